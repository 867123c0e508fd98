"""Error bounds for lenses on a lattice, and after a few Newton steps.

The inverse of the lens polynomial has no closed form, and bounds of its derivatives by those of the polynomial are far
too large near a fold. The errors are therefore measured in float64, for lenses at the corners of the ranges and for
random ones inside, in cells all over the frame, and multiplied by `_SAFETY`. `benchmarks/tolerance.py` tests them with
random lenses. That no lens of the ranges folds is proved.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract.cameras.brown_conrady import (
    POLYNOMIAL12,
    Terms,
    distort_with_jacobian,
    newton_step,
    newton_undistort,
    used_terms,
)
from torchrefract.cameras.radial import RADIAL
from torchrefract.fields.filled_frame import MARGIN_PX, STILL_PX
from torchrefract.types import FlowBounds, Range, Simplification

_SAFETY = 1.25
_MOST_CORNERS, _RANDOM_LENSES = 128, 16
_LEVEL_STRIDES = (4.0, 16.0, 64.0, 128.0, 256.0)  # px, strides at which errors are measured
_LEVELS = np.array(_LEVEL_STRIDES)
_FINE = 2  # the first levels, whose nodes lie near the frame, give the derivatives
_CELLS = 7  # along each axis, in which errors are measured
# Positions in strides from the corner of a cell, on a line through its middle, and weights of the values there that
# give the error of the cubic through the four nodes.
_LINE = (-1.0, 0.0, 0.5, 1.0, 2.0)
_ERROR = (-1 / 16, 9 / 16, -1.0, 9 / 16, -1 / 16)
_CONVERGED = 1e-7  # step of Newton's method on the plane z = 1; the error is about its square
_MAX_STEPS = 12
_MAX_STRETCH = 3.0  # the sampler clamps positions that lie farther out than this, relative to the frame
_MIN_GROWTH = 0.05  # a map that grows by less, relative to no lens at all, is near a fold
# Shares of the budget for dropped terms and for Newton's method; the rest is for the lattice.
_DROPPED_SHARE, _NEWTON_SHARE = 0.2, 0.1
# For each coefficient: the power of the radius, and how far it moves a point of the unit circle at most.
_DEGREES = (
    *((2 * i + 1, 1.0) for i in range(1, len(RADIAL) + 1)),
    (2, 3.0),
    (2, 3.0),
    (2, 1.0),
    (4, 1.0),
    (2, 1.0),
    (4, 1.0),
)
# Terms that are dropped together or not at all, the least important first.
_GROUPS = (
    range(len(RADIAL) + 2, len(POLYNOMIAL12)),
    range(len(RADIAL), len(RADIAL) + 2),
    *((i,) for i in reversed(range(len(RADIAL)))),
)


class LensRanges(NamedTuple):
    """Ranges of the 16 numbers of a lens; lengths in widths of the frame."""

    coefficients: tuple[Range, ...]  # 12, k1 ... k6, p1, p2, s1 ... s4
    focal: Range
    aspect: Range
    center_x: Range
    center_y: Range

    @property
    def numbers(self) -> tuple[Range, ...]:
        """Return the ranges of all 16 numbers."""
        return (*self.coefficients, self.focal, self.aspect, self.center_x, self.center_y)


class LensDetails(NamedTuple):
    """The choices of a plan for the computation of a lens."""

    num_steps: tuple[int, ...]  # of Newton's method, for nodes as far outside the frame as those of each level
    terms: Terms

    def steps_for(self, stride: int) -> int:
        """Return the number of Newton steps for the nodes of a lattice."""
        finer = [level for level in _LEVEL_STRIDES if level < stride]
        return self.num_steps[min(len(finer), len(self.num_steps) - 1)]


@dataclass(frozen=True)
class LensErrorModel:
    """Error bounds for lenses drawn from one of several boxes of ranges; see `ErrorModel`."""

    boxes: tuple[LensRanges, ...]
    fills: bool = False  # the clean view is zoomed so that it holds all that the lens shows

    is_random = False

    def bounds(self, height: int, width: int) -> FlowBounds | None:
        """Return measured bounds, or None if a lens may fold inside the frame."""
        measured = _measure(self.boxes, height, width)
        if measured is None:
            return None
        return with_zoom(measured.bounds) if self.fills else measured.bounds

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification | None:
        """Drop terms that move less than a share of the budget, and choose the number of Newton steps."""
        measured = _measure(self.boxes, height, width)
        if measured is None:
            return None
        spans = np.array([box.coefficients for box in self.boxes])  # (boxes, 12, 2)
        used = [i in np.flatnonzero(spans.any(axis=(0, 2))) for i in range(len(POLYNOMIAL12))]
        dropped = _droppable(used, measured.moved_px, _DROPPED_SHARE * budget_px)
        kept = [i for i in range(len(POLYNOMIAL12)) if used[i] and i not in dropped]
        # A level needs the steps of those before it, whose nodes lie within its own.
        enough = np.maximum.accumulate(measured.newton_px, axis=1) <= _NEWTON_SHARE * budget_px  # (steps, levels)
        if not enough[-1].all():
            return None
        steps = tuple(enough.argmax(axis=0).tolist())
        return Simplification(
            sum([measured.moved_px[i] for i in dropped]) + _NEWTON_SHARE * budget_px,
            kept=tuple([POLYNOMIAL12[i] for i in kept]),
            dropped=tuple([(POLYNOMIAL12[i], measured.moved_px[i]) for i in dropped]),
            details=LensDetails(steps, _terms_with(kept)),
            why="cubic polynomials between nodes",
        )

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: each lens lies in one of the boxes, up to rounding."""
        focal, aspect = params.focal[:, :1], params.focal[:, 1:] / params.focal[:, :1]
        numbers = torch.cat([params.coefficients, focal, aspect, params.center], dim=1)
        boxes = as_device_tensor([box.numbers for box in self.boxes], dtype=numbers.dtype, device=numbers.device)
        low, high = boxes.unbind(2)
        margin = 1e-5 * torch.maximum(low.abs(), high.abs())
        inside = (numbers[:, None] >= low - margin) & (numbers[:, None] <= high + margin)
        return inside.all(dim=2).any(dim=1).all()


