"""The sun in or just above the frame: its disk, glare, ghosts, and a camera that exposes for it."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, expand_batch
from torchrefract._validation import (
    bounded,
    check_color,
    check_count,
    check_number,
    check_range,
    check_values,
    check_within,
    finite_or,
)
from torchrefract.cameras.camera import Camera, check_camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.exposure import (
    LONGEST,
    MOST_GAMMA,
    check_control,
    controlled_gain,
    is_unsaturated,
)
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.effects.random_field import check_frame
from torchrefract.fields.exposure import (
    expose_clipped,
    finite_image,
    map_rows,
    metered_mean,
    metered_nodes,
)
from torchrefract.fields.sky import find_sky, sky_point
from torchrefract.fields.srgb import color_of_images, linear_to_srgb, srgb_to_linear
from torchrefract.fields.sun import SUN_RADIUS, Sun, sun_light
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_FARTHEST = 1e4  # widths and heights
_BRIGHTEST = 1e9
_HIGHEST_GAIN = 2.0  # never reached, as the sun only adds light
_SCALES, _SHAPES, _RADII = (0.01, 100.0), (0.1, 4.0), (0.01, 100.0)
_ABOVE = (-0.4, -0.1)  # heights of the frame, of a sun above one that shows sky
_HIGH_ABOVE = -0.3  # heights, of a sun above a frame without sky, in addition
_GHOST_PLACES = (-1.4, 0.7)  # on the line from the principal point to the sun
_GHOST_LIMITS = {"place": (-_FARTHEST, _FARTHEST), "radius": _RADII, "share": (0.0, 1.0)}
_TINTS = (0.2, 1.0)


class SunGlareParams(NamedTuple):
    """The parameters of sun glare for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    center: Tensor  # (B, 2), of the sun, in widths and heights of the frame, from its upper left corner
    luminance: Tensor  # (B,), of the disk of the sun, at least 0; white is 1
    scatter: Tensor  # (B,), share of the light that lens and windscreen scatter, in [0, 1]
    scale: Tensor  # (B,), degrees, at which the glare falls to 1/e
    shape: Tensor  # (B,), power of the distance in the glare
    color: Tensor  # (B, C), of the sun, relative, at least 0
    ghosts: Tensor  # (B, K, 3): place on the line from the principal point (0) to the sun (1), radius, deg, share
    tints: Tensor  # (B, K, C), of the ghosts, relative, at least 0
    gamma: Tensor  # (B,), strength of the exposure, in [0, 4]
    time_constant: Tensor  # (B,), of the exposure, frames, at least 0
    drift: Tensor  # (B, 2), widths and heights per frame, of the center over a clip
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: there is no sun."""
        return self.luminance == 0


class SunGlare(PhotometricEffect):
    """The sun in front of the camera, in linear light: I = clip(G (I_clean + v), 0, 1).

    Where the clean frame is clipped, G I_clean stays white, see `expose_clipped`.

    v is the light of the solar disk of 0.53 degrees, of the glare that lens and windscreen spread from it by
    g(r) = p1 delta(r) + p2 exp(-p3 r^p4), an energy of 1, and of ghosts on the line through the sun and the principal
    point; see `sun_light`. The camera meters this light and darkens the frame, the foreground with it:
    G = (mean of the clean frame / mean with the sun)^gamma, see `Exposure`. `intensity` is the mean of v over the
    channels; `valid` are the pixels that do not saturate.

    By default the sun stands at a random point of the sky that the frame shows, see `sky_mask`. In a share `outside` of
    the frames, and in those without sky, it stands above the frame, from where it sends glare but no disk and no
    ghosts; they fade while the disk leaves the frame. At night there is none: the drawn luminance is 0. For a clip, its
    first frame counts; so to degrade a clip in parts, pass the params of the first part to `apply`.

    Args:
        center_x_range, center_y_range: of the sun, in widths and heights from the upper left corner of the frame; both
            or none, which is the sky of the frame.
        outside: probability in [0, 1] that a sun that is placed by the sky stands above the frame.
        luminance_range: of the solar disk, in [0, 1e9]; white is 1, and the sun at noon some 1e5.
        scatter_range: 1 - p1, share of its light that is scattered, in [0, 1].
        scale_range: p3^(-1/p4), degrees in the image plane, in [0.01, 100].
        shape_range: p4, in [0.1, 4].
        num_ghosts: number of ghosts, 0 or above.
        ghost_radius_range: degrees, in [0.01, 100].
        ghost_share_range: of the light of the sun, in [0, 1]; two reflections of 0.5 % give 2.5e-5.
        color: of the sun, one number for each channel or one for all; gray images take the luma of three.
        gamma_range: strength of the exposure, in [0, 4]; 0 keeps the gain of the clean frame, and above 1 the camera
            darkens more than the mean asks for, as real ones do to keep highlights.
        min_gain: lowest G, in [1/32, 1].
        time_constant_range: of the exposure in a clip, in frames; with 0 each frame is exposed by itself.
        drift_x_range, drift_y_range: of the sun, in widths and heights per frame of a clip.
        camera: of the frames, whose pinhole counts; None is a centered one with a focal length of 0.9 widths.
        tolerance: all of the effect is computed under any tolerance.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range; one of the two ranges of the center; a color that does not fit.
        TypeError: a camera of another type.

    Source: arXiv:2404.10992 for the spread of glare; Lee and Eisemann, "Practical real-time lens-flare rendering",
    Computer Graphics Forum 32 (2013), for ghosts.
    """

    params_type = SunGlareParams
    maps = ("intensity",)

    def __init__(
        self,
        *,
        center_x_range: Range | None = None,
        center_y_range: Range | None = None,
        outside: float = 0.2,
        luminance_range: Range = (5e4, 1.5e5),
        scatter_range: Range = (0.02, 0.12),
        scale_range: Range = (0.3, 0.8),
        shape_range: Range = (0.45, 0.55),
        num_ghosts: int = 4,
        ghost_radius_range: Range = (0.5, 2.5),
        ghost_share_range: Range = (0.0, 5e-5),
        color: float | Sequence[float] = 1.0,
        gamma_range: Range = (1.2, 1.8),
        min_gain: float = 1 / 16,
        time_constant_range: Range = (0.0, 0.0),
        drift_x_range: Range = (-0.002, 0.002),
        drift_y_range: Range = (0.0, 0.0),
        camera: Camera | None = None,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        places = {"center_x_range": center_x_range, "center_y_range": center_y_range}
        self.center_x_range, self.center_y_range = (
            None if place is None else _check_place(name, place) for name, place in places.items()
        )
        if (center_x_range is None) != (center_y_range is None):
            raise ValueError("center_x_range and center_y_range must both be given, or neither, got one of them")
        self.outside = check_number("outside", outside, low=0.0, high=1.0)
        self.luminance_range = check_range("luminance_range", luminance_range, low=0.0, high=_BRIGHTEST)
        self.scatter_range = check_range("scatter_range", scatter_range, low=0.0, high=1.0)
        self.scale_range = check_range("scale_range", scale_range, low=_SCALES[0], high=_SCALES[1])
        self.shape_range = check_range("shape_range", shape_range, low=_SHAPES[0], high=_SHAPES[1])
        self.num_ghosts = check_count("num_ghosts", num_ghosts, low=0)
        self.ghost_radius_range = check_range("ghost_radius_range", ghost_radius_range, low=_RADII[0], high=_RADII[1])
        self.ghost_share_range = check_range("ghost_share_range", ghost_share_range, low=0.0, high=1.0)
        self.color = check_color("color", color, high=1e3)
        self.gamma_range = check_range("gamma_range", gamma_range, low=0.0, high=MOST_GAMMA)
        self.min_gain = check_number("min_gain", min_gain, low=1 / 32, high=1.0)
        self.time_constant_range = check_range("time_constant_range", time_constant_range, low=0.0, high=LONGEST)
        self.drift_x_range = _check_place("drift_x_range", drift_x_range)
        self.drift_y_range = _check_place("drift_y_range", drift_y_range)
        self.camera = check_camera(camera)

    def sample_params(self, stream: random.Stream, image: Tensor) -> SunGlareParams:
        """Draw all parameters uniformly in their ranges, and the place of the sun in the sky of the frame."""
        places = [self.center_x_range or (0.0, 1.0), self.center_y_range or _ABOVE]
        names = ("luminance", "scatter", "scale", "shape", "gamma", "time_constant", "drift_x", "drift_y")
        ranges = [*places, *(self._range(name) for name in names)]
        applied, values = self.draw_in_ranges(stream, ranges, image)
        center, luminance = values[:, :2], values[:, 2]
        inner = random.fold(stream)
        if self.center_x_range is None:
            u = random.uniform(inner.at(0), 4).to(values.dtype)
            sky = find_sky(image)
            point, has_sky = sky_point(sky, u[:, 1:], height=image.shape[2], width=image.shape[3])
            above = torch.stack([center[:, 0], center[:, 1] + _HIGH_ABOVE * (~has_sky).to(center.dtype)], dim=1)
            center = torch.where((has_sky & (u[:, 0] >= self.outside))[:, None], point, above)
            luminance = torch.where(sky.is_night, 0.0, luminance)
        batch, channels = image.shape[:2]
        spans = [_GHOST_PLACES, self.ghost_radius_range, self.ghost_share_range, *[_TINTS] * channels]
        ghosts = random.uniform_in_ranges(inner.at(1), spans * self.num_ghosts, dtype=values.dtype)
        ghosts = ghosts.view(batch, self.num_ghosts, 3 + channels)
        color = color_of_images("color", self.color, image, values.dtype)
        _, _, _, scatter, scale, shape, gamma, time_constant = values[:, :8].unbind(1)
        return SunGlareParams(
            applied,
            center,
            luminance,
            scatter,
            scale,
            shape,
            color,
            ghosts[..., :3],
            ghosts[..., 3:],
            gamma,
            time_constant,
            drift=values[:, 8:],
            frame=torch.zeros_like(values[:, :1]),
        )

    def validate(self, params: SunGlareParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        channels, count = image.shape[1], params.ghosts.shape[1]
        rows = dict.fromkeys(("luminance", "scatter", "scale", "shape", "gamma", "time_constant"), ())
        vectors = {
            "center": (2,),
            "drift": (2,),
            "color": (channels,),
            "ghosts": (count, 3),
            "tints": (count, channels),
        }
        check_shapes(params, rows | vectors)
        check_frame(params)
        check_control(params)
        for name in ("center", "drift"):
            check_values(f"params.{name}", "be finite", getattr(params, name), torch.isfinite)
        for name in ("luminance", "color", "tints"):
            check_within(f"params.{name}", getattr(params, name), 0.0, _BRIGHTEST)
        check_within("params.scatter", params.scatter, 0.0, 1.0)
        check_within("params.scale", params.scale, *_SCALES)
        check_within("params.shape", params.shape, *_SHAPES)
        for i, (name, span) in enumerate(_GHOST_LIMITS.items()):
            value, rule = params.ghosts[..., i], f"have a {name} in [{span[0]:g}, {span[1]:g}]"
            check_values("params.ghosts", rule, value, lambda v, span=span: (v >= span[0]) & (v <= span[1]))

    def render(self, image: Tensor, params: SunGlareParams, depth: Tensor | None) -> Rendered:
        """Add the light of the sun to images and expose them."""
        image = image.contiguous()  # the rounding of a sum of products depends on the memory format
        height, width = image.shape[2:]
        (focal, _), point = pinhole_of(self.camera, height=height, width=width)
        px_per_degree = math.radians(focal)
        sun = self._sun(params, image, px_per_degree)
        x, y = (torch.arange(size, dtype=sun.center.dtype, device=image.device) for size in (width, height))

        def light_of(sun: Sun, x: Tensor, y: Tensor) -> Callable[[slice], Tensor]:
            return sun_light(sun, x, y, principal_point=point, px_per_degree=px_per_degree)

        clean, stride = metered_nodes(image)
        with_sun = metered_mean(clean + light_of(sun, x[::stride], y[::stride])(slice(None)))
        gain = controlled_gain(with_sun, metered_mean(clean), params, low=self.min_gain, high=_HIGHEST_GAIN)
        each_gain, exposed_sun = gain.view(-1, 1, 1, 1), light_of(sun._replace(luminance=gain * sun.luminance), x, y)

        def exposed(band: Tensor, rows: slice) -> Tensor:
            return expose_clipped(srgb_to_linear(finite_image(band)), each_gain).add_(exposed_sun(rows))

        def of_rows(band: Tensor, rows: slice, out: Tensor | None) -> Tensor:
            return torch.clamp(linear_to_srgb(exposed(band, rows)), 0, 1, out=out)

        return Rendered(
            map_rows(of_rows, image, (gain, *sun)),
            lambda: is_unsaturated(image, exposed(image, slice(None))),
            intensity=lambda: light_of(sun, x, y)(slice(None)).mean(dim=1, keepdim=True),
        )

    def _sun(self, params: SunGlareParams, image: Tensor, px_per_degree: float) -> Sun:
        """Return the sun of each frame; invalid values, which cannot be read on an accelerator, give no light."""
        rows, _, height, width = image.shape
        dtype = field_dtype(image.dtype)
        place = params.center[:, None] + params.frame[:, :, None] * params.drift[:, None]
        place = finite_or(place.to(dtype), -_FARTHEST).clamp(-_FARTHEST, _FARTHEST).reshape(-1, 2)
        size = as_device_tensor((width, height), dtype=dtype, device=place.device)
        inset = (torch.minimum(place, 1 - place) * size).amin(dim=1) / px_per_degree
        seen = (0.5 + inset / (2 * SUN_RADIUS)).clamp(0, 1)[:, None, None]  # share of the disk in the frame

        def expanded(value: Tensor, low: float, high: float) -> Tensor:
            return expand_batch(bounded(value.to(dtype), low, high), rows)

        ghosts = [expanded(params.ghosts[..., i], *span) for i, span in enumerate(_GHOST_LIMITS.values())]
        return Sun(
            place * size - 0.5,
            expanded(params.luminance, 0.0, _BRIGHTEST),
            expanded(params.scatter, 0.0, 1.0),
            expanded(params.scale, *_SCALES),
            expanded(params.shape, *_SHAPES),
            expanded(params.color, 0.0, _BRIGHTEST),
            torch.stack(ghosts, dim=-1),
            expanded(params.tints, 0.0, _BRIGHTEST) * seen,
        )


def _check_place(name: str, value: Range) -> Range:
    return check_range(name, value, low=-_FARTHEST, high=_FARTHEST)
