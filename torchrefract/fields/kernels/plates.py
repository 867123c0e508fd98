"""What numba compiles: thin plates at the places of a lattice, in float64."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import inlined, jit
from torchrefract.fields.kernels.nodes import Doubles, logarithm


@jit
def plates(
    points: Doubles,
    weights: Doubles,
    affine: Doubles,
    x: Doubles,
    y: Doubles,
    nothing: float,
    start: int,
    stop: int,
    out: NDArray[np.floating],
) -> None:
    """Rows `start` ... `stop` of all plates, out (B, 2, n, m), one below the other, as for `spline_at`.

    points, weights: (B, N, 2), of the kernels r^2 ln r; affine: (B, 3, 2); x, (B, m), and y, (B, n): the places.
    nothing: what is added to squared distances, so that they have a logarithm.
    """
    count, columns = y.shape[1], x.shape[1]
    found, kernel = np.empty((2, columns), np.float64), np.empty(columns, np.float64)
    for row in range(start, stop):
        i, line = divmod(row, count)
        _plane(affine[i], x[i], y[i, line], found)
        for j in range(points.shape[1]):
            _kernel(points[i, j], x[i], y[i, line], nothing, kernel)
            _add(weights[i, j], kernel, found)
        out[i, 0, line], out[i, 1, line] = found[0], found[1]


@jit
def bends(points: Doubles, x: Doubles, y: Doubles, nothing: float, start: int, stop: int, out: Doubles) -> None:
    """Rows of out, (n, N, m): what `plates_of` takes of points (N, 2) at places x, (m,), and y, (n,)."""
    for line in range(start, stop):
        for j in range(points.shape[0]):
            _kernel(points[j], x, y[line], nothing, out[line, j])


@jit
def plates_of(
    known: Doubles,
    weights: Doubles,
    affine: Doubles,
    x: Doubles,
    y: Doubles,
    start: int,
    stop: int,
    out: NDArray[np.floating],
) -> None:
    """As `plates`, to the bit, of plates whose points and places are the same: with what `bends` found."""
    count, columns = y.size, x.size
    found = np.empty((2, columns), np.float64)
    for row in range(start, stop):
        i, line = divmod(row, count)
        _plane(affine[i], x, y[line], found)
        for j in range(known.shape[1]):
            _add(weights[i, j], known[line, j], found)
        out[i, 0, line], out[i, 1, line] = found[0], found[1]


@inlined
def _plane(affine: Doubles, x: Doubles, y: float, out: Doubles) -> None:
    u, v = out[0], out[1]
    for k in range(x.size):
        u[k] = affine[0, 0] + affine[1, 0] * x[k] + affine[2, 0] * y
        v[k] = affine[0, 1] + affine[1, 1] * x[k] + affine[2, 1] * y


@inlined
def _kernel(point: Doubles, x: Doubles, y: float, nothing: float, out: Doubles) -> None:
    """2 r^2 ln r of the distance from a point."""
    px, below = point[0], (y - point[1]) ** 2 + nothing
    for k in range(x.size):
        square = (x[k] - px) ** 2 + below
        out[k] = square * logarithm(square)


@inlined
def _add(weight: Doubles, kernel: Doubles, out: Doubles) -> None:
    u, v, at_u, at_v = out[0], out[1], weight[0] / 2, weight[1] / 2
    for k in range(kernel.size):
        u[k] += at_u * kernel[k]
        v[k] += at_v * kernel[k]
