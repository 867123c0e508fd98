"""What numba compiles: where a row of pixels looks, in the sampler's coordinates. All numbers are float32."""

import numpy as np

from torchrefract._jit import inlined
from torchrefract.warping.kernels.lines import between
from torchrefract.warping.kernels.pixels import CHUNK, Cells, Floats, Number


@inlined
def along_lattice(
    lines: Floats,
    weight: Floats,
    base_x: Floats,
    base_y: Floats,
    line: int,
    x: Floats,
    y: Floats,
    first: int = 0,
) -> None:
    """x and y, (m,), from the `first` column on, between the nodes of a lattice.

    lines (2, n, W), weight (2, stride, taps): as for `between`; base_x (W,) and base_y (H,) are added.
    """
    between(lines[0], weight[0], line, x, first)
    between(lines[1], weight[1], line, y, first)
    beside = base_x[first : first + x.size]
    for k in range(x.size):
        x[k] += beside[k]
        y[k] += base_y[line]


@inlined
def along_pixels(
    flow: Floats,
    base_x: Floats,
    base_y: Floats,
    scale_x: Number,
    scale_y: Number,
    far: Number,
    line: int,
    x: Floats,
    y: Floats,
) -> None:
    """x and y, (m,), of what is known at every pixel.

    flow (2, n, m): times the scales, with base_x (m,) and base_y (n,) added, within [-far, far], where also lies what
    is no number.
    """
    u, v = flow[0, line], flow[1, line]
    for k in range(x.size):
        x[k] = within(base_x[k] + u[k] * scale_x, far)
        y[k] = within(base_y[line] + v[k] * scale_y, far)


@inlined
def within(place: Number, far: Number) -> Number:
    """The place, in [-far, far], where also lies what is no number."""
    place = place if place <= far else far
    return place if place >= -far else -far


@inlined
def room() -> Cells:
    """For the cells of CHUNK pixels."""
    return np.empty(CHUNK, np.int32), np.empty(CHUNK, np.float32), np.empty(CHUNK, np.float32)
