"""Thin-plate splines: the smoothest flow that moves given points as told."""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import kernels
from torchrefract._threads import share
from torchrefract._validation import check_values, eager_bool, requires_grad, why_not_eager
from torchrefract.fields.linear import solve
from torchrefract.warping.grid import pixel_axes

# Control points nearer than this share of their extent count as one.
_NEAREST = 1e-6
# A set flatter than this ratio of its two extents counts as a line.
_FLATTEST = 1e-5
_UNIT = 2  # of the coordinates, in root mean square distances from the center
_NOTHING = 1e-300
_FEW_POINTS = 1 << 12  # numbers of all samples, whose system is kept
_SMALLEST = 1 << 10  # places, from which on a kernel is faster
_CACHED = 1 << 15  # numbers of eight bytes, a few times over, that stay in a core's cache


class Spline(NamedTuple):
    """The coefficients of one spline for each sample, in float64 and in coordinates with `center` 0 and `scale` 1."""

    points: Tensor  # (B, N, 2)
    weights: Tensor  # (B, N, 2), of the kernels, px
    affine: Tensor  # (B, 3, 2), of 1, x and y, px
    center: Tensor  # (B, 1, 2), px
    scale: Tensor  # (B, 1, 1), px


def fit_spline(points: Tensor, displacement: Tensor, smoothing: Tensor, *, checked: bool = False) -> Spline:
    """The thin-plate spline with f(p_i) = d_i at the control points, or near them where it is smoothed.

        f(p) = a1 + a2 x + a3 y + sum w_i U(|p - p_i|),  U(r) = r^2 ln r,  sum w = sum w x = sum w y = 0

    The system (K + smoothing I) w + P a = d, P' w = 0 is solved in float64. The smoothing is in units of the root mean
    square distance of the points from their center; the coordinates are in units of twice that, where the kernels
    between most points, and with them what rounds, are smallest.

    Args:
        points: (B, N, 2), px, x and y, N at least 3, not all on a line, no two the same.
        displacement: (B, N, 2), px, of each point.
        smoothing: (B,), 0 or above; 0 interpolates.
        checked: the points are known to be such.

    Raises:
        ValueError: too few points, points on a line, two that are the same; where reading them costs nothing.

    Source: Bookstein, "Principal warps", IEEE TPAMI 11 (1989).
    """
    if not checked:
        check_points(points)
    points, displacement, smoothing = points.double(), displacement.double(), smoothing.double()
    unit, center, scale, system = _system_of(points, smoothing)
    count = unit.shape[1]
    right = torch.cat([displacement, displacement.new_zeros(unit.shape[0], 3, 2)], dim=1)
    solution = solve(system, right)
    return Spline(unit, solution[:, :count], solution[:, count:], center, scale)


_System = tuple[Tensor, Tensor, Tensor, Tensor]


def _system_of(points: Tensor, smoothing: Tensor) -> _System:
    """The points in their own units, center and scale, and the system of all that go there, (B, N + 3, N + 3)."""
    values = points, smoothing
    if points.numel() > _FEW_POINTS or requires_grad(values) or any(map(why_not_eager, values)):
        return _made_system(points, smoothing)
    # Drawn plates have the same points in every frame.
    return _kept_system(tuple(points.shape), *(value.numpy().tobytes() for value in values))


@lru_cache(maxsize=16)
def _kept_system(shape: tuple[int, ...], points: bytes, smoothing: bytes) -> _System:
    # Tensors made in inference mode could not be used outside of it.
    with torch.inference_mode(False), torch.no_grad():
        at, weight = (torch.from_numpy(np.frombuffer(own).copy()) for own in (points, smoothing))
        return _made_system(at.view(shape), weight)


def _made_system(points: Tensor, smoothing: Tensor) -> _System:
    center = points.mean(dim=1, keepdim=True)
    scale = (points - center).square().sum(dim=2).mean(dim=1)[:, None, None].clamp(min=1e-24).sqrt()
    # The choice of coordinates moves nothing but the smoothing, which is measured in them.
    smoothing = smoothing[:, None, None] * (scale / scale.detach()).square() / _UNIT**2
    center, scale = center.detach(), _UNIT * scale.detach()
    unit = (points - center) / scale
    x, y = unit.unbind(2)
    kernel = _kernel(_square(x[:, None] - x[:, :, None], y[:, None] - y[:, :, None])) / 2
    kernel = kernel + smoothing * torch.eye(unit.shape[1], dtype=unit.dtype, device=unit.device)
    plane = torch.cat([torch.ones_like(unit[..., :1]), unit], dim=2)
    corner = unit.new_zeros(unit.shape[0], 3, 3)
    system = torch.cat([torch.cat([kernel, plane], dim=2), torch.cat([plane.mT, corner], dim=2)], dim=1)
    return unit, center, scale, system


