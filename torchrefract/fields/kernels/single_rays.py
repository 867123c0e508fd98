"""What numba compiles: noise in space at a row of rays, one ray after the other.

Arrays are read at places from their begin, as no part of one is made without being counted.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, inlined
from torchrefract.fields.kernels.pixels import Columns, Floats
from torchrefract.warping.kernels.across import GROUP

# Of four rows of nodes each, where g_x is read from, how far behind it g_y and g_z are, and their three weights.
Rows = tuple[NDArray[np.int64], NDArray[np.int64], Floats]


@inlined
def between_rows(gradients: Floats, rows: Rows, at: int, count: int, line: Floats) -> None:
    """A and B, line (2, n), at `count` nodes, whole groups of them: the sums over the rows `at`.

    rows: (crossings, 4), (crossings, 4) and (crossings, 4, 3).
    """
    places, behind, weights = rows
    for k in range(GROUP * -(-count // GROUP)):
        a, b = np.float32(0), np.float32(0)
        for i in range(4):
            place, step = np.uintp(places[at, i] + k), np.uintp(behind[at, i])
            a = fma(weights[at, i, 0], gradients[place], a)
            b = fma(weights[at, i, 1], gradients[place + step], b)
            b = fma(weights[at, i, 2], gradients[place + step + step], b)
        line[0, k], line[1, k] = a, b


@inlined
def add_crossing(line: Floats, columns: Columns, at: int, out: Floats, plane: int) -> None:
    """Add what A and B, line (2, n), make at the columns `at` to a plane, out (planes, W), W in whole groups."""
    begins, nodes, part, fade = columns
    for k in range(out.shape[1]):
        node = np.uintp(begins[at, k // GROUP] + nodes[at, k])
        p = part[at, k]
        left = fma(line[0, node], p, line[1, node])
        right = fma(line[0, node + np.uintp(1)], p - np.float32(1), line[1, node + np.uintp(1)])
        out[plane, k] += fma(fade[at, k], right - left, left)
