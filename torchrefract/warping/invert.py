"""Invert flows, with a residual that shows where the inverse is exact."""

import torch
from torch import Tensor

from torchrefract._tensor import rows_at_once
from torchrefract._validation import check_count, check_flow, check_positive, eager_values, requires_grad
from torchrefract.ops.sampling import grid_sample, sampling_dtype
from torchrefract.warping.flow import Jacobian
from torchrefract.warping.grid import field_dtype, inside, pixel_axes
from torchrefract.warping.implicit import LinearSample, implicit, sample_linear
from torchrefract.warping.warp import sees_only_valid

# Px, and units in the last place of the longer side: a pixel with a smaller residual takes no further step.
_SOLVED_PX, _SOLVED_ULPS = {torch.float32: 2e-5, torch.float64: 1e-11}, 4
# Px: flow beyond it is invalid; its square is still finite.
_LARGEST_FLOW = 1e12
# Pixels of a smaller Jacobian determinant are near a fold, and their first steps ignore the gradient of the flow.
_SMALLEST_DETERMINANT = 0.5
# Steps of all pixels with the gradient of the flow at p, while more than this share of them is unsolved. Afterwards the
# unsolved pixels are gathered, and take the slopes of the flow at p + inverse.
_SHARED_STEPS, _MANY = 3, 1 / 8
_BAND_PIXELS = 1 << 15  # whose 20 planes of float32 fit into the cache; fixed, so that threads change no result


