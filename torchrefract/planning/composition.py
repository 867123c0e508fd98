"""The plan of several warps in a row, whose composed flow is computed at the nodes of one lattice.

Flows in closed form are computed exactly wherever earlier warps lead. Random fields are computed at nodes of their own,
with a share of the tolerance. The error of a flow counts as often as the warps before it stretch distances, by up to
1 + (largest gradient) each. The rest of the tolerance is for the lattice of the composed flow, whose stride
depends on the sample: its error is measured (`torchrefract.effects.batch_flow`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from torchrefract._tensor import cached_constant
from torchrefract.planning.plan import EXACT_AT_NODES, ErrorModel, PlanRequest, WarpPlan, plan_warp

_FIELD_SHARE = 0.35  # of the tolerance, for the errors of random fields; the rest is for the lattice
# Shares allow for such a stretch of errors. A sample whose measured stretch is larger is computed exactly.
_ALLOWED_STRETCH = 4.0
_COARSEST = 64  # px, of a lattice of composed flows
_PROBE = 16  # px, of the lattice on which the stretch of rough flows is measured


class PlannedWarp(NamedTuple):
    """A warp of a composition."""

    model: ErrorModel | None  # None if the warp must be computed exactly
    ulps: int
    has_closed_form: bool  # the flow at a displaced point needs no lattice of its own, and one may interpolate it


class CompositionPlan(NamedTuple):  # torch.compile reads the fields of a constant tuple, but not of a dataclass
    """The plan of the composed flow of warps in a row.

    stride: px between the nodes of the first lattice that is measured; 1 computes every pixel.
    is_smooth: False if every pixel is computed after the measurement.
    plans: of each warp.
    error_px: largest error of the composed flow.
    max_gradient: of the composed flow; inf if unknown.
    """

    stride: int
    is_smooth: bool
    plans: tuple[WarpPlan, ...]
    error_px: float
    max_gradient: float

    def summary(self) -> str:
        """Return one line: where the composed flow is computed."""
        if self.stride == 1 or not self.is_smooth:
            return "at every pixel"
        return f"every {self.stride} px or finer, as measured in each sample; at every pixel off the CPU"


@dataclass(frozen=True)
class ComposePlan:
    """The plan of a `Compose` for frames of one size.

    height, width: px, of the frame.
    tolerance_px: largest error of the composed flow; None is exact.
    names, plans: of each effect, in order.
    groups: the plan of each group of warps that are sampled together.
    error_px: largest error of the composed flow.
    num_samplings: how often the image is sampled.
    """

    height: int
    width: int
    tolerance_px: float | None
    names: tuple[str, ...]
    plans: tuple[Any, ...]
    groups: tuple[CompositionPlan, ...]
    error_px: float
    num_samplings: int

    def __str__(self) -> str:
        tolerance = "none: exact" if self.tolerance_px is None else f"{self.tolerance_px:g} px"
        lines = [
            f"frame          {self.width} x {self.height} px",
            f"tolerance      {tolerance}",
            f"error at most  {self.error_px:.2g} px",
            f"samplings      {self.num_samplings}",
        ]
        lines += [f"composed flow  {plan.summary()}" for plan in self.groups if len(plan.plans) > 1]
        width = max(map(len, self.names))
        lines += [f"{name:{width}}  {plan.summary()}" for name, plan in zip(self.names, self.plans, strict=True)]
        return "\n".join(lines)


@cached_constant(maxsize=256)
def plan_composition(
    warps: tuple[PlannedWarp, ...], request: PlanRequest, *, can_measure: bool = True
) -> CompositionPlan:
    """Plan several warps that are sampled together, in order, the first nearest to the scene.

    Args:
        warps: at least two.
        request: the frame and the tolerance of the composed flow.
        can_measure: True if the values of the samples can be read; otherwise every pixel is computed.

    Raises:
        ValueError: the tolerance is below the rounding of positions in such a frame.
    """
    exact = plan_warp(None, replace(request, tolerance_px=None))
    if request.tolerance_px is None:
        return CompositionPlan(1, False, (exact,) * len(warps), 0.0, math.inf)
    budget = _FIELD_SHARE * request.remaining_px()
    fields = [warp for warp in warps if not warp.has_closed_form]
    # Independent random errors add as squares.
    parts = math.sqrt(len(fields)) if all(warp.model and warp.model.is_random for warp in fields) else len(fields)
    plans: list[WarpPlan] = []
    stretch, rough_stretch = 1.0, 1.0
    for warp in warps:
        bounds = None if warp.model is None else warp.model.bounds(request.height, request.width)
        # A lattice cannot measure how far fields stretch that are too rough for one.
        counted = min(stretch, _ALLOWED_STRETCH * rough_stretch) if can_measure else stretch
        share = replace(request, tolerance_px=budget / (parts or 1) / counted, ulps=warp.ulps)
        if warp.has_closed_form or bounds is None:
            plan = replace(exact, reason=EXACT_AT_NODES if bounds else exact.reason, bounds=bounds)
        elif share.is_reachable:
            plan = plan_warp(warp.model, share)
        else:
            plan = replace(exact, reason="its share of the tolerance is below rounding", bounds=bounds)
        plans.append(plan)
        factor = 1 + (math.inf if bounds is None else bounds.max_gradient)
        stretch *= factor
        if plan.stride == 1 and not warp.has_closed_form:
            rough_stretch *= factor
    # A warp without a model must be exact, and so is then the composed flow.
    strides = [
        plan.stride
        for plan, warp in zip(plans, warps, strict=True)
        if plan.stride and not (warp.has_closed_form and warp.model)
    ]
    has_errors = any(plan.error_px for plan in plans)
    finest = min(strides, default=_COARSEST)
    stride = min(_COARSEST, 2 ** (finest.bit_length())) if finest > 1 else _PROBE if has_errors else 1
    error_px = request.tolerance_px if has_errors or finest > 1 else 0.0
    return CompositionPlan(stride if can_measure else 1, finest > 1, tuple(plans), error_px, stretch - 1)
