"""A frame of a calibrated camera as a pinhole would have shown it."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, assume_constant_result
from torchrefract._validation import check_choice, check_within, eager_values, warn
from torchrefract.cameras.camera import Camera
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.lens import check_lens, lens_in_px
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.filled_frame import points_without_zoom, zoomed_flow
from torchrefract.fields.lens import lens_flow, lens_restore_flow
from torchrefract.fields.rectification import (
    RectificationErrorModel,
    is_border_missing,
    rectification_flow,
    rectification_restore_flow,
    zoom_to_crop,
)
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.warping.grid import Points, field_dtype
from torchrefract.warping.lattice import pixel_lattice

_LARGEST_COEFFICIENT = 1e30  # those of a ratio may be large without a large result


class RectificationParams(NamedTuple):
    """The camera, for each sample."""

    applied: Tensor  # (B,), bool: the sample is rectified
    coefficients: Tensor  # (B, n), of `Rectification.model`
    focal: Tensor  # (B, 2), in widths of the frame: fx / W and fy / W
    center: Tensor  # (B, 2), in widths: the principal point's offset from the center of the frame
    zoom: Tensor | None = None  # (B,), above 0: focal length of the rectified frame over that of the camera; None is 1

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: all coefficients are zero; never so for a fisheye, which has 4 of them."""
        # The radius of a fisheye is an angle, so that it distorts without any coefficient too.
        is_fisheye = self.coefficients.shape[1] == 4
        is_pinhole = (self.coefficients == 0).all(dim=1) & (not is_fisheye)
        return is_pinhole if self.zoom is None else is_pinhole & (self.zoom == 1)


