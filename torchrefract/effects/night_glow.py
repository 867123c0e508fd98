"""Glow around lamps in fog at night."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import bounded, check_number, check_within
from torchrefract.cameras.camera import Camera, check_camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.exposure import is_unsaturated
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.fields.exposure import finite_image, map_rows
from torchrefract.fields.night_glow import glow_at_nodes, lamp_light, lattice_stride, spread_glow
from torchrefract.fields.sky import is_day
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_LIMITS = {"optical_depth": (0.0, 50.0), "asymmetry": (0.1, 1.0), "luminance": (0.0, 1e6)}


class NightGlowParams(NamedTuple):
    """The parameters of glow for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    optical_depth: Tensor  # (B,), T, extinction times the distance of the lamps, in [0, 50]
    asymmetry: Tensor  # (B,), g, mean cosine of the angle of scattering, in [0.1, 1]
    luminance: Tensor  # (B,), of a lamp of stored value 1, in [0, 1e6]; white is 1

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: nothing scatters, or there are no lamps."""
        return (self.optical_depth == 0) | (self.luminance == 0)


class NightGlow(PhotometricEffect):
    """Glow around lamps in fog, by forward scattering in linear light: I = clip(I_clean + v, 0, 1).

    v is the light that droplets scatter on its way from the lamps,
    L = luminance max(I - threshold, 0)^2 / (1 - threshold)^2, of each channel: a camera clips lamps, which are brighter
    than white by an unknown factor. The sum of v is (1 - exp(-T)) times that of L, so that the lamps lose as much light
    as the glow has. What remains of them, exp(-T) L, is above white, so lamps stay as they are. Light that would leave
    the frame is reflected at its border. See `torchrefract.fields.night_glow.glow_at_nodes` for its shape.

    All lamps of a frame have one optical depth T = k d. For lamps at d meters in a visibility of V meters, T is about
    3 d / V. In a composition with fog this effect comes first, as fog darkens the lamps; or last, if the fog has a
    `lamp_luminance`, so that the fog does not hide the glow. Frames by day, with a sky, see `sky_mask`, or a bright
    road seen from above, have no glow: their drawn luminance is 0. For a clip, its first frame counts.

    `intensity` is the mean of v over the channels; `valid` are the pixels that do not saturate.

    Args:
        optical_depth_range: T; 0 is clear air.
        asymmetry_range: g, mean cosine of the angle by which a droplet scatters light, in [0.1, 1]: some 0.9 in fog,
            less in haze. The glow is about (1 - g) / sqrt(g) radians wide.
        luminance_range: of a lamp of stored value 1; white is 1.
        threshold: stored value in [0, 0.999], above which a pixel counts as a lamp; cameras show lamps from 0.9 on.
            White paint in the light of headlamps may exceed it.
        camera: of the frames, whose pinhole counts; None is a centered one with a focal length of 0.9 widths.
        tolerance: all of the effect is computed under any tolerance.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range.
        TypeError: a camera of another type.

    Source: Narasimhan and Nayar, "Shedding light on the weather", CVPR 2003; Wells, "Loss of resolution in water as a
    result of multiple small-angle scattering", Journal of the Optical Society of America 59 (1969).
    """

    params_type = NightGlowParams
    maps = ("intensity",)

    def __init__(
        self,
        *,
        optical_depth_range: Range = (0.5, 2.0),
        asymmetry_range: Range = (0.88, 0.95),
        luminance_range: Range = (10.0, 40.0),
        threshold: float = 0.85,
        camera: Camera | None = None,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        ranges = {"optical_depth": optical_depth_range, "asymmetry": asymmetry_range, "luminance": luminance_range}
        self._set_ranges(ranges, _LIMITS)
        self.threshold = check_number("threshold", threshold, low=0.0, high=0.999)
        self.camera = check_camera(camera)

    def sample_params(self, stream: random.Stream, image: Tensor) -> NightGlowParams:
        """Draw all parameters uniformly in their ranges; frames by day have lamps without light."""
        applied, values = self.draw_in_ranges(stream, [self._range(name) for name in _LIMITS], image)
        luminance = torch.where(is_day(image), 0.0, values[:, 2])
        return NightGlowParams(applied, values[:, 0], values[:, 1], luminance)

    def validate(self, params: NightGlowParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, dict.fromkeys(_LIMITS, ()))
        for name, limits in _LIMITS.items():
            check_within(f"params.{name}", getattr(params, name), *limits)

    def render(self, image: Tensor, params: NightGlowParams, depth: Tensor | None) -> Rendered:
        """Add glow to images."""
        image = image.contiguous()  # the rounding of a sum depends on the memory format
        height, width = image.shape[2:]
        focal = pinhole_of(self.camera, height=height, width=width).focal[0]
        stride = lattice_stride(image)

        dtype = field_dtype(image.dtype)
        thickness, asymmetry, luminance = (
            expand_batch(bounded(getattr(params, name).to(dtype), *limits), len(image))
            for name, limits in _LIMITS.items()
        )
        light = lamp_light(image, self.threshold)
        nodes = glow_at_nodes(light, thickness, asymmetry, focal=focal, stride=stride)
        strength = -torch.expm1(-thickness) * luminance
        glow_at = spread_glow(nodes, light, strength, height=height, width=width, stride=stride)

        def of_rows(band: Tensor, rows: slice, out: Tensor | None) -> Tensor:
            # Not in place: under vmap only the glow may have a batch.
            lit = srgb_to_linear(finite_image(band)) + glow_at(rows)
            return torch.clamp(linear_to_srgb(lit), 0, 1, out=out)

        return Rendered(
            map_rows(of_rows, image, (nodes, strength)),
            lambda: is_unsaturated(image, srgb_to_linear(finite_image(image)) + glow_at(slice(None))),
            intensity=lambda: glow_at(slice(None)).mean(dim=1, keepdim=True),
        )
