"""What numba compiles: the pixels of a row, LANES at once, by the steps of F.grid_sample and to the bits of `pixels`.

Neighbors are looked up near to one another: what a group of pixels takes of a row of the source lies, but for rough
flows, in the two registers from its first pixel on, out of which each lane picks its own. With 8 lanes it is faster
if each lane loads its own; that is done with planes, in groups that take nothing from outside of the frame.
"""

from typing import Any

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels import pixels
from torchrefract.warping.kernels.pixels import Apart, Cells, Floats, Size, Values

Lanes = Any
Three = tuple[Lanes, Lanes, Lanes]
Weights = tuple[Lanes, Lanes, Lanes, Lanes]
Cell = tuple[Lanes, Lanes, Lanes, Lanes]  # upper and lower row, left and right place among what is read
Flags = tuple[Lanes, Lanes]  # whether the left and the right pixels are in the frame
Rows = tuple[int, int]
Group = tuple[bool, int, Rows, Lanes, Cell, Flags, Weights]
MOST_ROWS = 12  # of the source; for more of them one pixel after the other is faster
BEFORE = LANES // 4  # pixels that are read before the first of those at both ends of a group
AHEAD = 3  # rows before they are read they are asked for: each is read anew, from farther memory, a row later
ROWS_AHEAD = 6  # the same, where each lane loads its own


@inlined
def read_row(source: Values, size: Size, x: Floats, y: Floats, cells: Cells, apart: Apart, out: Values) -> None:
    """As `pixels.read_row`."""
    channels, _, width, step = size
    if x.size < LANES or width < 2 * LANES or (step > 1 and channels != 3):
        pixels.read_row(source, size, x, y, cells, apart, out)
    elif step > 1:
        _read_together(source, size, x, y, cells, apart, out)
    else:
        _read_planes(source, size, x, y, cells, apart, out)


@jit
def _read_together(source: Values, size: Size, x: Floats, y: Floats, cells: Cells, apart: Apart, out: Values) -> None:
    """Three channels that lie together."""
    _, height, width, _ = size
    for first in range(0, x.size, LANES):
        start = min(first, x.size - LANES)  # the last group may do again what the one before it did
        near, begin, rows, begins, cell, counts, weights = _group(size, x, y, start)
        if near:
            a, b, c = _of_pixels(source, 3 * begin, 3 * width, height, rows, begins, cell, counts, weights)
            lanes.store_three(out, np.uintp(apart[2] + 3 * start), a, b, c)
        else:
            pixels.read_part(source, size, x, y, start, start + LANES, cells, apart, out)


@jit
def _read_planes(source: Values, size: Size, x: Floats, y: Floats, cells: Cells, apart: Apart, out: Values) -> None:
    """Planes of channels."""
    channels, height, width, _ = size
    first = 0
    while first < x.size:
        if LANES == 8:
            first = _read_in_frame(source, size, x, y, apart, out, first)
            if first >= x.size:
                return
        start = min(first, x.size - LANES)
        first += LANES
        near, begin, rows, begins, cell, counts, weights = _group(size, x, y, start)
        if not near:
            pixels.read_part(source, size, x, y, start, start + LANES, cells, apart, out)
            continue
        c, at, into = 0, begin, apart[2] + start
        while c + 3 <= channels:
            one, two, three = _of_three(source, at, apart[0], width, height, rows, begins, cell, counts, weights)
            lanes.store(out, np.uintp(into), one)
            lanes.store(out, np.uintp(into + apart[1]), two)
            lanes.store(out, np.uintp(into + 2 * apart[1]), three)
            c, at, into = c + 3, at + 3 * apart[0], into + 3 * apart[1]
        while c < channels:
            found = _of_plane(source, at, width, height, rows, begins, cell, counts, weights)
            lanes.store(out, np.uintp(into), found)
            c, at, into = c + 1, at + apart[0], into + apart[1]


