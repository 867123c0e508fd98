"""What a thin plate will compute under a tolerance.

A plate is linear in the displacements of its control points, so the error of the cubics between nodes is, too: with
normal displacements it is normal at every pixel, with a deviation that the splines through one displaced point each
give. Cubics leave nothing of the affine part. The kernel r^2 ln r has no second derivative at its control point, where
their error falls with the square of the stride alone; so that is where it is looked at, `_MARGIN` times. The kernel is
the same in all directions: along axes that are not square to one another the error is less.
"""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from torchrefract.effects.plan import Plan, PlanRequest, Smoothness, coarsest
from torchrefract.types import Range
from torchrefract.warping.lattice import lagrange_weights

_SIGMAS = 7.0  # the two components of the error are longer with a chance of exp(-_SIGMAS^2 / 2), 2e-11
_SLOPE_SIGMAS = 4.0
_MARGIN = 1.25
_MOST_POINTS = 64  # that errors are looked at
_INSIDE = (1, 3, 5)  # sixths of a cell
_PLACES = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (0.25, 0.25))  # of a kink in its cell
_NEAREST = math.exp(-1)  # px, from a kink: what ln r is there it is in the mean over the first px
_Arguments = tuple[tuple[int, int], float, int, int]


@lru_cache(maxsize=256)
def plate_plan(amplitude: float, points: tuple[int, int], smoothing: Range, ask: PlanRequest) -> Plan:
    """The plan for plates.

    Args:
        amplitude: px, the largest.
        points: rows and columns of control points, corner to corner.
        smoothing: the range.
        ask: for what.
    """
    if ask.tolerance_px is None:
        return ask.plan(1, 0.0, "no tolerance")
    room, most = ask.room(), 2 * _SIGMAS * amplitude
    if most <= room:
        return ask.plan(0, most, "it moves too little", random=True)
    if most > min(ask.height, ask.width):
        return ask.plan(1, 0.0, "it moves too far for a lattice")
    plates = [(points, value, ask.height, ask.width) for value in set(smoothing)]
    # Errors and slopes are not at their largest in one place.
    slope, bend = (_SLOPE_SIGMAS * amplitude * max(f(_plate(*plate)) for plate in plates) for f in (_slope, _bend))
    largest = _MARGIN * _SIGMAS * amplitude
    lines = largest * max(_deviation(plate, 1, 2) for plate in plates)
    more: dict[str, Any] = {"slope": slope, "smooth": Smoothness(bend, math.inf, lines, Cubics(largest, tuple(plates)))}

    def attempt(stride: int) -> Plan | None:
        off = largest * max(_deviation(plate, stride, 4) for plate in plates)
        if off > room:
            return None
        error = off + cast(float, ask.tolerance_px) - room
        return ask.plan(stride, error, "kinks of the second derivative", random=True, **more)

    return coarsest(attempt) or ask.plan(1, 0.0, "the plate bends too much for cubics", **more)


@dataclass(frozen=True)
class Cubics:
    """As for `Smoothness`."""

    largest: float  # px, times a deviation
    plates: tuple[_Arguments, ...]

    def __call__(self, stride: float) -> float:
        """Px, the largest error."""
        return self.largest * max(_deviation(plate, stride, 4, at) for plate in self.plates for at in _PLACES)


class _Plate(NamedTuple):
    """A lattice of N control points, in units of their rms radius."""

    points: np.ndarray  # (N, 2)
    center: np.ndarray  # (2,), px
    scale: float  # px, of the unit
    weights: np.ndarray  # (N + 3, N): of the kernels and of 1, x, y, one column for each point that is displaced by 1
    looked_at: np.ndarray  # (n, 2), px: some of the points, at which the kernels have kinks


