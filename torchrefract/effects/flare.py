"""Lens flare: the sun shining into the lens."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, assume_constant_result, expand_batch, in_ranges
from torchrefract._validation import (
    check_choice,
    check_color,
    check_flag,
    check_range,
    check_values,
    eager_values,
    finite_or,
    requires_grad,
)
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.effects.random_field import check_frame
from torchrefract.fields.flare import add_light, flare_axes, screen_light
from torchrefract.fields.srgb import color_of_images
from torchrefract.planning.photometric import PhotometricPlan, PhotometricRequest, plan_flare
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_FARTHEST = 1e4  # widths and heights
_PLACES = ("center_x", "center_y", "drift_x", "drift_y")
_ROUNDING = 2e-5  # relative, of drawn values


class FlareParams(NamedTuple):
    """The parameters of lens flare for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    center: Tensor  # (B, 2), of the sun, in widths and heights of the frame, from its upper left corner
    radius: Tensor  # (B,), rho, in diagonals of the frame, at least 0
    strength: Tensor  # (B,), beta, light added at the center, at least 0
    color: Tensor  # (B, C), of the sun, relative, at least 0
    drift: Tensor  # (B, 2), widths and heights per frame, of the center over a clip
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the flare has no strength or no size."""
        return (self.radius == 0) | (self.strength == 0)


class LensFlare(PhotometricEffect):
    """Lens flare: a Gaussian of light around the sun.

        I = clip(I_clean + beta color m, 0, 1),  m = exp(-(d / r)^2 / 2),  r = radius sqrt(W^2 + H^2),  beta = strength

    d is the distance to the center in px. `intensity` is beta m; `valid` are the pixels that do not saturate, where the
    clean image is I - beta color m. With `blend="screen"`, I = 1 - (1 - I_clean) (1 - min(beta color m, 1)), which
    never saturates, and a pixel is valid where at least 1/255 of its contrast remains. In a clip the sun moves.

    Args:
        center_x_range, center_y_range: of the sun, in widths and heights from the upper left corner of the frame; it
            may lie outside.
        radius_range: rho, in diagonals of the frame; 0 is no flare.
        strength_range: beta; 0 is no flare.
        color: of the sun, relative to `strength`, one number for each channel or one for all;
            gray images take the luma of three.
        blend: "add" or "screen".
        clip: clip the result of "add" to [0, 1]; without, it is linear in everything.
        drift_x_range, drift_y_range: widths and heights per frame of a clip.
        tolerance: largest error of the image, levels of 1/255; a flare too faint to be seen is not computed. None is
            exact. `plan` is that of single images. For a clip the sun moves, up to the latest frame of the batch if
            values can be read, and otherwise without a limit.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range; a color that does not fit the channels.

    Source: the torchrefract paper; the default ranges of rho and beta are its 0.3 and 0.6 +- 0.05.
    """

    params_type = FlareParams
    maps = ("intensity",)

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
        given = (center_x_range, center_y_range, drift_x_range, drift_y_range)
        self._set_ranges(dict(zip(_PLACES, given, strict=True)), dict.fromkeys(_PLACES, (-_FARTHEST, _FARTHEST)))
        self.radius_range = check_range("radius_range", radius_range, low=0.0, high=_FARTHEST)
        self.strength_range = check_range("strength_range", strength_range, low=0.0, high=1e3)
        self.color = check_color("color", color, high=1e3)
        self.blend = check_choice("blend", blend, ("add", "screen"))
        self.clip = check_flag("clip", clip)

    def sample_params(self, stream: random.Stream, image: Tensor) -> FlareParams:
        """Draw all parameters uniformly in their ranges."""
        places = [self._range(name) for name in _PLACES]
        applied, values = self.draw_in_ranges(stream, [*places, self.radius_range, self.strength_range], image)
        color = color_of_images("color", self.color, image, values.dtype)
        frame = torch.zeros_like(values[:, :1])
        return FlareParams(applied, values[:, :2], values[:, 4], values[:, 5], color, values[:, 2:4], frame)

    def validate(self, params: FlareParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        rows = {"center": (2,), "drift": (2,), "color": (image.shape[1],), "radius": (), "strength": ()}
        check_shapes(params, rows)
        check_frame(params)
        for name in ("center", "drift"):
            check_values(f"params.{name}", "be finite", getattr(params, name), torch.isfinite)
        for name in ("radius", "strength", "color"):
            value = getattr(params, name)
            check_values(f"params.{name}", "be at least 0 and finite", value, lambda v: v.isfinite() & (v >= 0))

    def params_in_range(self, params: FlareParams) -> Tensor:
        """Return (), bool: all parameters lie in the ranges."""
        values = torch.stack([*params.center.T, *params.drift.T, params.radius, params.strength], dim=1)
        colors = [(min(self.color), max(self.color))] * params.color.shape[1]
        ranges = [self._range(name) for name in (*_PLACES, "radius", "strength")]
        return in_ranges(values, ranges) & in_ranges(params.color, colors)

    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan images by the largest light that the ranges add to a pixel; flare does not depend on depth."""
        return self._plan_until(0.0, request)

    def _plan_until(self, latest: float, request: PhotometricRequest) -> PhotometricPlan:
        """Plan the frames of clips up to the latest one."""
        size = (request.width, request.height)
        radius = max(self.radius_range[1] * math.hypot(*size) * (1 + _ROUNDING), 1e-6)
        # The sun moves up to the latest frame of a clip, and is some distance from the nearest pixel there.
        places = [self._range(name) for name in _PLACES]
        moved = [latest * max(map(abs, ends)) if any(ends) else 0.0 for ends in places[2:]]
        centers = [(low - drift, high + drift) for (low, high), drift in zip(places[:2], moved, strict=True)]
        distance = math.hypot(*map(_distance_from_frame, centers, size))
        light = self.strength_range[1] * max(self.color) * (1 + _ROUNDING)
        light *= math.exp(-0.5 * (distance / radius) ** 2) if self.radius_range[1] > 0 else 0.0
        return plan_flare(light, request, is_bounded=self.clip or self.blend == "screen")

    def plan_for(self, image: Tensor, params: FlareParams, depth: Tensor | None) -> PhotometricPlan:
        """Return the plan for the latest frame of a batch, for all frames if it cannot be read; see the base class."""
        latest = eager_values(lambda: params.frame.abs().amax(), of=params.frame) if params.frame.numel() else 0.0
        if latest == 0 or self.tolerance is None or requires_grad(params):
            return super().plan_for(image, params, depth)
        height, width = image.shape[2:]
        latest = math.inf if latest is None else float(latest)
        return self._constant_clip_plan(id(self), height, width, field_dtype(image.dtype), latest)

    def render(self, image: Tensor, params: FlareParams, depth: Tensor | None) -> Rendered:
        """Add the light of the sun to images."""
        rows, _, height, width = image.shape
        dtype = field_dtype(image.dtype)
        place = params.center[:, None] + params.frame[:, :, None] * params.drift[:, None]
        # Invalid values, which cannot be read on an accelerator, make no light.
        center = finite_or(place.to(dtype), _FARTHEST).reshape(-1, 2)
        center = center * as_device_tensor((width, height), dtype=dtype, device=center.device) - 0.5
        radius, strength, color = (
            expand_batch(finite_or(value.to(dtype), 0.0), rows)
            for value in (params.radius, params.strength, params.color)
        )
        along_x, along_y = flare_axes(center, radius * math.hypot(width, height), height=height, width=width)
        along_y, color = along_y * strength.view(-1, 1, 1, 1), color[:, :, None, None]

        def is_valid() -> Tensor:
            if self.blend == "screen":
                return (along_y * color * along_x <= 1 - 1 / 255).all(dim=1, keepdim=True)
            return (torch.addcmul(image, along_y * color, along_x) <= 1).all(dim=1, keepdim=True)

        if self.plan_for(image, params, depth).is_identity:
            result = image
        elif self.blend == "screen":
            result = screen_light(image, along_x, along_y * color)
        else:
            result = add_light(image, along_x, along_y * color, clip=self.clip)
        return Rendered(result, is_valid, intensity=lambda: along_y * along_x)

    @assume_constant_result
    def _constant_clip_plan(
        self, _: int, height: int, width: int, dtype: torch.dtype, latest: float
    ) -> PhotometricPlan:
        return self._plan_until(latest, PhotometricRequest(height, width, self.tolerance, dtype is torch.float64))


def _distance_from_frame(center_range: Range, size: int) -> float:
    """Distance in px along an axis from the nearest center of a range, in shares of a side, to the nearest pixel."""
    if not all(map(math.isfinite, center_range)):
        return 0.0
    margin = 1e-5 * size * max(1.0, *map(math.fabs, center_range))  # rounding of given parameters
    low, high = (end * size - 0.5 for end in center_range)
    return max(low - margin - (size - 1), -high - margin, 0.0)
