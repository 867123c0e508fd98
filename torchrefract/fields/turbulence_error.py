"""How rough random fields are, and how far off polynomials between nodes and fields of few frequencies are.

What is linear in a Gaussian random field is normal, with a variance that the spectrum gives. Spectra are those of sums
of Gaussian covariances, see `as_gaussians`, and of each of these a product of two axes. An aperture a widens each,
from s l^2 to s l^2 + 2 a^2, so that no spectrum reaches much beyond 1 / a.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from torchrefract.fields.covariance import as_gaussians
from torchrefract.types import Range
from torchrefract.warping.lattice import lagrange_weights, slope_weights

_REACH = 8.0  # deviations of the spectrum beyond which nothing is left of it
_POINTS = 257
# Of axes that are square to one another errors are sqrt(2) times those along one and more, of any up to 1 + 5/4 times.
_OBLIQUE = 2.25 / math.sqrt(2)
_PLACES = 8  # between two nodes, at which cubics are looked at
# Pixels fold what a covariance has beyond their own frequencies back, before the aperture: of the power at k, radians
# per px, where it falls as k^-3 or faster, 0.045 k^3 or less up to k = 2.2, about where half of all frequencies are.
# Beyond 5 / a an aperture a leaves exp(-25). A Gaussian covariance has nothing there.
_FOLDED, _HALF_OF_ALL, _SEEN = 0.045, 2.2, 5.0
# Of a variance that an aperture adds 2 a^2 to: as if it were 0.
_LITTLE = 0.02


@dataclass(frozen=True)
class FieldRanges:
    """What a field is drawn from, px; of a stream function if `stream`, whose curl has unit variance."""

    amplitude: Range
    length: Range
    aperture: Range
    stream: bool = False
    kind: str = "gaussian"


class FieldSpectrum:
    """The roughest field of some ranges, of variance 1, along one axis: that of the shortest length and aperture."""

    def __init__(self, weight: np.ndarray, deviation: np.ndarray, *, stream: bool, margin: float):
        """Of the sum of Gaussian covariances of variances (S,), whose spectra have deviations (S,), radians per px."""
        k = np.linspace(-_REACH, _REACH, _POINTS)
        share = np.exp(-0.5 * k * k)
        self.weight, self.share, self.margin = weight, share / share.sum(), margin
        self.k, self.finest = deviation[:, None] * k, int(deviation.argmax())
        self.stream = stream
        # What a frequency is multiplied by: the central difference of a stream function, or nothing.
        self.target = 1j * np.sin(self.k) if stream else np.ones_like(self.k)
        self.variance = self._mixed(self._total(np.abs(self.target) ** 2))

    @classmethod
    def of(cls, ranges: FieldRanges) -> "FieldSpectrum | None":
        """That of some ranges; None where pixels are too coarse for it."""
        weight, scale = (values.numpy() for values in as_gaussians(ranges.kind, torch.device("cpu")))
        own, blur = ranges.length[0] ** 2 * scale, 2 * ranges.aperture[0] ** 2
        fine = own < _LITTLE * blur
        weight, own = np.append(weight[~fine], weight[fine].sum()), np.append(own[~fine], own[fine].max(initial=0.0))
        weight, own = weight[own > 0], own[own > 0]
        spread = own + blur
        weight, deviation = weight * own / spread, 1 / np.sqrt(np.where(own < _LITTLE * blur, blur, spread))
        if _REACH * deviation.max() > math.pi:
            return None
        folded = 0.0
        if ranges.kind != "gaussian":
            folded = _FOLDED * min(_HALF_OF_ALL, _SEEN / ranges.aperture[0]) ** 3
        return cls(weight / weight.sum(), deviation, stream=ranges.stream, margin=math.sqrt(1 + folded))

    def lines(self) -> float:
        """The deviation of the largest error of lines between pixels."""
        return self._missed(2, 2, 1)

    def error_of_cubics(self, stride: float) -> float:
        """That of cubics through four of its values along each axis, which for a stream function are of its curl."""
        return self._missed(_PLACES, 4, stride)

    def derivative(self, order: int) -> float:
        """The deviation of the largest derivative, in 1/px^order."""
        power = self._mixed(self._total(np.abs(self.target * self.k**order) ** 2))
        return self.margin * math.sqrt(power / self.variance)

    def cutoff(self, error: float) -> float:
        """The lowest frequency from which on all others together deviate by no more than this."""
        tried = np.abs(self.k[self.finest])
        kept = np.abs(self.k) <= tried[:, None, None]
        one, other = self._total(kept * np.abs(self.target) ** 2), self._total(kept)
        left_out = self.margin * np.sqrt(np.clip(1 - self._mixed(one * other) / self.variance, 0, None))
        return float(tried[left_out <= max(error, left_out.min())].min())

    def error_between(self, stride: int, nodes: int) -> float:
        """The deviation of the largest error of polynomials through so many nodes."""
        options = {"dtype": torch.float64, "device": torch.device("cpu")}
        own = along = self._transfer(lagrange_weights(stride, nodes, **options).numpy(), stride)
        if self.stream:
            along = self._transfer(slope_weights(stride, nodes, **options).numpy(), stride)
        return self._off(own, along)

    def _missed(self, places: int, nodes: int, px: float) -> float:
        """The deviation of the largest error at so many places between nodes, so many px from one another."""
        weights = lagrange_weights(places, nodes, dtype=torch.float64, device=torch.device("cpu")).numpy()
        own = self._transfer(weights, px)
        return self._off(own, self.target * own)

    def _off(self, own: np.ndarray, along: np.ndarray) -> float:
        """The deviation of the largest error, from what is made of waves along one axis and along the other."""
        agrees = self._mixed(self._total(self.target.conj() * along)[:, None] * self._total(own))
        power = self._mixed(self._total(np.abs(along) ** 2)[:, None] * self._total(np.abs(own) ** 2))
        return self.margin * math.sqrt(max(0.0, float((1 + (power - 2 * agrees.real) / self.variance).max())))

    def _transfer(self, weights: np.ndarray, px: float) -> np.ndarray:
        """(places, S, k): what weights (places, nodes) make of a wave of height 1, at each place of a cell."""
        places, count = weights.shape
        between = np.exp(-1j * px * (np.arange(places)[:, None, None] / places) * self.k)
        nodes = (np.exp(1j * px * (j - (count - 1) // 2) * self.k) for j in range(count))
        return between * sum(weights[:, j, None, None] * wave for j, wave in enumerate(nodes))

    def _total(self, values: np.ndarray) -> np.ndarray:
        """(..., S) of (..., S, k)."""
        return (values * self.share).sum(axis=-1)

    def _mixed(self, values: np.ndarray) -> Any:
        """(...) of (..., S)."""
        return values @ self.weight


@lru_cache(maxsize=64)
def field_spectrum(ranges: FieldRanges) -> FieldSpectrum | None:
    """That of `FieldSpectrum.of`."""
    return FieldSpectrum.of(ranges)


@lru_cache(maxsize=1024)
def error_of_cubics(ranges: FieldRanges, stride: float) -> float:
    """The deviation of the largest error of cubics along any two axes; inf where pixels are too coarse for it."""
    spectrum = field_spectrum(ranges)
    return math.inf if spectrum is None else _OBLIQUE * spectrum.error_of_cubics(stride)
