"""What numba compiles: fields between nodes, and images looked up row by row, by the steps of F.grid_sample.

Rows are those of all pictures, one below the other; each call does those from `start` on and before `stop`. All numbers
are float32. Arguments: source (B, C, H, W), out (B, C, n, m), images and flows (k,), the pictures of source and out and
the rows of the batch of flows that belong together, in k pairs.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit

ZEROS, BORDER, REFLECTION = range(3)
_CHUNK = 512  # pixels that are looked up together: without a look at borders if all of them are inside

Floats = NDArray[np.float32]
Whole = NDArray[np.int64]
Corners = NDArray[np.int32]
Number = np.float32


@jit
def down(lines: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of out, (B, C, H, W), of lines, (B, C, n, W), at every `stride` px, by weights (C, stride, taps)."""
    channels, height, width = out.shape[1:]
    for row in range(start, stop):
        plane, line = divmod(row, height)
        i, c = divmod(plane, channels)
        _between(lines[i, c], weight[c], line, 0, width, out[i, c, line])


@jit
def across(nodes: Floats, weight: Floats, start: int, stop: int, out: Floats) -> None:
    """Rows of out, (N, W), of nodes, (N, m), every `stride` px, by weights (taps, stride)."""
    taps, stride = weight.shape
    for row in range(start, stop):
        own, line = nodes[row], out[row]
        for cell in range(-(-line.size // stride)):
            here = line[cell * stride : (cell + 1) * stride]
            a, b, c, d = own[cell], own[cell + 1], own[cell + 2], own[cell + 3]
            for k in range(here.size):
                here[k] = fma(weight[3, k], d, fma(weight[2, k], c, fma(weight[1, k], b, weight[0, k] * a)))
            for tap in range(4, taps):
                for k in range(here.size):
                    here[k] = fma(weight[tap, k], own[cell + tap], here[k])


@jit
def look_up_lattice(
    source: Floats,
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
    """Look up along positions between the nodes of a lattice.

    lines (F, 2, n, W), weight (2, stride, taps): as for `down`; base_x (W,) and base_y (H,) are added.
    """
    height, width = out.shape[2:]
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    right, below, corner = np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.int32)
    for row in range(start, stop):
        pair, line = divmod(row, height)
        i, flow = images[pair], flows[pair]
        _between(lines[flow, 0], weight[0], line, 0, width, x)
        _between(lines[flow, 1], weight[1], line, 0, width, y)
        for k in range(width):
            x[k] += base_x[k]
            y[k] += base_y[line]
        _to_pixels(x, source.shape[3], padding)
        _to_pixels(y, source.shape[2], padding)
        for first in range(0, width, _CHUNK):
            last = min(first + _CHUNK, width)
            _look_up(source[i], x[first:last], y[first:last], padding, corner, right, below, out[i], line, first)


@jit
def look_up_dense(
    source: Floats,
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
    """Look up along positions that are known at every pixel.

    flow (F, 2, n, m): times the scales, with base_x (m,) and base_y (n,) added, within [-far, far], where also lies
    what is no number.
    """
    height, width = out.shape[2:]
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    right, below, corner = np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.int32)
    for row in range(start, stop):
        pair, line = divmod(row, height)
        i, u, v = images[pair], flow[flows[pair], 0, line], flow[flows[pair], 1, line]
        for k in range(width):
            x[k] = _within(base_x[k] + u[k] * scale_x, far)
            y[k] = _within(base_y[line] + v[k] * scale_y, far)
        _to_pixels(x, source.shape[3], padding)
        _to_pixels(y, source.shape[2], padding)
        for first in range(0, width, _CHUNK):
            last = min(first + _CHUNK, width)
            _look_up(source[i], x[first:last], y[first:last], padding, corner, right, below, out[i], line, first)


@jit
def _within(place: Number, far: Number) -> Number:
    place = place if place <= far else far
    return place if place >= -far else -far


@jit
def _between(lines: Floats, weight: Floats, line: int, first: int, last: int, out: Floats) -> None:
    """Pixels first ... last of a row, of lines (n, W), by the weights (stride, taps) of its place in its cell."""
    cell, place = divmod(line, weight.shape[0])
    taps = weight[place]
    a, b, c, d = (
        lines[cell, first:last],
        lines[cell + 1, first:last],
        lines[cell + 2, first:last],
        lines[cell + 3, first:last],
    )
    for i in range(out.size):
        out[i] = fma(taps[3], d[i], fma(taps[2], c[i], fma(taps[1], b[i], taps[0] * a[i])))
    for tap in range(4, taps.size):
        more = lines[cell + tap, first:last]
        for i in range(out.size):
            out[i] = fma(taps[tap], more[i], out[i])


@jit
def _look_up(
    source: Floats,
    x: Floats,
    y: Floats,
    padding: int,
    corner: Corners,
    right: Floats,
    below: Floats,
    out: Floats,
    line: int,
    first: int,
) -> None:
    """Pixels of a row of out (C, n, m), from `first` on, of a source (C, H, W) at the sampler's coordinates (N,).

    The coordinates are overwritten; corner, right and below (_CHUNK,) are room to work in.
    """
    channels, height, width = source.shape
    last = first + x.size
    inside, beside = _cells(x, y, height, width, corner, right, below)
    if inside:
        _in_frame(source, corner, right, below, out, line, first, last)
        return
    if beside:
        for c in range(channels):
            out[c, line, first:last] = 0
        return
    start, stop = _middle(x, y, height, width)
    _at_border(source, x[:start], y[:start], out, line, first)
    _at_border(source, x[stop:], y[stop:], out, line, first + stop)
    x, y = x[start:stop], y[start:stop]
    if _cells(x, y, height, width, corner, right, below)[0]:
        _in_frame(source, corner, right, below, out, line, first + start, first + stop)
    else:
        _at_border(source, x, y, out, line, first + start)


@jit
def _to_pixels(place: Floats, size: int, padding: int) -> None:
    """From the sampler's coordinates to px of an axis of so many pixels, on it where there is padding."""
    half, scale, last = np.float32(0.5), np.float32(size / 2), np.float32(size - 1)
    for i in range(place.size):
        place[i] = fma(place[i] + np.float32(1), scale, -half)
    if padding == REFLECTION:
        length, period = np.float32(size), np.float32(2 * size)
        beyond = False
        for i in range(place.size):
            at = abs(place[i] + half)
            place[i] = at
            beyond |= at > length
        if beyond:
            for i in range(place.size):
                at = place[i] - np.trunc(place[i] / period) * period
                place[i] = min(at, period - at)
        for i in range(place.size):
            place[i] -= half
    if padding != ZEROS:
        for i in range(place.size):
            place[i] = min(max(place[i], np.float32(0)), last)


@jit
def _cells(
    x: Floats, y: Floats, height: int, width: int, corner: Corners, right: Floats, below: Floats
) -> tuple[bool, bool]:
    """Whether all four pixels around each position are in the frame, and whether none of them is.

    If all are: the first of the four, and how far it is.
    """
    inside, beside = True, True
    for i in range(x.size):
        left, top = np.floor(x[i]), np.floor(y[i])
        inside &= (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
        beside &= (left < -1) | (top < -1) | (left >= width) | (top >= height)
        right[i], below[i] = x[i] - left, y[i] - top
        corner[i] = np.int32(top) * np.int32(width) + np.int32(left)
    return inside, beside


@jit
def _middle(x: Floats, y: Floats, height: int, width: int) -> tuple[int, int]:
    """Where those begin and end that are left without the ones at both ends which are not inside."""
    start, stop = 0, x.size
    while start < stop and not (0 <= x[start] < width - 1 and 0 <= y[start] < height - 1):
        start += 1
    while start < stop and not (0 <= x[stop - 1] < width - 1 and 0 <= y[stop - 1] < height - 1):
        stop -= 1
    return start, stop


@jit
def _in_frame(
    source: Floats, corner: Corners, right: Floats, below: Floats, out: Floats, line: int, start: int, stop: int
) -> None:
    """Pixels start ... stop of a row of out (C, n, m), whose four pixels of a source (C, H, W) are all there."""
    channels, height, width = source.shape
    planes, c, cells = source.reshape(channels, height * width), 0, (width, corner, right, below)
    while c + 3 <= channels:
        into = out[c, line, start:stop], out[c + 1, line, start:stop], out[c + 2, line, start:stop]
        _of_three(planes[c], planes[c + 1], planes[c + 2], *cells, *into)
        c += 3
    while c < channels:
        _of_one(planes[c], *cells, out[c, line, start:stop])
        c += 1


@jit
def _of_three(
    first: Floats,
    second: Floats,
    third: Floats,
    width: int,
    corner: Corners,
    right: Floats,
    below: Floats,
    first_out: Floats,
    second_out: Floats,
    third_out: Floats,
) -> None:
    """Of three channels (H W,) at once, which share the weights."""
    # What has a sign could count from the end, and would be asked.
    one, wide = np.uintp(1), np.uintp(width)
    for i in range(first_out.size):
        here = np.uintp(corner[i])
        under = here + wide
        a, b, c, d = _weights(right[i], below[i])
        first_out[i] = _sum(a, first[here], b, first[here + one], c, first[under], d, first[under + one])
        second_out[i] = _sum(a, second[here], b, second[here + one], c, second[under], d, second[under + one])
        third_out[i] = _sum(a, third[here], b, third[here + one], c, third[under], d, third[under + one])


@jit
def _of_one(plane: Floats, width: int, corner: Corners, right: Floats, below: Floats, out: Floats) -> None:
    one, wide = np.uintp(1), np.uintp(width)
    for i in range(out.size):
        here = np.uintp(corner[i])
        under = here + wide
        a, b, c, d = _weights(right[i], below[i])
        out[i] = _sum(a, plane[here], b, plane[here + one], c, plane[under], d, plane[under + one])


@jit
def _weights(right: Number, below: Number) -> tuple[Number, Number, Number, Number]:
    one = np.float32(1)
    return (one - right) * (one - below), right * (one - below), (one - right) * below, right * below


@jit
def _sum(a: Number, p: Number, b: Number, q: Number, c: Number, r: Number, d: Number, s: Number) -> Number:
    return fma(d, s, fma(c, r, fma(b, q, a * p)))


@jit
def _at_border(source: Floats, x: Floats, y: Floats, out: Floats, line: int, first: int) -> None:
    """Pixels of a row of out (C, n, m), from `first` on.

    Those that are not in the frame count nothing, whatever there is instead: a product with 0 need not be 0.
    """
    channels, height, width = source.shape
    for i in range(x.size):
        left, top = np.floor(x[i]), np.floor(y[i])
        column, row = np.int64(left), np.int64(top)
        a, b, c, d = _weights(x[i] - left, y[i] - top)
        above, under = 0 <= row < height, -1 <= row < height - 1
        before, behind = 0 <= column < width, -1 <= column < width - 1
        for channel in range(channels):
            total = np.float32(0)
            if above and before:
                total = a * source[channel, row, column]
            if above and behind:
                total = fma(b, source[channel, row, column + 1], total)
            if under and before:
                total = fma(c, source[channel, row + 1, column], total)
            if under and behind:
                total = fma(d, source[channel, row + 1, column + 1], total)
            out[channel, line, first + i] = total
