"""What numba compiles: rows of pixels, from the means along rays up to slices of the distance."""

from typing import Any

import numpy as np

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.nodes import Floats, Number
from torchrefract.fields.kernels.sheets import Whole
from torchrefract.warping.kernels import across as single
from torchrefract.warping.kernels.across import GROUP, Across, Small

if LANES:
    from torchrefract.warping.kernels.across_groups import along_nodes
else:
    from torchrefract.warping.kernels.across import along_nodes

# Of each row of pixels the first of four rows of rays, (H,), and their weights, (4, H).
Down = tuple[Small, Floats]
# The nearest and the farthest distance of each row of pixels, (M, H).
Ends = tuple[Floats, Floats]
_ONE, _HALF, _QUARTER = np.float32(1), np.float32(0.5), np.float32(0.25)
_NEAR, _FAR = np.float32(9 / 16), np.float32(-1 / 16)  # Keys' cubic of a = -1/2 in the middle of four


@jit
def ask_for(ends: Ends, reach: Number, count: int, down: Down, wanted: Whole) -> None:
    """The slices, of `count`, that pixels between these distances ask rays for, wanted (M, rows, 2)."""
    nearest, farthest = ends
    cells = down[0]
    wanted[:, :, 0], wanted[:, :, 1] = count, -1
    for i in range(nearest.shape[0]):
        for y in range(nearest.shape[1]):
            low, high = _span(nearest[i, y], farthest[i, y], reach, count)
            for row in range(cells[y], cells[y] + 4):
                wanted[i, row, 0], wanted[i, row, 1] = min(wanted[i, row, 0], low), max(wanted[i, row, 1], high)


