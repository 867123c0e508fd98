"""Fog of one density."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import draws
from torchrefract._checks import check_range
from torchrefract.cameras.models import Camera
from torchrefract.effects.air import check_fog_params, make_air
from torchrefract.effects.base import params_to
from torchrefract.effects.depth import DepthProvider
from torchrefract.effects.radiance import RadianceEffect, Shaded
from torchrefract.effects.rows import alike, column
from torchrefract.fields.fog import extinction, transmission
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype


class FogParams(NamedTuple):
    """The fogs of a batch."""

    gate: Tensor  # (B,), bool: the sample is degraded
    visibility: Tensor  # (B,), m, above 0; inf is clear air
    deviation: Tensor  # (B,), relative deviation of the extinction, above -1
    airlight: Tensor  # (B, C), in [0, 1], as stored in the image

    to = params_to


class UniformFog(RadianceEffect):
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
        p: float = 1.0,
    ):
        super().__init__(p=p)
        self.visibility_range = check_visibility(visibility_range)
        self.deviation_range = check_range("deviation_range", deviation_range, low=-0.999, high=0.999)
        self.air = make_air(
            airlight=airlight, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light
        )

    params_type = FogParams

    def draw(self, source: draws.Stream, image: Tensor) -> FogParams:
        """One fog a sample; V and the deviation are uniform in their ranges."""
        gate, values = self._uniform(source, [visibility_span(self.visibility_range), self.deviation_range], image)
        visibility = drawn_visibility(values[:, 0], self.visibility_range)
        return FogParams(gate, visibility, values[:, 1], self.air.light(image, values.dtype))

    def check(self, params: FogParams, image: Tensor) -> None:
        """Raise for fogs that are none."""
        check_fog_params(params, image)

    def acts(self, params: FogParams) -> Tensor:
        """The samples whose air is not clear."""
        return params.visibility != torch.inf

    def shade(self, image: Tensor, params: FogParams, depth: Tensor | None) -> Shaded:
        """The rows behind the fog."""
        dtype = field_dtype(image.dtype)
        distance = self.air.distance(image, depth)
        k = column(extinction(params.visibility.to(dtype), self.air.threshold) * (1 + params.deviation.to(dtype)))
        k, distance = (k, distance) if distance.shape[0] == 1 else alike(k, distance)
        t = transmission(distance, k)
        blended = self.air.blended(image, t, params.airlight.to(dtype))
        return Shaded(blended, valid=lambda: t >= 1 / 255, transmission=t, extinction=k)


def check_visibility(value: Range) -> Range:
    """The range of a visibility in m."""
    return check_range("visibility_range", value, low=1e-6, high=torch.inf)


def visibility_span(limits: Range) -> Range:
    """What a uniform number is drawn from for `drawn_visibility`."""
    # An infinite end has no uniform draw: 1/V is drawn there, as it has one.
    return (1 / limits[1], 1 / limits[0]) if limits[1] == torch.inf else limits


def drawn_visibility(value: Tensor, limits: Range) -> Tensor:
    """(B,), m, from a number of `visibility_span`."""
    return 1 / value if limits[1] == torch.inf else value
