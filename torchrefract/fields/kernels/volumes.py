"""What numba compiles: fog in space, one row of rays after the other, plane by plane.

Each octave has its gradients at the four rows of nodes around a row of rays on a plane. There

    noise = sum over the 2 nodes beside x of h(p) (A p + B),
    A = sum over 4 rows of h(q) h(r) g_x,  B = of h(q) h(r) (q g_y + r g_z)

so that what a ray takes of an octave is four numbers. Numbers are float32, but places float64.
"""

import numpy as np

from torchrefract._jit import fma, inlined, jit
from torchrefract._lanes import LANES
from torchrefract.fields.kernels.exponentials import less_one
from torchrefract.fields.kernels.nodes import Constants, Doubles, Floats, Key, Words
from torchrefract.fields.kernels.pixels import Columns
from torchrefract.fields.kernels.sheets import Sheets, Whole, draw_row, sheets_before
from torchrefract.fields.kernels.single_rays import Rows
from torchrefract.warping.kernels.across import GROUP, Small

if LANES:
    from torchrefract.fields.kernels.rays_at_once import add_crossing, between_rows
else:
    from torchrefract.fields.kernels.single_rays import add_crossing, between_rows

# Of each frame: turns over pi, (N,); amplitudes, (N, K, planes); what is taken from their sum, (N, planes); the whole
# coordinates of the first node of each octave, (N, K, 3), and how far from there the camera is, (N, K, 3), periods.
Fog = tuple[Doubles, Floats, Floats, Whole, Doubles]
# Periods of each octave to each plane, (K, planes), and how many planes it has, (K,); slopes of the rays, (columns,)
# and (rows,); the number of the plane where d is the reach, (rows, columns); and of each slice the root of its part of
# the reach, (slices,).
Rays = tuple[Doubles, Whole, Doubles, Doubles, Doubles, Doubles]
# Where planes cross octaves, at k planes + plane: the first column of nodes, how many there are, and the first sheet.
Crossings = Whole