def spline_flow(spline: Spline, *, height: int, width: int, dtype: torch.dtype) -> Tensor:
    """The flow (B, 2, H, W) in px that a spline has at each pixel, computed in float64."""
    return spline_at(spline, *pixel_axes(height, width, dtype=torch.float64, device=spline.points.device), dtype=dtype)


def spline_at(spline: Spline, x: Tensor, y: Tensor, *, dtype: torch.dtype) -> Tensor:
    """The flow (B, 2, n, m) in px at places x, (1, 1, 1, m), and y, (1, 1, n, 1), px, computed in float64."""
    x = ((x.double().flatten() - spline.center[:, :, 0]) / spline.scale[:, :, 0])[:, None]
    y = ((y.double().flatten() - spline.center[:, :, 1]) / spline.scale[:, :, 0])[:, :, None]
    if torch.compiler.is_compiling():  # one loop over the pixels, whose sums need no memory
        px, py, wu, wv = torch.cat([spline.points, spline.weights / 2], dim=2)[..., None, None].unbind(2)
        kernel = _kernel(_square(x[:, None] - px, y[:, None] - py))
        bent = torch.stack([(weight * kernel).sum(dim=1) for weight in (wu, wv)], dim=1)
        return (torch.stack(_plane(spline.affine, x, y), dim=1) + bent).to(dtype)
    values = spline.points, spline.weights, spline.affine, x, y
    if not requires_grad(values) and _by_kernel(values):
        return _filled(values, dtype)
    return _Lattice.apply(*values, dtype)


def evaluate_spline(spline: Spline, points: Tensor) -> Tensor:
    """The displacement (B, M, 2) in px, float64, that a spline has at points (B, M, 2) in px."""
    x, y = ((points.double() - spline.center) / spline.scale)[:, None].unbind(3)
    return _evaluate(spline.points, spline.weights, spline.affine, x, y)[:, :, 0].mT


def check_points(points: Tensor) -> None:
    """Raise ValueError for control points (B, N, 2) that no spline goes through, where reading them costs nothing."""
    if points.shape[1] < 3:
        raise ValueError(f"points must be at least 3 to a sample, got {points.shape[1]}")
    if points.device.type != "cpu":
        return  # what follows would keep an accelerator busy, or waited for, and is not read
    check_values("points", "be finite", points, torch.isfinite)
    centered = (points - points.mean(dim=1, keepdim=True)).detach().double()
    extent = centered.norm(dim=2).amax(dim=1)

    def apart() -> Tensor:
        own = extent[:, None, None] * torch.eye(points.shape[1], device=points.device)
        return ((torch.cdist(centered, centered) + own).amin(dim=(1, 2)) > _NEAREST * extent).all()

    def spread() -> Tensor:
        return (torch.linalg.svdvals(centered.nan_to_num(0.0, 0.0, 0.0))[:, 1] > _FLATTEST * extent).all()

    if eager_bool(apart, of=centered) is False:
        raise ValueError("points must differ from one another, got two that are the same")
    if eager_bool(spread, of=centered) is False:
        raise ValueError("points must not lie on a line, got a sample whose points do")


class _Lattice(torch.autograd.Function):
    """The flow on a lattice, by rows that stay in the cache; its gradients keep nothing of the size of the flow."""

    generate_vmap_rule = True

    @staticmethod
    def forward(points: Tensor, weights: Tensor, affine: Tensor, x: Tensor, y: Tensor, dtype: torch.dtype) -> Tensor:
        values = points, weights, affine, x, y
        if _by_kernel(values):
            return _filled(values, dtype)
        rows = y.split(_at_once(x), dim=1)
        return torch.cat([_evaluate(points, weights, affine, x, part).to(dtype) for part in rows], dim=2)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:5])

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        points, weights, affine, x, y = ctx.saved_tensors
        total = torch.zeros_like(points), torch.zeros_like(weights), torch.zeros_like(affine)
        at_once = _at_once(x)
        for slope, part in zip(slopes[0].split(at_once, dim=2), y.split(at_once, dim=1), strict=True):
            found = _gradients(slope.double(), points, weights, x, part)
            total = tuple(a + b for a, b in zip(total, found, strict=True))
        return *total, None, None, None


