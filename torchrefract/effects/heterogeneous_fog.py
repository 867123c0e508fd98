"""Fog whose density varies: over the image, or in space."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, expand_batch, in_ranges
from torchrefract._validation import (
    bounded,
    check_choice,
    check_number,
    check_positive,
    check_range,
    check_values,
    check_within,
    eager_values,
    finite_or,
)
from torchrefract.cameras.camera import Camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.fog import Airlight, check_fog_params, check_fog_ranges, draw_fog, make_medium
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.effects.random_field import (
    check_decorrelation,
    check_motion,
    check_wind,
    drawn_motion,
    motion_of,
    motion_ranges,
)
from torchrefract.fields.airlight import sunlit_airlight
from torchrefract.fields.depth import DepthSource
from torchrefract.fields.dust import descent_of_rows, mean_density, mean_wake_density
from torchrefract.fields.fog_volume import ExtinctionField, mean_extinction_along_rays
from torchrefract.fields.heterogeneous_fog import image_noise, normalize_weights, periods_in_frame
from torchrefract.fields.night_glow import unclip_lamps
from torchrefract.fields.srgb import luma
from torchrefract.labels.vehicles import check_vehicle_labels
from torchrefract.planning.photometric import (
    PhotometricPlan,
    PhotometricRequest,
    plan_image_fog,
    plan_uniform_fog,
    plan_volumetric_fog,
)
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

# Scales and weights of the paper, for noise in the image.
_PAPER_SCALES = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_PAPER_WEIGHTS = (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
# Scales in m and weights of fog over a road: structures as long as a few cars have the largest variance.
_ROAD_SCALES = (12.0, 24.0, 48.0, 96.0)
_ROAD_WEIGHTS = (0.2, 0.3, 0.3, 0.2)
_CONTRASTS = (0.0, 2.0)
_SCALE_HEIGHTS = (0.05, 1e6)  # m
_EVEN = 1e30  # m, a scale height at which the density is even up to the sky
_FARTHEST_PX = 1e5  # of a box
_DARK_AIRLIGHT = 0.4  # luma, below which fog is that of the night


class HeterogeneousFogParams(NamedTuple):
    """The parameters of heterogeneous fog for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    visibility: Tensor  # (B,), m, above 0, of the mean extinction; inf is clear air
    deviation: Tensor  # (B,), relative deviation of the mean extinction, above -1
    airlight: Tensor  # (B, C), in [0, 1], as stored in the image
    weights: Tensor  # (B, K), of the scales, at least 0 and not all 0
    contrast: Tensor  # (B,), standard deviation of the logarithm of the extinction in space, at least 0
    wind: Tensor  # (B, 3), per frame, to the right, down and ahead: m in space; px of the reference in the image
    decorrelation: Tensor  # (B,), frames, above 0; inf for fog that only moves with the wind
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the noise
    scale_height: Tensor | None = None  # (B,), m, over which the density falls to 1/e; inf or None: it does not
    # (B, 3): degrees to the right of the camera, degrees above the horizon, share of direct sunlight in the airlight;
    # used by an effect with `sunlight_range` only; None is no sunlight
    sun: Tensor | None = None
    # (B, V, 4) or, one for each frame of a clip, (B, T, V, 4): boxes x1, y1, x2, y2 of vehicles ahead, px from the
    # center of the first pixel, as for `warp_boxes`; a box without an area is no vehicle. Drawn params have no boxes
    vehicles: Tensor | None = None

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the air is clear."""
        return self.visibility == torch.inf

    @property
    def has_vehicles(self) -> bool:
        """Return True if there are boxes, also if none has an area."""
        return self.vehicles is not None and self.vehicles.shape[-2] > 0


class HeterogeneousFog(PhotometricEffect):
    """Fog whose density changes from place to place.

        I = I_clean t + A (1 - t),  t = exp(-k d),  k = k0 (1 + deviation) q / <q>,  k0 = -ln(threshold) / V

    In the mode "image", that of the paper, q is a sum of Perlin noises n_i in the image plane, one at each scale:
    q = sum w_i (n_i / sqrt(1/2) + 1) / 2 / sum w_i. In the mode "ray" (volumetric fog) q is the mean along the ray of
    each pixel, up to its depth, of the field exp(contrast g) in space; g is a sum of noises of unit variance. Near fog
    then moves faster than far fog. <q> is the mean over the frame, so V is that of the mean extinction, as in
    `UniformFog`. `transmission` is t, `extinction` is k, and `valid` is t >= 1/255.

    Args:
        mode: "image" or "ray".
        scales: of the noises, above 0; None is 4, 8, 16, 32, 64, 128 in the image (the paper), 12, 24, 48, 96 in space.
        weights: one for each scale, at least 0, not all 0; None takes those that belong to the default scales.
        scale_unit: of the scales in the image, "px" (periods in px of a frame `reference_width` wide) or "cells"
            (periods across the frame); in space they are in m.
        reference_width: px, see `scale_unit` and the wind.
        normalize: of each noise in the image: "theory" maps its bounds +-sqrt(1/2) to [0, 1], "image" its smallest and
            largest value in the frame, as in the paper, without a gradient of these.
        mean: <q> is the mean over the "image", or that of the "ensemble" of all fogs: 1/2 in the image; 1 in space,
            where the true mean is 1 % less at a contrast of 1 and 11 % less at 2.
        contrast_range: standard deviation of ln q at a point in space, in [0, 2]; 0 is uniform fog.
        reach: m; beyond it volumetric fog is uniform.
        wind_x_range, wind_y_range, wind_z_range: how far the fog moves per frame of a clip, to the right, down and
            ahead, as seen by the camera: m in space, where a car at v m per frame sees -v ahead; px of the reference in
            the image, which has no z.
        scale_height_range: m, in [0.05, 1e6], H of a plume of dust or of ground fog in the mode "ray", whose density
            falls with the height above the road as exp(-h / H). Its mean along each ray is exact, see `mean_density`,
            and multiplies that of the random field; V is the visibility on the road. None is an even density.
        wake_density: of the dust on the road behind a vehicle ahead, relative to the mean extinction, at least 0.
        wake_length: m, over which this dust falls to 1/e toward the camera. It is as wide and high as the vehicle, see
            `mean_wake_density`, and is added to the fog where boxes are given: by `vehicle_labels`, or by
            `effect.apply(image, effect.sample(image)._replace(vehicles=boxes))`. Without boxes there is none.
        vehicle_labels: numbers or names of the classes whose boxes raise this dust where a target has boxes, as in
            `effect(image, target)` and `degrade labels=...`; boxes without classes all do, those of clips do not. None
            raises none.
        camera_height, horizon: m, of the camera above the road, and share of the height of the frame, from the top, at
            which the road vanishes; for a plume and vehicles, and the horizon for the sun.
        sunlight_range: share of direct sunlight in the airlight, within [0, 1]: it makes the fog brighter on the side
            of the sun and darker on the other, see `sunlit_airlight`. About 0.1 for a sun that is hardly seen through
            fog and 0.5 for dust under a clear sky. None is the same airlight everywhere.
        sun_azimuth_range, sun_elevation_range: degrees, of the sun to the right of the camera, within [-360, 360], and
            above the horizon, within [-10, 90].
        asymmetry: mean cosine of the angle by which the fog scatters light, in (-1, 1): 0.6 to 0.9 for thin haze and
            dust, less for fog, in which light is scattered many times.
        lamp_luminance: in [1, 1e4], of lamps in fog at night, whose airlight is darker than 0.4: pixels that the camera
            clipped, of stored values from 0.85 to 1, count as up to that many times white, see `unclip_lamps`, and stay
            bright through fog that hides the rest. `remove_fog` does not undo them. Take linear light with it.
        decorrelation_range: frames, above 0 or inf, until k in the wind has the correlation 1/e with itself; one over
            it is uniform.
        tolerance: largest error of the image, levels of 1/255: octaves that are too faint, and fog or a contrast that
            cannot be seen, are not computed, see `plan`. None is exact. All octaves are computed for
            normalize="image" and if <q> may come near 0.
        visibility_range, deviation_range, airlight, threshold, depth, camera, linear_light, p: as for `UniformFog`; the
            rays in space are those of the camera, or of a pinhole with a focal length of 0.9 widths.

    Raises:
        ValueError: an argument outside its range; as for `UniformFog`.

    Source: the torchrefract paper; Zdrojewska, "Real time rendering of heterogenous fog based on the graphics hardware
    acceleration", CESCG 2004; in space, Wronski, "Volumetric fog", SIGGRAPH 2014.
    """

    params_type = HeterogeneousFogParams
    maps = ("transmission", "extinction")

    def __init__(
        self,
        *,
        mode: str = "image",
        visibility_range: Range = (100.0, 100.0),
        deviation_range: Range = (-0.05, 0.05),
        airlight: Airlight = None,
        threshold: float = 0.05,
        depth: DepthSource | None = None,
        camera: Camera | None = None,
        linear_light: bool = False,
        scales: Sequence[float] | None = None,
        weights: Sequence[float] | None = None,
        scale_unit: str = "px",
        reference_width: float = 1920.0,
        normalize: str = "theory",
        mean: str = "image",
        contrast_range: Range = (0.5, 0.8),
        reach: float = 400.0,
        wind_x_range: Range = (-0.1, 0.1),
        wind_y_range: Range = (0.0, 0.0),
        wind_z_range: Range = (0.0, 0.0),
        decorrelation_range: Range = (60.0, 150.0),
        scale_height_range: Range | None = None,
        wake_density: float = 10.0,
        wake_length: float = 15.0,
        lamp_luminance: float = 1.0,
        vehicle_labels: Sequence[int | str] | None = None,
        camera_height: float = 1.3,
        horizon: float = 0.5,
        sunlight_range: Range | None = None,
        sun_azimuth_range: Range = (-180.0, 180.0),
        sun_elevation_range: Range = (5.0, 30.0),
        asymmetry: float = 0.5,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.mode = check_choice("mode", mode, ("image", "ray"))
        self.visibility_range, self.deviation_range = check_fog_ranges(visibility_range, deviation_range)
        self.medium = make_medium(
            airlight=airlight, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light
        )
        self.depth = self.medium.depth
        self.scales, self.weights = _check_scales(scales, weights, mode=mode)
        self.scale_unit = check_choice("scale_unit", scale_unit, ("px", "cells"))
        self.reference_width = check_positive("reference_width", reference_width)
        self.normalize = check_choice("normalize", normalize, ("theory", "image"))
        self.mean = check_choice("mean", mean, ("image", "ensemble"))
        self.contrast_range = check_range("contrast_range", contrast_range, low=_CONTRASTS[0], high=_CONTRASTS[1])
        self.reach = check_number("reach", reach, low=1.0, high=1e5)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.wind_z_range = check_wind("wind_z_range", wind_z_range)
        if mode == "image" and self.wind_z_range != (0.0, 0.0):
            raise ValueError(
                f"wind_z_range must be (0, 0) for mode='image', which has no depth, got {self.wind_z_range}"
            )
        self.decorrelation_range = check_decorrelation(decorrelation_range)
        self.scale_height_range = scale_height_range
        if scale_height_range is not None:
            if mode == "image":
                raise ValueError(f"scale_height_range must be None for mode='image', got {scale_height_range}")
            low, high = _SCALE_HEIGHTS
            self.scale_height_range = check_range("scale_height_range", scale_height_range, low=low, high=high)
        self.wake_density = check_number("wake_density", wake_density, low=0.0, high=1e6)
        self.wake_length = check_number("wake_length", wake_length, low=1e-3, high=1e6)
        self.lamp_luminance = check_number("lamp_luminance", lamp_luminance, low=1.0, high=1e4)
        self.vehicle_labels = check_vehicle_labels(vehicle_labels)
        self.camera_height = check_positive("camera_height", camera_height)
        self.horizon = check_number("horizon", horizon, low=-10.0, high=10.0)
        self.sunlight_range = (
            None if sunlight_range is None else check_range("sunlight_range", sunlight_range, low=0.0, high=1.0)
        )
        self.sun_azimuth_range = check_range("sun_azimuth_range", sun_azimuth_range, low=-360.0, high=360.0)
        self.sun_elevation_range = check_range("sun_elevation_range", sun_elevation_range, low=-10.0, high=90.0)
        self.asymmetry = check_number("asymmetry", asymmetry, low=-0.99, high=0.99)

    def sample_params(self, stream: random.Stream, image: Tensor) -> HeterogeneousFogParams:
        """Draw all parameters uniformly in their ranges, and the key of the noise."""
        motion = motion_ranges(
            self.wind_x_range, self.wind_y_range, self.wind_z_range, decorrelation=self.decorrelation_range
        )
        plume = [] if self.scale_height_range is None else [self.scale_height_range]
        sun = [self.sun_azimuth_range, self.sun_elevation_range, self.sunlight_range] if self.sunlight_range else []
        fog, values = draw_fog(self, stream, image, [self.contrast_range, *motion, *plume, *sun])
        values, sunlight = (values[:, :-3], values[:, -3:]) if sun else (values, torch.zeros_like(values[:, :3]))
        values, scale_height = (
            (values[:, :-1], values[:, -1]) if plume else (values, torch.full_like(values[:, 0], torch.inf))
        )
        weights = as_device_tensor([self.weights] * image.shape[0], dtype=values.dtype, device=values.device)
        weights = weights.view(-1, len(self.scales))
        motion = drawn_motion(values[:, 1:])
        return HeterogeneousFogParams(
            *fog,
            weights,
            values[:, 0],
            **motion,
            key=random.noise_key(stream),
            scale_height=scale_height,
            sun=sunlight,
            vehicles=values.new_zeros(len(values), 0, 4),
        )

    def validate(self, params: HeterogeneousFogParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_fog_params(params, image)
        check_motion(params, axes=3)
        check_shapes(params, {"weights": (len(self.scales),), "contrast": ()})
        check_values("params.weights", "be at least 0 and finite", params.weights, lambda v: v.isfinite() & (v >= 0))
        sums = params.weights.sum(dim=1)
        check_values("params.weights", "have a sum above 0", sums, lambda v: v > 0)
        check_values("params.weights", "have a finite sum", sums, torch.isfinite)
        check_within("params.contrast", params.contrast, *_CONTRASTS)
        if params.scale_height is not None:
            check_shapes(params, {"scale_height": ()})
            low, high = _SCALE_HEIGHTS if self.mode == "ray" else (torch.inf, torch.inf)
            rule = f"lie in [{low:g}, {high:g}] m, or be inf" if self.mode == "ray" else "be inf for mode='image'"
            check_values(
                "params.scale_height",
                rule,
                params.scale_height,
                lambda v: ((v >= low) & (v <= high)) | (v == torch.inf),
            )
        if params.sun is not None:
            check_shapes(params, {"sun": (3,)})
            check_values("params.sun", "be finite", params.sun, torch.isfinite)
            if self.sunlight_range is not None:
                check_within("params.sun[:, 2]", params.sun[:, 2], 0.0, 1.0)
        if params.vehicles is not None:
            shape, frames = tuple(params.vehicles.shape[1:]), params.frame.shape[1]
            if len(shape) not in (2, 3) or shape[-1] != 4 or (len(shape) == 3 and shape[0] != frames):
                raise ValueError(
                    f"params.vehicles must have shape (B, V, 4) or (B, {frames}, V, 4), a box for each of V vehicles, "
                    f"got {tuple(params.vehicles.shape)}"
                )
            check_values("params.vehicles", "be finite", params.vehicles, torch.isfinite)

    def airlight_map(self, params: HeterogeneousFogParams, height: int, width: int) -> Tensor:
        """Return the airlight at each pixel, with which `remove_fog` undoes fog lit by the sun.

        Returns (B, C, height, width), stored values in [0, 1].
        """
        airlight = params.airlight
        if params.sun is None or self.sunlight_range is None:
            return airlight[:, :, None, None].expand(-1, -1, height, width)
        focal, center = pinhole_of(self.medium.camera, height=height, width=width)
        view = {"height": height, "width": width, "focal": focal, "center": center, "horizon": self.horizon}
        return sunlit_airlight(airlight, params.sun.to(airlight.dtype), **view, asymmetry=self.asymmetry)

    def params_in_range(self, params: HeterogeneousFogParams) -> Tensor:
        """Return (), bool: fog and contrast lie in the ranges, the weights are the effect's, there are no vehicles."""
        if params.has_vehicles:
            return torch.zeros((), dtype=torch.bool, device=params.applied.device)
        span = self.medium.extinction_range(self.visibility_range, self.deviation_range)
        weights = in_ranges(normalize_weights(params.weights), [(weight, weight) for weight in self._unit_weights()])
        contrast = in_ranges(params.contrast[:, None], [self.contrast_range])
        return self.medium.params_in_range(params, span) & weights & contrast

    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan frames for the depth of the effect or, with `has_depth`, for any depth."""
        size = (request.height, request.width)
        span = self.medium.extinction_range(self.visibility_range, self.deviation_range)
        model = replace(
            self.medium.error_model(span, *size, has_depth=has_depth),
            mean_over_frame=self.mean == "image",
            periods=self._periods(*size) if self.mode == "image" else (),
            weights=self._unit_weights(),
            contrast=self.contrast_range[1] if self.mode == "ray" else 0.0,
        )
        if self.sunlight_range is not None:
            model = replace(model, colors=(0.0, 1.0))
        if self.mode == "ray":
            return plan_volumetric_fog(model, request)
        if self.normalize == "image":
            # The mean of stretched noises may come near 0, so k has no bound.
            return plan_uniform_fog(replace(model, thickness=model.thickness and math.inf), request)
        return plan_image_fog(model, request)

    def render(self, image: Tensor, params: HeterogeneousFogParams, depth: Tensor | None) -> Rendered:
        """Blend images with fog."""
        plan = self.plan_for(image, params, depth)
        distance = self.medium.distance(image, depth)
        k = mean = self.medium.mean_extinction(params, field_dtype(image.dtype)).view(-1, 1, 1, 1)
        if plan.octaves is None or len(plan.octaves) > 0:
            rows = image.shape[0]
            distance = expand_batch(distance, rows) if distance.shape[0] > 1 else distance
            k = self._extinction(expand_batch(k, rows), params, distance, image, plan)
        scale_height = params.scale_height if self.mode == "ray" else None
        if scale_height is not None and eager_values(lambda: scale_height.isinf().all(), of=k) is not True:
            k = self._plume(scale_height, distance, image) * expand_batch(k, image.shape[0])
        if params.vehicles is not None and params.has_vehicles:
            k, mean = (expand_batch(value, image.shape[0]) for value in (k, mean))
            k = k + self.wake_density * mean * self._wakes(params.vehicles, distance, image)
        airlight = None
        if params.sun is not None and self.sunlight_range is not None:
            lit = params._replace(airlight=finite_or(params.airlight.to(field_dtype(image.dtype)), 0.0))
            airlight = expand_batch(self.airlight_map(lit, *image.shape[2:]), image.shape[0])
        has_lamps = self.lamp_luminance > 1 and not plan.is_identity
        source = self._unclip_lamps(image, params) if has_lamps else image
        rendered = self.medium.blend(source, params, distance, k, is_visible=not plan.is_identity, airlight=airlight)
        if not has_lamps:
            return rendered
        color = params.airlight.to(image.dtype)[:, :, None, None] if airlight is None else airlight
        brightest = torch.maximum(image, expand_batch(finite_or(color, 0.0), len(image)))
        return rendered._replace(image=torch.minimum(rendered.image, brightest))

    def _unclip_lamps(self, image: Tensor, params: HeterogeneousFogParams) -> Tensor:
        """Return images in which lamps are brighter than white, in fog that is dark."""
        is_dark = luma(finite_or(params.airlight, 0.0).to(image.dtype)[:, :, None, None]) < _DARK_AIRLIGHT
        luminance = image.new_full((), self.lamp_luminance)  # torch.where of two numbers is of the default type
        return unclip_lamps(image, torch.where(expand_batch(is_dark, len(image)), luminance, 1.0))

    def _extinction(
        self, k: Tensor, params: HeterogeneousFogParams, distance: Tensor, image: Tensor, plan: PhotometricPlan
    ) -> Tensor:
        """Compute (N, 1, H, W): k q / <q>, 1/m, of the mean extinction k, (N, 1, 1, 1)."""
        rows, _, height, width = image.shape
        size = {"height": height, "width": width}
        key, weights, contrast = (expand_batch(v, rows) for v in (params.key, params.weights, params.contrast))
        weights, motion = normalize_weights(weights.to(k.dtype)), motion_of(params)
        if self.mode == "image":
            motion = motion._replace(wind=motion.wind[:, :2] * (width / self.reference_width))
            octaves = range(len(self.scales)) if plan.octaves is None else plan.octaves
            periods, stretch = self._periods(height, width), self.normalize == "image"
            q = image_noise(key, weights, octaves=octaves, periods=periods, motion=motion, stretch=stretch, **size)
        else:
            focal, center = pinhole_of(self.medium.camera, height=height, width=width)
            field = ExtinctionField(key, weights, contrast.to(k.dtype), motion)
            view = {"focal": focal, "center": center, "scales": self.scales, "reach": self.reach}
            q = mean_extinction_along_rays(field, distance, **size, **view)
        of_all_fogs = 0.5 if self.mode == "image" else 1.0
        return q * (k / (q.mean(dim=(2, 3), keepdim=True) if self.mean == "image" else of_all_fogs))

    def _plume(self, scale_height: Tensor, distance: Tensor, image: Tensor) -> Tensor:
        """Compute (N, 1, H, 1 or W): the mean density along each ray."""
        height, width = image.shape[2:]
        (_, focal), (_, center) = pinhole_of(self.medium.camera, height=height, width=width)
        options = {"dtype": distance.dtype, "device": image.device}
        descent = descent_of_rows(self.horizon, height=height, focal=focal, center=center, **options)
        descent = descent / self._ray_length(distance, image)
        scale = finite_or(scale_height.to(distance.dtype), _EVEN).clamp(min=_SCALE_HEIGHTS[0] / 2).view(-1, 1, 1, 1)
        return mean_density(distance, descent, expand_batch(scale, len(image)), camera_height=self.camera_height)

    def _wakes(self, vehicles: Tensor, distance: Tensor, image: Tensor) -> Tensor:
        """Compute (N, 1, H, W): the mean density of the dust behind vehicles along each ray."""
        (rows, _, height, width), dtype = image.shape, distance.dtype
        boxes = bounded(vehicles.to(dtype), -_FARTHEST_PX, _FARTHEST_PX)
        boxes = boxes.flatten(0, 1) if boxes.ndim == 4 else expand_batch(boxes, rows)
        depth = expand_batch(distance / self._ray_length(distance, image), rows)
        (_, focal), (_, center) = pinhole_of(self.medium.camera, height=height, width=width)
        view = {"width": width, "horizon": self.horizon, "focal": focal, "center": center}
        return mean_wake_density(depth, boxes, **view, camera_height=self.camera_height, length=self.wake_length)

    def _ray_length(self, distance: Tensor, image: Tensor) -> Tensor:
        """Return m along the ray of each pixel per m of depth, (1, 1, H, 1 or W)."""
        return self.medium.distance(image, distance.new_ones(1, 1, image.shape[2], 1))

    def _unit_weights(self) -> tuple[float, ...]:
        return tuple(weight / sum(self.weights) for weight in self.weights)

    def _periods(self, height: int, width: int) -> tuple[float, ...]:
        return periods_in_frame(
            self.scales, unit=self.scale_unit, reference_width=self.reference_width, height=height, width=width
        )


def _check_scales(
    scales: Sequence[float] | None, weights: Sequence[float] | None, *, mode: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return valid scales and as many weights; None are the defaults of the mode."""
    defaults = (_PAPER_SCALES, _PAPER_WEIGHTS) if mode == "image" else (_ROAD_SCALES, _ROAD_WEIGHTS)
    if scales is None:
        scales, weights = defaults[0], defaults[1] if weights is None else weights
    scales = tuple(check_positive("scales", scale) for scale in scales)
    if not scales:
        raise ValueError("scales must be at least one number above 0, got none")
    if weights is None or len(weights) != len(scales):
        raise ValueError(f"weights must be one number for each of {len(scales)} scales, got {weights}; pass both")
    weights = tuple(check_number("weights", weight, low=0.0) for weight in weights)
    if sum(weights) <= 0:
        raise ValueError(f"weights must have a sum above 0, got {weights}")
    return scales, weights
