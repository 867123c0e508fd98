"""What numba compiles: a row of pixels between nodes every few px, one after the other."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.pixels import Floats

Small = NDArray[np.int32]
GROUP = LANES or 16  # pixels whose nodes are counted from the first of them
# Of each group of pixels the first node; of each pixel its cell, counted from that one, and the weights of the nodes
# from there on, (taps, n), of so many groups that they repeat themselves.
Across = tuple[Small, Small, Floats]


@jit
def nodes_across(taps: Floats, width: int) -> Across:
    """For a row of pixels, by the weights of the nodes around each place in a cell, (taps, stride)."""
    stride, groups = taps.shape[1], -(-width // GROUP)
    begins, same = np.empty(groups, np.int32), 1
    while stride and same < groups and same * GROUP % stride:
        same += 1
    cells, weights = np.empty(same * GROUP, np.int32), np.empty((taps.shape[0], same * GROUP), np.float32)
    if stride == 0:
        return begins, cells, weights
    for group in range(groups):
        begins[group] = group * GROUP // stride
    for k in range(same * GROUP):
        cell, place = divmod(k, stride)
        cells[k] = cell - begins[k // GROUP]
        weights[:, k] = taps[:, place]
    return begins, cells, weights


@jit
def along_nodes(nodes: Floats, across: Across, out: Floats) -> None:
    """A row of pixels in whole groups, out (W,), between nodes, (n,), and what lies behind them."""
    begins, cells, weights = across
    for k in range(out.size):
        own = np.uintp(k % cells.size)
        at = np.uintp(begins[k // GROUP] + cells[own])
        found = weights[0, own] * nodes[at]
        for tap in range(1, weights.shape[0]):
            at += np.uintp(1)
            found = fma(weights[tap, own], nodes[at], found)
        out[k] = found


@jit
def both_along_nodes(nodes: Floats, across: Across, x: Floats, y: Floats) -> None:
    """The same of two rows of nodes, (2, n), at once."""
    along_nodes(nodes[0], across, x)
    along_nodes(nodes[1], across, y)


@jit
def along_every_second(nodes: Floats, taps: Floats, out: Floats) -> None:
    """As `along_nodes`, between nodes every 2 px: pairs of pixels take the same of them, which no lane has to pick."""
    a, b, c, d = taps[0, 0], taps[1, 0], taps[2, 0], taps[3, 0]
    at_a, at_b, at_c, at_d = taps[0, 1], taps[1, 1], taps[2, 1], taps[3, 1]
    for k in range(out.size // 2):
        at = np.uintp(k)
        first, second = nodes[at], nodes[at + np.uintp(1)]
        third, fourth = nodes[at + np.uintp(2)], nodes[at + np.uintp(3)]
        out[np.uintp(2) * at] = fma(d, fourth, fma(c, third, fma(b, second, a * first)))
        found = fma(at_d, fourth, fma(at_c, third, fma(at_b, second, at_a * first)))
        out[np.uintp(2) * at + np.uintp(1)] = found
