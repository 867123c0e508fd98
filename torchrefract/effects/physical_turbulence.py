"""Turbulent air that is stated by its physics: strength, scales, aperture, height and wind."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch, in_ranges
from torchrefract._validation import (
    bounded,
    check_count,
    check_number,
    check_positive,
    check_range,
    check_within,
)
from torchrefract.cameras.camera import UNKNOWN_FOCAL, Camera, check_camera, pinhole_of
from torchrefract.effects.batch import ParamsAtDepth, check_shapes, params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.random_field import check_frame, frames_of, is_still
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.depth import DepthSource, GroundPlaneDepth, check_depth_provider
from torchrefract.fields.physical_turbulence import (
    Air,
    domain_size,
    fried_parameter,
    height_gain,
    layer_gradients,
    layer_shares,
    layers_of,
    tilt_variance,
)
from torchrefract.fields.random_field import node_positions
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.grid import Points
from torchrefract.warping.implicit import sample_at
from torchrefract.warping.lattice import pixel_lattice

_STRONGEST = 1e-4  # Cn2
_LARGEST_TILT = 1e6  # microradians
_FASTEST = 1e3  # m/s
_SIGMAS = 7.0  # beyond which no displacement of a frame is expected


class PhysicalTurbulenceParams(NamedTuple):
    """The turbulence of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    tilt: Tensor  # (B,), microradians, standard deviation of the angle of arrival from the reach, on a level path
    wind: Tensor  # (B, 2), m/s, of the air to the right and down
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the air is still."""
        return self.tilt == 0


class PhysicalTurbulence(WarpEffect):
    """A frame seen through turbulent air of a strength Cn2, with the depth of each pixel.

        flow(p) = f gain sum_k w_k(d) grad phi_k(p - f wind t / s_k),  sum_k w_k^2 = Cn2 v min(d, reach)

    The air is divided into layers at distances s_k, each the gradient of a potential with the spectrum of von Karman as
    aperture and scales filter it. Each pixel adds the layers in front of it. Its variance is that of the integral over
    the path, see `tilt_variance` of `torchrefract.fields.physical_turbulence`. With a height h of the camera, Cn2 falls
    with the height above the road as (height / h)^(-4/3): a ray to the road has 1.8 to 2 times the variance of a level
    one, and the sky is still. Layers keep their form while the wind moves them (frozen flow).

    Sizes: with f = 1400 px and an aperture of 2 mm, Cn2 = 1e-12 moves what is 200 m away by 0.05 px, and 1e-11 what is
    300 m away by 0.18 px. Displacements of 0.5 to 3 px are those of telephoto lenses; `Turbulence` exaggerates them for
    others, see its `equivalent_cn2`. The air blurs short exposures too, which `BlurredTurbulence` adds. This blur is
    invisible where the aperture D is smaller than Fried's parameter r0: at 2 mm up to a Cn2 of 1e-12 over 1 km. The
    plan states D / r0 above 1.

    Args:
        cn2_range: m^(-2/3), at the height of the camera; its root is drawn uniformly. 1e-14 is weak, 1e-12 a hot day.
        camera: of the frames, whose pinhole counts; None is a centered one with the focal length `focal`.
        focal: widths of the frame, of a camera that is None, in [1e-3, 1e4].
        aperture: m, diameter of the entrance pupil.
        inner_scale, outer_scale: m, of the turbulence.
        height: m, of the camera above the ground; None for Cn2 that is the same everywhere.
        horizon: of the frame, 0 at its top edge and 1 at its bottom edge; it counts if there is a height.
        wind_x_range, wind_y_range: m/s, to the right and down.
        fps: frames per second of clips.
        reach: m, of the air. Farther pixels look through as much air as those at the reach.
        num_layers: 3 to 8. The correlation of pixels at the reach and beyond it does not depend on their number; more
            layers divide the air in front of nearer things more finely.
        depth: of frames without a depth map, a provider or a function from images to their depth; None is a flat road
            below the horizon, seen from the height, or from 1.3 m.
        padding, interpolation, backend, tolerance_px, p: as for every warp. Each pixel has a ray of its own, so the
            flow is exact; it is left out if no displacement exceeds the tolerance.

    Raises:
        ValueError: an argument outside its range; a camera of another aspect ratio than the frames.

    Source: see `torchrefract.fields.physical_turbulence`.
    """

    params_type = PhysicalTurbulenceParams
    bounds_hold_at_any_depth = True

    def __init__(
        self,
        *,
        cn2_range: Range = (1e-13, 1e-12),
        camera: Camera | None = None,
        focal: float = UNKNOWN_FOCAL,
        aperture: float = 0.002,
        inner_scale: float = 0.005,
        outer_scale: float = 10.0,
        height: float | None = 1.3,
        horizon: float = 0.5,
        wind_x_range: Range = (-3.0, 3.0),
        wind_y_range: Range = (-1.0, 0.0),
        fps: float = 30.0,
        reach: float = 1000.0,
        num_layers: int = 3,
        depth: DepthSource | None = None,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.cn2_range = check_range("cn2_range", cn2_range, low=0.0, high=_STRONGEST)
        self.camera = check_camera(camera)
        self.focal = check_number("focal", focal, low=1e-3, high=1e4)
        self.aperture = check_number("aperture", aperture, low=1e-6, high=100.0)
        self.inner_scale = check_number("inner_scale", inner_scale, low=1e-5, high=1.0)
        self.outer_scale = check_number("outer_scale", outer_scale, low=self.inner_scale, high=1e6)
        self.height = None if height is None else check_number("height", height, low=1e-3, high=1e6)
        self.horizon = check_number("horizon", horizon, low=-10.0, high=10.0)
        self.wind_x_range = check_range("wind_x_range", wind_x_range, low=-_FASTEST, high=_FASTEST)
        self.wind_y_range = check_range("wind_y_range", wind_y_range, low=-_FASTEST, high=_FASTEST)
        self.fps = check_number("fps", fps, low=1e-3, high=1e6)
        self.reach = check_number("reach", reach, low=1e-2, high=1e6)
        self.num_layers = check_count("num_layers", num_layers, low=3)
        if self.num_layers > 8:
            raise ValueError(f"num_layers must be at most 8, got {num_layers}")
        if depth is None:
            depth = road_depth(self.camera, focal=self.focal, height=self.height, horizon=self.horizon)
        self.depth = check_depth_provider(depth)
        self._layers = layers_of(self.reach, self.num_layers, self._air)
        self._tilt_of_unit = 1e6 * math.sqrt(tilt_variance(self.reach, self._air))
        low, high = (min(self._tilt_of_unit * math.sqrt(end), _LARGEST_TILT) for end in self.cn2_range)
        self._tilts = low, high

    def sample_params(self, stream: random.Stream, image: Tensor) -> PhysicalTurbulenceParams:
        """Draw the air of each sample, the displacement and the wind uniform in their ranges."""
        applied, values = self.draw_in_ranges(stream, [self._tilts, self.wind_x_range, self.wind_y_range], image)
        key, frame = random.noise_key(stream), torch.zeros_like(values[:, :1])
        return PhysicalTurbulenceParams(applied, values[:, 0], values[:, 1:], frame, key)

    def validate(self, params: PhysicalTurbulenceParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, {"tilt": (), "wind": (2,), "key": (4,)})
        check_frame(params)
        check_within("params.tilt", params.tilt, 0.0, _LARGEST_TILT)
        check_within("params.wind", params.wind, -_FASTEST, _FASTEST)

    def flow(self, params: ParamsAtDepth, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow at the depth of each point; it exists everywhere."""
        air: PhysicalTurbulenceParams = params.params
        dtype, (height, width) = air.tilt.dtype, (plan.height, plan.width)
        focal, _ = pinhole_of(self.camera, height=height, width=width, focal=self.focal)
        rows, columns = node_positions(points.lattice)
        gradients = layer_gradients(
            air.key,
            self._layers,
            focal=focal,
            size=domain_size(height, width),
            rows=rows,
            columns=columns,
            shift=self._shift(air),
            dtype=dtype,
        )
        depth = params.depth.to(dtype).clamp(max=self.reach)
        if depth.shape[3] > 1 or points.lattice != pixel_lattice(height, width):
            depth = sample_at(depth, points)
        shares = layer_shares(depth, self._layers)
        u = v = torch.zeros((), dtype=dtype, device=depth.device)
        for share, (along_x, along_y) in zip(shares, gradients, strict=True):
            u, v = torch.addcmul(u, share, along_x), torch.addcmul(v, share, along_y)
        scale = bounded(air.tilt, 0.0, _LARGEST_TILT).view(-1, 1, 1, 1) * 1e-6
        if self.height is not None:
            below = (points.y - (self.horizon * height - 0.5)) / focal[1]
            scale = scale * height_gain(1 - depth * below / self.height, self._layers.gains)
        flow = torch.cat([u * (scale * focal[0]), v * (scale * focal[1])], dim=1)
        return flow, everywhere(flow.device)

    def error_model(self) -> "_TurbulenceBounds":
        """Return the largest displacement of the ranges."""
        gain = 1.0 if self.height is None else max(self._layers.gains)
        return _TurbulenceBounds(self._tilts, gain, self.camera, self.focal, self.blur_ratio)

    @property
    def blur_ratio(self) -> float:
        """Return D / r0 at the reach in the strongest air of the range, by `fried_parameter`.

        Above 1 the air blurs a short exposure more than the aperture does; `BlurredTurbulence` adds this blur.
        """
        return self.aperture / fried_parameter(self.cn2_range[1], self.reach)

    def root_cn2(self, params: PhysicalTurbulenceParams) -> Tensor:
        """Return the root of the Cn2 of parameters, (B,), m^(-1/3)."""
        return params.tilt / self._tilt_of_unit

    def equivalent_amplitude(self, width: int, *, distance: float | None = None) -> Range:
        """Return the displacement, px, of what is a distance away in frames of a width, for the ends of `cn2_range`.

        Args:
            width: px.
            distance: m, of a level path; None is the reach.
        """
        distance = self.reach if distance is None else check_positive("distance", distance)
        focal = focal_px(self.camera, width, focal=self.focal)
        sigma = focal * math.sqrt(tilt_variance(min(distance, self.reach), self._air))
        low, high = self.cn2_range
        return sigma * math.sqrt(low), sigma * math.sqrt(high)

    @property
    def _air(self) -> Air:
        return Air(self.aperture, self.inner_scale, self.outer_scale)

    def _shift(self, params: PhysicalTurbulenceParams) -> Tensor | None:
        """Return (N, 2), m: how far the wind has moved the air, or None if it has not."""
        if is_still(params.frame, params.wind):
            return None
        frame = frames_of(params).double()[:, None]
        wind = expand_batch(bounded(params.wind, -_FASTEST, _FASTEST), len(frame))
        return frame / self.fps * wind.double()


