"""What numba compiles: fields between the nodes of a lattice.

Each call does the rows from `start` on and before `stop`. All numbers are float32.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit

Floats = NDArray[np.float32]


@jit
def across(nodes: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of out, (N, W), of nodes, (N, m), every `stride` px, by weights (taps, stride), four taps or more."""
    taps, stride = weight.shape
    for row in range(start, stop):
        own, line = nodes[row], out[row]
        for cell in range(-(-line.size // stride)):
            here = line[cell * stride : (cell + 1) * stride]
            a, b, c, d = own[cell], own[cell + 1], own[cell + 2], own[cell + 3]
            for k in range(here.size):
                here[k] = fma(weight[3, k], d, fma(weight[2, k], c, fma(weight[1, k], b, weight[0, k] * a)))
            for tap in range(4, taps):
                for k in range(here.size):
                    here[k] = fma(weight[tap, k], own[cell + tap], here[k])


@jit
def down(lines: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of all planes of out, (B, C, H, W), of lines, (B, C, n, W), by weights (C, stride, taps)."""
    channels, height = out.shape[1:3]
    for row in range(start, stop):
        plane, line = divmod(row, height)
        i, c = divmod(plane, channels)
        between(lines[i, c], weight[c], line, out[i, c, line])


@jit
def between(lines: Floats, weight: Floats, line: int, out: Floats) -> None:
    """One row of pixels, (W,), of lines (n, W), by the weights (stride, taps) of its place in its cell."""
    cell, place = divmod(line, weight.shape[0])
    taps = weight[place]
    a, b, c, d = lines[cell], lines[cell + 1], lines[cell + 2], lines[cell + 3]
    for i in range(out.size):
        out[i] = fma(taps[3], d[i], fma(taps[2], c[i], fma(taps[1], b[i], taps[0] * a[i])))
    for tap in range(4, taps.size):
        more = lines[cell + tap]
        for i in range(out.size):
            out[i] = fma(taps[tap], more[i], out[i])
