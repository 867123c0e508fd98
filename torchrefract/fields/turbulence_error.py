"""Error bounds for random fields with few frequencies, interpolated between the nodes of a lattice.

Everything that is linear in a Gaussian random field is normal, with a variance that its spectrum gives. The two
components of an error are together longer than `_SIGMAS` deviations with a probability of exp(-_SIGMAS^2 / 2), 2e-11,
at each pixel. Covariances are sums of Gaussian ones, see `gaussian_mixture`. The spectrum of each of these is a product
of two axes with the deviation 1 / sqrt(s l^2 + 2 a^2), in radians per px, for an aperture a.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import in_ranges
from torchrefract.fields.random_field import REACH, Frequencies, embedding_size, gaussian_mixture, gradient_rms
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.lattice import lagrange_basis

_SIGMAS = 7.0
_DERIVATIVE_SIGMAS = 4.0  # errors and derivatives are not at their largest in the same place
_REACH = 8.0  # deviations of the spectrum beyond which nothing is left of it
# Pixels alias the part of a covariance beyond their own frequencies, before the aperture acts: of the power at k, which
# falls as k^-3 or faster, at most 0.045 k^3 up to k = 2.2, about where half of all frequencies lie. Beyond 5 / a an
# aperture a leaves exp(-25). A Gaussian covariance has nothing there.
_ALIASED, _HALF_OF_ALL, _SEEN = 0.045, 2.2, 5.0
# The errors along the two axes of a composed flow, which need not be at right angles, are slightly correlated.
_SKEW = 1.1
_DROPPED_SHARE = 0.3  # of the budget, for frequencies that are left out
_ROUNDING = 4e-6  # of a field of variance 1 in float32, in deviations
_NARROW_APERTURE = 1.1  # an aperture below half a pixel smooths pixels by less than its closed form, up to a tenth
# With more frequencies than these the transform of all takes no longer.
_MAX_FREQUENCIES, _MAX_SHARE = 1 << 18, 0.5
_PLACES = 8  # between two nodes, at which errors of cubics are computed


class _Spectrum(NamedTuple):
    """The roughest field of some ranges, of variance 1: that of the shortest length and narrowest aperture."""

    weight: np.ndarray  # (S,), of sum 1: share of each Gaussian covariance in the variance
    deviation: np.ndarray  # (S,), radians per px, of its spectrum
    margin: float  # factor of all deviations, for aliased frequencies


@dataclass(frozen=True)
class RandomFieldErrorModel:
    """Error bounds for random fields drawn from ranges; see `ErrorModel`.

    amplitude, length, aperture: px; of the flow, and of the field.
    covariance: one of COVARIANCES.
    is_stream: True if the flow is the curl of a stream function, which has this covariance.
    """

    amplitude: Range
    length: Range
    aperture: Range = (0.0, 0.0)
    covariance: str = "gaussian"
    is_stream: bool = False

    is_random = True

    def bounds(self, height: int, width: int) -> FlowBounds:
        """Return bounds of the displacement and, if pixels resolve the field, of its derivatives."""
        largest, steep = _SIGMAS * self.amplitude[1], _DERIVATIVE_SIGMAS * self.amplitude[1]
        spectrum = _spectrum(self)
        if spectrum is None:
            gradient = math.inf
            if not self.is_stream:
                shortest, narrowest = (
                    torch.tensor([ends[0]], dtype=torch.float64, device="cpu") for ends in (self.length, self.aperture)
                )
                gradient = _NARROW_APERTURE * steep
                gradient *= gradient_rms(shortest, kind=self.covariance, aperture=narrowest).item()
            return FlowBounds(largest, gradient)

        def interpolation_error(strides: np.ndarray) -> np.ndarray:
            spacing = np.multiply.outer(np.asarray(strides, dtype=float), spectrum.deviation)
            power = _cubic_error(spacing, is_stream=self.is_stream) @ spectrum.weight
            return _SKEW * spectrum.margin * largest * np.sqrt(power)

        return FlowBounds(largest, steep * _gradient_rms(spectrum, is_stream=self.is_stream), interpolation_error)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification | None:
        """Keep the lowest frequencies, so that the others use a share of the budget."""
        largest = _SIGMAS * self.amplitude[1]
        if largest > min(height, width):
            return Simplification(0.0, can_interpolate=False, why="the flow is longer than the frame")
        spectrum = _spectrum(self)
        if spectrum is None:
            return Simplification(0.0, can_interpolate=False, why="the field has too many frequencies for a lattice")
        allowed = _DROPPED_SHARE * budget_px
        cutoff = _cutoff(spectrum, allowed / largest, is_stream=self.is_stream)
        # The stream function has one row and one column more on each side of the frame.
        sides = [side + (2 if self.is_stream else 0) for side in (height, width)]
        reach = REACH[self.covariance] * self.length[1]
        size = embedding_size(*sides, kind=self.covariance, length=self.length[1], aperture=self.aperture[1])
        frequencies = Frequencies(size, *(math.ceil(cutoff * n / (2 * math.pi)) for n in size))
        count = math.prod(frequencies.counts)
        has_fewer = all(2 * largest + 1 < n for largest, n in zip(frequencies[1:], size, strict=True))
        if self.covariance == "gaussian":
            # The covariance is summed over the ways around the domain only if that is large enough.
            is_cheaper, has_room = count <= _MAX_FREQUENCIES, reach <= min(size)
        else:
            # The transform of all frequencies warns if the domain is too small.
            is_cheaper = count <= _MAX_SHARE * math.prod(size)
            has_room = all(side + reach <= n for side, n in zip(sides, size, strict=True))
        if not (has_fewer and is_cheaper and has_room):
            return Simplification(0.0, can_interpolate=False, why="the field has too many frequencies for a lattice")
        return Simplification(
            math.hypot(allowed, _ROUNDING * largest),
            details=frequencies,
            why="{} x {} of {} x {} frequencies".format(*frequencies.counts, *size),
        )

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: amplitude, length and aperture of each sample lie in the ranges, up to rounding."""
        names = ("amplitude", "length") if self.is_stream else ("amplitude", "length", "aperture")
        values = torch.stack([getattr(params, name) for name in names], dim=1)
        return in_ranges(values, [getattr(self, name) for name in names])


