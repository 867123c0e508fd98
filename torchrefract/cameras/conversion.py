"""A camera in another lens model, fitted by least squares, with what the fit leaves."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_number
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.projection import image_of_rays
from torchrefract.cameras.sheet import MODELS

# Places along each side of the frame at which a model is fitted, and others at which it is measured.
_FITTED, _MEASURED = 41, 129
_MOST_STEPS = 60
_SETTLED = 1e-9  # a step that lowers the squares by no larger a share is the last
_WEAKEST, _STRONGEST = 1e-15, 1e9  # damping
_COUNTS = {"polynomial12": 12, "opencv": 8, "fisheye": 4, "division": 1}


class Conversion(NamedTuple):
    """A camera in another model, and how far it is from the one it was made of.

    camera: with the pinhole of the other one.
    max_px, rms_px: how far apart both show the same rays, px, over the part of the frame that is covered.
    covered: the share of the frame whose rays both cameras show, within the angle that was asked for.
    """

    camera: Camera
    max_px: float
    rms_px: float
    covered: float


def convert(camera: Camera, *, to: str, count: int | None = None, most_angle_deg: float = 80.0) -> Conversion:
    """The camera of another model that shows the rays of a frame where this one shows them, as nearly as it can.

        coefficients = argmin sum |project(ray(p)) - p|^2  over places p of the frame, ray = camera.unproject

    Levenberg and Marquardt's method in float64; the pinhole stays. A polynomial in the radius on the plane z = 1 holds
    a fisheye up to about 55 degrees from the axis, a ratio up to about 80: read `max_px` before using what comes out.

    Args:
        camera: to be converted.
        to: "polynomial12", "opencv", "fisheye" or "division".
        count: of the coefficients, where the model has several; None is 8 for "opencv".
        most_angle_deg: rays farther from the axis are left out; below 90.

    Raises:
        ValueError: arguments out of range; a camera whose frame shows no ray within the angle.
    """
    check_choice("to", to, tuple(MODELS))
    count = _COUNTS[to] if count is None else count
    if count not in MODELS[to]:
        raise ValueError(f"count must be {' or '.join(map(str, MODELS[to]))} for the model {to}, got {count}")
    least_z = math.cos(math.radians(check_number("most_angle_deg", most_angle_deg, low=1.0, high=89.9)))
    exact = _exact(camera, to, count)
    if exact is None:
        exact = replace(camera, model=to, coefficients=_fitted(camera, to, count, least_z))
    return _measured(camera, exact, least_z)


def _exact(camera: Camera, to: str, count: int) -> Camera | None:
    """The camera itself, or its coefficients in another order, where that is all there is to do."""
    if to == camera.model:
        return camera if count == len(camera.coefficients) else None
    plain = to == "polynomial12" and camera.is_polynomial
    return replace(camera, model=to, coefficients=camera.polynomial()) if plain else None


def _fitted(camera: Camera, to: str, count: int, least_z: float) -> tuple[float, ...]:
    pixels, rays, seen = _rays(camera, _FITTED, least_z)
    if not seen.any():
        raise ValueError(f"camera must show rays nearer to its axis than most_angle_deg, got {camera}")
    _, focal, center = camera.tensors(pixels)
    x, y, z = rays[seen, :, None].unbind(1)
    goal = pixels[seen]

    def error(coefficients: Tensor) -> Tensor:
        seen_at = torch.cat(image_of_rays(x, y, z, coefficients, to), dim=1)
        return seen_at * focal + center - goal

    return tuple(least_squares(error, torch.zeros(count, dtype=torch.float64), rows=len(goal)).tolist())


def least_squares(error: Callable[[Tensor], Tensor], start: Tensor, *, rows: int) -> Tensor:
    """The parameters at which the squares of a function's values are least, by Levenberg and Marquardt's method.

    Each step solves (J^T J + damping diag(J^T J)) step = -J^T error, as a least-squares problem of its own.

    Args:
        error: from a copy of the parameters for each row, (rows, n), to values (rows, k), each row by its copy alone.
        start: (n,), float64.
        rows: so many.

    Source: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. 11 (1963).
    """
    found, damping = start, 1e-3
    value, jacobian = _linearized(error, found, rows)
    for _ in range(_MOST_STEPS):
        before = value.square().sum()
        while damping < _STRONGEST:
            tried = found + _step(jacobian, value, damping)
            # A step past a pole gives no number, and is none.
            if error(tried.expand(rows, -1)).square().sum() < before:
                break
            damping *= 10
        else:
            return found
        found, damping = tried, max(damping / 10, _WEAKEST)
        value, jacobian = _linearized(error, found, rows)
        if before - value.square().sum() <= _SETTLED * before:
            return found
    return found


def _linearized(error: Callable[[Tensor], Tensor], found: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """The values, (rows k,), and their derivatives, (rows k, n): a backward pass for each of the k columns."""
    with torch.enable_grad():
        copies = found.detach().expand(rows, -1).clone().requires_grad_()
        columns = error(copies).unbind(1)
        slopes = [torch.autograd.grad(column.sum(), copies, retain_graph=True)[0] for column in columns]
    return torch.cat(columns).detach(), torch.cat(slopes)


def _step(jacobian: Tensor, value: Tensor, damping: float) -> Tensor:
    # Columns of one length: radii to the power of 13 and of 3 stand side by side.
    scale = jacobian.square().sum(dim=0).sqrt().clamp(min=1e-12)
    damped = math.sqrt(damping) * torch.eye(len(scale), dtype=scale.dtype)
    right = torch.cat([-value, value.new_zeros(len(scale))])
    step = torch.linalg.lstsq(torch.cat([jacobian / scale, damped]), right[:, None], driver="gelsd").solution
    return step[:, 0] / scale


def _measured(camera: Camera, made: Camera, least_z: float) -> Conversion:
    pixels, rays, seen = _rays(camera, _MEASURED, least_z)
    shown = made.project(rays)
    seen = seen & shown.valid
    if not seen.any():
        return Conversion(made, math.inf, math.inf, 0.0)
    missed = (shown.points - pixels)[seen].norm(dim=1)
    rms = missed.square().mean().sqrt().item()
    return Conversion(made, missed.max().item(), rms, seen.double().mean().item())


def _rays(camera: Camera, places: int, least_z: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, 2) all over the frame, their rays (N, 3), and which of them there are within the angle."""
    pixels = camera.places(places)
    rays, valid, _ = camera.unproject(pixels)
    return pixels, rays, valid & (rays[:, 2] >= least_z)
