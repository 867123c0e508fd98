"""The flow that undoes a flow, with a certificate."""

import math

import torch
from torch import Tensor

from torchrefract._checks import check_count, check_flow, check_positive, is_true
from torchrefract.warping.grid import field_dtype, inside, length, pixel_axes
from torchrefract.warping.resample import look_up

# Px: after so short a step the next one, a square of it, is below rounding.
_NEAR = {torch.float32: 1e-3, torch.float64: 1e-6}
# Px: flow from here on leads nowhere, and its square is a number still.
_FARTHEST = 1e12
# Of so many pixels one may be left on a fold, where no step helps.
_FEW = 500


def invert_flow(flow: Tensor, *, steps: int = 6, tolerance_px: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """The flow that undoes a warp: warp(warp(image, flow), inverse) = image on `valid`.

        inverse(p) + flow(p + inverse(p)) = 0, solved by Newton's method from -flow:
        inverse <- inverse - (I + grad flow)^-1 (inverse + flow),  flow and its gradient read at p + inverse

    The flow is read bilinearly, its gradient by central differences. The gradient with respect to `flow` comes from
    one attached Newton step at the solution (implicit function theorem), not from unrolling.

    Args:
        flow: (B, 2, H, W), px.
        steps: Newton steps at most, at least 1; a sample takes no more once all its pixels stay within 1e-3 px (1e-6 px
            in float64), or the few of them that do not, one in 500, no longer become fewer.
        tolerance_px: the residual up to which a pixel counts as solved, px.

    Returns:
        inverse: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool: solved, on a sheet that is not folded over, looked up inside the frame.
        residual_px: (B, 1, H, W), px, |inverse(p) + flow(p + inverse(p))|.

    Raises:
        ValueError: a flow of another shape, no step, a tolerance that is not positive.

    Newton and the fixed point inverse <- -flow(p + inverse) end in the same inverse, equally smooth, valid on the same
    pixels. To 1e-3 px on 99.9 % of them Newton takes 1 to 2 steps on the effects' defaults and 3 on strong ones (21 to
    25, and 33 bare grid_samples), the fixed point 3 to 12 and 12 to 30 (17 to 33, and 33 to 64); on a strong lens
    (k1 = -0.4) it is still 17 px off after 30. Newton's steps hardly depend on the flow, so their number can be fixed;
    6 leave room. Measured by benchmarks/inverses.py on frames of 1280 x 720.

    Source: Chen, Lu, Chen, Ruchala, Olivera, "A simple fixed-point approach to invert a deformation field", Medical
    Physics 35 (2008), for the equation and the fixed point.
    """
    check_flow("flow", flow)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    flow = flow.to(field_dtype(flow.dtype))
    known = (flow.abs() <= _FARTHEST).all(dim=1, keepdim=True)
    flow = torch.where(known, flow, 0)
    with torch.no_grad():
        table = torch.cat([flow, _gradient(flow)], dim=1)
        inverse = -flow
        going, far = known.new_ones(known.shape[0], 1, 1, 1), math.prod(known.shape[2:])
        for _ in range(steps):
            error, jacobian = _residual(table, inverse)
            step = _solve(jacobian, error)
            inverse = torch.where(going, inverse - step, inverse)
            going, far = _goes_on(step, going, far)
            if is_true(going.any) is False:
                break
        error, jacobian = _residual(table, inverse)
        residual = length(error)
        solution = inverse
        solved = (residual <= tolerance_px) & (_determinant(jacobian) > 0) & inside(solution)
        # Nothing is known where a hole in the flow would have been read.
        read = look_up(known.to(flow.dtype), solution, padding="border", interpolation="bilinear")
        valid = solved & known & (read > 0.999)
    if flow.requires_grad and torch.is_grad_enabled():
        moved = look_up(flow, solution, padding="border", interpolation="bilinear")
        inverse = inverse - _solve(_cell_gradient(flow.detach(), solution), moved - moved.detach())
    return inverse, valid, residual


def _gradient(flow: Tensor) -> Tensor:
    """(B, 4, H, W): u_x, v_x, u_y, v_y by central differences, one-sided at the border."""
    sides = [torch.gradient(flow, dim=dim)[0] if flow.shape[dim] > 1 else torch.zeros_like(flow) for dim in (-1, -2)]
    return torch.cat(sides, dim=1)


def _cell_gradient(flow: Tensor, at: Tensor) -> Tensor:
    """(B, 4, H, W): u_x, v_x, u_y, v_y of the bilinear reading itself at p + at(p), each the slope of a cell."""
    axes = pixel_axes(flow.shape[2], flow.shape[3], dtype=flow.dtype, device=flow.device)
    slopes = []
    for channel, axis in enumerate(axes):
        shift = (axis + at[:, channel : channel + 1]).floor() - axis
        low = torch.cat([shift, at[:, 1:]] if channel == 0 else [at[:, :1], shift], dim=1)
        high = low + torch.eye(2, dtype=flow.dtype, device=flow.device)[channel].view(1, 2, 1, 1)
        ends = (look_up(flow, end, padding="border", interpolation="bilinear") for end in (high, low))
        slopes.append(torch.sub(*ends))
    return torch.cat(slopes, dim=1)


def _goes_on(step: Tensor, going: Tensor, before: Tensor | int) -> tuple[Tensor, Tensor]:
    """(B, 1, 1, 1), bool: the samples that another step changes, and how many of their pixels were far from solved.

    A sample that is done stays as it is, so that it does not depend on the others.
    """
    near = _NEAR[step.dtype]
    far = (step.square().sum(dim=1, keepdim=True) > near**2).sum(dim=(2, 3), keepdim=True)
    stuck = (far * _FEW <= math.prod(step.shape[2:])) & (far >= before)
    return going & (far > 0) & ~stuck, far


def _residual(table: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    read = look_up(table, inverse, padding="border", interpolation="bilinear")
    return inverse + read[:, :2], read[:, 2:]


def _determinant(jacobian: Tensor) -> Tensor:
    u_x, v_x, u_y, v_y = jacobian.split(1, dim=1)
    return (1 + u_x) * (1 + v_y) - u_y * v_x


def _solve(jacobian: Tensor, error: Tensor) -> Tensor:
    """(I + jacobian)^-1 error, in closed form."""
    u_x, v_x, u_y, v_y = jacobian.split(1, dim=1)
    a, b = error.split(1, dim=1)
    determinant = _determinant(jacobian)
    # Near a fold the step has no good length; a bounded determinant keeps it finite, the residual tells the rest.
    determinant = torch.where(determinant >= 0, determinant.clamp(min=0.1), determinant.clamp(max=-0.1))
    return torch.cat([(1 + v_y) * a - u_y * b, (1 + u_x) * b - v_x * a], dim=1) / determinant
