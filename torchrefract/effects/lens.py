"""The lens of a cheap dashcam."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import (
    check_choice,
    check_flag,
    check_range,
    check_values,
    check_within,
    eager_values,
    requires_grad,
    warn,
)
from torchrefract.cameras.brown_conrady import ALL_TERMS, POLYNOMIAL12, used_terms
from torchrefract.cameras.camera import Camera
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.filled_frame import points_without_zoom, zoom_to_fill, zoomed_flow
from torchrefract.fields.lens import lens_flow, lens_restore_flow, misses_in_frame, newton_lens_flow
from torchrefract.fields.lens_error import LensErrorModel, LensRanges
from torchrefract.fields.lens_source import LensSource, camera_with_covariance, lenses_from_cameras, ranges_around
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import Range
from torchrefract.warping.grid import Points
from torchrefract.warping.lattice import pixel_lattice

_LARGEST_COEFFICIENT = 100.0
_FARTHEST = 1e10  # widths
_SMALLEST_ZOOM = 1e-6
_SAME_VIEW = 1e-3  # difference of zooms and of shifts, in widths
FRAMES = ("fill", "pad")
_MODEL = "k1 ... k6, p1, p2, s1 ... s4 of the polynomial model (OpenCV's vectors are another model in another order)"


class LensParams(NamedTuple):
    """The lenses of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    coefficients: Tensor  # (B, 12): k1 ... k6, p1, p2, s1 ... s4
    focal: Tensor  # (B, 2), in widths of the frame: fx / W and fy / W
    center: Tensor  # (B, 2), in widths: the principal point's offset from the center of the frame
    # The pinhole of the clean frame, if it is not that of the lens:
    zoom: Tensor | None = None  # (B,), in [1e-6, 1]: its focal length over that of the lens
    shift: Tensor | None = None  # (B, 2), in widths: its principal point minus that of the lens

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: all coefficients are zero, and the clean view is that of the lens."""
        zoom, shift = clean_view(self)
        return (self.coefficients == 0).all(dim=1) & (zoom == 1) & (shift == 0).all(dim=1)


class LensDistortion(WarpEffect):
    """A frame as seen through a lens of the extended Brown-Conrady model, the polynomial of the paper.

        x_d = x (1 + sum k_i r^2i) + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_d = y (1 + sum k_i r^2i) + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,  i = 1 ... 6

    `flow` undistorts (the exact inverse), `restore_flow` distorts (closed form). Pixels beyond the radius where the
    model folds back show nothing: they are padded and not valid.

    A barrel lens sees more than a pinhole with its focal length. With `frame="fill"` the clean frame is a wider view:
    for each sample the smallest zoom and shift are found with which no pixel of the degraded frame looks outside of it.
    Both are part of the parameters and of both flows, see `clean_cameras`. With `frame="pad"` the clean frame keeps the
    focal length, and the pixels that look outside of it are padded and not valid.

    OpenCV's k4, k5, k6 belong to another model. The defaults are those of a fleet of cheap dashcams: barrel lenses that
    fold nowhere. Under a tolerance each drawn lens has a lattice of its own where values can be read (on the CPU,
    without `torch.compile` and without gradients of the lens) and the frame has at least 2^16 px.

    Args:
        k1_range ... k6_range: radial coefficients, each within [-100, 100].
        p1_range, p2_range: decentering (tangential) coefficients.
        s1_range ... s4_range: thin-prism coefficients; s1, s2 act on x, s3, s4 on y.
        focal_range: focal length fx in widths of the frame, above 0.
        aspect_range: fy / fx, above 0.
        center_x_range, center_y_range: offset of the principal point from the center of the frame, in widths.
        strict: raise, instead of warning, if the model folds back inside the frame (on the CPU).
        frame: "fill" or "pad".
        padding, interpolation, backend, tolerance_px, p: as for every warp.

    Raises:
        ValueError: an argument outside its range; a lens that folds inside the frame, if `strict`.

    Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37 (1971), with thin-prism terms.
    """

    params_type = LensParams
    has_closed_form = True
    rounding_ulps = 40  # next to a fold, as far as points count as having a preimage

    def __init__(
        self,
        *,
        k1_range: Range = (-0.35, -0.15),
        k2_range: Range = (0.06, 0.12),
        k3_range: Range = (0.0, 0.0),
        k4_range: Range = (0.0, 0.0),
        k5_range: Range = (0.0, 0.0),
        k6_range: Range = (0.0, 0.0),
        p1_range: Range = (-0.001, 0.001),
        p2_range: Range = (-0.001, 0.001),
        s1_range: Range = (0.0, 0.0),
        s2_range: Range = (0.0, 0.0),
        s3_range: Range = (0.0, 0.0),
        s4_range: Range = (0.0, 0.0),
        focal_range: Range = (0.7, 1.1),
        aspect_range: Range = (1.0, 1.0),
        center_x_range: Range = (-0.01, 0.01),
        center_y_range: Range = (-0.01, 0.01),
        strict: bool = False,
        frame: str = "fill",
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        radial = (k1_range, k2_range, k3_range, k4_range, k5_range, k6_range)
        others = (p1_range, p2_range, s1_range, s2_range, s3_range, s4_range)
        bounds: dict[str, Range] = dict.fromkeys(POLYNOMIAL12, (-_LARGEST_COEFFICIENT, _LARGEST_COEFFICIENT))
        self._set_ranges(dict(zip(POLYNOMIAL12, radial + others, strict=True)), bounds)
        self.focal_range = check_range("focal_range", focal_range, low=0.01, high=1000.0)
        self.aspect_range = check_range("aspect_range", aspect_range, low=0.01, high=100.0)
        self.center_x_range = check_range("center_x_range", center_x_range, low=-10.0, high=10.0)
        self.center_y_range = check_range("center_y_range", center_y_range, low=-10.0, high=10.0)
        self.strict = check_flag("strict", strict)
        self.frame = check_choice("frame", frame, FRAMES)
        self._source: LensSource | None = None

    @classmethod
    def from_camera(
        cls,
        camera: Camera,
        *,
        jitter: float = 0.0,
        covariance: Any = None,
        residual_px: float = 0.5,
        strict: bool = False,
        frame: str = "fill",
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ) -> "LensDistortion":
        """Build the effect of a calibrated camera, or of cameras near it.

        Args:
            camera: of any model; another model than the polynomial is replaced by the nearest polynomial.
            jitter: largest relative change of each number, drawn uniformly, in [0, 0.99]: focal length, aspect, offset
                of the principal point, and each coefficient.
            covariance: (4 + n, 4 + n), of fx, fy, cx, cy in px and n coefficients, in place of `jitter`: the numbers
                vary together.
            residual_px: largest distance between the camera and its polynomial, px.
            strict, frame, padding, interpolation, backend, tolerance_px, p: as for `LensDistortion`.

        Raises:
            ValueError: a number out of range; a camera too far from a polynomial, or that folds inside its frame.
        """
        warp = {"padding": padding, "interpolation": interpolation, "backend": backend, "p": p, "frame": frame}
        if covariance is None:
            ranges = ranges_around(camera, jitter=jitter, residual_px=residual_px)
            return cls(**ranges, strict=strict, tolerance_px=tolerance_px, **warp)
        if jitter:
            raise ValueError(f"jitter must be 0 if a covariance is given, got {jitter}")
        source = camera_with_covariance(camera, covariance, residual_px=residual_px)
        return cls._from_source(source, strict=strict, tolerance_px=tolerance_px, **warp)

    @classmethod
    def from_lenses(
        cls,
        table: Sequence[Camera] | None = None,
        *,
        residual_px: float = 0.5,
        strict: bool = False,
        frame: str = "fill",
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ) -> "LensDistortion":
        """Build an effect that draws one of several real lenses for each sample, each with the same probability.

        Args:
            table: their cameras; None takes the lens database of the package (`torchrefract.cameras.read_lenses`).
            residual_px: largest distance between a camera of another model and its polynomial, px; lenses of the
                database that are farther off are left out, others raise.
            strict, frame, padding, interpolation, backend, tolerance_px, p: as for `LensDistortion`.

        Raises:
            ValueError: an empty table; a camera too far from a polynomial, or that folds inside its frame.
        """
        warp = {"padding": padding, "interpolation": interpolation, "backend": backend, "p": p, "frame": frame}
        source = lenses_from_cameras(table, residual_px=residual_px)
        return cls._from_source(source, strict=strict, tolerance_px=tolerance_px, **warp)

    @classmethod
    def _from_source(cls, source: LensSource, **arguments: Any) -> "LensDistortion":
        effect = cls(**source.ranges, **arguments)
        effect._source = source
        return effect

    def sample_params(self, stream: random.Stream, image: Tensor) -> LensParams:
        """Draw one lens for each sample: all numbers uniform in their ranges, or a lens of the source."""
        if self._source is None:
            applied, values = self.draw_in_ranges(stream, self._ranges().numbers, image)
        else:
            applied, values = self.draw_in_ranges(stream, self._source.draw_ranges, image)
            values = self._source.select(values)
        coefficients, pinhole, center = values.split((len(POLYNOMIAL12), 2, 2), dim=1)
        fx, aspect = pinhole.unbind(1)
        params = LensParams(applied, coefficients, torch.stack([fx, fx * aspect], dim=1), center)
        zoom, shift = self._view(params, *image.shape[2:])
        return params._replace(zoom=zoom, shift=shift)

    def fill(self, params: LensParams, height: int, width: int) -> LensParams:
        """Return the same lenses with the zoom and the shift that leave no pixel of such frames without a source.

        Lenses that see no more than the pinhole, as pincushion lenses, keep a zoom of 1.
        """
        # The plan of the ranges says nothing of other lenses.
        effect = cast(LensDistortion, super().for_params(params, height, width))
        zoom, shift = effect._fit(params, height, width)
        return params._replace(zoom=zoom, shift=shift)

    def validate(self, params: LensParams, image: Tensor) -> None:
        """Raise ValueError for invalid lenses."""
        check_lens(params, image.shape[0])
        if (params.zoom is None) != (params.shift is None):
            raise ValueError("params.zoom and params.shift must be given both or not at all, got one of them")
        if params.zoom is not None and params.shift is not None:
            check_shapes(params, {"zoom": (), "shift": (2,)})
            check_within("params.zoom", params.zoom, _SMALLEST_ZOOM, 1.0)
            check_within("params.shift", params.shift, -_FARTHEST, _FARTHEST)

    def flow(self, params: LensParams, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Undistort the points, and lead on to the clean view."""
        height, width = points.lattice.height, points.lattice.width
        lens = lens_in_px(params, height, width)
        if plan.details is None:
            flow, exists = lens_flow(*lens, points)
            if points.lattice.stride == 1 and eager_values(exists.all, of=exists) is False:
                self._report_fold(params, exists, points)
        else:
            steps = plan.details.steps_for(points.lattice.stride)
            terms = ALL_TERMS if requires_grad(lens[:1]) else plan.details.terms
            flow, exists = newton_lens_flow(*lens, points, num_steps=steps, terms=terms), everywhere(points.x.device)
        zoom, shift = clean_view(params)
        return zoomed_flow(flow, points, lens[2], zoom, shift * width), exists

    def inverse_flow(self, params: LensParams, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Distort the pixels, in closed form."""
        height, width = flow.shape[2:]
        points = pixel_lattice(height, width).points(dtype=params.focal.dtype, device=params.focal.device)
        lens, (zoom, shift) = lens_in_px(params, height, width), clean_view(params)
        wide = points_without_zoom(points, lens[2], zoom, shift * width)
        inverse, exists = lens_restore_flow(*lens, wide)
        return inverse + torch.cat([wide.x - points.x, wide.y - points.y], dim=1), exists

    def error_model(self) -> LensErrorModel:
        """Return the error bounds of the ranges or of the source."""
        boxes = (self._ranges(),) if self._source is None else self._source.boxes
        return LensErrorModel(boxes, fills=self.frame == "fill")

    def for_params(self, params: LensParams, height: int, width: int) -> WarpEffect:
        """Return this effect, or an exact one if the plan does not hold for the lenses, or for their clean view."""
        effect = super().for_params(params, height, width)
        if params.zoom is None or params.shift is None or effect is not self or self.tolerance_px is None:
            return effect
        fits = self._view(params, height, width)
        difference = torch.cat([(params.zoom - fits[0])[:, None], params.shift - fits[1]], dim=1).abs()
        return effect.exact() if eager_values((difference <= _SAME_VIEW).all, of=difference) is False else effect

    def cameras(self, params: LensParams, *, height: int, width: int) -> list[Camera]:
        """Return the camera of each degraded frame; see `clean_cameras` for that of its clean frame.

        A sample that is not degraded has the pinhole of its clean frame. Reads values, which waits for an accelerator.

        Raises:
            ValueError: a lens that cannot be a `Camera`.
        """
        clean = self.clean_cameras(params, height=height, width=width)
        rows = zip(params.applied.tolist(), *map(Tensor.tolist, lens_in_px(params, height, width)), clean, strict=True)
        return [
            replace(view, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients)) if is_applied else view
            for is_applied, coefficients, (fx, fy), (cx, cy), view in rows
        ]

    def clean_cameras(self, params: LensParams, *, height: int, width: int) -> list[Camera]:
        """Return the pinhole of each clean frame: that of the lens, with its zoom and its shift."""
        (_, focal, center), (zoom, shift) = lens_in_px(params, height, width), clean_view(params)
        focal, center = focal * zoom[:, None], center + width * shift
        size: Any = {
            "width": width,
            "height": height,
            "coefficients": (0.0,) * len(POLYNOMIAL12),
            "model": "polynomial12",
        }
        return [
            Camera(fx=fx, fy=fy, cx=cx, cy=cy, **size)
            for (fx, fy), (cx, cy) in zip(focal.tolist(), center.tolist(), strict=True)
        ]

    def _view(self, params: LensParams, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Return the zoom and the shift of `frame`."""
        if self.frame == "fill":
            return self._fit(params, height, width)
        return torch.ones_like(params.focal[:, 0]), torch.zeros_like(params.center)

    def _fit(self, params: LensParams, height: int, width: int) -> tuple[Tensor, Tensor]:
        dtype = params.focal.dtype
        is_fixed = not (torch.is_grad_enabled() and requires_grad(params))
        details = self._constant_plan(id(self), height, width, dtype).details
        # torch.set_grad_enabled sets the mode twice, and torch.export.load cannot read the empty region in between.
        with torch.no_grad() if is_fixed else nullcontext():
            coefficients, focal, center = map(Tensor.double, lens_in_px(params, height, width))
            lens = coefficients, focal, center

            def position(points: Points) -> Tensor:
                pixels = torch.cat([points.x, points.y], dim=1)
                if details is not None and is_fixed:
                    # One more step than for the flow squares the error of its Newton steps.
                    steps = details.steps_for(1) + 1
                    return pixels + newton_lens_flow(*lens, points, num_steps=steps, terms=used_terms(coefficients))
                flow, exists = lens_flow(*lens, points)
                return torch.where(exists, pixels + flow, torch.nan)

            zoom, shift = zoom_to_fill(position, center, height=height, width=width)
        return zoom.to(dtype), (shift / width).to(dtype)

    def _ranges(self) -> LensRanges:
        others = (self.focal_range, self.aspect_range, self.center_x_range, self.center_y_range)
        return LensRanges(tuple([getattr(self, f"{name}_range") for name in POLYNOMIAL12]), *others)

    def _report_fold(self, params: LensParams, exists: Tensor, points: Points) -> None:
        folds = eager_values(lambda: params.applied & misses_in_frame(exists, points), of=params.applied)
        if not folds or not any(folds):
            return
        rule = "the lens must not fold back inside the frame (k1, k2 ... and focal_range decide)"
        if self.strict:
            sample = folds.index(True)
            k1, k2 = params.coefficients[sample, :2].tolist()
            raise ValueError(f"coefficients: {rule}, got k1 = {k1:g} and k2 = {k2:g} in sample {sample}")
        warn(f"{rule}: pixels beyond have no preimage and are padded, not valid")


def clean_view(params: LensParams) -> tuple[Tensor, Tensor]:
    """Return the zoom, (B,), and the shift, (B, 2), in widths, of the clean frames; 1 and 0 if params have none."""
    if params.zoom is None or params.shift is None:
        return torch.ones_like(params.focal[:, 0]), torch.zeros_like(params.center)
    return params.zoom, params.shift


def check_lens(
    params: Any, batch: int, *, count: int = len(POLYNOMIAL12), model: str = _MODEL, bound: float = _LARGEST_COEFFICIENT
) -> None:
    """Raise ValueError unless `coefficients`, `focal` and `center` of the parameters are valid lenses.

    Args:
        params: a NamedTuple with these fields.
        batch: B.
        count: the number of coefficients.
        model: which coefficients they are, for the message.
        bound: the largest magnitude of a coefficient.
    """
    for name, width, meaning in (("coefficients", count, model), ("focal", 2, "fx, fy"), ("center", 2, "x, y")):
        value = getattr(params, name)
        if value.shape != (batch, width):
            raise ValueError(f"params.{name} must have shape (B, {width}), {meaning}, got {tuple(value.shape)}")
    check_values(
        "params.coefficients", f"lie in [-{bound:g}, {bound:g}]", params.coefficients, lambda v: v.abs() <= bound
    )
    check_within("params.focal", params.focal, 1 / _FARTHEST, _FARTHEST)
    check_within("params.center", params.center, -_FARTHEST, _FARTHEST)


def lens_in_px(params: Any, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the coefficients, and the focal lengths and the principal point in px."""
    middle = as_device_tensor([width - 1, height - 1], dtype=params.center.dtype, device=params.center.device) / 2
    return params.coefficients, params.focal * width, middle + params.center * width
