"""A look-up along a flow on a lattice as one kernel of Triton: no grid of the frame's size is written."""

# Triton has a language of its own, which only looks like Python, so types are checked but for these two rules:
# pyright: reportGeneralTypeIssues=false, reportArgumentType=false

from typing import Any, cast

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from torchrefract._tensor import as_device_tensor, exact_matmul
from torchrefract.warping.grid import finite, pixel_axes, sampler_positions
from torchrefract.warping.grid_sample import PADDINGS, gradients_by_grid_sample
from torchrefract.warping.lattice import FARTHEST
from torchrefract.warping.sums import matrix_of

_ROWS, _COLUMNS = 16, 128  # of pixels that one program looks up


@triton.jit
def look_up_lattice(
    source,
    out,
    nodes,
    across,
    down,
    active,
    height,
    width,
    stride,
    node_rows,
    node_columns,
    batch_step,
    channel_step,
    row_step,
    column_step,
    nodes_step,
    other_step,
    channels: tl.constexpr,
    taps: tl.constexpr,
    shared: tl.constexpr,
    masked_flow: tl.constexpr,
    padding: tl.constexpr,
    rows: tl.constexpr,
    columns: tl.constexpr,
):
    """The source (B, C, H, W) where a flow leads that is known at nodes, with what lies outside by its padding.

        u = sum_i down_u(t_y, i) sum_j across_u(t_x, j) nodes_u(cell_y + i, cell_x + j),  v likewise

    A program looks up some rows of a cell, each thread a pixel of each: neighbors read neighbors, and the nodes of a
    column are read once.

    Args:
        source, out: of these steps, in elements.
        nodes: (B or 1, 2, node_rows, node_columns), of u and v, or (B or 1, 1, ...) if one is `shared` by both.
        across, down: (2, stride, taps), by the place in a cell.
        active: (B,), zero or not, if `gated`: the other samples come back as they are.
        height, width: of the source.
        stride: px, between nodes.
        node_rows, node_columns: how many there are.
        batch_step, channel_step, row_step, column_step: from one to the next in source and out.
        nodes_step: from a sample's nodes to the next one's, 0 where all have the same.
        other_step: from the nodes of u to those of v.
        channels: of the source.
        padding: 0 for zeros, 1 for border, 2 for reflection.
        rows, columns: of pixels that one program looks up.
    """
    sample = tl.program_id(2).to(tl.int64)
    x = tl.program_id(0) * columns + tl.arange(0, columns)
    inside = x < width
    moved = inside
    if masked_flow:
        moved = inside & (tl.zeros((columns,), tl.int32) + tl.load(active + sample) != 0)
    parts = tl.cdiv(stride, rows)
    cell, place = tl.program_id(1) // parts, tl.program_id(1) % parts * rows
    last = tl.minimum(tl.minimum(place + rows, stride), height - cell * stride)
    at = nodes + sample * nodes_step + cell * node_columns + x // stride
    by = across + x % stride * taps
    # Loads are never shared by the compiler: each is written once.
    over_u, over_v = (), ()
    for tap in tl.static_range(taps):
        over_u = over_u + (tl.load(by + tap, inside, 0.0),)  # noqa: RUF005 - Triton knows no unpacking
        over_v = over_v + (tl.load(by + stride * taps + tap, inside, 0.0),)  # noqa: RUF005 - Triton knows no unpacking
    known_u, known_v = (), ()
    for line in tl.static_range(taps):
        u = tl.zeros((columns,), tl.float32)
        v = tl.zeros((columns,), tl.float32)
        for tap in tl.static_range(taps):
            node = at + line * node_columns + tap
            first_node = tl.load(node, inside, 0.0)
            u += over_u[tap] * first_node
            v += over_v[tap] * (first_node if shared else tl.load(node + other_step, inside, 0.0))
        known_u = known_u + (u,)  # noqa: RUF005 - Triton knows no unpacking
        known_v = known_v + (v,)  # noqa: RUF005 - Triton knows no unpacking

    for own_row in range(place, last):
        y = cell * stride + own_row
        weight = down + own_row * taps
        u = tl.zeros((columns,), tl.float32)
        v = tl.zeros((columns,), tl.float32)
        for tap in tl.static_range(taps):
            u += tl.load(weight + tap) * known_u[tap]
            v += tl.load(weight + stride * taps + tap) * known_v[tap]
        to_x, to_y = _padded(x + u, width, padding), _padded(y + v, height, padding)
        if masked_flow:
            to_x = tl.where(moved, to_x, x.to(tl.float32))
            to_y = tl.where(moved, to_y, y.to(tl.float32))

        left, top = tl.floor(to_x), tl.floor(to_y)
        shares = (to_x - left, to_y - top)
        column, row = left.to(tl.int32), top.to(tl.int32)
        on_left, on_right = (column >= 0) & (column < width), (column >= -1) & (column < width - 1) & moved
        on_top, below = (row >= 0) & (row < height) & inside, (row >= -1) & (row < height - 1) & moved
        hits = (on_top & on_left, on_top & on_right, below & on_left, below & on_right)
        first, own = row * row_step + column * column_step, y * row_step + x * column_step
        base = sample * batch_step
        if channels <= 4:
            for _ in tl.static_range(channels):
                value = _mixed(source + base, first, row_step, column_step, hits, shares, moved, masked_flow)
                tl.store(out + base + own, value, inside)
                base += channel_step
        else:
            for _ in range(channels):
                value = _mixed(source + base, first, row_step, column_step, hits, shares, moved, masked_flow)
                tl.store(out + base + own, value, inside)
                base += channel_step


