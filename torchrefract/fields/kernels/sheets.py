"""What numba compiles: unit gradients at nodes in space, drawn as the rays of a frame come to need them.

The nodes of one depth are a sheet: as many columns and rows of them as the rays have beside them where they cross the
planes before and behind. `noise_on_planes` has the equations.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import inlined, jit
from torchrefract.fields.kernels.nodes import Doubles, Floats, Key, Number, direction, inverse_error
from torchrefract.fields.perlin3d import LINE, OCTAVE
from torchrefract.noise_kernel import hashed_word
from torchrefract.warping.kernels.across import GROUP

Whole = NDArray[np.int64]
# Of each octave the first of its sheets, (K + 1,); of each sheet the first column and row, how many of these there are,
# where its gradients begin and its rows are marked, (sheets, 6); gradients; and marks of the rows that are drawn.
Sheets = tuple[Whole, Whole, Floats, NDArray[np.bool_]]
_FAR = 1 << 62
_STEP = np.float32(2.0**-12)
_UPPER = np.float32(2.0**-11)
_HALF = np.float32(0.5)


@jit
def sheets_before(place: Doubles, ahead: Doubles, counts: Whole, x: Doubles, y: Doubles) -> Sheets:
    """Of the sheets that planes of a frame need, nothing drawn yet.

    place: (K, 3), of the camera, from the first node of each octave; ahead: (K, planes), periods to each plane; counts:
        (K,), of planes; x, (columns,), and y, (rows,): slopes of the rays.
    """
    firsts = np.zeros(counts.size + 1, np.int64)
    for k in range(counts.size):
        firsts[k + 1] = firsts[k] + int(np.floor(place[k, 2] + ahead[k, counts[k] - 1])) + 2
    ends = np.empty((firsts[-1], 4), np.int64)
    ends[:, :2], ends[:, 2:] = _FAR, -_FAR
    for k in range(counts.size):
        for plane in range(counts[k]):
            far = ahead[k, plane]
            sheet = firsts[k] + int(np.floor(place[k, 2] + far))
            for own in (ends[sheet], ends[sheet + 1]):
                own[0] = min(own[0], int(np.floor(place[k, 0] + far * x[0])))
                own[1] = min(own[1], int(np.floor(place[k, 1] + far * y[0])))
                own[2] = max(own[2], int(np.floor(place[k, 0] + far * x[-1])) + 2)
                own[3] = max(own[3], int(np.floor(place[k, 1] + far * y[-1])) + 2)
    return _laid_out(firsts, ends)


@inlined
def _laid_out(firsts: Whole, ends: Whole) -> Sheets:
    """Sheets from their first columns and rows, and those behind their last, (sheets, 4)."""
    table, begin, rows = np.empty((ends.shape[0], 6), np.int64), 0, 0
    for sheet in range(ends.shape[0]):
        across, down = max(0, ends[sheet, 2] - ends[sheet, 0]), max(0, ends[sheet, 3] - ends[sheet, 1])
        across = GROUP * -(-across // GROUP)
        table[sheet, 0], table[sheet, 1], table[sheet, 2] = ends[sheet, 0], ends[sheet, 1], across
        table[sheet, 3], table[sheet, 4], table[sheet, 5] = down, begin, rows
        begin, rows = begin + 3 * across * down, rows + down
    # Behind the last gradients as many are read as a group may have.
    gradients = np.empty(begin + 2 * GROUP, np.float32)
    gradients[begin:] = 0
    return firsts, table, gradients, np.zeros(rows, np.bool_)


@jit
def draw_row(sheets: Sheets, sheet: int, row: int, octave: int, first: Whole, key: Key) -> None:
    """A row of nodes, which is marked as drawn from then on.

    first: (K, 3), the whole coordinates of the first node of each octave.
    """
    firsts, table, gradients, drawn = sheets
    down, across = row - table[sheet, 1], table[sheet, 2]
    begin = table[sheet, 4] + 3 * across * down
    drawn[table[sheet, 5] + down] = True
    plane = first[octave, 2] + sheet - firsts[octave] + octave * OCTAVE
    number = first[octave, 0] + table[sheet, 0] + LINE * (first[octave, 1] + row + LINE * plane)
    _directions(np.uint32(number), key, gradients[begin : begin + 3 * across])


@jit
def _directions(number: np.uint32, key: Key, out: Floats) -> None:
    """x, y and z, out (3 n), at n nodes that are numbered one after the other."""
    words, elapsed, constants = key
    a, b, c, d = words[0], words[1], words[2], words[3]
    count = out.size // 3
    x, y, z = out[:count], out[count : 2 * count], out[2 * count :]
    for k in range(count):
        node = hashed_word(_hashed(number, k, constants), c, d, constants)
        word = hashed_word(np.uint32(node + np.uint32(constants[0])), a, b, constants)
        own = _upper(word) * _UPPER
        if elapsed != 0:
            turns = elapsed * inverse_error(2 * np.float64(_lower(word)) - 1)
            # Whole turns are dropped before the type gets narrow: after a long time they are many.
            turns = turns - np.trunc(turns) + np.float64(own)
            own = np.float32(turns - np.floor(turns + 0.5))
        x[k], y[k], z[k] = _turned(hashed_word(node, a, b, constants), own)


@inlined
def _hashed(number: np.uint32, k: int, constants: tuple[int, int, int]) -> np.uint32:
    return np.uint32(np.uint32(number + np.uint32(k)) * np.uint32(constants[0]))


@inlined
def _turned(word: np.uint32, turns: Number) -> tuple[Number, Number, Number]:
    """The direction after so many turns on the great circle about the axis that a word says."""
    cos_axis = np.float32(2) * _UPPER * (_upper(word) + _HALF) - np.float32(1)
    sin_axis = np.sqrt(np.float32(1) - cos_axis * cos_axis)
    cos_around, sin_around = direction(_lower(word))
    cos, sin = direction(turns)
    tilted = cos * cos_axis
    return tilted * cos_around - sin * sin_around, tilted * sin_around + sin * cos_around, -cos * sin_axis


@inlined
def _upper(word: np.uint32) -> Number:
    """The first 11 bits."""
    return np.float32(np.int32(word >> np.uint32(21)))


@inlined
def _lower(word: np.uint32) -> Number:
    """The 12 bits behind these, in (0, 1)."""
    return (np.float32(np.int32((word >> np.uint32(9)) & np.uint32(4095))) + _HALF) * _STEP