@inlined
def _read_in_frame(source: Values, size: Size, x: Floats, y: Floats, apart: Apart, out: Values, first: int) -> int:
    """Whole groups from a place on, up to the next one that the border of the frame goes through, or to the last."""
    channels, height, width, _ = size
    right, bottom = lanes.all_wholes(np.int32(width - 1)), lanes.all_wholes(np.int32(height - 1))
    wide = lanes.all_wholes(np.int32(width))
    while first + LANES <= x.size:
        place_x, place_y = lanes.load(x, np.uintp(first)), lanes.load(y, np.uintp(first))
        left, top = lanes.floor(place_x), lanes.floor(place_y)
        column, row = lanes.to_wholes(left), lanes.to_wholes(top)
        if not lanes.everywhere(lanes.both(lanes.below(column, right), lanes.below(row, bottom))):
            if not _is_outside(column, row, size):
                break
            for c in range(channels):
                lanes.store(out, np.uintp(apart[2] + first + c * apart[1]), lanes.all_floats(np.float32(0)))
            first += LANES
            continue
        weights = weights_of(lanes.difference(place_x, left), lanes.difference(place_y, top))
        places = lanes.plus(lanes.times(row, wide), column)
        into, ahead = apart[2] + first, min(int(lanes.first(places)) + ROWS_AHEAD * width, height * width - 1)
        if channels == 3:  # without a loop, before which all addresses would be made
            lanes.fetch(source, np.uintp(ahead))
            lanes.fetch(source, np.uintp(ahead + apart[0]))
            lanes.fetch(source, np.uintp(ahead + 2 * apart[0]))
            one = _of_own(source, 0, width, places, weights)
            two = _of_own(source, apart[0], width, places, weights)
            three = _of_own(source, 2 * apart[0], width, places, weights)
            lanes.store(out, np.uintp(into), one)
            lanes.store(out, np.uintp(into + apart[1]), two)
            lanes.store(out, np.uintp(into + 2 * apart[1]), three)
        else:
            for c in range(channels):
                found = _of_own(source, c * apart[0], width, places, weights)
                lanes.store(out, np.uintp(into + c * apart[1]), found)
        first += LANES
    return first


@inlined
def _is_outside(column: Lanes, row: Lanes, size: Size) -> bool:
    """Whether a group takes nothing from the frame."""
    one = lanes.all_wholes(np.int32(1))
    wide, tall = lanes.all_wholes(np.int32(size[2] + 1)), lanes.all_wholes(np.int32(size[1] + 1))
    beside = lanes.both(lanes.below(lanes.plus(column, one), wide), lanes.below(lanes.plus(row, one), tall))
    return not lanes.anywhere(beside)


@inlined
def _of_own(source: Values, begin: int, line: int, places: Lanes, weights: Weights) -> Lanes:
    """A plane, each lane by loads of its own."""
    left, right = lanes.load_pairs(source, np.uintp(begin), places)
    total = lanes.fma(weights[1], right, lanes.product(weights[0], left))
    left, right = lanes.load_pairs(source, np.uintp(begin + line), places)
    return lanes.fma(weights[3], right, lanes.fma(weights[2], left, total))


@inlined
def _group(size: Size, x: Floats, y: Floats, start: int) -> Group:
    """What LANES pixels of a row take, and whether they are near enough to one another."""
    _, height, width, _ = size
    place_x, place_y = lanes.load(x, np.uintp(start)), lanes.load(y, np.uintp(start))
    left, top = lanes.floor(place_x), lanes.floor(place_y)
    column, row = lanes.to_wholes(left), lanes.to_wholes(top)
    one, wide = lanes.all_wholes(np.int32(1)), lanes.all_wholes(np.int32(width))
    behind = lanes.plus(column, one)
    # Pixels that are not in the frame count nothing, whatever is read instead.
    counts = lanes.below(column, wide), lanes.below(behind, wide)
    lowest, highest = lanes.all_wholes(np.int32(0)), lanes.all_wholes(np.int32(width - 1))
    column = lanes.larger(lanes.smaller(column, highest), lowest)
    behind = lanes.larger(lanes.smaller(behind, highest), lowest)
    first = min(lanes.first(column), lanes.last(column)) - BEFORE
    begin = max(0, min(first, width - 2 * LANES))
    origin, reach = lanes.all_wholes(np.int32(begin)), lanes.all_wholes(np.int32(2 * LANES))
    column, behind = lanes.minus(column, origin), lanes.minus(behind, origin)
    near = lanes.everywhere(lanes.both(lanes.below(column, reach), lanes.below(behind, reach)))
    rows = max(0, lanes.smallest(row)), min(height, lanes.largest(row) + 2)
    weights = weights_of(lanes.difference(place_x, left), lanes.difference(place_y, top))
    # What -0 is added to keeps its bits; where nothing is read 0 is left.
    tall, zero = lanes.all_wholes(np.int32(height)), lanes.all_floats(np.float32(0))
    begins = lanes.where(lanes.below(row, tall), lanes.all_floats(np.float32(-0.0)), zero)
    cell = row, lanes.plus(row, one), column, behind
    return near and rows[1] - rows[0] <= MOST_ROWS, begin, rows, begins, cell, counts, weights


