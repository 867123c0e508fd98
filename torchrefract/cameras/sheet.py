"""Rays through a lens of any model, on the sheet that holds its center: up to a radius that is known.

The radius is on the plane z = 1, before distortion, and of a fisheye an angle, rad. All functions here take x and y,
(B, N), and the coefficients apart, as `columns` has them; shapes are not checked.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import (
    Jacobian,
    distort_polynomial,
    implicit,
    jacobian_polynomial,
    undistort_polynomial,
)
from torchrefract.cameras.division import distort_division, undistort_division
from torchrefract.cameras.fisheye import fisheye_angle, fisheye_image, fisheye_ray
from torchrefract.cameras.growth import first_root, growth_of_powers, growth_of_ratio
from torchrefract.cameras.radial import first_fall, limit_of_curve, radial, reach_of
from torchrefract.cameras.rational import (
    OPENCV_COUNTS,
    distort_opencv,
    in_front,
    opencv_radius,
    undistort_opencv,
)

# How many coefficients each model has.
MODELS = {"polynomial12": (12,), "opencv": OPENCV_COUNTS, "fisheye": (4,), "division": (1,)}
FARTHEST = 1e6  # on the plane z = 1; no lens shows what lies beyond
_MISSES = {torch.float32: 2e-6, torch.float64: 1e-12}  # of a solved point, relative to 1 + r_d


def columns(coefficients: Tensor, model: str) -> tuple[Tensor, ...]:
    """The coefficients (B, n) apart, (B, 1) each; of OpenCV's model 14 of them."""
    return (padded(coefficients) if model == "opencv" else coefficients)[..., None].unbind(1)


def padded(coefficients: Tensor) -> Tensor:
    """Coefficients of OpenCV's as 14 of them."""
    return torch.cat([coefficients, coefficients.new_zeros(len(coefficients), 14 - coefficients.shape[1])], dim=1)


def exact_radius(coefficients: Tensor, model: str) -> Tensor:
    """(B,), float64: up to where coefficients (B, n) make a lens one-to-one, by the roots of its growth; or inf."""
    c = coefficients.detach().double()
    if model == "polynomial12":
        return first_root(torch.stack(growth_of_powers(c[:, :6].unbind(1)), dim=1)).sqrt()
    if model == "opencv":
        return opencv_radius(padded(c))
    return fisheye_angle(c) if model == "fisheye" else first_root(-4 * c).sqrt()


def radius_within(coefficients: Tensor, reach: Tensor, model: str) -> Tensor:
    """(B,): up to where coefficients (B, n) make a lens one-to-one, looked for on a lattice as far as a reach, (B,).

    That is no further than where it is asked for, needs no roots, and so waits for no device.
    """
    with torch.no_grad():
        c = columns(coefficients.detach(), model)
        if model == "division":
            return reach
        if model == "opencv":
            growth, below = growth_of_ratio((c[0], c[1], c[4]), c[5:8]), c[5:8]
            return first_fall(lambda r: (_power_sum(growth, r) <= 0) | (_power_sum(below, r) <= 0), reach)[0]
        growth = growth_of_powers(c[:6])
        end = torch.full_like(reach, math.pi) if model == "fisheye" else reach
        return first_fall(lambda r: _power_sum(growth, r) <= 0, end)[0]


def image_of(
    x: Tensor, y: Tensor, z: Tensor, c: Sequence[Tensor], model: str, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where a lens shows rays, in focal lengths from the center, and which of them it does."""
    if model == "fisheye":
        return fisheye_image(x, y, z, c, radius)
    with torch.no_grad():
        seen = (z > 0) & (torch.maximum(x.abs(), y.abs()) < FARTHEST * z)
    x, y = (torch.where(seen, a, 0.0) / torch.where(seen, z, 1.0) for a in (x, y))
    if model == "division":
        x_d, y_d, exists = distort_division(x, y, c[0])
        return x_d, y_d, exists & seen
    with torch.no_grad():
        upright = _upright(x, y, [value.detach() for value in c], model, radius) & seen
    x, y = torch.where(upright, x, 0.0), torch.where(upright, y, 0.0)
    x_d, y_d, _ = formula(x, y, c, model)
    return torch.where(upright, x_d, 0.0), torch.where(upright, y_d, 0.0), upright


def ray_of(
    x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str, radius: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """The rays that a lens shows at places in focal lengths from the center, of any length, and which there are."""
    if model == "fisheye":
        return fisheye_ray(x_d, y_d, c, radius)
    if model == "division":
        x, y, exists = undistort_division(x_d, y_d, c[0])
        return (x, y, torch.ones_like(x)), exists
    with torch.no_grad():
        still = [value.detach() for value in c]
        x, y, exists = _solved(x_d.detach(), y_d.detach(), still, model, radius)
        x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
        jacobian = formula(x, y, still, model)[2]
    reached_x, reached_y, _ = formula(x, y, c, model)
    x, y = implicit((x, y), (reached_x - x_d, reached_y - y_d), jacobian)
    return (x, y, torch.ones_like(x)), exists


def on_plane(ray: tuple[Tensor, Tensor, Tensor], valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where valid rays meet the plane z = 1, and which of them do."""
    valid = valid & (ray[2] > 1 / FARTHEST)
    x, y = (torch.where(valid, a, 0.0) / torch.where(valid, ray[2], 1.0) for a in ray[:2])
    return x, y, valid


def formula(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str) -> tuple[Tensor, Tensor, Jacobian]:
    """A polynomial's or a ratio's point and its derivatives, on whichever sheet."""
    if model == "opencv":
        return distort_opencv(x, y, c)
    stacked = torch.stack(tuple(c), dim=1)
    return *distort_polynomial(x, y, stacked), jacobian_polynomial(x, y, stacked)


def _power_sum(a: Sequence[Tensor], r: Tensor) -> Tensor:
    """1 + a_1 r^2 + a_2 r^4 + ..."""
    return radial(r * r, tuple(a), len(a))


def _upright(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str, radius: Tensor) -> Tensor:
    """(B, N), bool: points of the plane z = 1 on the sheet that holds the center."""
    near = x * x + y * y <= radius[:, None].square()
    if model == "opencv":
        near = near & in_front(x, y, c)
    return near & (formula(x, y, c, model)[2].determinant > 0)


def _solved(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The points that a polynomial or a ratio maps to others, and which there are."""
    r_d = (x_d * x_d + y_d * y_d).sqrt()
    if model == "polynomial12":
        k = tuple(c[:6])
        limit = limit_of_curve(radius, reach_of(r_d), lambda r: r * radial(r * r, k, 6))
        return undistort_polynomial(x_d, y_d, torch.stack(tuple(c), dim=1), limit=limit)
    x, y = undistort_opencv(x_d, y_d, c, radius)
    reached_x, reached_y, _ = distort_opencv(x, y, c)
    missed = torch.maximum((reached_x - x_d).abs(), (reached_y - y_d).abs())
    return x, y, _upright(x, y, c, model, radius) & (missed <= _MISSES[x.dtype] * (1 + r_d))
