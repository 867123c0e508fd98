"""Points and rays through the lenses of a batch of cameras, differentiable, each with what it is worth.

All functions take one camera a row and check shapes; `Camera` has the same as methods, for one camera.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._checks import check_all, check_choice, check_tensor
from torchrefract.cameras.distortion import (
    Jacobian,
    distort_polynomial,
    implicit,
    jacobian_polynomial,
    undistort_polynomial,
)
from torchrefract.cameras.division import distort_division, undistort_division
from torchrefract.cameras.fisheye import fisheye_angle, fisheye_image, fisheye_ray
from torchrefract.cameras.growth import first_root, growth_of_powers
from torchrefract.cameras.radial import limit_of_curve, radial, reach_of
from torchrefract.cameras.rational import (
    OPENCV_COUNTS,
    distort_opencv,
    in_front,
    opencv_radius,
    undistort_opencv,
)

# How many coefficients each model has.
MODELS = {"polynomial12": (12,), "opencv": OPENCV_COUNTS, "fisheye": (4,), "division": (1,)}
_FARTHEST = 1e6  # on the plane z = 1; no lens shows what lies beyond
_MISSES = {torch.float32: 2e-6, torch.float64: 1e-12}  # of a solved point, relative to 1 + r_d


class Mapped(NamedTuple):
    """Where points or rays go.

    points: (B, N, 2), or of rays (B, N, 3); where `valid` is false the center, or the axis, and without gradient.
    valid: (B, N), bool: the model has an answer there, on the sheet that holds the center.
    residual: (B, N), by how much the answer misses when it is put into the model; zero in closed form. In px for
        pixels, else on the plane z = 1.
    """

    points: Tensor
    valid: Tensor
    residual: Tensor


def distort(points: Tensor, coefficients: Tensor, *, model: str) -> Mapped:
    """The points of the plane z = 1 where a lens shows them.

    Args:
        points: (B, N, 2), on the plane z = 1; float32 or float64.
        coefficients: (B, n), of the model.
        model: "polynomial12", "opencv", "fisheye" or "division".

    Returns:
        (B, N, 2), on the plane z = 1, in focal lengths: pixels are f times that, plus c.
    """
    check_coefficients(coefficients, model)
    points, finite = _clean("points", points, 2, coefficients)
    x, y = points[..., 0], points[..., 1]
    x_d, y_d, valid = _image(x, y, torch.ones_like(x), _columns(coefficients, model), model)
    return Mapped(torch.stack([x_d, y_d], dim=-1), valid & finite, torch.zeros_like(x_d))


def undistort(points: Tensor, coefficients: Tensor, *, model: str) -> Mapped:
    """The points of the plane z = 1 that a lens shows at other points: the inverse of `distort`.

    Gradients are those of the exact inverse, by the implicit function theorem. A ray at 90 degrees or more to the axis
    of a fisheye meets no such plane, and is not valid here.

    Args:
        points: (B, N, 2), in focal lengths from the center of the image.
        coefficients, model: as for `distort`.

    Returns:
        (B, N, 2), on the plane z = 1.
    """
    check_coefficients(coefficients, model)
    points, finite = _clean("points", points, 2, coefficients)
    c = _columns(coefficients, model)
    ray, valid = _ray(points[..., 0], points[..., 1], c, model)
    valid = valid & finite & (ray[2] > 1 / _FARTHEST)
    x, y = (torch.where(valid, a, 0.0) / torch.where(valid, ray[2], 1.0) for a in ray[:2])
    return Mapped(torch.stack([x, y], dim=-1), valid, _missed(x, y, torch.ones_like(x), points, c, model))


def project(points: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> Mapped:
    """The pixels where cameras show points in space; they may lie outside the frame.

        (u, v) = focal distort(x / z, y / z) + center;  for a fisheye the angle to the axis goes up to pi

    Args:
        points: (B, N, 3), x right, y down, z forward, in any unit.
        coefficients, model: as for `distort`.
        focal, center: (B, 2), px.

    Returns:
        (B, N, 2), px, pixel centers being whole numbers.
    """
    check_coefficients(coefficients, model)
    _check_pinhole(focal, center, coefficients)
    points, finite = _clean("points", points, 3, coefficients)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    x_d, y_d, valid = _image(x, y, z, _columns(coefficients, model), model)
    pixels = torch.stack([x_d, y_d], dim=-1) * focal[:, None] + center[:, None]
    return Mapped(pixels, valid & finite, torch.zeros_like(x_d))


def unproject(pixels: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> Mapped:
    """The rays of unit length that cameras see at pixels: the inverse of `project`.

    Args:
        pixels: (B, N, 2), px.
        coefficients, focal, center, model: as for `project`.

    Returns:
        (B, N, 3), x right, y down, z forward.
    """
    check_coefficients(coefficients, model)
    _check_pinhole(focal, center, coefficients)
    pixels, finite = _clean("pixels", pixels, 2, coefficients)
    c, points = _columns(coefficients, model), (pixels - center[:, None]) / focal[:, None]
    ray, valid = _ray(points[..., 0], points[..., 1], c, model)
    valid = valid & finite
    rays = torch.stack([torch.where(valid, a, axis) for a, axis in zip(ray, (0.0, 0.0, 1.0), strict=True)], dim=-1)
    missed = _missed(rays[..., 0], rays[..., 1], rays[..., 2], points, c, model, scale=focal)
    return Mapped(rays / rays.square().sum(dim=-1, keepdim=True).sqrt(), valid, missed)


def valid_radius(coefficients: Tensor, *, model: str) -> Tensor:
    """How far from its center a lens is one-to-one, by its radial part: up to the first root of its growth.

    Args:
        coefficients, model: as for `distort`.

    Returns:
        (B,), on the plane z = 1, before distortion, inf if there is no end; for a fisheye the angle, rad, pi at most.
    """
    check_coefficients(coefficients, model)
    c = coefficients.detach().double()
    if model == "polynomial12":
        return first_root(torch.stack(growth_of_powers(c[:, :6].unbind(1)), dim=1)).sqrt()
    if model == "opencv":
        return opencv_radius(_padded(c))
    return fisheye_angle(c) if model == "fisheye" else first_root(-4 * c).sqrt()


def image_of_rays(x: Tensor, y: Tensor, z: Tensor, coefficients: Tensor, model: str) -> tuple[Tensor, Tensor]:
    """Where a model's formula puts rays (B, N), z above zero, on whichever sheet: unchecked, to fit models by."""
    c = _columns(coefficients, model)
    if model == "fisheye":
        return fisheye_image(x, y, z, c)[:2]
    if model == "division":
        return distort_division(x / z, y / z, c[0])[:2]
    return _model(x / z, y / z, c, model)[:2]


