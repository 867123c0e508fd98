"""The sun in the lens."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import (
    check_choice,
    check_color,
    check_flag,
    check_range,
    check_values,
    color_per_channel,
    finite_or,
)
from torchrefract.effects.base import params_to
from torchrefract.effects.flare_plan import FlarePlan, Suns, flare_plan, reach
from torchrefract.effects.motion import check_frame
from torchrefract.effects.photometric_effect import Shaded
from torchrefract.effects.plan import in_ranges
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.effects.rows import column, expand_batch
from torchrefract.fields.flare import flare_axes
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_FARTHEST = 1e4  # widths and heights
_ROUNDING = 2e-5
# Of the frame: with more to compute, reading and writing it once more costs more than it saves.
_CLIPPED, _SCREENED = 1 / 3, 0.6


class FlareParams(NamedTuple):
    """The suns of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    center: Tensor  # (B, 2), in widths and heights of the frame, from its upper left corner
    radius: Tensor  # (B,), rho, in diagonals of the frame, 0 or above
    strength: Tensor  # (B,), beta, light added at the center, 0 or above
    color: Tensor  # (B, C), of the sun, relative, 0 or above
    drift: Tensor  # (B, 2), widths and heights per frame, of the center over a clip
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to


class LensFlare(PlannedLight):
    """The sun shining into the lens: a Gaussian veil of light.

        I = clip(I_clean + beta color m, 0, 1),  m = exp(-(d / r)^2 / 2),  r = radius sqrt(W^2 + H^2),  beta = strength

    d is the distance to the center in px. `intensity` is beta m; `valid` are the pixels that do not saturate, where the
    clean image is I - beta color m. With `blend="screen"` it is I = 1 - (1 - I_clean) (1 - min(beta color m, 1)), which
    never saturates, and a pixel is valid where 1/255 of its contrast is left. In a clip the sun drifts with the car.

    Args:
        center_x_range, center_y_range: of the sun, in widths and heights from the upper left corner of the frame, on
            it or not.
        radius_range: rho, in diagonals of the frame; 0 is no flare.
        strength_range: beta; 0 is no flare.
        color: of the sun, relative to `strength`, one number for each channel or one for all.
        blend: "add" or "screen".
        clip: hold the result of "add" in [0, 1]; without, it is linear in everything.
        drift_x_range, drift_y_range: widths and heights per frame of a clip.
        tolerance: how far the image may be from the exact one, levels of 1/255, so that only the part of the frame is
            computed that the flare reaches; see `plan`; None is exact.
        p: chance that a sample is degraded at all.

    Raises:
        ValueError: an argument outside its range; a color that does not fit the channels.

    Source: the torchrefract paper; the intervals of rho and beta are those it writes, 0.3 and 0.6 +- 0.05.
    """

    def __init__(
        self,
        *,
        center_x_range: Range = (0.3, 0.7),
        center_y_range: Range = (0.0, 0.3),
        radius_range: Range = (0.25, 0.35),
        strength_range: Range = (0.55, 0.65),
        color: float | Sequence[float] = 1.0,
        blend: str = "add",
        clip: bool = True,
        drift_x_range: Range = (-0.002, 0.002),
        drift_y_range: Range = (0.0, 0.0),
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        for name, value in {
            "center_x_range": center_x_range,
            "center_y_range": center_y_range,
            "drift_x_range": drift_x_range,
            "drift_y_range": drift_y_range,
        }.items():
            setattr(self, name, check_range(name, value, low=-_FARTHEST, high=_FARTHEST))
        self.radius_range = check_range("radius_range", radius_range, low=0.0, high=_FARTHEST)
        self.strength_range = check_range("strength_range", strength_range, low=0.0, high=1e3)
        self.color = check_color("color", color, high=1e3)
        self.blend = check_choice("blend", blend, ("add", "screen"))
        self.clip = check_flag("clip", clip)

    params_type = FlareParams
    maps = ("intensity",)

    def at_rest(self) -> bool:
        """Whether no sun has any strength, or size."""
        return 0 in (self.strength_range[1], self.radius_range[1])

    def draw(self, source: random.Stream, image: Tensor) -> FlareParams:
        """One sun a sample, every number uniform in its range."""
        places = [getattr(self, f"{name}_range") for name in ("center_x", "center_y", "drift_x", "drift_y")]
        applied, values = self._uniform(source, [*places, self.radius_range, self.strength_range], image)
        colors = [color_per_channel("color", self.color, image.shape[1])] * image.shape[0]
        color = as_device_tensor(colors, dtype=values.dtype, device=values.device).view(image.shape[:2])
        first = torch.zeros_like(values[:, :1])
        return FlareParams(applied, values[:, :2], values[:, 4], values[:, 5], color, values[:, 2:4], first)

    def check(self, params: FlareParams, image: Tensor) -> None:
        """Raise for suns that are none."""
        batch, channels = image.shape[:2]
        sizes = {"center": (batch, 2), "drift": (batch, 2), "color": (batch, channels), "radius": (batch,)}
        for name, size in (sizes | {"strength": (batch,)}).items():
            if getattr(params, name).shape != size:
                raise ValueError(f"params.{name} must have shape {size}, got {tuple(getattr(params, name).shape)}")
        check_frame(params)
        for name in ("center", "drift"):
            check_values(f"params.{name}", "be finite", getattr(params, name), torch.isfinite)
        for name in ("radius", "strength", "color"):
            value = getattr(params, name)
            check_values(f"params.{name}", "be at least 0 and finite", value, lambda v: v.isfinite() & (v >= 0))

    def acts(self, params: FlareParams) -> Tensor:
        """The samples with a sun."""
        return (params.radius != 0) & (params.strength != 0)

    def params_in_range(self, params: FlareParams) -> Tensor:
        """(), bool: all suns lie in the ranges."""
        names = ("center_x", "center_y", "radius", "strength", "drift_x", "drift_y")
        values = torch.stack([*params.center.T, params.radius, params.strength, *params.drift.T], dim=1)
        ends = [(min(self.color), max(self.color))] * params.color.shape[1]
        return in_ranges(values, [getattr(self, f"{name}_range") for name in names]) & in_ranges(params.color, ends)

    def planned(self, height: int, width: int, dtype: torch.dtype, *, any_depth: bool = False) -> FlarePlan:
        """The plan for images of a type, from the ranges alone; depth is nothing to a flare."""
        suns = Suns(
            *(
                reach(getattr(self, f"center_{axis}_range"), getattr(self, f"drift_{axis}_range"), size)
                for axis, size in (("x", width), ("y", height))
            ),
            radius=self.radius_range[1] * math.hypot(width, height) * (1 + _ROUNDING),
            strength=self.strength_range[1] * max(self.color) * (1 + _ROUNDING),
            worth=_SCREENED if self.blend == "screen" else _CLIPPED if self.clip else 0.0,
            bounded=self.clip or self.blend == "screen",
        )
        return flare_plan(suns, height, width, self.tolerance, dtype is torch.float64)

    def shade(self, image: Tensor, params: FlareParams, depth: Tensor | None) -> Shaded:
        """The rows in the light of the sun."""
        rows, _, height, width = image.shape
        dtype = field_dtype(image.dtype)
        share = params.center[:, None] + params.frame[:, :, None] * params.drift[:, None]
        # Where nothing may be read, numbers that are none are no sun.
        center = (
            finite_or(share.to(dtype), _FARTHEST).reshape(-1, 2)
            * as_device_tensor((width, height), dtype=dtype, device=share.device)
            - 0.5
        )
        radius = expand_batch(finite_or(params.radius.to(dtype), 0.0), rows) * math.hypot(width, height)
        along_x, along_y = flare_axes(center, radius, height=height, width=width)
        along_y = along_y * column(expand_batch(finite_or(params.strength.to(dtype), 0.0), rows))
        color = expand_batch(finite_or(params.color.to(dtype), 0.0), rows)[:, :, None, None]
        plan: FlarePlan = self.plan_for(params, image, depth)
        shone = image
        if plan.part is None:
            shone = self._shine(image, along_y * color, along_x)
        elif plan.acts:
            top, bottom, left, right = plan.part
            part = image[:, :, top:bottom, left:right]
            shone = image.clone()
            shone[:, :, top:bottom, left:right] = self._shine(
                part, along_y[:, :, top:bottom] * color, along_x[..., left:right]
            )
        return Shaded(
            shone,
            valid=lambda: self._valid(image, along_x, along_y * color),
            intensity=lambda: along_y * along_x,
        )

    def _shine(self, image: Tensor, light: Tensor, along_x: Tensor) -> Tensor:
        if self.blend == "screen":
            return torch.addcmul(image, 1 - image, (light * along_x).clamp(max=1))
        added = torch.addcmul(image, light, along_x)
        if not self.clip:
            return added
        if added.requires_grad or torch.compiler.is_compiling():
            return added.clamp(0, 1)
        # Nobody else needs the sum; this is a clamp in place that torch.vmap knows.
        return F.hardtanh(added, 0.0, 1.0, inplace=True)

    def _valid(self, image: Tensor, along_x: Tensor, light: Tensor) -> Tensor:
        if self.blend == "screen":
            return (light * along_x <= 1 - 1 / 255).all(dim=1, keepdim=True)
        return (torch.addcmul(image, light, along_x) <= 1).all(dim=1, keepdim=True)
