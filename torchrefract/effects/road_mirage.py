"""The mirage over a hot road."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import in_ranges
from torchrefract._validation import (
    bounded,
    check_count,
    check_number,
    check_positive,
    check_within,
    eager_values,
    requires_grad,
)
from torchrefract.effects.batch import ParamsAtDepth, check_shapes, params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.random_field import check_frame, frames_of
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.depth import DepthSource, GroundPlaneDepth, check_depth_provider
from torchrefract.fields.road_mirage import (
    AIR_TEMPERATURE,
    REFRACTIVITY,
    critical_angle,
    road_mirage_flow,
    shimmering_difference,
)
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.grid import Points
from torchrefract.warping.implicit import sample_at

_BOUNDS: dict[str, Range] = {
    "difference": (0.0, 300.0),  # K
    "shimmer": (0.0, 1.0),
    "wave": (-1e4, 1e4),  # cycles per width
    "rate": (-1e3, 1e3),  # Hz
    "phase": (-1e3, 1e3),  # rad
}
_STEEPEST = 1 / (4 * 0.15)  # 1/px, of the edge
_NEARER = 0.5  # times the distance of the road: what stands that near hides the road behind it
_FADED_PX = 3.0  # below the edge, where less than 1e-7 px is left of the flow
_MOVES_PX = 1e-3  # less flow counts as none


class RoadMirageParams(NamedTuple):
    """The mirages of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    difference: Tensor  # (B,), K, by which the air at the road is hotter than that at the camera
    shimmer: Tensor  # (B,), standard deviation of the difference along the edge, relative to it
    wave: Tensor  # (B, K), cycles per width, of the edge
    rate: Tensor  # (B, K), Hz, of the edge
    phase: Tensor  # (B, K), rad, of the edge in frame 0
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the road is not hotter than the air."""
        return self.difference == 0


class RoadMirage(WarpEffect):
    """The mirage over a hot road: what stands at the horizon, mirrored in the road far ahead.

        source row = 2 y_h - y  for 0 < y - y_h < f theta_c on the road,  theta_c = sqrt(2 * 2.67e-4 dT / T),  T = 300 K

    A difference dT of 5, 10, 20 and 30 K mirrors 4.2, 5.9, 8.4 and 10.2 px below the horizon for a focal length of
    1400 px, from 436, 308, 218 and 178 m on for a camera at 1.3 m. dT varies along the edge and in time, so the edge
    shimmers. The road is where a pixel looks at the ground at most `half_width` from the line to its vanishing point,
    unless the depth shows something that stands in front of it. What the mirage hides is not valid in `restore_flow`,
    which is 0 elsewhere. The horizon must be that of the frames to a few pixels.

    Args:
        difference_range: K, dT, in [0, 300].
        shimmer_range: standard deviation of dT along the edge, relative to dT, in [0, 1].
        wave_range: cycles per width of the frame, of the waves that make the edge shimmer.
        rate_range: Hz, of these waves.
        num_waves: their number K.
        fps: frames per second of clips.
        camera_height: m, above the road.
        focal: f, widths of the frame.
        horizon: y_h, 0 at the top edge of the frame and 1 at its bottom edge.
        vanishing: where the road vanishes, 0 at the left edge of the frame and 1 at its right edge.
        half_width: m, of the hot road; inf for all of the ground.
        depth: of frames without a depth map, a provider or a function from images to their depth; None is a flat road
            with the numbers above.
        padding, interpolation, backend, tolerance_px, p: as for every warp. The edge is computed at every pixel.

    Raises:
        ValueError: an argument outside its range.

    Source: Young, "Sunset science IV: low-altitude refraction", Astronomical Journal 127 (2004).
    """

    params_type = RoadMirageParams
    has_closed_form = True
    has_kinks = True
    bounds_hold_at_any_depth = True

    def __init__(
        self,
        *,
        difference_range: Range = (5.0, 30.0),
        shimmer_range: Range = (0.2, 0.4),
        wave_range: Range = (3.0, 25.0),
        rate_range: Range = (-2.0, 2.0),
        num_waves: int = 6,
        fps: float = 30.0,
        camera_height: float = 1.3,
        focal: float = 0.9,
        horizon: float = 0.5,
        vanishing: float = 0.5,
        half_width: float = 5.0,
        depth: DepthSource | None = None,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        ranges = {"difference": difference_range, "shimmer": shimmer_range, "wave": wave_range, "rate": rate_range}
        self._set_ranges(ranges, _BOUNDS)
        self.num_waves = check_count("num_waves", num_waves)
        self.fps = check_number("fps", fps, low=1e-3, high=1e6)
        self.camera_height = check_number("camera_height", camera_height, low=1e-3, high=1e6)
        self.focal = check_number("focal", focal, low=1e-3, high=1e4)
        self.horizon = check_number("horizon", horizon, low=-10.0, high=10.0)
        self.vanishing = check_number("vanishing", vanishing, low=-10.0, high=10.0)
        self.half_width = math.inf if half_width == math.inf else check_positive("half_width", half_width)
        road = GroundPlaneDepth(camera_height=camera_height, focal=focal, horizon=horizon, far=math.inf)
        self.depth = road if depth is None else check_depth_provider(depth)

    def sample_params(self, stream: random.Stream, image: Tensor) -> RoadMirageParams:
        """Draw all numbers uniformly in their ranges, and phases over the circle."""
        count = self.num_waves
        ranges = [self._range("difference"), self._range("shimmer")]
        ranges += [self._range("wave")] * count + [self._range("rate")] * count + [(0.0, 2 * math.pi)] * count
        applied, values = self.draw_in_ranges(stream, ranges, image)
        wave, rate, phase = values[:, 2:].unflatten(1, (3, count)).unbind(1)
        return RoadMirageParams(applied, values[:, 0], values[:, 1], wave, rate, phase, torch.zeros_like(values[:, :1]))

    def validate(self, params: RoadMirageParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        count = params.wave.shape[1:]
        check_shapes(params, {"difference": (), "shimmer": (), "wave": count, "rate": count, "phase": count})
        check_frame(params)
        for name, (low, high) in _BOUNDS.items():
            check_within(f"params.{name}", getattr(params, name), low, high)

    def flow(self, params: ParamsAtDepth, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow at points; it exists everywhere."""
        mirage: RoadMirageParams = params.params
        values = {name: bounded(getattr(mirage, name), *ends) for name, ends in _BOUNDS.items()}
        below = points.y - (self.horizon * plan.height - 0.5)
        focal = self.focal * plan.width
        inverse_depth = sample_at(1 / params.depth.detach().to(below.dtype).clamp(min=1e-6), points)
        hottest = values["difference"] * (1 + values["shimmer"] * math.sqrt(2 * self.num_waves))
        height, rows = max(below.shape[2], points.x.shape[2]), slice(None)
        if not requires_grad(params):
            rows = _rows_between(below, focal * critical_angle(hottest).amax() + _FADED_PX)
        below, x, inverse_depth = (v[:, :, rows] if v.shape[2] > 1 else v for v in (below, points.x, inverse_depth))
        place = (x + 0.5) / plan.width
        difference = shimmering_difference(**values, place=place, time=frames_of(mirage).double() / self.fps)
        # 1 / distance of the ground, 1/m; that of a depth map may be 0 in the sky.
        ground = below.clamp(min=0) / (focal * self.camera_height)
        lateral = (place - self.vanishing).abs() * plan.width / focal  # m, at a distance of 1 m
        is_road = (lateral <= self.half_width * ground) & (inverse_depth <= ground / _NEARER)
        v = road_mirage_flow(critical_angle(difference), below, is_road, focal=focal)
        start = rows.start or 0
        flow = F.pad(v, (0, 0, start, height - v.shape[2] - start, 1, 0))  # no flow along x, and none in other rows
        return flow, everywhere(v.device)

    def inverse_flow(self, params: ParamsAtDepth, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Return a flow of 0, which exists where the mirage hides nothing."""
        return torch.zeros_like(flow), flow.detach().abs().amax(dim=1, keepdim=True) <= _MOVES_PX

    def error_model(self) -> "_MirageBounds":
        """Return the height of the mirage."""
        difference, shimmer = self._range("difference"), self._range("shimmer")
        hottest = difference[1] * (1 + shimmer[1] * math.sqrt(2 * self.num_waves))
        return _MirageBounds(difference, shimmer, self.focal * math.sqrt(2 * REFRACTIVITY / AIR_TEMPERATURE * hottest))


def _rows_between(below: Tensor, lowest: Tensor) -> slice:
    """Return the rows (N, 1, h, w) with a value between 0 and a limit; all if values cannot be read."""
    has_any = eager_values(lambda: ((below > 0) & (below < lowest)).any(dim=3).any(dim=0)[0], of=below)
    if has_any is None:
        return slice(None)
    rows = [row for row, value in enumerate(has_any) if value] or [0]
    return slice(rows[0], rows[-1] + 1)


@dataclass(frozen=True)
class _MirageBounds:
    """Bounds of a mirage.

    difference, shimmer: the ranges of the effect.
    height: widths of the frame, the largest one of the mirage.
    """

    difference: Range
    shimmer: Range
    height: float

    is_random = False

    def bounds(self, height: int, width: int) -> FlowBounds:
        """Return the largest displacement and slope; the edge is too sharp for a lattice."""
        largest = self.height * width
        return FlowBounds(2 * largest, 2 + 2 * largest * _STEEPEST)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        """Leave nothing out."""
        return Simplification(0.0, can_interpolate=False, why="the edge of the mirage is sharp")

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: difference and shimmer lie in the ranges, up to rounding."""
        return in_ranges(torch.stack([params.difference, params.shimmer], dim=1), [self.difference, self.shimmer])
