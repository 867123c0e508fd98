"""Turbulent air in front of the camera."""

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import check_choice, eager_bool
from torchrefract.effects.batch import params_to
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
from torchrefract.fields.random_field import COVARIANCES, Frequencies, embedding_size, gradient_rms
from torchrefract.fields.turbulence import turbulence_flow
from torchrefract.fields.turbulence_error import RandomFieldErrorModel
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import Range
from torchrefract.warping.grid import Points

# A field folds the image first where a gradient of five standard deviations reaches 1.
_FOLDING_GRADIENT = 0.2


class TurbulenceParams(NamedTuple):
    """The turbulence of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    amplitude: Tensor  # (B,), px, standard deviation of each component of the flow
    length: Tensor  # (B,), px, correlation length
    aperture: Tensor  # (B,), px, standard deviation of the Gaussian that smooths the field
    wind: Tensor  # (B, 2), px per frame, motion of the field to the right and down
    decorrelation: Tensor  # (B,), frames, above 0; inf for a field that only moves
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the amplitude is zero."""
        return self.amplitude == 0


class Turbulence(WarpEffect):
    """A frame seen through turbulent air: a Gaussian random field of displacements (the paper's "Perlin distortion").

        flow = amplitude R_t,  t and s frames of a clip,  C smoothed by the aperture,  Var R = 1,
        Cov(R_t(p), R_s(q)) = C(|p - q - wind (t - s)| / length) exp(-((t - s) / decorrelation)^2)

    The two components are independent. A field with the exponential covariance is not differentiable: it folds the
    image from an amplitude of 0.14 sqrt(length) px on, unless an aperture smooths it, as the pupil of a real lens does.
    `restore_flow` comes from Newton's method; folded pixels are not valid in it.

    Args:
        amplitude_range: px, standard deviation of each component, 0 or above.
        length_range: px, correlation length, above 0.
        aperture_range: px, 0 or above.
        wind_x_range, wind_y_range: px per frame, motion of the field over a clip, to the right and down.
        decorrelation_range: frames, above 0, inf for a field that only moves; its inverse is drawn uniformly.
        covariance: "exponential", "gaussian", "matern32" or "matern52".
        normalize: "theory" gives the amplitude to the fields of all draws together, "image" to each field: its mean
            over the frame is subtracted, and it is divided by its standard deviation there, which enlarges fields that
            are longer than the frame.
        padding, interpolation, backend, tolerance_px, p: as for every warp. Under a tolerance the lowest frequencies
            are computed on a lattice; covariances other than the Gaussian one have few enough of them from an aperture
            of 1.8 px on, and are exact otherwise.

    Raises:
        ValueError: an argument outside its range.

    Warns:
        UserWarning: an amplitude from which on the field folds the image (on the CPU); a length that does not fit into
            the largest periodic domain.

    Source: the torchrefract paper; Dietrich and Newsam, SIAM J. Sci. Comput. 18 (1997), for the sampling; Taylor, "The
    spectrum of turbulence", Proc. Royal Society A 164 (1938), for air that the wind carries.
    """

    params_type = TurbulenceParams

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

    def sample_params(self, stream: random.Stream, image: Tensor) -> TurbulenceParams:
        """Draw one field for each sample, every number uniform in its range."""
        motion = motion_ranges(self.wind_x_range, self.wind_y_range, decorrelation=self.decorrelation_range)
        ranges = (self.amplitude_range, self.length_range, self.aperture_range, *motion)
        applied, values = self.draw_in_ranges(stream, ranges, image)
        sizes, motion = values[:, :3].unbind(1), drawn_motion(values[:, 3:])
        return TurbulenceParams(applied, *sizes, **motion, key=random.noise_key(stream))

    def validate(self, params: TurbulenceParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_field_params(params)

    def flow(self, params: TurbulenceParams, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow of each frame; it exists everywhere."""
        self._warn_if_folded(params)
        frequencies = plan.details
        if frequencies is None:
            longest, widest = self.length_range[1], self.aperture_range[1]
            size = embedding_size(plan.height, plan.width, length=longest, kind=self.covariance, aperture=widest)
            frequencies = Frequencies.all(size)
        fields = field_params(params)
        amplitude = expand_batch(params.amplitude, len(fields.length))

        kind = {"covariance": self.covariance, "normalize": self.normalize}
        flow, clipped = turbulence_flow(fields, amplitude, frequencies=frequencies, lattice=points.lattice, **kind)
        if frequencies.is_all:
            warn_if_clipped(clipped, params, frequencies.size)
        return flow, torch.ones(1, 1, 1, 1, dtype=torch.bool, device=flow.device)

    def error_model(self) -> RandomFieldErrorModel | None:
        """Return the error bounds of the ranges; None if fields are normalized by the image."""
        if self.normalize != "theory":
            return None
        return RandomFieldErrorModel(self.amplitude_range, self.length_range, self.aperture_range, self.covariance)

    def _warn_if_folded(self, params: TurbulenceParams) -> None:
        def folds() -> Tensor:
            gradient = gradient_rms(params.length, kind=self.covariance, aperture=params.aperture)
            return (params.applied & (params.amplitude * gradient > _FOLDING_GRADIENT)).any()

        if eager_bool(folds, of=params.applied):
            warnings.warn(
                "Turbulence this strong folds the image; folded pixels are excluded from restore_valid. Lower "
                "amplitude_range, or raise length_range or aperture_range.",
                stacklevel=2,
            )
