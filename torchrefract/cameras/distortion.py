"""Lens models on the plane z = 1: points distorted, and undistorted with a certificate.

All functions here take x and y apart, of any shapes that broadcast with coefficients viewed as (B, 12, 1, ...).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._checks import read

POLYNOMIAL12 = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
_NODES = 1024


class Terms(NamedTuple):
    """Which terms of the polynomial a computation needs; the others are taken as zero."""

    radial: int = 6
    tangential: bool = True
    prism: bool = True


ALL_TERMS = Terms()


class Jacobian(NamedTuple):
    """Derivatives of the distorted point: xy is d x_d / d y."""

    xx: Tensor
    xy: Tensor
    yx: Tensor
    yy: Tensor

    @property
    def determinant(self) -> Tensor:
        """Of the 2x2 matrix."""
        return self.xx * self.yy - self.xy * self.yx

    def solve(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """J^-1 (a, b), with the determinant held away from zero."""
        determinant = self.determinant
        determinant = torch.where(determinant.abs() < 1e-6, 1e-6, determinant)
        return (self.yy * a - self.xy * b) / determinant, (self.xx * b - self.yx * a) / determinant


def used_terms(coefficients: Tensor) -> Terms:
    """The terms that coefficients (B, 12) make use of: not zero, or asked for their gradient, or not to be read."""
    used = None if coefficients.requires_grad else read(lambda: (coefficients != 0).any(dim=0))
    if used is None:
        return ALL_TERMS
    return Terms(max((i + 1 for i in range(6) if used[i]), default=0), any(used[6:8]), any(used[8:]))


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
    c = coefficients.unbind(1)
    r2 = x * x + y * y
    radial = _radial(r2, c, terms.radial)
    x_d, y_d = x * radial, y * radial
    if terms.tangential:
        p1, p2 = c[6:8]
        xy = 2 * x * y
        x_d, y_d = x_d + p1 * xy + p2 * (r2 + 2 * x * x), y_d + p1 * (r2 + 2 * y * y) + p2 * xy
    if terms.prism:
        s1, s2, s3, s4 = c[8:]
        x_d, y_d = x_d + r2 * (s1 + s2 * r2), y_d + r2 * (s3 + s4 * r2)
    return x_d, y_d


def jacobian_polynomial(x: Tensor, y: Tensor, coefficients: Tensor, terms: Terms = ALL_TERMS) -> Jacobian:
    """The derivatives of `distort_polynomial` with respect to x and y."""
    c = coefficients.unbind(1)
    r2 = x * x + y * y
    radial, slope = _radial(r2, c, terms.radial), _radial_slope(r2, c, terms.radial)
    xx, xy, yy = radial + 2 * x * x * slope, 2 * x * y * slope, radial + 2 * y * y * slope
    yx = xy
    if terms.tangential:
        p1, p2 = c[6:8]
        xx, yy, cross = xx + 2 * p1 * y + 6 * p2 * x, yy + 6 * p1 * y + 2 * p2 * x, 2 * (p1 * x + p2 * y)
        xy, yx = xy + cross, yx + cross
    if terms.prism:
        s1, s2, s3, s4 = c[8:]
        s_x, s_y = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        xx, xy, yx, yy = xx + x * s_x, xy + y * s_x, yx + x * s_y, yy + y * s_y
    return Jacobian(xx, xy, yx, yy)


def undistort_polynomial(
    x_d: Tensor, y_d: Tensor, coefficients: Tensor, *, limit: "RadialLimit", terms: Terms = ALL_TERMS
) -> tuple[Tensor, Tensor, Tensor]:
    """The points that `distort_polynomial` maps to (x_d, y_d), without gradient, and which of them exist.

    The radial part is inverted by a table and Newton steps (2, in float64 3), the rest by Newton steps in the plane (3,
    in float64 4). A point
    exists if the radial part still grows there, the map keeps its orientation and the residual vanishes.

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
        r_d = (x_d * x_d + y_d * y_d).sqrt()
        r = limit.undistort(r_d, coefficients, terms.radial)
        scale = torch.where(r_d > torch.finfo(r_d.dtype).tiny, r / r_d, 1)
        x, y = scale * x_d, scale * y_d
        bent = terms.tangential or terms.prism
        if bent:
            x, y = _bend(x, y, x_d, y_d, coefficients, terms)
        reached = distort_polynomial(x, y, coefficients, terms)
        tolerance = 1e-12 if r_d.dtype is torch.float64 else 2e-6
        error = tolerance * (1 + r_d)
        exists = ((reached[0] - x_d).abs() <= error) & ((reached[1] - y_d).abs() <= error)
        exists &= x * x + y * y <= limit.radius.square()
        if bent:
            exists &= jacobian_polynomial(x, y, coefficients, terms).determinant > 0
        return x.nan_to_num(), y.nan_to_num(), exists


