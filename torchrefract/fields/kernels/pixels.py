"""What numba compiles: noise at the pixels of a row, one after the other."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit
from torchrefract._lanes import LANES

Floats = NDArray[np.float32]
Small = NDArray[np.int32]
GROUP = LANES or 16  # pixels whose nodes are counted from the first of them
# Of each octave and group, the first node; of each octave and pixel, the node before it, counted from that one, the
# part p of the cell, and its fade.
Columns = tuple[Small, Small, Floats, Floats]
# Of each group of pixels the first node of a lattice; of each pixel its cell, counted from that one, and its weights of
# four nodes, (4, n), of so many groups that they repeat themselves; and the number of all nodes.
Across = tuple[Small, Small, Floats, int]


@jit
def nodes_across(taps: Floats, width: int) -> Across:
    """For a row of pixels between nodes, by the weights of cubics, (4, stride)."""
    stride, groups = taps.shape[1], -(-width // GROUP)
    begins, same = np.empty(groups, np.int32), 1
    while stride and same < groups and same * GROUP % stride:
        same += 1
    cells, weights = np.empty(same * GROUP, np.int32), np.empty((4, same * GROUP), np.float32)
    if stride == 0:
        return begins, cells, weights, 0
    for group in range(groups):
        begins[group] = group * GROUP // stride
    for k in range(same * GROUP):
        cell, place = divmod(k, stride)
        cells[k] = cell - begins[k // GROUP]
        weights[:, k] = taps[:, place]
    return begins, cells, weights, -(-width // stride) + 3


@jit
def along_nodes(nodes: Floats, across: Across, out: Floats) -> None:
    """A row of pixels in whole groups, out (W,), between nodes of a lattice, (n,), and what lies behind them."""
    begins, cells, weights, _ = across
    for k in range(out.size):
        own = np.uintp(k % cells.size)
        at = np.uintp(begins[k // GROUP] + cells[own])
        found = fma(weights[1, own], nodes[at + np.uintp(1)], weights[0, own] * nodes[at])
        found = fma(weights[2, own], nodes[at + np.uintp(2)], found)
        out[k] = fma(weights[3, own], nodes[at + np.uintp(3)], found)


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
