"""What numba compiles: where earlier warps lead the pixels of a row that a later one has moved.

Their flows are known every few px, bilinear between, and outside of the frame as at its border. Of each it is told at
what address its two planes begin, how many rows and columns they have, and how many px these are apart. All numbers are
float32.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import floats_at, inlined
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.pixels import Cells, Floats, Frame, Whole

if LANES:
    from torchrefract.warping.kernels.following_groups import follow_one
else:
    from torchrefract.warping.kernels.following_pixels import follow_one

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