def _spectrum(model: RandomFieldErrorModel) -> _Spectrum | None:
    """Return the spectrum of the roughest field, or None if pixels do not resolve it."""
    weight, scale = (values.numpy() for values in gaussian_mixture(model.covariance, torch.device("cpu")))
    variance = model.length[0] ** 2 * scale
    smoothed = variance + 2 * model.aperture[0] ** 2
    weight, deviation = weight * variance / smoothed, 1 / np.sqrt(smoothed)
    if _REACH * deviation.max() > math.pi:
        return None
    aliased = 0.0
    if model.covariance != "gaussian":
        aliased = _ALIASED * min(_HALF_OF_ALL, _SEEN / model.aperture[0]) ** 3
    if model.is_stream:  # of the variance of a slope
        weight = weight * deviation**2
    return _Spectrum(weight / weight.sum(), deviation, math.sqrt(1 + aliased))


def _gradient_rms(spectrum: _Spectrum, *, is_stream: bool) -> float:
    """Return the root mean square of the largest derivative, in 1/px, of a flow of variance 1.

    A Gaussian spectrum of deviation d has the mean square d^2; that of a component of a curl is 3 d^2.
    """
    return spectrum.margin * math.sqrt((3 if is_stream else 1) * float(spectrum.weight @ spectrum.deviation**2))


def _cutoff(spectrum: _Spectrum, error: float, *, is_stream: bool) -> float:
    """Return the lowest frequency, radians per px, beyond which all others together deviate by less than an error."""
    cutoffs = np.linspace(0, _REACH * spectrum.deviation.max(), 1025)
    t = torch.from_numpy(cutoffs[:, None] / spectrum.deviation)
    beyond = torch.erfc(t / math.sqrt(2)).numpy()
    along = beyond
    if is_stream:  # along one axis the power is that of the slope
        along = beyond + math.sqrt(2 / math.pi) * (t * torch.exp(-t * t / 2)).numpy()
    # Of the kept square is left out what lies beyond along one axis or the other.
    left_out = spectrum.margin * np.sqrt((beyond + along - beyond * along) @ spectrum.weight)
    return float(cutoffs[np.argmax(left_out <= max(error, left_out[-1]))])


def _cubic_error(spacing: np.ndarray, *, is_stream: bool) -> np.ndarray:
    """Interpolate the variance of the error of cubics between nodes in a table, for spacings in 1 / deviation."""
    logs, values = _cubic_error_table(is_stream)
    log_spacing = np.log(np.maximum(spacing, 1e-30))
    # Below the table the error is that of the first term of its series.
    below = np.minimum(log_spacing - logs[0], 0.0)
    return np.exp(np.interp(log_spacing, logs, values) + 8 * below)


@lru_cache(maxsize=2)
def _cubic_error_table(is_stream: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return logarithms of spacings, in 1 / deviation, and of the largest variance of the error of cubics there.

    The error of a wave exp(i k x) is 1 - T(k), where T is the sum of weighted waves at the nodes. For a spectrum that
    is a product of two axes the variance is 1 + E|T_y|^2 E|T_x|^2 - 2 Re(E T_y E T_x).
    """
    logs = np.linspace(math.log(0.1), math.log(20.0), 140)
    k = np.linspace(-_REACH, _REACH, 161)
    density = np.exp(-0.5 * k * k)
    place, nodes = np.arange(_PLACES) / _PLACES, np.arange(-1, 3)
    wave = np.exp(1j * np.exp(logs)[:, None, None, None] * (nodes - place[:, None])[..., None] * k)
    transfer = (wave * np.stack(lagrange_basis(place), axis=1)[..., None]).sum(axis=2)  # (spacings, places, k)
    share_x = density / density.sum()
    share_y = density * k * k / (density * k * k).sum() if is_stream else share_x
    mean_x, mean_y = (transfer @ share for share in (share_x, share_y))
    power_x, power_y = (np.abs(transfer) ** 2 @ share for share in (share_x, share_y))
    variance = 1 + power_y[:, :, None] * power_x[:, None] - 2 * (mean_y[:, :, None] * mean_x[:, None]).real
    return logs, np.log(variance.max(axis=(1, 2)))
