"""What numba compiles: the pixels of a row, each from the four around its position, by the steps of F.grid_sample.

Numbers are float32, but those of a source and of what it is looked up to may both be bytes, which are rounded. Both,
(C H W,), have planes of channels, or the channels of each pixel together. size: C, H, W, and how far a pixel is from
the next one: 1 of planes, C of channels that lie together.
"""

from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from torchrefract._jit import alone, fma, jit

ZEROS, BORDER, REFLECTION = range(3)

Floats = NDArray[np.float32]
Values = NDArray[Any]
Corners = NDArray[np.int32]
Number = np.float32
Index = np.uintp  # what has a sign could count from the end, and would be asked
Size = tuple[int, int, int, int]
Apart = tuple[int, int, int]  # from one channel to the next, of the source and of out, and where the row begins
Cells = tuple[Corners, Floats, Floats]
Frame = tuple[int, int]  # px, height and width
Whole = NDArray[np.int64]
CHUNK = 512  # pixels that are read together: without a look at borders if all of them are inside


@jit
def to_pixels(place: Floats, size: int, padding: int) -> None:
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
def read_row(source: Values, size: Size, x: Floats, y: Floats, cells: Cells, apart: Apart, out: Values) -> None:
    """A row of out, of a source, (C H W,), at positions (m,), px.

    cells: room for those of CHUNK pixels.
    """
    for chunk in range(0, x.size, CHUNK):
        read_part(source, size, x, y, chunk, min(chunk + CHUNK, x.size), cells, apart, out)


@jit
def read_part(
    source: Values,
    size: Size,
    x: Floats,
    y: Floats,
    first: int,
    last: int,
    cells: Cells,
    apart: Apart,
    out: Values,
) -> None:
    """Pixels first ... last of the row, CHUNK of them at most."""
    alone()
    channels, height, width, step = size
    inside, beside = find_cells(x[first:last], y[first:last], height, width, cells)
    if beside:
        for c in range(channels):
            for k in range(first, last):
                out[c * apart[1] + apart[2] + k * step] = 0
        return
    if not inside:
        start, stop = _middle(x, y, first, last, height, width)
        _at_border(source, size, x, y, first, start, apart, out)
        _at_border(source, size, x, y, stop, last, apart, out)
        first, last = start, stop
        if not find_cells(x[first:last], y[first:last], height, width, cells)[0]:
            _at_border(source, size, x, y, first, last, apart, out)
            return
    _in_frame(source, size, cells, last - first, apart, out[apart[2] + first * step :])


