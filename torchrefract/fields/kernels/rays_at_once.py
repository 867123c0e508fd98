"""What numba compiles: noise in space at a row of rays, LANES at once, to the bits of `single_rays`.

So many rays that follow one another lie between 2 LANES nodes that do so: octaves end before rays are a period apart.
"""

from typing import Any

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.pixels import Columns, Floats
from torchrefract.fields.kernels.single_rays import Rows


@inlined
def between_rows(gradients: Floats, rows: Rows, at: int, count: int, line: Floats) -> None:
    """As `single_rays.between_rows`."""
    across = np.uintp(line.shape[1])
    none = lanes.all_floats(np.float32(0))
    for group in range(-(-count // LANES)):
        node = np.uintp(group * LANES)
        a, b = _with_row(gradients, rows, at, 0, node, none, none)
        a, b = _with_row(gradients, rows, at, 1, node, a, b)
        a, b = _with_row(gradients, rows, at, 2, node, a, b)
        a, b = _with_row(gradients, rows, at, 3, node, a, b)
        lanes.store(line, node, a)
        lanes.store(line, across + node, b)


@inlined
def _with_row(gradients: Floats, rows: Rows, at: int, i: int, node: np.uintp, a: Any, b: Any) -> tuple[Any, Any]:
    places, behind, weights = rows
    place, step = np.uintp(places[at, i]) + node, np.uintp(behind[at, i])
    a = lanes.fma(lanes.all_floats(weights[at, i, 0]), lanes.load(gradients, place), a)
    b = lanes.fma(lanes.all_floats(weights[at, i, 1]), lanes.load(gradients, place + step), b)
    return a, lanes.fma(lanes.all_floats(weights[at, i, 2]), lanes.load(gradients, place + step + step), b)


@inlined
def add_crossing(line: Floats, columns: Columns, at: int, out: Floats, plane: int) -> None:
    """As `single_rays.add_crossing`."""
    begins, nodes, part, fade = columns
    one, next_node = lanes.all_floats(np.float32(1)), lanes.all_wholes(np.int32(1))
    across, wide = np.uintp(line.shape[1]), np.uintp(out.shape[1])
    for group in range(begins.shape[1]):
        place, low = np.uintp(at) * wide + np.uintp(group * LANES), np.uintp(begins[at, group])
        into, high = np.uintp(plane) * wide + np.uintp(group * LANES), low + np.uintp(LANES)
        node, p = lanes.load_wholes(nodes, place), lanes.load(part, place)
        a, a_behind = lanes.load(line, low), lanes.load(line, high)
        b, b_behind = lanes.load(line, across + low), lanes.load(line, across + high)
        left = lanes.fma(lanes.pick(a, a_behind, node), p, lanes.pick(b, b_behind, node))
        node = lanes.plus(node, next_node)
        right = lanes.fma(lanes.pick(a, a_behind, node), lanes.difference(p, one), lanes.pick(b, b_behind, node))
        found = lanes.fma(lanes.load(fade, place), lanes.difference(right, left), left)
        lanes.store(out, into, lanes.total(lanes.load(out, into), found))