def invert_flow(flow: Tensor, *, steps: int = 8, tolerance_px: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """Invert a flow: warp(warp(image, flow), inverse) = image where valid.

        inverse(p) + flow(p + inverse(p)) = 0, solved for each pixel by Newton's method from inverse = 0:
        inverse <- inverse - (I + grad flow)^-1 (inverse + flow),  flow sampled at p + inverse

    The first steps, up to 4, use central differences of the flow at p. The later ones use the slopes at p + inverse of
    the flow, which is sampled bilinearly, and converge quadratically: after 8 steps, smooth flows without folds are
    solved to 1e-11 px in float64. Derivatives with respect to `flow`, of any order and in any mode, are those of the
    exact inverse (implicit function theorem); pixels that are not solved have none.

    Args:
        flow: (B, 2, H, W), px.
        steps: largest number of Newton steps after the first one, at least 1. A pixel takes no further step once its
            residual is within 2e-5 px (1e-11 px in float64), or 4 units in the last place of the longer side.
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
    has_holes = not eager_values(is_finite.all, of=flow)
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
            valid = valid & is_finite & sees_only_valid(is_finite, solution)
    if requires_grad((flow,)):
        # A pixel without a solution keeps the last iterate, which has no derivative.
        inverse = torch.cat(implicit(solution.split(1, dim=1), (flow,), _error), dim=1)
        solution = torch.where(residual <= tolerance_px, inverse, solution)
    return solution, valid, residual


def _solve(flow: Tensor, steps: int, *, is_eager: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return the inverse (B, 2, H, W), its residual, px, and the Jacobian determinant at p + inverse, (B, 1, H, W)."""
    height, width = flow.shape[2:]
    gradient = _gradient(flow)
    is_upright = eager_values(lambda: _determinant(gradient).amin() >= _SMALLEST_DETERMINANT, of=flow)
    rows = rows_at_once(flow.device, height, each=width, cached=_BAND_PIXELS) if is_eager else height
    bands = []
    for start in range(0, height, rows):
        band = flow[:, :, start : start + rows], gradient[:, :, start : start + rows]
        x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
        x, y = (2 * x + 1) / width - 1, (2 * y[:, :, start : start + rows] + 1) / height - 1
        bands.append(_solve_band(flow, gradient, x, y, *band, steps=steps, is_eager=is_eager, is_upright=is_upright))
    inverse, residual, determinant = (torch.cat(parts, dim=2) for parts in zip(*bands, strict=True))
    return inverse, residual, determinant


def _solve_band(
    flow: Tensor,
    gradient: Tensor,
    x: Tensor,
    y: Tensor,
    first_error: Tensor,
    first_gradient: Tensor,
    *,
    steps: int,
    is_eager: bool,
    is_upright: bool | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve for a band of rows of a frame.

    flow, gradient: of the frame. x, y: pixel centers of the rows, in the coordinates of F.grid_sample. first_error,
    first_gradient: flow and gradient in these rows. is_upright: True if no determinant is small.
    """
    determinant = _determinant(first_gradient)
    matrix = _inverse_jacobian(first_gradient, determinant)
    if not is_upright:
        # Near a fold a step by the gradient may lead anywhere.
        identity = matrix.new_tensor([1.0, 0.0, 0.0, 1.0]).view(1, 4, 1, 1)
        matrix = torch.where(determinant >= _SMALLEST_DETERMINANT, matrix, identity)
    inverse = _newton_step(torch.zeros_like(first_error), first_error, matrix)
    error = _sample_at(flow, x, y, inverse).add_(inverse)
    threshold = _solved_px(flow) ** 2
    pixels = None if is_eager else _pixels(x, y, flow)
    for step in range(steps):
        squared_error = _squared_length(error)
        is_unsolved = squared_error > threshold
        if pixels is not None:
            solution = inverse.flatten(2)
            stepped = _step_in_cells(solution, _sample_clamped(flow, pixels + solution))
            inverse = torch.where(is_unsolved, stepped.view_as(inverse), inverse)
            error = _sample_at(flow, x, y, inverse) + inverse
            continue
        num_unsolved = int(is_unsolved.count_nonzero())
        if num_unsolved == 0:
            break
        if step == _SHARED_STEPS or num_unsolved <= _MANY * is_unsolved.numel():
            _solve_pixels(flow, x, y, inverse, error, is_unsolved, steps=steps - step)
            break
        inverse = _newton_step(inverse, error, matrix)
        error = _sample_at(flow, x, y, inverse).add_(inverse)
    if not is_upright:
        determinant = _sample_at(_determinant(gradient), x, y, inverse)
    return inverse, _squared_length(error).sqrt_(), determinant


def _solve_pixels(
    flow: Tensor, x: Tensor, y: Tensor, inverse: Tensor, error: Tensor, is_unsolved: Tensor, *, steps: int
) -> None:
    """Take Newton steps at the unsolved pixels alone, with the slopes of the bilinear flow; write inverse and error."""
    index = is_unsolved.flatten().nonzero()[:, 0]
    pixels, solution = _pixels(x, y, flow).index_select(2, index), inverse.flatten(2).index_select(2, index)
    sample = _sample_clamped(flow, pixels + solution)
    for _ in range(steps):
        solution = _step_in_cells(solution, sample)
        sample = _sample_clamped(flow, pixels + solution)
        remainder = solution + sample.value
        for field, values in ((inverse, solution), (error, remainder)):
            field.view(1, 2, -1).index_copy_(2, index, values)
        remaining = (_squared_length(remainder) > _solved_px(flow) ** 2).flatten().nonzero()[:, 0]
        if len(remaining) == 0:
            break
        index, pixels, solution = index[remaining], pixels[:, :, remaining], solution[:, :, remaining]
        sample = LinearSample(*(values[:, :, remaining] for values in sample))


def _solved_px(flow: Tensor) -> float:
    rounding_px = _SOLVED_ULPS * torch.finfo(flow.dtype).eps / 2 * max(flow.shape[2:])
    return max(_SOLVED_PX[flow.dtype], rounding_px)


def _pixels(x: Tensor, y: Tensor, flow: Tensor) -> Tensor:
    """Return the positions (1, 2, h w), px, of pixel centers in the coordinates of F.grid_sample."""
    height, width = flow.shape[2:]
    axes = ((x + 1) * width - 1) / 2, ((y + 1) * height - 1) / 2
    return torch.cat(torch.broadcast_tensors(*axes), dim=1).round().flatten(2)


def _step_in_cells(solution: Tensor, sample: LinearSample) -> Tensor:
    """Take a Newton step of solutions (B, 2, N), at which the flow was sampled."""
    gradient = torch.cat([sample.slope_x, sample.slope_y], dim=1).unsqueeze(2)
    matrix = _inverse_jacobian(gradient, _determinant(gradient))
    return _newton_step(solution.unsqueeze(2), (solution + sample.value).unsqueeze(2), matrix).squeeze(2)


def _newton_step(inverse: Tensor, error: Tensor, matrix: Tensor) -> Tensor:
    """Subtract the inverse Jacobian (B, 4, h, w) times the error, px, bounded so that it stays finite."""
    xx, xy, yx, yy = matrix.split(1, dim=1)
    a, b = error.split(1, dim=1)
    u, v = inverse.split(1, dim=1)
    u = torch.addcmul(torch.addcmul(u, xx, a, value=-1), xy, b, value=-1)
    v = torch.addcmul(torch.addcmul(v, yx, a, value=-1), yy, b, value=-1)
    return torch.cat([u, v], dim=1).clamp(-_LARGEST_FLOW, _LARGEST_FLOW)


def _inverse_jacobian(gradient: Tensor, determinant: Tensor) -> Tensor:
    """Return (I + gradient)^-1, (B, 4, h, w), row by row, with |determinant| clamped to at least 0.1."""
    u_x, v_x, u_y, v_y = gradient.split(1, dim=1)
    # Near a fold no step has a good length; the residual shows whether it led to a solution.
    scale = 1 / determinant.abs().clamp(min=0.1).copysign(determinant)
    return torch.cat([(1 + v_y) * scale, -u_y * scale, -v_x * scale, (1 + u_x) * scale], dim=1)


def _determinant(gradient: Tensor) -> Tensor:
    u_x, v_x, u_y, v_y = gradient.split(1, dim=1)
    return torch.addcmul((1 + u_x) * (1 + v_y), u_y, v_x, value=-1)


def _squared_length(flow: Tensor) -> Tensor:
    u, v = flow.split(1, dim=1)
    return torch.addcmul(u * u, v, v)


def _gradient(flow: Tensor) -> Tensor:
    """Return central differences of u and v along x, then along y, one-sided at the border; (B, 4, H, W)."""
    differences = []
    for dim in (3, 2):
        size = flow.shape[dim]
        if size == 1:
            differences.append(torch.zeros_like(flow))
            continue
        center = (flow.narrow(dim, 2, size - 2) - flow.narrow(dim, 0, size - 2)) / 2
        first, last = (flow.narrow(dim, i + 1, 1) - flow.narrow(dim, i, 1) for i in (0, size - 2))
        differences.append(torch.cat([first, center, last], dim=dim))
    return torch.cat(differences, dim=1)


def _error(u: Tensor, v: Tensor, flow: Tensor) -> tuple[tuple[Tensor, Tensor], Jacobian]:
    """Return inverse + flow(p + inverse) of the inverse (u, v), and its derivatives with respect to u and v."""
    height, width = flow.shape[2:]
    axes = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    sample = _sample_clamped(flow, torch.cat([axes[0] + u, axes[1] + v], dim=1).flatten(2))
    moved_u, moved_v = sample.value.unflatten(2, (height, width)).split(1, dim=1)
    return (u + moved_u, v + moved_v), Jacobian(*(value.view_as(u) for value in sample.jacobian))


def _sample_clamped(flow: Tensor, points: Tensor) -> LinearSample:
    """Sample a flow bilinearly at points (B, 2, N), px; beyond the border it is constant."""
    height, width = flow.shape[2:]
    size = points.new_tensor([[width - 1], [height - 1]])
    inner = points.maximum(torch.zeros_like(size)).minimum(size)
    sample = sample_linear(flow, inner)
    is_inner_x, is_inner_y = (inner == points).split(1, dim=1)
    return sample._replace(slope_x=sample.slope_x * is_inner_x, slope_y=sample.slope_y * is_inner_y)


def _sample_at(field: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> Tensor:
    """Sample a field (B, C, H, W) bilinearly at (x, y), in the coordinates of F.grid_sample, plus a shift in px."""
    height, width = field.shape[2:]
    u, v = shift.split(1, dim=1)
    grid = torch.cat([torch.add(x, u, alpha=2 / width), torch.add(y, v, alpha=2 / height)], dim=1).movedim(1, -1)
    return grid_sample(field, grid, padding="border", interpolation="bilinear")
