"""Sample images on a GPU along flows on lattices with one Triton kernel: bilinear, forward only, float32.

The kernel writes no grid of the size of the image. torch.compile sees it as one operator, because the code that it
would generate writes that grid or computes each position once for each channel.
"""

# Triton compiles a language that only looks like Python, so two rules of the type checker do not apply:
# pyright: reportGeneralTypeIssues=false, reportArgumentType=false

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # pyright: ignore[reportMissingImports]  # C++ without stubs
from torch.autograd import forward_ad
from torch.library import triton_op, wrap_triton

_ROWS, _COLUMNS = 16, 128  # pixels of one program
_LARGEST_PLANE = 2**31 - 1  # elements of an image, which the kernel counts in int32
_LARGEST_GRID = 65535  # along the batch, and along the rows
_PADDINGS = {"zeros": 0, "border": 1, "reflection": 2}


def why_unsupported(image: Tensor, nodes: Tensor) -> str | None:
    """Say why the kernel cannot sample an image (N, C, H, W) along a flow on a lattice; None if it can."""
    if image[:1].numel() > _LARGEST_PLANE or max(image.shape[0], image.shape[2]) > _LARGEST_GRID:
        return f"an image of shape {tuple(image.shape)}"
    if torch.compiler.is_compiling():
        # While a graph is traced, only this flag tells an export, which has no such operator, from a compilation.
        return "an export" if getattr(torch.compiler, "_is_exporting_flag", False) else None
    if torch.jit.is_tracing():
        return "a trace"
    if any(forward_ad.unpack_dual(value).tangent is not None for value in (image, nodes)):
        return "forward-mode gradients"
    return "a tensor inside torch.func" if any(map(is_functorch_wrapped_tensor, (image, nodes))) else None


def sample_lattice(
    image: Tensor,
    nodes: Tensor,
    weights: Tensor,
    *,
    margin: int,
    padding: str,
    limit: float,
    active: Tensor | None = None,
) -> Tensor:
    """Sample an image along a flow at the nodes of a lattice, with cubics between them.

    Args:
        image: (N, C, H, W), float32, of any layout.
        nodes: (N or 1, 2, h, w), px, float32, finite, every `stride` px.
        weights: (stride, 4), of the nodes around a pixel by its position in its cell.
        margin: nodes before the first pixel, at least 1.
        padding: "zeros", "border" or "reflection".
        limit: unused, since the nodes are finite.
        active: (N,), bool, samples to warp; the others are copied. None for all.

    Returns:
        (N, C, H, W), float32, of the layout of the image.
    """
    if len(nodes) > 1 and nodes.stride(0) == 0:  # one flow for the frames of a clip
        nodes = nodes[:1]
    nodes = nodes[..., margin - 1 :, margin - 1 :].contiguous()
    mask = None if active is None else active.to(torch.uint8)
    return torch.ops.torchrefract.sample_lattice(image, nodes, weights.contiguous(), mask, _PADDINGS[padding])


