"""What numba compiles: thin plates at the places of a lattice, in float64."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import fma, inlined, jit
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
    found = np.empty((2, columns), np.float64)
    for row in range(start, stop):
        i, line = divmod(row, count)
        _plane(affine[i], x[i], y[i, line], found)
        for j in range(points.shape[1]):
            _add(weights[i, j], points[i, j], x[i], y[i, line], nothing, found)
        out[i, 0, line], out[i, 1, line] = found[0], found[1]


@jit
def sums(
    known: NDArray[np.float32],
    displacement: NDArray[np.float32],
    start: int,
    stop: int,
    out: NDArray[np.float32],
) -> None:
    """Rows `start` ... `stop` of out, (B, 2, n, m): known, (n, N, m), as often as the N points are moved, (B, N, 2)."""
    rows = out.shape[2]
    for row in range(start, stop):
        i, line = divmod(row, rows)
        u, v, first = out[i, 0, line], out[i, 1, line], known[line, 0]
        for k in range(u.size):
            u[k], v[k] = displacement[i, 0, 0] * first[k], displacement[i, 0, 1] * first[k]
        for j in range(1, known.shape[1]):
            own, by_u, by_v = known[line, j], displacement[i, j, 0], displacement[i, j, 1]
            for k in range(u.size):
                u[k], v[k] = fma(by_u, own[k], u[k]), fma(by_v, own[k], v[k])


@inlined
def _plane(affine: Doubles, x: Doubles, y: float, out: Doubles) -> None:
    u, v = out[0], out[1]
    for k in range(x.size):
        u[k] = affine[0, 0] + affine[1, 0] * x[k] + affine[2, 0] * y
        v[k] = affine[0, 1] + affine[1, 1] * x[k] + affine[2, 1] * y


@inlined
def _add(weight: Doubles, point: Doubles, x: Doubles, y: float, nothing: float, out: Doubles) -> None:
    u, v, at_u, at_v = out[0], out[1], weight[0] / 2, weight[1] / 2
    px, below = point[0], (y - point[1]) ** 2 + nothing
    for k in range(x.size):
        square = (x[k] - px) ** 2 + below
        bend = square * logarithm(square)
        u[k] += at_u * bend
        v[k] += at_v * bend
