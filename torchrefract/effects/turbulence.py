"""Hot air over a road."""

import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_choice, eager_bool
from torchrefract.effects.base import params_to
from torchrefract.effects.field_plan import FieldPlan, field_plan
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.motion import check_decorrelation, check_wind, drawn_motion, motion_ranges
from torchrefract.effects.plan import FEW_ULPS, TOLERANCE_PX, Plan, PlanRequest, in_ranges
from torchrefract.effects.random_field import check_field_params, check_field_range, field_of_modes, random_field
from torchrefract.effects.rows import column, expand_batch, frame_mean
from torchrefract.fields.covariance import COVARIANCES, slope_rms
from torchrefract.fields.field_bounds import FieldRanges
from torchrefract.fields.modes import Modes
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice, LatticeFlow

# A field folds first where a slope of five standard deviations reaches 1.
_FOLD = 0.2


class TurbulenceParams(NamedTuple):
    """The air of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    amplitude: Tensor  # (B,), px, standard deviation of each component of the flow
    length: Tensor  # (B,), px, correlation length
    aperture: Tensor  # (B,), px, standard deviation of the Gaussian that averages the field
    wind: Tensor  # (B, 2), px per frame, that the field drifts to the right and down
    decorrelation: Tensor  # (B,), frames, above 0; inf for a field that only drifts
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to


class Turbulence(LatticeWarp):
    """A frame seen through turbulent air: a Gaussian random field of displacements (the paper's "Perlin distortion").

        flow = amplitude R_t,  t and s frames of a clip,  C smoothed by the aperture,  Var R = 1,
        Cov(R_t(p), R_s(q)) = C(|p - q - wind (t - s)| / length) exp(-((t - s) / decorrelation)^2)

    The two components are independent. The exponential covariance has no slope: it folds the image from an amplitude of
    0.14 sqrt(length) px on, unless an aperture smooths it, as the pupil of a real lens does. `restore_flow` is found by
    Newton's method; folded pixels are not valid in it.

    Args:
        amplitude_range: px, standard deviation of each component, 0 or above.
        length_range: px, correlation length, above 0.
        aperture_range: px, 0 or above.
        wind_x_range, wind_y_range: px per frame, of the drift over a clip, to the right and down.
        decorrelation_range: frames, above 0, inf for air that only drifts; one over it is drawn uniformly.
        covariance: "exponential", "gaussian", "matern32" or "matern52".
        normalize: "theory" gives the amplitude to all fields together, "image" to each: its mean is subtracted and its
            standard deviation divided by, which inflates fields that are longer than the frame.
        padding, interpolation, backend, tolerance_px, p: as for every warp; other fields than Gaussian ones have few
            enough frequencies for a tolerance if the aperture is 1.8 px or more, and are exact otherwise.

    Raises:
        ValueError: an argument outside its range.

    Warns:
        UserWarning: an amplitude from which on the field folds the image (on the CPU); a
            length that the largest torus has no room for.

    Source: the torchrefract paper; Dietrich and Newsam, SIAM J. Sci. Comput. 18 (1997), for the sampling. Of air that a
    wind carries: Taylor, "The spectrum of turbulence", Proc. Royal Society A 164 (1938).
    """

    def __init__(
        self,
        *,
        amplitude_range: Range = (0.5, 1.5),
        length_range: Range = (20.0, 60.0),
        aperture_range: Range = (2.0, 3.0),
        wind_x_range: Range = (-1.0, 1.0),
        wind_y_range: Range = (-1.0, 0.0),
        decorrelation_range: Range = (6.0, 15.0),
        covariance: str = "exponential",
        normalize: str = "theory",
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.amplitude_range = check_field_range("amplitude", amplitude_range)
        self.length_range = check_field_range("length", length_range)
        self.aperture_range = check_field_range("aperture", aperture_range)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.decorrelation_range = check_decorrelation(decorrelation_range)
        self.covariance = check_choice("covariance", covariance, COVARIANCES)
        self.normalize = check_choice("normalize", normalize, ("theory", "image"))

    params_type = TurbulenceParams
    ulps = FEW_ULPS

    def at_rest(self) -> bool:
        """Whether no air has an amplitude."""
        return self.amplitude_range[1] == 0

    def draw(self, source: random.Stream, image: Tensor) -> TurbulenceParams:
        """One air a sample, every number uniform in its range."""
        motion = motion_ranges(self.wind_x_range, self.wind_y_range, decorrelation=self.decorrelation_range)
        ranges = (self.amplitude_range, self.length_range, self.aperture_range, *motion)
        applied, values = self._uniform(source, ranges, image)
        air, motion = values[:, :3].unbind(1), drawn_motion(values[:, 3:])
        return TurbulenceParams(applied, *air, **motion, key=random.noise_key(source))

    def check(self, params: TurbulenceParams, image: Tensor) -> None:
        """Raise for air that is none."""
        check_field_params(params)

    def flow(self, params: TurbulenceParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow, frame by frame, and where it exists: everywhere."""
        self._check_folds(params)
        reach = {"longest": self.length_range[1], "widest": self.aperture_range[1]}
        field = random_field(params, kind=self.covariance, **reach, height=height, width=width)
        if self.normalize == "image":
            field = field.contiguous()  # sums over another layout round in another way, and a batch has its own
            field = field - frame_mean(field)
            field = field / frame_mean(field.square()).clamp(min=1e-12).sqrt()
        flow = column(expand_batch(params.amplitude, field.shape[0])) * field
        return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan of `field_plan` for air that is normalized by theory; other is exact."""
        if self.normalize != "theory":
            return super().plan_within(ask)
        ranges = FieldRanges(self.amplitude_range, self.length_range, self.aperture_range, kind=self.covariance)
        return field_plan(ranges, ask)

    def params_in_range(self, params: TurbulenceParams, height: int, width: int) -> Tensor:
        """Whether the air lies in the ranges."""
        values = torch.stack([params.amplitude, params.length, params.aperture], dim=1)
        return in_ranges(values, [self.amplitude_range, self.length_range, self.aperture_range])

    def on_lattice(self, params: TurbulenceParams, plan: Plan) -> LatticeFlow:
        """The flow of the frequencies that the plan keeps."""
        lattice = cast(Lattice, plan.lattice)
        return LatticeFlow(self._of_modes(params, plan, *lattice.axes()), lattice)

    def at_pixels(self, params: TurbulenceParams, plan: Plan) -> tuple[Tensor, Tensor]:
        """The same at every pixel, where a plan keeps some of the frequencies."""
        if not isinstance(plan, FieldPlan):
            return super().at_pixels(params, plan)
        flow = self._of_modes(params, plan, range(plan.height), range(plan.width))
        return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)

    def _of_modes(self, params: TurbulenceParams, plan: Plan, rows: Sequence[int], columns: Sequence[int]) -> Tensor:
        strongest = self.amplitude_range[1], self.length_range[0], self.aperture_range[0]
        if torch.compiler.is_compiling() or _may_fold(*strongest, self.covariance):
            self._check_folds(params)
        kept = cast(FieldPlan, plan)
        drawn: Any = {"kind": self.covariance, "lengths": self.length_range, "nodes": kept.nodes}
        field = field_of_modes(params, cast(Modes, kept.modes), (rows, columns), **drawn, aperture=True)
        return column(expand_batch(params.amplitude, field.shape[0])) * field

    def moves(self, params: TurbulenceParams) -> Tensor:
        """The samples with an amplitude."""
        return params.amplitude != 0

    def _check_folds(self, params: TurbulenceParams) -> None:
        def folds() -> Tensor:
            slope = slope_rms(params.length, kind=self.covariance, aperture=params.aperture)
            return (params.applied & (params.amplitude * slope > _FOLD)).any()

        if eager_bool(folds, of=params.applied):
            warnings.warn(
                "amplitude is above what the covariance bears without folding the image (0.2 px over the slope of the "
                "field): restore_valid leaves folded pixels out; a larger length_range or aperture_range folds less",
                stacklevel=2,
            )


@lru_cache(maxsize=64)
def _may_fold(amplitude: float, length: float, aperture: float, kind: str) -> bool:
    """Whether air folds the image that is no stronger, and has no shorter length and no narrower aperture."""
    slope = slope_rms(torch.tensor([length]), kind=kind, aperture=torch.tensor([aperture]))
    return amplitude * slope.item() > _FOLD
