"""Invert flows, with a residual that shows where the inverse is exact."""

import torch
from torch import Tensor

from torchrefract._validation import check_count, check_flow, check_positive, eager_bool, eager_values
from torchrefract.ops.sampling import grid_sample, sample, sampling_dtype
from torchrefract.warping.grid import field_dtype, inside, pixel_axes

# Px: a pixel with a smaller residual takes no further step.
_SOLVED_PX = {torch.float32: 1e-3, torch.float64: 1e-9}
# Px: flow beyond it is invalid; its square is still finite.
_LARGEST_FLOW = 1e12
# Pixels of a smaller Jacobian determinant are near a fold, and their first steps ignore the gradient of the flow.
_SMALLEST_DETERMINANT = 0.5
# Steps of all pixels with the gradient of the flow at p, while more than this share of them is unsolved. Afterwards the
# unsolved pixels are gathered, and the gradient is sampled at p + inverse.
_SHARED_STEPS, _MANY = 3, 1 / 8


def invert_flow(flow: Tensor, *, steps: int = 8, tolerance_px: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """Invert a flow: warp(warp(image, flow), inverse) = image where valid.

        inverse(p) + flow(p + inverse(p)) = 0, solved for each pixel by Newton's method from inverse = 0:
        inverse <- inverse - (I + grad flow)^-1 (inverse + flow),  flow sampled at p + inverse

    The first steps, up to 4, use the gradient of the flow at p, the later ones that at p + inverse. The flow is sampled
    bilinearly, its gradient are central differences. The gradient with respect to `flow` is that of one Newton step at
    the solution (implicit function theorem).

    Args:
        flow: (B, 2, H, W), px.
        steps: largest number of Newton steps after the first one, at least 1. A pixel takes no further step once its
            residual is within 1e-3 px (1e-9 px in float64).
        tolerance_px: largest residual of a valid pixel, px.

    Returns:
        inverse: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool: solved, not on a sheet that is folded over, sampled inside of the frame.
        residual_px: (B, 1, H, W), px, |inverse(p) + flow(p + inverse(p))|.

    Raises:
        ValueError: a flow of another shape, steps below 1, a tolerance that is not positive.

    Source: Chen, Lu, Chen, Ruchala, Olivera, "A simple fixed-point approach to invert a deformation field", Medical
    Physics 35 (2008), for the equation.
    """
    check_flow("flow", flow)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    flow = flow.to(field_dtype(flow.dtype))
    if flow.numel() == 0:
        return flow.clone(), flow[:, :1] == 0, flow[:, :1].clone()
    is_finite = (flow.detach().abs() <= _LARGEST_FLOW).all(dim=1, keepdim=True)
    has_holes = not eager_bool(is_finite.all, of=flow)
    flow = torch.where(is_finite, flow, 0) if has_holes else flow
    with torch.no_grad():
        values = flow.detach().to(sampling_dtype(flow, flow.dtype))
        is_eager = eager_values(lambda: values[0, 0, 0, 0]) is not None
        # In eager mode one sample at a time, so that the unsolved pixels of each can be gathered.
        solved = [_solve(part, steps, is_eager=is_eager) for part in (values.split(1) if is_eager else [values])]
        solution, residual, determinant = (torch.cat(parts).to(flow.dtype) for parts in zip(*solved, strict=True))
        valid = (residual <= tolerance_px) & (determinant > 0) & inside(solution)
        if has_holes:
            # The inverse is unknown where it samples a hole of the flow.
            valid = valid & is_finite & (_sample(is_finite.to(flow.dtype), solution) > 0.999)
    if not (flow.requires_grad and torch.is_grad_enabled()):
        return solution, valid, residual
    moved = _sample(flow, solution)
    gradient = _cell_gradient(flow.detach(), solution)
    return _newton_step(solution, moved - moved.detach(), gradient), valid, residual


def _solve(flow: Tensor, steps: int, *, is_eager: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return the inverse (B, 2, H, W), its residual, px, and the Jacobian determinant at p + inverse, (B, 1, H, W)."""
    height, width = flow.shape[2:]
    axes = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    pixels = torch.cat(torch.broadcast_tensors(*axes), dim=1)  # (1, 2, H, W)
    gradient = torch.cat([_central_differences(flow, 3), _central_differences(flow, 2)], dim=1)
    determinant = _determinant(gradient)
    # Near a fold a step by the gradient may lead anywhere.
    first_gradient = torch.where(determinant >= _SMALLEST_DETERMINANT, gradient, 0)
    inverse = _newton_step(torch.zeros_like(flow), flow, first_gradient)
    error = inverse + _sample_at(flow, pixels + inverse)
    threshold = _SOLVED_PX[flow.dtype] ** 2
    index: Tensor | None = None
    for step in range(steps):
        is_unsolved = _squared_length(error) > threshold
        if not is_eager:
            slopes = _sample_at(gradient, pixels + inverse)
            inverse = torch.where(is_unsolved, _newton_step(inverse, error, slopes), inverse)
            error = inverse + _sample_at(flow, pixels + inverse)
            continue
        index = is_unsolved.flatten().nonzero()[:, 0]
        if len(index) == 0:
            break
        if step < _SHARED_STEPS and len(index) > _MANY * height * width:
            inverse = _newton_step(inverse, error, first_gradient)
            error = inverse + _sample_at(flow, pixels + inverse)
            continue
        p, u, e = (_gather(field, index) for field in (pixels, inverse, error))
        u = _newton_step(u, e, _sample_at(gradient, p + u))
        e = u + _sample_at(flow, p + u)
        for field, values in ((inverse, u), (error, e)):
            field.flatten(2).index_copy_(2, index, values[..., 0])
    if not eager_bool(lambda: determinant.amin() >= _SMALLEST_DETERMINANT, of=determinant):
        determinant = _sample_at(determinant, pixels + inverse)
    return inverse, _squared_length(error).sqrt(), determinant


def _gather(field: Tensor, index: Tensor) -> Tensor:
    """Gather pixels (n,) of a field (1, C, H, W), as (1, C, n, 1)."""
    return field.flatten(2)[:, :, index, None]


def _newton_step(inverse: Tensor, error: Tensor, gradient: Tensor) -> Tensor:
    """Return the inverse after one Newton step, bounded so that it stays finite.

    inverse, error: (B, 2, h, w), px. gradient: (B, 4, h, w), as of `_central_differences` along x and y.
    """
    u_x, v_x, u_y, v_y = gradient.split(1, dim=1)
    determinant = _determinant(gradient)
    # Near a fold no step has a good length; the residual shows whether it led to a solution.
    scale = 1 / determinant.abs().clamp(min=0.1).copysign(determinant)
    a, b = error.split(1, dim=1)
    step = torch.cat([(1 + v_y) * a - u_y * b, (1 + u_x) * b - v_x * a], dim=1) * scale
    return (inverse - step).clamp(-_LARGEST_FLOW, _LARGEST_FLOW)


def _determinant(gradient: Tensor) -> Tensor:
    u_x, v_x, u_y, v_y = gradient.split(1, dim=1)
    return (1 + u_x) * (1 + v_y) - u_y * v_x


def _squared_length(flow: Tensor) -> Tensor:
    u, v = flow.split(1, dim=1)
    return torch.addcmul(u * u, v, v)


def _central_differences(flow: Tensor, dim: int) -> Tensor:
    """Return the gradient of u and of v along a dimension, one-sided at the border; (B, 2, H, W)."""
    return torch.zeros_like(flow) if flow.shape[dim] == 1 else torch.gradient(flow, dim=dim)[0]


def _cell_gradient(flow: Tensor, at: Tensor) -> Tensor:
    """Return the gradient of the bilinear interpolant itself at p + at(p), (B, 4, H, W)."""
    height, width = flow.shape[2:]
    axes = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    x, y = (axis + shift for axis, shift in zip(axes, at.split(1, dim=1), strict=True))
    left, top = x.floor(), y.floor()
    differences = [
        _sample_at(flow, torch.cat(high, dim=1)) - _sample_at(flow, torch.cat(low, dim=1))
        for low, high in (((left, y), (left + 1, y)), ((x, top), (x, top + 1)))
    ]
    return torch.cat(differences, dim=1)


def _sample_at(field: Tensor, positions: Tensor) -> Tensor:
    """Sample a field (B, C, H, W) at positions (B, 2, h, w), px, bilinearly."""
    height, width = field.shape[2:]
    x, y = positions.split(1, dim=1)
    grid = torch.cat([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=1).movedim(1, -1)
    return grid_sample(field, grid, padding="border", interpolation="bilinear")


def _sample(field: Tensor, flow: Tensor) -> Tensor:
    return sample(field, flow, padding="border", interpolation="bilinear")
