"""What numba compiles: where one flow leads the pixels of a row, one after the other; see `following`."""

import numpy as np

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.pixels import (
    BORDER,
    Cells,
    Floats,
    Frame,
    Number,
    Whole,
    read_row,
    to_pixels,
)
from torchrefract.warping.kernels.places import within

Four = tuple[Number, Number, Number, Number]
TOGETHER = LANES == 8  # lie both numbers of a node, of flows on a lattice: one load takes those of four nodes
FEWEST = 256  # columns of `more`
_ONE, _TWO, _HALF, _SIXTH = np.float32(1), np.float32(2), np.float32(0.5), np.float32(1 / 6)


@jit
def follow_one(
    x: Floats,
    y: Floats,
    flow: Floats,
    place: Whole,
    far: Number,
    frame: Frame,
    cells: Cells,
    more: Floats,
) -> None:
    """As `following.follow_row` with one flow: its two planes, (2 n m,), and its row of the table."""
    rows, columns, stride = place
    at_x, at_y, found = more[0, : x.size], more[1, : x.size], more[2:].reshape(-1)
    at_x[:], at_y[:] = x, y
    to_pixels(at_x, frame[1], BORDER)
    to_pixels(at_y, frame[0], BORDER)
    if stride:
        for i in range(x.size):
            found[i], found[x.size + i] = between(flow, rows, columns, stride, at_x[i], at_y[i])
    else:
        read_row(flow, (2, rows, columns, 1), at_x, at_y, cells, (rows * columns, x.size, 0), found)
    scale_x, scale_y = np.float32(2 / frame[1]), np.float32(2 / frame[0])
    for i in range(x.size):
        x[i] = within(x[i] + found[i] * scale_x, far)
        y[i] = within(y[i] + found[x.size + i] * scale_y, far)


@inlined
def between(flow: Floats, rows: int, columns: int, stride: int, x: Number, y: Number) -> tuple[Number, Number]:
    """Both planes at a pixel of the frame, by cubics between nodes every `stride` px."""
    x, y = x * np.float32(1 / stride), y * np.float32(1 / stride)
    left, top = np.floor(x), np.floor(y)
    across, down = cubic_weights(x - left), cubic_weights(y - top)
    at = min(int(top), rows - 4) * columns + min(int(left), columns - 4)
    step, plane = (2, 1) if TOGETHER else (1, rows * columns)
    u = _between_four(flow, step * at, step, columns * step, across, down)
    return u, _between_four(flow, step * at + plane, step, columns * step, across, down)


@inlined
def _between_four(flow: Floats, at: int, step: int, line: int, across: Four, down: Four) -> Number:
    """One plane, of which nodes and their rows lie so far apart."""
    total = across[0] * _down(flow, at, line, down)
    for tap in range(1, 4):
        total = fma(across[tap], _down(flow, at + tap * step, line, down), total)
    return total


@inlined
def _down(flow: Floats, at: int, line: int, weights: Four) -> Number:
    here, apart = np.uintp(at), np.uintp(line)
    total = weights[0] * flow[here]
    for row in range(1, 4):
        here += apart
        total = fma(weights[row], flow[here], total)
    return total


@inlined
def cubic_weights(t: Number) -> Four:
    """Of the nodes at -1, 0, 1 and 2 for a place t, of the cubic through them."""
    before, behind, last = t + _ONE, t - _ONE, t - _TWO
    inner, outer = _HALF * (before * last), _SIXTH * (t * behind)
    return -outer * last, inner * behind, -inner * t, outer * before
