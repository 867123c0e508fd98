"""The rolling shutter of a camera that moves and vibrates."""

import math
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import bounded, check_count, check_number, check_values, check_within, finite_or
from torchrefract.cameras.camera import Camera, check_camera, pinhole_of
from torchrefract.effects.batch import ParamsAtDepth, check_shapes, params_to
from torchrefract.effects.random_field import check_frame, frames_of
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.depth import DepthSource, GroundPlaneDepth, check_depth_provider
from torchrefract.fields.rolling_shutter import (
    ShutterMotion,
    rolling_shutter_flow,
    rolling_shutter_restore_flow,
)
from torchrefract.fields.rolling_shutter_error import RollingShutterErrorModel
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import Range
from torchrefract.warping.flow import compose_flows
from torchrefract.warping.grid import Points, length
from torchrefract.warping.lattice import pixel_lattice

_BOUNDS: dict[str, Range] = {
    "speed": (-1000.0, 1000.0),  # km/h
    "readout": (-200.0, 200.0),  # ms
    "exposure": (0.0, 200.0),  # ms
    "pitch": (0.0, 5.0),  # deg
    "yaw": (0.0, 5.0),
    "roll": (0.0, 5.0),
    "frequency": (0.0, 1000.0),  # Hz
}
_AXES = ("pitch", "yaw", "roll")
_LARGEST_PHASE = 1e3  # rad
_NEAREST = 0.1  # m
_RESIDUAL_PX = 0.05  # of a valid restore flow


