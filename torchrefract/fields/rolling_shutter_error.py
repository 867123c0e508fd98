"""Error bounds for the flow of a rolling shutter, if all pixels of a row have one depth."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import in_ranges
from torchrefract.cameras.camera import Camera, pinhole_of
from torchrefract.fields.depth import DepthProvider, DepthSource
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.lattice import lagrange_basis

_SAFETY = 1.25  # of measured errors, since the flow is not quite linear along rows
_LARGEST_SHARE = 0.4  # of a depth, driven while the rows are read
_FOURTH = 9 / 16 / 24  # times the fourth derivative and stride^4: error of cubics through four nodes
_OFFSETS = 4  # of the lattice, at which errors are measured
_LARGEST_STRIDE = 128  # px
_SMALLEST_FRAME = 1 << 14  # pixels


@dataclass(frozen=True, kw_only=True)
class RollingShutterErrorModel:
    """Error bounds for all rolling shutters of the ranges; see `ErrorModel`.

    speed: m/s, the largest magnitude.
    readout: s, the largest magnitude.
    moment: s, from the middle of the exposure of each row, the largest magnitude.
    amplitude: rad, the largest for pitch, yaw and roll.
    frequency: Hz, the largest.
    num_frequencies: of the vibration.
    ranges: of the parameters by name, (low, high) of all numbers.
    depth: of the frame.
    camera: of the frame.
    """

    speed: float
    readout: float
    moment: float
    amplitude: tuple[float, float, float]
    frequency: float
    num_frequencies: int
    ranges: tuple[tuple[str, tuple[Range, ...]], ...]
    depth: DepthSource
    camera: Camera | None

    is_random = False

    def __hash__(self) -> int:
        """Return a hash without the provider, which may have none."""
        return hash((self.speed, self.readout, self.moment, self.amplitude, self.frequency, self.ranges, self.camera))

    def bounds(self, height: int, width: int) -> FlowBounds | None:
        """Return bounds, with errors between nodes measured along a row profile; None for depth that varies in a row.

        With forward motion alone x + u = c + (x - c) (1 - v t / Z) at the end of each row, likewise y: linear along x,
        and along y as smooth as t / Z. Vibration adds sines of t and the perspective of small angles.
        """
        if not isinstance(self.depth, DepthProvider):
            return None
        depth = self.depth(height, width, dtype=torch.float64, device=torch.device("cpu"))
        if depth.shape[3] > 1:
            return None
        (fx, fy), (cx, cy) = pinhole_of(self.camera, height=height, width=width)
        reach_x, reach_y = (max(abs(c), abs(size - 1 - c)) for c, size in ((cx, width), (cy, height)))
        focal = max(fx, fy)
        stretch = 1 + (reach_x / fx) ** 2 + (reach_y / fy) ** 2  # of angles, far from the axis
        # Sines at any time: their difference is at most 2, and at most the change of phase.
        turned = math.sqrt(self.num_frequencies) * np.array(self.amplitude)
        angle = float(turned.sum()) * min(2.0, 2 * math.pi * self.frequency * (self.readout / 2 + self.moment))
        step = 2 * math.pi * self.frequency * self.readout / height  # rad of phase per row
        if angle > 0.2:
            return None
        # Way over depth at each row, for the time of the row and for that of the exposure.
        inverse = 1 / depth[0, 0, :, 0].clamp(min=1e-6).numpy()
        times = ((np.arange(height) - (height - 1) / 2) * (self.readout / height), np.full(height, self.moment))
        profiles = [self.speed * time * inverse for time in times]
        share = sum(float(np.abs(profile).max()) for profile in profiles)
        way = self.speed * (self.readout / 2 + self.moment)
        slope = way * reach_y * _steepest(inverse)
        if share > _LARGEST_SHARE or slope > _LARGEST_SHARE:
            return None
        # Of each row: the largest distance from the principal point, and its growth, as the depth is that at the end.
        distance = np.hypot(reach_x, np.arange(height) - cy)
        time = sum(map(np.abs, times))
        grown = distance / (1 - self.speed * time * np.abs(np.arange(height) - cy) * _steepest(inverse))
        moved = share * float(grown.max()) + angle * focal * stretch
        gradient = share + float(grown.max()) * sum(map(_steepest, profiles))
        gradient += step * float(turned.sum()) * focal * stretch + 4 * angle * stretch
        measured = [_interpolation_error(profile, grown) for profile in profiles]
        # Per px^4, along columns the sines, along rows and columns perspective.
        fourth = focal * stretch * float(turned.sum()) * step**4 + 24 * angle * stretch**2 / focal**3

        def interpolation_error(strides: np.ndarray) -> np.ndarray:
            between = _SAFETY * sum(error(strides) for error in measured)
            return np.where(strides > _LARGEST_STRIDE, np.inf, between + _FOURTH * fourth * strides**4)

        return FlowBounds(moved, gradient, interpolation_error)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        """Leave out nothing; a small frame is computed at every pixel, since a lattice saves no time."""
        if height * width < _SMALLEST_FRAME:
            return Simplification(0.0, can_interpolate=False, why="the frame is small")
        return Simplification(0.0, why="as smooth as the depth and the vibration")

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: all parameters lie in the ranges."""
        inside = []
        for name, ranges in self.ranges:
            values = getattr(params, name)
            values = values[:, None] if values.ndim == 1 else values
            if values.shape[1] != len(ranges):  # another number of frequencies
                return torch.zeros((), dtype=torch.bool, device=values.device)
            inside.append(in_ranges(values, ranges))
        return torch.stack(inside).all()


def _steepest(profile: np.ndarray) -> float:
    """Return the largest change from one row to the next."""
    return float(np.abs(np.diff(profile)).max()) if len(profile) > 1 else 0.0


def _interpolation_error(profile: np.ndarray, weight: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Measure the weighted error of cubics through every s-th row of a profile, (H,), linear beyond its ends."""
    height = len(profile)
    margin = 2 * _LARGEST_STRIDE
    before = profile[0] - (profile[min(1, height - 1)] - profile[0]) * np.arange(margin, 0, -1)
    after = profile[-1] + (profile[-1] - profile[max(height - 2, 0)]) * np.arange(1, margin + 1)
    values = np.concatenate([before, profile, after])

    def largest(stride: int) -> float:
        if stride <= 1 or stride > _LARGEST_STRIDE:
            return 0.0
        errors = []
        for offset in sorted({round(k * stride / _OFFSETS) for k in range(_OFFSETS)}):
            place = (np.arange(height) + offset) / stride
            cell = np.floor(place).astype(int)
            t = place - cell
            nodes = values[margin - offset + (cell + np.arange(-1, 3)[:, None]) * stride]
            cubic = (nodes * lagrange_basis(t)).sum(axis=0)
            errors.append((weight * np.abs(cubic - profile)).max())
        return float(max(errors))

    return lambda strides: np.array([largest(int(stride)) for stride in np.atleast_1d(strides)])
