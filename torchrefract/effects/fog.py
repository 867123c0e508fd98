"""Fog of uniform density, and what all fogs share."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, cached_constant, expand_batch, in_ranges
from torchrefract._validation import (
    check_color,
    check_flag,
    check_number,
    check_range,
    check_values,
    check_within,
    finite_or,
)
from torchrefract.cameras.camera import Camera, check_camera
from torchrefract.effects.batch import (
    BatchShape,
    check_image,
    check_shapes,
    from_batch,
    params_to,
    to_batch,
)
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.fields.airlight import airlight_of_frame, dust_airlight
from torchrefract.fields.depth import (
    DepthProvider,
    DepthSource,
    LinearDepth,
    check_depth_provider,
    check_floating,
    frame_depth,
    ray_distance,
)
from torchrefract.fields.fog import blend_fog, extinction, transmission, unblend_fog
from torchrefract.fields.srgb import color_of_images, color_per_channel
from torchrefract.planning.photometric import (
    FogErrorModel,
    PhotometricPlan,
    PhotometricRequest,
    plan_uniform_fog,
)
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_OfFrame = Literal["frame", "dust"]
Airlight = float | Sequence[float] | _OfFrame | None

_AIRLIGHTS = {"frame": airlight_of_frame, "dust": dust_airlight}
_PAPER_AIRLIGHT = (220 / 255, 220 / 255, 235 / 255)
(_GRAY,) = color_per_channel("airlight", _PAPER_AIRLIGHT, 1)
MIN_TRANSMISSION = 1 / 255  # of what 8 bits can recover
_ROUNDING = 2e-5  # relative, of a drawn extinction
_ENDLESS = 1e30  # m, of a visibility that float32 hardly holds
_OPAQUE = 1e20  # 1/m; no light passes, and products with depths stay finite


class FogParams(NamedTuple):
    """The parameters of uniform fog for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    visibility: Tensor  # (B,), m, above 0; inf is clear air
    deviation: Tensor  # (B,), relative deviation of the extinction, above -1
    airlight: Tensor  # (B, C), in [0, 1], as stored in the image

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the air is clear."""
        return self.visibility == torch.inf


@dataclass(frozen=True, kw_only=True)
class FogMedium:
    """The light of the fog and the distance through it, without its density; fields as arguments of `UniformFog`."""

    airlight: tuple[float, ...] | _OfFrame | None
    threshold: float
    depth: DepthSource = field(hash=False)  # providers may have no hash
    camera: Camera | None
    linear_light: bool

    @property
    def colors(self) -> tuple[float, ...]:
        """Return all values that the airlight can have, or the ends of their range for that of the frame."""
        if isinstance(self.airlight, str):
            return (0.0, 1.0)
        return (*_PAPER_AIRLIGHT, _GRAY) if self.airlight is None else self.airlight

    def airlight_of(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the airlight for images (B, C, H, W) as (B, C)."""
        if isinstance(self.airlight, str):
            return _AIRLIGHTS[self.airlight](to_batch(image)).to(dtype)
        paper = _PAPER_AIRLIGHT if image.shape[1] == 3 else (_GRAY,)
        return color_of_images("airlight", paper if self.airlight is None else self.airlight, image, dtype)

    def distance(self, image: Tensor, depth: Tensor | None) -> Tensor:
        """Return how far light travels to each pixel of images (N, C, H, W), along the rays if the camera is known.

        Args:
            image: gives the size.
            depth: (N or B, 1, H, W), m; None takes that of the provider.

        Returns:
            (N, B or 1, 1, H, 1 or W), m.
        """
        depth, (height, width) = frame_depth(self.depth, image, depth), image.shape[2:]
        if self.camera is None:
            return depth
        camera = self.camera.resized(width=width, height=height)
        return ray_distance(depth, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, width=width)

    def extinction_range(self, visibility_range: Range, deviation_range: Range) -> Range:
        """Return the lowest and the highest mean extinction in 1/m, with a margin for rounding."""
        (near, far), (thin, dense) = visibility_range, deviation_range
        scale = -math.log(self.threshold)
        return scale / far * (1 + thin) * (1 - _ROUNDING), scale / near * (1 + dense) * (1 + _ROUNDING)

    def error_model(self, extinction_range: Range, height: int, width: int, *, has_depth: bool) -> FogErrorModel:
        """Return error bounds of uniform fog; `has_depth` if the depth is passed in, so that it has no bound."""
        largest = extinction_range[1]
        is_known = isinstance(self.depth, DepthProvider) and not has_depth
        farthest = _farthest(self, height, width) if is_known else math.inf
        thickness = largest * min(farthest, 1e12) if largest > 0 else 0.0
        return FogErrorModel(thickness, self.colors, self.linear_light)

    def mean_extinction(self, params: Any, dtype: torch.dtype) -> Tensor:
        """Return k0 (1 + deviation) in 1/m, (B,); fog without a valid extinction is opaque."""
        k = extinction(params.visibility.to(dtype), self.threshold) * (1 + params.deviation.to(dtype))
        return k.nan_to_num(nan=_OPAQUE).clamp(0, _OPAQUE)

    def params_in_range(self, params: Any, extinction_range: Range) -> Tensor:
        """Return (), bool: extinction and airlight lie in the ranges."""
        k = self.mean_extinction(params, params.visibility.dtype)
        colors = [(min(self.colors), max(self.colors))] * params.airlight.shape[1]
        return in_ranges(k[:, None], [extinction_range]) & in_ranges(params.airlight, colors)

    def blend(
        self,
        image: Tensor,
        params: Any,
        distance: Tensor,
        k: Tensor,
        *,
        is_visible: bool,
        airlight: Tensor | None = None,
    ) -> Rendered:
        """Blend images with fog, or return them as they are and maps.

        Args:
            image: (N, C, H, W), clean.
            params: with B rows; gives the airlight.
            distance: (N, B or 1, 1, H, 1 or W), m.
            k: (N or B, 1, H or 1, W or 1), extinction, 1/m.
            is_visible: False returns the image as it is.
            airlight: (N, C, H, W), stored values; None is that of the params everywhere.
        """
        rows, batch = max(len(k), len(distance)), len(image)

        def through() -> Tensor:
            return transmission(expand_batch(distance, rows), expand_batch(k, rows))

        if not is_visible:
            return Rendered(image, lambda: through() >= MIN_TRANSMISSION, transmission=through, extinction=k)
        t = through()
        if airlight is None:
            airlight = finite_or(params.airlight.to(field_dtype(image.dtype)), 0.0)[:, :, None, None]
            airlight = expand_batch(airlight, batch)
        blended = blend_fog(image, expand_batch(t, batch), airlight, linear_light=self.linear_light)
        return Rendered(blended, lambda: t >= MIN_TRANSMISSION, transmission=t, extinction=k)


