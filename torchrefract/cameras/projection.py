"""Points and rays through the lenses of a batch of cameras, differentiable, with validity and residual.

`distort`, `undistort`, `project`, `unproject` and `valid_radius` are public and check shapes; `Camera` offers them as
methods for one camera. The functions below them choose the formula of the lens model; they take x and y, (B, N), and
the coefficients as `columns` returns them, and check nothing.

Every model is used from the center of the image up to the radius where it folds back. That radius is on the plane
z = 1 before distortion; for a fisheye it is an angle in rad.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_tensor, check_values
from torchrefract.cameras.brown_conrady import (
    POLYNOMIAL12,
    RADIAL,
    Jacobian,
    distort_with_jacobian,
    implicit,
    undistort_polynomial,
)
from torchrefract.cameras.fisheye import fisheye_angle, fisheye_image, fisheye_ray
from torchrefract.cameras.radial import (
    distort_division,
    first_fall,
    first_root,
    growth_of_polynomial,
    growth_of_ratio,
    limit_of_curve,
    radial_factor,
    reach_of,
    undistort_division,
)
from torchrefract.cameras.rational import (
    OPENCV14,
    OPENCV_COUNTS,
    distort_opencv,
    hits_sensor_front,
    opencv_radius,
    ratio,
    undistort_opencv,
)

# Names of the coefficients of each model, and how many of them a camera may have.
COEFFICIENTS = {
    "polynomial12": POLYNOMIAL12,
    "opencv": OPENCV14,
    "fisheye": ("k1", "k2", "k3", "k4"),
    "division": ("k",),
}
MODELS = {"polynomial12": (len(POLYNOMIAL12),), "opencv": OPENCV_COUNTS, "fisheye": (4,), "division": (1,)}
_MAX_RADIUS = 1e6  # on the plane z = 1; no lens shows points beyond it
_RESIDUALS = {torch.float32: 2e-6, torch.float64: 1e-12}  # of an inverted point, relative to 1 + r_d


class PointResult(NamedTuple):
    """Points or rays after a lens.

    points: (B, N, 2), or rays (B, N, 3). Where `valid` is false they are the center or the axis, without gradient.
    valid: (B, N), bool: the model has an answer before the lens folds back.
    residual: (B, N), the distance between the input and the answer put through the model; zero for closed forms.
        In px if the input is in px, otherwise in focal lengths.
    """

    points: Tensor
    valid: Tensor
    residual: Tensor


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
    check_coefficients(coefficients, model)
    points, finite = _check_points("points", points, 2, coefficients)
    x, y = points.unbind(-1)
    x_d, y_d, valid = image_of(x, y, torch.ones_like(x), *_lens(coefficients, model))
    return PointResult(torch.stack([x_d, y_d], dim=-1), valid & finite, torch.zeros_like(x_d))


def undistort(points: Tensor, coefficients: Tensor, *, model: str) -> PointResult:
    """Invert `distort`, with the gradient of the exact inverse by the implicit function theorem.

    Args:
        points: (B, N, 2), in focal lengths from the center of the image; float32 or float64.
        coefficients, model: as for `distort`.

    Returns:
        Points (B, N, 2) on the plane z = 1. Rays of a fisheye at 90 degrees or more to its axis are not valid: they do
        not meet the plane.

    Raises:
        ValueError, TypeError: as for `distort`.
    """
    check_coefficients(coefficients, model)
    points, finite = _check_points("points", points, 2, coefficients)
    lens = _lens(coefficients, model)
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

    Raises:
        ValueError, TypeError: as for `distort`; a focal length is not positive.
    """
    check_coefficients(coefficients, model)
    _check_pinhole(focal, center, coefficients)
    points, finite = _check_points("points", points, 3, coefficients)
    x, y, z = points.unbind(-1)
    x_d, y_d, valid = image_of(x, y, z, *_lens(coefficients, model))
    pixels = torch.stack([x_d, y_d], dim=-1) * focal[:, None] + center[:, None]
    return PointResult(pixels, valid & finite, torch.zeros_like(x_d))


