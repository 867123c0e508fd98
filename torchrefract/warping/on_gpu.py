"""Looking an image up on a GPU along a flow on a lattice: positions and look-up in one pass, by a kernel of Triton."""

from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._constants import constant
from torchrefract._products import product
from torchrefract._triton import launched, reads
from torchrefract.warping.grid import finite, pixel_axes, sampler_positions
from torchrefract.warping.grid_sample import PADDINGS, gradients_by_grid_sample
from torchrefract.warping.lattice import FARTHEST, SmoothFlow
from torchrefract.warping.sums import matrix_of

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
    return flow.dtype is torch.float32 and reads(image, flow.nodes)


def looked_up(source: Tensor, flow: SmoothFlow, *, padding: str, active: Tensor | None = None) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W), bilinear, where the kernel `serves`.

    active: (B,), bool: the other samples come back as they are; None is all.
    """
    shared = len(flow.nodes) > 1 and flow.nodes.stride(0) == 0  # as those of the frames of a clip
    nodes = (flow.nodes[:1] if shared else flow.nodes).to(source.dtype).contiguous()
    across, down = (weight.contiguous() for weight in flow.weights())
    gates = None if active is None else active.to(torch.uint8)
    return torch.ops.torchrefract.look_up_lattice(source, nodes, across, down, gates, PADDINGS.index(padding))


# Compilers see into this operator: theirs writes a grid, or finds each position once for each channel.
@torch.library.triton_op("torchrefract::look_up_lattice", mutates_args={})
def _look_up_lattice(
    source: Tensor, nodes: Tensor, across: Tensor, down: Tensor, active: Tensor | None, padding: int
) -> Tensor:
    kernel = launched("warping.gpu_kernels", "look_up_lattice")
    return filled(kernel, source, nodes, across, down, active, padding)


def filled(
    kernel: Any, source: Tensor, nodes: Tensor, across: Tensor, down: Tensor, active: Tensor | None, padding: int
) -> Tensor:
    """What the kernel finds; `gpu_kernels` says what it is told."""
    out = torch.empty_like(source)
    batch, channels, height, width = source.shape
    _, stride, taps = across.shape
    cells, parts = -(-height // stride), -(-stride // ROWS)
    kernel[(-(-width // COLUMNS), cells * parts, batch)](
        source,
        out,
        nodes,
        across,
        down,
        down if active is None else active,
        height,
        width,
        stride,
        *nodes.shape[2:],
        *source.stride(),
        nodes.stride(0) if len(nodes) > 1 else 0,
        nodes.stride(1),
        channels=channels,
        taps=taps,
        shared=nodes.shape[1] == 1,
        gated=active is not None,
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
    source, nodes, across, down, active = ctx.saved_tensors
    height, width = source.shape[2:]
    over, under = matrix_of(across, nodes.shape[3], width), matrix_of(down, nodes.shape[2], height)
    flow = product(product(under, nodes), over.mT)
    axes = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    positions = finite(sampler_positions(flow, *axes, height=height, width=width), FARTHEST)
    grid = positions.movedim(1, -1).expand(len(source), -1, -1, -1)
    acts = None if active is None else active.bool().view(-1, 1, 1, 1)
    upstream = gradient if acts is None else torch.where(acts, gradient, 0.0)
    needed = ctx.needs_input_grad[:2]
    of_source, of_grid = gradients_by_grid_sample(source, grid, upstream, needed=needed, padding=ctx.padding)
    if of_source is not None and acts is not None:
        of_source = torch.where(acts, of_source, gradient)
    of_nodes = None
    if of_grid is not None:
        scale = constant([2 / width, 2 / height], dtype=of_grid.dtype, device=of_grid.device).view(2, 1, 1)
        of_flow = of_grid.movedim(-1, 1) * scale
        of_nodes = product(product(under.mT, of_flow), over)
        of_nodes = of_nodes.sum(dim=0, keepdim=True) if len(nodes) < len(of_nodes) else of_nodes
        of_nodes = of_nodes.sum(dim=1, keepdim=True) if nodes.shape[1] < 2 else of_nodes
    return of_source, of_nodes, None, None, None, None


cast(Any, _look_up_lattice).register_autograd(_gradients, setup_context=_keep)