def make_medium(
    *,
    airlight: Airlight,
    threshold: float,
    depth: DepthSource | None,
    camera: Camera | None,
    linear_light: bool,
) -> FogMedium:
    """Make a medium from arguments as `UniformFog` takes them."""
    return FogMedium(
        airlight=_check_airlight(airlight),
        threshold=check_number("threshold", threshold, low=1e-6, high=1 - 1e-6),
        depth=LinearDepth() if depth is None else check_depth_provider(depth),
        camera=check_camera(camera),
        linear_light=check_flag("linear_light", linear_light),
    )


def _check_airlight(airlight: Airlight) -> tuple[float, ...] | _OfFrame | None:
    if isinstance(airlight, str):
        if airlight not in _AIRLIGHTS:
            raise ValueError(f"airlight must be 'frame', 'dust', None or numbers in [0, 1], got {airlight!r}")
        return airlight
    return None if airlight is None else check_color("airlight", airlight, high=1.0)


class UniformFog(PhotometricEffect):
    """Fog of uniform density by Koschmieder's law.

        I = I_clean t + A (1 - t),  t = exp(-k d),  k = -ln(threshold) / V (1 + deviation)

    `transmission` is t, `extinction` is k, and `valid` is t >= 1/255: the pixels that `remove_fog` can recover from
    8 bits.

    Args:
        visibility_range: V in m, above 0, inf for clear air; up to an infinite end, 1 / V is drawn uniformly.
        deviation_range: relative deviation of the extinction, within (-1, 1).
        airlight: color of the fog in [0, 1], one number for each channel or one for all, of three the luma for gray
            images; None is that of the paper,
            (220, 220, 235) / 255 for three channels and its luminance for any other number; "frame" estimates it from
            each image, see `airlight_of_frame`: gray under clouds, dark at night; "dust" is laterite in that light,
            see `dust_airlight`. A clip has the color of its first frame, and frame t alone its own, so pass the params
            of the clip to `apply` for frames one by one.
        threshold: contrast that remains at the distance V, in (0, 1); 0.05 is the meteorological optical range.
        depth: gives d if no depth is passed in: a provider, or any function from images (B, C, H, W) in [0, 1] to their
            depth (B, 1, H, W) in m, such as a network. None is `LinearDepth()`, the ramp over the rows of the paper.
        camera: of the frames, whose pinhole counts; with it, depth along its axis becomes the distance along each ray.
        linear_light: blend linear light, not stored values (sRGB).
        tolerance: largest error of the image, levels of 1/255; fog too thin to be seen is not computed, see `plan`.
            None is exact. Maps stay exact.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range; an airlight that does not fit the channels; a depth that is
            negative, NaN, or clearly not in m, see `check_depth` (on the CPU).

    Source: Koschmieder, "Theorie der horizontalen Sichtweite", 1924; colors and depth from the torchrefract paper.
    """

    params_type = FogParams
    maps = ("transmission", "extinction")

    def __init__(
        self,
        *,
        visibility_range: Range = (100.0, 100.0),
        deviation_range: Range = (-0.05, 0.05),
        airlight: Airlight = None,
        threshold: float = 0.05,
        depth: DepthSource | None = None,
        camera: Camera | None = None,
        linear_light: bool = False,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.visibility_range, self.deviation_range = check_fog_ranges(visibility_range, deviation_range)
        self.medium = make_medium(
            airlight=airlight, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light
        )
        self.depth = self.medium.depth

    def sample_params(self, stream: random.Stream, image: Tensor) -> FogParams:
        """Draw V and the deviation uniformly in their ranges."""
        return draw_fog(self, stream, image)[0]

    def validate(self, params: FogParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_fog_params(params, image)

    def params_in_range(self, params: FogParams) -> Tensor:
        """Return (), bool: all parameters lie in the ranges."""
        span = self.medium.extinction_range(self.visibility_range, self.deviation_range)
        return self.medium.params_in_range(params, span)

    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan frames for the depth of the effect or, with `has_depth`, for any depth."""
        span = self.medium.extinction_range(self.visibility_range, self.deviation_range)
        model = self.medium.error_model(span, request.height, request.width, has_depth=has_depth)
        return plan_uniform_fog(model, request)

    def render(self, image: Tensor, params: FogParams, depth: Tensor | None) -> Rendered:
        """Blend images with fog."""
        is_visible = not self.plan_for(image, params, depth).is_identity
        k = self.medium.mean_extinction(params, field_dtype(image.dtype)).view(-1, 1, 1, 1)
        return self.medium.blend(image, params, self.medium.distance(image, depth), k, is_visible=is_visible)


def draw_fog(
    effect: Any, stream: random.Stream, image: Tensor, ranges: Sequence[Range] = ()
) -> tuple[FogParams, Tensor]:
    """Draw the parameters that all fogs have, and a uniform value in each of n more ranges, (B, n)."""
    near, far = effect.visibility_range
    # An infinite end has no uniform draw, so 1 / V is drawn.
    is_inverse = far > _ENDLESS
    first = (1 / far, 1 / near) if is_inverse else (near, far)
    applied, values = effect.draw_in_ranges(stream, [first, effect.deviation_range, *ranges], image)
    visibility = 1 / values[:, 0] if is_inverse else values[:, 0]
    airlight = effect.medium.airlight_of(image, values.dtype)
    return FogParams(applied, visibility, values[:, 1], airlight), values[:, 2:]


def check_fog_ranges(visibility_range: Range, deviation_range: Range) -> tuple[Range, Range]:
    """Return valid ranges of V in m and of the relative deviation of the extinction."""
    visibility_range = check_range("visibility_range", visibility_range, low=1e-6, high=torch.inf)
    return visibility_range, check_range("deviation_range", deviation_range, low=-0.999, high=0.999)


def check_fog_params(params: Any, image: Tensor) -> None:
    """Raise ValueError for an invalid visibility, deviation or airlight."""
    check_shapes(params, {"visibility": (), "deviation": (), "airlight": (image.shape[1],)})
    check_values("params.visibility", "be above 0", params.visibility, lambda v: v > 0)
    check_values("params.deviation", "be above -1", params.deviation, lambda v: (v > -1) & v.isfinite())
    check_within("params.airlight", params.airlight, 0.0, 1.0)


@cached_constant(maxsize=64)
def _farthest(medium: FogMedium, height: int, width: int) -> float:
    """The largest distance in m by the depth provider."""
    return medium.distance(torch.empty(1, 1, height, width, dtype=torch.float64, device="cpu"), None).amax().item()


def remove_fog(
    image: Tensor, transmission: Tensor, airlight: float | Sequence[float] | Tensor, *, linear_light: bool = False
) -> tuple[Tensor, Tensor]:
    """Remove fog of a known transmission: the inverse of every fog in closed form.

        J = A + (I - A) / t where t >= 1/255, else I

    A floating result is not clamped, so an image with noise may leave [0, 1].

    Args:
        image: (B, C, H, W), (C, H, W) or (B, T, C, H, W), floating, or uint8, which is converted, rounded and clamped.
        transmission: t in [0, 1], (B, 1, H, W), (1, H, W) or (B, T, 1, H, W), or a shape that broadcasts to it.
        airlight: A, color of the fog: one number in [0, 1], or one for each channel; (C,), (B, C) or, for images
            (B, C, H, W), of their shape as a tensor.
        linear_light: the fog was blended in linear light, not in stored values (sRGB).

    Returns:
        The image, with the same shape, type and memory format, and valid, (B, 1, H, W) for (B, C, H, W), bool:
        t >= 1/255.

    Raises:
        ValueError: shapes that do not fit; a transmission outside [0, 1] or NaN (on the CPU); an airlight out of range.
        TypeError: an image that is neither floating nor uint8, a transmission that is no floating tensor.
    """
    shape = check_image(image)
    check_flag("linear_light", linear_light)
    foggy, t = to_batch(image), _transmission_to_batch(transmission, image, shape)
    t = t.to(foggy.dtype)
    valid = t >= MIN_TRANSMISSION
    color = _airlight_to_batch(airlight, foggy, shape)
    clean = unblend_fog(foggy, torch.where(valid, t, 1), color, linear_light=linear_light)
    clean = torch.where(valid & (t < 1), clean, foggy)
    return from_batch(clean, image, foggy), shape.restore(valid.expand(foggy.shape[0], 1, *foggy.shape[2:]))


def _transmission_to_batch(t: Tensor, image: Tensor, shape: BatchShape) -> Tensor:
    """(N, 1, H or 1, W or 1)."""
    full = (*shape.leading, 1, *image.shape[-2:])
    size = check_floating("transmission", t).shape
    if len(size) != len(full) or any(side not in (1, largest) for side, largest in zip(size, full, strict=True)):
        raise ValueError(f"transmission must broadcast to {full} for this image, got {tuple(size)}")
    check_values("transmission", "be in [0, 1]", t, lambda v: (v >= 0) & (v <= 1))
    return t.expand(*shape.leading, -1, -1, -1).reshape(shape.batch * shape.frames, *size[-3:])


def _airlight_to_batch(airlight: float | Sequence[float] | Tensor, image: Tensor, shape: BatchShape) -> Tensor:
    """(N or 1, C, 1, 1), or (N, C, H, W), for images (N, C, H, W)."""
    batch, channels = shape.batch, image.shape[1]
    if isinstance(airlight, Tensor):
        if airlight.shape == image.shape:
            check_values("airlight", "be finite", airlight, torch.isfinite)
            return airlight.to(image.dtype)
        if airlight.shape not in ((channels,), (1, channels), (batch, channels)):
            raise ValueError(
                f"airlight must have shape ({channels},), ({batch}, {channels}) or that of the image, "
                f"got {tuple(airlight.shape)}"
            )
        check_values("airlight", "be finite", airlight, torch.isfinite)
        return expand_batch(airlight.to(image.dtype).view(-1, channels), image.shape[0])[:, :, None, None]
    numbers = color_per_channel("airlight", check_color("airlight", airlight, high=1.0), channels)
    return as_device_tensor(numbers, dtype=image.dtype, device=image.device)[None, :, None, None]
