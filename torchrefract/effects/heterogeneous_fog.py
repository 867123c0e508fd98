"""Fog in drifts and holes."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_choice, check_number, check_positive, check_range, check_within, finite_or
from torchrefract.cameras.models import Camera
from torchrefract.effects.air import check_fog_params, distances, make_air
from torchrefract.effects.base import params_to
from torchrefract.effects.depth import DepthProvider
from torchrefract.effects.drift_plan import DriftPlan, Drifts, drift_plan
from torchrefract.effects.fog import (
    behind_fog,
    check_visibility,
    drawn_visibility,
    extinctions,
    fogs_lie_in,
    fogs_of,
    mean_extinction,
    visibility_span,
)
from torchrefract.effects.fog_plan import fog_plan
from torchrefract.effects.motion import check_decorrelation, check_motion, check_wind, drawn_motion, motion_ranges, tame
from torchrefract.effects.photometric_effect import Shaded
from torchrefract.effects.plan import in_ranges
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.effects.random_field import check_key
from torchrefract.effects.rows import column, expand_batch, frame_mean
from torchrefract.effects.scales import check_scales, check_weights, chosen, periods, shares, stretched
from torchrefract.effects.space_plan import space_plan
from torchrefract.fields.fog import drifting_transmission_
from torchrefract.fields.fog_volume import path_mean
from torchrefract.fields.perlin_drawn import Coarse, Drawn, drawn_noise
from torchrefract.fields.veils import Drifting
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.lattice import Lattice

_FLATTEST, _STARKEST = 0.0, 2.0  # of the contrast


class HeterogeneousFogParams(NamedTuple):
    """The fogs of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    visibility: Tensor  # (B,), m, above 0, of the mean extinction; inf is clear air
    deviation: Tensor  # (B,), relative deviation of the mean extinction, above -1
    airlight: Tensor  # (B, C), in [0, 1], as stored in the image
    weights: Tensor  # (B, K), of the scales, at least 0 and not all 0
    contrast: Tensor  # (B,), standard deviation of the logarithm of the extinction in space, 0 or above
    wind: Tensor  # (B, 3), per frame, to the right, down and ahead: m in space; px of the reference in the image
    decorrelation: Tensor  # (B,), frames, above 0; inf for fog that only drifts
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the noise

    to = params_to


