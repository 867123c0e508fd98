"""What a thin plate will compute under a tolerance.

A plate is linear in the displacements of its control points, so the error of the cubics between nodes is, too: with
normal displacements it is normal at every pixel, with a deviation that the splines through one displaced point each
give. Cubics leave nothing of the affine part. The kernel r^2 ln r has no second derivative at its control point, where
their error falls with the square of the stride alone; so that is where it is looked at, `_MARGIN` times.
"""

import itertools
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch

from torchrefract.effects.plan import READINGS, Ask, Plan, coarsest
from torchrefract.types import Range
from torchrefract.warping.lattice import lagrange_weights

_SIGMAS = 7.0  # the two components of the error are longer with a chance of exp(-_SIGMAS^2 / 2), 2e-11
_SLOPE_SIGMAS = 4.0
_MARGIN = 1.25
_MOST_POINTS = 64  # that errors are looked at
_INSIDE = (1, 3, 5)  # sixths of a cell


@lru_cache(maxsize=256)
def plate_plan(amplitude: float, points: tuple[int, int], smoothing: Range, ask: Ask) -> Plan:
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
    slope = _SLOPE_SIGMAS * amplitude * max(_slope(_plate(*plate)) for plate in plates)

    def error_between(stride: int, taps: int) -> float:
        return _MARGIN * _SIGMAS * amplitude * max(_deviation(plate, stride, taps) for plate in plates)

    readings = tuple((px, error_between(px, 2)) for px in READINGS)

    def attempt(stride: int) -> Plan | None:
        off = error_between(stride, 4)
        if off > room:
            return None
        error = off + cast(float, ask.tolerance_px) - room
        return ask.plan(stride, error, "kinks of the second derivative", random=True, slope=slope, readings=readings)

    return coarsest(attempt) or ask.plan(1, 0.0, "the plate bends too much for cubics")


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
def _deviation(plate: tuple[tuple[int, int], float, int, int], stride: int, taps: int) -> float:
    """Of the largest error of polynomials through so many nodes along each axis, for displacements of deviation 1.

    plate: arguments as for `_plate`.
    """
    unit, center, scale, weights, looked_at = _plate(*plate)
    step = stride / scale
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    cells = np.unique((np.floor(looked_at / stride)[:, None] + around).reshape(-1, 2), axis=0)
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


def _kernel(offset: np.ndarray) -> np.ndarray:
    square = (offset**2).sum(axis=-1)
    return 0.5 * square * np.log(np.where(square > 0, square, 1))
