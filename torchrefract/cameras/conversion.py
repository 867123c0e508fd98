"""Conversion of a camera to another lens model, fitted by least squares, with the error that remains."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_number
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.projection import MODELS, image_of_rays

_FIT_GRID, _TEST_GRID = 41, 129  # points along each side of the frame for the fit, and for its error
_MAX_STEPS = 60
_CONVERGED = 1e-9  # relative decrease of the sum of squares at which the fit stops
_MIN_DAMPING, _MAX_DAMPING = 1e-15, 1e9
_DEFAULT_COUNTS = {"polynomial12": 12, "opencv": 8, "fisheye": 4, "division": 1}


class Conversion(NamedTuple):
    """A converted camera and its distance from the original."""

    camera: Camera  # with the pinhole of the original
    max_px: float  # distance between the pixels where both show the same ray, over the covered part of the frame
    rms_px: float  # of the same distances
    covered: float  # share of the frame whose rays lie within `most_angle_deg` and are shown by both cameras


def convert(camera: Camera, *, to: str, count: int | None = None, most_angle_deg: float = 80.0) -> Conversion:
    """Fit the coefficients of another model to a camera.

        coefficients = argmin sum |project(ray(p)) - p|^2  over pixels p of the frame, ray = camera.unproject

    The pinhole stays. "polynomial12" represents a fisheye up to about 55 degrees from the axis, "opencv" up to
    about 80. Read `max_px` before you use the result.

    Args:
        camera: to convert.
        to: "polynomial12", "opencv", "fisheye" or "division".
        count: number of coefficients if `to` allows several; None is 8 for "opencv".
        most_angle_deg: rays farther from the axis are ignored; in [1, 89.9].

    Raises:
        ValueError: an argument is out of range, or no ray of the frame lies within `most_angle_deg`.
    """
    check_choice("to", to, tuple(MODELS))
    count = _DEFAULT_COUNTS[to] if count is None else count
    if count not in MODELS[to]:
        raise ValueError(f"count must be {' or '.join(map(str, MODELS[to]))} for the model {to}, got {count}")
    min_z = math.cos(math.radians(check_number("most_angle_deg", most_angle_deg, low=1.0, high=89.9)))
    if to == camera.model and count == len(camera.coefficients):
        converted = camera
    elif to == "polynomial12" and camera.is_polynomial:
        converted = replace(camera, model=to, coefficients=camera.polynomial())
    else:
        converted = replace(camera, model=to, coefficients=_fit(camera, to, count, min_z))
    return _measure(camera, converted, min_z)


def _fit(camera: Camera, to: str, count: int, min_z: float) -> tuple[float, ...]:
    pixels, rays, valid = _rays(camera, _FIT_GRID, min_z)
    if not valid.any():
        raise ValueError(f"camera must show rays nearer to its axis than most_angle_deg, got {camera}")
    _, focal, center = camera.tensors(pixels)
    x, y, z = rays[valid, :, None].unbind(1)
    target = pixels[valid]

    def error(coefficients: Tensor) -> Tensor:
        points = torch.cat(image_of_rays(x, y, z, coefficients, to), dim=1)
        return points * focal + center - target

    start = torch.zeros(count, dtype=torch.float64, device="cpu")
    return tuple(least_squares(lambda c: _linearize(error, c, len(target)), start).tolist())


def least_squares(function: Callable[[Tensor], tuple[Tensor, Tensor]], start: Tensor) -> Tensor:
    """Minimize a sum of squares by the Levenberg-Marquardt method, from parameters (n,), float64.

    Each step solves (J^T J + damping diag(J^T J)) step = -J^T values as a linear least-squares problem. The function
    maps parameters to values (m,) and their derivatives J (m, n).

    Source: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. 11 (1963).
    """
    parameters, damping = start, 1e-3
    values, jacobian = function(start)
    for _ in range(_MAX_STEPS):
        before = values.square().sum()
        while damping < _MAX_DAMPING:
            candidate = parameters + _step(jacobian, values, damping)
            new_values, new_jacobian = function(candidate)
            # A step past a pole gives NaN, which compares as false.
            if new_values.square().sum() < before:
                break
            damping *= 10
        else:
            return parameters
        parameters, damping = candidate, max(damping / 10, _MIN_DAMPING)
        values, jacobian = new_values, new_jacobian
        if before - values.square().sum() <= _CONVERGED * before:
            break
    return parameters


def _linearize(error: Callable[[Tensor], Tensor], parameters: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Return the values (rows k,) of a function and their derivatives (rows k, n), by k backward passes.

    `error` maps parameters (rows, n), one copy for each row, to values (rows, k); row i depends on copy i only.
    """
    with torch.enable_grad():
        copies = parameters.detach().expand(rows, -1).clone().requires_grad_()
        columns = error(copies).unbind(1)
        slopes = [torch.autograd.grad(column.sum(), copies, retain_graph=True)[0] for column in columns]
    return torch.cat(columns).detach(), torch.cat(slopes)


def _step(jacobian: Tensor, values: Tensor, damping: float) -> Tensor:
    # Columns hold r^3 up to r^13: scaled to equal length, so that the problem is well conditioned.
    scale = jacobian.square().sum(dim=0).sqrt().clamp(min=1e-12)
    damped = math.sqrt(damping) * torch.eye(len(scale), dtype=scale.dtype, device=scale.device)
    right = torch.cat([-values, values.new_zeros(len(scale))])
    step = torch.linalg.lstsq(torch.cat([jacobian / scale, damped]), right[:, None], driver="gelsd").solution
    return step[:, 0] / scale


def _measure(camera: Camera, converted: Camera, min_z: float) -> Conversion:
    pixels, rays, valid = _rays(camera, _TEST_GRID, min_z)
    projected = converted.project(rays)
    valid = valid & projected.valid
    if not valid.any():
        return Conversion(converted, math.inf, math.inf, 0.0)
    distance = (projected.points - pixels)[valid].norm(dim=1)
    rms = distance.square().mean().sqrt().item()
    return Conversion(converted, distance.max().item(), rms, valid.double().mean().item())


def _rays(camera: Camera, count: int, min_z: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels (N, 2) on a grid over the frame, their rays (N, 3), and which of them lie within the angle."""
    pixels = camera.grid(count)
    rays, valid, _ = camera.unproject(pixels)
    return pixels, rays, valid & (rays[:, 2] >= min_z)