class MeasuredErrors(NamedTuple):
    """Errors of the flows of several lenses."""

    bounds: FlowBounds
    newton_px: np.ndarray  # (steps, levels), after 0, 1, 2 ... steps
    moved_px: tuple[float, ...]  # by each of the 12 coefficients alone


@lru_cache(maxsize=256)
def _measure(boxes: tuple[LensRanges, ...], height: int, width: int) -> MeasuredErrors | None:
    """Measure all lenses of the boxes; None if one of them may fold inside the frame."""
    radii = [_radii(box, height, width) for box in boxes]
    proofs = [_prove_no_fold(box, radius, width) for box, radius in zip(boxes, radii, strict=True)]
    proved = [proof for proof in proofs if proof is not None]
    if len(proved) < len(proofs):
        return None
    # A level counts if no lens can fold where its nodes lie.
    num_levels = min(int((radius <= proof.radius).sum()) for radius, proof in zip(radii, proved, strict=True))
    if num_levels == 0:
        return None
    moved = tuple(float(values.max()) for values in np.array([proof.moved_px for proof in proved]).T)
    c, focal, center = _sample_lenses(boxes, height, width)
    points = cell_lines(height, width, num_levels)
    x, y = ((points[None, :, i] - center[:, i]) / focal[:, i] for i in range(2))
    iterates = _solve(x, y, c)
    if iterates is None:
        return None
    solved_x, solved_y = iterates[-1]
    near = torch.stack([torch.stack(iterate) for iterate in iterates])  # (steps, 2, N, P)
    missed = torch.hypot(*((near - near[-1]) * focal.movedim(1, 0)).unbind(1))
    newton = _SAFETY * missed.unflatten(2, (num_levels, -1)).amax(dim=(1, 3)).numpy()
    flow = torch.stack([(solved_x - x) * focal[:, 0], (solved_y - y) * focal[:, 1]])
    stretch = torch.hypot(solved_x, solved_y) / torch.hypot(x, y).clamp(min=1e-9)
    bounds = flow_bounds(flow, num_levels, stretch)
    return None if bounds is None else MeasuredErrors(bounds, newton, moved)


def with_zoom(bounds: FlowBounds) -> FlowBounds:
    """Return the bounds of flows with the zoom and the shift that fit them to a frame.

    They move no point by more than the flow moves the border of the frame, on two sides with their margin, and change
    the gradient by no more than its mean across the frame. Cubics interpolate them exactly.
    """
    moved = 3 * bounds.max_displacement
    margins = 2 * MARGIN_PX if moved > STILL_PX else 0.0
    return replace(bounds, max_displacement=moved + margins, max_gradient=2 * bounds.max_gradient)