@triton.jit
def _mixed(plane, first, row_step, column_step, hits, shares, moved, masked_flow: tl.constexpr):
    """What four pixels of a plane amount to, of which `first` is the upper left; it alone, if nothing is moved."""
    right, lower = shares
    upper_left = tl.load(plane + first, hits[0], 0.0)
    value = upper_left * ((1.0 - right) * (1.0 - lower))
    value += tl.load(plane + column_step + first, hits[1], 0.0) * (right * (1.0 - lower))
    value += tl.load(plane + row_step + first, hits[2], 0.0) * ((1.0 - right) * lower)
    value += tl.load(plane + (row_step + column_step) + first, hits[3], 0.0) * (right * lower)
    return tl.where(moved, value, upper_left) if masked_flow else value


@triton.jit
def _padded(place, size, padding: tl.constexpr):
    """Where a place, px, is read along an axis of so many pixels, finite."""
    place = tl.minimum(tl.maximum(place, -1e7), 1e7)
    if padding == 2:
        place = tl.abs(place + 0.5)
        turns = tl.floor(place / size)
        rest = place - turns * size
        place = tl.where((turns.to(tl.int32) % 2) == 1, size - rest, rest) - 0.5
    if padding != 0:
        place = tl.minimum(tl.maximum(place, 0.0), size - 1.0)
    return place


# Compilers see into this operator: theirs writes a grid, or finds each position once for each channel.
@triton_op("torchrefract::look_up_lattice", mutates_args={})
def _look_up_lattice(
    source: Tensor, nodes: Tensor, across: Tensor, down: Tensor, active: Tensor | None, padding: int
) -> Tensor:
    out = torch.empty_like(source)
    batch, channels, height, width = source.shape
    _, stride, taps = across.shape
    cells, parts = -(-height // stride), -(-stride // _ROWS)
    wrap_triton(look_up_lattice)[(-(-width // _COLUMNS), cells * parts, batch)](
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
        masked_flow=active is not None,
        padding=padding,
        rows=_ROWS,
        columns=_COLUMNS,
        num_warps=_COLUMNS // 32,
    )
    return out


def _keep(ctx: Any, inputs: Any, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:-1])
    ctx.padding = PADDINGS[inputs[-1]]


def _gradients(ctx: Any, gradient: Tensor) -> Any:
    source, nodes, across, down, active = ctx.saved_tensors
    height, width = source.shape[2:]
    over, under = matrix_of(across, nodes.shape[3], width), matrix_of(down, nodes.shape[2], height)
    flow = exact_matmul(exact_matmul(under, nodes), over.mT)
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
        scale = as_device_tensor([2 / width, 2 / height], dtype=of_grid.dtype, device=of_grid.device).view(2, 1, 1)
        of_flow = of_grid.movedim(-1, 1) * scale
        of_nodes = exact_matmul(exact_matmul(under.mT, of_flow), over)
        of_nodes = of_nodes.sum(dim=0, keepdim=True) if len(nodes) < len(of_nodes) else of_nodes
        of_nodes = of_nodes.sum(dim=1, keepdim=True) if nodes.shape[1] < 2 else of_nodes
    return of_source, of_nodes, None, None, None, None


cast(Any, _look_up_lattice).register_autograd(_gradients, setup_context=_keep)
