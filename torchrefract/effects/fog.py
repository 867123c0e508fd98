"""Fog of one density."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import draws
from torchrefract._checks import check_all, check_flag, check_number, check_range
from torchrefract.effects.base import params_to
from torchrefract.effects.color import check_color, each_channel
from torchrefract.effects.radiance import RadianceEffect, Shaded
from torchrefract.effects.rows import alike, column, spread
from torchrefract.fields.fog import extinction, linear_depth, linear_to_srgb, srgb_to_linear, transmission, veil
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_PAPER_AIRLIGHT = (220 / 255, 220 / 255, 235 / 255)
_REC_709 = (0.2126, 0.7152, 0.0722)


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

    `transmission` is t; `valid` are the pixels that 8 bits can still recover, t >= 1/255.

    Args:
        visibility_range: V in m, above 0, inf for clear air.
        deviation_range: relative deviation of the extinction, within (-1, 1).
        airlight: color of the fog in [0, 1], one number for each channel or one for all; None is the paper's
            (220, 220, 235) / 255 for three channels and its luminance for any other number.
        threshold: contrast left at the distance V, in (0, 1); 0.05 is the meteorological optical range.
        max_depth: m, depth of the top row where no depth is given: d(y) = (1 - (y + 1/2) / H) max_depth.
        linear_light: blend radiance, not stored values (sRGB).
        p: chance that a sample is degraded at all.

    Raises:
        ValueError: an argument outside its range; an airlight that does not fit the channels; a depth that is
            negative or NaN (on the CPU).

    Source: Koschmieder, "Theorie der horizontalen Sichtweite", 1924; colors and depth from the torchrefract paper.
    """

    def __init__(
        self,
        *,
        visibility_range: Range = (100.0, 100.0),
        deviation_range: Range = (-0.05, 0.05),
        airlight: float | Sequence[float] | None = None,
        threshold: float = 0.05,
        max_depth: float = 160.0,
        linear_light: bool = False,
        p: float = 1.0,
    ):
        super().__init__(p=p)
        self.visibility_range = check_range("visibility_range", visibility_range, low=1e-6, high=torch.inf)
        self.deviation_range = check_range("deviation_range", deviation_range, low=-0.999, high=0.999)
        self.airlight = None if airlight is None else check_color("airlight", airlight, high=1.0)
        self.threshold = check_number("threshold", threshold, low=1e-6, high=1 - 1e-6)
        self.max_depth = check_number("max_depth", max_depth, low=0.0)
        self.linear_light = check_flag("linear_light", linear_light)

    params_type = FogParams

    def draw(self, source: draws.Stream, image: Tensor) -> FogParams:
        """One fog a sample; V and the deviation are uniform in their ranges."""
        low, high = self.visibility_range
        # An infinite end has no uniform draw: 1/V is drawn there, as it has one.
        inverse = high == torch.inf
        span = (1 / high, 1 / low) if inverse else (low, high)
        gate, values = self._uniform(source, [span, self.deviation_range], image)
        visibility = 1 / values[:, 0] if inverse else values[:, 0]
        batch, channels = image.shape[:2]
        airlight = torch.tensor([self._airlight(channels)] * batch, dtype=values.dtype, device=values.device)
        return FogParams(gate, visibility, values[:, 1], airlight.view(batch, channels))

    def check(self, params: FogParams, image: Tensor) -> None:
        """Raise for fogs that are none."""
        if params.airlight.shape != (image.shape[0], image.shape[1]):
            expected = (image.shape[0], image.shape[1])
            raise ValueError(f"params.airlight must have shape {expected}, got {tuple(params.airlight.shape)}")
        for name in ("visibility", "deviation"):
            if getattr(params, name).ndim != 1:
                raise ValueError(f"params.{name} must have shape (B,), got {tuple(getattr(params, name).shape)}")
        check_all("params.visibility", "be above 0", params.visibility, lambda v: v > 0)
        check_all("params.deviation", "be above -1", params.deviation, lambda v: (v > -1) & v.isfinite())
        check_all("params.airlight", "be finite", params.airlight, torch.isfinite)

    def acts(self, params: FogParams) -> Tensor:
        """The samples with an air that is not clear."""
        return params.visibility != torch.inf

    def shade(self, image: Tensor, params: FogParams, depth: Tensor | None) -> Shaded:
        """The batch behind the fog."""
        dtype = field_dtype(image.dtype)
        if depth is None:
            depth = linear_depth(image.shape[2], self.max_depth, dtype=dtype, device=image.device)
        else:
            check_all("depth", "be at least 0, in m", depth, lambda v: v >= 0)
            depth = depth.to(dtype).nan_to_num(nan=0.0, posinf=torch.inf).clamp(min=0)
        k = extinction(params.visibility.to(dtype), self.threshold) * (1 + params.deviation.to(dtype))
        k, depth = (column(k), depth) if depth.shape[0] == 1 else alike(column(k), depth)
        t = transmission(depth, k)
        airlight = params.airlight.to(dtype)[:, :, None, None]
        rows = [spread(value, image.shape[0]) for value in (t, airlight)]
        return Shaded(self._blend(image, *rows), valid=lambda: t >= 1 / 255, transmission=t, extinction=k)

    def _blend(self, image: Tensor, t: Tensor, airlight: Tensor) -> Tensor:
        if not self.linear_light:
            return veil(image, t, airlight)
        blended = linear_to_srgb(veil(srgb_to_linear(image), t, srgb_to_linear(airlight)))
        return torch.where(t == 1, image, blended)

    def _airlight(self, channels: int) -> Sequence[float]:
        if self.airlight is None:
            gray = sum(weight * value for weight, value in zip(_REC_709, _PAPER_AIRLIGHT, strict=True))
            return _PAPER_AIRLIGHT if channels == 3 else [gray] * channels
        return each_channel("airlight", self.airlight, channels)
