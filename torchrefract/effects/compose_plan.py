"""What a composition will compute under a tolerance.

The composite d_1 of n flows, d_i = d_(i+1) + f_i(p + d_(i+1)), is off by e_1 at most, e_i = e_(i+1) (1 + L_i) + the
error of f_i, L_i being the largest slope of f_i. So the error of each flow counts times the product of 1 + L of those
before it, and what follows a flow whose slope is not known is computed exactly; that flow itself shares in the
tolerance if parts of its ranges may have lattices. Errors that are of a chance add as deviations do. Of several effects
that never act on one sample together, each has the whole tolerance.

Where a later flow leads, f_i is read linearly between pixels. With what is left of the tolerance it is read between
every second or fourth: that adds no more than its largest error between these, as lines from every h-th pixel to the
next are themselves lines from pixel to pixel.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import takewhile
from typing import NamedTuple, cast

import torch

from torchrefract.effects.base import Effect
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.light_plan import LightPlan
from torchrefract.effects.plan import READINGS, Ask, Plan
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.effects.refraction import WarpEffect


@dataclass(frozen=True)
class ComposePlan:
    """How a composition computes its flow for frames of one size.

    height, width: px, of the frame.
    tolerance_px: how far the composite may be from the exact one; None is exact.
    names: of the effects, in order.
    plans: of each effect.
    error_px: how far the composite is off at most.
    resamples: how often the image is looked up.
    """

    height: int
    width: int
    tolerance_px: float | None
    names: tuple[str, ...]
    plans: tuple[Plan | LightPlan, ...]
    error_px: float
    resamples: int

    def __str__(self) -> str:
        told = "none: exact" if self.tolerance_px is None else f"{self.tolerance_px:g} px"
        lines = [
            f"frame          {self.height} x {self.width} px",
            f"tolerance      {told}",
            f"error at most  {self.error_px:.2g} px",
            f"resamples      {self.resamples}",
        ]
        widest = max(map(len, self.names))
        for name, plan in zip(self.names, self.plans, strict=True):
            lines.append(f"{name:{widest}}  {plan.summary()}")
        return "\n".join(lines)


class _Warp(NamedTuple):
    place: int  # among all effects
    group: int  # of those that are looked up together
    effect: WarpEffect

    def plan(self, ask: Ask, tolerance: float | None) -> Plan:
        """Its plan under a tolerance, None for exact; if it has none of its own it stays exact."""
        if not isinstance(self.effect, LatticeWarp):
            return self.effect.planned(ask.height, ask.width, torch.float64 if ask.double else torch.float32)
        ask = replace(ask, tolerance_px=None if self.effect.tolerance_px is None else tolerance)
        if not ask.reachable:
            return ask.plan(1, 0.0, "its share of the tolerance is below rounding")
        return self.effect.plan_within(ask)


def compose_plan(effects: Sequence[tuple[Effect, bool]], together: Sequence[Sequence[int]], ask: Ask) -> ComposePlan:
    """The plan that is asked for.

    Args:
        effects: those that are no compositions, in order, and whether each changes nothing.
        together: their places, as sets that may act on one sample.
        ask: for what.

    Raises:
        ValueError: a tolerance below the rounding of positions in such a frame.
    """
    warps = list(_warps(effects))
    if ask.tolerance_px is None:
        found, error = [_Share(0.0, warp.plan(ask, None)) for warp in warps], 0.0
    else:
        ask.room()
        found, error = _shared(warps, together, ask)
    plans = [share.plan for share in found]
    resamples = len({warp.group for warp, plan in zip(warps, plans, strict=True) if plan.stride > 0})
    by_place = {warp.place: plan for warp, plan in zip(warps, plans, strict=True)}
    each = tuple(
        by_place[place] if place in by_place else _other_plan(effect, idle, ask)
        for place, (effect, idle) in enumerate(effects)
    )
    names = tuple(type(effect).__name__ for effect, _ in effects)
    return ComposePlan(ask.height, ask.width, ask.tolerance_px, names, each, error, resamples)


def _other_plan(effect: Effect, idle: bool, ask: Ask) -> Plan | LightPlan:
    """Of an effect that moves nothing."""
    if idle:
        return _idle_plan(ask, "its strength is 0" if effect.at_rest() else "its p is 0")
    return cast(PlannedLight, effect).planned(ask.height, ask.width, torch.float64 if ask.double else torch.float32)


@lru_cache(maxsize=64)
def _idle_plan(ask: Ask, why: str) -> Plan:
    return ask.plan(0, 0.0, why)


def _warps(effects: Sequence[tuple[Effect, bool]]) -> Iterator[_Warp]:
    """Those that may move something; what changes light in between parts them."""
    group = 0
    for place, (effect, idle) in enumerate(effects):
        if idle:
            continue
        if isinstance(effect, WarpEffect):
            yield _Warp(place, group, effect)
        else:
            group += 1


class _Share(NamedTuple):
    """A warp's part in a composite."""

    tolerance: float  # px, that its flow may be off by; 0 is exact
    plan: Plan  # for it
    stretched: float = 1.0  # how often its error counts in the composite


