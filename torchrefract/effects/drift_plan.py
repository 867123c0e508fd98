"""What fog in drifts will compute under a tolerance: where it is seen, of fewer octaves, the long ones on a lattice.

Pixels whose t is so small that nothing is seen of the scene count as t = 0, those whose t is so near to 1 that nothing
is seen of the fog as t = 1, by the t that is computed. Octaves have a share of the tolerance, and these ends what is
left of it.

With q = 1/2 + n / sqrt(2) and m = <q> fog is t = exp(-x r), x = k0 (1 + deviation) d, r = q / m. Another noise n + e
has another mean, m + f, and r changes by

    |r' - r| = |e' - r f'| / (m + f'),  e' = e / sqrt(2),  f' = <e> / sqrt(2)
    |t' - t| <= exp(-x r_low) (1 - exp(-x |e'| / m_low)) + |f'| / m_low max over y of y exp(-y)

where r_low is the smaller of q / m and (q + e') / m, at least 0. e and n are sub-Gaussian, see `perlin_bounds`: at a
pixel they lie in the ellipse of their variances and their covariance, `SIGMAS` deviations wide, and neither is beyond
its own `largest_sum`; means likewise. Over that and over all x up to that of the farthest pixel the bound is looked
for.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from torchrefract.effects.fog_plan import FogPlan
from torchrefract.effects.plan import STRIDES
from torchrefract.fields.perlin import BAND
from torchrefract.fields.perlin_bounds import (
    VARIANCE,
    Error,
    error_between,
    error_without,
    largest_sum,
    mean_variance,
)
from torchrefract.fields.veils import Ends
from torchrefract.planning.photometric import Blend, check_level_reachable, named, thicknesses, whole

SIGMAS = 7.0
MARGIN = 1.05  # for what lies between the x and the places that are looked at
# A mean nearer to zero than this has no bound of its own.
_LEAST_MEAN = 0.1
# Of the room, which octaves may take.
_OF_OCTAVES = 0.75
# Less work than this of all is worth a step more.
_WORTH = 0.85
# What one more pass over the frame takes in float64, in products for each pixel.
_PASS = 16
# What kernels take between four rows of nodes, between four columns of them, for a node of Perlin's lattice in a row of
# pixels, to draw one, and to begin with a lattice at all: measured, in octaves at a pixel.
_DOWN, _ACROSS, _LINE, _NODE, _START = 0.3, 1.4, 0.5, 2.5, 3e4
_HALF = math.sqrt(0.5)  # of q over that of n


@dataclass(frozen=True)
class Drifts:
    """What fog in the image is made of.

    thickness: the largest k0 (1 + deviation) d, inf for a depth that is not known.
    periods: px, of the octaves.
    shares: of each in the noise, of sum 1.
    of_image: <q> is that over the image, else 1/2.
    """

    thickness: float
    periods: tuple[float, ...]
    shares: tuple[float, ...]
    of_image: bool
    blend: Blend


@dataclass(frozen=True)
class DriftPlan(FogPlan):
    """A plan with the octaves that are computed at every pixel, and those on a lattice; without any, that of a fog.

    fine, coarse: their numbers.
    stride: px, between the nodes of the lattice; 1 is none.
    is_uniform: no drifts are left.
    """

    fine: tuple[int, ...] = ()
    coarse: tuple[int, ...] = ()
    stride: int = 1
    is_uniform: bool = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "is_uniform", not (self.fine or self.coarse))

    def of_uniform(self, fog: FogPlan) -> "DriftPlan":
        """The same, where no drifts are left, with what a plan that knows its error says of the fog that is."""
        own: Any = {name: getattr(fog, name) for name in ("error", "bands", "details", "nodes", "ends")}
        return replace(self, dropped=self.dropped + fog.dropped, **own)


class _Choice(NamedTuple):
    fine: tuple[int, ...]
    coarse: tuple[int, ...]
    stride: int
    error: float


@lru_cache(maxsize=256)
def drift_plan(drifts: Drifts, height: int, width: int, tolerance: float | None, double: bool) -> DriftPlan:
    """The plan for frames of a size, in float64 or in float32."""
    octaves = tuple(range(len(drifts.periods)))
    every = _Choice(octaves, (), 1, 0.0)
    plan = partial(DriftPlan, height, width, tolerance)
    computed = whole("computed", height)
    names = tuple(_name(drifts, i) for i in octaves)
    if tolerance is None:
        return plan(0.0, "no tolerance", computed, names, fine=octaves)
    room = check_level_reachable(tolerance, linear=drifts.blend.linear, double=double)
    least = _lowest_mean(drifts, height, width)
    if least < _LEAST_MEAN:
        ends, seldom = ends_of(drifts, room, math.inf)
        return plan(
            tolerance, "the mean over the frame may come near 0", computed, names, seldom, fine=octaves, ends=ends
        )
    if (seen := seen_of_all(drifts, 1 / least)) <= room:
        return plan(seen, "it is too thin", whole("left", height), dropped=(("fog", seen),), fine=octaves)
    work = partial(_products, drifts, height=height) if double else partial(_work, drifts, area=height * width)
    best, why = min(_choices(drifts, height, width, room), key=work, default=every), "what octaves can move"
    if work(best) > _WORTH * work(every):
        best, why = every, "no octave can be left out or made coarser"
    fine, coarse, stride, error = best
    kept = tuple(name for i, name in enumerate(names) if i in (*fine, *coarse))
    dropped = tuple((names[i], _error(drifts, {i: None}, height, width)) for i in octaves if i not in (*fine, *coarse))
    if not kept:
        return plan(error, why, computed, dropped=dropped)
    ends, seldom = ends_of(drifts, room - error, 1 / least)
    on_lattice = (("on a lattice", ", ".join(names[i] for i in coarse) + f", every {stride} px"),) if coarse else ()
    return plan(
        tolerance, why, computed, kept, dropped + seldom,
        details=on_lattice, fine=fine, coarse=coarse, stride=stride, ends=ends,
    )  # fmt: skip


def ends_of(drifts: Drifts, room: float, most: float) -> tuple[Ends, tuple[tuple[str, float], ...]]:
    """Those of t that move nothing farther, and what they leave out, where q / <q> is at most so large."""
    ends = drifts.blend.ends(room).within(math.exp(-drifts.thickness * most), 1.0)
    return ends, named(ends, room)


def seen_of_all(drifts: Drifts, ratio: float) -> float:
    """Levels, by which the whole fog can move the image, where q / <q> is at most so large."""
    return float(drifts.blend.left(np.exp(-np.array([drifts.thickness * ratio])))[0])


def _choices(drifts: Drifts, height: int, width: int, room: float) -> list[_Choice]:
    """What keeps a share of the room: octaves of the least weight dropped, the longest on the widest lattice."""
    room *= _OF_OCTAVES
    by_share = sorted(range(len(drifts.shares)), key=lambda i: drifts.shares[i])
    found = []
    for dropped in range(len(by_share) + 1):
        out = dict.fromkeys(by_share[:dropped])
        error = _error(drifts, out, height, width)
        if error > room:
            break
        kept = sorted(by_share[dropped:], key=lambda i: -drifts.periods[i])
        found.append(_Choice(tuple(kept), (), 1, error))
        for coarse in range(1, len(kept) + 1):
            attempt = _coarsest(drifts, out, kept[:coarse], height, width, room)
            if attempt is None:
                break
            stride, error = attempt
            found.append(_Choice(tuple(kept[coarse:]), tuple(kept[:coarse]), stride, error))
    return found


def _coarsest(
    drifts: Drifts, out: dict[int, None], coarse: Sequence[int], height: int, width: int, room: float
) -> tuple[int, float] | None:
    """The largest stride, and its error, for octaves on a lattice."""
    found, low, high = None, 0, sum(stride <= min(drifts.periods[i] for i in coarse) for stride in STRIDES)
    while low < high:
        middle = (low + high) // 2
        error = _error(drifts, out | dict.fromkeys(coarse, STRIDES[middle]), height, width)
        found, low, high = ((STRIDES[middle], error), middle + 1, high) if error <= room else (found, low, middle)
    return found


def _products(drifts: Drifts, choice: _Choice, height: int) -> float:
    """Multiplications for each pixel; see `perlin_noise`."""
    band = min(BAND, height)
    lines = sum(2 * (math.ceil((band - 1) / drifts.periods[i]) + 2) for i in choice.fine)
    if choice.coarse:
        lines += _PASS + (band + choice.stride - 2) // choice.stride + 4 + 8 * len(choice.coarse) / choice.stride**2
    return lines


def _work(drifts: Drifts, choice: _Choice, area: int) -> float:
    """Of kernels, in octaves at a pixel; see `drawn_noise`. Nodes are drawn once, whatever the stride."""

    def octave(period: float, stride: int) -> float:
        return 1 / stride**2 + _LINE / (stride * period) + _NODE / period**2

    work = sum(octave(drifts.periods[i], 1) for i in choice.fine)
    if choice.coarse:
        work += _START / area + _DOWN + _ACROSS / choice.stride
        work += sum(octave(drifts.periods[i], choice.stride) for i in choice.coarse)
    return work


def _error(drifts: Drifts, changed: dict[int, int | None], height: int, width: int) -> float:
    """Levels, by which the image can be off where octaves are dropped (None) or known every so many px."""
    if not changed:
        return 0.0
    parts = [(drifts.shares[i], _part(drifts.periods[i], stride, height, width)) for i, stride in changed.items()]
    variance = sum(share**2 * part.variance for share, part in parts)
    covariance = sum(share**2 * part.covariance for share, part in parts)
    if variance == 0:
        return 0.0
    deviation = math.sqrt(variance)
    most = largest_sum([share**2 * part.variance for share, part in parts], [part.nodes for _, part in parts], SIGMAS)
    most = min(SIGMAS, most / deviation)
    own = sum(share**2 for share in drifts.shares) * VARIANCE
    z = np.linspace(0, most, 25)
    beside = np.sqrt(max(own - covariance**2 / variance, 0.0) * (SIGMAS**2 - z**2))
    deepest = largest_sum([VARIANCE * share**2 for share in drifts.shares], [4] * len(drifts.shares), SIGMAS)
    lowest = 0.5 - _HALF * np.minimum(covariance / deviation * z + beside, deepest)
    off = _HALF * deviation * z
    mean = _HALF * SIGMAS * math.sqrt(sum(share**2 * part.mean for share, part in parts)) if drifts.of_image else 0.0
    least, greatest = _mean_bounds(drifts, height, width)
    least = least - mean
    if least <= 0:
        return math.inf
    r_low, r_off = np.maximum(lowest - off, 0) / greatest, off / least
    x = thicknesses(drifts.thickness)
    at = np.exp(-x * r_low[:, None])
    moved = (at * -np.expm1(-x * r_off[:, None]) * drifts.blend.slope(at)).max()
    y = np.linspace(0, 1, 60)[1:] * min(1.0, drifts.thickness * greatest / least)
    moved += mean / least * (y * np.exp(-y) * drifts.blend.slope(np.exp(-y))).max()
    return MARGIN * float(moved)


def _part(period: float, stride: int | None, height: int, width: int) -> Error:
    return error_without(period, height, width) if stride is None else error_between(period, stride, height, width)


def _lowest_mean(drifts: Drifts, height: int, width: int) -> float:
    return _mean_bounds(drifts, height, width)[0]


def _mean_bounds(drifts: Drifts, height: int, width: int) -> tuple[float, float]:
    """Of <q>."""
    if not drifts.of_image:
        return 0.5, 0.5
    pairs = zip(drifts.shares, drifts.periods, strict=True)
    variance = sum(share**2 * mean_variance(period, height, width) for share, period in pairs)
    off = _HALF * min(SIGMAS * math.sqrt(variance), _HALF)
    return 0.5 - off, 0.5 + off


def _name(drifts: Drifts, octave: int) -> str:
    return f"octave of {drifts.periods[octave]:g} px"