def check_coefficients(coefficients: Tensor, model: str) -> None:
    """Raise unless these are coefficients (B, n) of the model."""
    check_choice("model", model, tuple(MODELS))
    check_tensor("coefficients", coefficients)
    if coefficients.ndim != 2 or coefficients.shape[1] not in MODELS[model]:
        counts = " or ".join(map(str, MODELS[model]))
        raise ValueError(
            f"coefficients must have shape (B, {counts}) for the model {model}, got {tuple(coefficients.shape)}"
        )
    check_all("coefficients", "be finite", coefficients, torch.isfinite)


def _check_pinhole(focal: Tensor, center: Tensor, coefficients: Tensor) -> None:
    for name, value in (("focal", focal), ("center", center)):
        if check_tensor(name, value).shape != (coefficients.shape[0], 2):
            raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, 2), got {tuple(value.shape)}")
    check_all("focal", "be positive and finite", focal, lambda v: (v > 0) & v.isfinite())
    check_all("center", "be finite", center, torch.isfinite)


def _clean(name: str, points: Tensor, size: int, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The points with numbers in place of NaN and infinity, and where they were numbers, (B, N)."""
    check_tensor(name, points)
    if points.dtype not in _MISSES:
        raise TypeError(f"{name} must be float32 or float64, got {points.dtype}")
    if points.ndim != 3 or points.shape[0] != coefficients.shape[0] or points.shape[2] != size:
        raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, N, {size}), got {tuple(points.shape)}")
    finite = points.isfinite().all(dim=-1)
    return torch.where(finite[..., None], points, 0.0), finite


def _padded(coefficients: Tensor) -> Tensor:
    """Coefficients of OpenCV's as 14 of them."""
    return torch.cat([coefficients, coefficients.new_zeros(len(coefficients), 14 - coefficients.shape[1])], dim=1)


def _columns(coefficients: Tensor, model: str) -> tuple[Tensor, ...]:
    return (_padded(coefficients) if model == "opencv" else coefficients)[..., None].unbind(1)


def _image(x: Tensor, y: Tensor, z: Tensor, c: Sequence[Tensor], model: str) -> tuple[Tensor, Tensor, Tensor]:
    """Where a lens shows rays, in focal lengths from the center, and which of them it does."""
    if model == "fisheye":
        return fisheye_image(x, y, z, c)
    with torch.no_grad():
        seen = (z > 0) & (torch.maximum(x.abs(), y.abs()) < _FARTHEST * z)
    x, y = (torch.where(seen, a, 0.0) / torch.where(seen, z, 1.0) for a in (x, y))
    if model == "division":
        x_d, y_d, exists = distort_division(x, y, c[0])
        return x_d, y_d, exists & seen
    with torch.no_grad():
        upright = _upright(x, y, [value.detach() for value in c], model) & seen
    x, y = torch.where(upright, x, 0.0), torch.where(upright, y, 0.0)
    x_d, y_d, _ = _model(x, y, c, model)
    return torch.where(upright, x_d, 0.0), torch.where(upright, y_d, 0.0), upright


def _ray(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """The rays that a lens shows at places in focal lengths from the center, of any length, and which there are."""
    if model == "fisheye":
        return fisheye_ray(x_d, y_d, c)
    if model == "division":
        x, y, exists = undistort_division(x_d, y_d, c[0])
        return (x, y, torch.ones_like(x)), exists
    with torch.no_grad():
        still = [value.detach() for value in c]
        x, y, exists = _solved(x_d.detach(), y_d.detach(), still, model)
        x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
        jacobian = _model(x, y, still, model)[2]
    reached_x, reached_y, _ = _model(x, y, c, model)
    x, y = implicit((x, y), (reached_x - x_d, reached_y - y_d), jacobian)
    return (x, y, torch.ones_like(x)), exists


def _missed(
    x: Tensor, y: Tensor, z: Tensor, points: Tensor, c: Sequence[Tensor], model: str, scale: Tensor | None = None
) -> Tensor:
    """(B, N), how far rays land from points (B, N, 2) in focal lengths."""
    with torch.no_grad():
        x_d, y_d, _ = _image(x, y, z, c, model)
        error = torch.stack([x_d, y_d], dim=-1) - points
        return (error if scale is None else error * scale[:, None]).square().sum(dim=-1).sqrt()


def _model(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str) -> tuple[Tensor, Tensor, Jacobian]:
    if model == "opencv":
        return distort_opencv(x, y, c)
    stacked = torch.stack(tuple(c), dim=1)
    return *distort_polynomial(x, y, stacked), jacobian_polynomial(x, y, stacked)


def _radius(c: Sequence[Tensor], model: str) -> Tensor:
    """(B,), of the plane z = 1."""
    return valid_radius(torch.cat(tuple(c), dim=1), model=model).to(c[0].dtype)


def _upright(x: Tensor, y: Tensor, c: Sequence[Tensor], model: str) -> Tensor:
    """(B, N), bool: points of the plane z = 1 on the sheet that holds the center."""
    near = x * x + y * y <= _radius(c, model)[:, None].square()
    if model == "opencv":
        near = near & in_front(x, y, c)
    return near & (_model(x, y, c, model)[2].determinant > 0)


def _solved(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], model: str) -> tuple[Tensor, Tensor, Tensor]:
    """The points that a polynomial or a ratio maps to others, and which there are."""
    r_d, radius = (x_d * x_d + y_d * y_d).sqrt(), _radius(c, model)
    if model == "polynomial12":
        k = tuple(c[:6])
        limit = limit_of_curve(radius, reach_of(r_d), lambda r: r * radial(r * r, k, 6))
        return undistort_polynomial(x_d, y_d, torch.stack(tuple(c), dim=1), limit=limit)
    x, y = undistort_opencv(x_d, y_d, c, radius)
    reached_x, reached_y, _ = distort_opencv(x, y, c)
    missed = torch.maximum((reached_x - x_d).abs(), (reached_y - y_d).abs())
    return x, y, _upright(x, y, c, model) & (missed <= _MISSES[x.dtype] * (1 + r_d))
