"""What a composition will compute under a tolerance.

The composite d_1 of n flows, d_i = d_(i+1) + f_i(p + d_(i+1)), is off by e_1 at most, e_i = e_(i+1) (1 + L_i) + the
error of f_i, L_i being the largest slope of f_i. So the error of each flow counts times the product of 1 + L of those
before it, and what follows a flow whose slope is not known is computed exactly. Errors that are of a chance add as
deviations do.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import NamedTuple, cast

import torch

from torchrefract.effects.base import Effect
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.light_plan import LightPlan
from torchrefract.effects.plan import Ask, Plan
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


def compose_plan(effects: Sequence[tuple[Effect, float]], ask: Ask) -> ComposePlan:
    """The plan that is asked for.

    Args:
        effects: those that are no compositions, in order, and the chance that each acts.
        ask: for what.

    Raises:
        ValueError: a tolerance below the rounding of positions in such a frame.
    """
    warps = list(_warps(effects))
    if ask.tolerance_px is None:
        plans = [warp.plan(ask, None) for warp in warps]
    else:
        ask.room()
        plans = _shared(warps, ask)
    error = _total((plan.error_px, plan.random) for plan in plans)
    resamples = len({warp.group for warp, plan in zip(warps, plans, strict=True) if plan.stride > 0})
    by_place = {warp.place: plan for warp, plan in zip(warps, plans, strict=True)}
    found = tuple(
        by_place[place] if place in by_place else _other_plan(effect, p, ask)
        for place, (effect, p) in enumerate(effects)
    )
    names = tuple(type(effect).__name__ for effect, _ in effects)
    return ComposePlan(ask.height, ask.width, ask.tolerance_px, names, found, error, resamples)


def _other_plan(effect: Effect, p: float, ask: Ask) -> Plan | LightPlan:
    """Of an effect that moves nothing."""
    if p == 0:
        return ask.plan(0, 0.0, "its p is 0")
    return cast(PlannedLight, effect).planned(ask.height, ask.width, torch.float64 if ask.double else torch.float32)


def _warps(effects: Sequence[tuple[Effect, float]]) -> Iterator[_Warp]:
    """Those that may move something; what changes light in between parts them."""
    group = 0
    for place, (effect, p) in enumerate(effects):
        if p == 0:
            continue
        if isinstance(effect, WarpEffect):
            yield _Warp(place, group, effect)
        else:
            group += 1


def _shared(warps: Sequence[_Warp], ask: Ask) -> list[Plan]:
    """The plan of each warp, its `error_px` as it counts in the composite."""
    tolerance = ask.tolerance_px or 0.0
    plans = [warp.plan(ask, tolerance / len(warps)) for warp in warps]
    for _ in warps:
        still = [plan.stride == 0 for plan in plans]
        plans = _shared_once(warps, plans, ask)
        # A flow that is too small to count under a larger share has given no slope yet.
        if still == [plan.stride == 0 for plan in plans]:
            break
    return plans


def _shared_once(warps: Sequence[_Warp], plans: Sequence[Plan], ask: Ask) -> list[Plan]:
    """The plans for shares of the tolerance that go by the slopes of earlier ones."""
    smooth = list(takewhile(lambda both: both[1].stride != 1, zip(warps, plans, strict=True)))
    share = (ask.tolerance_px or 0.0) / max(1.0, _total([(1.0, plan.random) for _, plan in smooth]))
    found, before = [], 1.0
    for warp, plan in smooth:
        new = warp.plan(ask, share / before)
        found.append(replace(new, error_px=before * new.error_px))
        # A flow that is not computed is too small to count.
        before *= 1 + plan.slope if plan.stride > 0 else 1.0
    follows = ask.plan(1, 0.0, "it follows a warp whose slope is not known")
    return found + [plan if i == 0 else follows for i, plan in enumerate(plans[len(smooth) :])]


def _total(errors: Iterable[tuple[float, bool]]) -> float:
    """Of errors, and whether each is one of a chance: those add as deviations do."""
    found = list(errors)
    return sum(size for size, random in found if not random) + math.hypot(*(size for size, random in found if random))
