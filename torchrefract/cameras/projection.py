"""Points and rays through the lenses of a batch of cameras, differentiable, with validity and residual.

`distort`, `undistort`, `project`, `unproject` and `valid_radius` check their arguments. The functions below them choose
the formula of the lens model; they take x and y, (B, N), and the coefficients as `columns` returns them, and check
nothing. Every model is used from the center of the image up to the radius where it folds back, on the plane z = 1
before distortion; for a fisheye it is an angle in rad.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_tensor, check_values
from torchrefract.cameras.brown_conrady import POLYNOMIAL12, Point
from torchrefract.cameras.fisheye import fisheye_angle, fisheye_image, fisheye_ray
from torchrefract.cameras.radial import (
    distort_division,
    first_fall,
    first_root,
    growth,
    radial_factor,
    undistort_division,
)
from torchrefract.cameras.rational import OPENCV14, OPENCV_COUNTS, RationalLens
from torchrefract.warping.flow import Jacobian
from torchrefract.warping.implicit import implicit

# Names of the coefficients of each model, and how many of them a camera may have.
COEFFICIENTS = {
    "polynomial12": POLYNOMIAL12,
    "opencv": OPENCV14,
    "fisheye": ("k1", "k2", "k3", "k4"),
    "division": ("k",),
}
MODELS = {"polynomial12": (len(POLYNOMIAL12),), "opencv": OPENCV_COUNTS, "fisheye": (4,), "division": (1,)}
_MAX_RADIUS = 1e6  # on the plane z = 1; no lens shows points beyond it


class PointResult(NamedTuple):
    """Points or rays after a lens.

    The residual is zero for closed forms. It is in px if the input is in px, otherwise in focal lengths.
    """

    points: Tensor  # (B, N, 2), or rays (B, N, 3); the center or the axis, without gradient, if not valid
    valid: Tensor  # (B, N), bool: the model has an answer before the lens folds back
    residual: Tensor  # (B, N), the distance between the input and the answer put through the model


def distort(points: Tensor, coefficients: Tensor, *, model: str) -> PointResult:
    """Distort points of the plane z = 1.

    Args:
        points: (B, N, 2), on the plane z = 1; float32 or float64.
        coefficients: (B, n), of the model.
        model: "polynomial12", "opencv", "fisheye" or "division".

    Returns:
        Points (B, N, 2) in focal lengths from the center of the image; in px they are focal * point + center.

    Raises:
        ValueError: a shape or model is wrong, or a coefficient is not finite.
        TypeError: `points` is not float32 or float64.
    """
    points, finite, lens = _check_points("points", points, 2, coefficients, model)
    x, y = points.unbind(-1)
    x_d, y_d, valid = image_of(x, y, torch.ones_like(x), *lens)
    return PointResult(torch.stack([x_d, y_d], dim=-1), valid & finite, torch.zeros_like(x_d))


def undistort(points: Tensor, coefficients: Tensor, *, model: str) -> PointResult:
    """Invert `distort`, with the gradient of the exact inverse by the implicit function theorem.

    Args:
        points: (B, N, 2), in focal lengths from the center of the image; float32 or float64.
        coefficients, model: as for `distort`.

    Returns:
        Points (B, N, 2) on the plane z = 1. Rays of a fisheye at 90 degrees or more to its axis are not valid: they do
        not meet the plane.

    Raises: as for `distort`.
    """
    points, finite, lens = _check_points("points", points, 2, coefficients, model)
    x_d, y_d = points.unbind(-1)
    ray, valid = ray_of(x_d, y_d, *lens)
    x, y, valid = on_plane(ray, valid & finite)
    residual = _residual((x, y, torch.ones_like(x)), points, lens)
    return PointResult(torch.stack([x, y], dim=-1), valid, residual)


def project(points: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> PointResult:
    """Project points in space to pixels.

        (u, v) = focal distort(x / z, y / z) + center;  a fisheye uses the angle to the axis, up to pi

    Args:
        points: (B, N, 3), x right, y down, z forward, in any unit; float32 or float64.
        coefficients, model: as for `distort`.
        focal, center: (B, 2), px.

    Returns:
        Pixels (B, N, 2), which may lie outside the frame; pixel centers are whole numbers.

    Raises: as for `distort`, and ValueError for a focal length that is not positive.
    """
    points, finite, lens = _check_points("points", points, 3, coefficients, model)
    _check_pinhole(focal, center, len(coefficients))
    x, y, z = points.unbind(-1)
    x_d, y_d, valid = image_of(x, y, z, *lens)
    pixels = torch.stack([x_d, y_d], dim=-1) * focal[:, None] + center[:, None]
    return PointResult(pixels, valid & finite, torch.zeros_like(x_d))


def unproject(pixels: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> PointResult:
    """Return the rays of unit length that cameras show at pixels, the inverse of `project`.

    Args:
        pixels: (B, N, 2), px; float32 or float64.
        coefficients, focal, center, model: as for `project`.

    Returns:
        Rays (B, N, 3), x right, y down, z forward.

    Raises: as for `project`.
    """
    pixels, finite, lens = _check_points("pixels", pixels, 2, coefficients, model)
    _check_pinhole(focal, center, len(coefficients))
    points = (pixels - center[:, None]) / focal[:, None]
    x_d, y_d = points.unbind(-1)
    ray, valid = ray_of(x_d, y_d, *lens)
    valid = valid & finite
    rays = torch.stack([torch.where(valid, a, axis) for a, axis in zip(ray, (0.0, 0.0, 1.0), strict=True)], dim=-1)
    residual = _residual(rays.unbind(-1), points, lens, focal[:, None])
    return PointResult(rays / rays.square().sum(dim=-1, keepdim=True).sqrt(), valid, residual)


def valid_radius(coefficients: Tensor, *, model: str) -> Tensor:
    """Return the radius up to which the radial part of lenses is one-to-one, the first root of its growth.

    Args and Raises are as for `distort`. Returns (B,), float64, on the plane z = 1 before distortion, inf if the lens
    never folds; for a fisheye the angle in rad, at most pi.
    """
    _check_coefficients(coefficients, model)
    return _exact_radius(coefficients, model)


def columns(coefficients: Tensor, model: str) -> tuple[Tensor, ...]:
    """Return the coefficients (B, n) as n tensors (B, 1); those of OpenCV's model are padded to 14 with zeros."""
    if model == "opencv":
        zeros = coefficients.new_zeros(len(coefficients), len(OPENCV14) - coefficients.shape[1])
        coefficients = torch.cat([coefficients, zeros], dim=1)
    return coefficients[..., None].unbind(1)


