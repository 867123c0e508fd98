"""The colored edges towards the corners of a frame."""

from typing import NamedTuple

from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import bounded, check_choice, check_range, check_within
from torchrefract.cameras.camera import Camera, check_camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.fields.chromatic_aberration import scale_about, shift_colors
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype, inside

_LARGEST_SCALE = 0.1
_INTERPOLATIONS = ("bilinear", "bicubic")


class ChromaticAberrationParams(NamedTuple):
    """The lateral chromatic aberration of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    scale: Tensor  # (B, 2), of the first and of the last channel against the others, relative

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: all channels have one size."""
        return (self.scale == 0).all(dim=1)


class ChromaticAberration(PhotometricEffect):
    """Lateral chromatic aberration: red and blue are a little larger or smaller than green, about the principal point.

        I_red(c + (1 + s_red) (p - c)) = I_clean_red(p),  likewise for blue;  I_green = I_clean_green

    The first channel takes the scale of red, the last one that of blue, and the others stay; an image of one channel
    does not change. Labels and the flow are those of green, so the effect moves nothing. `valid` are the pixels whose
    colors all lie in the clean frame; the others show its border.

    Args:
        red_range, blue_range: s, relative, within [-0.1, 0.1]; 0.001 shifts the corner of a frame of 1920 px by 1.1 px.
        camera: of the frames, whose principal point counts; None is the center of the frame.
        interpolation: "bilinear" or "bicubic".
        tolerance: has no effect, since all of it is computed.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range.

    Source: Mallon and Whelan, "Calibration and removal of lateral chromatic aberration in images", Pattern Recognition
    Letters 28 (2007), of whose terms the linear one.
    """

    params_type = ChromaticAberrationParams
    maps = ()

    def __init__(
        self,
        *,
        red_range: Range = (-0.0015, 0.0015),
        blue_range: Range = (-0.0015, 0.0015),
        camera: Camera | None = None,
        interpolation: str = "bilinear",
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.red_range = check_range("red_range", red_range, low=-_LARGEST_SCALE, high=_LARGEST_SCALE)
        self.blue_range = check_range("blue_range", blue_range, low=-_LARGEST_SCALE, high=_LARGEST_SCALE)
        self.camera = check_camera(camera)
        self.interpolation = check_choice("interpolation", interpolation, _INTERPOLATIONS)

    def sample_params(self, stream: random.Stream, image: Tensor) -> ChromaticAberrationParams:
        """Draw both scales uniformly in their ranges."""
        return ChromaticAberrationParams(*self.draw_in_ranges(stream, [self.red_range, self.blue_range], image))

    def validate(self, params: ChromaticAberrationParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, {"scale": (2,)})
        check_within("params.scale", params.scale, -_LARGEST_SCALE, _LARGEST_SCALE)

    def render(self, image: Tensor, params: ChromaticAberrationParams, depth: Tensor | None) -> Rendered:
        """Scale the first and the last channel of images."""
        height, width = image.shape[2:]
        scale = bounded(params.scale.to(field_dtype(image.dtype)), -_LARGEST_SCALE, _LARGEST_SCALE)
        center = pinhole_of(self.camera, height=height, width=width).center
        red, blue = (
            scale_about(each, center, height=height, width=width) for each in expand_batch(scale, len(image)).unbind(1)
        )
        shifted = shift_colors(image, red, blue, interpolation=self.interpolation)
        return Rendered(shifted, lambda: inside(red.dense()) & inside(blue.dense()))
