"""What numba compiles: where a row of pixels looks along a flow that earlier ones follow.

Their composite may be known every few px, by cubics between. Where a flow is read outside of the frame it is as at its
border, with a kink: there, and where fewer than four nodes are in a row, each pixel is followed by itself.

last: the lines of the last flow, (F, 2, n, W), which of them each pair has, (k,), their weights, and what is added to x
and to y, (W,) and (H,), as for `along_lattice`.
earlier: the flows before it, as for `follow_row`, with addresses (k, flows).
known: positions of the composite every `stride` px, (k, 2, n, m), of no row where it is known nowhere; between which of
each row of nodes it is smooth, (k, n, 2); weights, (4, stride).
"""

import numpy as np

from torchrefract._jit import floats_at, fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.across import GROUP, Across, along_every_second, nodes_across
from torchrefract.warping.kernels.following import Addresses, follow_one, follow_row, room_beside
from torchrefract.warping.kernels.pixels import Cells, Floats, Frame, Whole
from torchrefract.warping.kernels.places import along_lattice, room

if LANES:
    from torchrefract.warping.kernels.across_groups import both_along_nodes
else:
    from torchrefract.warping.kernels.across import both_along_nodes

Last = tuple[Floats, Whole, Floats, Floats, Floats]
Earlier = tuple[Addresses, Whole, Floats, Frame]
Known = tuple[Floats, Whole, Floats]
_SIDES = 16  # px, so many at a time are followed by themselves, with registers of any size
Room = tuple[Across, Floats, Floats, Cells, Floats]


@jit
def compose(last: Last, earlier: Earlier, every: int, start: int, stop: int, out: Floats, spans: Whole) -> None:
    """Rows of nodes every so many px, out (k, 2, n, m), and between which of them all flows are smooth, (k, n, 2).

    last: with lines (F, 2, n, m), at the columns of nodes.
    """
    lines, flows, weight, base_x, base_y = last
    addresses, table, far, frame = earlier
    rows, columns = out.shape[2:]
    cells, more = room(), room_beside(columns)
    for row in range(start, stop):
        i, line = divmod(row, rows)
        x, y = out[i, 0, line], out[i, 1, line]
        along_lattice(lines[flows[i]], weight, base_x, base_y, line * every, x, y)
        low, high = 0, columns
        for k in range(table.shape[0]):
            low, high = _inside(x, y, frame, low, high)
            flow = floats_at(addresses[i, k], 2 * table[k, 0] * table[k, 1])
            follow_one(x, y, flow, table[k], far[k], frame, cells, more)
        spans[i, line, 0], spans[i, line, 1] = low, high


@jit
def along_followed(
    last: Last, earlier: Earlier, known: Known, pair: int, line: int, space: Room, x: Floats, y: Floats
) -> None:
    """x and y of a row, in whole groups, in the sampler's coordinates.

    space: of `room_for`.
    """
    lines, flows, weight, base_x, base_y = last
    addresses, table, far, frame = earlier
    across, between, sides, cells, more = space
    width = base_x.size
    low, high = _between(known[0][pair], known[1][pair], known[2], line, across, between, x, y)
    low, high = min(width, _SIDES * -(-low // _SIDES)), max(0, width - _SIDES * -(-(width - high) // _SIDES))
    low, high = (low, high) if low < high else (width, width)
    count = low + width - high
    if count == 0:
        return
    side_x, side_y = sides[0, :count], sides[1, :count]
    own = lines[flows[pair]]
    along_lattice(own, weight, base_x, base_y, line, side_x[:low], side_y[:low])
    along_lattice(own, weight, base_x, base_y, line, side_x[low:], side_y[low:], high)
    follow_row(side_x, side_y, addresses[pair], table, far, frame, cells, more)
    for k in range(low):
        x[k], y[k] = side_x[k], side_y[k]
    for k in range(low, count):
        x[high - low + k], y[high - low + k] = side_x[k], side_y[k]


@jit
def room_for(known: Known, width: int) -> Room:
    """To work in, for rows of so many pixels."""
    between = np.zeros((2, known[0].shape[3] + 2 * GROUP + 1), np.float32)
    return nodes_across(known[2], width), between, np.empty((2, width), np.float32), room(), room_beside(width)


@inlined
def _between(
    nodes: Floats, spans: Whole, taps: Floats, line: int, across: Across, between: Floats, x: Floats, y: Floats
) -> tuple[int, int]:
    """A row of pixels between nodes, and between which pixels it is right."""
    rows, columns = nodes.shape[1:]
    if rows == 0:
        return 0, 0
    stride = taps.shape[1]
    cell, place = divmod(line, stride)
    if cell < 1 or cell + 2 >= rows:
        return 0, 0
    low, high = 0, columns
    for k in range(cell - 1, cell + 3):
        low, high = max(low, spans[k, 0]), min(high, spans[k, 1])
    if high - low < 4:
        return 0, 0
    for i in range(2):
        # Cubics take a node before each cell: before the frame there is none.
        _down(nodes[i, cell - 1 : cell + 3], taps[:, place], between[i, 1 : columns + 1])
    if stride == 2:
        along_every_second(between[0], taps, x)
        along_every_second(between[1], taps, y)
    else:
        both_along_nodes(between, across, x, y)
    return (low + 1) * stride, (high - 2) * stride


@jit
def _down(rows: Floats, taps: Floats, out: Floats) -> None:
    """A row, out (n,), between four, (4, n)."""
    a, b, c, d = rows[0], rows[1], rows[2], rows[3]
    at_a, at_b, at_c, at_d = taps[0], taps[1], taps[2], taps[3]
    for k in range(out.size):
        out[k] = fma(at_d, d[k], fma(at_c, c[k], fma(at_b, b[k], at_a * a[k])))


@inlined
def _inside(x: Floats, y: Floats, frame: Frame, low: int, high: int) -> tuple[int, int]:
    """Between which of a row of nodes, around its middle, all are a pixel and more from the border."""
    right, bottom = np.float32(1 - 3 / frame[1]), np.float32(1 - 3 / frame[0])
    middle = x.size // 2
    first, behind = np.int32(low), np.int32(high)
    for k in range(middle):
        is_inside = (abs(x[k]) < right) & (abs(y[k]) < bottom)
        first = max(first, np.int32(0) if is_inside else np.int32(k + 1))
    for k in range(middle, x.size):
        is_inside = (abs(x[k]) < right) & (abs(y[k]) < bottom)
        behind = min(behind, np.int32(x.size) if is_inside else np.int32(k))
    return int(first), int(behind)


@jit
def positions(last: Last, earlier: Earlier, known: Known, start: int, stop: int, out: Floats) -> None:
    """Rows of out, (k, 2, H, W): as for `along_followed`."""
    height, width = out.shape[2:]
    space, whole = room_for(known, width), GROUP * -(-width // GROUP)
    x, y = np.empty(whole, np.float32), np.empty(whole, np.float32)
    for row in range(start, stop):
        i, line = divmod(row, height)
        along_followed(last, earlier, known, i, line, space, x, y)
        out[i, 0, line], out[i, 1, line] = x[:width], y[:width]
