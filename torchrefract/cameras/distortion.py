"""Lens models on the plane z = 1: points distorted, and undistorted with a certificate.

All functions here take x and y apart, of any shapes that broadcast with coefficients viewed as (B, 12, 1, ...).
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import eager_bool, eager_values
from torchrefract.cameras.radial import RadialLimit, radial, radial_slope
from torchrefract.warping.flow import Jacobian

POLYNOMIAL12 = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
_SMALLEST_RADIAL = 0.1  # of a first guess


class Terms(NamedTuple):
    """Which terms of the polynomial a computation needs; the others are taken as zero."""

    radial: int = 6
    tangential: bool = True
    prism: bool = True
    round: bool = True  # some lens of the batch may have radial terms only

    @property
    def bent(self) -> bool:
        """Some lens of the batch may have other terms than radial ones."""
        return self.tangential or self.prism


ALL_TERMS = Terms()


def used_terms(coefficients: Tensor) -> Terms:
    """The terms that coefficients (B, 12) make use of: not zero, or asked for their gradient, or not to be read."""
    values = None if coefficients.requires_grad else eager_values(lambda: coefficients)
    if values is None:
        return ALL_TERMS
    used = [any(row[i] for row in values) for i in range(12)]
    order = max((i + 1 for i in range(6) if used[i]), default=0)
    return Terms(order, any(used[6:8]), any(used[8:]), not all(any(row[6:]) for row in values))


def distort_polynomial(x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS) -> tuple[Tensor, Tensor]:
    """The extended Brown-Conrady model, a polynomial.

        x_d = x (1 + sum k_i r^2i) + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_d = y (1 + sum k_i r^2i) + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,  i = 1 ... 6

    OpenCV's k4, k5, k6 are another model (a denominator); only with k4 = k5 = k6 = 0 are the two the same.

    Args:
        x, y: (B, ...), on the plane z = 1.
        coefficients: (B, 12, ...), k1 ... k6, p1, p2, s1 ... s4.
        terms: those to compute.

    Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37 (1971), with thin-prism terms.
    """
    return _distorted(x, y, coefficients.unbind(1), terms)[0]


def distort_with_jacobian(
    x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS
) -> tuple[tuple[Tensor, Tensor], Jacobian]:
    """The point of `distort_polynomial` and the derivatives of `jacobian_polynomial`; arguments as there."""
    c = coefficients.unbind(1)
    point, r2, g = _distorted(x, y, c, terms)
    return point, _slopes(x, y, r2, g, c, terms)


def jacobian_polynomial(x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS) -> Jacobian:
    """The derivatives of `distort_polynomial` with respect to x and y."""
    return distort_with_jacobian(x, y, coefficients, terms)[1]


def undistort_polynomial(
    x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, limit: RadialLimit, terms: Terms = ALL_TERMS
) -> tuple[Tensor, Tensor, Tensor]:
    """The points that `distort_polynomial` maps to (x_d, y_d), without gradient, and which of them exist.

    A table gives the inverse of the radial part to 1e-6. From there go Newton steps: along the radius for a lens with
    radial terms only (2, in float64 3), in the plane for others (2, in float64 3; up to 3 and 5 for points that the
    last of these still moves by 1e-4, in float64 1e-8). A point exists if the radial part still grows there, the map
    keeps its orientation and the residual vanishes.

    Args:
        x_d, y_d: (B, ...), on the plane z = 1.
        coefficients: (B, 12, ...), k1 ... k6, p1, p2, s1 ... s4.
        limit: how far the radial part can be inverted, of the same batch.
        terms: those to compute.

    Returns:
        x, y: (B, ...), on the plane z = 1; not meaningful where `exists` is false, finite everywhere.
        exists: (B, ...), bool.
    """
    with torch.no_grad():
        c = coefficients.unbind(1)
        r_d = (x_d * x_d + y_d * y_d).sqrt()
        if r_d.numel() == 0:
            return r_d, r_d, r_d == 0
        r = _radial_start(r_d, c, limit, terms)
        scale = r / r_d.clamp(min=torch.finfo(r_d.dtype).tiny)
        x, y = scale * x_d, scale * y_d
        if terms.bent:
            x, y = _bend(x, y, x_d, y_d, coefficients, terms)
        (reached_x, reached_y), r2, g = _distorted(x, y, c, terms)
        # What must not be negative, in one number: comparisons are slow.
        room = (1e-12 if r_d.dtype is torch.float64 else 2e-6) * (1 + r_d)
        room = torch.minimum(room - (reached_x - x_d).abs(), room - (reached_y - y_d).abs())
        room = torch.minimum(room, limit.radius.square() - r2)
        if terms.bent:
            room = torch.minimum(room, _slopes(x, y, r2, g, c, terms).determinant)
        if eager_bool(lambda: room.amin() >= 0, of=room):
            return x, y, torch.ones_like(room, dtype=torch.bool)
        return x.nan_to_num(0, 0, 0), y.nan_to_num(0, 0, 0), room >= 0


def newton_undistort(
    x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, steps: int, terms: Terms = ALL_TERMS
) -> tuple[Tensor, Tensor]:
    """The points that `distort_polynomial` maps to (x_d, y_d), for lenses that fold nowhere near; without gradient.

    So many Newton steps in the plane, from the distorted point over the radial part taken there.

    Args:
        x_d, y_d: (B, ...), on the plane z = 1.
        coefficients: (B, 12, ...), k1 ... k6, p1, p2, s1 ... s4.
        steps: 0 or more.
        terms: those to compute.
    """
    with torch.no_grad():
        return next(islice(newton_iterates(x_d, y_d, coefficients, terms=terms), steps, None))


def newton_iterates(
    x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, terms: Terms = ALL_TERMS
) -> Iterator[tuple[Tensor, Tensor]]:
    """The points of `newton_undistort` after 0, 1, 2 ... steps, without end; arguments as there."""
    c = coefficients.unbind(1)
    shrunk = radial(x_d * x_d + y_d * y_d, c, terms.radial).clamp(min=_SMALLEST_RADIAL)
    x, y = x_d / shrunk, y_d / shrunk
    while True:
        yield x, y
        (reached_x, reached_y), r2, g = _distorted(x, y, c, terms)
        step_x, step_y = _slopes(x, y, r2, g, c, terms).solve(reached_x - x_d, reached_y - y_d)
        x, y = x - step_x, y - step_y


def _radial_start(r_d: Tensor, c: tuple[Tensor, ...], limit: RadialLimit, terms: Terms) -> Tensor:
    """The inverse of the radial part: exact for lenses without other terms, to start from for the others."""
    if terms.radial == 0:
        return r_d
    start = limit.sample_image(r_d)
    if not terms.round:
        return start
    r = newton_radius(r_d, start, limit, lambda r2: (radial(r2, c, terms.radial), radial_slope(r2, c, terms.radial)))
    return torch.where(_is_bent(c), start, r) if terms.bent else r


def newton_radius(
    r_d: Tensor, start: Tensor, limit: RadialLimit, parts: Callable[[Tensor], tuple[Tensor, Tensor]]
) -> Tensor:
    """The radius r with r g(r^2) = r_d, by Newton steps (2, in float64 3) from a start that is good to 1e-6.

    Args:
        r_d, start: (B, ...).
        limit: how far the radial part can be inverted.
        parts: from r^2 to g and its derivative with respect to r^2.
    """
    r = start
    for _ in range(3 if r.dtype is torch.float64 else 2):
        r2 = r * r
        shrunk, slope = parts(r2)
        growth = shrunk + 2 * r2 * slope
        step = (r * shrunk - r_d) / growth.clamp(min=torch.finfo(r.dtype).eps)
        r = torch.minimum((r - step).clamp(min=0), limit.radius)
    return r


def _bend(x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, coefficients: Tensor, terms: Terms) -> tuple[Tensor, Tensor]:
    """(x, y) brought from the inverse of the radial part to that of the whole model."""
    c = coefficients.unbind(1)
    straight = x, y
    least, most, still = (3, 5, 1e-8) if x.dtype is torch.float64 else (2, 3, 1e-4)
    moves: Tensor | None = None  # points that the last step has moved
    for count in range(1, most + 1):
        (reached_x, reached_y), r2, g = _distorted(x, y, c, terms)
        step_x, step_y = _slopes(x, y, r2, g, c, terms).solve(reached_x - x_d, reached_y - y_d)
        if moves is not None:  # each point by itself
            step_x, step_y = torch.where(moves, step_x, 0), torch.where(moves, step_y, 0)
        x, y = x - step_x, y - step_y
        if count >= least:
            size = torch.maximum(step_x.abs(), step_y.abs())
            if eager_bool(lambda size=size: size.amax() <= still, of=size):
                break
            moves = size > still
    if not terms.round:
        return x, y
    # A lens without such terms keeps its bits, whatever its neighbors in the batch have.
    bent = _is_bent(c)
    return torch.where(bent, x, straight[0]), torch.where(bent, y, straight[1])


def _is_bent(c: tuple[Tensor, ...]) -> Tensor:
    return torch.stack(c[6:]).ne(0).any(dim=0)


def _distorted(
    x: Tensor, y: Tensor, c: tuple[Tensor, ...], terms: Terms
) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """The distorted point, with r^2 and g.

    x_d = x g + r^2 (p2 + s1 + s2 r^2),  y_d = y g + r^2 (p1 + s3 + s4 r^2),  g = 1 + sum k_i r^2i + 2 p1 y + 2 p2 x
    """
    r2 = x * x + y * y
    point, g = bent(x, y, r2, radial(r2, c, terms.radial), c[6:], terms)
    return point, r2, g


def bent(
    x: Tensor, y: Tensor, r2: Tensor, g: Tensor, others: Sequence[Tensor], terms: Terms
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """The point distorted by a radial part g and by the others, p1, p2, s1 ... s4; and g with 2 p1 y + 2 p2 x."""
    p1, p2, s1, s2, s3, s4 = others
    if not terms.bent:
        return (x * g, y * g), g
    if terms.tangential:
        g = torch.addcmul(torch.addcmul(g, 2 * p1, y), 2 * p2, x)
    a, b = (p2 + s1 + s2 * r2, p1 + s3 + s4 * r2) if terms.prism else (p2, p1)
    return (torch.addcmul(r2 * a, x, g), torch.addcmul(r2 * b, y, g)), g


def _slopes(x: Tensor, y: Tensor, r2: Tensor, g: Tensor, c: tuple[Tensor, ...], terms: Terms) -> Jacobian:
    """The derivatives of the distorted point, by what `_distorted` has computed already."""
    return bent_slopes(x, y, r2, g, radial_slope(r2, c, terms.radial), c[6:], terms)


def bent_slopes(
    x: Tensor, y: Tensor, r2: Tensor, g: Tensor, slope: Tensor, others: Sequence[Tensor], terms: Terms
) -> Jacobian:
    """The derivatives of the point of `bent`: g as it returns it, slope that of the radial part by r^2."""
    p1, p2, s1, s2, s3, s4 = others
    along_x, along_y = slope * x, slope * y
    if not terms.bent:
        cross = 2 * along_x * y
        return Jacobian(torch.addcmul(g, x, along_x, value=2), cross, cross, torch.addcmul(g, y, along_y, value=2))
    cross = torch.addcmul(2 * p1 * x, along_x + p2, y, value=2)
    if not terms.prism:
        xx, yy = torch.addcmul(g, x, along_x + 2 * p2, value=2), torch.addcmul(g, y, along_y + 2 * p1, value=2)
        return Jacobian(xx, cross, cross, yy)
    a, b = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2
    return Jacobian(
        torch.addcmul(g, x, along_x + (2 * p2 + a), value=2),
        torch.addcmul(cross, a, y, value=2),
        torch.addcmul(cross, b, x, value=2),
        torch.addcmul(g, y, along_y + (2 * p1 + b), value=2),
    )


def implicit(point: tuple[Tensor, Tensor], error: tuple[Tensor, Tensor], jacobian: Jacobian) -> tuple[Tensor, Tensor]:
    """A solved point with the gradient of the exact inverse: one Newton step of length zero.

    Args:
        point: x and y, solved without gradient.
        error: what the model makes of the point, less what it should be, with gradient.
        jacobian: of the model there, held fixed.
    """
    step_x, step_y = jacobian.solve(error[0] - error[0].detach(), error[1] - error[1].detach())
    return point[0] - step_x, point[1] - step_y