@jit
def find_cells(x: Floats, y: Floats, height: int, width: int, cells: Cells) -> tuple[bool, bool]:
    """Whether all four pixels around each position are in the frame, and whether none of them is.

    If all are: the first of the four, and how far behind it the position is along both axes.
    """
    corner, right, below = cells
    inside, beside = True, True
    for i in range(x.size):
        left, top = np.floor(x[i]), np.floor(y[i])
        inside &= (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
        beside &= (left < -1) | (top < -1) | (left >= width) | (top >= height)
        right[i], below[i] = x[i] - left, y[i] - top
        corner[i] = np.int32(top) * np.int32(width) + np.int32(left)
    return inside, beside


@jit
def _middle(x: Floats, y: Floats, start: int, stop: int, height: int, width: int) -> tuple[int, int]:
    """Where those begin and end that are left without the ones at both ends which are not inside."""
    while start < stop and not (0 <= x[start] < width - 1 and 0 <= y[start] < height - 1):
        start += 1
    while start < stop and not (0 <= x[stop - 1] < width - 1 and 0 <= y[stop - 1] < height - 1):
        stop -= 1
    return start, stop


@jit
def _in_frame(source: Values, size: Size, cells: Cells, count: int, apart: Apart, out: Values) -> None:
    """So many pixels of out, whose four pixels are all there; three channels at once, which share the weights."""
    channels, _, width, step = size
    c = 0
    while c + 3 <= channels:
        first, second, third = (
            source[c * apart[0] :],
            source[(c + 1) * apart[0] :],
            source[(c + 2) * apart[0] :],
        )
        into = out[c * apart[1] :], out[(c + 1) * apart[1] :], out[(c + 2) * apart[1] :]
        _of_three(first, second, third, width, step, cells, count, into[0], into[1], into[2])
        c += 3
    while c < channels:
        _of_one(source[c * apart[0] :], width, step, cells, count, out[c * apart[1] :])
        c += 1


@jit
def _of_three(
    first: Values,
    second: Values,
    third: Values,
    width: int,
    step: int,
    cells: Cells,
    count: int,
    first_out: Values,
    second_out: Values,
    third_out: Values,
) -> None:
    corner, right, below = cells
    each, wide = np.uintp(step), np.uintp(width * step)
    for i in range(count):
        here, into = np.uintp(corner[i]) * each, np.uintp(i) * each
        beside, under = here + each, here + wide
        last = under + each
        a, b, c, d = weights_at(right[i], below[i])
        _put(first_out, into, _sum(first, here, beside, under, last, a, b, c, d))
        _put(second_out, into, _sum(second, here, beside, under, last, a, b, c, d))
        _put(third_out, into, _sum(third, here, beside, under, last, a, b, c, d))


@jit
def _of_one(plane: Values, width: int, step: int, cells: Cells, count: int, out: Values) -> None:
    corner, right, below = cells
    each, wide = np.uintp(step), np.uintp(width * step)
    for i in range(count):
        here = np.uintp(corner[i]) * each
        beside, under = here + each, here + wide
        a, b, c, d = weights_at(right[i], below[i])
        _put(out, np.uintp(i) * each, _sum(plane, here, beside, under, under + each, a, b, c, d))


@jit
def weights_at(right: Number, below: Number) -> tuple[Number, Number, Number, Number]:
    """Of the four pixels around a position, from how far it is behind the first of them."""
    one = np.float32(1)
    return (one - right) * (one - below), right * (one - below), (one - right) * below, right * below


@jit
def _sum(
    plane: Values, here: Index, beside: Index, under: Index, last: Index, a: Number, b: Number, c: Number, d: Number
) -> Number:
    upper = fma(b, _number(plane[beside]), a * _number(plane[here]))
    return fma(d, _number(plane[last]), fma(c, _number(plane[under]), upper))


@jit
def _at_border(
    source: Values,
    size: Size,
    x: Floats,
    y: Floats,
    start: int,
    stop: int,
    apart: Apart,
    out: Values,
) -> None:
    """Pixels start ... stop of a row.

    Those that are not in the frame count nothing, whatever there is instead: a product with 0 need not be 0.
    """
    channels, height, width, step = size
    for i in range(start, stop):
        left, top = np.floor(x[i]), np.floor(y[i])
        column, row = np.int64(left), np.int64(top)
        a, b, c, d = weights_at(x[i] - left, y[i] - top)
        above, under = 0 <= row < height, -1 <= row < height - 1
        before, behind = 0 <= column < width, -1 <= column < width - 1
        here, into = (row * width + column) * step, apart[2] + i * step
        for _ in range(channels):
            total = np.float32(0)
            if above and before:
                total = a * _number(source[here])
            if above and behind:
                total = fma(b, _number(source[here + step]), total)
            if under and before:
                total = fma(c, _number(source[here + width * step]), total)
            if under and behind:
                total = fma(d, _number(source[here + width * step + step]), total)
            _put(out, np.uintp(into), total)
            here += apart[0]
            into += apart[1]


@jit
def _number(value: Any) -> Number:
    return np.float32(value)


def _put(out: Any, place: Any, value: Any) -> Any:
    """A number to its place, rounded if that is for bytes."""
    raise NotImplementedError("only in what is compiled")


@overload(_put)
def _put_into(out: Any, place: Any, value: Any) -> Any:
    if str(out.dtype) == "uint8":

        def put(out: Any, place: Any, value: Any) -> None:
            out[place] = np.uint8(np.int32(np.rint(min(value, np.float32(255)))))

    else:

        def put(out: Any, place: Any, value: Any) -> None:
            out[place] = value

    return put
