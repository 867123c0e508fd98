"""What numba compiles: where LANES pixels are, and how nodes around them weigh, to the bits of `following_pixels`."""

from typing import Any

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined
from torchrefract.warping.kernels.pixels import Number

Lanes = Any
Four = tuple[Lanes, Lanes, Lanes, Lanes]


@inlined
def to_pixels(place: Lanes, size: int) -> Lanes:
    """From the sampler's coordinates to px, on a frame of so many."""
    one, scale = lanes.all_floats(np.float32(1)), lanes.all_floats(np.float32(size / 2))
    at = lanes.fma(lanes.total(place, one), scale, lanes.all_floats(np.float32(-0.5)))
    return lanes.lower(lanes.higher(at, lanes.all_floats(np.float32(0))), lanes.all_floats(np.float32(size - 1)))


@inlined
def moved(place: Lanes, by: Lanes, size: int, far: Number) -> Lanes:
    """The place in the sampler's coordinates, moved by so many px."""
    at = lanes.total(place, lanes.product(by, lanes.all_floats(np.float32(2 / size))))
    return lanes.higher(lanes.lower(at, lanes.all_floats(far)), lanes.all_floats(-far))


@inlined
def cubic_weights(t: Lanes) -> Four:
    """As `following_pixels.cubic_weights`."""
    one = lanes.all_floats(np.float32(1))
    before, behind = lanes.total(t, one), lanes.difference(t, one)
    last = lanes.difference(t, lanes.all_floats(np.float32(2)))
    inner = lanes.product(lanes.all_floats(np.float32(0.5)), lanes.product(before, last))
    outer = lanes.product(lanes.all_floats(np.float32(1 / 6)), lanes.product(t, behind))
    minus = lanes.all_floats(np.float32(-1))
    negative = lanes.product(minus, outer), lanes.product(minus, inner)
    return (
        lanes.product(negative[0], last),
        lanes.product(inner, behind),
        lanes.product(negative[1], t),
        lanes.product(outer, before),
    )
