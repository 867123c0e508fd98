"""What the effects of random fields will compute under a tolerance: few frequencies, on a lattice.

The error of what is left out and of the cubics between nodes is a Gaussian random field itself, whose variance the
spectrum gives: at every pixel the two components of the error are longer than `_SIGMAS` deviations with a chance of
exp(-_SIGMAS^2 / 2), 2e-11. Covariances with slower spectra than the Gaussian one have too many frequencies for this: an
exponential field has no coarse lattice, it would be smoothed. They are computed exactly.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from torchrefract.effects.plan import Ask, Plan, Smoothness, coarsest
from torchrefract.fields.covariance import REACH
from torchrefract.fields.modes import Modes
from torchrefract.fields.torus import torus
from torchrefract.types import Range
from torchrefract.warping.lattice import STREAM_NODES, lagrange_weights, slope_weights

_SIGMAS, _SLOPE_SIGMAS = 7.0, 4.0
_REACH = 8.0  # deviations of the spectrum beyond which nothing is left of it
_POINTS = 257
# Of axes that are square to one another errors are sqrt(2) times those along one and more, of any up to 1 + 5/4 times.
_OBLIQUE = 2.25 / math.sqrt(2)
_PLACES = 8  # between two nodes, at which cubics are looked at
# Of the tolerance, for frequencies that are left out.
_DROPPED = 0.3
# Fields of unit variance in float32 are off by so much.
_ROUNDING = 4e-6
# More frequencies than these take longer than Fourier transforms of all.
_MOST_MODES = 1 << 18


@dataclass(frozen=True)
class FieldRanges:
    """What a field is drawn from, px; of a stream function if `stream`, whose curl has unit variance."""

    amplitude: Range
    length: Range
    aperture: Range
    stream: bool = False


@dataclass(frozen=True)
class FieldPlan(Plan):
    """A plan with the frequencies that are kept."""

    modes: Modes | None = None


@lru_cache(maxsize=256)
def field_plan(ranges: FieldRanges, ask: Ask) -> Plan:
    """The plan for a Gaussian covariance."""
    if ask.tolerance_px is None:
        return ask.plan(1, 0.0, "no tolerance")
    tolerance, room, most = ask.tolerance_px, ask.room(), _SIGMAS * ranges.amplitude[1]
    if most <= room:
        return ask.plan(0, most, "it moves too little", random=True)
    room -= 0.0 if ask.double else _ROUNDING * most
    if most > min(ask.height, ask.width) or room <= 0:
        return ask.plan(1, 0.0, "it moves too far for a lattice")
    spectrum = _Spectrum.of(ranges)
    if spectrum is None:
        return ask.plan(1, 0.0, "the field has too many frequencies for a lattice")
    # Errors and slopes are not at their largest in one place.
    steep = _SLOPE_SIGMAS * ranges.amplitude[1]
    slope, bend, third = (steep * spectrum.derivative(order) for order in (1, 2, 3))
    known = {"slope": slope, "smooth": Smoothness(bend, third, most * spectrum.lines(), Cubics(ranges))}
    modes = _modes(ranges, ask, spectrum.cutoff(_DROPPED * room / most))
    if modes is None:
        return ask.plan(1, 0.0, "the field has too many frequencies for a lattice", **known)
    more: dict[str, Any] = {"modes": modes, "random": True, **known}
    nodes = STREAM_NODES if ranges.stream else 4
    if ranges.stream:
        more |= {"before": nodes // 2, "after": nodes // 2 - 1}
    counts = "{} x {} of {} x {} frequencies".format(*modes.counts, *modes.size)

    def attempt(stride: int) -> Plan | None:
        off = most * math.hypot(_DROPPED * room / most, spectrum.error_between(stride, nodes))
        if off > room:
            return None
        return FieldPlan(ask.height, ask.width, tolerance, stride, off + tolerance - room, counts, **more)

    return coarsest(attempt) or ask.plan(1, 0.0, "the field is too rough for a lattice", **known)


@dataclass(frozen=True)
class Cubics:
    """As for `Smoothness`."""

    ranges: FieldRanges

    def __call__(self, stride: float) -> float:
        """Px, the largest error."""
        return _error_of_cubics(self.ranges, stride)


@lru_cache(maxsize=1024)
def _error_of_cubics(ranges: FieldRanges, stride: float) -> float:
    spectrum = _Spectrum.of(ranges)
    return math.inf if spectrum is None else _OBLIQUE * _SIGMAS * ranges.amplitude[1] * spectrum.error_of_cubics(stride)


def _modes(ranges: FieldRanges, ask: Ask, cutoff: float) -> Modes | None:
    """The frequencies up to a cutoff, in radians per px; None where there are too many, or one torus is too small."""
    more = 2 if ranges.stream else 0
    reach = {"length": ranges.length[1], "aperture": ranges.aperture[1]}
    size = torus(ask.height + more, ask.width + more, kind="gaussian", **reach)
    modes = Modes(size, *(math.ceil(cutoff * n / (2 * math.pi)) for n in size))
    all_there = all(count < n for count, n in zip(modes.counts, size, strict=True))
    # The sums round a torus that make a covariance periodic are taken where the length has room.
    has_room = REACH["gaussian"] * ranges.length[1] <= min(size)
    return modes if all_there and has_room and math.prod(modes.counts) <= _MOST_MODES else None


class _Spectrum:
    """The roughest field of the ranges, along one axis, at frequencies in radians per px."""

    def __init__(self, k: np.ndarray, share: np.ndarray, *, stream: bool):
        self.k, self.share, self.stream = k, share, stream
        # What a frequency is multiplied by: the central difference of a stream function, or nothing.
        self.target = 1j * np.sin(k) if stream else np.ones_like(k)
        self.variance = self._total(np.abs(self.target) ** 2)

    @classmethod
    def of(cls, ranges: FieldRanges) -> "_Spectrum | None":
        """That of the shortest length and the narrowest aperture; None where pixels are too coarse for it."""
        deviation = 1 / math.hypot(ranges.length[0], math.sqrt(2) * ranges.aperture[0])
        if _REACH * deviation > math.pi:
            return None
        k = np.linspace(-_REACH, _REACH, _POINTS)
        share = np.exp(-0.5 * k * k)
        return cls(deviation * k, share / share.sum(), stream=ranges.stream)

    def lines(self) -> float:
        """The deviation of the largest error of lines between pixels, of a field of variance 1."""
        return self._missed(2, 2, 1)

    def error_of_cubics(self, stride: float) -> float:
        """That of cubics through four of its values along each axis, which for a stream function are of its curl."""
        return self._missed(_PLACES, 4, stride)

    def derivative(self, order: int) -> float:
        """The deviation of the largest derivative of a field of variance 1, in 1/px^order."""
        return math.sqrt(self._total(np.abs(self.target * self.k**order) ** 2) / self.variance)

    def cutoff(self, error: float) -> float:
        """The lowest frequency from which on all others together deviate by no more than this."""
        kept = np.abs(self.k) <= np.abs(self.k)[:, None]
        one, other = (kept * self.share * np.abs(self.target) ** 2).sum(axis=1), (kept * self.share).sum(axis=1)
        left_out = np.sqrt(np.clip(1 - one * other / self.variance, 0, None))
        return float(np.abs(self.k)[left_out <= max(error, left_out.min())].min())

    def error_between(self, stride: int, nodes: int) -> float:
        """The deviation of the largest error of polynomials through so many nodes, of a field of variance 1."""
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
        agrees = self._total(self.target.conj() * along)[:, None] * self._total(own)
        power = self._total(np.abs(along) ** 2)[:, None] * self._total(np.abs(own) ** 2)
        return math.sqrt(max(0.0, float((1 + (power - 2 * agrees.real) / self.variance).max())))

    def _transfer(self, weights: np.ndarray, px: float) -> np.ndarray:
        """(places, k): what weights (places, nodes) make of a wave of height 1, at each place of a cell."""
        places, count = weights.shape
        place = np.arange(count) - (count - 1) // 2 - np.arange(places)[:, None] / places
        return np.einsum("tj,tjk->tk", weights, np.exp(1j * px * place[:, :, None] * self.k))

    def _total(self, values: np.ndarray) -> Any:
        return (values * self.share).sum(axis=-1)
