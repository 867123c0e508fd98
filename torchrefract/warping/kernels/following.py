"""What numba compiles: where earlier warps lead the pixels of a row that a later one has moved.

Their flows are known every few px, bilinear between, and outside of the frame as at its border. Of each it is told at
what address its two planes begin, how many rows and columns they have, and how many px these are apart. All numbers are
float32.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import floats_at, inlined
from torchrefract.warping.kernels.pixels import BORDER, Cells, Floats, Number, read_row, to_pixels
from torchrefract.warping.kernels.places import within

Frame = tuple[int, int]  # px, height and width
Whole = NDArray[np.int64]
Addresses = NDArray[np.uint64]


@inlined
def follow_row(
    x: Floats,
    y: Floats,
    flows: Addresses,
    table: Whole,
    far: Floats,
    frame: Frame,
    cells: Cells,
    more: Floats,
) -> None:
    """Replace positions x and y, (W,), in the sampler's coordinates by those where k flows lead.

    flows, (k,), and table, (k, 3): see above; what is read first comes first.
    far: (k,), within which sums lie, and where also lies what is no number.
    more: (4, W), to work in.
    """
    for k in range(table.shape[0]):
        flow = floats_at(flows[k], 2 * table[k, 0] * table[k, 1])
        follow_one(x, y, flow, table[k], far[k], frame, cells, more)


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
    """The same with one flow."""
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