class Rectification(WarpEffect):
    """Remove the distortion of a calibrated camera from its frames, which keep their size.

        flow(p) = f (distort((p - c) / f) - (p - c) / f)

    `flow` distorts (closed form), `restore_flow` undistorts (the exact inverse): it is `LensDistortion` in the other
    direction. Before other warps in a `Compose` it shares their sampling, so that raw frames are degraded like
    rectified ones without being blurred twice:

        scene = Compose([Rectification(camera), LensDistortion()])
        d = scene.degrade(raw)  # d.image from the raw frame, sampled once
        clean = scene.effects[0](raw)  # what a network should restore

    `d.restore_flow` then leads back to the raw frame. Pixels whose ray the camera does not show are padded, not valid.
    Pincushion lenses leave such pixels along the border; `frame="crop"` multiplies the focal length by the smallest
    zoom with which there are none, see `clean_camera`.

    Args:
        camera: of the frames, which may have another size with the same ratio of the sides.
        frame: "pad" keeps the focal length, "crop" keeps valid pixels only.
        padding, interpolation, backend, tolerance_px, p: as for every warp.

    Raises:
        ValueError: a camera with a pole inside its frame (`Camera.check_pole`); frames with another ratio of the sides
            than those of the camera.

    Warns:
        UserWarning: the model folds back inside the frame (on the CPU): pixels beyond are padded, not valid.
    """

    params_type = RectificationParams
    has_closed_form = True
    rounding_ulps = 16  # Newton's method magnifies the rounding of positions

    def __init__(
        self,
        camera: Camera,
        *,
        frame: str = "pad",
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
        self.frame = check_choice("frame", frame, ("pad", "crop"))

    @property
    def model(self) -> str:
        """Return the model of the coefficients in the parameters: "polynomial12" wherever it is the same."""
        return "polynomial12" if self.camera.is_polynomial else self.camera.model

    def sample_params(self, stream: random.Stream, image: Tensor) -> RectificationParams:
        """Return the camera for every sample; only `applied` is drawn."""
        applied = random.uniform(stream, 1)[:, 0] < self.p
        dtype, count = field_dtype(image.dtype), image.shape[0]
        rows = (as_device_tensor([row], dtype=dtype, device=image.device).repeat(count, 1) for row in self._numbers())
        params = RectificationParams(applied, *rows)
        return params._replace(zoom=self._zoom(params, *image.shape[2:]))

    def validate(self, params: RectificationParams, image: Tensor) -> None:
        """Raise ValueError for invalid cameras."""
        if params.zoom is not None:
            check_shapes(params, {"zoom": ()})
            check_within("params.zoom", params.zoom, 1e-2, 1e2)
        if self.model == "polynomial12":
            check_lens(params, image.shape[0])
            return
        model, count = f"of the model {self.model}", len(self.camera.coefficients)
        check_lens(params, image.shape[0], count=count, model=model, bound=_LARGEST_COEFFICIENT)

    def flow(self, params: RectificationParams, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Distort the points, in closed form."""
        height, width = points.lattice.height, points.lattice.width
        self.camera.resized(width=width, height=height)  # raises for another ratio of the sides
        camera = lens_in_px(params, height, width)
        rays = points if params.zoom is None else points_without_zoom(points, camera[2], params.zoom)
        if self.model == "polynomial12":
            flow, exists = lens_restore_flow(*camera, rays)
        else:
            flow, exists = rectification_flow(*camera, rays, model=self.model)
        if params.zoom is not None:
            flow = flow + torch.cat([rays.x - points.x, rays.y - points.y], dim=1)

        def folds() -> Tensor:
            is_missing = is_border_missing(*camera, model=self.model, height=height, width=width)
            return (params.applied & is_missing).any()

        is_suspect = points.lattice.stride == 1 and eager_values(exists.all, of=exists) is False
        if is_suspect and eager_values(folds, of=params.applied):
            warn("camera: the model folds back inside the frame: pixels beyond are padded, not valid")
        return flow, exists

    def inverse_flow(self, params: RectificationParams, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Undistort the pixels."""
        height, width = flow.shape[2:]
        camera = lens_in_px(params, height, width)
        points = pixel_lattice(height, width).points(dtype=params.focal.dtype, device=params.focal.device)
        if self.model == "polynomial12":
            inverse, exists = lens_flow(*camera, points)
        else:
            inverse, exists = rectification_restore_flow(*camera, points, model=self.model)
        if params.zoom is not None:
            inverse = zoomed_flow(inverse, points, camera[2], params.zoom)
        return inverse, exists

    def error_model(self) -> RectificationErrorModel:
        """Return the error bounds of the camera."""
        numbers = tuple(number for row in self._numbers() for number in row)
        return RectificationErrorModel(self.camera, numbers, crops=self.frame == "crop")

    def for_params(self, params: RectificationParams, height: int, width: int) -> WarpEffect:
        """Return this effect, or an exact one if the plan does not hold for the cameras, or for their zoom."""
        effect, zoom = super().for_params(params, height, width), params.zoom
        if zoom is None or self.tolerance_px is None:
            return effect
        is_same = eager_values(((zoom - self._zoom(params, height, width)).abs() <= 1e-3).all, of=zoom)
        return effect.exact() if is_same is False else effect

    def clean_camera(self, height: int, width: int) -> Camera:
        """Return the pinhole of the rectified frames of a size."""
        camera = self.camera.resized(width=width, height=height)
        return camera.without_lens(zoom=self._constant_zoom(id(self), height, width))

    def _zoom(self, params: RectificationParams, height: int, width: int) -> Tensor:
        return torch.full_like(params.focal[:, 0], self._constant_zoom(id(self), height, width))

    # torch.compile takes the zoom as a constant, see `WarpEffect`.
    @assume_constant_result
    def _constant_zoom(self, _: int, height: int, width: int) -> float:
        return zoom_to_crop(self.camera.resized(width=width, height=height)) if self.frame == "crop" else 1.0

    def _numbers(self) -> tuple[tuple[float, ...], ...]:
        """Return the coefficients, and in widths the focal lengths and the offset of the principal point."""
        camera = self.camera
        width, middle = camera.width, ((camera.width - 1) / 2, (camera.height - 1) / 2)
        return (
            camera.polynomial() if camera.is_polynomial else camera.coefficients,
            (camera.fx / width, camera.fy / width),
            ((camera.cx - middle[0]) / width, (camera.cy - middle[1]) / width),
        )
