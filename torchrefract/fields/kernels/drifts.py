"""What numba compiles: Perlin's noise of several octaves, one row of pixels after the other.

Each octave keeps the gradients at the two rows of nodes around a row of pixels. In that row

    noise = sum over the 2 nodes beside x of h(p) (A p + B),  A = sum over 2 rows of h(q) g_x, B = of h(q) q g_y

so that what a pixel takes of an octave is four numbers. Numbers are float32, but places float64.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.nodes import Constants, Doubles, Key, Words, gradients, hashed_columns
from torchrefract.fields.kernels.pixels import Columns, Floats
from torchrefract.warping.kernels.across import GROUP, nodes_across

if LANES:
    from torchrefract.fields.kernels.groups import add_octave
    from torchrefract.warping.kernels.across_groups import along_nodes
else:
    from torchrefract.fields.kernels.pixels import add_octave
    from torchrefract.warping.kernels.across import along_nodes

Whole = NDArray[np.int64]
Level = tuple[Words, Doubles, Whole, Doubles, Floats]
Room = tuple[Columns, Words, Floats, Whole, Floats]
_NONE = -(1 << 62)  # a row of nodes that no frame has


@jit
def drifts(
    keys: Words,
    constants: Constants,
    elapsed: Doubles,
    fine: Level,
    coarse: Level,
    taps: Floats,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Rows `start` ... `stop` of the noise of all frames, out (N, H, W), one below the other.

    keys: (N, 4), the words of each; constants: of their hash.
    elapsed: (N,), t / (pi decorrelation).
    fine: octaves, their numbers, (K,); steps, (K,), cells from pixel to pixel; the number of the last column and row of
        nodes before the first pixel, (N, K, 2), and how far behind it this is, (N, K, 2), cells, in [0, 1); weights,
        (N, K).
    coarse, taps: octaves at the nodes of a lattice, and cubics between these, (4, stride); of no stride there are none.
    """
    height, width = out.shape[1:]
    stride = taps.shape[1]
    across, columns = nodes_across(taps, width), -(-width // stride) + 3 if stride else 0
    rooms = _room(fine[1], width), _room(coarse[1], columns)
    found, lines = np.empty(_whole(width), np.float32), np.empty((4, _whole(width)), np.float32)
    nodes, kept, frame = np.zeros(_whole(columns) + 2 * GROUP, np.float32), np.empty(4, np.int64), -1
    for row in range(start, stop):
        i, y = divmod(row, height)
        key = keys[i], elapsed[i], constants
        if i != frame:
            frame, kept[:] = i, _NONE
            _enter(fine, rooms[0], i, key, width)
            _enter(coarse, rooms[1], i, key, columns)
        if stride:
            cell, place = divmod(y, stride)
            for node in range(cell, cell + 4):
                if kept[node % 4] != node:
                    kept[node % 4] = node
                    nodes[:] = 0
                    _add_row(coarse, rooms[1], i, node, key, columns, nodes[: _whole(columns)])
                    along_nodes(nodes, across, lines[node % 4])
            _down(lines, cell, taps[:, place], found)
        else:
            found[:] = 0
        _add_row(fine, rooms[0], i, y, key, width, found)
        out[i, y] = found[:width]


@jit
def _enter(level: Level, room: Room, frame: int, key: Key, width: int) -> None:
    """Where the columns of a frame lie, and hashes of its columns of nodes."""
    numbers, steps, first, place, _ = level
    columns, hashes, _, kept, _ = room
    kept[:] = _NONE
    for k in range(numbers.size):
        _along(place[frame, k, 0], steps[k], width, columns, k)
        hashed_columns(numbers[k], first[frame, k, 0], place[frame, k, 0], steps[k], key, hashes[k])


@inlined
def _add_row(level: Level, room: Room, frame: int, y: int, key: Key, width: int, out: Floats) -> None:
    """Add all octaves to a row of pixels in whole groups."""
    numbers, steps, first, place, weights = level
    columns, hashes, slopes, kept, line = room
    for k in range(numbers.size):
        at, count = place[frame, k, 1] + steps[k] * y, _nodes(steps[k], width)
        _line(at, first[frame, k, 1], weights[frame, k], hashes[k, :count], key, slopes[k], kept[k], line)
        add_octave(line, columns, k, out)


@inlined
def _down(lines: Floats, cell: int, taps: Floats, out: Floats) -> None:
    """A row of pixels between four rows of nodes, which lie in turn in lines (4, W)."""
    a, b, c, d = lines[cell % 4], lines[(cell + 1) % 4], lines[(cell + 2) % 4], lines[(cell + 3) % 4]
    at_a, at_b, at_c, at_d = taps[0], taps[1], taps[2], taps[3]
    for k in range(out.size):
        out[k] = fma(at_d, d[k], fma(at_c, c[k], fma(at_b, b[k], at_a * a[k])))


@jit
def _room(steps: Doubles, width: int) -> Room:
    """For columns, their hashes, gradients, x and y, of two rows of nodes, their numbers, and what `_line` makes."""
    count, most = steps.size, GROUP
    for step in steps:
        most = max(most, _nodes(step, width))
    begins, nodes = np.empty((count, _whole(width) // GROUP), np.int32), np.empty((count, _whole(width)), np.int32)
    part, fade = np.empty((count, _whole(width)), np.float32), np.empty((count, _whole(width)), np.float32)
    hashes, slopes = np.empty((count, most), np.uint32), np.empty((count, 2, 2, most), np.float32)
    # Behind the last nodes as many are read as a group may have.
    line = np.zeros((2, most + 2 * GROUP), np.float32)
    return (begins, nodes, part, fade), hashes, slopes, np.empty((count, 2), np.int64), line


@inlined
def _whole(width: int) -> int:
    """So many, in whole groups, which are made faster."""
    return GROUP * -(-width // GROUP)


@inlined
def _nodes(step: float, width: int) -> int:
    """So many are in a row of nodes."""
    return _whole(2 * width if step >= 2 else int(np.ceil(step * width)) + 2)


@jit
def _along(place: float, step: float, width: int, columns: Columns, octave: int) -> None:
    """Where the pixels of a row lie between nodes: columns of an octave."""
    begins, nodes, part, fade = columns
    for k in range(nodes.shape[1]):
        pixel = min(k, width - 1)
        at = place + step * pixel
        p = at - np.floor(at)
        # Pixels so far apart share no node: each takes the two of its own.
        node = int(np.floor(at)) if step < 2 else 2 * pixel
        if k % GROUP == 0:
            begins[octave, k // GROUP] = node
        nodes[octave, k] = node - begins[octave, k // GROUP]
        part[octave, k], fade[octave, k] = p, _fade(p)


@inlined
def _line(
    at: float, first: int, weight: float, hashes: Words, key: Key, slopes: Floats, kept: Whole, out: Floats
) -> None:
    """A and B, out (2, n), at the nodes of a row of pixels, from the gradients in the rows of nodes around it."""
    number = first + int(np.floor(at))
    for row in (number, number + 1):
        if kept[row & 1] != row:
            kept[row & 1] = row
            gradients(hashes, np.uint32(row), key, slopes[row & 1, 0], slopes[row & 1, 1])
    q = at - np.floor(at)
    below = weight * _fade(q)
    above = weight - below
    of_x = np.float32(above), np.float32(below)
    of_y = np.float32(above * q), np.float32(below * (q - 1))
    upper, lower = slopes[number & 1], slopes[(number + 1) & 1]
    for k in range(hashes.size):
        out[0, k] = of_x[0] * upper[0, k] + of_x[1] * lower[0, k]
        out[1, k] = of_y[0] * upper[1, k] + of_y[1] * lower[1, k]


@inlined
def _fade(p: float) -> float:
    return p * p * p * (p * (6 * p - 15) + 10)
