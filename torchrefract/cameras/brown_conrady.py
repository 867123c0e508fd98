"""The extended Brown-Conrady lens model: a polynomial with radial, tangential and thin-prism terms.

The model maps a point (x, y) of the plane z = 1 to the point where the lens shows it, in focal lengths from the
principal point. All functions take x and y as separate tensors of any shapes (B, ...) that broadcast with coefficients
(B, 12, ...), k1 ... k6, p1, p2, s1 ... s4, and compute only the given `terms`. To add a radial term, extend `RADIAL` in
`radial.py`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import eager_values, requires_grad
from torchrefract.cameras.radial import RADIAL, RadialLimit, factor_and_slope, newton_radius, radial_factor
from torchrefract.warping.flow import Jacobian

POLYNOMIAL12 = (*RADIAL, "p1", "p2", "s1", "s2", "s3", "s4")
MAX_RESIDUAL = {torch.float32: 2e-6, torch.float64: 1e-12}  # of an inverted point, relative to 1 + r_d
# Rounding of a position is divided by the determinant, so that these keep it below 40 units in the last place.
_MIN_DETERMINANT = {torch.float32: 1 / 32, torch.float64: 1e-9}
_MIN_RADIAL_FACTOR = 0.1  # in the first guess of Newton's method
# In the plane; strong prisms need more than the usual 3. In graphs and on accelerators, where nothing can be read,
# all points take the second number of steps, and those that need more count as having no preimage.
_MAX_NEWTON_STEPS, _BLIND_NEWTON_STEPS = 12, 8
_SMALL_STEP = {torch.float32: 1e-4, torch.float64: 1e-7}  # after which the error is about its square

Point = tuple[Tensor, Tensor]  # x and y


class Terms(NamedTuple):
    """The terms of the polynomial to compute; the coefficients of all others count as zero."""

    radial: int = len(RADIAL)  # number of radial terms, k1 and on
    tangential: bool = True  # p1 and p2
    prism: bool = True  # s1 ... s4

    @property
    def bent(self) -> bool:
        """Return True if there are other terms than radial ones."""
        return self.tangential or self.prism


ALL_TERMS = Terms()


def used_terms(coefficients: Tensor) -> Terms:
    """Return the terms with a coefficient that is not zero.

    Returns all terms if the coefficients (B, 12) require a gradient, or if reading them would wait for a device.
    """
    values = None if requires_grad((coefficients,)) else eager_values(lambda: coefficients)
    if values is None:
        return ALL_TERMS
    is_used = list(map(any, zip(*values, strict=True)))
    if not is_used:
        return ALL_TERMS
    n = len(RADIAL)
    order = n - [*is_used[n - 1 :: -1], True].index(True)  # of the last radial term that is used
    return Terms(order, any(is_used[n : n + 2]), any(is_used[n + 2 :]))


def distort_polynomial(x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS) -> Point:
    """Distort points (x, y) of the plane z = 1 by the extended Brown-Conrady model, to focal lengths.

        x_d = x g + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_d = y g + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,  g = 1 + sum k_i r^2i,  i = 1 ... 6

    It equals OpenCV's model if k4 = k5 = k6 = 0; OpenCV's coefficients of those names form a denominator.

    Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37 (1971), with thin-prism terms.
    """
    k, p, s = _groups(coefficients, terms)
    r2 = x * x + y * y
    g = radial_factor(r2, k)
    shift_x, shift_y = _decentering(x, y, r2, p, s)
    return x * g + shift_x, y * g + shift_y


def distort_with_jacobian(
    x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS
) -> tuple[Point, Jacobian]:
    """Compute `distort_polynomial` and its derivatives with respect to x and y."""
    k, p, s = _groups(coefficients, terms)
    return distort_by_factor(x, y, k=k, p=p, s=s)


def distort_by_factor(
    x: Tensor,
    y: Tensor,
    *,
    k: Sequence[Tensor],
    denominator: Sequence[Tensor] = (),
    p: Sequence[Tensor],
    s: Sequence[Tensor],
) -> tuple[Point, Jacobian]:
    """Compute the polynomial with the ratio of k and the denominator (see `radial.py`) as g, and its derivatives.

    The derivatives of (x g, y g) are g I + 2 dg/d(r^2) (x, y)^T (x, y). p (p1, p2) and s (s1 ... s4) may be empty.
    """
    r2 = x * x + y * y
    g, slope = factor_and_slope(r2, k, denominator)
    shift_x, shift_y = _decentering(x, y, r2, p, s)
    cross = 2 * slope * x * y
    xx, xy, yx, yy = g + 2 * slope * x * x, cross, cross, g + 2 * slope * y * y
    if p:
        p1, p2 = p
        cross = 2 * (p1 * x + p2 * y)
        xx, xy, yx, yy = xx + 2 * p1 * y + 6 * p2 * x, xy + cross, yx + cross, yy + 6 * p1 * y + 2 * p2 * x
    if s:
        s1, s2, s3, s4 = s
        a, b = 2 * s1 + 4 * s2 * r2, 2 * s3 + 4 * s4 * r2
        xx, xy, yx, yy = xx + a * x, xy + a * y, yx + b * x, yy + b * y
    return (x * g + shift_x, y * g + shift_y), Jacobian(xx, xy, yx, yy)


def _decentering(x: Tensor, y: Tensor, r2: Tensor, p: Sequence[Tensor], s: Sequence[Tensor]) -> Point:
    shift_x = shift_y = torch.zeros_like(r2)
    if p:
        p1, p2 = p
        shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        shift_y = 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    if s:
        s1, s2, s3, s4 = s
        shift_x, shift_y = shift_x + r2 * (s1 + s2 * r2), shift_y + r2 * (s3 + s4 * r2)
    return shift_x, shift_y


def undistort_polynomial(
    x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, limit: RadialLimit, terms: Terms = ALL_TERMS
) -> tuple[Tensor, Tensor, Tensor]:
    """Invert `distort_polynomial` by Newton's method, without gradient.

    Newton's method starts from the inverse of the radial terms, which a table gives to 1e-6. It runs along the radius
    if there are only radial terms, otherwise in the plane. The limit is of the same coefficients, by `radial_limit`.

    Returns:
        x, y: (B, ...), on the plane z = 1, finite everywhere.
        exists: (B, ...), bool: the point lies before the fold of the radial terms, distorts back to (x_d, y_d), and is
            not so near a fold that rounding decides where it lies: the Jacobian determinant is at least 1/32 in single
            precision.
    """
    with torch.no_grad():
        k, p, s = _groups(coefficients, terms)
        distort = partial(distort_by_factor, k=k, p=p, s=s)
        r_d = (x_d * x_d + y_d * y_d).sqrt()
        r = limit.inverse(r_d)
        if not terms.bent:
            r = newton_radius(r_d, r, limit, k)
        scale = r / r_d.clamp(min=torch.finfo(r_d.dtype).tiny)
        x, y = scale * x_d, scale * y_d
        if terms.bent:
            x, y = converge((x, y), (x_d, y_d), distort)
        (back_x, back_y), jacobian = distort(x, y)
        residual = torch.maximum((back_x - x_d).abs(), (back_y - y_d).abs())
        exists = (residual <= MAX_RESIDUAL[r_d.dtype] * (1 + r_d)) & (x * x + y * y <= limit.radius.square())
        exists = exists & (jacobian.determinant >= _MIN_DETERMINANT[r_d.dtype])
        return x.nan_to_num(0, 0, 0), y.nan_to_num(0, 0, 0), exists


def newton_undistort(x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, steps: int, terms: Terms = ALL_TERMS) -> Point:
    """Invert `distort_polynomial` by a fixed number of Newton steps in the plane, 0 or more, without gradient.

    The first guess divides the distorted point by the radial factor at that point. Converges for lenses that do not
    fold near the points; checks nothing.
    """
    with torch.no_grad():
        k, p, s = _groups(coefficients, terms)
        g = radial_factor(x_d * x_d + y_d * y_d, k).clamp(min=_MIN_RADIAL_FACTOR)
        point = x_d / g, y_d / g
        for _ in range(steps):
            point = newton_step(point, (x_d, y_d), *distort_by_factor(*point, k=k, p=p, s=s))
        return point


def newton_step(point: Point, target: Point, reached: Point, jacobian: Jacobian) -> Point:
    """Return the next point of Newton's method in the plane, for a map that takes `point` to `reached`."""
    step_x, step_y = jacobian.solve(reached[0] - target[0], reached[1] - target[1])
    return point[0] - step_x, point[1] - step_y


