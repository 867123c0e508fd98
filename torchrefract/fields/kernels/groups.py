"""What numba compiles: noise at the pixels of a row, LANES at once, to the bits of `pixels`.

So many pixels that follow one another lie between 2 LANES nodes that do so, out of which each lane picks its own two.
"""

import numpy as np

from torchrefract import _lanes as lanes
from torchrefract._jit import inlined
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.pixels import Columns, Floats


@inlined
def add_octave(line: Floats, columns: Columns, octave: int, out: Floats) -> None:
    """As `pixels.add_octave`."""
    begins, nodes, part, fade = columns[0][octave], columns[1][octave], columns[2][octave], columns[3][octave]
    along, across = line[0], line[1]
    one, next_node = lanes.all_floats(np.float32(1)), lanes.all_wholes(np.int32(1))
    for group in range(begins.size):
        at, low = np.uintp(group * LANES), np.uintp(begins[group])
        high = low + np.uintp(LANES)
        node, p = lanes.load_wholes(nodes, at), lanes.load(part, at)
        a, a_behind = lanes.load(along, low), lanes.load(along, high)
        b, b_behind = lanes.load(across, low), lanes.load(across, high)
        left = lanes.fma(lanes.pick(a, a_behind, node), p, lanes.pick(b, b_behind, node))
        node = lanes.plus(node, next_node)
        right = lanes.fma(lanes.pick(a, a_behind, node), lanes.difference(p, one), lanes.pick(b, b_behind, node))
        found = lanes.fma(lanes.load(fade, at), lanes.difference(right, left), left)
        lanes.store(out, at, lanes.total(lanes.load(out, at), found))
