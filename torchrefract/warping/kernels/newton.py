"""What numba compiles: Newton's method on a flow, each pixel by itself; `invert_flow` has the equations.

Arguments: flow, (B, 2, H, W), px, finite. Rows are those of all samples, one below the other; each call does those from
`start` on and before `stop`.
"""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, jit

Floats = NDArray[np.float32]
Number = np.float32
Matrix = tuple[Number, Number, Number, Number]  # xx, xy, yx, yy
Pixels = NDArray[np.int32]
Index = np.uintp  # what has a sign could count from the end, and would be asked
Cell = tuple[Index, Index, Index, Index, Number, Number]  # rows, columns, and how far behind the first of each
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_FLAT = np.float32(0.1)  # of determinants: what is nearer to a fold has no step of a good length


@jit
def determinants(flow: Floats, start: int, stop: int, out: Floats) -> None:
    """That of I + the slopes of the flow at each pixel, out (B, H, W)."""
    height, width = flow.shape[2:]
    slopes = np.empty((4, width), np.float32)
    for row in range(start, stop):
        i, line = divmod(row, height)
        _jacobians(flow[i, 0], flow[i, 1], line, slopes)
        _determinants(slopes, out[i, line])


@jit
def least_determinants(flow: Floats, start: int, stop: int, out: Floats) -> None:
    """The smallest of them in each row, out (B H,)."""
    height, width = flow.shape[2:]
    slopes, found = np.empty((4, width), np.float32), np.empty(width, np.float32)
    for row in range(start, stop):
        i, line = divmod(row, height)
        _jacobians(flow[i, 0], flow[i, 1], line, slopes)
        _determinants(slopes, found)
        out[row] = found.min()


@jit
def _determinants(jacobians: Floats, out: Floats) -> None:
    xx, xy, yx, yy = jacobians[0], jacobians[1], jacobians[2], jacobians[3]
    for k in range(out.size):
        out[k] = fma(xx[k], yy[k], -(xy[k] * yx[k]))


@jit
def solve(
    flow: Floats,
    upright: Number,
    steps: int,
    at_once: int,
    near: Number,
    farthest: Number,
    start: int,
    stop: int,
    inverse: Floats,
    error: Floats,
) -> None:
    """The inverse, (B, 2, H, W), px, and its error, (B, H, W), px.

    upright: of determinants; pixels of a smaller one begin without slopes.
    at_once: how many steps take the slopes at p; later ones take those at p + inverse.
    near: px, the error that calls for no further step.
    farthest: px, how long the inverse may be.
    """
    height, width = flow.shape[2:]
    slopes, pixels = np.empty((4, width), np.float32), np.empty(width, np.int32)
    for row in range(start, stop):
        i, line = divmod(row, height)
        _begin(flow[i], line, upright, farthest, slopes, inverse[i])
        for k in range(width):
            pixels[k] = k
        left = width
        for step in range(steps + 1):
            last, again = step == steps, step >= at_once
            left = _step(flow[i], line, last, again, near, farthest, slopes, pixels, left, inverse[i], error[i])
            if left == 0:
                break
        own = error[i, line]
        for k in range(width):
            own[k] = np.sqrt(own[k])


@jit
def read_at(planes: Floats, inverse: Floats, start: int, stop: int, out: Floats) -> None:
    """Planes, (B, H, W), at p + inverse, (B, 2, H, W), px; out (B, H, W)."""
    height, width = planes.shape[1:]
    for row in range(start, stop):
        i, line = divmod(row, height)
        u, v, into = inverse[i, 0, line], inverse[i, 1, line], out[i, line]
        for k in range(width):
            into[k] = _read(planes[i], _cell(u[k], v[k], line, k, height, width))


@jit
def _begin(flow: Floats, line: int, upright: Number, farthest: Number, inverses: Floats, out: Floats) -> None:
    """The inverse Jacobians of a row, (4, W), and out, (2, H, W), after the first step, which has nothing to read."""
    u, v = flow[0, line], flow[1, line]
    into_u, into_v = out[0, line], out[1, line]
    xx, xy, yx, yy = inverses[0], inverses[1], inverses[2], inverses[3]
    _jacobians(flow[0], flow[1], line, inverses)
    for k in range(u.size):
        if fma(xx[k], yy[k], -(xy[k] * yx[k])) < upright:
            xx[k], xy[k], yx[k], yy[k] = _ONE, _ZERO, _ZERO, _ONE
        inverse = _inverse((xx[k], xy[k], yx[k], yy[k]))
        xx[k], xy[k], yx[k], yy[k] = inverse
        into_u[k], into_v[k] = _stepped(inverse, _ZERO, _ZERO, u[k], v[k], farthest)


