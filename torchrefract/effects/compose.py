"""Several effects in a row, with one sampling for all warps that follow one another."""

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrefract import random
from torchrefract._tensor import as_device_tensor, assume_constant_result
from torchrefract._validation import check_choice, check_number, requires_grad, type_name
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import params_per_frame, params_to, select_params
from torchrefract.effects.batch_flow import FlowPart, SamplingOptions, can_read, flow_on_measured_lattice, zero_flow
from torchrefract.effects.progress import Leaf, Progress
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.planning.composition import ComposePlan, CompositionPlan, PlannedWarp, plan_composition
from torchrefract.planning.plan import TOLERANCE_PX, PlanRequest, check_tolerance
from torchrefract.types import Degraded
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.warp import BACKENDS, INTERPOLATIONS, PADDINGS


class ComposeParams(NamedTuple):
    """The parameters of all effects of a composition."""

    applied: Tensor  # (B,), bool: the sample is degraded; where it is False, it is False in all children too
    children: tuple[Any, ...]  # of each effect, in order

    to = params_to


class Compose(Effect):
    """Effects one after the other, the first nearest to the scene.

        flow(p) = d_1,  d_i = d_(i+1) + f_i(p + d_(i+1)),  d_n = f_n(p)

    Warps that follow one another sample the image once, along their composed flow, so that it is blurred once. Under a
    tolerance the composed flow is computed at the nodes of one lattice. Photometric effects between warps keep their
    place: the image is sampled before them, and their maps move with the warps after them. Effects that share a
    function from images to depth get the depth of the frame before fog and light, computed once for the first of them;
    samplings move it along, as a depth that is passed. `restore_flow` is the composition of the inverse flows, not
    valid where it misses by more than 0.1 px, as between the sheets of a fold.

    Args:
        effects: at least one; compositions may be nested.
        padding, interpolation, backend: of all samplings, in place of those of the effects and compositions inside;
            None takes those of the last warp that moves the sample, or of the outermost composition inside with any.
        tolerance_px: largest error of the composed flow in px, see `plan`; None is exact. It replaces the tolerance of
            the effects and compositions inside, but an effect whose own tolerance is None stays exact. In frames too
            large for the default, the default is exact.
        p: probability that a sample is degraded.

    Raises:
        ValueError: no effect.
        TypeError: one of them is not an effect.
    """

    params_type = ComposeParams

    def __init__(
        self,
        effects: Iterable[Effect],
        *,
        padding: str | None = None,
        interpolation: str | None = None,
        backend: str | None = None,
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(p=p)
        if not isinstance(effects, Iterable):
            raise TypeError(f"effects must be a list of effects, got {type(effects).__name__}")
        effects = list(effects)
        if not effects:
            raise ValueError("effects must be at least one effect, got none")
        for effect in effects:
            if not isinstance(effect, Effect):
                raise TypeError(f"effects must be effects of torchrefract, got {type_name(effect)}")
        self.effects = cast(Sequence[Effect], nn.ModuleList(effects))
        self.padding = None if padding is None else check_choice("padding", padding, PADDINGS)
        self.interpolation = (
            None if interpolation is None else check_choice("interpolation", interpolation, INTERPOLATIONS)
        )
        self.backend = None if backend is None else check_choice("backend", backend, BACKENDS)
        self.tolerance_px = check_tolerance(tolerance_px)

    @property
    def keeps_uint8(self) -> bool:
        """Return True if all effects do."""
        return all(effect.keeps_uint8 for effect in self.effects)

    def sample_params(self, stream: random.Stream, image: Tensor) -> ComposeParams:
        """Draw the parameters of each effect from a stream of its own."""
        applied, children_applied = self.sample_applied(stream)
        inner = random.fold(stream)
        children = [effect.sample_params(inner.at(i), image) for i, effect in enumerate(self.effects)]
        return ComposeParams(applied, tuple(map(_restrict, children, children_applied)))

    def sample_applied(self, stream: random.Stream) -> tuple[Tensor, list[Tensor]]:
        """Draw whether the composition is applied, (B,), bool, and whether each of its effects is."""
        applied = random.uniform(stream, 1)[:, 0] < self.p
        return applied, [applied] * len(self.effects)

    def validate(self, params: ComposeParams, image: Tensor) -> None:
        """Raise for parameters that one of the effects rejects."""
        if len(params.children) != len(self.effects):
            raise ValueError(
                f"params.children must be those of {len(self.effects)} effects, got {len(params.children)}"
            )
        for effect, child in zip(self.effects, params.children, strict=True):
            effect.check_params(child, image)

    def for_params(self, params: ComposeParams, height: int, width: int) -> "Compose":
        """Return the composition with an exact effect wherever parameters lie outside the ranges."""
        pairs = zip(self.effects, params.children, strict=True)
        effects = [effect.for_params(child, height, width) for effect, child in pairs]
        if all(new is old for new, old in zip(effects, self.effects, strict=True)):
            return self
        composition = copy(self)
        composition._modules = {**self._modules, "effects": nn.ModuleList(effects)}
        return composition

    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> ComposePlan:
        """Return the plan for all parameters in the ranges."""
        effects, requests = self._flat_effects(), self._requests(id(self), height, width, dtype)
        plans: dict[int, Any] = {}
        composed: list[CompositionPlan] = []
        error, stretch = 0.0, 1.0
        groups = _groups(effects, requests)
        for group in groups:
            plan = _plan_group([effects[place] for place in group], cast(PlanRequest, requests[group[0]]))
            plans |= dict(zip(group, plan.plans, strict=True))
            composed.append(plan)
            error += plan.error_px * stretch if plan.error_px else 0.0
            stretch *= 1 + plan.max_gradient
        each = tuple(
            plans[place] if place in plans else effect.plan_for_dtype(height, width, dtype)
            for place, effect in enumerate(effects)
        )
        names = tuple(type(effect).__name__ for effect in effects)
        samplings = sum(
            max(len(effects[place].moments()) for place in group)
            for group in groups
            if any(effects[place].p > 0 and not plans[place].is_identity for place in group)
        )
        return ComposePlan(height, width, self.tolerance_px, names, each, tuple(composed), error, samplings)

    def degrade_batch(self, image: Tensor, params: ComposeParams, depth: Tensor | None) -> Degraded:
        """Pass the images through all effects."""
        height, width = image.shape[2:]
        requests = self._requests(id(self), height, width, field_dtype(image.dtype))
        progress = Progress(image, depth, len(params.applied))
        together: list[Leaf] = []  # warps that will be sampled together
        for leaf in self._leaves(params):
            if isinstance(leaf.effect, WarpEffect):
                progress.has_warps = True
                if leaf.effect.may_change(leaf.params) and height * width > 1:
                    together.append(leaf)
                continue
            if together and (requests[leaf.place] is None or leaf.effect.may_change(leaf.params)):
                self._move(progress, together, requests)  # the warps before it come first
                together = []
            progress.shade(leaf.effect, leaf.params)
        if together:
            self._move(progress, together, requests)
        return progress.result(params)

    def effects_with_params(self, params: ComposeParams) -> Iterator[tuple[Effect, Any]]:
        """Yield the effects that are not compositions, in order, with their parameters."""
        for leaf in self._leaves(params):
            yield leaf.effect, leaf.params

    def _flat_effects(self) -> list[Any]:
        """Return the effects that are not compositions, in order."""
        effects: list[Any] = []
        for effect in self.effects:
            effects += effect._flat_effects() if isinstance(effect, Compose) else [effect]
        return effects

    def _leaves(self, params: ComposeParams, outer: SamplingOptions | None = None, first: int = 0) -> list[Leaf]:
        """Return `_flat_effects` with their parameters, and with the options of the compositions around them first.

        Args:
            params: of the composition.
            outer: options of the compositions around this one; None for none.
            first: place of its first effect.
        """
        options = (outer or SamplingOptions()).or_else(self)
        leaves: list[Leaf] = []
        for effect, child in zip(self.effects, params.children, strict=True):
            if isinstance(effect, Compose):
                leaves += effect._leaves(child, options, first + len(leaves))
            else:
                decided = options.or_else(effect) if isinstance(effect, WarpEffect) else options
                leaves.append(Leaf(effect, child, decided, first + len(leaves)))
        return leaves

    def _move(self, progress: Progress, warps: Sequence[Leaf], requests: Sequence[PlanRequest | None]) -> None:
        """Sample the images along the composed flow of warps."""
        request = cast(PlanRequest, requests[warps[0].place])
        moving = self._at_depth(progress, warps, request)
        active = [leaf.effect.active(leaf.params) for leaf in moving]
        moments = [leaf.effect.moments() for leaf in moving]
        parts = []
        for k in range(max(map(len, moments))):
            looks = [
                leaf if len(each) == 1 else leaf._replace(params=leaf.params.at(each[k % len(each)]))
                for leaf, each in zip(moving, moments, strict=True)
            ]
            parts.append(self._parts(looks, active, request))
        middle = parts[0] if len(parts) == 1 else self._parts(moving, active, request)
        # The share must not depend on the warps that move other samples of the batch. Of several warps it is half as
        # large, since the inverse of one stretches the errors of the others.
        num_warps = sum(isinstance(effect, WarpEffect) for effect in self._flat_effects())
        num_shares = num_warps if num_warps == 1 else 2 * num_warps
        share_px = None if request.tolerance_px is None else request.tolerance_px / num_shares
        progress.move(moving, active, middle, share_px, exposures=parts)

    def _parts(
        self, moving: Sequence[Leaf], active: Sequence[Tensor], request: PlanRequest, *, can_measure: bool = True
    ) -> list[FlowPart]:
        """Compute the composed flow of warps; arguments as for `Progress.move` and `_at_depth`."""
        frame = request.height, request.width
        can_measure = can_measure and all(can_read(leaf.params) for leaf in moving)
        can_group = can_measure and not requires_grad([leaf.params for leaf in moving])
        parts: list[FlowPart] = []
        for samples, acting in _group_samples(active) if can_group else [(None, list(range(len(moving))))]:
            chosen = [moving[k] for k in acting]
            if samples is not None:
                chosen = [leaf._replace(params=select_params(leaf.params, samples)) for leaf in chosen]
            places = tuple([leaf.place for leaf in chosen])
            exact_places = tuple([leaf.place for leaf in chosen if leaf.effect.must_be_exact(leaf.params)])
            plan = self._constant_plan(
                id(self), places, exact_places, *frame, request.tolerance_px, request.is_double, can_measure
            )
            parts += [part.of_samples(samples) for part in _composed_flow(chosen, plan, request.tolerance_px)]
        return parts

    def _at_depth(self, progress: Progress, leaves: Sequence[Leaf], request: PlanRequest) -> list[Leaf]:
        """Return warps with the parameters of each frame, and with its depth, moved by the warps before, if it counts.

        Args:
            progress: before the warps.
            leaves: the warps that will be sampled together.
            request: for the composed flow.
        """
        placed: list[Leaf] = []
        for leaf in leaves:
            params = params_per_frame(leaf.params, progress.frames)
            if leaf.effect.depth is not None:
                depth = progress.depth_for(leaf.effect)
                if placed and progress.depth is not None:
                    active = [before.effect.active(before.params) for before in placed]
                    depth = progress.moved_depth(
                        placed, active, self._parts(placed, active, request, can_measure=False)
                    )
                params = leaf.effect.at_depth(params, progress.image, depth)
            placed.append(leaf._replace(params=params))
        return placed

    @assume_constant_result
    def _requests(self, _: int, height: int, width: int, dtype: torch.dtype) -> tuple[PlanRequest | None, ...]:
        """Return for each effect the request of its group of warps, or None if it separates groups.

        A photometric effect that may change something separates groups, whatever is drawn, so that a sample does not
        depend on the others of its batch.
        """
        effects = self._flat_effects()
        request = PlanRequest(height, width, self.tolerance_px, dtype is torch.float64).with_reachable_default()
        requests: list[PlanRequest | None] = []
        for effect in effects:
            is_separator = not isinstance(effect, WarpEffect) and effect.p > 0
            is_separator = is_separator and not effect.plan_for_dtype(height, width, dtype).is_identity
            requests.append(None if is_separator else request)
        if request.tolerance_px is None:
            return tuple(requests)
        request.remaining_px()  # raises for an unreachable tolerance
        groups, stretch = _groups(effects, requests), 1.0
        for group in groups if len(groups) > 1 else ():
            share = replace(request, tolerance_px=request.tolerance_px / len(groups) / stretch).if_reachable()
            for place in group:
                requests[place] = share
            stretch *= 1 + _plan_group([effects[place] for place in group], share).max_gradient
        return tuple(requests)

    @assume_constant_result
    def _constant_plan(
        self,
        _: int,
        places: tuple[int, ...],
        exact_places: tuple[int, ...],
        height: int,
        width: int,
        tolerance_px: float | None,
        is_double: bool,
        can_measure: bool,
    ) -> CompositionPlan:
        effects, request = self._flat_effects(), PlanRequest(height, width, tolerance_px, is_double)
        warps = [effects[place].exact() if place in exact_places else effects[place] for place in places]
        return _plan_group(warps, request, can_measure=can_measure)


class OneOf(Compose):
    """One of several effects for each sample.

    Args:
        effects: to choose from.
        weights: relative frequency of each effect, above 0; None chooses all with the same probability.
        padding, interpolation, backend, tolerance_px, p: as for `Compose`.

    Raises:
        ValueError, TypeError: as for `Compose`; weights that are not one positive number for each effect.
    """

    def __init__(
        self,
        effects: Iterable[Effect],
        *,
        weights: Sequence[float] | None = None,
        padding: str | None = None,
        interpolation: str | None = None,
        backend: str | None = None,
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(
            effects, padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p
        )
        count = len(self.effects)
        weights = [1.0] * count if weights is None else weights
        if len(weights) != count:
            raise ValueError(f"weights must be one number for each of {count} effects, got {len(weights)}")
        self.weights = tuple(check_number("weights", weight, low=1e-9) for weight in weights)

    def sample_applied(self, stream: random.Stream) -> tuple[Tensor, list[Tensor]]:
        """Draw whether the composition is applied, and for each sample which effect is."""
        values = random.uniform(stream, 2)
        applied, choice = values[:, 0] < self.p, values[:, 1] * sum(self.weights)
        ends = as_device_tensor(self.weights, dtype=choice.dtype, device=choice.device).cumsum(dim=0)[:-1]
        chosen = torch.bucketize(choice, ends, right=True)
        return applied, [applied & (chosen == i) for i in range(len(self.effects))]


def _restrict(params: Any, applied: Tensor) -> Any:
    """Apply the effect only to samples that the composition around it is applied to."""
    if isinstance(params, ComposeParams):
        return ComposeParams(params.applied & applied, tuple(_restrict(child, applied) for child in params.children))
    return params._replace(applied=params.applied & applied)


def _groups(effects: Sequence[Effect], requests: Sequence[PlanRequest | None]) -> list[list[int]]:
    """Return the places of the warps that are sampled together."""
    groups: list[list[int]] = [[]]
    for place, (effect, request) in enumerate(zip(effects, requests, strict=True)):
        if request is None:
            groups.append([])
        elif isinstance(effect, WarpEffect):
            groups[-1].append(place)
    return [group for group in groups if group]


def _plan_group(warps: Sequence[WarpEffect], request: PlanRequest, *, can_measure: bool = True) -> CompositionPlan:
    """Plan warps that are sampled together."""
    if len(warps) == 1:
        plan = warps[0].plan_under(replace(request, ulps=warps[0].rounding_ulps).if_reachable())
        return CompositionPlan(max(plan.stride, 1), True, (plan,), plan.error_px, plan.max_gradient)
    planned = [
        PlannedWarp(
            warp.error_model() if warp.tolerance_px else None,
            warp.rounding_ulps,
            warp.has_closed_form and not warp.has_kinks,
        )
        for warp in warps
    ]
    return plan_composition(tuple(planned), request, can_measure=can_measure)


def _group_samples(active: Sequence[Tensor]) -> list[tuple[Tensor | None, list[int]]]:
    """Group samples by the warps that move them: pairs of their numbers, None for all, and the numbers of the warps."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for i, row in enumerate(torch.stack(list(active), dim=1).tolist()):
        acting = tuple([k for k, moves in enumerate(row) if moves])
        groups.setdefault(acting or (len(active) - 1,), []).append(i)
    return [
        (None if len(groups) == 1 else torch.tensor(rows, device="cpu"), list(acting))
        for acting, rows in groups.items()
    ]


def _composed_flow(warps: Sequence[Leaf], plan: CompositionPlan, tolerance_px: float | None) -> list[FlowPart]:
    """Compute the flow of warps in a row."""
    if len(warps) == 1:
        return warps[0].effect.flow_parts(warps[0].params, plan.plans[0])
    flows = [
        leaf.effect.warp_flow(leaf.params, each)
        for leaf, each in zip(warps, plan.plans, strict=True)
        if each.stride > 0 or requires_grad(leaf.params)
    ]
    if not flows:
        return [zero_flow(warps[0].params, plan.plans[0])]
    options = {"is_smooth": plan.is_smooth, "tolerance_px": tolerance_px or 0.0}
    return flow_on_measured_lattice(flows, stride=plan.stride, **options)
