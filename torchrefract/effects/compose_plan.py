"""What a composition will compute under a tolerance.

The composite d_1 of n flows, d_i = d_(i+1) + f_i(p + d_(i+1)), is off by e_1 at most, e_i = e_(i+1) (1 + L_i) + the
error of f_i, L_i being the largest slope of f_i. So the error of each flow counts times the product of 1 + L of those
before it, and what follows a flow whose slope is not known is computed exactly; that flow itself shares in the
tolerance if parts of its ranges may have lattices. A flow that is exact under its share leaves that to the others.
Errors that are of a chance add as deviations do. Of several effects that never act on one sample together, each has the
whole tolerance.

On the CPU part of the tolerance goes to knowing the composite itself every few px; see `composite_errors`.
"""

import math
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import takewhile
from typing import NamedTuple, cast

import torch

from torchrefract.effects.base import Effect
from torchrefract.effects.composite_errors import SELDOM, Error, Share, errors_of
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.plan import Plan, PlanRequest
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.effects.refraction import WarpEffect
from torchrefract.planning.photometric import LightPlan

# Of the tolerance, what flows may have of it where their composite is known seldom, as is tried.
_PARTS = (0.7, 0.55, 0.4)
_MOST_KNOWN = 64
_known = dict[Hashable, tuple[Sequence[Plan], float]]()


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
        if (px := max((plan.every for plan in self.plans if isinstance(plan, Plan)), default=1)) > 1:
            lines.append(f"composite      every {px} px on the CPU (cubics between)")
        widest = max(map(len, self.names))
        for name, plan in zip(self.names, self.plans, strict=True):
            lines.append(f"{name:{widest}}  {plan.summary()}")
        return "\n".join(lines)


class _Warp(NamedTuple):
    place: int  # among all effects
    group: int  # of those that are looked up together
    effect: WarpEffect

    def plan(self, ask: PlanRequest, tolerance: float | None) -> Plan:
        """Its plan under a tolerance, None for exact; if it has none of its own it stays exact."""
        if not isinstance(self.effect, LatticeWarp):
            return self.effect.planned(ask.height, ask.width, torch.float64 if ask.double else torch.float32)
        ask = replace(ask, tolerance_px=None if self.effect.tolerance_px is None else tolerance, ulps=self.effect.ulps)
        if not ask.reachable:
            least = self.effect.plan_within(replace(ask, tolerance_px=2 * ask.rounding))
            # Neighbors that move by less than that each are apart by less than twice as much.
            slope = 4 * ask.rounding if least.stride == 0 else least.slope
            return ask.plan(1, 0.0, "its share of the tolerance is below rounding", slope=slope, smooth=least.smooth)
        return self.effect.plan_within(ask)


def compose_plan(
    effects: Sequence[tuple[Effect, bool]], together: Sequence[Sequence[int]], ask: PlanRequest
) -> ComposePlan:
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
        plans, error = [warp.plan(ask, None) for warp in warps], 0.0
    else:
        ask.room()
        plans, error = _shared(warps, together, ask)
    resamples = len({warp.group for warp, plan in zip(warps, plans, strict=True) if plan.stride > 0})
    by_place = {warp.place: plan for warp, plan in zip(warps, plans, strict=True)}
    each = tuple(
        by_place[place] if place in by_place else _other_plan(effect, idle, ask)
        for place, (effect, idle) in enumerate(effects)
    )
    names = tuple(type(effect).__name__ for effect, _ in effects)
    return ComposePlan(ask.height, ask.width, ask.tolerance_px, names, each, error, resamples)


def _other_plan(effect: Effect, idle: bool, ask: PlanRequest) -> Plan | LightPlan:
    """Of an effect that moves nothing."""
    if idle:
        return _idle_plan(ask, "its strength is 0" if effect.at_rest() else "its p is 0")
    return cast(PlannedLight, effect).planned(ask.height, ask.width, torch.float64 if ask.double else torch.float32)


@lru_cache(maxsize=64)
def _idle_plan(ask: PlanRequest, why: str) -> Plan:
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


def _shared(
    warps: Sequence[_Warp], together: Sequence[Sequence[int]], ask: PlanRequest
) -> tuple[Sequence[Plan], float]:
    """The plan of each warp, and how far the composite is off at most."""
    alone = tuple(warp.plan(ask, ask.tolerance_px) for warp in warps)
    if not all(plan.smooth or _is_exact(plan) for plan in alone):
        return _sought(warps, together, ask)
    # Plans of flows whose smoothness is known tell all that is asked of them; what is exact is so under a share, too.
    key = ask, alone, tuple((warp.place, warp.group) for warp in warps), tuple(map(tuple, together))
    if key not in _known:
        if len(_known) >= _MOST_KNOWN:
            _known.clear()
        _known[key] = _sought(warps, together, ask)
    return _known[key]