@triton.jit
def sample_lattice_kernel(
    source,
    out,
    nodes,
    weights,
    active,
    height,
    width,
    stride,
    node_columns,
    batch_step,
    channel_step,
    row_step,
    column_step,
    nodes_step,
    axis_step,
    channels: tl.constexpr,
    has_active: tl.constexpr,
    padding: tl.constexpr,
    rows: tl.constexpr,
    columns: tl.constexpr,
):
    """Sample a source (N, C, H, W) along a flow at nodes, for a block of rows within one row of cells.

        u = sum_i w_i(t_y) sum_j w_j(t_x) nodes_u(cell_y + i, cell_x + j),  v likewise

    Each thread samples a pixel of each row: neighbors read neighbors, and the nodes of a column are read once.

    Args:
        source, out: of these steps, in elements.
        nodes: (N or 1, 2, h, node_columns), of which the first is one node before the first pixel.
        weights: (stride, 4), by the position in a cell.
        active: (N,), zero or not, if `has_active`; inactive samples are copied.
        height, width: px.
        stride: px, between nodes.
        node_columns: nodes in a row.
        batch_step, channel_step, row_step, column_step: of source and out, in elements.
        nodes_step: from the nodes of a sample to those of the next one, 0 if all samples share them.
        axis_step: from the nodes of u to those of v.
        channels: of the source.
        padding: 0 for zeros, 1 for border, 2 for reflection.
        rows, columns: px, of one program.
    """
    sample = tl.program_id(2).to(tl.int64)
    x = tl.program_id(0) * columns + tl.arange(0, columns)
    inside = x < width
    moved = inside
    if has_active:
        moved = inside & (tl.zeros((columns,), tl.int32) + tl.load(active + sample) != 0)
    parts = tl.cdiv(stride, rows)
    cell, start = tl.program_id(1) // parts, tl.program_id(1) % parts * rows
    stop = tl.minimum(tl.minimum(start + rows, stride), height - cell * stride)
    corner = nodes + sample * nodes_step + cell * node_columns + x // stride
    # The compiler never merges loads, so each is written once.
    along = ()
    for tap in tl.static_range(4):
        along = along + (tl.load(weights + x % stride * 4 + tap, inside, 0.0),)  # noqa: RUF005 - Triton cannot unpack
    lines_u, lines_v = (), ()
    for line in tl.static_range(4):
        u = tl.zeros((columns,), tl.float32)
        v = tl.zeros((columns,), tl.float32)
        for tap in tl.static_range(4):
            node = corner + line * node_columns + tap
            u += along[tap] * tl.load(node, inside, 0.0)
            v += along[tap] * tl.load(node + axis_step, inside, 0.0)
        lines_u = lines_u + (u,)  # noqa: RUF005
        lines_v = lines_v + (v,)  # noqa: RUF005

    for phase in range(start, stop):
        y = cell * stride + phase
        u = tl.zeros((columns,), tl.float32)
        v = tl.zeros((columns,), tl.float32)
        for tap in tl.static_range(4):
            weight = tl.load(weights + phase * 4 + tap)
            u += weight * lines_u[tap]
            v += weight * lines_v[tap]
        to_x, to_y = _pad(x + u, width, padding), _pad(y + v, height, padding)
        if has_active:
            to_x = tl.where(moved, to_x, x.to(tl.float32))
            to_y = tl.where(moved, to_y, y.to(tl.float32))

        left, top = tl.floor(to_x), tl.floor(to_y)
        shares = (to_x - left, to_y - top)
        column, row = left.to(tl.int32), top.to(tl.int32)
        on_left, on_right = (column >= 0) & (column < width), (column >= -1) & (column < width - 1) & moved
        on_top, on_bottom = (row >= 0) & (row < height) & inside, (row >= -1) & (row < height - 1) & moved
        masks = (on_top & on_left, on_top & on_right, on_bottom & on_left, on_bottom & on_right)
        first, target = row * row_step + column * column_step, y * row_step + x * column_step
        base = sample * batch_step
        if channels <= 4:
            for _ in tl.static_range(channels):
                value = _bilinear(source + base, first, row_step, column_step, masks, shares, moved, has_active)
                tl.store(out + base + target, value, inside)
                base += channel_step
        else:
            for _ in range(channels):
                value = _bilinear(source + base, first, row_step, column_step, masks, shares, moved, has_active)
                tl.store(out + base + target, value, inside)
                base += channel_step


@triton.jit
def _bilinear(plane, first, row_step, column_step, masks, shares, moved, has_active: tl.constexpr):
    """Sum four weighted pixels of a plane, the upper left one at `first`; return that one alone if nothing moves."""
    right, lower = shares
    upper_left = tl.load(plane + first, masks[0], 0.0)
    value = upper_left * ((1.0 - right) * (1.0 - lower))
    value += tl.load(plane + column_step + first, masks[1], 0.0) * (right * (1.0 - lower))
    value += tl.load(plane + row_step + first, masks[2], 0.0) * ((1.0 - right) * lower)
    value += tl.load(plane + (row_step + column_step) + first, masks[3], 0.0) * (right * lower)
    return tl.where(moved, value, upper_left) if has_active else value


@triton.jit
def _pad(position, size, padding: tl.constexpr):
    """Bring positions along an axis of `size` px to finite ones, or onto the frame by the padding."""
    position = tl.minimum(tl.maximum(position, -1e7), 1e7)
    if padding == 2:
        position = tl.abs(position + 0.5)
        turns = tl.floor(position / size)
        rest = position - turns * size
        position = tl.where((turns.to(tl.int32) % 2) == 1, size - rest, rest) - 0.5
    if padding != 0:
        position = tl.minimum(tl.maximum(position, 0.0), size - 1.0)
    return position


@triton_op("torchrefract::sample_lattice", mutates_args={})
def _sample_lattice(source: Tensor, nodes: Tensor, weights: Tensor, active: Tensor | None, padding: int) -> Tensor:
    out = torch.empty_like(source)
    batch, channels, height, width = source.shape
    stride = weights.shape[0]
    cells, parts = -(-height // stride), -(-stride // _ROWS)
    wrap_triton(sample_lattice_kernel)[(-(-width // _COLUMNS), cells * parts, batch)](
        source,
        out,
        nodes,
        weights,
        weights if active is None else active,
        height,
        width,
        stride,
        nodes.shape[3],
        *source.stride(),
        nodes.stride(0) if len(nodes) > 1 else 0,
        nodes.stride(1),
        channels=channels,
        has_active=active is not None,
        padding=padding,
        rows=_ROWS,
        columns=_COLUMNS,
        num_warps=_COLUMNS // 32,
    )
    return out
