"""Warps without sources or sinks."""

from typing import NamedTuple

from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import check_choice, check_count
from torchrefract.effects.batch import params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.random_field import (
    check_decorrelation,
    check_field_params,
    check_field_range,
    check_wind,
    drawn_motion,
    field_params,
    motion_ranges,
    warn_if_clipped,
)
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.divergence_free import divergence_free_flow
from torchrefract.fields.random_field import COVARIANCES, Frequencies, embedding_size
from torchrefract.fields.turbulence_error import RandomFieldErrorModel
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import Range
from torchrefract.warping.grid import Points


class DivergenceFreeParams(NamedTuple):
    """The stream functions of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    amplitude: Tensor  # (B,), px
    length: Tensor  # (B,), px, correlation length of the stream function
    wind: Tensor  # (B, 2), px per frame, motion of the field to the right and down
    decorrelation: Tensor  # (B,), frames, above 0; inf for a field that only moves
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the amplitude is zero."""
        return self.amplitude == 0


class DivergenceFree(WarpEffect):
    """A frame moved by a displacement without divergence, the curl of a Gaussian random stream function.

        flow = amplitude (D_y psi, -D_x psi) / rms,
        Cov(psi_t(p), psi_s(q)) = C(|p - q - wind (t - s)| / length) exp(-((t - s) / decorrelation)^2), t, s frames

    D is the central difference, so the divergence taken with central differences is zero: up to rounding without a
    tolerance, and up to about the tolerance per pixel with one. The map preserves areas to first order only:
    det(I + grad flow) differs from 1 by the square of the gradient. With `steps` the displacement is followed in that
    many equal parts, which keeps the map one-to-one and nearer to equal areas.

    Args:
        amplitude_range: px, 0 or above.
        length_range: px, correlation length of psi, above 0.
        wind_x_range, wind_y_range: px per frame, motion of the field over a clip, to the right and down.
        decorrelation_range: frames, above 0, inf for a field that only moves; its inverse is drawn uniformly.
        covariance: of psi: "gaussian", "matern52", "matern32" or "exponential"; psi with the last is not
            differentiable, and the flow is nearly white noise.
        normalize: "theory" divides by the standard deviation of each component over all draws, "max" by the longest
            displacement in the frame, "none" by 1: amplitude is then in px per unit of the gradient of psi.
        steps: number of parts in which the displacement is followed.
        padding, interpolation, backend, tolerance_px, p: as for every warp; flows are exact unless psi is Gaussian,
            normalized by theory and followed in one step.

    Raises:
        ValueError: an argument outside its range.

    Warns:
        UserWarning: a length that does not fit into the largest periodic domain (on the CPU).

    Source: the torchrefract paper; Bridson, Houriham, Nordenstam, "Curl-noise for procedural fluid flow", ACM
    Transactions on Graphics 26 (2007).
    """

    params_type = DivergenceFreeParams

    def __init__(
        self,
        *,
        amplitude_range: Range = (2.0, 6.0),
        length_range: Range = (40.0, 100.0),
        wind_x_range: Range = (-1.0, 1.0),
        wind_y_range: Range = (-1.0, 1.0),
        decorrelation_range: Range = (15.0, 45.0),
        covariance: str = "gaussian",
        normalize: str = "theory",
        steps: int = 1,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.amplitude_range = check_field_range("amplitude", amplitude_range)
        self.length_range = check_field_range("length", length_range)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.decorrelation_range = check_decorrelation(decorrelation_range)
        self.covariance = check_choice("covariance", covariance, COVARIANCES)
        self.normalize = check_choice("normalize", normalize, ("theory", "max", "none"))
        self.steps = check_count("steps", steps)

    def sample_params(self, stream: random.Stream, image: Tensor) -> DivergenceFreeParams:
        """Draw one stream function for each sample, every number uniform in its range."""
        motion = motion_ranges(self.wind_x_range, self.wind_y_range, decorrelation=self.decorrelation_range)
        applied, values = self.draw_in_ranges(stream, (self.amplitude_range, self.length_range, *motion), image)
        sizes, motion = values[:, :2].unbind(1), drawn_motion(values[:, 2:])
        return DivergenceFreeParams(applied, *sizes, **motion, key=random.noise_key(stream))

    def validate(self, params: DivergenceFreeParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_field_params(params)

    def flow(self, params: DivergenceFreeParams, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow of each frame; it exists everywhere."""
        frequencies = plan.details
        if frequencies is None:
            # The stream function has one row and one column more on each side of the frame.
            size = (plan.height + 2, plan.width + 2)
            frequencies = Frequencies.all(embedding_size(*size, length=self.length_range[1], kind=self.covariance))
        fields = field_params(params)
        amplitude = expand_batch(params.amplitude, len(fields.length))

        flow, clipped = divergence_free_flow(
            fields,
            amplitude,
            covariance=self.covariance,
            frequencies=frequencies,
            lattice=points.lattice,
            normalize=self.normalize,
            steps=self.steps,
        )
        if frequencies.is_all:
            warn_if_clipped(clipped, params, frequencies.size)
        return flow, everywhere(flow.device)

    def error_model(self) -> RandomFieldErrorModel | None:
        """Return the error bounds of the ranges for Gaussian psi in one step, normalized by theory; otherwise None."""
        if self.covariance != "gaussian" or self.normalize != "theory" or self.steps > 1:
            return None
        return RandomFieldErrorModel(self.amplitude_range, self.length_range, is_stream=True)