def unproject(pixels: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> PointResult:
    """Return the rays of unit length that cameras show at pixels, the inverse of `project`.

    Args:
        pixels: (B, N, 2), px; float32 or float64.
        coefficients, focal, center, model: as for `project`.

    Returns:
        Rays (B, N, 3), x right, y down, z forward.

    Raises:
        ValueError, TypeError: as for `project`.
    """
    check_coefficients(coefficients, model)
    _check_pinhole(focal, center, coefficients)
    pixels, finite = _check_points("pixels", pixels, 2, coefficients)
    lens = _lens(coefficients, model)
    points = (pixels - center[:, None]) / focal[:, None]
    x_d, y_d = points.unbind(-1)
    ray, valid = ray_of(x_d, y_d, *lens)
    valid = valid & finite
    rays = torch.stack([torch.where(valid, a, axis) for a, axis in zip(ray, (0.0, 0.0, 1.0), strict=True)], dim=-1)
    residual = _residual(rays.unbind(-1), points, lens, focal[:, None])
    return PointResult(rays / rays.square().sum(dim=-1, keepdim=True).sqrt(), valid, residual)


def valid_radius(coefficients: Tensor, *, model: str) -> Tensor:
    """Return the radius up to which the radial part of lenses is one-to-one, the first root of its growth.

    Args:
        coefficients, model: as for `distort`.

    Returns:
        (B,), float64, on the plane z = 1 before distortion, inf if the lens never folds; for a fisheye the angle in
        rad, at most pi.
    """
    check_coefficients(coefficients, model)
    return _exact_radius(coefficients, model)


def check_coefficients(coefficients: Tensor, model: str) -> None:
    """Raise unless `coefficients` are (B, n), finite, with a number n that the model allows."""
    check_choice("model", model, tuple(MODELS))
    check_tensor("coefficients", coefficients)
    if coefficients.ndim != 2 or coefficients.shape[1] not in MODELS[model]:
        counts = " or ".join(map(str, MODELS[model]))
        raise ValueError(
            f"coefficients must have shape (B, {counts}) for the model {model}, got {tuple(coefficients.shape)}"
        )
    check_values("coefficients", "be finite", coefficients, torch.isfinite)


def columns(coefficients: Tensor, model: str) -> tuple[Tensor, ...]:
    """Return the coefficients (B, n) as n tensors (B, 1); those of OpenCV's model are padded to 14 with zeros."""
    return (_pad(coefficients) if model == "opencv" else coefficients)[..., None].unbind(1)


def radius_within(coefficients: Tensor, reach: Tensor, model: str) -> Tensor:
    """Return the radius up to which lenses are one-to-one, searched on a lattice of radii up to `reach`.

    Other than `valid_radius` it needs no eigenvalues, which would wait for a device.

    Args:
        coefficients: (B, n), of the model.
        reach: (B,), on the plane z = 1. A fisheye is searched up to pi.
        model: of the lens.

    Returns:
        (B,), without gradient.
    """
    with torch.no_grad():
        c = columns(coefficients.detach(), model)
        if model == "division":
            return reach
        if model == "opencv":  # a pole ends it as well
            positive = [growth_of_ratio(*ratio(c)), ratio(c)[1]]
        else:
            positive = [growth_of_polynomial(c[: len(RADIAL)])]
        end = torch.full_like(reach, math.pi) if model == "fisheye" else reach
        return first_fall(lambda r: torch.stack([radial_factor(r * r, k) for k in positive]).amin(dim=0) <= 0, end)[0]


def image_of(
    x: Tensor, y: Tensor, z: Tensor, c: Sequence[Tensor], model: str, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Project rays (x, y, z) of any length to the image.

    Returns:
        x_d, y_d: (B, N), in focal lengths; 0 where `valid` is false.
        valid: (B, N), bool.
    """
    if model == "fisheye":
        return fisheye_image(x, y, z, c, radius)
    with torch.no_grad():
        in_front = (z > 0) & (torch.maximum(x.abs(), y.abs()) < _MAX_RADIUS * z)
    x, y = (torch.where(in_front, a, 0.0) / torch.where(in_front, z, 1.0) for a in (x, y))
    if model == "division":
        x_d, y_d, exists = distort_division(x, y, c[0])
        return x_d, y_d, exists & in_front
    with torch.no_grad():
        valid = _is_before_fold(x, y, [value.detach() for value in c], model, radius) & in_front
    x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
    x_d, y_d, _ = formula(x, y, c, model)
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
        fixed = [value.detach() for value in c]
        x, y, exists = _solve(x_d.detach(), y_d.detach(), fixed, model, radius)
        x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
        jacobian = formula(x, y, fixed, model)[2]
    back_x, back_y, _ = formula(x, y, c, model)
    x, y = implicit((x, y), (back_x - x_d, back_y - y_d), jacobian)
    return (x, y, torch.ones_like(x)), exists


def on_plane(ray: tuple[Tensor, Tensor, Tensor], valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x and y where valid rays meet the plane z = 1, and the validity of rays that do."""
    valid = valid & (ray[2] > 1 / _MAX_RADIUS)
    x, y = (torch.where(valid, a, 0.0) / torch.where(valid, ray[2], 1.0) for a in ray[:2])
    return x, y, valid


def formula(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str) -> tuple[Tensor, Tensor, Jacobian]:
    """Evaluate "polynomial12" or "opencv" and its derivatives, also beyond the fold."""
    if model == "opencv":
        return distort_opencv(x, y, c)
    point, jacobian = distort_with_jacobian(x, y, torch.stack(tuple(c), dim=1))
    return *point, jacobian


def image_of_rays(x: Tensor, y: Tensor, z: Tensor, coefficients: Tensor, model: str) -> tuple[Tensor, Tensor]:
    """Evaluate a model's formula for rays (B, N) with z > 0, also beyond the fold, to fit models by.

    Returns x_d and y_d, (B, N), in focal lengths.
    """
    c = columns(coefficients, model)
    if model == "fisheye":
        return fisheye_image(x, y, z, c, fisheye_angle(coefficients).to(coefficients.dtype))[:2]
    if model == "division":
        return distort_division(x / z, y / z, c[0])[:2]
    return formula(x / z, y / z, c, model)[:2]


def _lens(coefficients: Tensor, model: str) -> tuple[tuple[Tensor, ...], str, Tensor]:
    """Return the last three arguments of `image_of` and `ray_of`."""
    return columns(coefficients, model), model, _exact_radius(coefficients, model).to(coefficients.dtype)


def _exact_radius(coefficients: Tensor, model: str) -> Tensor:
    c = coefficients.detach().double()
    if model == "polynomial12":
        return first_root(torch.stack(growth_of_polynomial(c[:, : len(RADIAL)].unbind(1)), dim=1)).sqrt()
    if model == "opencv":
        return opencv_radius(_pad(c))
    return fisheye_angle(c) if model == "fisheye" else first_root(-4 * c).sqrt()


def _pad(coefficients: Tensor) -> Tensor:
    zeros = coefficients.new_zeros(len(coefficients), len(OPENCV14) - coefficients.shape[1])
    return torch.cat([coefficients, zeros], dim=1)


def _is_before_fold(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str, radius: Tensor) -> Tensor:
    """Return (B, N), bool: points of the plane z = 1 that the lens does not show folded back."""
    valid = x * x + y * y <= radius[:, None].square()
    if model == "opencv":
        valid = valid & hits_sensor_front(x, y, c)
    return valid & (formula(x, y, c, model)[2].determinant > 0)


def _solve(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Invert "polynomial12" or "opencv": x, y and whether the point exists, (B, N) each."""
    r_d = (x_d * x_d + y_d * y_d).sqrt()
    if model == "polynomial12":
        k = c[: len(RADIAL)]
        limit = limit_of_curve(radius, reach_of(r_d), lambda r: r * radial_factor(r * r, k))
        return undistort_polynomial(x_d, y_d, torch.stack(tuple(c), dim=1), limit=limit)
    x, y = undistort_opencv(x_d, y_d, c, radius)
    back_x, back_y, _ = distort_opencv(x, y, c)
    residual = torch.maximum((back_x - x_d).abs(), (back_y - y_d).abs())
    return x, y, _is_before_fold(x, y, c, model, radius) & (residual <= _RESIDUALS[x.dtype] * (1 + r_d))


def _check_pinhole(focal: Tensor, center: Tensor, coefficients: Tensor) -> None:
    for name, value in (("focal", focal), ("center", center)):
        if check_tensor(name, value).shape != (coefficients.shape[0], 2):
            raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, 2), got {tuple(value.shape)}")
    check_values("focal", "be positive and finite", focal, lambda v: (v > 0) & v.isfinite())
    check_values("center", "be finite", center, torch.isfinite)


def _check_points(name: str, points: Tensor, size: int, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points with NaN and infinity replaced by 0, and (B, N), bool: the point was finite."""
    check_tensor(name, points)
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64, got {points.dtype}")
    if points.ndim != 3 or points.shape[0] != coefficients.shape[0] or points.shape[2] != size:
        raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, N, {size}), got {tuple(points.shape)}")
    finite = points.isfinite().all(dim=-1)
    return torch.where(finite[..., None], points, 0.0), finite


def _residual(ray: Sequence[Tensor], points: Tensor, lens: tuple[Any, str, Tensor], scale: Any = 1.0) -> Tensor:
    """Return (B, N), the distance between projected rays and points (B, N, 2) in focal lengths, times `scale`."""
    with torch.no_grad():
        x, y, z = ray
        x_d, y_d, _ = image_of(x, y, z, *lens)
        error = torch.stack([x_d, y_d], dim=-1) - points
        return (error * scale).square().sum(dim=-1).sqrt()