def _by_kernel(values: Sequence[Tensor]) -> bool:
    """Whether a kernel can make the flow, and is faster; the places are the last two."""
    large = values[3].shape[2] * values[4].shape[1] >= _SMALLEST
    return large and not any(map(why_not_eager, values)) and kernels("_jit") is not None


def _filled(values: Sequence[Tensor], dtype: torch.dtype) -> Tensor:
    """The flow by a kernel; the places are the last two."""
    batch, (rows, columns) = len(values[0]), (values[4].shape[1], values[3].shape[2])
    out = values[0].new_empty(batch, 2, rows, columns, dtype=dtype)
    points, weights, affine, x, y = (np.ascontiguousarray(value.numpy()) for value in values)
    x, y = (
        np.ascontiguousarray(np.broadcast_to(own.reshape(-1, count), (batch, count)))
        for own, count in ((x, columns), (y, rows))
    )
    work = partial(kernels("fields.kernels.plates").plates, points, weights, affine, x, y, _NOTHING)
    share(lambda start, stop: work(start, stop, out.numpy()), batch * rows, least=_SMALLEST // columns + 1)
    return out


def _evaluate(points: Tensor, weights: Tensor, affine: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(B, 2, rows, columns): the spline at x and y, which broadcast to (B, rows, columns)."""
    u, v = _plane(affine, x, y)
    # Point by point: a matrix product would round by the number of its columns and threads.
    for point, weight in zip(points.unbind(1), (weights / 2).unbind(1), strict=True):
        px, py, wu, wv = torch.cat([point, weight], dim=1)[..., None, None].unbind(1)
        kernel = _kernel(_square(x - px, y - py))
        u, v = torch.addcmul(u, wu, kernel), torch.addcmul(v, wv, kernel)
    return torch.stack([u, v], dim=1)


def _gradients(slope: Tensor, points: Tensor, weights: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The gradients of points, weights and affine that a slope (B, 2, rows, W) on the lattice of x and y amounts to."""
    gu, gv = slope.unbind(1)
    by_point, by_weight = [], []
    for point, weight in zip(points.unbind(1), weights.unbind(1), strict=True):
        px, py, wu, wv = torch.cat([point, weight], dim=1)[..., None, None].unbind(1)
        x_to, y_to = x - px, y - py
        r2 = _square(x_to, y_to)
        log = r2.log()
        kernel = r2 * log / 2
        by_weight.append(torch.stack([(g * kernel).sum(dim=(1, 2)) for g in (gu, gv)], dim=1))
        along = -(gu * wu + gv * wv) * (log + 1)
        by_point.append(torch.stack([(along * to).sum(dim=(1, 2)) for to in (x_to, y_to)], dim=1))
    by_affine = torch.stack(
        [(slope * t).sum(dim=(2, 3)) for t in (torch.ones_like(x)[:, None], x[:, None], y[:, None])], 1
    )
    return torch.stack(by_point, dim=1), torch.stack(by_weight, dim=1), by_affine


def _plane(affine: Tensor, x: Tensor, y: Tensor) -> list[Tensor]:
    a, b, c = affine[..., None, None].unbind(1)
    return [a[:, i] + b[:, i] * x + c[:, i] * y for i in range(2)]


def _at_once(x: Tensor) -> int:
    """How many rows of the columns x (B, 1, W) go through the cache together."""
    return max(1, _CACHED // max(1, x.numel())) if x.device.type == "cpu" else 1 << 30


def _square(x: Tensor, y: Tensor) -> Tensor:
    """The squared distance, or what is nothing beside any other but has a logarithm."""
    return x.square() + (y.square() + _NOTHING)


def _kernel(r2: Tensor) -> Tensor:
    """2 U(r) = r^2 ln r^2 of the squared distance, 0 to every digit that counts and with a slope of 0 at r = 0."""
    return r2 * r2.log()