def _sought(
    warps: Sequence[_Warp], together: Sequence[Sequence[int]], ask: PlanRequest
) -> tuple[Sequence[Plan], float]:
    """The same: of the composites that are known most seldom the one with the coarsest flows."""
    found = list[tuple[int, list[Plan], float]]()
    parted = any(_meet([warp for warp in warps if warp.place in own]) for own in together)
    for part in _PARTS if parted else ():
        own = replace(ask, tolerance_px=part * cast(float, ask.tolerance_px))
        if own.reachable:
            plans, acting = _in_sets(warps, together, own)
            # What is too coarse stays so with larger strides.
            errors = ((px, _error(acting, px)) for px in SELDOM)
            allowed = list(takewhile(lambda tried: tried[1] <= cast(float, ask.tolerance_px), errors))
            found += [(px, [replace(plan, every=px) for plan in plans], error) for px, error in allowed[-1:]]
    if found:
        return max(found, key=lambda one: one[0])[1:]
    plans, acting = _in_sets(warps, together, ask)
    return plans, _error(acting, 1)


def _meet(warps: Sequence[_Warp]) -> bool:
    """Whether some are looked up together."""
    return len({warp.group for warp in warps}) < len(warps)


def _error(acting: Sequence[Sequence[Share]], every: int) -> float:
    """How far the composite of each set is off at most, if it is known every so many px.

    All of a set count as one composite: light between warps may turn out to change nothing.
    """
    return max((_total(errors_of(shares, every)) for shares in acting), default=0.0)


def _in_sets(
    warps: Sequence[_Warp], together: Sequence[Sequence[int]], ask: PlanRequest
) -> tuple[list[Plan], list[list[Share]]]:
    """What each warp gets, and the shares of each set.

    A warp of several sets gets the smallest of its shares, which is within the others. So that no flow counts as too
    small in one set and has a slope in another, all act together where that would be.
    """
    sets = [[i for i, warp in enumerate(warps) if warp.place in places] for places in together]
    tried = [_in_row([warps[i] for i in own], ask) for own in sets]
    found = list[Share | None]([None] * len(warps))
    for own, shares in zip(sets, tried, strict=True):
        for i, share in zip(own, shares, strict=True):
            before = found[i]
            if before is not None and (before.plan.stride == 0) != (share.plan.stride == 0):
                return _in_sets(warps, [[warp.place for warp in warps]], ask)
            found[i] = share if before is None else min(before, share, key=lambda share: share.tolerance)
    return [share.plan for share in cast(list[Share], found)], tried


def _in_row(warps: Sequence[_Warp], ask: PlanRequest) -> list[Share]:
    """What each warp gets of those that act one after the other."""
    tolerance = ask.tolerance_px or 0.0
    shares = [Share(tolerance / len(warps), warp.plan(ask, tolerance / len(warps))) for warp in warps]
    exact = [False] * len(warps)
    for _ in (*warps, *warps):
        before = [share.plan.stride == 0 for share in shares], exact
        shares = _shared_once(warps, shares, exact, ask)
        # What would come to a lattice by a share that another one leaves stays exact: shares come to an end.
        exact = [own or _is_exact(share.plan) for own, share in zip(exact, shares, strict=True)]
        # A flow that is too small to count under a larger share has given no slope yet.
        if before == ([share.plan.stride == 0 for share in shares], exact):
            break
    return shares


def _is_exact(plan: Plan) -> bool:
    return plan.stride == 1 and plan.error_px == 0


def _shared_once(
    warps: Sequence[_Warp], shares: Sequence[Share], exact: Sequence[bool], ask: PlanRequest
) -> list[Share]:
    """The plans for shares of the tolerance that go by the slopes of earlier ones; some are known to be exact."""
    known = sum(1 for _ in takewhile(lambda share: share.plan.stride == 0 or share.plan.slope < math.inf, shares))
    # The one that comes next has an error, too, where what is drawn may have a lattice of its own.
    sharing = known + any(share.plan.parts for share in shares[known : known + 1])
    erring = [share.plan for share, own in zip(shares[:sharing], exact, strict=False) if not own]
    whole = (ask.tolerance_px or 0.0) / max(1.0, _total([(1.0, plan.random) for plan in erring]))
    found, before = list[Share](), 1.0
    for warp, last, own in zip(warps[:sharing], shares, exact, strict=False):
        found.append(
            Share(0.0, last.plan, before) if own else Share(whole / before, warp.plan(ask, whole / before), before)
        )
        # A flow that is not computed is too small to count.
        before *= 1 + last.plan.slope if last.plan.stride > 0 else 1.0
    follows = Share(0.0, ask.plan(1, 0.0, "it follows a warp whose slope is not known"))
    return found + [share if i == known else follows for i, share in enumerate(shares[sharing:], start=sharing)]


def _total(errors: Iterable[Error]) -> float:
    """Of errors, and whether each is one of a chance: those add as deviations do."""
    found = list(errors)
    return sum(size for size, random in found if not random) + math.hypot(*(size for size, random in found if random))