class HeterogeneousFog(PlannedLight):
    """Fog whose density changes from place to place.

        I = I_clean t + A (1 - t),  t = exp(-k d),  k = k0 (1 + deviation) q / <q>,  k0 = -ln(threshold) / V

    In the mode "image", the paper's, q is the sum of the weights times Perlin noise at each scale, in the plane of the
    image: q = sum w_i (n_i / sqrt(1/2) + 1) / 2 / sum w_i. In the mode "ray" q is the mean along the ray of each pixel
    up to its depth, through a field in space, exp(contrast g), g a sum of noises of unit variance: fog has depth, near
    drifts pass faster than far ones. <q> is the mean over the frame, so that V is that of the mean extinction, as in
    `UniformFog`. `transmission` is t, `extinction` is k, `valid` where t >= 1/255.

    Args:
        mode: "image" or "ray".
        scales: of the noise, above 0; None is the paper's 4, 8, 16, 32, 64, 128 in the image, 12, 24, 48, 96 in space.
        weights: one for each scale, 0 or above, not all 0; None are those that go with the scales of None.
        scale_unit: of the scales in the image, "px" (periods, px of a frame `reference_width` wide) or "cells"
            (periods across the frame); in space they are in m.
        reference_width: px, see `scale_unit` and the wind.
        normalize: of each noise in the image: "theory" maps its bounds +-sqrt(1/2) to [0, 1], "image" its smallest and
            largest value in the frame, as the paper has it, without a gradient of these.
        mean: <q> is that over the "image", or over all of the "ensemble": 1/2 in the image; 1 in space, where it is
            1 % less at a contrast of 1, 11 % at 2.
        contrast_range: standard deviation of ln q at a point in space, in [0, 2]; 0 is a uniform fog.
        reach: m, from which on fog in space is uniform.
        wind_x_range, wind_y_range, wind_z_range: of the drift per frame of a clip, to the right, down and ahead, as
            seen from the camera: m in space, where a car that goes v m per frame sees -v ahead; px of the reference in
            the image, which has no z.
        decorrelation_range: frames, above 0 or inf, until k in the wind is correlated by 1/e; one over it is uniform.
        tolerance: how far the image may be from the exact one, levels of 1/255, so that pixels behind so much fog that
            nothing is seen of them are filled with the airlight, those behind too little of it left as they are,
            octaves in the image left out or known on a coarse lattice only, and fog whose drifts nobody sees is
            uniform; see `plan`; None is exact. Octaves are all computed where normalize="image" or <q> may come near 0.
        visibility_range, deviation_range, airlight, threshold, depth, camera, linear_light, p: as for `UniformFog`; the
            rays of space are those of the camera, or of a pinhole of 0.9 widths.

    Raises:
        ValueError: an argument outside its range; as for `UniformFog`.

    Source: the torchrefract paper; Zdrojewska, "Real time rendering of heterogenous fog based on the graphics hardware
    acceleration", CESCG 2004; in space, Wronski, "Volumetric fog", SIGGRAPH 2014, for the volume before the camera.
    """

    def __init__(
        self,
        *,
        mode: str = "image",
        visibility_range: Range = (100.0, 100.0),
        deviation_range: Range = (-0.05, 0.05),
        airlight: float | Sequence[float] | None = None,
        threshold: float = 0.05,
        depth: DepthProvider | None = None,
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
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.mode = check_choice("mode", mode, ("image", "ray"))
        self.visibility_range = check_visibility(visibility_range)
        self.deviation_range = check_range("deviation_range", deviation_range, low=-0.999, high=0.999)
        self.air = make_air(
            airlight=airlight, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light
        )
        self.scales, self.weights = check_scales(scales, weights, mode=mode)
        self.scale_unit = check_choice("scale_unit", scale_unit, ("px", "cells"))
        self.reference_width = check_positive("reference_width", reference_width)
        self.normalize = check_choice("normalize", normalize, ("theory", "image"))
        self.mean = check_choice("mean", mean, ("image", "ensemble"))
        self.contrast_range = check_range("contrast_range", contrast_range, low=_FLATTEST, high=_STARKEST)
        self.reach = check_number("reach", reach, low=1.0, high=1e5)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.wind_z_range = check_wind("wind_z_range", wind_z_range)
        if mode == "image" and self.wind_z_range != (0.0, 0.0):
            raise ValueError(f"wind_z_range must be (0, 0) in the image, which has no depth, got {self.wind_z_range}")
        self.decorrelation_range = check_decorrelation(decorrelation_range)

    params_type = HeterogeneousFogParams
    maps = ("transmission", "extinction")

    def at_rest(self) -> bool:
        """Whether all air is clear."""
        return self.visibility_range[0] == math.inf

    def draw(self, source: random.Stream, image: Tensor) -> HeterogeneousFogParams:
        """One fog a sample, every number uniform in its range."""
        winds = (self.wind_x_range, self.wind_y_range, self.wind_z_range)
        ranges = [visibility_span(self.visibility_range), self.deviation_range, self.contrast_range]
        ranges += motion_ranges(*winds, decorrelation=self.decorrelation_range)
        applied, values = self._uniform(source, ranges, image)
        return HeterogeneousFogParams(
            applied,
            drawn_visibility(values[:, 0], self.visibility_range),
            values[:, 1],
            self.air.light(image, values.dtype),
            as_device_tensor([self.weights] * image.shape[0], dtype=values.dtype, device=values.device).view(
                -1, len(self.scales)
            ),
            values[:, 2],
            **drawn_motion(values[:, 3:]),
            key=random.noise_key(source),
        )

    def check(self, params: HeterogeneousFogParams, image: Tensor) -> None:
        """Raise for fogs that are none."""
        check_fog_params(params, image)
        check_key(params)
        check_motion(params, axes=3)
        check_weights(params.weights, len(self.scales))
        if params.contrast.ndim != 1:
            raise ValueError(f"params.contrast must have shape (B,), got {tuple(params.contrast.shape)}")
        check_within("params.contrast", params.contrast, _FLATTEST, _STARKEST)

    def acts(self, params: HeterogeneousFogParams) -> Tensor:
        """The samples whose air is not clear."""
        return params.visibility != torch.inf

    def params_in_range(self, params: HeterogeneousFogParams) -> Tensor:
        """(), bool: all fogs lie in the ranges, and the weights are those of the effect."""
        limits = [(share, share) for share in self._shares()]
        own = in_ranges(shares(params.weights), limits) & in_ranges(params.contrast[:, None], [self.contrast_range])
        return fogs_lie_in(params, extinctions(self), self.air) & own

    def planned(self, height: int, width: int, dtype: torch.dtype, *, any_depth: bool = False) -> DriftPlan:
        """The plan for images of a type, from the ranges alone; for the depth of the effect, or for any."""
        known = self.tolerance is not None and not any_depth
        farthest = max(distances(self.air, height, width)[1]) if known else math.inf
        thickness = extinctions(self)[1] * min(farthest, 1e12)
        lengths = self._periods(height, width) if self.mode == "image" else self.scales
        drifts = Drifts(thickness, lengths, self._shares(), self.mean == "image", self.air.blend)
        size, double = (height, width, self.tolerance), dtype is torch.float64
        if self.mode == "ray" or self.normalize == "image":
            plan = space_plan(drifts, self.contrast_range[1] if self.mode == "ray" else None, *size, double)
        else:
            plan = drift_plan(drifts, *size, double)
        if not plan.is_uniform:
            return plan
        return plan.of_uniform(fog_plan(fogs_of(self, height, width, any_depth=any_depth), *size, double, plan.error))

    def shade(self, image: Tensor, params: HeterogeneousFogParams, depth: Tensor | None) -> Shaded:
        """The rows behind the fog."""
        plan: DriftPlan = self.plan_for(params, image, depth)
        if plan.is_uniform:
            return behind_fog(self.air, image, params, depth, plan)
        rows, dtype = image.shape[0], field_dtype(image.dtype)
        distance = self.air.distance(image, depth)
        mean_k = column(expand_batch(mean_extinction(params, self.air, dtype), rows))
        distance = expand_batch(distance, rows) if distance.shape[0] > 1 else distance

        def drifting() -> Drifting:
            noise, share, offset = self._field(params, distance, image, plan)
            return Drifting(noise, share * mean_k, offset * mean_k, distance)

        def k() -> Tensor:
            # Made again for who asks: kept, it would be a third of the image for who does not.
            noise, scale, offset, _ = drifting()
            return noise * scale + offset

        def through() -> Tensor:
            return drifting_transmission_(*drifting())

        if not plan.acts:
            return Shaded(image, valid=lambda: through() >= 1 / 255, transmission=through, extinction=k)
        airlight = finite_or(params.airlight.to(dtype), 0.0)
        blended, t = self.air.behind_drifts(image, drifting(), airlight, plan.ends)
        return Shaded(blended, valid=lambda: t >= 1 / 255, transmission=t, extinction=k)

    def _field(
        self, params: HeterogeneousFogParams, distance: Tensor, image: Tensor, plan: DriftPlan
    ) -> tuple[Tensor, Tensor, Tensor]:
        """A noise n, (N, 1, H, W), a row for each of the image, and a and b, (N, 1, 1, 1), of q / <q> = a n + b."""
        rows, _, height, width = image.shape
        dtype = field_dtype(image.dtype)
        names = ("key", "weights", "contrast", "wind", "decorrelation")
        key, weights, contrast, wind, decorrelation = (expand_batch(getattr(params, name), rows) for name in names)
        share = shares(weights.to(dtype))
        frame, wind, decorrelation = tame(params.frame.reshape(-1), wind, decorrelation)
        if self.mode == "image":
            in_image = Drawn(key, frame, wind[:, :2] * (width / self.reference_width), decorrelation)
            return self._in_image(in_image, share, plan)
        focal, center = self.air.pinhole(height, width)
        view: Any = {"height": height, "width": width, "focal": focal, "center": center, "reach": self.reach}
        fog: Any = {"scales": self.scales, "weights": share, "contrast": contrast.to(dtype)}
        motion: Any = {"frame": frame, "wind": wind, "decorrelation": decorrelation}
        q = path_mean(key, distance, **view, **fog, **motion, dtype=dtype)
        return q, self._inverse_mean(q, 1.0), q.new_zeros(1, 1, 1, 1)

    def _in_image(self, drawn: Drawn, share: Tensor, plan: DriftPlan) -> tuple[Tensor, Tensor, Tensor]:
        """The paper's noise, for weights (N, K) of sum 1."""
        size: Any = {"height": plan.height, "width": plan.width}
        octaves = tuple(enumerate(self._periods(**size)))
        if self.normalize == "image":
            one = share.new_ones(share.shape[0], 1)
            noises = (stretched(drawn_noise(drawn, [each], one, **size)) for each in octaves)
            parts = [column(w) * noise for noise, w in zip(noises, share.unbind(1), strict=True)]
            q = sum(parts[1:], parts[0])
            return q, self._inverse_mean(q, 0.5), q.new_zeros(1, 1, 1, 1)
        coarse = None
        if plan.coarse:
            lattice = Lattice(plan.height, plan.width, plan.stride)
            coarse = Coarse([octaves[i] for i in plan.coarse], chosen(share, plan.coarse), lattice)
        # q = 1/2 + n / sqrt(2), with the noise n.
        fine = [octaves[i] for i in plan.fine]
        noise = drawn_noise(drawn, fine, chosen(share, plan.fine), **size, coarse=coarse)
        mean = 0.5 + frame_mean(noise) / math.sqrt(2) if self.mean == "image" else noise.new_full((1, 1, 1, 1), 0.5)
        return noise, math.sqrt(0.5) / mean, 0.5 / mean

    def _shares(self) -> tuple[float, ...]:
        return tuple(weight / sum(self.weights) for weight in self.weights)

    def _inverse_mean(self, q: Tensor, ensemble: float) -> Tensor:
        return 1 / frame_mean(q) if self.mean == "image" else q.new_full((1, 1, 1, 1), 1 / ensemble)

    def _periods(self, height: int, width: int) -> tuple[float, ...]:
        """Of the noises, px."""
        size = {"height": height, "width": width}
        return periods(self.scales, unit=self.scale_unit, reference_width=self.reference_width, **size)
