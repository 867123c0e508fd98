"""What numba compiles: the same as `following_pixels`, LANES pixels at once and to its bits."""

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels import following_pixels, pixels
from torchrefract.warping.kernels.groups import AHEAD, BEFORE, MOST_ROWS, weights_of
from torchrefract.warping.kernels.lane_weights import Four, Lanes, cubic_weights, moved, to_pixels
from torchrefract.warping.kernels.pixels import Cells, Floats, Frame, Number, Whole

if following_pixels.TOGETHER:
    from torchrefract.warping.kernels.following_nodes import follow_nodes
else:
    follow_nodes = following_pixels.follow_one

Read = tuple[bool, Lanes, Lanes]


@jit
def follow_one(
    x: Floats,
    y: Floats,
    flow: Floats,
    place: Whole,
    far: Number,
    frame: Frame,
    cells: Cells,
    more: Floats,
) -> None:
    """As `following_pixels.follow_one`."""
    rows, columns, stride = place
    if stride and following_pixels.TOGETHER:
        follow_nodes(x, y, flow, place, far, frame, cells, more)
        return
    if x.size < LANES or columns < 2 * LANES:
        following_pixels.follow_one(x, y, flow, place, far, frame, cells, more)
        return
    end = np.uintp(x.size - LANES)
    last_x, last_y = lanes.load(x, end), lanes.load(y, end)
    for first in range(0, x.size, LANES):
        start = min(first, x.size - LANES)  # the last group does again what the one before it did
        at_x, at_y = lanes.load(x, np.uintp(start)), lanes.load(y, np.uintp(start))
        if start < first:
            at_x, at_y = last_x, last_y
        place_x, place_y = to_pixels(at_x, frame[1]), to_pixels(at_y, frame[0])
        if stride:
            known, u, v = _between(flow, rows, columns, stride, place_x, place_y)
        else:
            known, u, v = _read(flow, rows, columns, place_x, place_y)
        if not known:
            lanes.store(more[0], np.uintp(start), place_x)
            lanes.store(more[1], np.uintp(start), place_y)
            _read_apart(flow, place, start, cells, more, x, y)
            u, v = lanes.load(x, np.uintp(start)), lanes.load(y, np.uintp(start))
        lanes.store(x, np.uintp(start), moved(at_x, u, frame[1], far))
        lanes.store(y, np.uintp(start), moved(at_y, v, frame[0], far))


@inlined
def _read(flow: Floats, rows: int, columns: int, x: Lanes, y: Lanes) -> Read:
    """Both planes of a flow at positions in it, or False for those that are too far from one another."""
    left, top = lanes.floor(x), lanes.floor(y)
    column, row = lanes.to_wholes(left), lanes.to_wholes(top)
    one = lanes.all_wholes(np.int32(1))
    behind = lanes.smaller(lanes.plus(column, one), lanes.all_wholes(np.int32(columns - 1)))
    near = min(lanes.first(column), lanes.last(column)) - BEFORE
    at = max(0, min(near, columns - 2 * LANES))
    origin, reach = lanes.all_wholes(np.int32(at)), lanes.all_wholes(np.int32(2 * LANES))
    column, behind = lanes.minus(column, origin), lanes.minus(behind, origin)
    u = v = lanes.all_floats(np.float32(-0.0))  # what is added to it keeps its bits
    if not lanes.everywhere(lanes.both(lanes.below(column, reach), lanes.below(behind, reach))):
        return False, u, v
    first, last = lanes.smallest(row), min(rows, lanes.largest(row) + 2)
    if last - first > MOST_ROWS:
        return False, u, v
    weights, under = weights_of(lanes.difference(x, left), lanes.difference(y, top)), lanes.plus(row, one)
    at += first * columns
    _fetch(flow, at + min(last - first + AHEAD, rows - 1 - first) * columns, rows * columns)
    for line in range(first, last):
        here = lanes.all_wholes(np.int32(line))
        upper = lanes.equal(row, here)
        reads = lanes.either(upper, lanes.equal(under, here))
        at_left, at_right = lanes.where(upper, weights[0], weights[2]), lanes.where(upper, weights[1], weights[3])
        u = lanes.where(reads, _added(u, flow, at, column, behind, at_left, at_right), u)
        v = lanes.where(reads, _added(v, flow, at + rows * columns, column, behind, at_left, at_right), v)
        at += columns
    return True, u, v


