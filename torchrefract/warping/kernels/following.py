"""What numba compiles: where earlier warps lead the pixels of a row that a later one has moved.

Their flows are known at the nodes of a lattice, one of them before the frame, by cubics between; or at every pixel, by
lines between; and outside of the frame as at its border. Of each it is told at what address its two planes begin, how
many rows and columns they have, and how many px the nodes are apart, 0 for pixels. Both numbers of a node lie together
where `TOGETHER` says so. All numbers are float32.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import floats_at, jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.following_pixels import FEWEST
from torchrefract.warping.kernels.pixels import Cells, Floats, Frame, Whole
from torchrefract.warping.kernels.places import room

if LANES:
    from torchrefract.warping.kernels.following_groups import follow_one
else:
    from torchrefract.warping.kernels.following_pixels import follow_one

Addresses = NDArray[np.uint64]


@jit
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
    more: of `room_beside`, of so many pixels or more.
    """
    for k in range(table.shape[0]):
        flow = floats_at(flows[k], 2 * table[k, 0] * table[k, 1])
        follow_one(x, y, flow, table[k], far[k], frame, cells, more)


@jit
def room_beside(width: int) -> Floats:
    """To work in, for rows of so many pixels."""
    return np.empty((4, max(width, FEWEST)), np.float32)


@jit
def follow(
    grid: Floats,
    addresses: Addresses,
    table: Whole,
    far: Floats,
    frame: Frame,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Rows of out, (B, 2, n, m): where flows lead a grid's positions, as for `follow_row`, with addresses (B, k)."""
    lines, columns = grid.shape[2:]
    cells, more = room(), room_beside(columns)
    for row in range(start, stop):
        i, line = divmod(row, lines)
        x, y = out[i, 0, line], out[i, 1, line]
        x[:], y[:] = grid[i, 0, line], grid[i, 1, line]
        follow_row(x, y, addresses[i], table, far, frame, cells, more)
