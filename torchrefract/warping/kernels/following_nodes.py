"""What numba compiles: the same as `following_pixels` between nodes both numbers of which lie together, to its bits.

8 pixels at once: of each, four lines of four nodes are loaded and added up, and then put side by side. What weighs them
is made for some groups before any of them reads: from memory one load has a number in all lanes.
"""

from typing import Any

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels import following_pixels
from torchrefract.warping.kernels.across import Small
from torchrefract.warping.kernels.lane_weights import cubic_weights, moved, to_pixels
from torchrefract.warping.kernels.pixels import Cells, Floats, Frame, Number, Whole

Lanes = Any
_PIXELS = following_pixels.FEWEST // 8  # that are weighed before they are read


@jit
def follow_nodes(
    x: Floats,
    y: Floats,
    flow: Floats,
    place: Whole,
    far: Number,
    frame: Frame,
    cells: Cells,
    more: Floats,
) -> None:
    """As `following_pixels.follow_one`, of a flow on a lattice."""
    if x.size < LANES:
        following_pixels.follow_one(x, y, flow, place, far, frame, cells, more)
        return
    rows, columns, stride = place
    weights, places, end = more[0], cells[0], x.size - LANES
    last_x, last_y = lanes.load(x, np.uintp(end)), lanes.load(y, np.uintp(end))
    for begin in range(0, x.size, _PIXELS):
        count = min(_PIXELS, x.size - begin)
        for first in range(0, count, LANES):
            start = min(begin + first, end)  # the last group does again what the one before it did
            at_x, at_y = lanes.load(x, np.uintp(start)), lanes.load(y, np.uintp(start))
            if start < begin + first:
                at_x, at_y = last_x, last_y
            place_x, place_y = to_pixels(at_x, frame[1]), to_pixels(at_y, frame[0])
            _weigh(place_x, place_y, rows, columns, stride, first, places, weights)
        for first in range(0, count, LANES):
            start = min(begin + first, end)
            at_x, at_y = lanes.load(x, np.uintp(start)), lanes.load(y, np.uintp(start))
            if start < begin + first:
                at_x, at_y = last_x, last_y
            u, v = _between(flow, columns, places, weights, first)
            lanes.store(x, np.uintp(start), moved(at_x, u, frame[1], far))
            lanes.store(y, np.uintp(start), moved(at_y, v, frame[0], far))


@inlined
def _weigh(x: Lanes, y: Lanes, rows: int, columns: int, stride: int, own: int, places: Small, weights: Floats) -> None:
    """Where a group reads, and the weights of lines and of nodes in them."""
    share = lanes.all_floats(np.float32(1 / stride))
    x, y = lanes.product(x, share), lanes.product(y, share)
    left, top = lanes.floor(x), lanes.floor(y)
    column = lanes.smaller(lanes.to_wholes(left), lanes.all_wholes(np.int32(columns - 4)))
    row = lanes.smaller(lanes.to_wholes(top), lanes.all_wholes(np.int32(rows - 4)))
    at = lanes.plus(lanes.times(row, lanes.all_wholes(np.int32(columns))), column)
    lanes.store_wholes(places, np.uintp(own), lanes.plus(at, at))
    down, across = cubic_weights(lanes.difference(y, top)), cubic_weights(lanes.difference(x, left))
    for k in range(4):
        lanes.store(weights, np.uintp(own + k * _PIXELS), down[k])
        lanes.store(weights, np.uintp(own + (4 + k) * _PIXELS), across[k])


@inlined
def _between(flow: Floats, columns: int, places: Small, weights: Floats, own: int) -> tuple[Lanes, Lanes]:
    """Both planes at a group of pixels."""
    at, apart = np.uintp(own), np.uintp(_PIXELS)
    u0, v0, u1, v1, u2, v2, u3, v3 = lanes.sums_of_eights(flow, places, weights, at, np.uintp(2 * columns), apart)
    at += np.uintp(4) * apart
    weight = lanes.load(weights, at)
    u, v = lanes.product(weight, u0), lanes.product(weight, v0)
    weight = lanes.load(weights, at + apart)
    u, v = lanes.fma(weight, u1, u), lanes.fma(weight, v1, v)
    weight = lanes.load(weights, at + np.uintp(2) * apart)
    u, v = lanes.fma(weight, u2, u), lanes.fma(weight, v2, v)
    weight = lanes.load(weights, at + np.uintp(3) * apart)
    return lanes.fma(weight, u3, u), lanes.fma(weight, v3, v)