@inlined
def _fetch(flow: Floats, at: int, plane: int) -> None:
    lanes.fetch(flow, np.uintp(at + LANES))
    lanes.fetch(flow, np.uintp(at + LANES + plane))


@inlined
def _added(total: Lanes, flow: Floats, at: int, column: Lanes, behind: Lanes, at_left: Lanes, at_right: Lanes) -> Lanes:
    low, high = lanes.load(flow, np.uintp(at)), lanes.load(flow, np.uintp(at + LANES))
    left, right = lanes.pick(low, high, column), lanes.pick(low, high, behind)
    return lanes.fma(at_right, right, lanes.fma(at_left, left, total))


@inlined
def _between(flow: Floats, rows: int, columns: int, stride: int, x: Lanes, y: Lanes) -> Read:
    """The same, by cubics between nodes every `stride` px."""
    share = lanes.all_floats(np.float32(1 / stride))
    x, y = lanes.product(x, share), lanes.product(y, share)
    left, top = lanes.floor(x), lanes.floor(y)
    column, row = lanes.to_wholes(left), lanes.to_wholes(top)
    near = min(lanes.first(column), lanes.last(column)) - BEFORE
    at = max(0, min(near, columns - 2 * LANES))
    column = lanes.minus(column, lanes.all_wholes(np.int32(at)))
    zero = lanes.all_floats(np.float32(0))
    u = v = zero
    if not lanes.everywhere(lanes.below(column, lanes.all_wholes(np.int32(2 * LANES - 3)))):
        return False, u, v
    first, last = lanes.smallest(row), min(rows, lanes.largest(row) + 4)
    if last - first > MOST_ROWS:
        return False, u, v
    across, down = cubic_weights(lanes.difference(x, left)), cubic_weights(lanes.difference(y, top))
    one = lanes.all_wholes(np.int32(1))
    second = lanes.plus(column, one)
    third = lanes.plus(second, one)
    places = column, second, third, lanes.plus(third, one)
    at, plane = at + first * columns, rows * columns
    of_u = of_v = zero, zero, zero, zero
    for line in range(first, last):
        behind = lanes.minus(lanes.all_wholes(np.int32(line)), row)
        weight = lanes.where(lanes.equal(behind, lanes.all_wholes(np.int32(0))), down[0], zero)
        weight = lanes.where(lanes.equal(behind, one), down[1], weight)
        weight = lanes.where(lanes.equal(behind, lanes.all_wholes(np.int32(2))), down[2], weight)
        weight = lanes.where(lanes.equal(behind, lanes.all_wholes(np.int32(3))), down[3], weight)
        of_u, of_v = _added_four(of_u, flow, at, places, weight), _added_four(of_v, flow, at + plane, places, weight)
        at += columns
    return True, _across(of_u, across), _across(of_v, across)


@inlined
def _added_four(totals: Four, flow: Floats, at: int, places: Four, weight: Lanes) -> Four:
    low, high = lanes.load(flow, np.uintp(at)), lanes.load(flow, np.uintp(at + LANES))
    return (
        lanes.fma(weight, lanes.pick(low, high, places[0]), totals[0]),
        lanes.fma(weight, lanes.pick(low, high, places[1]), totals[1]),
        lanes.fma(weight, lanes.pick(low, high, places[2]), totals[2]),
        lanes.fma(weight, lanes.pick(low, high, places[3]), totals[3]),
    )


@inlined
def _across(found: Four, weights: Four) -> Lanes:
    total = lanes.fma(weights[1], found[1], lanes.product(weights[0], found[0]))
    return lanes.fma(weights[3], found[3], lanes.fma(weights[2], found[2], total))


@inlined
def _read_apart(flow: Floats, place: Whole, start: int, cells: Cells, more: Floats, u: Floats, v: Floats) -> None:
    """The same one pixel after the other, at positions more[:2] from `start` on."""
    rows, columns, stride = place
    plane = rows * columns
    if stride:
        for k in range(start, start + LANES):
            u[k], v[k] = following_pixels.between(flow, rows, columns, stride, more[0, k], more[1, k])
        return
    size = (1, rows, columns, 1)
    pixels.read_part(flow[:plane], size, more[0], more[1], start, start + LANES, cells, (0, 0, 0), u)
    pixels.read_part(flow[plane:], size, more[0], more[1], start, start + LANES, cells, (0, 0, 0), v)
