"""What numba compiles: a row of pixels between nodes, LANES at once, to the bits of `across`."""

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.across import Across
from torchrefract.warping.kernels.pixels import Floats


@inlined
def along_nodes(nodes: Floats, across: Across, out: Floats) -> None:
    """As `across.along_nodes`."""
    begins, cells, weights = across
    one, own = lanes.all_wholes(np.int32(1)), np.uintp(0)
    for group in range(begins.size):
        begin = np.uintp(begins[group])
        low, high = lanes.load(nodes, begin), lanes.load(nodes, begin + np.uintp(LANES))  # of strides of 2 and more
        cell = lanes.load_wholes(cells, own)
        found = lanes.product(lanes.load(weights[0], own), lanes.pick(low, high, cell))
        for tap in range(1, weights.shape[0]):
            cell = lanes.plus(cell, one)
            found = lanes.fma(lanes.load(weights[tap], own), lanes.pick(low, high, cell), found)
        lanes.store(out, np.uintp(group * LANES), found)
        own += np.uintp(LANES)
        if own >= np.uintp(cells.size):
            own = np.uintp(0)


@inlined
def both_along_nodes(nodes: Floats, across: Across, x: Floats, y: Floats) -> None:
    """The same of two rows of nodes, (2, n), at once."""
    begins, cells, weights = across
    one, own, behind = lanes.all_wholes(np.int32(1)), np.uintp(0), np.uintp(LANES)
    of_x, of_y = nodes[0], nodes[1]
    for group in range(begins.size):
        begin = np.uintp(begins[group])
        low_x, high_x = lanes.load(of_x, begin), lanes.load(of_x, begin + behind)
        low_y, high_y = lanes.load(of_y, begin), lanes.load(of_y, begin + behind)
        cell, weight = lanes.load_wholes(cells, own), lanes.load(weights[0], own)
        found_x = lanes.product(weight, lanes.pick(low_x, high_x, cell))
        found_y = lanes.product(weight, lanes.pick(low_y, high_y, cell))
        for tap in range(1, weights.shape[0]):
            cell, weight = lanes.plus(cell, one), lanes.load(weights[tap], own)
            found_x = lanes.fma(weight, lanes.pick(low_x, high_x, cell), found_x)
            found_y = lanes.fma(weight, lanes.pick(low_y, high_y, cell), found_y)
        at = np.uintp(group * LANES)
        lanes.store(x, at, found_x)
        lanes.store(y, at, found_y)
        own += behind
        if own >= np.uintp(cells.size):
            own = np.uintp(0)
