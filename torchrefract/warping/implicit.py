"""Derivatives of solutions of equations by the implicit function theorem, in all modes and of any order.

The derivative of a solution x of F(x, inputs) = 0 is dx = -(dF/dx)^-1 (dF/dinputs) dinputs. It is the same for any
solver, so solvers run without gradient, and `implicit` attaches the derivative to what they return.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract._validation import requires_grad
from torchrefract.warping.flow import Jacobian
from torchrefract.warping.grid import Points, pixel_axes
from torchrefract.warping.lattice import pixel_lattice
from torchrefract.warping.warp import sample_image

_SMALLEST_DETERMINANT = 1e-6
# Outside the frame the flow continues along its secant over this many border pixels: the slope of one pixel is noise.
_SECANT_PX = 16

Solution = tuple[Tensor, ...]


class Slope(NamedTuple):
    """Hold the derivative of a function of one variable; a Jacobian with one entry."""

    value: Tensor


Equation = Callable[..., tuple[Solution, Jacobian | Slope]]


class _Implicit(torch.autograd.Function):
    """Return the solution, with derivatives of any order in reverse and forward mode.

    The outputs are saved, so the derivative is itself a differentiable function of the solution.
    """

    @staticmethod
    def forward(equation: Equation, count: int, *values: Tensor) -> Solution:
        return tuple(value.clone() for value in values[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.equation, ctx.count, *values = inputs
        saved = (*output, *values[ctx.count :])
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> Any:
        solution, inputs = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]

        def error(*inputs: Tensor) -> tuple[Solution, Jacobian | Slope]:
            return ctx.equation(*solution, *inputs)

        _, pull_back, jacobian = cast(Any, torch.func.vjp(error, *inputs, has_aux=True))
        weights = _solve(jacobian, gradient, is_transposed=True)
        return None, None, *[None] * ctx.count, *(-value for value in pull_back(weights))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        saved = [forward_ad.unpack_dual(value).primal for value in ctx.saved_tensors]
        solution, inputs = saved[: ctx.count], saved[ctx.count :]
        moved = [
            torch.zeros_like(value) if tangent is None else tangent
            for value, tangent in zip(inputs, tangents[2 + ctx.count :], strict=True)
        ]

        def pull_back(*weights: Tensor) -> Any:
            return torch.func.vjp(lambda *inputs: ctx.equation(*solution, *inputs)[0], *inputs)[1](weights)

        # PyTorch turns the forward mode off in this function, also that of outer levels of torch.func, which would drop
        # second derivatives. torch.autograd.forward_ad has one level only.
        with forward_ad._set_fwd_grad_enabled(torch._C._are_functorch_transforms_active()):
            jacobian = ctx.equation(*solution, *inputs)[1]
            # Pulling back is linear, and its transpose pushes tangents forward. torch.func.jvp cannot be nested in
            # torch.autograd.forward_ad.
            push_forward = torch.func.vjp(pull_back, *(torch.zeros_like(value) for value in solution))[1]
            return tuple(-value for value in _solve(jacobian, push_forward(tuple(moved))))

    @staticmethod
    def vmap(info: Any, in_dims: Any, *arguments: Any) -> Any:
        equation, count, *values = arguments
        dims = [dim if i >= count or dim is not None else 0 for i, dim in enumerate(in_dims[2:])]
        values = [
            value.expand(info.batch_size, *value.shape) if in_dims[2 + i] is None and i < count else value
            for i, value in enumerate(values)
        ]
        values = [value if dim is None else value.movedim(dim, 0) for value, dim in zip(values, dims, strict=True)]
        batched = torch.func.vmap(equation, in_dims=tuple(None if dim is None else 0 for dim in dims))
        return _Implicit.apply(batched, count, *values), (0,) * count


def implicit(solution: Solution, inputs: Sequence[Tensor], equation: Equation) -> Solution:
    """Attach the derivatives of the exact solution of an equation to a solution that was computed without them.

    Args:
        solution: one or two unknowns, detached, of equal shape.
        inputs: the tensors that the equation depends on.
        equation: maps (*solution, *inputs) to the error of each unknown, zero at the solution, and its derivatives with
            respect to the unknowns. Uses no other tensor.

    Returns:
        The same values, differentiable in the inputs: in reverse and forward mode, in torch.func, in any order; up to
        the third order inside torch.compile.
    """
    if not torch.compiler.is_compiling():
        return _Implicit.apply(equation, len(solution), *solution, *inputs)  # pyright: ignore[reportReturnType]
    # Newton steps of length zero. Each doubles the number of right terms of the Taylor series: 2, then 4.
    for _ in range(2):
        errors, jacobian = equation(*solution, *inputs)
        steps = _solve(jacobian, errors)
        solution = tuple(value - (step - step.detach()) for value, step in zip(solution, steps, strict=True))
    return solution


def _solve(jacobian: Jacobian | Slope, right: Sequence[Tensor], *, is_transposed: bool = False) -> Solution:
    """Return J^-1 times the right side, with |det J| of at least 1e-6."""
    if isinstance(jacobian, Slope):
        return (right[0] / _bounded(jacobian.value),)
    (xx, xy, yx, yy), determinant = jacobian, _bounded(jacobian.determinant)
    if is_transposed:
        xy, yx = yx, xy
    a, b = right
    return (yy * a - xy * b) / determinant, (xx * b - yx * a) / determinant


def _bounded(value: Tensor) -> Tensor:
    return torch.where(value.abs() >= _SMALLEST_DETERMINANT, value, _SMALLEST_DETERMINANT)


class LinearSample(NamedTuple):
    """Bilinear samples of a map and their derivatives, each (B, C, N)."""

    value: Tensor
    slope_x: Tensor
    slope_y: Tensor

    @property
    def jacobian(self) -> Jacobian:
        """Return I + slopes of a flow, entries (B, 1, N)."""
        x, y = self.slope_x, self.slope_y
        return Jacobian(1 + x[:, :1], y[:, :1], x[:, 1:2], 1 + y[:, 1:2])


def sample_linear(table: Tensor, points: Tensor) -> LinearSample:
    """Sample a map (B, C, H, W) bilinearly at the points (B, 2, N), beyond its border along its secant.

    Differentiable in any order, which F.grid_sample is not.
    """
    height, width = table.shape[2:]
    left, right, span_x = _interval(points[:, :1], width)
    top, bottom, span_y = _interval(points[:, 1:], height)
    tx, ty = (points[:, :1] - left) / span_x, (points[:, 1:] - top) / span_y
    flat = table.flatten(2)
    a, b, c, d = (
        flat.gather(2, (row * width + column).expand(-1, table.shape[1], -1))
        for row in (top, bottom)
        for column in (left, right)
    )
    upper, lower = a + tx * (b - a), c + tx * (d - c)
    value = upper + ty * (lower - upper)
    return LinearSample(value, ((b - a) + ty * ((d - c) - (b - a))) / span_x, (lower - upper) / span_y)


def sample_at(values: Tensor, points: Points) -> Tensor:
    """Sample maps of a frame bilinearly at points, and beyond their border at its nearest pixel.

    Args:
        values: (N, C, H, W), or (N, C, H, 1) if all pixels of a row are equal, which are extrapolated beyond the
            border; finite, so of a depth its inverse.
        points: in the same frame, of N rows or one.

    Returns:
        (N, C, h, w), or (N, C, h, 1) of rows at points of a lattice; differentiable in the values and the points in all
        modes.
    """
    lattice, is_rows = points.lattice, values.shape[3] == 1
    is_pixels = lattice == pixel_lattice(lattice.height, lattice.width)
    if is_pixels and not points.is_displaced:
        return values.expand(-1, -1, -1, lattice.width)
    if lattice.stride == 1 and not points.is_displaced and not is_rows:
        before, (rows, columns) = lattice.margin, lattice.num_nodes
        after = columns - before - lattice.width, rows - before - lattice.height
        return F.pad(values, (before, after[0], before, after[1]), mode="replicate")
    if is_rows:
        return _sample_rows(values, points.y.nan_to_num(nan=0.0).clamp(-lattice.height, 2 * lattice.height))
    if is_pixels and not requires_grad((values, points.x, points.y)):
        x, y = pixel_axes(lattice.height, lattice.width, dtype=points.x.dtype, device=points.x.device)
        flow = torch.cat(torch.broadcast_tensors(points.x - x, points.y - y), dim=1)
        return sample_image(values, flow, padding="border", interpolation="bilinear")
    x = points.x.nan_to_num(nan=0.0).clamp(0, lattice.width - 1)
    y = points.y.nan_to_num(nan=0.0).clamp(0, lattice.height - 1)
    positions = torch.cat(torch.broadcast_tensors(x, y), dim=1).expand(len(values), -1, -1, -1)
    return sample_linear(values, positions.flatten(2)).value.unflatten(2, positions.shape[2:])


def _sample_rows(values: Tensor, y: Tensor) -> Tensor:
    """Interpolate rows (N, C, H, 1) at y, (N or 1, 1, h, w), linearly, and extrapolate the first and the last two."""
    batch, channels, height, _ = values.shape
    if height == 1:
        return values + torch.zeros_like(y)
    row = y.detach().clamp(0, height - 2).long()
    index = row.expand(batch, channels, -1, -1).flatten(2)
    rows = values[..., 0]
    low, step = (table.gather(2, index).view(batch, channels, *y.shape[2:]) for table in (rows[:, :, :-1], rows.diff()))
    return torch.addcmul(low, step, y - row)


def _interval(position: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixels on both sides and their distance; outside the frame, those of the secant at its border."""
    outside = (position < 0) | (position > size - 1)
    span = torch.where(outside, min(_SECANT_PX, max(size - 1, 1)), 1)
    low = torch.minimum(position.floor().long().clamp(min=0), size - 1 - span).clamp(min=0)
    return low, (low + span).clamp(max=size - 1), span