@jit
def rows_at_distances(
    volume: Floats, distance: Floats, reach: Number, down: Down, across: Across, start: int, stop: int, out: Floats
) -> None:
    """Rows `start` ... `stop` of the means of all frames, out (N, H, W), one below the other, from those along rays.

    volume: (N, rows, slices + 1, n), less one; distance: (N or 1, H), m; reach: m.
    down, across: where pixels lie between rays.
    """
    height, width = out.shape[1:]
    (_, rows, slices, most), flat = volume.shape, volume.ravel()
    whole = np.zeros(most + 2 * GROUP, np.float32)
    line = whole[:most]
    found = np.empty(GROUP * -(-width // GROUP), np.float32)
    # Where frames are small, a group of pixels has more rays than can be read at once.
    together = across[1].size > 0 and across[1].max() + 3 < 2 * GROUP
    for at in range(start, stop):
        i, y = divmod(at, height)
        d = distance[min(i, distance.shape[0] - 1), y]
        first, part = _slice(d, reach, volume.shape[2] - 1)
        share = _share(d, reach)
        line[:] = 0
        place = ((i * rows + down[0][y]) * slices + first) * line.size
        _between_rows(flat, place, slices * line.size, down[1], y, share * (_ONE - part), line)
        _between_rows(flat, place + line.size, slices * line.size, down[1], y, share * part, line)
        if together:
            along_nodes(whole, across, found)
        else:
            single.along_nodes(whole, across, found)
        own = out[i, y]
        for k in range(width):
            own[k] = _positive(found[k] + _ONE)


@jit
def refined(volume: Floats, wanted: Whole, start: int, stop: int, out: Floats) -> None:
    """Columns of a volume from its second one on, two to a cell, out (N, rows, slices + 1, 2 n), as far as wanted."""
    _, rows, slices, most = volume.shape
    flat, into = volume.ravel(), out.ravel()
    for at in range(start, stop):
        own, row = min(at // rows, wanted.shape[0] - 1), at % rows
        for n in range(wanted[own, row, 0], wanted[own, row, 1] + 1):
            place = np.uintp((at * slices + n) * most)
            for k in range(most - 3):
                left = place + np.uintp(k)
                here, after = flat[left + np.uintp(1)], flat[left + np.uintp(2)]
                outer = flat[left] + flat[left + np.uintp(3)]
                to = np.uintp(2) * (place + np.uintp(k))
                into[to] = here
                into[to + np.uintp(1)] = fma(_FAR, outer, _NEAR * (here + after))
            # The last column that has one of the rays beside it, which rays in whole groups have none behind.
            into[np.uintp(2) * (place + np.uintp(most - 3))] = flat[place + np.uintp(most - 2)]


@jit
def rows_of_pixels(
    volume: Floats,
    distance: Floats,
    ends: Ends,
    reach: Number,
    down: Down,
    across: tuple[Small, Floats],
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """The same for distances by pixel, (N or 1, H, W), from a volume that is `refined`.

    across: the column before each column of pixels, (W,), and how far on this is.
    """
    (height, width), (_, rows, slices, wide), flat = out.shape[1:], volume.shape, volume.ravel()
    lines = np.empty(slices * wide, np.float32)
    place, part, share = np.empty(width, np.int32), np.empty(width, np.float32), np.empty(width, np.float32)
    for at in range(start, stop):
        i, y = divmod(at, height)
        own = min(i, distance.shape[0] - 1)
        low, high = _span(ends[0][own, y], ends[1][own, y], reach, slices - 1)
        begin = (i * rows + down[0][y]) * slices * wide
        # Slices lie one behind the other.
        some = lines[low * wide : (high + 1) * wide]
        some[:] = 0
        _between_rows(flat, begin + low * wide, slices * wide, down[1], y, _ONE, some)
        _places(distance[own, y], reach, slices - 1, wide, across[0], place, part, share)
        _looked_up(lines, wide, place, across[1], part, share, out[i, y])


@jit
def _places(
    distance: Floats, reach: Number, count: int, wide: int, nodes: Small, place: Small, part: Floats, share: Floats
) -> None:
    """Where a row of pixels lies, in slices that follow one another, and reach / d, at most 1."""
    for k in range(place.size):
        d = distance[k]
        first, part[k] = _slice(d, reach, count)
        place[k], share[k] = np.int32(first * np.int32(wide)) + nodes[k], _share(d, reach)


@jit
def _looked_up(
    lines: Floats, wide: int, place: Small, across: Floats, part: Floats, share: Floats, out: Floats
) -> None:
    """A row of pixels."""
    for k in range(out.size):
        above = np.uintp(place[k])
        below = above + np.uintp(wide)
        near = _mixed(lines[above], lines[above + np.uintp(1)], across[k])
        far = _mixed(lines[below], lines[below + np.uintp(1)], across[k])
        out[k] = _positive(fma(_mixed(near, far, part[k]), share[k], _ONE))


@inlined
def _span(nearest: Number, farthest: Number, reach: Number, count: int) -> tuple[int, int]:
    """The first and the last slice that distances between two lie between."""
    if not nearest <= farthest:  # one of them is no number
        return 0, count
    return _slice(nearest, reach, count)[0], _slice(farthest, reach, count)[0] + 1


@inlined
def _slice(d: Number, reach: Number, count: int) -> tuple[Any, Number]:
    """The slice below a distance, and the part of the way to the next."""
    near = reach if d > reach else d
    place = np.sqrt(near * (np.float32(count * (count + 1)) / reach) + _QUARTER) - _HALF
    first = min(max(np.int32(place), np.int32(0)), np.int32(count - 1))
    return first, place - np.float32(first)


@inlined
def _share(d: Number, reach: Number) -> Number:
    return reach / (d if d > reach else reach)


@inlined
def _positive(mean: Number) -> Number:
    # Cubics overshoot where the contrast is high.
    return np.float32(0) if mean < 0 else mean


@inlined
def _mixed(a: Number, b: Number, part: Number) -> Number:
    return fma(part, b - a, a)


@jit
def _between_rows(volume: Floats, place: int, step: int, weights: Floats, y: int, factor: Number, line: Floats) -> None:
    """Add means at a row of pixels: of four rows in `volume`, from a place on, one a step behind the other."""
    first, second = np.uintp(place), np.uintp(place + step)
    third, fourth = np.uintp(place + 2 * step), np.uintp(place + 3 * step)
    a, b, c, d = factor * weights[0, y], factor * weights[1, y], factor * weights[2, y], factor * weights[3, y]
    for k in range(line.size):
        at = np.uintp(k)
        found = fma(b, volume[second + at], a * volume[first + at])
        found = fma(d, volume[fourth + at], fma(c, volume[third + at], found))
        line[k] += found
