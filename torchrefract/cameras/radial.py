"""Radial factors of lens models: their values, how far out they can be inverted, and their inverse.

A radially symmetric lens maps the radius r to r_d = r g(r^2) with a ratio of polynomials g = N / D,
N = 1 + n_1 r^2 + n_2 r^4 + ..., D likewise. The Brown-Conrady polynomial has no denominator, so D = 1. A fisheye is
the same with the angle to the axis in place of r. The division model is radial too, with closed forms both ways.

The lens is one-to-one from its center up to the radius where dr_d/dr reaches zero: beyond it the image folds back.
dr_d/dr is, up to a positive factor, a polynomial 1 + a_1 q + ... + a_n q^n in q = r^2, called the growth here.

Coefficients of a polynomial are a sequence without the leading 1: `numerator`, and `denominator`, which may be empty.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")  # of the Brown-Conrady polynomial, its first coefficients
_NODES = 2048  # of a lattice of radii
_MAX_IMAGE_RADIUS = 1e3  # focal lengths; farther points are outside every lens and must not coarsen the table
_DOUBLINGS = 12  # of the radius after distortion, to bracket the radius before it


def radial_factor(r2: Tensor, numerator: Sequence[Tensor], denominator: Sequence[Tensor] = ()) -> Tensor:
    """Evaluate g at r^2 by Horner's rule."""
    value = torch.zeros_like(r2)
    for coefficient in reversed(numerator):
        value = (value + coefficient) * r2
    return (1 + value) / radial_factor(r2, denominator) if denominator else 1 + value


def factor_and_slope(
    r2: Tensor, numerator: Sequence[Tensor], denominator: Sequence[Tensor] = ()
) -> tuple[Tensor, Tensor]:
    """Evaluate g and dg/d(r^2) at r^2."""
    value = slope = torch.zeros_like(r2)
    for coefficient in reversed(numerator):
        value = value + coefficient
        value, slope = value * r2, slope * r2 + value
    g = 1 + value
    if not denominator:
        return g, slope
    below, slope_below = factor_and_slope(r2, denominator)
    g = g / below
    return g, (slope - g * slope_below) / below


def growth(numerator: Sequence[Any], denominator: Sequence[Any] = ()) -> list[Any]:
    """Return a_1 ... a_n of the growth of r N / D, of numbers or tensors.

    d/dr [r N / D] = [N D + 2 q (N' D - N D')] / D^2, so that n_i d_j (1 + 2 (i - j)) belongs to q^(i + j).
    """
    numerator, denominator = (1.0, *numerator), (1.0, *denominator)
    powers: list[Any] = [0.0] * (len(numerator) + len(denominator) - 1)
    for i, n in enumerate(numerator):
        for j, d in enumerate(denominator):
            powers[i + j] = powers[i + j] + (1 + 2 * (i - j)) * n * d
    return powers[1:]


def first_root(a: Tensor) -> Tensor:
    """Return the smallest positive root of 1 + a_1 q + ... + a_n q^n, or inf if there is none.

    With z = 1 / q it is the largest positive root of z^n + a_1 z^(n - 1) + ... + a_n, an eigenvalue of a companion
    matrix. A root where the polynomial touches zero without crossing it counts. Takes (B, n) and returns (B,), both
    float64, without gradient.
    """
    with torch.no_grad():
        batch, n = a.shape
        companion = torch.diag_embed(a.new_ones(batch, n - 1), offset=-1)
        companion[:, 0] = -a
        z = torch.linalg.eigvals(companion)
        is_real = (z.imag.abs() <= 1e-7 * z.abs()) & (z.real > 1e-30)
        return 1 / torch.where(is_real, z.real, 0.0).amax(dim=1)


def falls_before(a: Sequence[float], q_max: float) -> bool:
    """Return True if 1 + a_1 q + ... is zero or below at one of 16 points up to `q_max`.

    Uses Python numbers, which torch.compile can trace.
    """
    points = (q_max * i / 16 for i in range(1, 17))
    return any(1 + sum(value * q**i for i, value in enumerate(a, start=1)) <= 0 for q in points)


def first_fall(falls: Callable[[Tensor], Tensor], reach: Tensor) -> Tensor:
    """Search the radius (B,) up to `reach` (B,) where a radial map stops growing, on a lattice that is refined twice.

    `falls` maps radii (B, n) to (B, n), bool: the map does not grow there. Returns `reach` if it never falls.
    """
    steps = _steps(reach)
    has_fall = falls(reach[:, None] * steps).any(dim=1)
    radius, width = torch.zeros_like(reach), reach
    for _ in range(3):
        first = falls(radius[:, None] + width[:, None] * steps).long().argmax(dim=1)
        width = width / _NODES
        radius = torch.where(has_fall, radius + (first - 1).clamp(min=0) * width, reach)
    return radius


class RadialLimit(NamedTuple):
    """The largest radius up to which a radial map can be inverted, with a table of its inverse.

    radius: (B, 1, ...), the largest radius before distortion, on the plane z = 1.
    image_radius: (B, 1, ...), the largest radius after distortion in the table.
    table: (B, 2049), the radius before distortion at r_d = image_radius (1 - (1 - i / 2048)^2). Near a fold the inverse
        behaves like a square root, and on these nodes it is smooth.
    """

    radius: Tensor
    image_radius: Tensor
    table: Tensor

    def inverse(self, r_d: Tensor) -> Tensor:
        """Interpolate the radius before distortion at (B, ...), to about 1e-6; beyond the table it is `radius`."""
        position = _NODES * (1 - (1 - r_d / self.image_radius).clamp(min=0).sqrt())
        node = position.long().clamp(0, _NODES - 1)
        index = node.flatten(1)
        low, high = (self.table.gather(1, index + i).view(node.shape) for i in (0, 1))
        return torch.lerp(low, high, position - node)


