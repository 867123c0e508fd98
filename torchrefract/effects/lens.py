"""The lens of a cheap dashcam."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._compiled import SMALLEST
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_flag, check_range, check_values, check_within, eager_bool, eager_values
from torchrefract.cameras.distortion import ALL_TERMS, POLYNOMIAL12
from torchrefract.cameras.models import Camera
from torchrefract.effects.base import params_to
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.lens_parts import plan_in_parts, plan_of_lens
from torchrefract.effects.lens_plan import kept_terms, params_in_range
from torchrefract.effects.lens_source import LensSource, cameras_of, correlated, jittered, listed
from torchrefract.effects.plan import TOLERANCE_PX, Plan, PlanRequest
from torchrefract.effects.refraction import Moved
from torchrefract.fields.lens import folds_inside, lens_flow, lens_restore_flow, smooth_lens_flow
from torchrefract.fields.lens_bounds import LensRanges, lens_numbers
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice, LatticeFlow

_LARGEST = 100.0  # coefficient
_FARTHEST = 1e10  # widths
_MODEL = "k1 ... k6, p1, p2, s1 ... s4 of the polynomial model (OpenCV's vectors are another model in another order)"


class LensParams(NamedTuple):
    """The lenses of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    coefficients: Tensor  # (B, 12): k1 ... k6, p1, p2, s1 ... s4
    focal: Tensor  # (B, 2), in widths of the frame: fx / W and fy / W
    center: Tensor  # (B, 2), in widths: the principal point's offset from the center of the frame

    to = params_to