def cell_lines(height: int, width: int, num_levels: int) -> Tensor:
    """Return (P, 2), px: for each level and for cells all over the frame, the positions `_LINE` along x and along y."""
    line = torch.tensor(_LINE, dtype=torch.float64, device="cpu")
    middle = torch.full_like(line, 0.5)
    offsets = torch.stack([torch.stack([line, middle], dim=1), torch.stack([middle, line], dim=1)])  # (2, 5, 2)
    points = []
    for stride in _LEVELS[:num_levels]:
        # The last cell lies worst if the border of the frame cuts it in the middle.
        columns, rows = (np.linspace(0, max(side - 1 - stride / 2, 0), _CELLS) for side in (width, height))
        corners = torch.from_numpy(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 1, 2))
        points.append((corners + stride * offsets).reshape(-1, 2))
    return torch.cat(points)


def outermost_nodes(height: int, width: int, num_levels: int) -> Tensor:
    """Return (4, 2), px: the corners of the coarsest lattice, beyond which no node lies."""
    stride = float(_LEVELS[num_levels - 1])
    x, y = (
        torch.tensor([-stride, side - 1 + 2 * stride], dtype=torch.float64, device="cpu") for side in (width, height)
    )
    return torch.cartesian_prod(x, y)


def flow_bounds(flow: Tensor, num_levels: int, stretch: Tensor) -> FlowBounds | None:
    """Return the bounds of N flows from their values.

    Args:
        flow: (2, N, P), px, at the positions of `cell_lines`.
        num_levels: of these positions.
        stretch: (N, P), the distance from the center at which a position is sampled, over its own distance.
    """
    lines = flow.unflatten(2, (num_levels, _CELLS * _CELLS, 2, 5))  # (2, N, level, cell, axis, position)
    strides = torch.from_numpy(_LEVELS[:num_levels])
    # Cubics along y act on values that are already off by the error along x, which they amplify by 5/4 at most.
    along_x, along_y = torch.hypot(*(lines @ flow.new_tensor(_ERROR))).unbind(-1)  # (N, level, cell)
    errors = _SAFETY * (along_x + 5 / 4 * along_y).amax(dim=(0, 2))
    reachable = stretch.unflatten(1, (num_levels, -1)).amax(dim=(0, 2)) <= _MAX_STRETCH
    errors = torch.where(reachable, errors, torch.inf)
    if not reachable[0]:
        return None
    near, near_strides = lines[:, :, :_FINE], strides[:_FINE, None, None]
    steps = torch.diff(flow.new_tensor(_LINE))
    gradient = (torch.hypot(*torch.diff(near, dim=5)) / (near_strides[..., None] * steps)).max()
    return FlowBounds(
        max_displacement=_SAFETY * float(torch.hypot(*near).max()),
        max_gradient=_SAFETY * float(gradient),
        interpolation_error=_between_levels(_LEVELS[:num_levels], errors.numpy()),
    )


