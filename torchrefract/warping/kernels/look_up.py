"""What numba compiles: images looked up row by row, bilinearly, by the steps of F.grid_sample.

Rows are those of all pairs, one below the other; each call does those from `start` on and before `stop`. Numbers are
float32, but those of a source and of what it is looked up to may both be bytes, which are rounded. Arguments:

source, (B, C H W), and out, (B, C n m): with planes of channels, or the channels of each pixel together.
size: C, H, W, and how far a pixel is from the next one: 1 of planes, C of channels that lie together.
images, flows, (k,): the rows of the batches of source and out, and of flows, that belong together, in k pairs.
"""

import numpy as np

from torchrefract._jit import jit
from torchrefract._lanes import LANES
from torchrefract.warping.kernels.across import GROUP
from torchrefract.warping.kernels.composed import Earlier, Known, Last, along_followed, room_for
from torchrefract.warping.kernels.pixels import Cells, Floats, Number, Size, Values, Whole, to_pixels
from torchrefract.warping.kernels.places import along_lattice, along_pixels, room

if LANES:
    from torchrefract.warping.kernels.groups import read_row
else:
    from torchrefract.warping.kernels.pixels import read_row


@jit
def look_up_lattice(
    source: Values,
    size: Size,
    images: Whole,
    lines: Floats,
    flows: Whole,
    weight: Floats,
    base_x: Floats,
    base_y: Floats,
    padding: int,
    start: int,
    stop: int,
    out: Values,
) -> None:
    """Look up along positions between the nodes of a lattice, as for `along_lattice`, with lines (F, 2, n, W)."""
    height, width = base_y.size, base_x.size
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = room()
    for row in range(start, stop):
        pair, line = divmod(row, height)
        image, flow = images[pair], flows[pair]
        along_lattice(lines[flow], weight, base_x, base_y, line, x, y)
        _look_up(source[image], size, x, y, padding, cells, out[image], line, height)


@jit
def look_up_dense(
    source: Values,
    size: Size,
    images: Whole,
    flow: Floats,
    flows: Whole,
    base_x: Floats,
    base_y: Floats,
    scale_x: Number,
    scale_y: Number,
    far: Number,
    padding: int,
    start: int,
    stop: int,
    out: Values,
) -> None:
    """Look up along positions that are known at every pixel, as for `along_pixels`, with flow (F, 2, n, m)."""
    height, width = base_y.size, base_x.size
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = room()
    for row in range(start, stop):
        pair, line = divmod(row, height)
        image = images[pair]
        along_pixels(flow[flows[pair]], base_x, base_y, scale_x, scale_y, far, line, x, y)
        _look_up(source[image], size, x, y, padding, cells, out[image], line, height)


@jit
def look_up_followed(
    source: Values,
    size: Size,
    images: Whole,
    last: Last,
    earlier: Earlier,
    known: Known,
    padding: int,
    start: int,
    stop: int,
    out: Values,
) -> None:
    """Look up along positions as for `along_followed`."""
    width, height = last[3].size, last[4].size
    space, whole = room_for(known, width), GROUP * -(-width // GROUP)
    x, y, cells = np.empty(whole, np.float32), np.empty(whole, np.float32), room()
    for row in range(start, stop):
        pair, line = divmod(row, height)
        image = images[pair]
        along_followed(last, earlier, known, pair, line, space, x, y)
        _look_up(source[image], size, x[:width], y[:width], padding, cells, out[image], line, height)


@jit
def _look_up(
    source: Values,
    size: Size,
    x: Floats,
    y: Floats,
    padding: int,
    cells: Cells,
    out: Values,
    line: int,
    lines: int,
) -> None:
    """A row of out, which has so many, of a source, (C H W,), at the sampler's coordinates, (m,).

    These are overwritten; cells: room for `read_row`.
    """
    _, height, width, step = size
    to_pixels(x, width, padding)
    to_pixels(y, height, padding)
    apart = (height * width, lines * x.size, line * x.size) if step == 1 else (1, 1, line * x.size * step)
    read_row(source, size, x, y, cells, apart, out)
