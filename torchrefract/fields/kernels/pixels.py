"""What numba compiles: noise at the pixels of a row, one after the other."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit
from torchrefract.warping.kernels.across import GROUP, Small

Floats = NDArray[np.float32]
# Of each octave and group, the first node; of each octave and pixel, the node before it, counted from that one, the
# part p of the cell, and its fade.
Columns = tuple[Small, Small, Floats, Floats]


@jit
def add_octave(line: Floats, columns: Columns, octave: int, out: Floats) -> None:
    """Add an octave, of A and B at its nodes, line (2, n), to a row of pixels in whole groups, out (W,)."""
    begins, nodes, part, fade = columns
    for k in range(out.size):
        node = np.uintp(begins[octave, k // GROUP] + nodes[octave, k])
        p = part[octave, k]
        left = fma(line[0, node], p, line[1, node])
        right = fma(line[0, node + np.uintp(1)], p - np.float32(1), line[1, node + np.uintp(1)])
        out[k] += fma(fade[octave, k], right - left, left)