@jit
def volumes(
    keys: Words, constants: Constants, fog: Fog, rays: Rays, wanted: Whole, start: int, stop: int, out: Floats
) -> None:
    """Means along rays, less one, out (N, rows, slices, W), W in whole groups: rows `start` ... `stop` of all frames.

    keys: (N, 4), the words of each; constants: of their hash.
    wanted: (N or 1, rows, 2), the first and last of the slices that are asked for; others are left as they are.
    """
    rows = out.shape[1]
    for i in range(start // rows, -(-stop // rows)):
        own = (fog[1][i], fog[2][i], fog[3][i], fog[4][i], rays)
        key = keys[i], fog[0][i], constants
        slices = wanted[min(i, wanted.shape[0] - 1)]
        _rows(own, key, slices, max(0, start - i * rows), min(rows, stop - i * rows), out[i])


@jit
def _rows(own: tuple, key: Key, wanted: Whole, start: int, stop: int, out: Floats) -> None:
    """Some rows of a frame, out (rows, slices, W)."""
    amplitude, half, first, place, (ahead, counts, x, y, last, depths) = own
    wide, planes = out.shape[2], np.zeros(stop, np.int64)  # those that each row needs
    for row in range(start, stop):
        if wanted[row, 0] <= wanted[row, 1]:
            # The mean up to a plane needs one plane more.
            planes[row] = _before(depths[wanted[row, 1]] * last[row].max(), ahead.shape[1]) + 3
    if planes.max() == 0:
        return
    counts = np.minimum(counts, planes.max())
    sheets = sheets_before(place, ahead, counts, x, y)
    columns, crossings, line = _crossings(place, ahead, counts, x, wide, sheets[0])
    places, behind = np.empty((len(crossings), 4), np.int64), np.empty((len(crossings), 4), np.int64)
    rows = places, behind, np.empty((len(crossings), 4, 3), np.float32)
    excess, means = np.empty((planes.max(), wide), np.float32), np.empty((planes.max(), wide), np.float32)
    for row in range(start, stop):
        if planes[row]:
            seen = np.minimum(counts, planes[row])
            _rows_around(place, ahead, seen, y[row], amplitude, crossings, first, key, sheets, rows)
            _excess(sheets[2], rows, crossings, seen, columns, half, line, excess[: planes[row]])
            _means(excess[: planes[row]], means)
            _slices(means, last[row], depths, wanted[row], ahead.shape[1], out[row])


@inlined
def _before(place: float, planes: int) -> int:
    """The plane before a place, of which the next two exist."""
    return min(int(place), planes - 3)


@jit
def _crossings(
    place: Doubles, ahead: Doubles, counts: Whole, x: Doubles, wide: int, firsts: Whole
) -> tuple[Columns, Crossings, Floats]:
    """Where rays lie between nodes on the planes of a frame, and room for a line of nodes."""
    octaves, planes = ahead.shape
    begins, nodes = np.empty((octaves * planes, wide // GROUP), np.int32), np.empty((octaves * planes, wide), np.int32)
    part, fade = np.empty((octaves * planes, wide), np.float32), np.empty((octaves * planes, wide), np.float32)
    crossings, most = np.empty((octaves * planes, 3), np.int64), 0
    for k in range(octaves):
        for plane in range(counts[k]):
            at, far = k * planes + plane, ahead[k, plane]
            left = int(np.floor(place[k, 0] + far * x[0]))
            count = int(np.floor(place[k, 0] + far * x[-1])) + 2 - left
            crossings[at, 0], crossings[at, 1] = left, count
            crossings[at, 2] = firsts[k] + int(np.floor(place[k, 2] + far))
            most = max(most, count)
            _along(place[k, 0], far, x, left, begins[at], nodes[at], part[at], fade[at])
    # Behind the last nodes as many are read as a group may have.
    return (begins, nodes, part, fade), crossings, np.zeros((2, GROUP * (most // GROUP + 3)), np.float32)


@inlined
def _along(
    place: float, far: float, x: Doubles, left: int, begins: Small, nodes: Small, part: Floats, fade: Floats
) -> None:
    """Where the rays, whole groups of them, lie on one plane."""
    for group in range(begins.size):
        begin = int(np.floor(place + far * x[group * GROUP]))
        begins[group] = begin - left
        for k in range(group * GROUP, (group + 1) * GROUP):
            at = place + far * x[k]
            p = at - np.floor(at)
            nodes[k] = int(np.floor(at)) - begin
            part[k], fade[k] = p, _fade(p)


@jit
def _rows_around(
    place: Doubles,
    ahead: Doubles,
    counts: Whole,
    y: float,
    amplitude: Floats,
    crossings: Crossings,
    first: Whole,
    key: Key,
    sheets: Sheets,
    rows: Rows,
) -> None:
    """The rows of nodes around a row of rays on all planes, drawn where nobody did."""
    places, behind, weights = rows
    _, table, _, drawn = sheets
    for k in range(counts.size):
        for plane in range(counts[k]):
            at = k * ahead.shape[1] + plane
            at_y, at_z = place[k, 1] + ahead[k, plane] * y, place[k, 2] + ahead[k, plane]
            q, r = at_y - np.floor(at_y), at_z - np.floor(at_z)
            below, beyond = _fade(q), amplitude[k, plane] * _fade(r)
            for i in range(4):
                sheet, node = crossings[at, 2] + i // 2, int(np.floor(at_y)) + i % 2
                down, across = node - table[sheet, 1], table[sheet, 2]
                if not drawn[table[sheet, 5] + down]:
                    draw_row(sheets, sheet, node, k, first, key)
                places[at, i] = table[sheet, 4] + 3 * across * down + crossings[at, 0] - table[sheet, 0]
                behind[at, i] = across
                weight = (below if i % 2 else 1 - below) * (beyond if i // 2 else amplitude[k, plane] - beyond)
                weights[at, i, 0], weights[at, i, 1] = weight, weight * (q - i % 2)
                weights[at, i, 2] = weight * (r - i // 2)


@jit
def _excess(
    gradients: Floats,
    rows: Rows,
    crossings: Crossings,
    counts: Whole,
    columns: Columns,
    half: Floats,
    line: Floats,
    out: Floats,
) -> None:
    """Values of q - 1 at a row of rays on the planes, out (planes, W)."""
    planes = len(crossings) // counts.size
    for plane in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[plane, j] = -half[plane]
        for k in range(counts.size):
            if plane < counts[k]:
                at = k * planes + plane
                between_rows(gradients, rows, at, crossings[at, 1], line)
                add_crossing(line, columns, at, out, plane)
        for j in range(out.shape[1]):
            out[plane, j] = less_one(out[plane, j])


@inlined
def _fade(p: float) -> float:
    return p * p * p * (p * (6 * p - 15) + 10)


@jit
def _means(excess: Floats, out: Floats) -> None:
    """Up to each plane, out (planes, W), from values on the planes and one behind; `_quadrature` has the weights."""
    twelfth = np.float32(1 / 12)
    total = excess[1] * (np.float32(2) * twelfth)
    out[0] = excess[0]
    for i in range(1, excess.shape[0] - 1):
        at_last, at, at_after = np.float32(i - 1), np.float32(i), np.float32(i + 1)
        share = np.float32(1 / (i * i))
        for k in range(total.size):
            own = fma(at, excess[i, k], twelfth * (at_last * excess[i - 1, k] - at_after * excess[i + 1, k]))
            out[i, k] = (total[k] + own) * share
            total[k] = fma(np.float32(2) * at, excess[i, k], total[k])


@jit
def _slices(means: Floats, last: Doubles, depths: Doubles, wanted: Whole, planes: int, out: Floats) -> None:
    """Means up to slices of a row of rays, out (slices, W), from those up to planes."""
    before, part = np.empty(last.size, np.int32), np.empty(last.size, np.float32)
    for n in range(wanted[0], wanted[1] + 1):
        low, high = planes, 0
        for k in range(last.size):
            place = depths[n] * last[k]
            first = _before(place, planes)
            before[k], part[k] = first, place - first
            low, high = min(low, first), max(high, first)
        for plane in range(low, high + 1):
            for k in range(last.size):
                near = means[plane, k]
                found = fma(part[k], means[plane + 1, k] - near, near)
                out[n, k] = found if before[k] == plane else out[n, k]