@lru_cache(maxsize=64)
def _plate(points: tuple[int, int], smoothing: float, height: int, width: int) -> _Plate:
    y, x = (np.linspace(0, max(size - 1, 1), count) for size, count in zip((height, width), points, strict=True))
    at = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1).reshape(-1, 2)
    center = at.mean(axis=0)
    scale = float(np.sqrt(((at - center) ** 2).sum(axis=1).mean()))
    unit = (at - center) / scale
    plane = np.column_stack([np.ones(len(unit)), unit])
    kernel = _kernel(unit[:, None] - unit) + smoothing * np.eye(len(unit))
    system = np.block([[kernel, plane], [plane.T, np.zeros((3, 3))]])
    weights = np.linalg.solve(system, np.eye(len(unit) + 3))[:, : len(unit)]
    chosen = np.unique(np.linspace(0, len(at) - 1, min(len(at), _MOST_POINTS)).round().astype(int))
    return _Plate(unit, center, scale, weights, at[chosen])


@lru_cache(maxsize=1024)
def _deviation(plate: _Arguments, stride: float, taps: int, place: tuple[float, float] | None = None) -> float:
    """Of the largest error of polynomials through so many nodes along each axis, for displacements of deviation 1.

    plate: arguments as for `_plate`.
    place: of each kink in its cell, cells; None for a lattice that begins where the frame does.
    """
    unit, center, scale, weights, looked_at = _plate(*plate)
    step = stride / scale
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    first = np.floor(looked_at / stride) if place is None else looked_at / stride - place
    cells = np.unique((first[:, None] + around).reshape(-1, 2), axis=0)
    corners = (cells * stride - center) / scale
    own = np.arange(1 - taps // 2, taps // 2 + 1)
    nodes = np.stack(np.meshgrid(own, own), axis=-1).reshape(-1, 2)
    known = _kernel(corners[:, None, None] + step * nodes[:, None] - unit)  # (cells, nodes, N)
    largest = 0.0
    through = lagrange_weights(6, taps, dtype=torch.float64, device=torch.device("cpu")).numpy()
    for x, y in itertools.product(_INSIDE, repeat=2):
        between = np.einsum("j,cjn->cn", np.outer(through[y], through[x]).ravel(), known)
        error = (_kernel(corners[:, None] + step * np.array([x, y]) / 6 - unit) - between) @ weights[: len(unit)]
        largest = max(largest, float(np.sqrt((error**2).sum(axis=1)).max()))
    return largest


def _slope(plate: _Plate) -> float:
    """The deviation of the steepest slope, for displacements of deviation 1."""
    pixel = np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    at = (plate.looked_at + pixel - plate.center) / plate.scale  # (4, n, 2)
    plane = np.concatenate([np.ones_like(at[..., :1]), at], axis=-1)
    right, left, down, up = np.concatenate([_kernel(at[:, :, None] - plate.points), plane], axis=-1) @ plate.weights
    slopes = np.stack([right - left, down - up]) / 2
    return float(np.sqrt((slopes**2).sum(axis=-1)).max())


def _bend(plate: _Plate) -> float:
    """The deviation of the largest second derivative along a line, for displacements of deviation 1."""
    largest = 0.0
    for line in np.array([[1.0, 0.0], [0.0, 1.0], [0.5**0.5, 0.5**0.5], [0.5**0.5, -(0.5**0.5)]]):
        at = plate.looked_at[:, None] + _NEAREST * line
        step = 0.1 * line / plate.scale
        places = (at - plate.center) / plate.scale + np.array([-step, 0 * step, step])  # (n, 3, 2)
        before, here, behind = (_kernel(places[:, i, None] - plate.points) for i in range(3))
        bends = (before - 2 * here + behind) / 0.1**2 @ plate.weights[: len(plate.points)]
        largest = max(largest, float(np.sqrt((bends**2).sum(axis=-1)).max()))
    return largest


def _kernel(offset: np.ndarray) -> np.ndarray:
    square = (offset**2).sum(axis=-1)
    return 0.5 * square * np.log(np.where(square > 0, square, 1))