def radial_limit(coefficients: Tensor, reach: Tensor, image_reach: Tensor) -> RadialLimit:
    """Compute how far out the radial terms of the Brown-Conrady polynomial can be inverted.

    Args:
        coefficients: (B, 12, ...), with one dimension for each dimension of the points.
        reach: (B,), the largest radius on the plane z = 1 to search.
        image_reach: (B,), the largest radius after distortion that will be inverted.
    """
    with torch.no_grad():
        k = coefficients.flatten(1)[:, : len(RADIAL), None].unbind(1)
        slope = growth(k)
        radius = first_fall(lambda r: radial_factor(r * r, slope) <= 0, reach)
        limit, shape = _tabulate(radius, image_reach, k, ()), (-1,) + (1,) * (coefficients.ndim - 2)
        return RadialLimit(radius.view(shape), limit.image_radius.view(shape), limit.table)


def invert_radius(
    r_d: Tensor, radius: Tensor, numerator: Sequence[Tensor], denominator: Sequence[Tensor] = ()
) -> Tensor:
    """Solve r g(r^2) = r_d for r (B, N) by a table and Newton's method, without gradient.

    `radius` (B,), up to which the map grows, is inf if it always does. Each coefficient is (B, 1).
    """
    with torch.no_grad():
        zero = r_d.new_zeros(r_d.shape[0], 1)
        image_reach = torch.cat([zero, r_d], dim=1).clamp(max=_MAX_IMAGE_RADIUS).amax(dim=1)
        image_reach = 1.1 * image_reach.clamp(min=1e-3)
        # A radius far beyond the points would make the table coarse: bracket what they need by doubling.
        powers = 2.0 ** torch.arange(_DOUBLINGS + 1, dtype=radius.dtype, device=radius.device)
        radii = torch.minimum(image_reach[:, None] * powers, radius[:, None])
        reached = radii * radial_factor(radii * radii, numerator, denominator)
        first = (reached < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_DOUBLINGS)
        limit = _tabulate(radii.gather(1, first)[:, 0], image_reach, numerator, denominator)
        limit = limit._replace(radius=radius[:, None])
        return newton_radius(r_d, limit.inverse(r_d), limit, numerator, denominator)


def newton_radius(
    r_d: Tensor, start: Tensor, limit: RadialLimit, numerator: Sequence[Tensor], denominator: Sequence[Tensor] = ()
) -> Tensor:
    """Solve r g(r^2) = r_d for r (B, ...) by 2 Newton steps in float32, 3 in float64, from a start that is 1e-6 off."""
    r = start
    for _ in range(3 if r.dtype is torch.float64 else 2):
        r2 = r * r
        g, slope = factor_and_slope(r2, numerator, denominator)
        derivative = (g + 2 * r2 * slope).clamp(min=torch.finfo(r.dtype).eps)
        r = torch.minimum((r - (r * g - r_d) / derivative).clamp(min=0), limit.radius)
    return r


def _tabulate(
    radius: Tensor, image_reach: Tensor, numerator: Sequence[Tensor], denominator: Sequence[Tensor]
) -> RadialLimit:
    """Return the limit (B, 1) of a map that grows up to `radius`, with a table that ends where it covers the reach."""

    def curve(r: Tensor) -> Tensor:
        return r * radial_factor(r * r, numerator, denominator)

    steps = _steps(radius)
    r = radius[:, None] * steps
    last = (curve(r) < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_NODES)
    r = r.gather(1, last) * steps  # a shorter table is finer
    r_d = curve(r)
    nodes = r_d[:, -1:] * (1 - (1 - steps).square())
    node = torch.searchsorted(r_d.contiguous(), nodes.contiguous()).clamp(1, _NODES)
    low, high = r_d.gather(1, node - 1), r_d.gather(1, node)
    weight = ((nodes - low) / (high - low).clamp(min=torch.finfo(r.dtype).tiny)).clamp(0, 1)
    table = torch.lerp(r.gather(1, node - 1), r.gather(1, node), weight)
    return RadialLimit(radius[:, None], r_d[:, -1:], table)


def _steps(like: Tensor) -> Tensor:
    return torch.arange(_NODES + 1, dtype=like.dtype, device=like.device) / _NODES


def undistort_division(x_d: Tensor, y_d: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Undistort points by the division model, which is defined from the image to the plane z = 1.

        x = x_d / (1 + k r_d^2),  y = y_d / (1 + k r_d^2)

    k is (B, 1), all else (B, N). The last result is True where the point exists: 1 + k r_d^2 and 1 - k r_d^2, to which
    dr / dr_d is proportional, are above zero. Elsewhere x and y are 0.

    Source: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion", CVPR 2001.
    """
    with torch.no_grad():
        exists = (k * (x_d * x_d + y_d * y_d)).abs() < 1
    x_d, y_d = torch.where(exists, x_d, 0.0), torch.where(exists, y_d, 0.0)
    scale = 1 / (1 + k * (x_d * x_d + y_d * y_d))
    return scale * x_d, scale * y_d, exists


def distort_division(x: Tensor, y: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distort points by the inverse of `undistort_division`, the nearest root of k r r_d^2 - r_d + r = 0.

        x_d = 2 x / (1 + sqrt(1 - 4 k r^2)),  y_d = 2 y / (1 + sqrt(1 - 4 k r^2))

    The shapes are as there; a point exists where 1 - 4 k r^2 is above zero.
    """
    with torch.no_grad():
        exists = 4 * k * (x * x + y * y) < 1
    x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
    scale = 2 / (1 + (1 - 4 * k * (x * x + y * y)).sqrt())
    return scale * x, scale * y, exists