def _shared(warps: Sequence[_Warp], together: Sequence[Sequence[int]], ask: Ask) -> tuple[list[_Share], float]:
    """What each warp gets, and how far the composite is off at most.

    A warp of several sets gets the smallest of its shares, which is within the others. So that no flow counts as too
    small in one set and has a slope in another, all act together where that would be.
    """
    sets = [[i for i, warp in enumerate(warps) if warp.place in places] for places in together]
    tried = [_in_row([warps[i] for i in own], ask) for own in sets]
    found = list[_Share | None]([None] * len(warps))
    for own, shares in zip(sets, tried, strict=True):
        for i, share in zip(own, shares, strict=True):
            before = found[i]
            if before is not None and (before.plan.stride == 0) != (share.plan.stride == 0):
                return _shared(warps, [[warp.place for warp in warps]], ask)
            found[i] = share if before is None else min(before, share, key=lambda share: share.tolerance)
    shares = cast(list[_Share], found)
    acting = [dict(zip(own, shares, strict=True)) for own, shares in zip(sets, tried, strict=True)]
    plans, error = _read_seldom([share.plan for share in shares], warps, acting, ask)
    return [share._replace(plan=plan) for share, plan in zip(shares, plans, strict=True)], error


def _read_seldom(
    plans: Sequence[Plan], warps: Sequence[_Warp], acting: Sequence[Mapping[int, _Share]], ask: Ask
) -> tuple[list[Plan], float]:
    """The plans with the px at which later warps read their flows, as coarse as is allowed, and the largest error.

    acting: of each set of warps that act together, by their places among all.
    """

    def error(plans: Sequence[Plan]) -> float:
        sets = (((_read_error(plans[i], share), share.plan.random) for i, share in own.items()) for own in acting)
        return max(map(_total, sets), default=0.0)

    def is_read(i: int) -> bool:
        later = (j for own in acting if i in own for j in own if j > i and warps[j].group == warps[i].group)
        return plans[i].stride > 1 and not plans[i].parts and any(plans[j].stride > 0 for j in later)

    found = list(plans)
    for px, i in itertools.product(READINGS, filter(is_read, range(len(plans)))):
        coarser = [replace(plan, every=px) if i == j else plan for j, plan in enumerate(found)]
        if px in dict(found[i].readings) and error(coarser) <= (ask.tolerance_px or 0.0):
            found = coarser
    return found, error(found)


def _read_error(plan: Plan, share: _Share) -> float:
    """How far the composite is off by a flow, in all."""
    return (share.plan.error_px + dict(plan.readings).get(plan.every, 0.0)) * share.stretched


def _in_row(warps: Sequence[_Warp], ask: Ask) -> list[_Share]:
    """What each warp gets of those that act one after the other."""
    tolerance = ask.tolerance_px or 0.0
    shares = [_Share(tolerance / len(warps), warp.plan(ask, tolerance / len(warps))) for warp in warps]
    for _ in warps:
        still = [share.plan.stride == 0 for share in shares]
        shares = _shared_once(warps, shares, ask)
        # A flow that is too small to count under a larger share has given no slope yet.
        if still == [share.plan.stride == 0 for share in shares]:
            break
    return shares


def _shared_once(warps: Sequence[_Warp], shares: Sequence[_Share], ask: Ask) -> list[_Share]:
    """The plans for shares of the tolerance that go by the slopes of earlier ones."""
    smooth = sum(1 for _ in takewhile(lambda share: share.plan.stride != 1, shares))
    # The one that comes next has an error, too, where what is drawn may have a lattice of its own.
    sharing = smooth + any(share.plan.parts for share in shares[smooth : smooth + 1])
    whole = (ask.tolerance_px or 0.0) / max(1.0, _total([(1.0, share.plan.random) for share in shares[:sharing]]))
    found, before = list[_Share](), 1.0
    for warp, last in zip(warps[:sharing], shares[:sharing], strict=True):
        found.append(_Share(whole / before, warp.plan(ask, whole / before), before))
        # A flow that is not computed is too small to count.
        before *= 1 + last.plan.slope if last.plan.stride > 0 else 1.0
    follows = _Share(0.0, ask.plan(1, 0.0, "it follows a warp whose slope is not known"))
    return found + [share if i == smooth else follows for i, share in enumerate(shares[sharing:], start=sharing)]


def _total(errors: Iterable[tuple[float, bool]]) -> float:
    """Of errors, and whether each is one of a chance: those add as deviations do."""
    found = list(errors)
    return sum(size for size, random in found if not random) + math.hypot(*(size for size, random in found if random))
