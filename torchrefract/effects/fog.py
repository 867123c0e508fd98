"""Fog of one density."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import exact_matmul
from torchrefract._validation import check_range, finite_or
from torchrefract.cameras.models import Camera
from torchrefract.effects.air import Air, check_fog_params, distances, make_air, squares
from torchrefract.effects.base import params_to
from torchrefract.effects.depth import DepthProvider
from torchrefract.effects.fog_plan import FogPlan, Fogs, fog_plan
from torchrefract.effects.photometric_effect import Shaded
from torchrefract.effects.plan import in_ranges
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.effects.rows import column, expand_alike
from torchrefract.fields.fog import extinction, transmission
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_ROUNDING = 2e-5
_ENDLESS = 1e30  # m, of a visibility that float32 hardly holds
_OPAQUE = 1e20  # 1/m: through so much of it nothing comes, and its products with depths are finite


class FogParams(NamedTuple):
    """The fogs of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    visibility: Tensor  # (B,), m, above 0; inf is clear air
    deviation: Tensor  # (B,), relative deviation of the extinction, above -1
    airlight: Tensor  # (B, C), in [0, 1], as stored in the image

    to = params_to


class UniformFog(PlannedLight):
    """Fog of one density, after Koschmieder.

        I = I_clean t + A (1 - t),  t = exp(-k d),  k = -ln(threshold) / V (1 + deviation)

    `transmission` is t and `extinction` k; `valid` are the pixels that 8 bits can still recover, t >= 1/255, by
    `remove_fog`.

    Args:
        visibility_range: V in m, above 0, inf for clear air.
        deviation_range: relative deviation of the extinction, within (-1, 1).
        airlight: color of the fog in [0, 1], one number for each channel or one for all; None is the paper's
            (220, 220, 235) / 255 for three channels and its luminance for any other number.
        threshold: contrast left at the distance V, in (0, 1); 0.05 is the meteorological optical range.
        depth: what gives d where no depth is passed in; None is `LinearDepth()`, the paper's ramp over the rows.
        camera: of the frames; with it depth is taken along its axis and turned into the distance along each ray.
        linear_light: blend radiance, not stored values (sRGB).
        tolerance: how far the image may be from the exact one, levels of 1/255, so that pixels behind so much fog that
            nothing is seen of them are filled with the airlight, those behind too little of it left as they are, and t
            is a polynomial along the rows of a camera; see `plan`; None is exact. Maps stay exact.
        p: chance that a sample is degraded at all.

    Raises:
        ValueError: an argument outside its range; an airlight that does not fit the channels; a depth that is
            negative, NaN, or clearly not in m, see `check_depth` (on the CPU).

    Source: Koschmieder, "Theorie der horizontalen Sichtweite", 1924; colors and depth from the torchrefract paper.
    """

    def __init__(
        self,
        *,
        visibility_range: Range = (100.0, 100.0),
        deviation_range: Range = (-0.05, 0.05),
        airlight: float | Sequence[float] | None = None,
        threshold: float = 0.05,
        depth: DepthProvider | None = None,
        camera: Camera | None = None,
        linear_light: bool = False,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.visibility_range = check_visibility(visibility_range)
        self.deviation_range = check_range("deviation_range", deviation_range, low=-0.999, high=0.999)
        self.air = make_air(
            airlight=airlight, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light
        )

    params_type = FogParams
    maps = ("transmission", "extinction")

    def at_rest(self) -> bool:
        """Whether all air is clear."""
        return self.visibility_range[0] == math.inf

    def draw(self, source: random.Stream, image: Tensor) -> FogParams:
        """One fog a sample; V and the deviation are uniform in their ranges."""
        applied, values = self._uniform(source, [visibility_span(self.visibility_range), self.deviation_range], image)
        visibility = drawn_visibility(values[:, 0], self.visibility_range)
        return FogParams(applied, visibility, values[:, 1], self.air.light(image, values.dtype))

    def check(self, params: FogParams, image: Tensor) -> None:
        """Raise for fogs that are none."""
        check_fog_params(params, image)

    def acts(self, params: FogParams) -> Tensor:
        """The samples whose air is not clear."""
        return params.visibility != torch.inf

    def params_in_range(self, params: FogParams) -> Tensor:
        """(), bool: all fogs lie in the ranges."""
        return fogs_lie_in(params, extinctions(self), self.air)

    def planned(self, height: int, width: int, dtype: torch.dtype, *, any_depth: bool = False) -> FogPlan:
        """The plan for images of a type, from the ranges alone; for the depth of the effect, or for any."""
        fogs = fogs_of(self, height, width, any_depth=any_depth)
        return fog_plan(fogs, height, width, self.tolerance, dtype is torch.float64)

    def shade(self, image: Tensor, params: FogParams, depth: Tensor | None) -> Shaded:
        """The rows behind the fog."""
        return behind_fog(self.air, image, params, depth, self.plan_for(params, image, depth))


def behind_fog(air: Air, image: Tensor, params: Any, depth: Tensor | None, plan: FogPlan) -> Shaded:
    """Rows behind fog of one density, with a `visibility`, a `deviation` and an `airlight`, as planned."""
    dtype = field_dtype(image.dtype)
    k = column(mean_extinction(params, air, dtype))

    def through(distance: Tensor) -> Tensor:
        return transmission(distance, k) if distance.shape[0] == 1 else transmission(*expand_alike(distance, k))

    def exact() -> Tensor:
        return through(air.distance(image, depth))

    if not plan.acts:
        return Shaded(image, valid=lambda: exact() >= 1 / 255, transmission=exact, extinction=k)
    airlight = finite_or(params.airlight.to(dtype), 0.0)
    if plan.nodes is None:
        t = exact()
        blended = air.blended(image, t, airlight, plan.ends)
        return Shaded(blended, valid=lambda: t >= 1 / 255, transmission=t, extinction=k)
    places, weights = along_columns(air, image, plan.nodes)
    t = exact_matmul(through(air.distance_at(places, image)), weights)
    blended = air.blended(image, t, airlight, plan.ends)
    return Shaded(blended, valid=lambda: exact() >= 1 / 255, transmission=exact, extinction=k)


def fogs_of(fog: Any, height: int, width: int, *, any_depth: bool) -> Fogs:
    """Those of an effect with a `visibility_range`, a `deviation_range` and an `air`, before its own depth or any."""
    if fog.tolerance is None or any_depth:
        return Fogs(extinctions(fog), (0.0,) * height, (math.inf,) * height, None, fog.air.blend)
    near, far = distances(fog.air, height, width)
    return Fogs(extinctions(fog), near, far, squares(fog.air, height, width), fog.air.blend)


def extinctions(fog: Any) -> Range:
    """1/m, of the fogs in the ranges of an effect, with room for rounding."""
    (near, far), (thin, dense) = fog.visibility_range, fog.deviation_range
    scale = -math.log(fog.air.threshold)
    return scale / far * (1 + thin) * (1 - _ROUNDING), scale / near * (1 + dense) * (1 + _ROUNDING)


def mean_extinction(params: Any, air: Air, dtype: torch.dtype) -> Tensor:
    """(B,), 1/m, of fogs with a `visibility` and a `deviation`; what is no number is a wall."""
    k = extinction(params.visibility.to(dtype), air.threshold) * (1 + params.deviation.to(dtype))
    return k.nan_to_num(nan=_OPAQUE).clamp(0, _OPAQUE)


def fogs_lie_in(params: Any, span: Range, air: Air) -> Tensor:
    """(), bool: fogs have an extinction in a range, and the light of this air."""
    k = mean_extinction(params, air, params.visibility.dtype)
    return in_ranges(k[:, None], [span]) & air.params_in_range(params.airlight)


def along_columns(air: Air, image: Tensor, count: int) -> tuple[list[float], Tensor]:
    """Where t is computed in each row, as squares of tangents, and the weights of these, (count, W).

    At the zeros of a Chebyshev polynomial, and with the weights of Lagrange's.
    """
    height, width = image.shape[2:]
    camera = cast(Camera, air.camera).resized(width=width, height=height)
    options: Any = {"dtype": torch.float64, "device": image.device}
    # Computed from numbers alone, for compilers, too.
    low, high = (
        f(abs(x - camera.cx) / camera.fx for x in (0, width - 1, min(max(round(camera.cx), 0), width - 1))) ** 2
        for f in (min, max)
    )
    zeros = [math.cos(math.pi * (2 * j + 1) / (2 * count)) for j in range(count)]
    at = ((torch.arange(width, **options) - camera.cx) / camera.fx).square()
    u = (2 * at - low - high) / max(high - low, 1e-12)
    weights = []
    for j in range(count):
        others = [(u - zero) / (zeros[j] - zero) for i, zero in enumerate(zeros) if i != j]
        weights.append(math.prod(others, start=torch.ones_like(u)))
    places = [(low + high) / 2 + zero * (high - low) / 2 for zero in zeros]
    return places, torch.stack(weights).to(field_dtype(image.dtype))


def check_visibility(value: Range) -> Range:
    """The range of a visibility in m."""
    return check_range("visibility_range", value, low=1e-6, high=torch.inf)


def visibility_span(limits: Range) -> Range:
    """What a uniform number is drawn from for `drawn_visibility`."""
    # An infinite end has no uniform draw: 1/V is drawn there, as it has one.
    return (1 / limits[1], 1 / limits[0]) if limits[1] > _ENDLESS else limits


def drawn_visibility(value: Tensor, limits: Range) -> Tensor:
    """(B,), m, from a number of `visibility_span`."""
    return 1 / value if limits[1] > _ENDLESS else value