@dataclass(frozen=True)
class _TurbulenceBounds:
    """Bounds of the displacement by turbulence.

    tilt: microradians, from the reach on a level path.
    gain: the largest gain by height.
    camera, focal, blur_ratio: as for `PhysicalTurbulence`.
    """

    tilt: Range
    gain: float
    camera: Camera | None
    focal: float
    blur_ratio: float

    is_random = True

    def bounds(self, height: int, width: int) -> FlowBounds:
        """Return the largest displacement; each pixel has a ray of its own, so the flow is not smooth."""
        focal, _ = pinhole_of(self.camera, height=height, width=width, focal=self.focal)
        largest = _SIGMAS * self.gain * self.tilt[1] * 1e-6 * max(focal)
        return FlowBounds(largest)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        """Leave nothing out."""
        why = "each pixel has a ray of its own"
        if self.blur_ratio > 1:
            why += f"; BlurredTurbulence blurs short exposures too, D / r0 is up to {self.blur_ratio:.1f}"
        return Simplification(0.0, can_interpolate=False, why=why)

    def contains(self, params: PhysicalTurbulenceParams) -> Tensor:
        """Return (), bool: the tilt lies in the range, up to rounding."""
        return in_ranges(params.tilt[:, None], [self.tilt])


def road_depth(camera: Camera | None, *, focal: float, height: float | None, horizon: float) -> GroundPlaneDepth:
    """Return the depth of a flat road; arguments as for `PhysicalTurbulence`."""
    return GroundPlaneDepth(
        camera_height=1.3 if height is None else height,
        focal=focal_px(camera, 1, focal=focal),
        horizon=horizon,
        far=math.inf,
    )


def focal_px(camera: Camera | None, width: int, *, focal: float = UNKNOWN_FOCAL) -> float:
    """Return the focal length in frames of a width, px; that of a camera that is None is `focal`, in widths."""
    check_count("width", width)
    return focal * width if camera is None else camera.fx * width / camera.width
