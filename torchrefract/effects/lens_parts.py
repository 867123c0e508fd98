"""Plans for parts of the ranges that lenses are drawn from.

The strongest lens of the ranges decides how fine a lattice for all of them is. Where it can be read which lens was
drawn, a plan that would be fine is replaced by that for the half of the ranges that the lens lies in, or for a half of
that half, and so on: a few plans in all, each made when the first lens asks for it, and each within the tolerance for
the same reasons as that of the whole. Which lens gets which plan depends on its own numbers alone.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from torchrefract.effects.lens_plan import lens_plan
from torchrefract.effects.plan import Plan, PlanRequest
from torchrefract.fields.lens_bounds import LensRanges, moved_by_terms
from torchrefract.warping.lattice import Lattice

# Px: with more than so many between nodes they cost next to nothing.
_COARSE = 4
_MOST_HALVINGS = 5
# Plans cost time, too, and small frames are soon done.
_SMALLEST_FRAME = 1 << 16


@lru_cache(maxsize=2048)
def plan_in_parts(boxes: tuple[LensRanges, ...], ask: PlanRequest) -> Plan:
    """The plan of `lens_plan`, said to have parts if lenses may get coarser ones of their own."""
    plan = lens_plan(boxes, ask)
    wide = len(boxes) > 1 or any(low != high for box in boxes for low, high in box.numbers)
    if ask.tolerance_px is None or not _is_fine(plan) or not wide or ask.height * ask.width < _SMALLEST_FRAME:
        return plan
    return replace(plan, parts=True, error_px=ask.tolerance_px)


def plan_of_lens(boxes: tuple[LensRanges, ...], lens: Sequence[float], ask: PlanRequest) -> Plan:
    """The plan for one lens.

    Args:
        boxes: what lenses are drawn from.
        lens: 16 numbers, in the order of `LensRanges`, in one of the boxes.
        ask: for what, with a tolerance.
    """
    box = min(boxes, key=lambda box: _farthest_outside(box, lens))
    plan = lens_plan((box,), ask)
    for _ in range(_MOST_HALVINGS):
        halves = _halves(box, ask.height, ask.width) if _is_fine(plan) else None
        if halves is None:
            break
        place, low, high = halves
        box = low if lens[place] < high.numbers[place][0] else high
        plan = lens_plan((box,), ask)
    return plan


def _is_fine(plan: Plan) -> bool:
    return 0 < plan.stride < _COARSE


@lru_cache(maxsize=2048)
def _halves(box: LensRanges, height: int, width: int) -> tuple[int, LensRanges, LensRanges] | None:
    """The two halves of the range that parts mild lenses from strong ones best, and its place; None for one lens."""
    tried = [(place, *_halved(box, place)) for place, (low, high) in enumerate(box.numbers) if low != high]
    return min(tried, key=lambda halves: min(_strength(half, height, width) for half in halves[1:]), default=None)


def _strength(box: LensRanges, height: int, width: int) -> float:
    """How far lenses may move a pixel, px, roughly; inf where one may fold."""
    moved = moved_by_terms((box,), Lattice(height, width, 1))
    return math.inf if moved is None else sum(moved)


def _halved(box: LensRanges, place: int) -> tuple[LensRanges, LensRanges]:
    numbers = box.numbers
    low, high = numbers[place]
    middle = (low + high) / 2
    below, above = ([*numbers[:place], half, *numbers[place + 1 :]] for half in ((low, middle), (middle, high)))
    return LensRanges.of(below), LensRanges.of(above)


def _farthest_outside(box: LensRanges, lens: Sequence[float]) -> float:
    """By how much the number of a lens that is farthest outside of its range is, relative to its size."""
    ranges = zip(lens, box.numbers, strict=True)
    return max(max(low - value, value - high, 0.0) / max(abs(low), abs(high), 1e-9) for value, (low, high) in ranges)
