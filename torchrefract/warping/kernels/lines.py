"""What numba compiles: fields between the nodes of a lattice.

Each call does the rows from `start` on and before `stop`. All numbers are float32.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.across import GROUP, Across, nodes_across

if LANES:
    from torchrefract.warping.kernels.across_groups import along_nodes
else:
    from torchrefract.warping.kernels.across import along_nodes

Floats = NDArray[np.float32]


@jit
def across(nodes: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of out, (N, W), of nodes, (N, m), every `stride` px, by weights (taps, stride)."""
    along = nodes_across(weight, out.shape[1])
    # Behind the last nodes as many are read as a group may have.
    own, line = np.zeros(nodes.shape[1] + 2 * GROUP, np.float32), np.empty(along[0].size * GROUP, np.float32)
    for row in range(start, stop):
        own[: nodes.shape[1]] = nodes[row]
        _along(own, along, line, out[row])


@jit
def across_twice(nodes: Floats, first: Floats, second: Floats, start: int, stop: int, out: Floats) -> None:
    """The same by two weights: rows of both planes of out, (B, 2, n, W), of nodes, (B n, m)."""
    along_first, along_second = nodes_across(first, out.shape[3]), nodes_across(second, out.shape[3])
    own = np.zeros(nodes.shape[1] + 2 * GROUP, np.float32)
    line = np.empty(along_first[0].size * GROUP, np.float32)
    for row in range(start, stop):
        i, own_row = divmod(row, out.shape[2])
        own[: nodes.shape[1]] = nodes[row]
        _along(own, along_first, line, out[i, 0, own_row])
        _along(own, along_second, line, out[i, 1, own_row])


@inlined
def _along(nodes: Floats, across: Across, line: Floats, out: Floats) -> None:
    """A row of pixels, out (W,), by way of a line in whole groups where these do not fill it."""
    if line.size == out.size:
        along_nodes(nodes, across, out)
        return
    along_nodes(nodes, across, line)
    out[:] = line[: out.size]


@jit
def down(lines: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of all planes of out, (B, C, H, W), of lines, (B, C, n, W), by weights (C, stride, taps)."""
    channels, height = out.shape[1:3]
    for row in range(start, stop):
        plane, line = divmod(row, height)
        i, c = divmod(plane, channels)
        between(lines[i, c], weight[c], line, out[i, c, line])


@jit
def between(lines: Floats, weight: Floats, line: int, out: Floats, first: int = 0) -> None:
    """A row of pixels, (m,), from the `first` on, of lines (n, W), by the weights (stride, taps) of its place."""
    cell, place = divmod(line, weight.shape[0])
    taps, last = weight[place], first + out.size
    a, b, c, d = lines[cell], lines[cell + 1], lines[cell + 2], lines[cell + 3]
    a, b, c, d = a[first:last], b[first:last], c[first:last], d[first:last]
    for i in range(out.size):
        out[i] = fma(taps[3], d[i], fma(taps[2], c[i], fma(taps[1], b[i], taps[0] * a[i])))
    for tap in range(4, taps.size):
        more = lines[cell + tap, first:last]
        for i in range(out.size):
            out[i] = fma(taps[tap], more[i], out[i])
