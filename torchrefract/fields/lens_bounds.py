"""How far off a lens is on a lattice, and after some of Newton's steps, for all lenses in given ranges.

The inverse of a polynomial in the plane has no closed form, and bounds of its derivatives by those of the polynomial
are far too large where a barrel comes near to folding. So errors are measured, in float64, for lenses at the corners of
the ranges and for draws inside, in cells all over the frame, and taken `_MARGIN` times. That is no proof, but is tried
at random by benchmarks/tolerance.py. That no lens in the ranges folds is proved.
"""

import itertools
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract.cameras.distortion import ALL_TERMS, newton_undistort, undistort_polynomial
from torchrefract.cameras.radial import radial_limit
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice, lagrange_weights

_MARGIN = 1.5
_MOST_CORNERS, _DRAWS = 128, 16
_FEW_CELLS, _MANY_CELLS = 6, 24  # along each axis
_WORST = 8  # lenses that are looked at in many cells
_INSIDE = ((0.5, 0.5), (0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75))  # of a cell, x and y
_MOST_STEPS = 8
# A map that grows by less than this, compared with no lens, is near to a fold: nothing is smooth there.
_FLATTEST = 0.05
# Of each coefficient's own term: the power of the radius, and how far it moves a point on the unit circle at most.
_DEGREES = (*((2 * i + 1, 1.0) for i in range(1, 7)), (2, 3.0), (2, 3.0), (2, 1.0), (4, 1.0), (2, 1.0), (4, 1.0))


class LensRanges(NamedTuple):
    """What lenses are drawn from; lengths in widths of the frame."""

    coefficients: tuple[Range, ...]  # 12, k1 ... k6, p1, p2, s1 ... s4
    focal: Range
    aspect: Range
    center_x: Range
    center_y: Range


class LensErrors(NamedTuple):
    """Of the flow of any lens in the ranges."""

    cubic: float  # px, between the nodes of a lattice
    newton: tuple[float, ...]  # px, after 0, 1, 2 ... steps of `newton_undistort`
    stretch: float  # how many times as far from the center a node is looked up at most
    slope: float  # of the flow from node to node, px per px


def moved_by_terms(ranges: LensRanges, lattice: Lattice) -> tuple[float, ...] | None:
    """How far each of the 12 coefficients alone may move a pixel, px; None where a lens of the ranges may fold.

    Along and across the radius r the radial part grows by f'(r) and f(r) / r, both least for the lowest coefficients,
    and the other terms take no more than t(r) of that. Where what is left is above zero the map has one inverse, since
    the symmetric part of its Jacobian is positive; it covers all that the nodes see once f(r) - b(r), b what the other
    terms move, does. A term of size d there moves the inverse by no more than d over the least growth.
    """
    radius = _radius(ranges, lattice)
    low = [limits[0] for limits in ranges.coefficients[:6]]
    largest = [max(map(abs, limits)) for limits in ranges.coefficients]
    p, s2, s4 = (sum(largest[i] for i in which) for which in ((6, 7), (8, 10), (9, 11)))
    r = radius * np.linspace(0, 8, 8193)[1:]
    powers = [k * r ** (2 * i) for i, k in enumerate(low, start=1)]
    across = 1 + sum(powers)
    along = 1 + sum((2 * i + 1) * power for i, power in enumerate(powers, start=1))
    covers = r * across - (3 * p + s2) * r**2 - s4 * r**4 >= radius
    if not covers.any():
        return None
    last = int(covers.argmax())
    least = (np.minimum(across, along) - (6 * p + 2 * s2) * r - 4 * s4 * r**3)[: last + 1].min()
    if least < _FLATTEST:
        return None
    # Displacements grow faster than the radius, so the shortest focal length moves most.
    focal = ranges.focal[0] * lattice.width * max(1.0, ranges.aspect[1])
    sizes = zip(largest, _DEGREES, strict=True)
    return tuple(float(focal * size * r[last] ** degree * factor / least) for size, (degree, factor) in sizes)


@lru_cache(maxsize=1024)
def lens_errors(ranges: LensRanges, lattice: Lattice) -> LensErrors | None:
    """The errors on a lattice; None where one of the lenses that were tried folds."""
    (c, focal, center), radius = _lenses(ranges, lattice), _radius(ranges, lattice)
    first = _measured(c, focal, center, lattice, radius=radius, cells=_FEW_CELLS)
    if first is None:
        return None
    # The worst of them are looked at more closely.
    worst = first[0].argsort(descending=True)[:_WORST]
    found = _measured(c[worst], focal[worst], center[worst], lattice, radius=radius, cells=_MANY_CELLS)
    if found is None:
        return None
    largest = (torch.cat(both, dim=-1).amax(dim=-1) for both in zip(first, found, strict=True))
    cubic, newton, stretch, slope = largest
    return LensErrors(
        _MARGIN * cubic.item(), tuple((_MARGIN * newton).tolist()), stretch.item(), _MARGIN * slope.item()
    )


