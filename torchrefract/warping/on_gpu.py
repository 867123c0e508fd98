"""Looking an image up on a GPU along a flow on a lattice: positions and look-up in one pass, by a kernel of Triton."""

import importlib
from typing import Any, cast

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # pyright: ignore[reportMissingImports]  # of C++
from torch.autograd import forward_ad

from torchrefract._constants import assume_constant_result
from torchrefract.warping.grid_sample import PADDINGS, gradients_by_grid_sample
from torchrefract.warping.lattice import Lines, SmoothFlow, gradient_of_lines

ROWS, COLUMNS = 16, 128  # of pixels that one program looks up
_LARGEST_PLANE = 2**31 - 1  # elements that the kernel counts within a channel
_MOST_PROGRAMS = 65535  # along the batch, and along the rows


def serves(image: Tensor, flow: Any, dtype: torch.dtype) -> bool:
    """Whether the kernel can look an image (B, C, H, W) up along a flow, bilinear, at positions of a type."""
    if image.device.type != "cuda" or not isinstance(flow, SmoothFlow) or dtype is not torch.float32:
        return False
    batch, height = image.shape[0], image.shape[2]
    # A channel of any layout lies within so many elements.
    if image[:1].numel() > _LARGEST_PLANE or max(batch, height) > _MOST_PROGRAMS:
        return False
    return flow.dtype is torch.float32 and _open(image, flow.nodes) and _is_there()


def looked_up(source: Tensor, flow: SmoothFlow, *, padding: str, active: Tensor | None = None) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W), bilinear, where the kernel `serves`.

    active: (B,), bool: the other samples come back as they are; None is all.
    """
    shared = len(flow.nodes) > 1 and flow.nodes.stride(0) == 0  # as those of the frames of a clip
    lines = (flow.with_nodes(flow.nodes[:1]) if shared else flow).lines(source.dtype)
    values, weight = lines.values.contiguous(), lines.weight.contiguous()
    gates = None if active is None else active.to(torch.uint8)
    arguments = values, weight, lines.x, lines.y, gates, PADDINGS.index(padding)
    return torch.ops.torchrefract.look_up_lines(source, *arguments)


def _open(*values: Tensor) -> bool:
    """Whether the numbers of tensors are there for a kernel."""
    if torch.compiler.is_compiling():
        # What this flag says `is_exporting` says of every graph while it is traced.
        return not getattr(torch.compiler, "_is_exporting_flag", False)
    if torch.jit.is_tracing():
        return False
    return not any(
        forward_ad.unpack_dual(value).tangent is not None or is_functorch_wrapped_tensor(value) for value in values
    )


@assume_constant_result
def _is_there() -> bool:
    """Whether Triton is, and its kernels with it."""
    try:
        importlib.import_module("torchrefract.warping.gpu_kernels")
    except ImportError:
        return False
    return True


# Compilers see into this operator: theirs writes a grid, or finds each position once for each channel.
@torch.library.triton_op("torchrefract::look_up_lines", mutates_args={})
def _look_up_lines(
    source: Tensor,
    lines: Tensor,
    weight: Tensor,
    x: Tensor | None,
    y: Tensor | None,
    active: Tensor | None,
    padding: int,
) -> Tensor:
    kernel = importlib.import_module("torchrefract.warping.gpu_kernels").look_up_lines
    return filled(torch.library.wrap_triton(kernel), source, lines, weight, x, y, active, padding)


def filled(
    kernel: Any,
    source: Tensor,
    lines: Tensor,
    weight: Tensor,
    x: Tensor | None,
    y: Tensor | None,
    active: Tensor | None,
    padding: int,
) -> Tensor:
    """What the kernel finds; `gpu_kernels` says what it is told."""
    out = torch.empty_like(source)
    batch, channels, height, width = source.shape
    whole, gated = x is None, active is not None
    stride = weight.shape[1]
    cells, parts = -(-height // stride), -(-stride // ROWS)
    kernel[(-(-width // COLUMNS), cells * parts, batch)](
        source,
        out,
        lines,
        weight,
        lines if x is None else x,
        lines if y is None else y,
        lines if active is None else active,
        height,
        width,
        lines.shape[2],
        stride,
        *source.stride(),
        lines.stride(0) if len(lines) > 1 else 0,
        channels=channels,
        taps=weight.shape[2],
        whole=whole,
        gated=gated,
        padding=padding,
        rows=ROWS,
        columns=COLUMNS,
        num_warps=COLUMNS // 32,
    )
    return out


def _keep(ctx: Any, inputs: Any, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:-1])
    ctx.padding = PADDINGS[inputs[-1]]


def _gradients(ctx: Any, gradient: Tensor) -> Any:
    source, lines, weight, x, y, active = ctx.saved_tensors
    grid = Lines(lines, weight, source.shape[2], x, y).grid().expand(len(source), -1, -1, -1)
    acts = None if active is None else active.bool().view(-1, 1, 1, 1)
    upstream = gradient if acts is None else torch.where(acts, gradient, 0.0)
    of_source, of_grid = gradients_by_grid_sample(
        source, grid, upstream, needed=tuple(ctx.needs_input_grad[:2]), padding=ctx.padding
    )
    if of_source is not None and acts is not None:
        of_source = torch.where(acts, of_source, gradient)
    of_lines = None
    if of_grid is not None:
        of_lines = gradient_of_lines(of_grid.movedim(-1, 1), weight, lines.shape[2])
        of_lines = of_lines.sum(dim=0, keepdim=True) if len(lines) < len(of_lines) else of_lines
    return of_source, of_lines, None, None, None, None, None


cast(Any, _look_up_lines).register_autograd(_gradients, setup_context=_keep)