def radius_within(coefficients: Tensor, reach: Tensor, model: str) -> Tensor:
    """Return the radius up to which lenses are one-to-one, searched on a lattice of radii up to `reach`, both (B,).

    Other than `valid_radius` it needs no eigenvalues, which would wait for a device. `reach` is on the plane z = 1; a
    fisheye is searched up to pi. The result has no gradient.
    """
    if model == "division":
        return reach
    with torch.no_grad():
        c = columns(coefficients.detach(), model)
        if model == "fisheye":
            positive, reach = [growth(c)], torch.full_like(reach, math.pi)
        else:
            lens = RationalLens.of(c, model)
            positive = [growth(lens.numerator, lens.denominator), lens.denominator]  # a pole ends it as well
        return first_fall(lambda r: torch.stack([radial_factor(r * r, k) for k in positive]).amin(dim=0) <= 0, reach)


def image_of(
    x: Tensor, y: Tensor, z: Tensor, c: Sequence[Tensor], model: str, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Project rays (x, y, z) of any length to x_d, y_d, in focal lengths; return 0 where the last, valid, is False."""
    if model == "fisheye":
        return fisheye_image(x, y, z, c, radius)
    with torch.no_grad():
        in_front = (z > 0) & (torch.maximum(x.abs(), y.abs()) < _MAX_RADIUS * z)
    x, y = (torch.where(in_front, a, 0.0) / torch.where(in_front, z, 1.0) for a in (x, y))
    if model == "division":
        x_d, y_d, exists = distort_division(x, y, c[0])
        return x_d, y_d, exists & in_front
    with torch.no_grad():
        valid = RationalLens.of([value.detach() for value in c], model).is_before_fold(x, y, radius) & in_front
    x_d, y_d = RationalLens.of(c, model).distort(torch.where(valid, x, 0.0), torch.where(valid, y, 0.0))[0]
    return torch.where(valid, x_d, 0.0), torch.where(valid, y_d, 0.0), valid


def ray_of(
    x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str, radius: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return the rays, of any length, that lenses show at points in focal lengths, and their validity (B, N)."""
    if model == "fisheye":
        return fisheye_ray(x_d, y_d, c, radius)
    if model == "division":
        x, y, exists = undistort_division(x_d, y_d, c[0])
        return (x, y, torch.ones_like(x)), exists
    with torch.no_grad():
        fixed = RationalLens.of([value.detach() for value in c], model)
        x, y, exists = fixed.undistort(x_d.detach(), y_d.detach(), radius)
        x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
    x, y = implicit((x, y), (x_d, y_d, *c), partial(_distortion_error, model=model))
    return (x, y, torch.ones_like(x)), exists


def _distortion_error(x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, *c: Tensor, model: str) -> tuple[Point, Jacobian]:
    (back_x, back_y), jacobian = RationalLens.of(c, model).distort(x, y)
    return (back_x - x_d, back_y - y_d), jacobian


def on_plane(ray: tuple[Tensor, Tensor, Tensor], valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x and y where valid rays meet the plane z = 1, and the validity of rays that do."""
    valid = valid & (ray[2] > 1 / _MAX_RADIUS)
    x, y = (torch.where(valid, a, 0.0) / torch.where(valid, ray[2], 1.0) for a in ray[:2])
    return x, y, valid


def image_of_rays(x: Tensor, y: Tensor, z: Tensor, coefficients: Tensor, model: str) -> tuple[Tensor, Tensor]:
    """Evaluate x_d and y_d by a model's formula for rays (B, N) with z > 0, also beyond the fold, to fit models by."""
    c = columns(coefficients, model)
    if model == "fisheye":
        return fisheye_image(x, y, z, c, fisheye_angle(coefficients).to(coefficients.dtype))[:2]
    if model == "division":
        return distort_division(x / z, y / z, c[0])[:2]
    return RationalLens.of(c, model).distort(x / z, y / z)[0]


def _exact_radius(coefficients: Tensor, model: str) -> Tensor:
    c = coefficients.detach()
    if model == "fisheye":
        return fisheye_angle(c)
    if model == "division":
        return first_root(-4 * c.double()).sqrt()
    return RationalLens.of(columns(c, model), model).radius()


def _check_coefficients(coefficients: Tensor, model: str) -> None:
    check_choice("model", model, tuple(MODELS))
    check_tensor("coefficients", coefficients)
    if coefficients.ndim != 2 or coefficients.shape[1] not in MODELS[model]:
        counts = " or ".join(map(str, MODELS[model]))
        raise ValueError(
            f"coefficients must have shape (B, {counts}) for the model {model}, got {tuple(coefficients.shape)}"
        )
    check_values("coefficients", "be finite", coefficients, torch.isfinite)


def _check_points(
    name: str, points: Tensor, size: int, coefficients: Tensor, model: str
) -> tuple[Tensor, Tensor, tuple[tuple[Tensor, ...], str, Tensor]]:
    """Return finite points, where they were finite before, and the last three arguments of `image_of`."""
    _check_coefficients(coefficients, model)
    check_tensor(name, points)
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64, got {points.dtype}")
    if points.ndim != 3 or points.shape[0] != coefficients.shape[0] or points.shape[2] != size:
        raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, N, {size}), got {tuple(points.shape)}")
    finite = points.isfinite().all(dim=-1)
    lens = columns(coefficients, model), model, _exact_radius(coefficients, model).to(coefficients.dtype)
    return torch.where(finite[..., None], points, 0.0), finite, lens


def _check_pinhole(focal: Tensor, center: Tensor, batch: int) -> None:
    for name, value in (("focal", focal), ("center", center)):
        if check_tensor(name, value).shape != (batch, 2):
            raise ValueError(f"{name} must have shape ({batch}, 2), got {tuple(value.shape)}")
    check_values("focal", "be positive and finite", focal, lambda v: (v > 0) & v.isfinite())
    check_values("center", "be finite", center, torch.isfinite)


def _residual(ray: Sequence[Tensor], points: Tensor, lens: tuple[Any, str, Tensor], scale: Any = 1.0) -> Tensor:
    """Return (B, N), the distance between projected rays and points (B, N, 2) in focal lengths, times `scale`."""
    with torch.no_grad():
        x, y, z = ray
        x_d, y_d, _ = image_of(x, y, z, *lens)
        error = torch.stack([x_d, y_d], dim=-1) - points
        return (error * scale).detach().square().sum(dim=-1).sqrt()