class RollingShutterParams(NamedTuple):
    """The motion of a batch of cameras."""

    applied: Tensor  # (B,), bool: the sample is degraded
    speed: Tensor  # (B,), km/h, forward
    readout: Tensor  # (B,), ms, from the first row to the last one; below 0 from the last to the first
    exposure: Tensor  # (B,), ms, of each row
    amplitude: Tensor  # (B, 3), deg, of the vibration in pitch, yaw and roll
    frequency: Tensor  # (B, K), Hz, of the vibration
    phase: Tensor  # (B, 3, K), rad, of the vibration in the middle of frame 0
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: all rows are exposed at one time, or the camera does not move."""
        is_still = (self.speed == 0) & (self.amplitude == 0).all(dim=1)
        return ((self.readout == 0) & (self.exposure == 0)) | is_still


class RollingShutter(WarpEffect):
    """A rolling shutter: the camera moves while the rows of a frame are exposed one after the other.

        p + flow(p) = c + f (r_x, r_y) / r_z (1 - v t / Z),  t = ((y + 1/2) / H - 1/2) readout
        r = R(a(t) - a(0)) ((x - cx) / fx, (y - cy) / fy, 1)
        a_i(t) = amplitude_i / sqrt(K) sum_k sin(2 pi f_k t + phase_ik),  i = pitch, yaw, roll

    Z is the depth where the pixel ends, v the speed, and R turns the camera. The clean frame is the one that all rows
    would show at the time of the middle row, so the effect is the skew of a frame, not its shake. In clips the
    vibration goes on from frame to frame. Place it before the lens: rows are those of the pinhole.

    With a depth map, which has edges, the flow is computed at every pixel. What the camera sees behind such an edge is
    not in the clean frame: it is filled by what is next to it. `restore_valid` leaves out what becomes hidden. Give the
    car's own bonnet an infinite depth, since it drives along.

    With an exposure, the image is the mean of `num_exposures` images at times spread evenly over it, and costs as many
    samplings. All maps and labels are those of the middle of the exposure.

    Args:
        speed_range: km/h, within [-1000, 1000], forward along the axis of the camera; below 0 backward.
        readout_range: ms, within [-200, 200], from the first row to the last one; below 0 for a camera that is mounted
            upside down.
        exposure_range: ms, of each row, in [0, 200].
        pitch_range, yaw_range, roll_range: deg, in [0, 5], amplitudes of the vibration. The K sines together have the
            variance of one sine of the amplitude.
        frequency_range: Hz, in [0, 1000], of the vibration; each of the K frequencies is drawn in it.
        num_frequencies: K.
        num_exposures: times that are averaged if there is an exposure.
        fps: frames per second of clips.
        depth: gives Z if no depth map is passed in, a provider or a function of the image; None is the flat road of
            `GroundPlaneDepth()`. Depths below 0.1 m count as 0.1 m.
        camera: of the frames, whose pinhole counts; None is a centered one with a focal length of 0.9 widths.
        padding, interpolation, backend, tolerance_px, p: as for every warp.

    Raises:
        ValueError: an argument outside its range; a depth that is clearly not in m, see `check_depth` (on the CPU).

    Source: Zhuang, Cheong, Lee, "Rolling-shutter-aware differential SfM and image rectification", ICCV 2017; Karpenko
    et al., "Digital video stabilization and rolling shutter correction using gyroscopes", Stanford CTSR 2011-03. The
    readout times are those of action cameras and phones. Amplitudes are not published for unpaved roads.
    """

    params_type = RollingShutterParams
    has_closed_form = True
    has_kinks = True  # at the horizon

    def __init__(
        self,
        *,
        speed_range: Range = (20.0, 100.0),
        readout_range: Range = (14.0, 33.0),
        exposure_range: Range = (0.0, 0.0),
        pitch_range: Range = (0.05, 0.2),
        yaw_range: Range = (0.02, 0.1),
        roll_range: Range = (0.05, 0.2),
        frequency_range: Range = (8.0, 25.0),
        num_frequencies: int = 3,
        num_exposures: int = 5,
        fps: float = 30.0,
        depth: DepthSource | None = None,
        camera: Camera | None = None,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        given = (speed_range, readout_range, exposure_range, pitch_range, yaw_range, roll_range, frequency_range)
        self._set_ranges(dict(zip(_BOUNDS, given, strict=True)), _BOUNDS)
        self.num_frequencies = check_count("num_frequencies", num_frequencies)
        self.num_exposures = check_count("num_exposures", num_exposures)
        self.fps = check_number("fps", fps, low=1e-3, high=1e6)
        # A network stays outside of the module, whose state holds nothing of an effect.
        vars(self)["depth"] = GroundPlaneDepth() if depth is None else check_depth_provider(depth)
        self.camera = check_camera(camera)

    def sample_params(self, stream: random.Stream, image: Tensor) -> RollingShutterParams:
        """Draw all numbers uniformly in their ranges, and phases over the circle."""
        count = self.num_frequencies
        ranges = [self._range(name) for name in _BOUNDS][:-1]
        spectrum = [self._range("frequency")] * count + [(0.0, 2 * math.pi)] * (3 * count)
        applied, values = self.draw_in_ranges(stream, [*ranges, *spectrum], image)
        speed, readout, exposure = values[:, :3].unbind(1)
        frequency, phase = values[:, 6 : 6 + count], values[:, 6 + count :].unflatten(1, (3, count))
        frame = torch.zeros_like(values[:, :1])
        return RollingShutterParams(applied, speed, readout, exposure, values[:, 3:6], frequency, phase, frame)

    def validate(self, params: RollingShutterParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        count = params.frequency.shape[-1]
        check_shapes(params, {"speed": (), "readout": (), "exposure": (), "amplitude": (3,)})
        check_shapes(params, {"frequency": (count,), "phase": (3, count)})
        check_frame(params)
        for name in ("speed", "readout", "exposure", "frequency"):
            check_within(f"params.{name}", getattr(params, name), *_BOUNDS[name])
        check_within("params.amplitude", params.amplitude, *_BOUNDS["pitch"])
        check_values("params.phase", "lie in [-1000, 1000]", params.phase, lambda v: v.abs() <= _LARGEST_PHASE)

    def flow(self, params: ParamsAtDepth, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow at the depth where each point ends."""
        motion, inverse_depth = self._motion(params)
        view = pinhole_of(self.camera, height=plan.height, width=plan.width)
        return rolling_shutter_flow(motion, inverse_depth, points, view)

    def inverse_flow(self, params: ParamsAtDepth, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Compute where each point of the clean frame is exposed; it exists where the flow leads back to the point."""
        motion, inverse_depth = self._motion(params)
        height, width = flow.shape[2:]
        points = pixel_lattice(height, width).points(dtype=flow.dtype, device=flow.device)
        view = pinhole_of(self.camera, height=height, width=width)
        inverse, exists = rolling_shutter_restore_flow(motion, inverse_depth, points, view)
        return inverse, exists & (length(compose_flows(flow, inverse)) <= _RESIDUAL_PX)

    def error_model(self) -> RollingShutterErrorModel:
        """Return the error bounds of the ranges for the depth of the provider."""
        largest = {name: max(map(abs, self._range(name))) for name in _BOUNDS}
        pitch, yaw, roll = (math.radians(largest[name]) for name in _AXES)
        ranges: list[tuple[str, tuple[Range, ...]]] = [
            (name, (self._range(name),)) for name in ("speed", "readout", "exposure")
        ]
        ranges.append(("amplitude", tuple([self._range(name) for name in _AXES])))
        ranges.append(("frequency", (self._range("frequency"),) * self.num_frequencies))
        return RollingShutterErrorModel(
            speed=largest["speed"] / 3.6,
            readout=largest["readout"] / 1000,
            moment=largest["exposure"] / 2000,
            amplitude=(pitch, yaw, roll),
            frequency=largest["frequency"],
            num_frequencies=self.num_frequencies,
            ranges=tuple(ranges),
            depth=cast(DepthSource, self.depth),
            camera=self.camera,
        )

    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> WarpPlan:
        """Return the plan for all parameters in the ranges, which counts the moments of the exposure."""
        return replace(super().plan_for_dtype(height, width, dtype), num_samplings=len(self.moments()))

    def moments(self) -> list[float]:
        """Return the moments of the exposure that are averaged; its middle if there is none."""
        count = self.num_exposures if self._range("exposure")[1] > 0 else 1
        return [(k + 0.5) / count - 0.5 for k in range(count)]

    def _motion(self, at_depth: ParamsAtDepth) -> tuple[ShutterMotion, Tensor]:
        """Return the motion of each frame in SI units, and 1 / depth; values that are not finite move nothing."""
        params: Any
        params, depth, moment = at_depth
        frequency = bounded(params.frequency, *_BOUNDS["frequency"])
        # Late frames have large phases, of which float32 would lose the digits.
        turns = frequency.double() * (frames_of(params).double()[:, None] / self.fps)
        turns = (turns - turns.detach().floor()).to(frequency.dtype)[:, None]
        exposure = bounded(params.exposure, *_BOUNDS["exposure"]) / 1000
        motion = ShutterMotion(
            speed=bounded(params.speed, *_BOUNDS["speed"]) / 3.6,
            readout=bounded(params.readout, *_BOUNDS["readout"]) / 1000,
            moment=torch.zeros_like(exposure) if moment is None else moment.to(exposure.dtype) * exposure,
            amplitude=torch.deg2rad(bounded(params.amplitude, *_BOUNDS["pitch"])),
            frequency=frequency,
            phase=finite_or(params.phase, 0.0) + 2 * math.pi * turns,
        )
        return motion, 1 / depth.to(frequency.dtype).clamp(min=_NEAREST)
