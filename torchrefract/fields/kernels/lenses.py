"""What numba compiles: where lenses that fold nowhere near lead the nodes of a lattice. All numbers are float32."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import inlined, jit

Floats = NDArray[np.float32]
_ONE, _TWO = np.float32(1), np.float32(2)
_SMALLEST_RADIAL = np.float32(0.1)  # as in `cameras.distortion`, and the determinant as in `Jacobian.solve`
_SMALLEST_DETERMINANT = np.float32(1e-6)


@jit
def smooth_flows(
    coefficients: Floats, focal: Floats, center: Floats, x: Floats, y: Floats, steps: int, out: Floats
) -> None:
    """As `smooth_lens_flow`, by its steps; terms that it leaves out have coefficients of 0.

    coefficients, (B, 12), focal and center, (B, 2): of all samples. x, (m,), and y, (n,): the places, px.
    """
    x_d, at_x, at_y = np.empty(x.size, np.float32), np.empty(x.size, np.float32), np.empty(x.size, np.float32)
    for i in range(out.shape[0]):
        k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4 = coefficients[i]
        k, others = (k1, k2, k3, k4, k5, k6), (p1, p2, s1, s2, s3, s4)
        for j in range(x.size):
            x_d[j] = (x[j] - center[i, 0]) / focal[i, 0]
        for line in range(y.size):
            y_d = (y[line] - center[i, 1]) / focal[i, 1]
            for j in range(x.size):
                shrunk = max(_radial(x_d[j] * x_d[j] + y_d * y_d, k), _SMALLEST_RADIAL)
                at_x[j], at_y[j] = x_d[j] / shrunk, y_d / shrunk
            for _ in range(steps):
                for j in range(x.size):
                    at_x[j], at_y[j] = _nearer(at_x[j], at_y[j], x_d[j], y_d, k, others)
            for j in range(x.size):
                out[i, 0, line, j] = (at_x[j] - x_d[j]) * focal[i, 0]
                out[i, 1, line, j] = (at_y[j] - y_d) * focal[i, 1]


Number = np.float32
Radial = tuple[Number, Number, Number, Number, Number, Number]


@inlined
def _radial(r2: Number, k: Radial) -> Number:
    value = (k[4] + k[5] * r2) * r2
    value = (k[3] + value) * r2
    value = (k[2] + value) * r2
    value = (k[1] + value) * r2
    return _ONE + (k[0] + value) * r2


@inlined
def _slope(r2: Number, k: Radial) -> Number:
    value = np.float32(5) * k[4] + r2 * (np.float32(6) * k[5])
    value = np.float32(4) * k[3] + r2 * value
    value = np.float32(3) * k[2] + r2 * value
    value = _TWO * k[1] + r2 * value
    return k[0] + r2 * value


@inlined
def _nearer(x: Number, y: Number, x_d: Number, y_d: Number, k: Radial, others: Radial) -> tuple[Number, Number]:
    """One of Newton's steps from (x, y) to the point that is distorted to (x_d, y_d)."""
    p1, p2, s1, s2, s3, s4 = others
    r2 = x * x + y * y
    slope = _slope(r2, k)
    g = _radial(r2, k) + _TWO * p1 * y + _TWO * p2 * x
    a = r2 * (p2 + s1 + s2 * r2) + x * g - x_d
    b = r2 * (p1 + s3 + s4 * r2) + y * g - y_d
    along_x, along_y = slope * x, slope * y
    prism_x, prism_y = s1 + _TWO * s2 * r2, s3 + _TWO * s4 * r2
    xx = g + _TWO * x * (along_x + (_TWO * p2 + prism_x))
    yy = g + _TWO * y * (along_y + (_TWO * p1 + prism_y))
    cross = _TWO * p1 * x + _TWO * (along_x + p2) * y
    xy, yx = cross + _TWO * prism_x * y, cross + _TWO * prism_y * x
    scale = _ONE / max(xx * yy - xy * yx, _SMALLEST_DETERMINANT)
    return x - (yy * a - xy * b) * scale, y - (xx * b - yx * a) * scale
