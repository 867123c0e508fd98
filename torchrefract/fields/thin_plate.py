"""Thin-plate splines: the smoothest flow with given displacements at control points."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchrefract._tensor import in_bands
from torchrefract._validation import check_values, eager_values, requires_grad, why_not_eager

# Control points closer than this share of their extent count as equal.
_NEAREST = 1e-6
# Points count as collinear if the ratio of their two extents is below this.
_FLATTEST = 1e-5
_UNIT = 2  # of the coordinates, in root mean square distances from the center
_TINY = 1e-60  # negligible beside rounding; derivatives of the fifth order, which divide by its fifth power, are finite
_VALUES_AT_ONCE = 1 << 18  # kernels that stay in a processor's cache


class Spline(NamedTuple):
    """Coefficients of one spline for each sample, float64, in coordinates with `center` 0 and `scale` 1."""

    points: Tensor  # (B, P, 2)
    weights: Tensor  # (B, P, 2), of the kernels, px
    affine: Tensor  # (B, 3, 2), of 1, x and y, px
    center: Tensor  # (B, 1, 2), px
    scale: Tensor  # (B, 1, 1), px


def fit_spline(points: Tensor, displacement: Tensor, smoothing: Tensor) -> Spline:
    """Fit the thin-plate spline with f(p_i) = d_i at the control points, or near them if it is smoothed.

        f(p) = a1 + a2 x + a3 y + sum w_i U(|p - p_i|),  U(r) = r^2 ln r,  sum w = sum w x = sum w y = 0

    The system (K + smoothing I) w + P a = d, P' w = 0 is solved in float64. The smoothing is in units of the root mean
    square distance of the points from their center. The coordinates are in units of twice that, where the kernels
    between most points, and with them rounding errors, are smallest.

    Args:
        points: (B, P, 2), px, x and y, P at least 3, distinct and not collinear, see `check_points`.
        displacement: (B, P, 2), px, of each point.
        smoothing: (B,), 0 or above; 0 interpolates.

    U has no second derivative at r = 0, where it diverges like ln r: second derivatives of the spline at a control
    point, with respect to positions or points, are finite and have no meaning; first ones are right everywhere.

    Source: Bookstein, "Principal warps", IEEE TPAMI 11 (1989).
    """
    points, displacement, smoothing = points.double(), displacement.double(), smoothing.double()
    count = points.shape[1]
    center = points.mean(dim=1, keepdim=True)
    scale = (points - center).square().sum(dim=2).mean(dim=1)[:, None, None].clamp(min=1e-24).sqrt()
    # The choice of coordinates changes only the smoothing, which is measured in them.
    smoothing = smoothing[:, None, None] * (scale / scale.detach()).square() / _UNIT**2
    center, scale = center.detach(), _UNIT * scale.detach()
    unit = (points - center) / scale
    x, y = unit[:, None].unbind(3)
    kernel = _kernel(unit, x, y) / 2 + smoothing * torch.eye(count, dtype=unit.dtype, device=unit.device)
    plane = torch.cat([torch.ones_like(unit[..., :1]), unit], dim=2)
    corner = unit.new_zeros(unit.shape[0], 3, 3)
    system = torch.cat([torch.cat([kernel, plane], dim=2), torch.cat([plane.mT, corner], dim=2)], dim=1)
    right = torch.cat([displacement, displacement.new_zeros(unit.shape[0], 3, 2)], dim=1)
    # solve_ex raises nothing, and so waits for no device.
    solution = torch.linalg.solve_ex(system, right)[0]
    return Spline(unit, solution[:, :count], solution[:, count:], center, scale)


def spline_flow(spline: Spline, x: Tensor, y: Tensor, *, dtype: torch.dtype) -> Tensor:
    """Evaluate splines at positions, in float64.

    Args:
        spline: of B samples.
        x, y: px, (B or 1, 1, h or 1, w) and (B or 1, 1, h, w or 1), which broadcast.
        dtype: of the result.

    Returns:
        (B, 2, h, w), px.
    """
    x, y = (((axis.double()[:, 0] - spline.center[..., i : i + 1]) / spline.scale) for i, axis in enumerate((x, y)))
    height = y.shape[1]
    at_once = max(1, _VALUES_AT_ONCE // max(1, spline.points.shape[1] * x.shape[2] * len(x)))
    if torch.compiler.is_compiling():
        at_once = height
    # Kernels of all positions would need gigabytes; their gradients compute them again.
    recompute = at_once < height and requires_grad((*spline[:3], x, y)) and why_not_eager(x) is None

    def at_rows(start: int, stop: int) -> Tensor:
        values = (*spline[:3], x if x.shape[1] == 1 else x[:, start:stop], y[:, start:stop])
        return (checkpoint(_evaluate, *values, use_reentrant=False) if recompute else _evaluate(*values)).to(dtype)

    return in_bands(at_rows, length=height, band=at_once, dim=2)


def check_points(points: Tensor) -> None:
    """Raise ValueError if no spline interpolates control points (B, N, 2); nothing is checked on accelerators."""
    if points.shape[1] < 3:
        raise ValueError(f"points must be at least 3 to a sample, got {points.shape[1]}")
    if points.device.type != "cpu" or torch.compiler.is_compiling():
        return
    check_values("points", "be finite", points, torch.isfinite)
    centered = (points - points.mean(dim=1, keepdim=True)).detach().double()
    extent = centered.norm(dim=2).amax(dim=1)
    apart = torch.cdist(centered, centered) + extent[:, None, None] * torch.eye(
        points.shape[1], dtype=extent.dtype, device=extent.device
    )
    if eager_values((apart.amin(dim=(1, 2)) > _NEAREST * extent).all, of=centered) is False:
        raise ValueError("points must differ from one another, got two equal ones")
    widths = torch.linalg.svdvals(centered.nan_to_num(0.0, 0.0, 0.0))
    if eager_values((widths[:, 1] > _FLATTEST * extent).all, of=centered) is False:
        raise ValueError("points must not lie on one line, got a sample with collinear points")


def _evaluate(points: Tensor, weights: Tensor, affine: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Compute (B, 2, h, w) at positions x and y, which broadcast to (B, h, w)."""
    kernel = _kernel(points[:, :, None], x[:, None], y[:, None])
    bent = (weights.mT / 2 @ kernel.flatten(2)).unflatten(2, kernel.shape[2:])
    a, b, c = affine[..., None, None].unbind(1)
    return a + b * x[:, None] + c * y[:, None] + bent


def _kernel(points: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Compute 2 U(r) = r^2 ln r^2 of points (B, P, ..., 2) and positions; 0 up to rounding, as its gradient, at 0."""
    px, py = points[..., None].unbind(-2)
    # The negligible number has a logarithm.
    r2 = (x - px).square() + ((y - py).square() + _TINY)
    return r2.log().mul_(r2)