def _between_levels(strides: np.ndarray, errors: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the error for any stride: s^4 below the first level, and power laws between levels.

    The error grows at least like s^4 and faster the larger s is, so that both lie above it.
    """
    finite = np.isfinite(errors)
    last = int(np.argmin(finite)) if not finite.all() else len(errors)  # the first level that is unknown
    log_strides, log_errors = np.log(strides[:last]), np.log(np.maximum(errors[:last], 1e-12))

    def interpolation_error(stride: np.ndarray) -> np.ndarray:
        logs = np.log(np.maximum(stride, 1e-3))
        between = np.interp(logs, log_strides, log_errors) + 4 * np.minimum(logs - log_strides[0], 0)
        return np.where(logs <= log_strides[-1] + 1e-9, np.exp(between), np.inf)

    return interpolation_error


class _Proof(NamedTuple):
    radius: float  # on the plane z = 1, up to which each distorted point has exactly one preimage
    moved_px: tuple[float, ...]  # by each of the 12 coefficients alone, at most, inside the frame


def _prove_no_fold(ranges: LensRanges, radii: np.ndarray, width: int) -> _Proof | None:
    """Prove for all lenses of the ranges that they have an inverse in the frame.

    Along and across the radius r the radial part grows by f'(r) and f(r) / r, both least for the lowest coefficients,
    and the other terms take no more than t(r) of that. Where the rest is positive, the symmetric part of the Jacobian
    is positive and the map has one inverse; it covers the disc of radius f(r) - b(r), b what the other terms move. A
    term of size d moves the inverse by no more than d over the least growth.

    Args:
        ranges: of the lenses.
        radii: on the plane z = 1, of the nodes of each level.
        width: px, of the frame.
    """
    low = [limits[0] for limits in ranges.coefficients[:6]]
    largest = [max(map(abs, limits)) for limits in ranges.coefficients]
    p, s2, s4 = (sum(largest[i] for i in group) for group in ((6, 7), (8, 10), (9, 11)))
    r = radii[0] * np.linspace(0, 8, 4097)[1:]
    powers = [k * r ** (2 * i) for i, k in enumerate(low, start=1) if k]
    orders = [i for i, k in enumerate(low, start=1) if k]
    across = 1 + sum(powers, np.zeros_like(r))
    along = 1 + sum(((2 * i + 1) * power for i, power in zip(orders, powers, strict=True)), np.zeros_like(r))
    growth = np.minimum(across, along) - (6 * p + 2 * s2) * r - 4 * s4 * r**3
    growing = np.minimum.accumulate(growth) >= _MIN_GROWTH
    covered = np.where(growing, r * across - (3 * p + s2) * r**2 - s4 * r**4, 0)
    if covered.max() < radii[0]:
        return None
    last = int((covered >= radii[0]).argmax())
    least = growth[: last + 1].min()
    # Displacements grow faster than the radius, so the shortest focal length moves pixels most.
    focal = ranges.focal[0] * width * max(1.0, ranges.aspect[1])
    sizes = zip(largest, _DEGREES, strict=True)
    moved = tuple(float(focal * size * r[last] ** degree * factor / least) for size, (degree, factor) in sizes)
    return _Proof(float(covered.max()), moved)


def _radii(ranges: LensRanges, height: int, width: int) -> np.ndarray:
    """Return for each level the radius of the disc on the plane z = 1 that its nodes lie in, for all lenses."""
    fx, aspect = ranges.focal[0], ranges.aspect[0]
    x, y = (max(map(abs, offset)) for offset in (ranges.center_x, ranges.center_y))
    across, down = ((side - 1) / 2 + 2 * _LEVELS for side in (width, height))
    return np.hypot((across / width + x) / fx, (down / width + y) / (fx * aspect))


def _sample_lenses(boxes: Sequence[LensRanges], height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return coefficients (N, 12, 1), and in px focal lengths and centers (N, 2, 1), of lenses in the boxes."""
    values = torch.from_numpy(np.concatenate([_corners_and_draws(box) for box in boxes]))[:, :, None]
    middle = torch.tensor([[width - 1], [height - 1]], dtype=torch.float64, device="cpu") / 2
    coefficients, fx, aspect, center = values.split((len(POLYNOMIAL12), 1, 1, 2), dim=1)
    return coefficients, width * torch.cat([fx, fx * aspect], dim=1), middle + width * center


def _corners_and_draws(ranges: LensRanges) -> np.ndarray:
    """Return (N, 16): corners of the ranges, and random lenses inside."""
    # All displacements fall faster than 1 / focal, so the shortest focal length is the worst.
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
    shares = np.concatenate([corners, random.random((_RANDOM_LENSES, len(wide)))])
    values = np.repeat(limits[None, :, 0], len(shares), axis=0)
    values[:, wide] += shares * (limits[wide, 1] - limits[wide, 0])
    return values


def _solve(x: Tensor, y: Tensor, c: Tensor) -> list[tuple[Tensor, Tensor]] | None:
    """Return the Newton iterates, of which the last has converged; None if none does."""
    limit, terms = _CONVERGED * (1 + torch.hypot(x, y).max()), used_terms(c[..., 0])
    iterates = [newton_undistort(x, y, c, steps=0, terms=terms)]
    is_moving = torch.ones_like(x, dtype=torch.bool)
    while len(iterates) < _MAX_STEPS:
        # After three steps one point in twenty moves still, those of the strongest lenses far from the center.
        lenses, points = (is_moving.any(dim=dim).nonzero()[:, 0] for dim in (1, 0))
        part = lenses[:, None], points
        last = iterates[-1][0][part], iterates[-1][1][part]
        new = newton_step(last, (x[part], y[part]), *distort_with_jacobian(*last, c[lenses], terms))
        # NaN never counts as converged.
        is_moving[part] = ~(torch.maximum((new[0] - last[0]).abs(), (new[1] - last[1]).abs()) <= limit)
        iterates.append((iterates[-1][0].index_put(part, new[0]), iterates[-1][1].index_put(part, new[1])))
        if not is_moving.any():
            return iterates
    return None


def _droppable(used: Sequence[bool], moved_px: Sequence[float], budget_px: float) -> list[int]:
    """Return the terms that may be dropped together."""
    dropped: list[int] = []
    for group in _GROUPS:
        candidates = [i for i in group if used[i]]
        if sum(moved_px[i] for i in (*dropped, *candidates)) > budget_px:
            break
        dropped += candidates
    return dropped


def _terms_with(kept: Sequence[int]) -> Terms:
    n = len(RADIAL)
    order = max([0, *(i + 1 for i in kept if i < n)])
    return Terms(order, any(n <= i < n + 2 for i in kept), any(i >= n + 2 for i in kept))