class LensDistortion(LatticeWarp):
    """A frame as seen through a lens of the extended Brown-Conrady model, the polynomial of the paper.

        x_d = x (1 + sum k_i r^2i) + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_d = y (1 + sum k_i r^2i) + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,  i = 1 ... 6

    `flow` undistorts (the exact inverse), `restore_flow` distorts (closed form). Pixels that the lens shows nothing
    at, beyond the radius where the model folds back, are padded and not valid. OpenCV's k4, k5, k6 belong to another
    model. The defaults are those of one fleet of cheap dashcams: a barrel that folds nowhere. Under a tolerance, where
    the strongest lens of the ranges asks for a fine lattice or none, those that are drawn go by their parts of the
    ranges, if values can be read (on the CPU, uncompiled, without gradients of the lens) and frames have 2^16 px.

    Args:
        k1_range ... k6_range: radial coefficients, each within [-100, 100].
        p1_range, p2_range: decentring (tangential) coefficients.
        s1_range ... s4_range: thin-prism coefficients; s1, s2 act on x, s3, s4 on y.
        focal_range: focal length fx in widths of the frame, above 0.
        aspect_range: fy / fx, above 0.
        center_x_range, center_y_range: offset of the principal point from the center of the frame, in widths.
        strict: raise, instead of warning, where the model folds back inside the frame (on the CPU).
        padding, interpolation, backend, tolerance_px, p: as for every warp.

    Raises:
        ValueError: an argument outside its range; a lens that folds inside the frame, if `strict`.

    Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37 (1971), with thin-prism terms.
    """

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
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        radial = (k1_range, k2_range, k3_range, k4_range, k5_range, k6_range)
        others = (p1_range, p2_range, s1_range, s2_range, s3_range, s4_range)
        for name, value in zip(POLYNOMIAL12, radial + others, strict=True):
            bounds = {"low": -_LARGEST, "high": _LARGEST}
            setattr(self, f"{name}_range", check_range(f"{name}_range", value, **bounds))
        self.focal_range = check_range("focal_range", focal_range, low=0.01, high=1000.0)
        self.aspect_range = check_range("aspect_range", aspect_range, low=0.01, high=100.0)
        self.center_x_range = check_range("center_x_range", center_x_range, low=-10.0, high=10.0)
        self.center_y_range = check_range("center_y_range", center_y_range, low=-10.0, high=10.0)
        self.strict = check_flag("strict", strict)
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
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ) -> "LensDistortion":
        """The lens of a calibrated camera, or those near to it.

        Args:
            camera: of any model; what is no polynomial is replaced by the nearest.
            jitter: each number is drawn uniformly up to so large a share of itself off, in [0, 0.99]; focal length,
                aspect, offset of the principal point, and each coefficient.
            covariance: (4 + n, 4 + n), of fx, fy, cx, cy in px and n coefficients, in place of `jitter`: numbers are
                off together, by uniform draws of that covariance. For cameras that are polynomials as they are.
            residual_px: how far the polynomial may show a ray from where the camera does, px.
            strict, padding, interpolation, backend, tolerance_px, p: as for `LensDistortion`.

        Raises:
            ValueError: numbers out of range; a camera too far from a polynomial, or that folds inside its frame.
        """
        if covariance is None:
            lenses = jittered(camera, jitter=jitter, residual_px=residual_px).ranges
        elif jitter:
            raise ValueError(f"jitter must be 0 beside a covariance, got {jitter}")
        else:
            lenses = correlated(camera, covariance)
        warp = {"padding": padding, "interpolation": interpolation, "backend": backend, "p": p}
        return cls._drawn_from(lenses, strict=strict, tolerance_px=tolerance_px, **warp)

    @classmethod
    def from_lenses(
        cls,
        table: Sequence[Camera] | None = None,
        *,
        residual_px: float = 0.5,
        strict: bool = False,
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ) -> "LensDistortion":
        """One of several real lenses for each sample, each as often as another.

        Args:
            table: their cameras; None is the table of the package (`torchrefract.cameras.lens_table`).
            residual_px: how far a polynomial may show a ray from where a camera of another model does, px; lenses of
                the package's table that are farther off are left out, others raise.
            strict, padding, interpolation, backend, tolerance_px, p: as for `LensDistortion`.

        Raises:
            ValueError: an empty table; a camera too far from a polynomial, or that folds inside its frame.
        """
        warp = {"padding": padding, "interpolation": interpolation, "backend": backend, "p": p}
        return cls._drawn_from(listed(table, residual_px=residual_px), strict=strict, tolerance_px=tolerance_px, **warp)

    @classmethod
    def _drawn_from(cls, lenses: LensSource | dict[str, Range], **arguments: Any) -> "LensDistortion":
        """Lenses of a source, or of ranges by their names."""
        ranges = lenses.ranges if isinstance(lenses, LensSource) else lenses
        made = cls(**ranges, **arguments)
        made._source = lenses if isinstance(lenses, LensSource) else None
        return made

    params_type = LensParams

    def at_rest(self) -> bool:
        """Whether all lenses are pinholes."""
        return self._source is None and all(span == (0.0, 0.0) for span in self._ranges().coefficients)

    def draw(self, source: random.Stream, image: Tensor) -> LensParams:
        """One lens a sample: every number uniform in its range, or one of those of a table or a camera."""
        if self._source is None:
            applied, values = self._uniform(source, self._ranges().numbers, image)
        else:
            applied, values = self._uniform(source, self._source.inputs, image)
            values = self._source.lenses(values)
        fx, aspect = values[:, 12], values[:, 13]
        return LensParams(applied, values[:, :12], torch.stack([fx, fx * aspect], dim=1), values[:, 14:])

    def check(self, params: LensParams, image: Tensor) -> None:
        """Raise for lenses that are none."""
        check_lens(params, image.shape[0])

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan for all lenses of the ranges, or of a table."""
        return plan_in_parts(self._boxes(), ask)

    def plans_of(self, params: LensParams, plan: Plan) -> list[Plan] | None:
        """For each lens the plan of `plan_of_lens`."""
        numbers = eager_values(lambda: lens_numbers(*(value.detach() for value in params[1:])), of=params.focal)
        if numbers is None:
            return None
        boxes = self._boxes()
        ask = PlanRequest(plan.height, plan.width, plan.tolerance_px, params.focal.dtype is torch.float64)
        return [plan_of_lens(boxes, lens, ask) for lens in numbers]

    def params_in_range(self, params: LensParams, height: int, width: int) -> Tensor:
        """Whether the lenses lie in the ranges, or near one of a table's."""
        if self._source is not None:
            return self._source.params_in_range(params.coefficients, params.focal, params.center)
        return params_in_range(self._ranges(), params.coefficients, params.focal, params.center)

    def on_lattice(self, params: LensParams, plan: Plan) -> LatticeFlow:
        """The flow of `smooth_lens_flow`."""
        lattice = cast(Lattice, plan.lattice)
        x, y = lattice.places(dtype=params.focal.dtype, device=params.focal.device)
        terms = ALL_TERMS if params.coefficients.requires_grad else kept_terms(plan)
        camera, large = in_px(params, lattice.height, lattice.width), lattice.height * lattice.width >= SMALLEST
        flow = smooth_lens_flow(*camera, x, y, steps=cast(int, plan.steps), terms=terms, large=large)
        return LatticeFlow(flow, lattice)

    def masked_flow(self, params: LensParams, *, height: int, width: int, plan: Plan | None = None) -> Moved:
        """The flow, by its own plan or by one that is given; a lens that folds is told."""
        moved = super().masked_flow(params, height=height, width=width, plan=plan)
        if eager_bool(moved.exists.all, of=moved.exists) is False:
            self._check_fold(params, height, width)
        return moved

    def flow(self, params: LensParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow of `lens_flow`, and where it exists."""
        return lens_flow(*in_px(params, height, width), height=height, width=width)

    def undo(self, params: LensParams, flow: Tensor) -> tuple[Tensor, Tensor]:
        """The flow of `lens_restore_flow`, and where it exists; the closed form needs no flow."""
        height, width = flow.shape[2:]
        return lens_restore_flow(*in_px(params, height, width), height=height, width=width)

    def cameras(self, params: LensParams, *, height: int, width: int) -> list[Camera]:
        """The camera of each sample's degraded frame, where its focal length and center are those of the clean one's.

        A pinhole where the gate is closed. Values are read, for which an accelerator is waited for.

        Raises:
            ValueError: a lens that is no `Camera`.
        """
        return cameras_of(params.applied, *in_px(params, height, width), height=height, width=width)

    def moves(self, params: LensParams) -> Tensor:
        """The samples with a coefficient that is not zero."""
        return (params.coefficients != 0).any(dim=1)

    def _boxes(self) -> tuple[LensRanges, ...]:
        return (self._ranges(),) if self._source is None else self._source.boxes

    def _ranges(self) -> LensRanges:
        others = (self.focal_range, self.aspect_range, self.center_x_range, self.center_y_range)
        return LensRanges(tuple(getattr(self, f"{name}_range") for name in POLYNOMIAL12), *others)

    def _check_fold(self, params: LensParams, height: int, width: int) -> None:
        camera = in_px(params, height, width)

        def folds() -> Tensor:
            return (params.applied & folds_inside(*camera, height=height, width=width)).any()

        if not eager_bool(folds, of=params.applied):
            return
        rule = "the lens must not fold back inside the frame (k1, k2 ... and focal_range decide)"
        if self.strict:
            raise ValueError(f"coefficients: {rule}, got {params.coefficients.tolist()}")
        warnings.warn(f"{rule}: pixels beyond have no preimage and are padded, not valid", stacklevel=2)


def check_lens(params: Any, batch: int, *, count: int = 12, what: str = _MODEL, bound: float = _LARGEST) -> None:
    """Raise for parameters with `coefficients`, `focal` and `center` that are no lens of so many coefficients."""
    for name, width, meaning in (("coefficients", count, what), ("focal", 2, "fx, fy"), ("center", 2, "x, y")):
        value = getattr(params, name)
        if value.shape != (batch, width):
            raise ValueError(f"params.{name} must have shape (B, {width}), {meaning}, got {tuple(value.shape)}")
    check_values(
        "params.coefficients", f"lie in [-{bound:g}, {bound:g}]", params.coefficients, lambda v: v.abs() <= bound
    )
    check_within("params.focal", params.focal, 1 / _FARTHEST, _FARTHEST)
    check_within("params.center", params.center, -_FARTHEST, _FARTHEST)


def in_px(params: Any, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """The coefficients, and in px the focal lengths and the principal point, of such parameters."""
    middle = as_device_tensor([width - 1, height - 1], dtype=params.center.dtype, device=params.center.device) / 2
    return params.coefficients, params.focal * width, middle + params.center * width
