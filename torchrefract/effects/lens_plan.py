"""What a lens will compute under a tolerance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from torch import Tensor

from torchrefract.cameras.distortion import POLYNOMIAL12, Terms
from torchrefract.effects.plan import STRIDES, Plan, PlanRequest, Smoothness, coarsest, in_ranges
from torchrefract.fields.lens_bounds import LensRanges, lens_errors, lens_numbers, moved_by_terms
from torchrefract.warping.lattice import Lattice

# Of the tolerance: for the terms that are left out and for Newton's method; the rest is for the cubics.
_DROPPED, _NEWTON = 0.2, 0.1
# Farther from the center the sampler of an exact flow clamps positions.
MOST_STRETCH = 3.0
# What goes together or not at all, the least important first.
_GROUPS = (range(8, 12), range(6, 8), (5,), (4,), (3,), (2,), (1,), (0,))


def params_in_range(ranges: LensRanges, coefficients: Tensor, focal: Tensor, center: Tensor) -> Tensor:
    """(), bool: lenses (B, 12), (B, 2), (B, 2) all lie in the ranges, but for rounding."""
    return in_ranges(lens_numbers(coefficients, focal, center), ranges.numbers)


@lru_cache(maxsize=2048)
def lens_plan(boxes: tuple[LensRanges, ...], ask: PlanRequest) -> Plan:
    """The plan for lenses that are drawn from any of the boxes."""
    if ask.tolerance_px is None:
        return ask.plan(1, 0.0, "no tolerance")
    tolerance, room = ask.tolerance_px, ask.room()
    used = [any(box.coefficients[i] != (0.0, 0.0) for box in boxes) for i in range(12)]
    if not any(used):
        return ask.plan(0, 0.0, "no coefficient is other than zero")
    moved = moved_by_terms(boxes, Lattice(ask.height, ask.width, STRIDES[0]))
    if moved is None:
        return ask.plan(1, 0.0, "a lens of the ranges may fold inside the frame")
    kept, dropped = _terms(used, moved, _DROPPED * room)
    left_out = sum(size for _, size in dropped)
    if not kept:
        return ask.plan(0, left_out, "it moves too little", dropped=dropped)

    def attempt(stride: int) -> Plan | None:
        lattice = Lattice(ask.height, ask.width, stride)
        errors = lens_errors(boxes, lattice) if moved_by_terms(boxes, lattice) else None
        if errors is None or errors.stretch > MOST_STRETCH or left_out + errors.cubic > (1 - _NEWTON) * room:
            return None
        steps = next((n for n, error in enumerate(errors.newton) if error <= _NEWTON * room), None)
        if steps is None:
            return None
        error = left_out + errors.cubic + errors.newton[steps] + tolerance - room
        # Lines between miss h^2 / 8 of a second derivative along each axis.
        smooth = Smoothness(errors.bend, errors.third, errors.bend / 8, Cubics(boxes, ask.height, ask.width))
        more = {"slope": errors.slope, "steps": steps, "kept": kept, "dropped": dropped, "smooth": smooth}
        return ask.plan(stride, error, "cubics between", **more)

    if (plan := coarsest(attempt)) is not None:
        return plan
    errors = lens_errors(boxes, Lattice(ask.height, ask.width, STRIDES[0]))
    slope = math.inf if errors is None or errors.stretch > MOST_STRETCH else errors.slope
    return ask.plan(1, 0.0, "the lenses of the ranges bend too much for cubics", slope=slope)


@dataclass(frozen=True)
class Cubics:
    """As for `Smoothness`."""

    boxes: tuple[LensRanges, ...]
    height: int  # px, of the frame
    width: int

    def __call__(self, stride: float) -> float:
        """Px, the largest error."""
        errors = lens_errors(self.boxes, Lattice(self.height, self.width, math.ceil(stride)))
        return math.inf if errors is None else errors.cubic


def kept_terms(plan: Plan) -> Terms:
    """Those of the polynomial that a plan keeps."""
    kept = [POLYNOMIAL12.index(name) for name in plan.kept]
    radial = max([0, *(i + 1 for i in kept if i < 6)])
    return Terms(radial, any(i in (6, 7) for i in kept), any(i > 7 for i in kept))


def _terms(
    used: Sequence[bool], moved: Sequence[float], room: float
) -> tuple[tuple[str, ...], tuple[tuple[str, float], ...]]:
    """The names of the terms to keep, and those to drop with what they could move, px."""
    dropped: list[int] = []
    for group in _GROUPS:
        here = [i for i in group if used[i]]
        if sum(moved[i] for i in (*dropped, *here)) > room:
            break
        dropped += here
    kept = [i for i in range(12) if used[i] and i not in dropped]
    return tuple(POLYNOMIAL12[i] for i in kept), tuple((POLYNOMIAL12[i], moved[i]) for i in dropped)
