"""What a thin plate will compute under a tolerance.

A plate is linear in the displacements of its control points, so the error of the cubics between nodes is, too: with
normal displacements it is normal at every pixel, with a deviation that the splines through one displaced point each
give. Cubics leave nothing of the affine part. The kernel r^2 ln r has no second derivative at its control point, where
their error falls with the square of the stride alone; so that is where it is looked at, `_MARGIN` times.
"""

import itertools
from functools import lru_cache, partial

import numpy as np
import torch

from torchrefract.effects.plan import Plan, check_reachable, coarsest
from torchrefract.types import Range
from torchrefract.warping.lattice import lagrange_weights

_SIGMAS = 7.0  # the two components of the error are longer with a chance of exp(-_SIGMAS^2 / 2), 2e-11
_MARGIN = 1.25
_MOST_POINTS = 64  # that errors are looked at
_INSIDE = (1, 3, 5)  # sixths of a cell


@lru_cache(maxsize=256)
def plate_plan(
    amplitude: float,
    points: tuple[int, int],
    smoothing: Range,
    height: int,
    width: int,
    tolerance: float | None,
    double: bool,
) -> Plan:
    """The plan for frames of a size, in float64 or in float32.

    Args:
        amplitude: px, the largest.
        points: rows and columns of control points, corner to corner.
        smoothing: the range.
        height, width, tolerance, double: of the frame.
    """
    plan = partial(Plan, height, width, tolerance)
    if tolerance is None:
        return plan(1, 0.0, "no tolerance")
    room = check_reachable(tolerance, height=height, width=width, double=double)
    most = 2 * _SIGMAS * amplitude
    if most <= room:
        return plan(0, most, "it moves too little")
    if most > min(height, width):
        return plan(1, 0.0, "it moves too far for a lattice")

    def attempt(stride: int) -> Plan | None:
        deviation = max(_deviation(points, value, height, width, stride) for value in set(smoothing))
        off = _MARGIN * _SIGMAS * amplitude * deviation
        return plan(stride, off + tolerance - room, "kinks of the second derivative") if off <= room else None

    return coarsest(attempt) or plan(1, 0.0, "the plate bends too much for cubics")


@lru_cache(maxsize=1024)
def _deviation(points: tuple[int, int], smoothing: float, height: int, width: int, stride: int) -> float:
    """Of the largest error between nodes, for displacements of deviation 1."""
    y, x = (np.linspace(0, max(size - 1, 1), count) for size, count in zip((height, width), points, strict=True))
    at = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1).reshape(-1, 2)
    center = at.mean(axis=0)
    scale = np.sqrt(((at - center) ** 2).sum(axis=1).mean())
    unit, step = (at - center) / scale, stride / scale
    # The weights of the kernels, one column for each point that is displaced.
    plane = np.column_stack([np.ones(len(unit)), unit])
    kernel = _kernel(unit[:, None] - unit) + smoothing * np.eye(len(unit))
    system = np.block([[kernel, plane], [plane.T, np.zeros((3, 3))]])
    weights = np.linalg.solve(system, np.eye(len(unit) + 3))[: len(unit), : len(unit)]
    # Cells around some of the points, where the kernels have kinks.
    chosen = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), _MOST_POINTS)).round().astype(int))]
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    cells = np.unique((np.floor(chosen / stride)[:, None] + around).reshape(-1, 2), axis=0)
    corners = (cells * stride - center) / scale
    nodes = np.stack(np.meshgrid(np.arange(-1, 3), np.arange(-1, 3)), axis=-1).reshape(-1, 2)
    known = _kernel(corners[:, None, None] + step * nodes[:, None] - unit)  # (cells, 16, N)
    largest = 0.0
    cubic = lagrange_weights(6, 4, dtype=torch.float64, device=torch.device("cpu")).numpy()
    for x, y in itertools.product(_INSIDE, repeat=2):
        between = np.einsum("j,cjn->cn", np.outer(cubic[y], cubic[x]).ravel(), known)
        error = (_kernel(corners[:, None] + step * np.array([x, y]) / 6 - unit) - between) @ weights
        largest = max(largest, float(np.sqrt((error**2).sum(axis=1)).max()))
    return largest


def _kernel(offset: np.ndarray) -> np.ndarray:
    square = (offset**2).sum(axis=-1)
    return 0.5 * square * np.log(np.where(square > 0, square, 1))