@jit
def _step(
    flow: Floats,
    line: int,
    last: bool,
    again: bool,
    near: Number,
    farthest: Number,
    inverses: Floats,
    pixels: Pixels,
    count: int,
    out: Floats,
    errors: Floats,
) -> int:
    """How many of the first `count` pixels of a row have taken another step; they come first now.

    last: only look, take none.
    again: with slopes read anew.
    """
    plane_u, plane_v = flow[0], flow[1]
    height, width = plane_u.shape
    u, v, error = out[0, line], out[1, line], errors[line]
    xx, xy, yx, yy = inverses[0], inverses[1], inverses[2], inverses[3]
    left = 0
    for k in range(count):
        column = np.uintp(pixels[k])
        own_u, own_v = u[column], v[column]
        cell = _cell(own_u, own_v, line, int(pixels[k]), height, width)
        error_u, error_v = _read(plane_u, cell) + own_u, _read(plane_v, cell) + own_v
        square = fma(error_u, error_u, error_v * error_v)
        error[column] = square
        if last or square <= near * near:
            continue
        if again:
            inverse = _inverse(_jacobian_in(plane_u, plane_v, cell))
        else:
            inverse = xx[column], xy[column], yx[column], yy[column]
        u[column], v[column] = _stepped(inverse, own_u, own_v, error_u, error_v, farthest)
        pixels[left] = pixels[k]
        left += 1
    return left


@jit
def _stepped(
    inverse: Matrix, u: Number, v: Number, error_u: Number, error_v: Number, farthest: Number
) -> tuple[Number, Number]:
    """The inverse of the flow after a step, no longer than any flow, so that it is a number."""
    xx, xy, yx, yy = inverse
    u, v = fma(xy, error_v, fma(-xx, error_u, u)), fma(yx, error_u, fma(-yy, error_v, v))
    return min(max(u, -farthest), farthest), min(max(v, -farthest), farthest)


@jit
def _inverse(jacobian: Matrix) -> Matrix:
    """Of a Jacobian, [[xx, -xy], [-yx, yy]]; also for that of a fold, the residual tells the rest."""
    xx, xy, yx, yy = jacobian
    determinant = fma(xx, yy, -(xy * yx))
    scale = _ONE / np.copysign(max(abs(determinant), _FLAT), determinant)
    return yy * scale, xy * scale, yx * scale, xx * scale


@jit
def _jacobians(u: Floats, v: Floats, line: int, out: Floats) -> None:
    """I + the slopes in a row of the planes (H, W), (4, W), by central differences, one-sided at the border."""
    height, width = u.shape
    above, below = max(line - 1, 0), min(line + 1, height - 1)
    down = _HALF if below - above == 2 else _ONE
    for k, (plane, own) in enumerate(((u, 0), (v, 2))):
        here, up, under, along, across = plane[line], plane[above], plane[below], out[own], out[own + 1]
        for column in range(1, width - 1):
            along[column] = (here[column + 1] - here[column - 1]) * _HALF
        if width > 1:
            along[0], along[width - 1] = here[1] - here[0], here[width - 1] - here[width - 2]
        else:
            along[0] = 0
        for column in range(width):
            across[column] = (under[column] - up[column]) * down
        diagonal = along if k == 0 else across
        for column in range(width):
            diagonal[column] += _ONE


@jit
def _jacobian(u: Floats, v: Floats, line: np.uintp, column: np.uintp) -> Matrix:
    """The same at one pixel."""
    one = np.uintp(1)
    height, width = np.uintp(u.shape[0]), np.uintp(u.shape[1])
    left, right = column - one if column > 0 else column, column + one if column + one < width else column
    above, below = line - one if line > 0 else line, line + one if line + one < height else line
    across = _HALF if right - left > one else _ONE
    down = _HALF if below - above > one else _ONE
    return (
        (u[line, right] - u[line, left]) * across + _ONE,
        (u[below, column] - u[above, column]) * down,
        (v[line, right] - v[line, left]) * across,
        (v[below, column] - v[above, column]) * down + _ONE,
    )


@jit
def _jacobian_in(u: Floats, v: Floats, cell: Cell) -> Matrix:
    """The same between pixels."""
    top, bottom, left, right, x, y = cell
    a, b, c, d = (_ONE - x) * (_ONE - y), x * (_ONE - y), (_ONE - x) * y, x * y
    p, q = _jacobian(u, v, top, left), _jacobian(u, v, top, right)
    r, s = _jacobian(u, v, bottom, left), _jacobian(u, v, bottom, right)
    return (
        a * p[0] + b * q[0] + c * r[0] + d * s[0],
        a * p[1] + b * q[1] + c * r[1] + d * s[1],
        a * p[2] + b * q[2] + c * r[2] + d * s[2],
        a * p[3] + b * q[3] + c * r[3] + d * s[3],
    )


@jit
def _cell(u: Number, v: Number, line: int, column: int, height: int, width: int) -> Cell:
    """Around a pixel moved by (u, v), on the frame."""
    left, right, x = _side(u, column, width)
    top, bottom, y = _side(v, line, height)
    return top, bottom, left, right, x, y


@jit
def _side(shift: Number, place: int, size: int) -> tuple[Index, Index, Number]:
    # The whole pixels apart, so that no digit of a small shift is lost beside a large place.
    whole = np.floor(shift)
    first, part = np.int64(whole) + place, shift - whole
    if first < 0 or first >= size - 1:
        first, part = (0, _ZERO) if first < 0 else (size - 1, _ZERO)
    return np.uintp(first), np.uintp(min(first + 1, size - 1)), part


@jit
def _read(plane: Floats, cell: Cell) -> Number:
    """A plane (H, W) in a cell, bilinearly."""
    top, bottom, left, right, x, y = cell
    above = fma(x, plane[top, right] - plane[top, left], plane[top, left])
    below = fma(x, plane[bottom, right] - plane[bottom, left], plane[bottom, left])
    return fma(y, below - above, above)
