"""The flow that undoes a flow, with a certificate."""

import math

import torch
from torch import Tensor

from torchrefract._checks import check_count, check_flow, check_positive, is_true
from torchrefract.warping.grid import field_dtype, inside, length, pixel_axes
from torchrefract.warping.resample import look_up

# Px: so short a step is the last.
_NEAR = {torch.float32: 1e-3, torch.float64: 1e-6}
# Px: flow from here on leads nowhere, and its square is a number still.
_FARTHEST = 1e12
# Of so many pixels one may be left on a fold, where no step helps.
_FEW = 500
# Where a step is longer than this share of the one before, the slopes that both took no longer fit. They are read anew
# for a sample of which more than one pixel in so many is like that.
_SLOW, _FEW_SLOW = 1 / 3, 2000
# Of determinants: what is nearer to a fold is begun without slopes.
_UPRIGHT = 0.5


def invert_flow(flow: Tensor, *, steps: int = 8, tolerance_px: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """The flow that undoes a warp: warp(warp(image, flow), inverse) = image on `valid`.

        inverse(p) + flow(p + inverse(p)) = 0, solved by Newton's method from no flow:
        inverse <- inverse - (I + grad flow)^-1 (inverse + flow),  flow read at p + inverse,
        its gradient at first at p, and at p + inverse once steps no longer shrink to a third

    The flow is read bilinearly, its gradient by central differences. The gradient with respect to `flow` comes from
    one attached Newton step at the solution (implicit function theorem), not from unrolling.

    Args:
        flow: (B, 2, H, W), px.
        steps: Newton steps at most beside the first, at least 1; a sample takes no more once all its pixels stay within
            1e-3 px (1e-6 px in float64), or the few of them that do not, one in 500, no longer become fewer.
        tolerance_px: the residual up to which a pixel counts as solved, px.

    Returns:
        inverse: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool: solved, on a sheet that is not folded over, looked up inside the frame.
        residual_px: (B, 1, H, W), px, |inverse(p) + flow(p + inverse(p))|.

    Raises:
        ValueError: a flow of another shape, no step, a tolerance that is not positive.

    Newton and the fixed point inverse <- -flow(p + inverse) end in the same inverse, equally smooth, valid on the same
    pixels. To 1e-3 px on 99.9 % of them Newton takes 9 to 13 bare grid_samples on the defaults of a lens, turbulence
    and a thin plate, and 19 on strong turbulence, the fixed point 7 to 19, and 18; on a strong lens (k1 = -0.4) the
    fixed point is still 17 px off after 30 steps. Measured by benchmarks/inverses.py on frames of 1280 x 720.

    Source: Chen, Lu, Chen, Ruchala, Olivera, "A simple fixed-point approach to invert a deformation field", Medical
    Physics 35 (2008), for the equation and the fixed point.
    """
    check_flow("flow", flow)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    flow = flow.to(field_dtype(flow.dtype))
    known = (flow.abs() <= _FARTHEST).all(dim=1, keepdim=True)
    whole = is_true(known.all)
    flow = flow if whole else torch.where(known, flow, 0)
    with torch.no_grad():
        slopes = _gradient(flow)
        determinant = _determinant(slopes)
        solution = inverse = _solved(flow, slopes, determinant, steps)
        read = _read(torch.cat([flow, determinant], dim=1), solution)
        residual = length(solution + read[:, :2])
        solved = (residual <= tolerance_px) & (read[:, 2:] > 0) & inside(solution)
        # Nothing is known where a hole in the flow would have been read.
        valid = solved if whole else solved & known & (_read(known.to(flow.dtype), solution) > 0.999)
    if flow.requires_grad and torch.is_grad_enabled():
        moved = _read(flow, solution)
        slopes = _cell_gradient(flow.detach(), solution)
        inverse = solution - _times(_inverted(slopes, _determinant(slopes)), moved - moved.detach())
    return inverse, valid, residual


def _solved(flow: Tensor, slopes: Tensor, determinant: Tensor, steps: int) -> Tensor:
    """The inverse (B, 2, H, W), after some steps; a sample that is done stays as it is, and depends on no other."""
    near, pixels = _NEAR[flow.dtype] ** 2, math.prod(flow.shape[2:])
    # The first step, from no flow at all, has nothing to read.
    upright = determinant >= _UPRIGHT
    matrix = _where(upright, _inverted(slopes, determinant), _identity(flow))
    inverse = -_step(matrix, flow)
    going, many, before = upright.new_ones(upright.shape[0], 1, 1, 1), pixels, _square(inverse)
    for _ in range(steps):
        error = inverse + _read(flow, inverse)
        step = _step(matrix, error)
        size = _square(step)
        far = size > near
        slow = going & (_count(far & (size > _SLOW**2 * before)) * _FEW_SLOW > pixels)
        if is_true(slow.any) is not False:
            there = _read(slopes, inverse)
            matrix = _where(slow, _inverted(there, _determinant(there)), matrix)
            step = _step(matrix, error)
            size = _square(step)
            far = size > near
        inverse = _where(going, inverse - step, inverse)
        left = _count(far)
        stuck = (left * _FEW <= pixels) & (left >= many)
        going, many, before = going & (left > 0) & ~stuck, left, size
        if is_true(going.any) is False:
            break
    return inverse


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
        ends = (_read(flow, end) for end in (high, low))
        slopes.append(torch.sub(*ends))
    return torch.cat(slopes, dim=1)


def _read(field: Tensor, at: Tensor) -> Tensor:
    """A field (B, C, H, W) at p + at(p)."""
    return look_up(field, at, padding="border", interpolation="bilinear")


def _where(flags: Tensor, value: Tensor, otherwise: Tensor) -> Tensor:
    """As `torch.where`, which takes longer than the rest of a step; nothing is chosen where all flags are true."""
    return value if is_true(flags.all) else torch.where(flags, value, otherwise)


def _count(flags: Tensor) -> Tensor:
    """(B, 1, 1, 1): how many pixels of a sample, (B, 1, H, W), are true."""
    return flags.sum(dim=(2, 3), keepdim=True)


def _square(step: Tensor) -> Tensor:
    """(B, 1, H, W), px^2, of (B, 2, H, W)."""
    u, v = step.split(1, dim=1)
    return torch.addcmul(u * u, v, v)


def _determinant(slopes: Tensor) -> Tensor:
    """(B, 1, H, W): of I + the slopes (B, 4, H, W), as of `_gradient`."""
    u_x, v_x, u_y, v_y = slopes.split(1, dim=1)
    return (1 + u_x) * (1 + v_y) - u_y * v_x


def _inverted(slopes: Tensor, determinant: Tensor) -> Tensor:
    """(B, 4, H, W): the matrix (I + slopes)^-1, column by column, from that and its determinant."""
    # Near a fold the step has no good length; a bounded determinant keeps it finite, the residual tells the rest.
    determinant = determinant.abs().clamp(min=0.1).copysign(determinant)
    u_x, v_x, u_y, v_y = slopes.split(1, dim=1)
    return torch.cat([1 + v_y, -v_x, -u_y, 1 + u_x], dim=1) / determinant


def _identity(flow: Tensor) -> Tensor:
    """(1, 4, 1, 1), as of `_inverted`."""
    return torch.eye(2, dtype=flow.dtype, device=flow.device).view(1, 4, 1, 1)


def _step(matrix: Tensor, error: Tensor) -> Tensor:
    """Newton's, no longer than any flow, so that all that comes of it is a number."""
    return _times(matrix, error).clamp(-_FARTHEST, _FARTHEST)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """(B, 2, H, W) of matrices (B, 4, H, W), column by column, and vectors (B, 2, H, W)."""
    x, y = vector.split(1, dim=1)
    return torch.addcmul(matrix[:, :2] * x, matrix[:, 2:], y)