def _measured(
    c: Tensor, focal: Tensor, center: Tensor, lattice: Lattice, *, radius: float, cells: int
) -> tuple[Tensor, ...] | None:
    """For each of N lenses the numbers of `LensErrors`, (N,), those after steps (steps, N); None if one folds."""
    at, count = _nodes_and_places(lattice, cells)
    x, y = ((at[:, i] - center[:, i]) / focal[:, i] for i in range(2))
    one = x.new_ones(len(x))
    limit = radial_limit(c, 16 * radius * one, 1.5 * radius * one)
    found_x, found_y, exists = undistort_polynomial(x, y, c, limit=limit)
    if not exists.all():
        return None
    flow = torch.stack([(found_x - x) * focal[:, 0], (found_y - y) * focal[:, 1]])
    nodes, places = flow.unflatten(2, (count, -1)).split([16, len(_INSIDE)], dim=3)
    u, v = nodes @ _weights_inside().mT - places
    off = torch.hypot(u, v).flatten(1).amax(dim=1)
    newton = []
    for steps in range(_MOST_STEPS + 1):
        near = newton_undistort(x, y, c, steps=steps, terms=ALL_TERMS)
        error = torch.hypot((near[0] - found_x) * focal[:, 0], (near[1] - found_y) * focal[:, 1])
        newton.append(error.nan_to_num(nan=math.inf).amax(dim=1))
    stretch = torch.hypot(found_x, found_y) / torch.hypot(x, y).clamp(min=1e-9)
    return off, torch.stack(newton), stretch.amax(dim=1), _slope(nodes, lattice.stride)


def _slope(nodes: Tensor, stride: int) -> Tensor:
    """(N,): the largest slope along an axis, from corner to corner of the cells, of flows (2, N, cells, 16)."""
    grids = nodes.unflatten(3, (4, 4))[..., 1:3, 1:3]
    slopes = [torch.diff(grids, dim=dim).square().sum(dim=0).sqrt().flatten(1).amax(dim=1) for dim in (3, 4)]
    return torch.maximum(*slopes) / stride


def _radius(ranges: LensRanges, lattice: Lattice) -> float:
    """Of the disc on the plane z = 1 that the nodes of a lattice see, for all lenses."""
    fx, aspect = ranges.focal[0], ranges.aspect[0]
    x, y = (max(map(abs, offset)) for offset in (ranges.center_x, ranges.center_y))
    rows, columns = lattice.axes
    across, down = columns[-1] - (lattice.width - 1) / 2, rows[-1] - (lattice.height - 1) / 2
    return math.hypot((across / lattice.width + x) / fx, (down / lattice.width + y) / (fx * aspect))


def _lenses(ranges: LensRanges, lattice: Lattice) -> tuple[Tensor, Tensor, Tensor]:
    """Coefficients, (N, 12, 1), focal lengths and centers, (N, 2, 1), px: corners of the ranges and lenses inside."""
    # All displacements fall faster than 1 / focal.
    limits = np.array([*ranges.coefficients, (ranges.focal[0], ranges.focal[0]), *ranges[2:]])
    wide = np.flatnonzero(limits[:, 0] != limits[:, 1])
    random = np.random.default_rng(0)
    if 2 ** len(wide) <= _MOST_CORNERS:
        corners = np.array(list(itertools.product((0.0, 1.0), repeat=len(wide)))).reshape(2 ** len(wide), len(wide))
    else:
        corners = random.integers(0, 2, (_MOST_CORNERS, len(wide))).astype(float)
        corners[:2] = [[0.0], [1.0]]
    shares = np.concatenate([corners, random.random((_DRAWS, len(wide)))])
    values = np.repeat(limits[None, :, 0], len(shares), axis=0)
    values[:, wide] += shares * (limits[wide, 1] - limits[wide, 0])
    lenses = torch.from_numpy(values)[:, :, None]
    middle = torch.tensor([[lattice.width - 1], [lattice.height - 1]], dtype=torch.float64) / 2
    focal = lattice.width * torch.cat([lenses[:, 12:13], lenses[:, 12:13] * lenses[:, 13:14]], dim=1)
    return lenses[:, :12], focal, middle + lattice.width * lenses[:, 14:]


def _nodes_and_places(lattice: Lattice, most: int) -> tuple[Tensor, int]:
    """(1, 2, n (16 + places)), px: of n cells all over the frame the 16 nodes around and places inside; and n."""
    axes = [
        lattice.stride * torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).round()
        for count in reversed(lattice.cells)
    ]
    steps = torch.arange(-1, 3, dtype=torch.float64)
    around = lattice.stride * torch.cat([torch.cartesian_prod(steps, steps), steps.new_tensor(_INSIDE)])
    corners = torch.cartesian_prod(*axes).view(-1, 2)
    return (corners[:, None] + around).flatten(0, 1).mT[None], len(corners)


def _weights_inside() -> Tensor:
    """(places, 16)."""
    quarters = lagrange_weights(4, 4, dtype=torch.float64, device=torch.device("cpu"))
    return torch.stack([torch.outer(quarters[round(4 * x)], quarters[round(4 * y)]).flatten() for x, y in _INSIDE])
