"""What numba compiles: thin plates at the places of a lattice, in float64."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import jit
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
    u, v = found[0], found[1]
    for row in range(start, stop):
        i, line = divmod(row, count)
        own, height = x[i], y[i, line]
        for k in range(columns):
            u[k] = affine[i, 0, 0] + affine[i, 1, 0] * own[k] + affine[i, 2, 0] * height
            v[k] = affine[i, 0, 1] + affine[i, 1, 1] * own[k] + affine[i, 2, 1] * height
        for j in range(points.shape[1]):
            px, below = points[i, j, 0], (height - points[i, j, 1]) ** 2 + nothing
            at_u, at_v = weights[i, j, 0] / 2, weights[i, j, 1] / 2
            for k in range(columns):
                square = (own[k] - px) ** 2 + below
                kernel = square * logarithm(square)
                u[k] += at_u * kernel
                v[k] += at_v * kernel
        out[i, 0, line], out[i, 1, line] = u, v
