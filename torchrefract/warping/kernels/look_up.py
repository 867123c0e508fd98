"""What numba compiles: images looked up row by row, bilinearly, by the steps of F.grid_sample.

Rows are those of all pairs, one below the other; each call does those from `start` on and before `stop`. Numbers are
float32, but those of a source and of what it is looked up to may both be bytes, which are rounded. Arguments:

source, (B, C H W), and out, (B, C n m): with planes of channels, or the channels of each pixel together.
size: C, H, W, and how far a pixel is from the next one: 1 of planes, C of channels that lie together.
images, flows, (k,): the rows of the batches of source and out, and of flows, that belong together, in k pairs.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import jit
from torchrefract.warping.kernels.lines import between
from torchrefract.warping.kernels.pixels import (
    BORDER,
    Cells,
    Floats,
    Number,
    Size,
    Values,
    at_border,
    find_cells,
    find_cells_on_frame,
    in_frame,
    middle,
    of_two,
    to_pixels,
)

Whole = NDArray[np.int64]
_CHUNK = 512  # pixels that are looked up together: without a look at borders if all of them are inside


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
    """Look up along positions between the nodes of a lattice.

    lines (F, 2, n, W), weight (2, stride, taps): as for `between`; base_x (W,) and base_y (H,) are added.
    """
    height, width = base_y.size, base_x.size
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = np.empty(_CHUNK, np.int32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32)
    for row in range(start, stop):
        pair, line = divmod(row, height)
        image, flow = images[pair], flows[pair]
        between(lines[flow, 0], weight[0], line, x)
        between(lines[flow, 1], weight[1], line, y)
        for k in range(width):
            x[k] += base_x[k]
            y[k] += base_y[line]
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
    """Look up along positions that are known at every pixel.

    flow (F, 2, n, m): times the scales, with base_x (m,) and base_y (n,) added, within [-far, far], where also lies
    what is no number.
    """
    height, width = base_y.size, base_x.size
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    cells = np.empty(_CHUNK, np.int32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32)
    for row in range(start, stop):
        pair, line = divmod(row, height)
        image, u, v = images[pair], flow[flows[pair], 0, line], flow[flows[pair], 1, line]
        for k in range(width):
            x[k] = _within(base_x[k] + u[k] * scale_x, far)
            y[k] = _within(base_y[line] + v[k] * scale_y, far)
        _look_up(source[image], size, x, y, padding, cells, out[image], line, height)


@jit
def follow(
    grid: Floats,
    flow: Floats,
    flows: Whole,
    scale_x: Number,
    scale_y: Number,
    far: Number,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Rows of out, (B, 2, n, m): positions of a grid and, times the scales, the flow (F, 2, H, W) that is read there.

    Outside of the frame it is as at its border. The sums lie in [-far, far], where also lies what is no number.
    """
    lines, columns = grid.shape[2:]
    height, width = flow.shape[2:]
    x, y = np.empty(columns, np.float32), np.empty(columns, np.float32)
    cells = np.empty(columns, np.int32), np.empty(columns, np.float32), np.empty(columns, np.float32)
    for row in range(start, stop):
        i, line = divmod(row, lines)
        x[:], y[:] = grid[i, 0, line], grid[i, 1, line]
        to_pixels(x, width, BORDER)
        to_pixels(y, height, BORDER)
        find_cells_on_frame(x, y, height, width, cells)
        u, v = flow[flows[i], 0].reshape(height * width), flow[flows[i], 1].reshape(height * width)
        of_two(u, v, min(width - 1, 1), width if height > 1 else 0, cells, x, y)
        for k in range(columns):
            out[i, 0, line, k] = _within(grid[i, 0, line, k] + x[k] * scale_x, far)
            out[i, 1, line, k] = _within(grid[i, 1, line, k] + y[k] * scale_y, far)


@jit
def _within(place: Number, far: Number) -> Number:
    place = place if place <= far else far
    return place if place >= -far else -far


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

    These are overwritten; cells: room for what `find_cells` finds.
    """
    channels, height, width, step = size
    to_pixels(x, width, padding)
    to_pixels(y, height, padding)
    # From one channel to the next, of the source and of out, and where the row begins.
    apart = (height * width, lines * x.size, line * x.size) if step == 1 else (1, 1, line * x.size * step)
    for chunk in range(0, x.size, _CHUNK):
        first, last = chunk, min(chunk + _CHUNK, x.size)
        inside, beside = find_cells(x[first:last], y[first:last], height, width, cells)
        if beside:
            for c in range(channels):
                for k in range(first, last):
                    out[c * apart[1] + apart[2] + k * step] = 0
            continue
        if not inside:
            start, stop = middle(x, y, first, last, height, width)
            at_border(source, size, x, y, first, start, apart, out)
            at_border(source, size, x, y, stop, last, apart, out)
            first, last = start, stop
            if not find_cells(x[first:last], y[first:last], height, width, cells)[0]:
                at_border(source, size, x, y, first, last, apart, out)
                continue
        in_frame(source, size, cells, last - first, apart, out[apart[2] + first * step :])
