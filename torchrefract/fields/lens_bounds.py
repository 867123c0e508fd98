"""How far off a lens is on a lattice, and after some of Newton's steps, for all lenses in given ranges.

The inverse of a polynomial in the plane has no closed form, and bounds of its derivatives by those of the polynomial
are far too large where a barrel comes near to folding. So errors are measured, in float64, for lenses at the corners of
the ranges and for draws inside, in the middle of cells all over the frame, where that of cubics is largest along each
axis, and taken `_MARGIN` times. That is no proof, but is tried at random by benchmarks/tolerance.py. That no lens in
the ranges folds is proved.
"""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import newton_iterates, used_terms
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice

_MARGIN = 1.2
_MOST_CORNERS, _DRAWS = 128, 16
_FEW_CELLS, _MANY_CELLS = 5, 17  # along each axis
_WORST = 8  # lenses that are looked at in many places
# Strides from the corner of a cell, on a line through its middle; what the cubic of the four nodes misses there.
_LINE, _MISSED = (-1.0, 0.0, 0.5, 1.0, 2.0), (-1 / 16, 9 / 16, -1.0, 9 / 16, -1 / 16)
# What second and third derivatives make of them, at strides of 1.
_BENT, _TWISTED = (0.0, 4.0, -8.0, 4.0, 0.0), (-1.0, 3.0, 0.0, -3.0, 1.0)
_SOLVED = 1e-12  # the last of Newton's steps, on the plane z = 1
_MOST_STEPS, _STEPS_TO_SOLVE = 8, 16
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

    @classmethod
    def of(cls, numbers: Sequence[Range]) -> "LensRanges":
        """Of the ranges of all 16 numbers."""
        return cls(tuple(numbers[:12]), *numbers[12:])

    @property
    def numbers(self) -> tuple[Range, ...]:
        """The ranges of all 16 numbers."""
        return (*self.coefficients, self.focal, self.aspect, self.center_x, self.center_y)


def lens_numbers(coefficients: Tensor, focal: Tensor, center: Tensor) -> Tensor:
    """(B, 16): the numbers of lenses that `LensRanges` has ranges of; (B, 12), (B, 2), fx and fy, and (B, 2)."""
    return torch.cat([coefficients, focal[:, :1], focal[:, 1:] / focal[:, :1], center], dim=1)


class LensErrors(NamedTuple):
    """Of the flow of any lens in the ranges."""

    cubic: float  # px, between the nodes of a lattice
    newton: tuple[float, ...]  # px, after 0, 1, 2 ... steps of `newton_undistort`
    stretch: float  # how many times as far from the center a node is looked up at most
    slope: float  # of the flow from node to node, px per px
    bend: float  # of the flow: its second derivatives along both axes, together, px per px^2
    third: float  # likewise, px per px^3


def moved_by_terms(boxes: Sequence[LensRanges], lattice: Lattice) -> tuple[float, ...] | None:
    """How far each of the 12 coefficients alone may move a pixel, px; None where a lens of a box may fold."""
    moved = [_moved_by_terms(box, lattice) for box in boxes]
    sure = [found for found in moved if found is not None]
    return tuple(map(max, zip(*sure, strict=True))) if len(sure) == len(moved) else None


