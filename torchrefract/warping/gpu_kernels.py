"""What Triton compiles: a look-up along a flow on a lattice, for which no grid of the frame's size is written."""

import triton
import triton.language as tl


@triton.jit
def look_up_lines(
    source,
    out,
    lines,
    weight,
    axis_x,
    axis_y,
    active,
    height,
    width,
    nodes,
    stride,
    batch_step,
    channel_step,
    row_step,
    column_step,
    lines_step,
    channels: tl.constexpr,
    taps: tl.constexpr,
    whole: tl.constexpr,
    gated: tl.constexpr,
    padding: tl.constexpr,
    rows: tl.constexpr,
    columns: tl.constexpr,
):
    """The source (B, C, H, W) where lines of nodes lead, with what lies outside by its padding.

        x' = sum_j w_x(t, j) X(i + j) [+ axis_x],  y' likewise,  t and i the place of a row in its cell and that cell

    A program looks up some rows of a cell, each thread a pixel of each: neighbors read neighbors, and what nodes there
    are of a column is read once.

    Args:
        source, out: of these steps, in elements.
        lines: (B or 1, 2, nodes, W), where F.grid_sample(align_corners=False) looks, in the rows of nodes.
        weight: (2, stride, taps), of x and of y.
        axis_x, axis_y: (W,) and (H,), what is to be added between the rows, unless the lines are `whole`.
        active: (B,), zero or not, if `gated`: the other samples come back as they are.
        height, width: of the source.
        nodes: rows of them.
        stride: px, between them.
        batch_step, channel_step, row_step, column_step: from one to the next in source and out.
        lines_step: from a sample's lines to the next one's, 0 where all have the same.
        channels: of the source.
        padding: 0 for zeros, 1 for border, 2 for reflection.
        rows, columns: of pixels that one program looks up.
    """
    sample = tl.program_id(2).to(tl.int64)
    x = tl.program_id(0) * columns + tl.arange(0, columns)
    inside = x < width
    moved = inside
    if gated:
        moved = inside & (tl.zeros((columns,), tl.int32) + tl.load(active + sample) != 0)
    parts = tl.cdiv(stride, rows)
    cell, place = tl.program_id(1) // parts, tl.program_id(1) % parts * rows
    at = lines + sample * lines_step + cell * width + x
    last = tl.minimum(tl.minimum(place + rows, stride), height - cell * stride)
    known_x, known_y = (), ()
    for tap in tl.static_range(taps):
        known_x = known_x + (tl.load(at + tap * width, inside, 0.0),)
        known_y = known_y + (tl.load(at + (nodes + tap) * width, inside, 0.0),)
    if not whole:
        add_x = tl.load(axis_x + x, inside, 0.0)

    for place in range(place, last):
        y = cell * stride + place
        by = weight + place * taps
        to_x = tl.zeros((columns,), tl.float32)
        to_y = tl.zeros((columns,), tl.float32)
        for tap in tl.static_range(taps):
            to_x += tl.load(by + tap) * known_x[tap]
            to_y += tl.load(by + stride * taps + tap) * known_y[tap]
        if not whole:
            to_x += add_x
            to_y += tl.load(axis_y + y)
        to_x = _padded(((to_x + 1.0) * width - 1.0) * 0.5, width, padding)
        to_y = _padded(((to_y + 1.0) * height - 1.0) * 0.5, height, padding)
        if gated:
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
                value = _mixed(source + base, first, row_step, column_step, hits, shares, moved, gated)
                tl.store(out + base + own, value, inside)
                base += channel_step
        else:
            for _ in range(channels):
                value = _mixed(source + base, first, row_step, column_step, hits, shares, moved, gated)
                tl.store(out + base + own, value, inside)
                base += channel_step


@triton.jit
def _mixed(plane, first, row_step, column_step, hits, shares, moved, gated: tl.constexpr):
    """What four pixels of a plane amount to, of which `first` is the upper left; it alone, if nothing is moved."""
    right, lower = shares
    upper_left = tl.load(plane + first, hits[0], 0.0)
    value = upper_left * ((1.0 - right) * (1.0 - lower))
    value += tl.load(plane + column_step + first, hits[1], 0.0) * (right * (1.0 - lower))
    value += tl.load(plane + row_step + first, hits[2], 0.0) * ((1.0 - right) * lower)
    value += tl.load(plane + (row_step + column_step) + first, hits[3], 0.0) * (right * lower)
    return tl.where(moved, value, upper_left) if gated else value


@triton.jit
def _padded(place, size, padding: tl.constexpr):
    """Where a place, px, is read along an axis of so many pixels."""
    if padding == 2:
        place = tl.abs(place + 0.5)
        turns = tl.floor(place / size)
        rest = place - turns * size
        odd = (turns.to(tl.int32) % 2) == 1
        place = tl.where(odd, size - rest, rest) - 0.5
    if padding != 0:
        place = tl.minimum(tl.maximum(place, 0.0), size - 1.0)
    return place
