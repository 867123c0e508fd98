"""A frame of a calibrated camera as a pinhole would have shown it."""

import warnings
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import eager_bool
from torchrefract.cameras.models import Camera
from torchrefract.effects.base import params_to
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.lens import check_lens, in_px
from torchrefract.effects.plan import TOLERANCE_PX, Plan, PlanRequest
from torchrefract.effects.rectification_plan import rectification_plan
from torchrefract.fields.lens import lens_flow, lens_restore_flow
from torchrefract.fields.rectifying import rectification_flow, rectification_restore_flow, shows_folded
from torchrefract.types import Degraded
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.lattice import Lattice, LatticeFlow

_LARGEST = 1e30  # coefficient; those of a ratio may be large without making a large number
_CLOSE = 1e-5  # of each number, its rounding


class RectificationParams(NamedTuple):
    """The camera, for each sample."""

    applied: Tensor  # (B,), bool: the sample is rectified
    coefficients: Tensor  # (B, n), of `Rectification.model`
    focal: Tensor  # (B, 2), in widths of the frame: fx / W and fy / W
    center: Tensor  # (B, 2), in widths: the principal point's offset from the center of the frame

    to = params_to


class Rectification(LatticeWarp):
    """The distortion of a calibrated camera, of any model, taken out of its frames, which keep focal length and size.

        flow(p) = f (distort((p - c) / f) - (p - c) / f)

    `flow` distorts (closed form), `restore_flow` undistorts (the exact inverse): it is `LensDistortion` the other way
    round. In front of other warps in a `Compose` it joins their look-up, so that frames are degraded as rectified ones
    without being blurred by a look-up of their own:

        scene = Compose([Rectification(camera), LensDistortion()])
        d = scene.degrade(raw)                        # d.image from the raw frame, in one look-up
        clean = scene.effects[0](raw)                 # what a network should restore
        scene.effects[1].restore_flow(d.params.children[1], height=h, width=w)  # leads from d.image to clean

    while d.restore_flow leads back to the raw frame. Pixels whose ray the camera does not show are padded, not valid.

    Args:
        camera: of the frames, which may have another size with the same ratio of the sides.
        padding, interpolation, backend, tolerance_px, p: as for every warp.

    Raises:
        ValueError: a camera with a pole inside its frame (`Camera.check_pole`); frames of another shape than the
            camera's.

    Warns:
        UserWarning: the model folds back inside the frame (on the CPU): pixels beyond are padded, not valid.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        if not isinstance(camera, Camera):
            raise TypeError(f"camera must be a Camera, got {type(camera).__name__}")
        camera.check_pole()
        self.camera = camera

    params_type = RectificationParams

    @property
    def model(self) -> str:
        """Of the coefficients among the parameters: that of the camera, or "polynomial12" where that is the same."""
        return "polynomial12" if self.camera.is_polynomial else self.camera.model

    def draw(self, source: random.Stream, image: Tensor) -> RectificationParams:
        """The camera for every sample; only the gate is drawn."""
        applied = random.uniform(source, 1)[:, 0] < self.p
        dtype, count = field_dtype(image.dtype), image.shape[0]
        values = (as_device_tensor([n], dtype=dtype, device=image.device).repeat(count, 1) for n in self._numbers())
        return RectificationParams(applied, *values)

    def check(self, params: RectificationParams, image: Tensor) -> None:
        """Raise for cameras that are none."""
        if self.model == "polynomial12":
            check_lens(params, image.shape[0])
        else:
            what = f"of the model {self.model}"
            check_lens(params, image.shape[0], count=len(self.camera.coefficients), what=what, bound=_LARGEST)

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan of `rectification_plan`."""
        return rectification_plan(self.camera, ask)

    def params_in_range(self, params: RectificationParams, height: int, width: int) -> Tensor:
        """Whether the cameras are the one that is known, but for rounding."""
        found = torch.cat(params[1:], dim=1)
        known = as_device_tensor([n for row in self._numbers() for n in row], dtype=found.dtype, device=found.device)
        return ((found - known).abs() <= _CLOSE * known.abs()).all()

    def on_lattice(self, params: RectificationParams, plan: Plan) -> LatticeFlow:
        """The flow of `rectification_flow` at the nodes."""
        lattice = cast(Lattice, plan.lattice)
        height, width = lattice.height, lattice.width
        axes = lattice.places(dtype=params.focal.dtype, device=params.focal.device)
        camera = in_px(params, height, width)
        nodes, _ = rectification_flow(*camera, model=self.model, height=height, width=width, axes=axes)
        return LatticeFlow(nodes, lattice)

    def compute(self, image: Tensor, params: RectificationParams, depth: Tensor | None) -> Degraded:
        """The batch looked up along the flow; a camera that folds is told."""
        height, width = image.shape[2:]
        if self.plan_for(params, height, width).stride == 1:  # no other plan has a camera that folds
            self._tell_folds(params, height, width)
        return super().compute(image, params, depth)

    def flow(self, params: RectificationParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow of `rectification_flow`, and where it exists."""
        self.camera.resized(width=width, height=height)  # raises for another shape
        camera = in_px(params, height, width)
        if self.model == "polynomial12":  # the same, without what other models need
            return lens_restore_flow(*camera, height=height, width=width)
        return rectification_flow(*camera, model=self.model, height=height, width=width)

    def undo(self, params: RectificationParams, flow: Tensor) -> tuple[Tensor, Tensor]:
        """The flow of `rectification_restore_flow`, and where it exists."""
        height, width = flow.shape[2:]
        camera = in_px(params, height, width)
        if self.model == "polynomial12":
            return lens_flow(*camera, height=height, width=width)
        return rectification_restore_flow(*camera, model=self.model, height=height, width=width)

    def moves(self, params: RectificationParams) -> Tensor:
        """The samples with a coefficient that is not zero, or of a fisheye."""
        if self.model == "fisheye":  # whose radius is an angle
            return torch.ones_like(params.applied)
        return (params.coefficients != 0).any(dim=1)

    def _numbers(self) -> tuple[tuple[float, ...], ...]:
        """Coefficients, and in widths focal lengths and the principal point's offset from the center of the frame."""
        camera = self.camera
        width, middle = camera.width, ((camera.width - 1) / 2, (camera.height - 1) / 2)
        return (
            camera.polynomial() if camera.is_polynomial else camera.coefficients,
            (camera.fx / width, camera.fy / width),
            ((camera.cx - middle[0]) / width, (camera.cy - middle[1]) / width),
        )

    def _tell_folds(self, params: RectificationParams, height: int, width: int) -> None:
        def folds() -> Tensor:
            camera = in_px(params, height, width)
            return (params.applied & shows_folded(*camera, model=self.model, height=height, width=width)).any()

        if eager_bool(folds, of=params.applied):
            warnings.warn(
                "camera: the model folds back inside the frame: pixels beyond are padded, not valid", stacklevel=3
            )
