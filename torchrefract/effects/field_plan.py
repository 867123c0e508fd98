"""What the effects of random fields will compute under a tolerance: few frequencies, on a lattice.

The error of what is left out and of the cubics between nodes is a Gaussian random field itself, whose variance the
spectrum gives: at every pixel the two components of the error are longer than `_SIGMAS` deviations with a chance of
exp(-_SIGMAS^2 / 2), 2e-11. Covariances with slower spectra than the Gaussian one have too many frequencies for this,
unless an aperture smooths them: an exponential field by itself has no coarse lattice, that would be a smoothing of its
own. Those are computed exactly.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from torchrefract.effects.plan import STRIDES, Plan, PlanRequest, Smoothness, coarsest
from torchrefract.fields.covariance import REACH, slope_rms
from torchrefract.fields.field_bounds import FieldRanges, FieldSpectrum, error_of_cubics, field_spectrum
from torchrefract.fields.length_bounds import nodes_needed
from torchrefract.fields.modes import Modes
from torchrefract.fields.torus import torus
from torchrefract.warping.lattice import STREAM_NODES

_SIGMAS, _SLOPE_SIGMAS = 7.0, 4.0
# Of the tolerance, for frequencies that are left out.
_DROPPED = 0.3
# Fields of unit variance in float32 are off by so much, and those whose eigenvalues are interpolated by so much more.
_ROUNDING, _INTERPOLATED = 4e-6, 1e-5
# An aperture below half a pixel smooths pixels by so much less than slopes count with.
_NARROW = 1.1
# More frequencies than these take longer than Fourier transforms of all; of those of other covariances, such a share.
_MOST_MODES, _MOST_OF_ALL = 1 << 18, 0.5


@dataclass(frozen=True)
class FieldPlan(Plan):
    """A plan with the frequencies that are kept.

    modes: the frequencies; None for all.
    nodes: lengths that their eigenvalues are interpolated between, see `low_eigenvalues`.
    """

    modes: Modes | None = None
    nodes: int | None = None


@lru_cache(maxsize=256)
def field_plan(ranges: FieldRanges, ask: PlanRequest) -> Plan:
    """The plan for fields of some ranges."""
    if ask.tolerance_px is None:
        return ask.plan(1, 0.0, "no tolerance")
    room, most = ask.room(), _SIGMAS * ranges.amplitude[1]
    if most <= room:
        return ask.plan(0, most, "it moves too little", random=True)
    room -= (0.0 if ask.double else _ROUNDING * most) + (0.0 if ranges.kind == "gaussian" else _INTERPOLATED * most)
    if most > min(ask.height, ask.width) or room <= 0:
        return ask.plan(1, 0.0, "it moves too far for a lattice")
    spectrum = field_spectrum(ranges)
    known = _known(ranges, spectrum)
    if spectrum is None:
        return ask.plan(1, 0.0, "the field has too many frequencies for a lattice", **known)
    return _planned(ranges, spectrum, ask, room, known) or ask.plan(
        1, 0.0, "the field is too rough for a lattice", **known
    )


def _planned(
    ranges: FieldRanges, spectrum: FieldSpectrum, ask: PlanRequest, room: float, known: dict[str, Any]
) -> Plan | None:
    """The plan with the fewest nodes, or else with few frequencies at every pixel."""
    most, taps = _SIGMAS * ranges.amplitude[1], STREAM_NODES if ranges.stream else 4
    beside = {"before": taps // 2, "after": taps // 2 - 1} if ranges.stream else {}

    def plan(stride: int, modes: Modes, off: float, **more: Any) -> FieldPlan:
        counts = "{} x {} of {} x {} frequencies".format(*modes.counts, *modes.size)
        own = known | more | {"modes": modes, "nodes": _nodes(ranges, modes), "random": True}
        error = off + (ask.tolerance_px or 0.0) - room
        return FieldPlan(ask.height, ask.width, ask.tolerance_px, stride, error, counts, **own)

    if (modes := _modes(ranges, ask, spectrum.cutoff(_DROPPED * room / most))) is not None:

        def attempt(stride: int) -> Plan | None:
            off = most * math.hypot(_DROPPED * room / most, spectrum.error_between(stride, taps))
            return plan(stride, modes, off, **beside) if off <= room else None

        if (found := coarsest(attempt)) is not None:
            return found if ranges.kind == "gaussian" else attempt(_quickest(found.stride, modes.size))
    if ranges.kind == "gaussian":
        return None
    fewest = _modes(ranges, ask, spectrum.cutoff(room / most))
    return None if fewest is None else plan(1, fewest, room)


def _quickest(most: int, size: tuple[int, int]) -> int:
    """Of strides up to one that with the fewest points to transform: those that `low_field` has of the torus."""
    strides = [stride for stride in STRIDES if stride <= most]
    return min(strides, key=lambda stride: (math.prod(n // math.gcd(stride, n) for n in size), -stride))


@dataclass(frozen=True)
class Cubics:
    """As for `Smoothness`."""

    ranges: FieldRanges

    def __call__(self, stride: float) -> float:
        """Px, the largest error."""
        return _SIGMAS * self.ranges.amplitude[1] * error_of_cubics(self.ranges, stride)


def _known(ranges: FieldRanges, spectrum: FieldSpectrum | None) -> dict[str, Any]:
    """What a plan says of the field."""
    # Errors and slopes are not at their largest in one place.
    steep = _SLOPE_SIGMAS * ranges.amplitude[1]
    if spectrum is not None:
        slope, bend, third = (steep * spectrum.derivative(order) for order in (1, 2, 3))
        lines = _SIGMAS * ranges.amplitude[1] * spectrum.lines()
        return {"slope": slope, "smooth": Smoothness(bend, third, lines, Cubics(ranges))}
    if ranges.stream:
        return {}
    shortest, narrowest = (torch.tensor([value[0]]) for value in (ranges.length, ranges.aperture))
    return {"slope": _NARROW * steep * slope_rms(shortest, kind=ranges.kind, aperture=narrowest).item()}


def _modes(ranges: FieldRanges, ask: PlanRequest, cutoff: float) -> Modes | None:
    """The frequencies up to a cutoff, in radians per px; None where there are too many, or one torus is too small."""
    sides = [side + (2 if ranges.stream else 0) for side in (ask.height, ask.width)]
    reach = REACH[ranges.kind] * ranges.length[1]
    size = torus(*sides, kind=ranges.kind, length=ranges.length[1], aperture=ranges.aperture[1])
    modes = Modes(size, *(math.ceil(cutoff * n / (2 * math.pi)) for n in size))
    all_there = all(count < n for count, n in zip(modes.counts, size, strict=True))
    count = math.prod(modes.counts)
    if ranges.kind == "gaussian":
        # The sums round a torus that make a covariance periodic are taken where the length has room.
        return modes if all_there and reach <= min(size) and count <= _MOST_MODES else None
    # What is clipped on a torus that is too small is told by who makes all of the field.
    has_room = all(side + reach <= n for side, n in zip(sides, size, strict=True))
    few = all_there and has_room and count <= _MOST_OF_ALL * math.prod(size)
    return modes if few and _nodes(ranges, modes) is not None else None


@lru_cache(maxsize=64)
def _nodes(ranges: FieldRanges, modes: Modes) -> int | None:
    if ranges.kind == "gaussian":
        return None
    share = _INTERPOLATED**2
    return nodes_needed(modes.size, ranges.length, kind=ranges.kind, aperture=ranges.aperture[0], share=share)