@inlined
def weights_of(right: Lanes, below: Lanes) -> Weights:
    """Of the four pixels around each position, from how far it is behind the first of them."""
    one = lanes.all_floats(np.float32(1))
    before, above = lanes.difference(one, right), lanes.difference(one, below)
    upper = lanes.product(before, above), lanes.product(right, above)
    return upper[0], upper[1], lanes.product(before, below), lanes.product(right, below)


@inlined
def _of_pixels(
    source: Values,
    begin: int,
    line: int,
    height: int,
    rows: Rows,
    begins: Lanes,
    cell: Cell,
    counts: Flags,
    weights: Weights,
) -> Three:
    """Three channels that lie together, from where a row of the source begins, each so long."""
    a = b = c = begins
    ahead = begin + _ahead(rows, height) * line + 3 * LANES
    lanes.fetch(source, np.uintp(ahead))
    lanes.fetch(source, np.uintp(ahead + LANES))
    lanes.fetch(source, np.uintp(ahead + 2 * LANES))
    for row in range(rows[0], rows[1]):
        reads, at_left, at_right = _shares(row, cell, weights)
        at = begin + row * line
        low, high = lanes.load_three(source, np.uintp(at)), lanes.load_three(source, np.uintp(at + 3 * LANES))
        a = _added(a, low[0], high[0], reads, cell, counts, at_left, at_right)
        b = _added(b, low[1], high[1], reads, cell, counts, at_left, at_right)
        c = _added(c, low[2], high[2], reads, cell, counts, at_left, at_right)
    return a, b, c


@inlined
def _of_three(
    source: Values,
    begin: int,
    plane: int,
    line: int,
    height: int,
    rows: Rows,
    begins: Lanes,
    cell: Cell,
    counts: Flags,
    weights: Weights,
) -> Three:
    """Three planes, one so far behind the other."""
    a = b = c = begins
    ahead = begin + _ahead(rows, height) * line + LANES
    lanes.fetch(source, np.uintp(ahead))
    lanes.fetch(source, np.uintp(ahead + plane))
    lanes.fetch(source, np.uintp(ahead + 2 * plane))
    for row in range(rows[0], rows[1]):
        reads, at_left, at_right = _shares(row, cell, weights)
        at = begin + row * line
        a = _add_plane(a, source, at, reads, cell, counts, at_left, at_right)
        b = _add_plane(b, source, at + plane, reads, cell, counts, at_left, at_right)
        c = _add_plane(c, source, at + 2 * plane, reads, cell, counts, at_left, at_right)
    return a, b, c


@inlined
def _of_plane(
    source: Values,
    begin: int,
    line: int,
    height: int,
    rows: Rows,
    begins: Lanes,
    cell: Cell,
    counts: Flags,
    weights: Weights,
) -> Lanes:
    total = begins
    lanes.fetch(source, np.uintp(begin + _ahead(rows, height) * line + LANES))
    for row in range(rows[0], rows[1]):
        reads, at_left, at_right = _shares(row, cell, weights)
        total = _add_plane(total, source, begin + row * line, reads, cell, counts, at_left, at_right)
    return total


@inlined
def _add_plane(
    total: Lanes, source: Values, at: int, reads: Lanes, cell: Cell, counts: Flags, at_left: Lanes, at_right: Lanes
) -> Lanes:
    low, high = lanes.load(source, np.uintp(at)), lanes.load(source, np.uintp(at + LANES))
    return _added(total, low, high, reads, cell, counts, at_left, at_right)


@inlined
def _ahead(rows: Rows, height: int) -> int:
    return min(rows[1] + AHEAD, height - 1)


@inlined
def _shares(row: int, cell: Cell, weights: Weights) -> tuple[Lanes, Lanes, Lanes]:
    """The lanes that read this row of the source, and the weights of its two pixels."""
    here = lanes.all_wholes(np.int32(row))
    upper = lanes.equal(cell[0], here)
    at_left, at_right = lanes.where(upper, weights[0], weights[2]), lanes.where(upper, weights[1], weights[3])
    return lanes.either(upper, lanes.equal(cell[1], here)), at_left, at_right


@inlined
def _added(
    total: Lanes,
    low: Lanes,
    high: Lanes,
    reads: Lanes,
    cell: Cell,
    counts: Flags,
    at_left: Lanes,
    at_right: Lanes,
) -> Lanes:
    """The total and what one row of the source adds to it."""
    none = lanes.all_floats(np.float32(0))
    left = lanes.where(counts[0], lanes.pick(low, high, cell[2]), none)
    right = lanes.where(counts[1], lanes.pick(low, high, cell[3]), none)
    return lanes.where(reads, lanes.fma(at_right, right, lanes.fma(at_left, left, total)), total)
