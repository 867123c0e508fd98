"""Warps whose flow can be computed on a lattice, under a tolerance."""

import functools
from abc import abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result
from torchrefract._validation import eager_bool, requires_grad
from torchrefract.effects.plan import MOST_ULPS, TOLERANCE_PX, Plan, PlanRequest, check_tolerance
from torchrefract.effects.refraction import Moved, WarpEffect, mixed
from torchrefract.effects.rows import expand_batch, params_part, put, some, where_active
from torchrefract.warping.lattice import LatticeFlow


class LatticeWarp(WarpEffect):
    """A warp with a plan.

    Args:
        padding, interpolation, backend, p: as for every warp.
        tolerance_px: how far the flow may be from the exact one, px, anywhere and for all parameters in the ranges of
            the effect, so that it can be computed on a coarser lattice, see `plan`; None is exact, and so is the
            default in frames so large that float32 does not reach it, from about 10 000 px on for lenses and 40 000
            for others.

    ulps: as for `Ask`.
    """

    ulps = MOST_ULPS

    def __init__(
        self,
        *,
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, p=p)
        self.tolerance_px = check_tolerance(tolerance_px)

    def plan_for(self, params: Any, height: int, width: int) -> Plan:
        """The plan for the type of these parameters."""
        dtype = next(value.dtype for value in params if value.is_floating_point())
        return self._constant(id(self), height, width, dtype)

    @assume_constant_result
    def _constant(self, _: int, height: int, width: int, dtype: torch.dtype) -> Plan:
        # As for `PlannedLight`.
        return self.planned(height, width, dtype)

    def planned(self, height: int, width: int, dtype: torch.dtype) -> Plan:
        """The plan for fields of a type."""
        ask = PlanRequest(height, width, self.tolerance_px, dtype is torch.float64, self.ulps)
        return self.plan_within(ask.of_default)

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan that is asked for, from the ranges alone."""
        return ask.plan(1, 0.0, "no tolerance" if ask.tolerance_px is None else "no bound is known for these arguments")

    def for_params(self, params: Any, height: int, width: int) -> "LatticeWarp":
        """The effect itself; an exact one for parameters outside the ranges that its plan is for."""
        params_in_range = functools.partial(self.params_in_range, params, height, width)
        if self.tolerance_px is None or eager_bool(params_in_range, of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "LatticeWarp":
        """The effect without a tolerance."""
        exact = copy(self)
        exact.tolerance_px = None
        return exact

    @abstractmethod
    def params_in_range(self, params: Any, height: int, width: int) -> Tensor:
        """(), bool: all parameters lie in the ranges that the plan for such a frame is for."""

    @abstractmethod
    def on_lattice(self, params: Any, plan: Plan) -> LatticeFlow:
        """The flow on the plan's lattice, where it exists everywhere."""

    def at_pixels(self, params: Any, plan: Plan) -> tuple[Tensor, Tensor]:
        """The flow of a plan that has no lattice, and where it exists, as for `flow`."""
        return self.flow(params, height=plan.height, width=plan.width)

    def plans_of(self, params: Any, plan: Plan) -> Sequence[Plan] | None:
        """Of a plan that has parts the one for each sample, None where it cannot be told."""
        return None

    def stirs(self, params: Any, height: int, width: int, plan: Plan | None = None) -> bool:
        """Whether a sample may be moved by more than the tolerance, or a gradient is asked for."""
        if requires_grad(params):
            return True
        plan = plan or self.plan_for(params, height, width)
        return plan.stride > 0 and super().stirs(params, height, width)

    def masked_flow(self, params: Any, *, height: int, width: int, plan: Plan | None = None) -> Moved:
        """The flow, zero for the samples that the effect leaves alone, by its own plan or by one that is given."""
        plan = plan or self.plan_for(params, height, width)
        plans = self.plans_of(params, plan) if plan.parts and not requires_grad(params) else None
        if not plans:
            return self._gated(params, plan)
        places: dict[Plan, list[int]] = {}
        for i, own in enumerate(plans):
            places.setdefault(own, []).append(i)
        # In one form whatever the plans: how a sample is looked up must not depend on the others.
        alike = [(own, torch.tensor(rows)) for own, rows in places.items()]
        return mixed([(index, self._gated(params_part(params, index), own)) for own, index in alike])

    def _gated(self, params: Any, plan: Plan) -> Moved:
        """The same, by one plan."""
        height, width = plan.height, plan.width
        if plan.lattice is None:
            return self._moved(params, lambda own: self.at_pixels(own, plan), height, width)
        active = self.active(params, height, width)
        if (index := some(active, params)) is not None:
            path = self._known_every(params_part(params, index), plan)
            path = path.with_nodes(put(path.nodes, index, 0.0, len(active)))
            return Moved(path, active.new_ones(1, 1, 1, 1), expand_batch(active, path.nodes.shape[0]))
        path = self._known_every(params, plan)
        active = expand_batch(active, path.nodes.shape[0])
        path = path.with_nodes(where_active(path.nodes, 0.0, active, params))
        return Moved(path, active.new_ones(1, 1, 1, 1), active)

    def _known_every(self, params: Any, plan: Plan) -> LatticeFlow:
        return replace(self.on_lattice(params, plan), every=plan.every)
