"""What numba compiles: pixels of rows, from the means along rays up to slices of the distance."""

import numpy as np

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.fields.kernels import pixels
from torchrefract.fields.kernels.nodes import Floats
from torchrefract.fields.kernels.pixels import GROUP, Across, Small
from torchrefract.fields.kernels.sheets import Whole

if LANES:
    from torchrefract.fields.kernels.groups import along_nodes
else:
    from torchrefract.fields.kernels.pixels import along_nodes

# Of each row of pixels the slice before it, (M, H), the part of the way to the next, and reach / d, at most 1.
Slices = tuple[Small, Floats, Floats]


@jit
def slices_of(distance: Floats, reach: float, count: int, cells: Small, wanted: Whole) -> Slices:
    """For distances (M, H) between `count` slices and 0; and which of them rays are asked for, wanted (M, rows, 2).

    cells: (H,), the first of the four rows of rays around each row of pixels.
    """
    rows, height = distance.shape
    first = np.empty((rows, height), np.int32)
    part, share = np.empty((rows, height), np.float32), np.empty((rows, height), np.float32)
    wanted[:, :, 0], wanted[:, :, 1] = count, -1
    for i in range(rows):
        for y in range(height):
            d = np.float64(distance[i, y])
            place = np.sqrt((d if d < reach else reach) * (count * (count + 1) / reach) + 0.25) - 0.5
            own = min(int(place), count - 1)
            first[i, y], part[i, y], share[i, y] = own, place - own, reach / (d if d > reach else reach)
            for row in range(cells[y], cells[y] + 4):
                wanted[i, row, 0] = min(wanted[i, row, 0], own)
                wanted[i, row, 1] = max(wanted[i, row, 1], own + 1)
    return first, part, share


@jit
def rows_of_pixels(
    volume: Floats, slices: Slices, cells: Small, weights: Floats, across: Across, start: int, stop: int, out: Floats
) -> None:
    """Rows `start` ... `stop` of the means of all frames, out (N, H, W), from a volume, (N, rows, slices, n).

    cells, (H,), and weights, (4, H), of the four rows of rays around each row of pixels; across: as for columns.
    """
    height, width = out.shape[1:]
    line = np.zeros(volume.shape[3] + 2 * GROUP, np.float32)
    found = np.empty(GROUP * -(-width // GROUP), np.float32)
    # Where frames are small, a group of pixels has more rays than can be read at once.
    near = across[1].size > 0 and across[1].max() + 3 < 2 * GROUP
    for at in range(start, stop):
        i, y = divmod(at, height)
        _down(volume[i], slices, min(i, slices[0].shape[0] - 1), y, cells[y], weights[:, y], line)
        if near:
            along_nodes(line, across, found)
        else:
            pixels.along_nodes(line, across, found)
        own = out[i, y]
        for k in range(width):
            mean = found[k] + np.float32(1)
            # Cubics overshoot where the contrast is high.
            own[k] = np.float32(0) if mean < 0 else mean


@inlined
def _down(volume: Floats, slices: Slices, frame: int, y: int, cell: int, weights: Floats, line: Floats) -> None:
    """The means at a row of pixels, where columns of rays are."""
    first, part, share = slices[0][frame, y], slices[1][frame, y], slices[2][frame, y]
    line[:] = 0
    for row in range(4):
        far = weights[row] * share * part
        near = weights[row] * share - far
        before, behind = volume[cell + row, first], volume[cell + row, first + 1]
        for k in range(volume.shape[2]):
            line[k] = fma(far, behind[k], fma(near, before[k], line[k]))
