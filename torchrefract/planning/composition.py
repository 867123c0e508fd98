"""The plan of several warps in a row, whose composed flow is computed at the nodes of one lattice.

The composed flow d_1 of n flows, d_i = d_(i+1) + f_i(p + d_(i+1)), has the error e_1, e_i = e_(i+1) (1 + L_i) + (error
of f_i), where L_i is the largest gradient of f_i. The error of each flow thus counts times the product of 1 + L of the
warps before it, and what follows a flow with an unknown gradient is computed exactly.

Between nodes that are s px apart lie cubic polynomials. Let phi = id + d of the flows after f, psi the cubic through
four values of phi along an axis, at the place x of a pixel, and A its tangent there. The cubic through the values of
f(phi) is that of f(psi), and as it reproduces cubics, such as f'(A(x)) (psi - A),

    |error| <= error of f on a lattice of s |A'| + sum |w_j r_j| + |f'| |psi(x) - phi(x)|
    r_j = f(psi_j) - f(A_j) - f'(A(x)) (psi_j - A_j)

The last term is the error of phi, as often as f stretches it. Let u_j be the distances from x to the nodes in strides,
1 + L the stretch of phi, B and C its second and third derivative, F and G those of f, and |psi_j - A_j| <= B s^2 q_j,
with q_j for a second derivative that is linear between two values, as that of a cubic is. The part of r_j that is a
cubic in u_j, of f'' and psi'', is reproduced too, which leaves

    |r_j| <= F (1 + L) C (u_j s)^4 / 6 + F (B s^2 q_j)^2 / 2 + G ((1 + L) |u_j| s + B s^2 q_j)^2 B s^2 q_j / 2

If f'' has kinks there is no G, f' differs by second derivatives alone, and

    |r_j| <= F ((1 + L) |u_j| s + B s^2 q_j) B s^2 q_j

The sums over j are largest somewhere in the cell, whatever s is, so that they are constants (`_SUMS`). Third
differences are two of second ones. With two axes, one after the other, the second takes on the error of the first
sum |w_j| times, and so it takes on the errors of the nodes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from torchrefract.planning.plan import ErrorModel, PlanRequest, WarpPlan, plan_warp
from torchrefract.types import FlowBounds

_CLOSED_FORM_SHARE = 0.05  # of the budget of the single flows, for each that drops terms only
# px between the nodes of a composition, from fine to coarse
_STRIDES = np.array([2.0, 3, 4, 5, 6, 8, 10, 12, 16])
# Shares of the tolerance that the single flows may use; the rest is for the lattice of the composition.
_SHARES = (0.7, 0.5, 0.35, 0.2)
_MAX_BEND_PX = 4.0  # of phi over one stride, up to which the bound above holds at the border


class PlannedWarp(NamedTuple):
    """A warp of a composition."""

    model: ErrorModel | None  # None if the warp must be computed exactly
    ulps: int
    has_closed_form: bool  # the flow at a displaced point needs no lattice of its own


@dataclass(frozen=True)
class CompositionPlan:
    """The plan of the composed flow of warps in a row.

    stride: px between the nodes; 1 computes every pixel.
    plans: of each warp.
    error_px: largest error of the composed flow.
    max_gradient: of the composed flow; inf if unknown.
    """

    stride: int
    plans: tuple[WarpPlan, ...]
    error_px: float
    max_gradient: float

    @property
    def key(self) -> tuple[Any, ...]:
        """Return a value that is equal for plans that compute the same."""
        return (self.stride, *((plan.stride, plan.details, plan.tolerance_px is None) for plan in self.plans))


@dataclass(frozen=True)
class ComposePlan:
    """The plan of a `Compose` for frames of one size.

    height, width: px, of the frame.
    tolerance_px: largest error of the composed flow; None is exact.
    names, plans: of each effect, in order.
    strides: px, of the lattice of each group of warps that are sampled together.
    error_px: largest error of the composed flow.
    num_samplings: how often the image is sampled.
    """

    height: int
    width: int
    tolerance_px: float | None
    names: tuple[str, ...]
    plans: tuple[Any, ...]
    strides: tuple[int, ...]
    error_px: float
    num_samplings: int

    def __str__(self) -> str:
        tolerance = "none: exact" if self.tolerance_px is None else f"{self.tolerance_px:g} px"
        lines = [
            f"frame          {self.height} x {self.width} px",
            f"tolerance      {tolerance}",
            f"error at most  {self.error_px:.2g} px",
            f"samplings      {self.num_samplings}",
        ]
        lines += [f"composed flow  every {px} px (cubic polynomials between nodes)" for px in self.strides if px > 1]
        width = max(map(len, self.names))
        lines += [f"{name:{width}}  {plan.summary()}" for name, plan in zip(self.names, self.plans, strict=True)]
        return "\n".join(lines)


@lru_cache(maxsize=256)
def plan_composition(warps: tuple[PlannedWarp, ...], request: PlanRequest) -> CompositionPlan:
    """Plan warps that are sampled together, in order, the first nearest to the scene.

    Args:
        warps: at least one.
        request: the frame and the tolerance of the composed flow.

    Raises:
        ValueError: the tolerance is below the rounding of positions in such a frame.
    """
    if request.tolerance_px is None:
        plans = tuple(plan_warp(None, request) for _ in warps)
        return CompositionPlan(1, plans, 0.0, math.inf)
    if len(warps) == 1:
        alone = replace(request, ulps=warps[0].ulps)
        plan = plan_warp(warps[0].model, alone) if alone.is_reachable else _exact_plan(warps[0], request)
        return CompositionPlan(max(plan.stride, 1), (plan,), plan.error_px, _gradient(plan))
    best: CompositionPlan | None = None
    if all(warp.model is not None for warp in warps):
        for share in _SHARES:
            plans = _plan_shares(warps, request, share * request.remaining_px())
            errors = _composed_errors(warps, plans)
            num_fitting = int(np.logical_and.accumulate(errors <= request.tolerance_px).sum())
            if num_fitting and (best is None or _STRIDES[num_fitting - 1] > best.stride):
                stride, error = int(_STRIDES[num_fitting - 1]), float(errors[num_fitting - 1])
                best = CompositionPlan(stride, tuple(plans), error, _composed_gradient(plans))
    if best is not None:
        return best
    plans = _plan_shares(warps, request, request.remaining_px())
    if _error_at_pixels(warps, plans) > request.tolerance_px:  # the rounding of closed forms has no share
        plans = [
            _exact_plan(warp, request) if warp.has_closed_form and not plan.is_identity else plan
            for warp, plan in zip(warps, plans, strict=True)
        ]
    return CompositionPlan(1, tuple(plans), _error_at_pixels(warps, plans), _composed_gradient(plans))


def _error_at_pixels(warps: Sequence[PlannedWarp], plans: Sequence[WarpPlan]) -> float:
    """Bound the error of a composed flow that is computed at every pixel."""
    errors = [_own_error(plan, warp) for plan, warp in zip(plans, warps, strict=True)]
    counted = zip(errors, _stretches(plans), plans, strict=True)
    return _total([(error * stretch, plan.is_random) for error, stretch, plan in counted if error > 0])


def _exact_plan(warp: PlannedWarp, request: PlanRequest) -> WarpPlan:
    """Plan an exact flow whose bounds are known as far as those of the warp."""
    bounds = None if warp.model is None else warp.model.bounds(request.height, request.width)
    plan = replace(plan_warp(None, replace(request, tolerance_px=None)), bounds=bounds)
    return plan if bounds is None else replace(plan, reason="its share of the tolerance is below rounding")


def _plan_shares(warps: Sequence[PlannedWarp], request: PlanRequest, budget_px: float) -> list[WarpPlan]:
    """Plan each warp with a share of the budget, divided by how much the warps before it stretch its error.

    Warps with a lattice of their own have equal shares; those of independent random errors add as squares.
    """
    num_closed = sum(warp.has_closed_form for warp in warps)
    lattices = [(1.0, warp.model is not None and warp.model.is_random) for warp in warps if not warp.has_closed_form]
    closed_share = _CLOSED_FORM_SHARE if lattices else 1 / len(warps)
    lattice_share = (1 - num_closed * closed_share) / max(_total(lattices), 1.0)
    plans: list[WarpPlan] = []
    stretch = 1.0
    for warp, outside_px in zip(warps, _outside_px(warps, request), strict=True):
        part = closed_share if warp.has_closed_form else lattice_share
        # Rounded down to quarters of octaves, so that compositions with other drawn lenses find the same plans.
        share_px = 2 ** (math.floor(4 * math.log2(part * budget_px / stretch)) / 4) if stretch < math.inf else 0.0
        # What a closed form drops has a small share, which need not cover the rounding as well.
        share = replace(request, tolerance_px=share_px, ulps=0 if warp.has_closed_form else warp.ulps)
        if math.isinf(stretch) or warp.model is None or not share.is_reachable:
            plan = _exact_plan(warp, request)
        else:
            plan = plan_warp(warp.model, share)
            if warp.has_closed_form and plan.bounds is not None and not plan.is_identity:
                # Bounds hold as far outside the frame as the nodes of the coarsest lattice with a bound lie.
                reaches = math.isfinite(float(plan.bounds.interpolation_error(np.array([max(outside_px, 1.0)]))[0]))
                if not reaches:
                    exact = plan_warp(None, replace(share, tolerance_px=None))
                    plan = replace(exact, bounds=plan.bounds, reason="later warps lead far outside the frame")
        if warp.has_closed_form and not plan.is_identity:
            plan = replace(plan, node_error_px=plan.node_error_px + replace(request, ulps=warp.ulps).rounding_px)
        plans.append(plan)
        stretch *= 1 + _gradient(plan)
    return plans


def _outside_px(warps: Sequence[PlannedWarp], request: PlanRequest) -> list[float]:
    """Return how far outside the frame each flow may be evaluated, px: as far as the later warps move together."""
    distances = [0.0]
    for warp in reversed(warps[1:]):
        bounds = None if warp.model is None else warp.model.bounds(request.height, request.width)
        distances.append(distances[-1] + (math.inf if bounds is None else bounds.max_displacement))
    return distances[::-1]


def _own_error(plan: WarpPlan, warp: PlannedWarp) -> float:
    """Return the error of a flow at a displaced point."""
    return plan.node_error_px if warp.has_closed_form and not plan.is_identity else plan.error_px


def _gradient(plan: WarpPlan) -> float:
    return 0.0 if plan.is_identity else plan.max_gradient


def _composed_gradient(plans: Sequence[WarpPlan]) -> float:
    return math.prod(1 + _gradient(plan) for plan in plans) - 1


def _stretches(plans: Sequence[WarpPlan]) -> list[float]:
    """Return how often the error of each flow counts in the composed flow."""
    stretches = [1.0]
    for plan in plans[:-1]:
        stretches.append(stretches[-1] * (1 + _gradient(plan)))
    return stretches


def _total(errors: Sequence[tuple[Any, bool]]) -> Any:
    """Add errors in px, numbers or arrays; those that are marked as random add as squares."""
    fixed = sum([error for error, is_random in errors if not is_random])
    return fixed + np.sqrt(sum([error * error for error, is_random in errors if is_random]))


def _composed_errors(warps: Sequence[PlannedWarp], plans: Sequence[WarpPlan]) -> np.ndarray:
    """Bound the error of a composed flow for each stride of its lattice; inf if there is no bound."""
    errors: list[tuple[Any, bool]] = []
    stretch, second, third = 1.0, 0.0, np.zeros_like(_STRIDES)  # of phi
    s = _STRIDES
    for warp, plan, count in zip(reversed(warps), reversed(plans), reversed(_stretches(plans)), strict=True):
        if math.isinf(count):
            return np.full_like(s, np.inf)
        if plan.stride == 0:
            errors.append((plan.error_px * count, plan.is_random))
            continue
        bounds = plan.bounds
        if bounds is None or math.isinf(bounds.max_second_derivative):
            return np.full_like(s, np.inf)
        # Flows without a closed form are interpolated bilinearly, here between nodes and if exact between pixels.
        is_read = second > 0 and not warp.has_closed_form
        bilinear = bounds.max_second_derivative * (s**2 + 1) / 4 if is_read else 0.0
        node_error = _AMPLIFICATION**2 * _own_error(plan, warp)
        between = bounds.interpolation_error(s * stretch)
        errors.append(((node_error + between + bilinear) * count, plan.is_random))
        cross = np.where(second * s**2 <= _MAX_BEND_PX, _cross_error(bounds, stretch, second, third), np.inf)
        errors.append(((1 + _AMPLIFICATION) * cross * count, False))
        gradient, bend = bounds.max_gradient, bounds.max_second_derivative
        bent = bend * stretch**2 + gradient * second
        twisted = 3 * bend * stretch * second + gradient * third + bounds.max_third_derivative * stretch**3
        third = third + np.minimum(twisted, 2 * bent / s)
        stretch, second = stretch * (1 + gradient), second + bent
    return _total(errors)


def _cross_error(bounds: FlowBounds, stretch: float, second: float, third: np.ndarray) -> np.ndarray:
    """Bound sum |w_j r_j| for each stride, with the derivatives of phi."""
    along, off = stretch * _STRIDES, second * _STRIDES**2
    rough = bounds.max_second_derivative * (along * off * _SUMS["uq"] + off**2 * _SUMS["qq"])
    if math.isinf(bounds.max_third_derivative):
        return rough
    smooth = stretch * third * _STRIDES**4 / 6 * _SUMS["uuuu"] + off**2 / 2 * _SUMS["qq"]
    cubes = along**2 * off * _SUMS["uuq"] + 2 * along * off**2 * _SUMS["uqq"] + off**3 * _SUMS["qqq"]
    return np.minimum(rough, bounds.max_second_derivative * smooth + bounds.max_third_derivative / 2 * cubes)


def _largest_sums() -> dict[str, float]:
    """Return the largest sums of |w_j| times powers of |u_j| and q_j over the places in a cell."""
    t = np.linspace(0, 1, 65)[:, None]
    u = np.arange(-1, 3) - t
    others = [[k for k in range(4) if k != j] for j in range(4)]
    weight = np.stack([np.prod(-u[:, k], axis=1) / math.prod(j - i for i in k) for j, k in enumerate(others)], axis=1)
    # The second derivative (1 - t) a + t b, integrated twice from x to a node.
    q = np.abs((1 - t) * u**2 / 2 - u**3 / 6) + np.abs(t * u**2 / 2 + u**3 / 6)
    powers = {"": 1.0, "uq": abs(u) * q, "qq": q**2, "uuuu": u**4, "uuq": u**2 * q, "uqq": abs(u) * q**2, "qqq": q**3}
    return {name: float((np.abs(weight) * value).sum(axis=1).max()) for name, value in powers.items()}


_SUMS = _largest_sums()
_AMPLIFICATION = _SUMS[""]  # 5 / 4