class RadialLimit(NamedTuple):
    """How far out the radial part of a lens can be inverted, and a table of its inverse.

    radius: (B, 1, ...), the largest radius before distortion, on the plane z = 1.
    image_radius: (B, 1, ...), the largest radius after distortion that the table covers.
    folds: (B,), bool: the radial part stops growing there; otherwise it was only followed so far.
    table: (B, 1025), the radius before distortion at equal steps from 0 to image_radius after it.
    """

    radius: Tensor
    image_radius: Tensor
    folds: Tensor
    table: Tensor

    def undistort(self, r_d: Tensor, coefficients: Tensor, order: int) -> Tensor:
        """The radius (B, ...) that the radial part maps to r_d, or `radius` where there is none."""
        if order == 0:
            return r_d.clone()
        place = (r_d / self.image_radius * _NODES).nan_to_num(nan=_NODES).clamp(0, _NODES)
        node = place.long().clamp(max=_NODES - 1)
        flat = node.flatten(1)
        low = self.table.gather(1, flat).view(node.shape)
        high = self.table.gather(1, flat + 1).view(node.shape)
        r = torch.lerp(low, high, place - node)
        c = coefficients.unbind(1)
        for _ in range(_steps_for(r, 2)):
            r2 = r * r
            radial = _radial(r2, c, order)
            growth = radial + 2 * r2 * _radial_slope(r2, c, order)
            step = (r * radial - r_d) / growth.clamp(min=torch.finfo(r.dtype).eps)
            r = torch.minimum((r - step).clamp(min=0), self.radius)
        return r


def radial_limit(coefficients: Tensor, reach: Tensor, image_reach: Tensor) -> RadialLimit:
    """The limit of the radial part of (B, 12, ...) coefficients.

    The limit is the first root of d/dr [r (1 + sum k_i r^2i)], found on a lattice that is refined twice.

    Args:
        coefficients: (B, 12, ...).
        reach: (B,), the radius up to which a root is looked for, on the plane z = 1.
        image_reach: (B,), the radius after distortion up to which the inverse is asked for.
    """
    with torch.no_grad():
        k = coefficients.flatten(1)[:, :6, None].unbind(1)
        folds = _falls(reach[:, None] * _steps(reach), k).any(dim=1)
        radius, width = torch.zeros_like(reach), reach
        for _ in range(3):
            first = _falls(radius[:, None] + width[:, None] * _steps(reach), k).long().argmax(dim=1)
            width = width / _NODES
            radius = torch.where(folds, radius + (first - 1).clamp(min=0) * width, reach)
        r, r_d = _lattice(radius, k)
        # Only what is asked for goes into the table, which is finer so.
        last = (r_d < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_NODES)
        r, r_d = _lattice(r.gather(1, last)[:, 0], k)
        image_radius = r_d[:, -1]
        table = _inverse_table(r, r_d)
        shape = (-1,) + (1,) * (coefficients.ndim - 2)
        return RadialLimit(radius.view(shape), image_radius.view(shape), folds, table)


def _falls(r: Tensor, k: tuple[Tensor, ...]) -> Tensor:
    return _radial(r * r, k, 6) + 2 * r * r * _radial_slope(r * r, k, 6) <= 0


def _lattice(radius: Tensor, k: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    r = radius[:, None] * _steps(radius)
    return r, r * _radial(r * r, k, 6)


def _inverse_table(r: Tensor, r_d: Tensor) -> Tensor:
    even = r_d[:, -1:] * _steps(r[:, 0])
    node = torch.searchsorted(r_d.contiguous(), even.contiguous()).clamp(1, _NODES)
    low, high = r_d.gather(1, node - 1), r_d.gather(1, node)
    share = ((even - low) / (high - low).clamp(min=torch.finfo(r.dtype).tiny)).clamp(0, 1)
    return torch.lerp(r.gather(1, node - 1), r.gather(1, node), share)


def _steps(like: Tensor) -> Tensor:
    return torch.arange(_NODES + 1, dtype=like.dtype, device=like.device) / _NODES


def _steps_for(like: Tensor, steps: int) -> int:
    return steps + 1 if like.dtype is torch.float64 else steps


def _bend(x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, coefficients: Tensor, terms: Terms) -> tuple[Tensor, Tensor]:
    """(x, y) brought from the inverse of the radial part to that of the whole model."""
    radial = x, y
    for _ in range(_steps_for(x, 3)):
        reached = distort_polynomial(x, y, coefficients, terms)
        jacobian = jacobian_polynomial(x, y, coefficients, terms)
        step_x, step_y = jacobian.solve(reached[0] - x_d, reached[1] - y_d)
        x, y = x - step_x, y - step_y
    # A sample without such terms keeps its bits, whatever its neighbors in the batch have.
    bent = (coefficients[:, 6:] != 0).any(dim=1)
    return torch.where(bent, x, radial[0]), torch.where(bent, y, radial[1])


def _radial(r2: Tensor, k: tuple[Tensor, ...], order: int) -> Tensor:
    """1 + sum k_i r^2i."""
    value = torch.zeros_like(r2)
    for i in reversed(range(order)):
        value = r2 * (k[i] + value)
    return 1 + value


def _radial_slope(r2: Tensor, k: tuple[Tensor, ...], order: int) -> Tensor:
    """The derivative of `_radial` with respect to r^2: sum i k_i r^(2i - 2)."""
    value = torch.zeros_like(r2)
    for i in reversed(range(order)):
        value = (i + 1) * k[i] + r2 * value
    return value
