"""What numba compiles: where one flow leads the pixels of a row, one after the other; see `following`."""

import numpy as np

from torchrefract._jit import inlined
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


@inlined
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
    rows, columns, every = place
    more[0], more[1] = x, y
    to_pixels(more[0], frame[1], BORDER)
    to_pixels(more[1], frame[0], BORDER)
    share, found = np.float32(1 / every), more[2:].reshape(2 * x.size)
    for i in range(x.size):
        more[0, i] *= share
        more[1, i] *= share
    read_row(flow, (2, rows, columns, 1), more[0], more[1], cells, (rows * columns, x.size, 0), found)
    scale_x, scale_y = np.float32(2 / frame[1]), np.float32(2 / frame[0])
    for i in range(x.size):
        x[i] = within(x[i] + found[i] * scale_x, far)
        y[i] = within(y[i] + found[x.size + i] * scale_y, far)
