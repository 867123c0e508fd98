"""The dark corners of a frame."""

from typing import NamedTuple

from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import bounded, check_flag, check_range, check_within
from torchrefract.cameras.camera import Camera, check_camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear
from torchrefract.fields.vignetting import vignetting
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

_MIN_TRANSMISSION = 1 / 255  # of what 8 bits can recover


class VignettingParams(NamedTuple):
    """The parameters of vignetting for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    strength: Tensor  # (B,), s in [0, 1]; 1 is the cos^4 law

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the strength is 0."""
        return self.strength == 0


class Vignetting(PhotometricEffect):
    """Natural vignetting: a lens shows less light towards the corners.

        I = I_clean t,  t = 1 - s (1 - cos^4 a),  tan^2 a = ((x - cx) / fx)^2 + ((y - cy) / fy)^2

    `transmission` is t, and `valid` is t >= 1/255.

    Args:
        strength_range: s, in [0, 1]; 1 is the cos^4 law, 0 a lens, or a camera's software, that compensates for it.
        camera: of the frames, whose pinhole counts; None is a centered one with a focal length of 0.9 widths.
        linear_light: darken linear light, as a lens does; False darkens stored values (sRGB), which is stronger.
        tolerance: has no effect, since all of it is computed.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range.

    Source: Reiss, "The cos^4 law of illumination", Journal of the Optical Society of America 35 (1945).
    """

    params_type = VignettingParams
    maps = ("transmission",)

    def __init__(
        self,
        *,
        strength_range: Range = (0.5, 1.0),
        camera: Camera | None = None,
        linear_light: bool = True,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.strength_range = check_range("strength_range", strength_range, low=0.0, high=1.0)
        self.camera = check_camera(camera)
        self.linear_light = check_flag("linear_light", linear_light)

    def sample_params(self, stream: random.Stream, image: Tensor) -> VignettingParams:
        """Draw the strength uniformly in its range."""
        applied, values = self.draw_in_ranges(stream, [self.strength_range], image)
        return VignettingParams(applied, values[:, 0])

    def validate(self, params: VignettingParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, {"strength": ()})
        check_within("params.strength", params.strength, 0.0, 1.0)

    def render(self, image: Tensor, params: VignettingParams, depth: Tensor | None) -> Rendered:
        """Darken images."""
        height, width = image.shape[2:]
        strength = bounded(params.strength.to(field_dtype(image.dtype)), 0.0, 1.0)
        view = pinhole_of(self.camera, height=height, width=width)
        t = vignetting(expand_batch(strength, len(image)), view, height=height, width=width)
        # Powers are rounded by the place of a value in memory, so that all layouts are computed in one.
        darkened = linear_to_srgb(srgb_to_linear(image.contiguous()) * t) if self.linear_light else image * t
        return Rendered(darkened, lambda: t >= _MIN_TRANSMISSION, transmission=t)