def _moved_by_terms(ranges: LensRanges, lattice: Lattice) -> tuple[float, ...] | None:
    """Of one box.

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
    params_in_range = r * across - (3 * p + s2) * r**2 - s4 * r**4 >= radius
    if not params_in_range.any():
        return None
    last = int(params_in_range.argmax())
    least = (np.minimum(across, along) - (6 * p + 2 * s2) * r - 4 * s4 * r**3)[: last + 1].min()
    if least < _FLATTEST:
        return None
    # Displacements grow faster than the radius, so the shortest focal length moves most.
    focal = ranges.focal[0] * lattice.width * max(1.0, ranges.aspect[1])
    sizes = zip(largest, _DEGREES, strict=True)
    return tuple(float(focal * size * r[last] ** degree * factor / least) for size, (degree, factor) in sizes)


@lru_cache(maxsize=1024)
def lens_errors(boxes: tuple[LensRanges, ...], lattice: Lattice) -> LensErrors | None:
    """The errors on a lattice of lenses in any of the boxes; None where one that was tried has no inverse."""
    lenses = _Lenses.all(boxes, lattice)
    first = _measured(lenses, lattice, _FEW_CELLS)
    if first is None:
        return None
    # The worst of them are looked at more closely.
    found = _measured(lenses.some(first[0].argsort(descending=True)[:_WORST]), lattice, _MANY_CELLS)
    if found is None:
        return None
    largest = (torch.cat(both, dim=-1).amax(dim=-1) for both in zip(first, found, strict=True))
    cubic, newton, stretch, slope, bend, third = largest
    return LensErrors(
        _MARGIN * cubic.item(),
        tuple((_MARGIN * newton).tolist()),
        stretch.item(),
        _MARGIN * slope.item(),
        _MARGIN * bend.item(),
        _MARGIN * third.item(),
    )


class _Lenses(NamedTuple):
    """N lenses."""

    coefficients: Tensor  # (N, 12, 1)
    focal: Tensor  # (N, 2, 1), px
    center: Tensor  # (N, 2, 1), px

    @classmethod
    def all(cls, boxes: Sequence[LensRanges], lattice: Lattice) -> "_Lenses":
        """Corners of each box, and lenses inside."""
        values = torch.from_numpy(np.concatenate([_tried(box) for box in boxes]))[:, :, None]
        middle = torch.tensor([[lattice.width - 1], [lattice.height - 1]], dtype=torch.float64) / 2
        focal = lattice.width * torch.cat([values[:, 12:13], values[:, 12:13] * values[:, 13:14]], dim=1)
        return cls(values[:, :12], focal, middle + lattice.width * values[:, 14:])

    def some(self, which: Tensor) -> "_Lenses":
        """Those in these places."""
        return _Lenses(*(value[which] for value in self))


def _measured(lenses: _Lenses, lattice: Lattice, cells: int) -> tuple[Tensor, ...] | None:
    """For each of N lenses the numbers of `LensErrors`, (N,), those after steps (steps, N); None without an inverse."""
    c, focal, center = lenses
    at = lines_of_cells(lattice, cells)
    x, y = ((at[:, i] - center[:, i]) / focal[:, i] for i in range(2))
    iterates = _solve(x, y, c)
    if iterates is None:
        return None
    found_x, found_y = iterates[-1]
    newton = [
        torch.hypot((near_x - found_x) * focal[:, 0], (near_y - found_y) * focal[:, 1]).amax(dim=1)
        for near_x, near_y in (iterates[min(steps, len(iterates) - 1)] for steps in range(_MOST_STEPS + 1))
    ]
    flow = torch.stack([(found_x - x) * focal[:, 0], (found_y - y) * focal[:, 1]])
    stretch = torch.hypot(found_x, found_y) / torch.hypot(x, y).clamp(min=1e-9)
    cubic, *derivatives = cubic_errors(flow, lattice.stride)
    return cubic, torch.stack(newton), stretch.amax(dim=1), *derivatives


def _solve(x: Tensor, y: Tensor, c: Tensor) -> list[tuple[Tensor, Tensor]] | None:
    """The iterates of `newton_undistort`, the last of which is exact; None where none is."""
    room = _SOLVED * (1 + torch.hypot(x, y))
    iterates: list[tuple[Tensor, Tensor]] = []
    for found in itertools.islice(newton_iterates(x, y, c, terms=used_terms(c[..., 0])), _STEPS_TO_SOLVE):
        iterates.append(found)
        # What is not a number is never near enough.
        if len(iterates) > 1 and all(
            ((new - old).abs() <= room).all() for new, old in zip(found, iterates[-2], strict=True)
        ):
            return iterates
    return None


def lines_of_cells(lattice: Lattice, most: int) -> Tensor:
    """(1, 2, cells 2 5), px: for cells all over the frame the places `_LINE` along x, and along y."""
    columns, rows = (
        torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).round() for count in lattice.cells()[::-1]
    )
    line = columns.new_tensor(_LINE)
    offsets = torch.stack([torch.stack([line, 0 * line + 0.5]), torch.stack([0 * line + 0.5, line])])
    corners = torch.cartesian_prod(columns, rows)
    at = corners[:, None, :, None] + offsets  # (cells, line, x and y, place)
    return lattice.stride * at.movedim(2, 0).flatten(1)[None]


def cubic_errors(flow: Tensor, stride: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How far flows between nodes are off, and their largest slopes, bends and thirds, of N lenses, (N,).

    In px, px per px, px per px^2 and px per px^3, as in `LensErrors`.

    Args:
        flow: (2, N, cells 2 5), px, at the places of `lines_of_cells`.
        stride: px, of the lattice.
    """
    lines = flow.unflatten(2, (-1, 2, 5))
    along_x, along_y = torch.hypot(*(lines @ flow.new_tensor(_MISSED))).unbind(2)
    # What is missed along y has gone through cubics along x.
    missed = (along_x + 5 / 4 * along_y).amax(dim=1)
    slopes = torch.hypot(*torch.diff(lines, dim=4)) / (stride * torch.diff(flow.new_tensor(_LINE)))
    bends, thirds = (torch.hypot(*(lines @ flow.new_tensor(by))).sum(dim=2).amax(dim=1) for by in (_BENT, _TWISTED))
    return missed, slopes.flatten(1).amax(dim=1), bends / stride**2, thirds / stride**3


def _radius(ranges: LensRanges, lattice: Lattice) -> float:
    """Of the disc on the plane z = 1 that the nodes of a lattice see, for all lenses."""
    fx, aspect = ranges.focal[0], ranges.aspect[0]
    x, y = (max(map(abs, offset)) for offset in (ranges.center_x, ranges.center_y))
    rows, columns = lattice.axes()
    across, down = columns[-1] - (lattice.width - 1) / 2, rows[-1] - (lattice.height - 1) / 2
    return math.hypot((across / lattice.width + x) / fx, (down / lattice.width + y) / (fx * aspect))


def _tried(ranges: LensRanges) -> np.ndarray:
    """(N, 16): corners of the ranges, and lenses inside."""
    # All displacements fall faster than 1 / focal.
    limits = np.array(ranges._replace(focal=(ranges.focal[0], ranges.focal[0])).numbers)
    wide = np.flatnonzero(limits[:, 0] != limits[:, 1])
    if not len(wide):
        return limits[None, :, 0]
    random = np.random.default_rng(0)
    if 2 ** len(wide) <= _MOST_CORNERS:
        corners = np.array(list(itertools.product((0.0, 1.0), repeat=len(wide))))
    else:
        corners = random.integers(0, 2, (_MOST_CORNERS, len(wide))).astype(float)
        corners[:2] = [[0.0], [1.0]]
    shares = np.concatenate([corners, random.random((_DRAWS, len(wide)))])
    values = np.repeat(limits[None, :, 0], len(shares), axis=0)
    values[:, wide] += shares * (limits[wide, 1] - limits[wide, 0])
    return values
