"""What numba compiles: gradients of images that were looked up, added to the pixels that were read.

Tasks are bands of rows, of all pairs; each call does those from `start` on and before `stop`. All numbers are float32.
What the kernels take:

upstream, (B, C n m): the gradient of what was looked up.
size: C, H and W of the images.
images, flows, (k,): the rows of the batches of images, and of flows, that belong together, in k pairs.
out, (B, P, C H W): the gradients of the images, zeros at first; what each of P bands adds by itself.
"""

import numpy as np

from torchrefract._jit import inlined, jit
from torchrefract.warping.kernels.across import GROUP
from torchrefract.warping.kernels.composed import Earlier, Known, Last, along_followed, room_for
from torchrefract.warping.kernels.pixels import CHUNK, Cells, Floats, Number, Whole, find_cells, to_pixels, weights_at
from torchrefract.warping.kernels.places import along_lattice, along_pixels, room

Frame = tuple[int, int, int]


@jit
def scatter_lattice(
    upstream: Floats,
    size: Frame,
    images: Whole,
    lines: Floats,
    flows: Whole,
    weight: Floats,
    base_x: Floats,
    base_y: Floats,
    padding: int,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Of a look-up along positions between the nodes of a lattice, as for `along_lattice`, with lines (F, 2, n, W)."""
    height, width, bands = base_y.size, base_x.size, out.shape[1]
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = room()
    for task in range(start, stop):
        pair, band = divmod(task, bands)
        image, flow = images[pair], flows[pair]
        for line in range(height * band // bands, height * (band + 1) // bands):
            along_lattice(lines[flow], weight, base_x, base_y, line, x, y)
            _scatter(upstream[image], size, x, y, padding, cells, line, height, out[image, band])


@jit
def scatter_followed(
    upstream: Floats,
    size: Frame,
    images: Whole,
    last: Last,
    earlier: Earlier,
    known: Known,
    padding: int,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Of a look-up along positions as for `along_followed`."""
    width, height, bands = last[3].size, last[4].size, out.shape[1]
    space, whole = room_for(known, width), GROUP * -(-width // GROUP)
    x, y, cells = np.empty(whole, np.float32), np.empty(whole, np.float32), room()
    for task in range(start, stop):
        pair, band = divmod(task, bands)
        image = images[pair]
        for line in range(height * band // bands, height * (band + 1) // bands):
            along_followed(last, earlier, known, pair, line, space, x, y)
            _scatter(upstream[image], size, x[:width], y[:width], padding, cells, line, height, out[image, band])


@jit
def scatter_dense(
    upstream: Floats,
    size: Frame,
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
    out: Floats,
) -> None:
    """Of a look-up along positions that are known at every pixel, as for `along_pixels`, with flow (F, 2, n, m)."""
    height, width, bands = base_y.size, base_x.size, out.shape[1]
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = room()
    for task in range(start, stop):
        pair, band = divmod(task, bands)
        image = images[pair]
        for line in range(height * band // bands, height * (band + 1) // bands):
            along_pixels(flow[flows[pair]], base_x, base_y, scale_x, scale_y, far, line, x, y)
            _scatter(upstream[image], size, x, y, padding, cells, line, height, out[image, band])


@jit
def _scatter(
    upstream: Floats,
    size: Frame,
    x: Floats,
    y: Floats,
    padding: int,
    cells: Cells,
    line: int,
    lines: int,
    out: Floats,
) -> None:
    """A row of upstream, which has so many, looked up at the sampler's coordinates, (m,), which are overwritten."""
    channels, height, width = size
    to_pixels(x, width, padding)
    to_pixels(y, height, padding)
    for first in range(0, x.size, CHUNK):
        last = min(first + CHUNK, x.size)
        inside, beside = find_cells(x[first:last], y[first:last], height, width, cells)
        for c in range(0 if beside else channels):
            begin = (c * lines + line) * x.size
            own, plane = upstream[begin + first : begin + last], out[c * height * width : (c + 1) * height * width]
            if inside:
                _to_frame(own, width, cells, plane)
            else:
                _to_border(own, x[first:last], y[first:last], height, width, plane)


@inlined
def _to_frame(upstream: Floats, width: int, cells: Cells, plane: Floats) -> None:
    corner, right, below = cells
    one = np.uintp(1)
    for k in range(upstream.size):
        a, b, c, d = weights_at(right[k], below[k])
        here = np.uintp(corner[k])
        under = here + np.uintp(width)
        plane[here] += a * upstream[k]
        plane[here + one] += b * upstream[k]
        plane[under] += c * upstream[k]
        plane[under + one] += d * upstream[k]


@inlined
def _to_border(upstream: Floats, x: Floats, y: Floats, height: int, width: int, plane: Floats) -> None:
    """Pixels that are not in the frame have no gradient."""
    for k in range(upstream.size):
        left, top = np.floor(x[k]), np.floor(y[k])
        column, row = np.int64(left), np.int64(top)
        a, b, c, d = weights_at(x[k] - left, y[k] - top)
        above, under = 0 <= row < height, -1 <= row < height - 1
        before, behind = 0 <= column < width, -1 <= column < width - 1
        here = row * width + column
        if above and before:
            plane[np.uintp(here)] += a * upstream[k]
        if above and behind:
            plane[np.uintp(here + 1)] += b * upstream[k]
        if under and before:
            plane[np.uintp(here + width)] += c * upstream[k]
        if under and behind:
            plane[np.uintp(here + width + 1)] += d * upstream[k]
