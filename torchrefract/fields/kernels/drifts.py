"""What numba compiles: Perlin's noise of several octaves, one row of pixels after the other.

Each octave keeps the gradients at the two rows of nodes around a row of pixels. In that row

    noise = sum over the 2 nodes beside x of h(p) (A p + B),  A = sum over 2 rows of h(q) g_x, B = of h(q) q g_y

so that what a pixel takes of an octave is four numbers. Numbers are float32, but places float64.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import jit
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.nodes import Constants, Doubles, Key, Words, gradients, hashed_columns
from torchrefract.fields.kernels.pixels import GROUP, Columns, Floats
from torchrefract.warping.kernels.lines import between

if LANES:
    from torchrefract.fields.kernels.groups import add_octave
else:
    from torchrefract.fields.kernels.pixels import add_octave

Whole = NDArray[np.int64]
Octaves = tuple[Words, Doubles, Whole, Doubles]
_NONE = -(1 << 62)  # a row of nodes that no frame has


@jit
def drifts(
    keys: Words,
    constants: Constants,
    elapsed: Doubles,
    octaves: Octaves,
    weights: Floats,
    lines: Floats,
    taps: Floats,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Rows `start` ... `stop` of the noise of all frames, out (N, H, W), one below the other.

    keys: (N, 4), the words of each; constants: of their hash.
    elapsed: (N,), t / (pi decorrelation).
    octaves: their numbers, (K,); steps, (K,), cells from pixel to pixel; the number of the last column and row of nodes
        before the frame, (N, K, 2), and how far behind it the first pixel is, (N, K, 2), cells, in [0, 1).
    weights: (N, K).
    lines, taps: what else is in the noise, as for `between`, (N, n, W) and (stride, taps); no taps are nothing.
    """
    numbers, steps, first, place = octaves
    height, width = out.shape[1:]
    columns, hashes, slopes, line = _room(steps, width)
    kept, found = np.empty((numbers.size, 2), np.int64), np.empty(columns[1].shape[1], np.float32)
    frame = -1
    for row in range(start, stop):
        i, y = divmod(row, height)
        if i != frame:
            frame, kept[:] = i, _NONE
            for k in range(numbers.size):
                _along(place[i, k, 0], steps[k], width, columns, k)
                hashed_columns(numbers[k], first[i, k, 0], place[i, k, 0], steps[k], keys[i], constants, hashes[k])
        if taps.size:
            between(lines[i], taps, y, found[:width])
        else:
            found[:] = 0
        key = keys[i], elapsed[i], constants
        for k in range(numbers.size):
            above, count = place[i, k, 1] + steps[k] * y, _nodes(steps[k], width)
            _line(above, first[i, k, 1], weights[i, k], hashes[k, :count], key, slopes[k], kept[k], line)
            add_octave(line, columns, k, found)
        out[i, y] = found[:width]


@jit
def _room(steps: Doubles, width: int) -> tuple[Columns, Words, Floats, Floats]:
    """For columns, their hashes, gradients, x and y, of two rows of nodes, and what `_line` makes."""
    count, groups, most = steps.size, -(-width // GROUP), GROUP
    for step in steps:
        most = max(most, _nodes(step, width))
    begins, nodes = np.empty((count, groups), np.int32), np.empty((count, groups * GROUP), np.int32)
    part, fade = np.empty((count, groups * GROUP), np.float32), np.empty((count, groups * GROUP), np.float32)
    hashes, slopes = np.empty((count, most), np.uint32), np.empty((count, 2, 2, most), np.float32)
    # Behind the last nodes as many are read as a group may have.
    return (begins, nodes, part, fade), hashes, slopes, np.zeros((2, most + 2 * GROUP), np.float32)


@jit
def _nodes(step: float, width: int) -> int:
    """In a row, in whole groups, which are made faster."""
    needed = 2 * width if step >= 2 else int(np.ceil(step * width)) + 2
    return GROUP * -(-needed // GROUP)


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


@jit
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


@jit
def _fade(p: float) -> float:
    return p * p * p * (p * (6 * p - 15) + 10)
