"""A frame of a calibrated camera as a pinhole would have shown it."""

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import draws
from torchrefract._checks import is_true
from torchrefract.cameras.models import Camera
from torchrefract.effects.base import params_to
from torchrefract.effects.lens import check_lens, in_px
from torchrefract.effects.refraction import WarpEffect
from torchrefract.fields.lens import lens_flow, lens_restore_flow, shows_folded
from torchrefract.types import Degraded
from torchrefract.warping.grid import field_dtype


class RectificationParams(NamedTuple):
    """The camera, for each sample."""

    gate: Tensor  # (B,), bool: the sample is rectified
    coefficients: Tensor  # (B, 12): k1 ... k6, p1, p2, s1 ... s4
    focal: Tensor  # (B, 2), in widths of the frame: fx / W and fy / W
    center: Tensor  # (B, 2), in widths: the principal point's offset from the center of the frame

    to = params_to


class Rectification(WarpEffect):
    """The distortion of a calibrated camera taken out of its frames, which keep their focal length and size.

        flow(p) = f (distort((p - c) / f) - (p - c) / f)

    `flow` distorts (closed form), `restore_flow` undistorts (the exact inverse): it is `LensDistortion` the other way
    round. In front of other warps in a `Compose` it joins their look-up, so that frames are degraded as rectified ones
    without being blurred by a look-up of their own:

        scene = Compose([Rectification(camera), LensDistortion()])
        d = scene.degrade(raw)                        # d.image from the raw frame, in one look-up
        clean = scene.effects[0](raw)                 # what a network should restore
        scene.effects[1].restore_flow(d.params.children[1], height=h, width=w)  # leads from d.image to clean

    while d.restore_flow leads back to the raw frame.

    Args:
        camera: of the frames, which may have another size with the same ratio of the sides.
        padding, interpolation, resampler, p: as for every warp.

    Raises:
        ValueError: a camera whose distortion is no polynomial; frames of another shape than the camera's.

    Warns:
        UserWarning: the model folds back inside the frame (on the CPU): pixels beyond are padded, not valid.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        padding: str = "zeros",
        interpolation: str = "bilinear",
        resampler: str = "auto",
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, resampler=resampler, p=p)
        if not isinstance(camera, Camera):
            raise TypeError(f"camera must be a Camera, got {type(camera).__name__}")
        camera.polynomial()
        self.camera = camera

    params_type = RectificationParams

    def draw(self, source: draws.Stream, image: Tensor) -> RectificationParams:
        """The camera for every sample; only the gate is drawn."""
        camera = self.camera
        middle = (camera.width - 1) / 2, (camera.height - 1) / 2
        numbers = (
            camera.polynomial(),
            (camera.fx / camera.width, camera.fy / camera.width),
            ((camera.cx - middle[0]) / camera.width, (camera.cy - middle[1]) / camera.width),
        )
        gate = draws.uniform(source, 1)[:, 0] < self.p
        dtype, count = field_dtype(image.dtype), image.shape[0]
        values = (torch.tensor([n], dtype=dtype, device=image.device).repeat(count, 1) for n in numbers)
        return RectificationParams(gate, *values)

    def check(self, params: RectificationParams, image: Tensor) -> None:
        """Raise for cameras that are none."""
        check_lens(params, image.shape[0])

    def compute(self, image: Tensor, params: RectificationParams, depth: Tensor | None) -> Degraded:
        """The batch looked up along the flow; a camera that folds is told."""
        height, width = image.shape[2:]

        def folds() -> Tensor:
            camera = in_px(params, height, width)
            return (params.gate & shows_folded(*camera, height=height, width=width)).any()

        if is_true(folds):
            warnings.warn(
                "camera: the model folds back inside the frame: pixels beyond are padded, not valid", stacklevel=2
            )
        return super().compute(image, params, depth)

    def flow(self, params: RectificationParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow of `lens_restore_flow`, and where it exists."""
        self.camera.resized(width=width, height=height)  # raises for another shape
        return lens_restore_flow(*in_px(params, height, width), height=height, width=width)

    def undo(self, params: RectificationParams, flow: Tensor) -> tuple[Tensor, Tensor]:
        """The flow of `lens_flow`, and where it exists."""
        height, width = flow.shape[2:]
        return lens_flow(*in_px(params, height, width), height=height, width=width)

    def moves(self, params: RectificationParams) -> Tensor:
        """The samples with a coefficient that is not zero."""
        return (params.coefficients != 0).any(dim=1)
