"""Error bounds for thin-plate splines on a lattice.

A thin-plate spline is linear in the displacements of its control points, so the error of cubics between nodes is, too:
with normal displacements it is normal at every pixel. Its variance is the sum of squared errors of the splines that
displace one point by 1 each. Cubics reproduce the affine part. The kernel r^2 ln r has no second derivative at its
control point, where the error falls with the square of the stride only. The errors are therefore measured around the
control points, and multiplied by `_SAFETY`. The kernel is the same in all directions: along axes that are not at right
angles the error is smaller.
"""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchrefract._tensor import in_ranges
from torchrefract.random import LARGEST_NORMAL
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.lattice import lagrange_basis

_SIGMAS = 7.0  # the two components of the error are longer with a probability of exp(-_SIGMAS^2 / 2), 2e-11
_DERIVATIVE_SIGMAS = 4.0  # errors and derivatives are not at their largest in the same place
_MOST_POINTS = 100  # of a spline whose bounds are measured
_SAFETY, _GRADIENT_SAFETY = 1.25, 1.05
_MAX_POINTS = 64  # at which errors are measured
_LEVELS = np.array([2.0, 16.0, 64.0, 256.0])  # px, strides at which errors are measured
_INSIDE = (1, 3, 5)  # positions in a cell, sixths
_PLACES = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (0.25, 0.25))  # of a control point in its cell


@dataclass(frozen=True)
class ThinPlateErrorModel:
    """Error bounds for thin-plate splines through a lattice of points with normal displacements; see `ErrorModel`.

    amplitude: px, the largest standard deviation of the displacements.
    lattice: rows and columns of control points, from corner to corner.
    smoothing: range.
    """

    amplitude: float
    lattice: tuple[int, int]
    smoothing: Range

    is_random = True

    def bounds(self, height: int, width: int) -> FlowBounds | None:
        """Return bounds of the displacement, and measured ones of its gradient and of the error of cubics.

        None for many control points, since measuring their splines takes longer than the lattice saves.
        """
        return None if math.prod(self.lattice) > _MOST_POINTS else _bounds(self, height, width)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        """Leave out nothing; a flow that is longer than the frame is computed at every pixel."""
        if _max_displacement(self) > min(height, width):
            return Simplification(0.0, can_interpolate=False, why="the flow is longer than the frame")
        return Simplification(0.0, why="kinks of the second derivative")

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: displacements and smoothing are such as can be drawn; points are not compared."""
        largest = LARGEST_NORMAL * self.amplitude
        is_drawn = in_ranges(params.displacement.reshape(-1, 1), [(-largest, largest)])
        return is_drawn & in_ranges(params.smoothing[:, None], [self.smoothing])


def _max_displacement(model: ThinPlateErrorModel) -> float:
    return 2 * _SIGMAS * model.amplitude


@lru_cache(maxsize=256)
def _bounds(model: ThinPlateErrorModel, height: int, width: int) -> FlowBounds:
    splines = [_unit_splines(model.lattice, value, height, width) for value in sorted(set(model.smoothing))]
    steep, largest = _DERIVATIVE_SIGMAS * model.amplitude, _SAFETY * _SIGMAS * model.amplitude
    errors = np.array([max(_deviation(spline, level) for spline in splines) for level in _LEVELS])
    log_levels, log_errors = np.log(_LEVELS), np.log(np.maximum(errors, 1e-30))

    def interpolation_error(strides: np.ndarray) -> np.ndarray:
        # The error is a sum of a second and a fourth power of the stride: lines between logarithms lie above it.
        between = largest * np.exp(np.interp(np.log(strides), log_levels, log_errors))
        return np.where(np.asarray(strides) > _LEVELS[-1], np.inf, between)

    return FlowBounds(
        _max_displacement(model),
        _GRADIENT_SAFETY * steep * max(map(_gradient, splines)),
        interpolation_error,
    )


class _UnitSplines(NamedTuple):
    """Splines through a lattice of P control points, each of which displaces one point by 1."""

    points: np.ndarray  # (P, 2), in units of their rms radius
    center: np.ndarray  # (2,), px
    scale: float  # px, of the unit
    weights: np.ndarray  # (P + 3, P): of the kernels and of 1, x, y, one column for each spline
    measured: np.ndarray  # (n, 2), px: some of the points
    between: np.ndarray  # (n, 2), px: a lattice four times as fine, or some of it


def _unit_splines(lattice: tuple[int, int], smoothing: float, height: int, width: int) -> _UnitSplines:
    at = _lattice_points(lattice, height, width)
    rows, columns = lattice
    between = _lattice_points((4 * rows - 3, 4 * columns - 3), height, width)
    center = at.mean(axis=0)
    scale = float(np.sqrt(((at - center) ** 2).sum(axis=1).mean()))
    unit = (at - center) / scale
    plane = np.column_stack([np.ones(len(unit)), unit])
    kernel = _kernel(unit[:, None] - unit) + smoothing * np.eye(len(unit))
    system = np.block([[kernel, plane], [plane.T, np.zeros((3, 3))]])
    weights = np.linalg.solve(system, np.eye(len(unit) + 3))[:, : len(unit)]
    return _UnitSplines(unit, center, scale, weights, _choose(at, _MAX_POINTS), _choose(between, 4 * _MAX_POINTS))


def _lattice_points(lattice: tuple[int, int], height: int, width: int) -> np.ndarray:
    y, x = (np.linspace(0, max(size - 1, 1), count) for size, count in zip((height, width), lattice, strict=True))
    return np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1).reshape(-1, 2)


def _choose(points: np.ndarray, count: int) -> np.ndarray:
    return points[np.unique(np.linspace(0, len(points) - 1, min(len(points), count)).round().astype(int))]


def _deviation(splines: _UnitSplines, stride: float) -> float:
    """Measure the deviation of the largest error of cubics, for displacements of deviation 1."""
    unit, center, scale, weights, measured, _ = splines
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    offsets = np.arange(-1, 3)
    nodes = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    step, largest = stride / scale, 0.0
    for place in _PLACES:
        cells = np.unique(((measured / stride - place)[:, None] + around).reshape(-1, 2), axis=0)
        corners = (cells * stride - center) / scale
        at_nodes = _kernel(corners[:, None, None] + step * nodes[:, None] - unit)  # (cells, nodes, P)
        for x, y in itertools.product(_INSIDE, repeat=2):
            weights_of_nodes = np.outer(lagrange_basis(y / 6), lagrange_basis(x / 6)).ravel()
            between = np.einsum("j,cjp->cp", weights_of_nodes, at_nodes)
            error = (_kernel(corners[:, None] + step * np.array([x, y]) / 6 - unit) - between) @ weights[: len(unit)]
            largest = max(largest, float(np.sqrt((error**2).sum(axis=1)).max()))
    return largest


def _gradient(splines: _UnitSplines) -> float:
    """Measure the deviation of the largest gradient, for displacements of deviation 1."""
    pixel = np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    at = (splines.between + pixel - splines.center) / splines.scale  # (4, n, 2)
    plane = np.concatenate([np.ones_like(at[..., :1]), at], axis=-1)
    right, left, down, up = np.concatenate([_kernel(at[:, :, None] - splines.points), plane], axis=-1) @ splines.weights
    gradients = np.stack([right - left, down - up]) / 2
    return float(np.sqrt((gradients**2).sum(axis=-1)).max())


def _kernel(offset: np.ndarray) -> np.ndarray:
    square = (offset**2).sum(axis=-1)
    return 0.5 * square * np.log(np.where(square > 0, square, 1))
