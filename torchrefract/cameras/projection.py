"""Points and rays through the lenses of a batch of cameras, differentiable, each with what it is worth.

All functions take one camera a row and check shapes; `Camera` has the same as methods, for one camera.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_tensor, check_values
from torchrefract.cameras.division import distort_division
from torchrefract.cameras.fisheye import fisheye_image
from torchrefract.cameras.sheet import MODELS, columns, exact_radius, formula, image_of, on_plane, ray_of


class PointResult(NamedTuple):
    """Where points or rays go.

    points: (B, N, 2), or of rays (B, N, 3); where `valid` is false the center, or the axis, and without gradient.
    valid: (B, N), bool: the model has an answer there, on the sheet that holds the center.
    residual: (B, N), by how much the answer misses when it is put into the model; zero in closed form. In px for
        pixels, else on the plane z = 1.
    """

    points: Tensor
    valid: Tensor
    residual: Tensor


def distort(points: Tensor, coefficients: Tensor, *, model: str) -> PointResult:
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
    c, radius = columns(coefficients, model), _radius(coefficients, model)
    x_d, y_d, valid = image_of(x, y, torch.ones_like(x), c, model, radius)
    return PointResult(torch.stack([x_d, y_d], dim=-1), valid & finite, torch.zeros_like(x_d))


def undistort(points: Tensor, coefficients: Tensor, *, model: str) -> PointResult:
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
    c, radius = columns(coefficients, model), _radius(coefficients, model)
    ray, valid = ray_of(points[..., 0], points[..., 1], c, model, radius)
    x, y, valid = on_plane(ray, valid & finite)
    return PointResult(
        torch.stack([x, y], dim=-1), valid, _missed((x, y, torch.ones_like(x)), points, c, model, radius)
    )


def project(points: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> PointResult:
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
    x_d, y_d, valid = image_of(x, y, z, columns(coefficients, model), model, _radius(coefficients, model))
    pixels = torch.stack([x_d, y_d], dim=-1) * focal[:, None] + center[:, None]
    return PointResult(pixels, valid & finite, torch.zeros_like(x_d))


def unproject(pixels: Tensor, coefficients: Tensor, *, focal: Tensor, center: Tensor, model: str) -> PointResult:
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
    c, radius = columns(coefficients, model), _radius(coefficients, model)
    points = (pixels - center[:, None]) / focal[:, None]
    ray, valid = ray_of(points[..., 0], points[..., 1], c, model, radius)
    valid = valid & finite
    rays = torch.stack([torch.where(valid, a, axis) for a, axis in zip(ray, (0.0, 0.0, 1.0), strict=True)], dim=-1)
    missed = _missed(rays.unbind(-1), points, c, model, radius, scale=focal)
    return PointResult(rays / rays.square().sum(dim=-1, keepdim=True).sqrt(), valid, missed)


def valid_radius(coefficients: Tensor, *, model: str) -> Tensor:
    """How far from its center a lens is one-to-one, by its radial part: up to the first root of its growth.

    Args:
        coefficients, model: as for `distort`.

    Returns:
        (B,), on the plane z = 1, before distortion, inf if there is no end; for a fisheye the angle, rad, pi at most.
    """
    check_coefficients(coefficients, model)
    return exact_radius(coefficients, model)


def image_of_rays(x: Tensor, y: Tensor, z: Tensor, coefficients: Tensor, model: str) -> tuple[Tensor, Tensor]:
    """Where a model's formula puts rays (B, N), z above zero, on whichever sheet: unchecked, to fit models by."""
    c = columns(coefficients, model)
    if model == "fisheye":
        return fisheye_image(x, y, z, c, _radius(coefficients, model))[:2]
    if model == "division":
        return distort_division(x / z, y / z, c[0])[:2]
    return formula(x / z, y / z, c, model)[:2]


def check_coefficients(coefficients: Tensor, model: str) -> None:
    """Raise unless these are coefficients (B, n) of the model."""
    check_choice("model", model, tuple(MODELS))
    check_tensor("coefficients", coefficients)
    if coefficients.ndim != 2 or coefficients.shape[1] not in MODELS[model]:
        counts = " or ".join(map(str, MODELS[model]))
        raise ValueError(
            f"coefficients must have shape (B, {counts}) for the model {model}, got {tuple(coefficients.shape)}"
        )
    check_values("coefficients", "be finite", coefficients, torch.isfinite)


def _check_pinhole(focal: Tensor, center: Tensor, coefficients: Tensor) -> None:
    for name, value in (("focal", focal), ("center", center)):
        if check_tensor(name, value).shape != (coefficients.shape[0], 2):
            raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, 2), got {tuple(value.shape)}")
    check_values("focal", "be positive and finite", focal, lambda v: (v > 0) & v.isfinite())
    check_values("center", "be finite", center, torch.isfinite)


def _clean(name: str, points: Tensor, size: int, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The points with numbers in place of NaN and infinity, and where they were numbers, (B, N)."""
    check_tensor(name, points)
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64, got {points.dtype}")
    if points.ndim != 3 or points.shape[0] != coefficients.shape[0] or points.shape[2] != size:
        raise ValueError(f"{name} must have shape ({coefficients.shape[0]}, N, {size}), got {tuple(points.shape)}")
    finite = points.isfinite().all(dim=-1)
    return torch.where(finite[..., None], points, 0.0), finite


def _radius(coefficients: Tensor, model: str) -> Tensor:
    """(B,), of the plane z = 1, in the type of the coefficients."""
    return exact_radius(coefficients, model).to(coefficients.dtype)


def _missed(
    ray: Sequence[Tensor],
    points: Tensor,
    c: Sequence[Tensor],
    model: str,
    radius: Tensor,
    scale: Tensor | None = None,
) -> Tensor:
    """(B, N), how far rays land from points (B, N, 2) in focal lengths."""
    with torch.no_grad():
        x, y, z = ray
        x_d, y_d, _ = image_of(x, y, z, c, model, radius)
        error = torch.stack([x_d, y_d], dim=-1) - points
        return (error if scale is None else error * scale[:, None]).square().sum(dim=-1).sqrt()
