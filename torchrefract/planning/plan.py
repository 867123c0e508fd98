"""The plan of one warp: the coarsest lattice and the fewest terms that keep its flow within a tolerance."""

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from torchrefract._tensor import cached_constant
from torchrefract._validation import check_number
from torchrefract.types import FlowBounds, Simplification

TOLERANCE_PX = 0.02  # the default of all warps; an error of this size is invisible
EXACT_AT_NODES = "exact, at the nodes of the composed flow"  # the reason of warps in closed form
DEFAULT_ULPS = 4  # units in the last place of the longer side by which float32 flows are off
_SMALLEST, _LARGEST = 1e-6, 64.0  # px, or levels of 1/255
_LAST_PLACE = {False: 2.0**-24, True: 2.0**-53}
# px between nodes, from fine to coarse
STRIDES = (*range(2, 8), *(share << octave for octave in range(1, 7) for share in (4, 5, 6, 7)), 512)
_STRIDES = np.array(STRIDES, dtype=float)


class ErrorModel(Protocol):
    """Error bounds for all flows that an effect draws from its ranges, or for those of one drawn sample.

    is_random: True if the errors are Gaussian and independent of those of other effects; they then add as squares.
    """

    @property
    def is_random(self) -> bool:
        """See the class."""
        ...

    def bounds(self, height: int, width: int) -> FlowBounds | None:
        """Return bounds for frames of a size, or None if none are known; the flow is then computed exactly."""
        ...

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification | None:
        """Return what can be left out within a share of the budget, or None if the flow must be computed exactly."""
        ...

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: all parameters lie in the ranges of the model, up to rounding."""
        ...


@dataclass(frozen=True)
class PlanRequest:
    """The frame and the tolerance that a plan is made for.

    height, width: px, of the frame.
    tolerance_px: largest error of the flow; None computes it exactly.
    is_double: True for flows in float64.
    ulps: units in the last place of the longer side by which the flow is off through rounding.
    """

    height: int
    width: int
    tolerance_px: float | None
    is_double: bool
    ulps: int = DEFAULT_ULPS

    @property
    def rounding_px(self) -> float:
        """Return the rounding error of the flow in px."""
        return self.ulps * _LAST_PLACE[self.is_double] * max(self.height, self.width)

    @property
    def is_reachable(self) -> bool:
        """Return True if rounding leaves at least half of the tolerance."""
        return self.tolerance_px is None or self.tolerance_px >= 2 * self.rounding_px

    def if_reachable(self) -> "PlanRequest":
        """Drop a tolerance that rounding exceeds."""
        return self if self.is_reachable else replace(self, tolerance_px=None)

    def with_reachable_default(self) -> "PlanRequest":
        """Drop the default tolerance in frames so large that rounding exceeds it."""
        return self.if_reachable() if self.tolerance_px == TOLERANCE_PX else self

    def remaining_px(self) -> float:
        """Return the part of the tolerance that rounding leaves, in px.

        Raises:
            ValueError: the tolerance is smaller than twice the rounding error.
        """
        assert self.tolerance_px is not None
        if not self.is_reachable:
            dtype = "float64" if self.is_double else "float32"
            raise ValueError(
                f"tolerance_px must be at least {2 * self.rounding_px:.2g} px for {dtype} positions in a frame of "
                f"{self.width} x {self.height} px (None is exact), got {self.tolerance_px:g}"
            )
        return self.tolerance_px - self.rounding_px


@dataclass(frozen=True)
class WarpPlan:
    """The computation of the flow of a warp for frames of one size.

    height, width: px, of the frame.
    tolerance_px: largest error of the flow that was requested; None is exact.
    stride: px between the nodes of the lattice; 1 computes every pixel; 0 computes no flow at all.
    error_px: largest error of the flow.
    reason: what decided the stride.
    kept, dropped: terms that are computed, and those that are not with the largest displacement in px of each.
    is_random: as for `ErrorModel`.
    is_measured: True if each sample gets the coarsest lattice whose measured error fits, where values can be read.
    details: what the effect needs to compute the flow, from `Simplification.details`.
    bounds: of the flow; None if unknown.
    num_samplings: how often the image is sampled.
    """

    height: int
    width: int
    tolerance_px: float | None
    stride: int
    error_px: float
    reason: str
    kept: tuple[str, ...] = ()
    dropped: tuple[tuple[str, float], ...] = ()
    is_random: bool = False
    is_measured: bool = False
    details: Any = None
    bounds: FlowBounds | None = None
    num_samplings: int = 1

    @property
    def is_identity(self) -> bool:
        """Return True if no flow is computed, because none would exceed the tolerance."""
        return self.stride == 0

    @property
    def max_gradient(self) -> float:
        """Return the largest gradient of the flow, px per px; inf if unknown."""
        return math.inf if self.bounds is None else self.bounds.max_gradient

    def summary(self) -> str:
        """Return one line: where the flow is computed, and why."""
        if self.reason == EXACT_AT_NODES:
            return self.reason
        flow = {0: "not computed", 1: "at every pixel"}.get(self.stride, f"every {self.stride} px")
        measured = "; on the CPU as coarse as each sample allows, which is measured" if self.is_measured else ""
        return f"{flow} ({self.reason}{measured})"

    def __str__(self) -> str:
        lines = [
            f"frame          {self.width} x {self.height} px",
            f"tolerance      {'none: exact' if self.tolerance_px is None else f'{self.tolerance_px:g} px'}",
            f"flow           {self.summary()}",
            f"error at most  {self.error_px:.2g} px",
            f"samplings      {self.num_samplings}",
        ]
        if self.kept:
            lines.append(f"terms kept     {', '.join(self.kept)}")
        lines += [f"term dropped   {name}, which moves up to {moved:.2g} px" for name, moved in self.dropped]
        return "\n".join(lines)


@cached_constant(maxsize=1024)
def plan_warp(model: ErrorModel | None, request: PlanRequest) -> WarpPlan:
    """Plan one warp: drop terms, then take the coarsest lattice whose error fits into the tolerance.

    Args:
        model: of the effect; None if it has no bounds.
        request: the frame and the tolerance.

    Raises:
        ValueError: the tolerance is below the rounding of positions in such a frame.
    """
    frame = (request.height, request.width)
    if request.tolerance_px is None:
        return WarpPlan(*frame, None, 1, 0.0, "no tolerance")
    budget = request.remaining_px()
    exact = WarpPlan(*frame, request.tolerance_px, 1, 0.0, "no error bound is known for these arguments")
    bounds = None if model is None else model.bounds(*frame)
    if model is None or bounds is None:
        return exact
    exact = replace(exact, bounds=bounds)
    if bounds.max_displacement <= budget:
        moved = bounds.max_displacement
        reason = "it moves nothing" if moved == 0 else "it moves less than the tolerance"
        return replace(exact, stride=0, error_px=moved, reason=reason, is_random=model.is_random)
    simplified = model.simplify(*frame, budget)
    if simplified is None or simplified.error_px > budget:
        return exact if simplified is None else replace(exact, reason="the tolerance is too small for fewer terms")
    stride = coarsest_stride(bounds, simplified, budget, is_random=model.is_random)
    between = float(bounds.interpolation_error(np.array([float(stride)]))[0]) if stride > 1 else 0.0
    # Independent random errors add as squares.
    error = math.hypot(simplified.error_px, between) if model.is_random else simplified.error_px + between
    if stride == 1 and simplified.error_px == 0:
        return replace(exact, reason=simplified.why or "the flow bends too much for a lattice")
    return replace(
        exact,
        stride=stride,
        error_px=error + request.rounding_px,
        reason=simplified.why or "cubic polynomials between nodes",
        kept=simplified.kept,
        dropped=simplified.dropped,
        is_random=model.is_random,
        details=simplified.details,
    )


def coarsest_stride(bounds: FlowBounds, simplified: Simplification, budget_px: float, *, is_random: bool) -> int:
    """Return the largest stride in STRIDES whose total error fits into the budget; 1 if none does."""
    if not simplified.can_interpolate:
        return 1
    between = bounds.interpolation_error(_STRIDES)
    total = np.hypot(simplified.error_px, between) if is_random else simplified.error_px + between
    # The error grows with the stride: only strides below the first one that does not fit count.
    count = np.logical_and.accumulate(total <= budget_px).sum()
    return STRIDES[count - 1] if count else 1


def check_tolerance(value: float | None, *, name: str = "tolerance_px") -> float | None:
    """Return a tolerance in px, or in levels of 1/255, or None for exact results."""
    return None if value is None else check_number(name, value, low=_SMALLEST, high=_LARGEST)