def converge(point: Point, target: Point, distort: Callable[[Tensor, Tensor], tuple[Point, Jacobian]]) -> Point:
    """Solve distort(point) = target by Newton's method in the plane.

    Each point stops after a small step, or after 12 steps, and does not depend on the others. If values cannot be
    read, all points take 8 steps.
    """
    x, y = point
    is_done = torch.zeros_like(x, dtype=torch.bool)
    for count in range(1, _MAX_NEWTON_STEPS + 1):
        new_x, new_y = newton_step((x, y), target, *distort(x, y))
        step = torch.maximum((new_x - x).abs(), (new_y - y).abs())
        x, y = torch.where(is_done, x, new_x), torch.where(is_done, y, new_y)
        is_done = is_done | (step <= _SMALL_STEP[step.dtype])
        all_done = eager_values(is_done.all, of=step)
        if all_done or (all_done is None and count == _BLIND_NEWTON_STEPS):
            break
    return x, y


def _groups(coefficients: Tensor, terms: Terms) -> tuple[Sequence[Tensor], Sequence[Tensor], Sequence[Tensor]]:
    """Return k, p and s of coefficients (B, 12, ...), each (B, ...), without the terms that are not computed."""
    values, n = coefficients.unbind(1), len(RADIAL)
    return (
        values[: terms.radial],
        values[n : n + 2] if terms.tangential else (),
        values[n + 2 :] if terms.prism else (),
    )
