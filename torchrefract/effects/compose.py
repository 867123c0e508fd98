"""Several effects in a row, with one sampling for all warps that follow one another."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrefract import random
from torchrefract._tensor import assume_constant_result, expand_batch
from torchrefract._validation import check_choice, eager_bool, eager_values, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import params_per_frame, params_to, per_sample, select_params, where_active
from torchrefract.effects.photometric_effect import PhotometricEffect
from torchrefract.effects.warp_effect import (
    BatchFlow,
    FlowPart,
    SamplingOptions,
    WarpEffect,
    flow_dtype,
    warped,
)
from torchrefract.planning.composition import ComposePlan, CompositionPlan, PlannedWarp, plan_composition
from torchrefract.planning.plan import (
    TOLERANCE_PX,
    ErrorModel,
    PlanRequest,
    WarpPlan,
    check_tolerance,
    lattice_with_stride,
)
from torchrefract.types import Degraded
from torchrefract.warping.flow import compose_flows
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.warp import BACKENDS, INTERPOLATIONS, PADDINGS, sees_only_valid

# How photometric maps of several effects combine.
_COMBINE: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "transmission": torch.mul,
    "intensity": torch.add,
    "extinction": torch.add,
}

_UNDECIDED = SamplingOptions()


class ComposeParams(NamedTuple):
    """The parameters of all effects of a composition."""

    applied: Tensor  # (B,), bool: the sample is degraded; where it is False, it is False in all children too
    children: tuple[Any, ...]  # of each effect, in order

    to = params_to


class _Leaf(NamedTuple):
    """An effect that is not a composition, with its parameters and the sampling options of the compositions around."""

    effect: Effect
    params: Any
    options: SamplingOptions


class Compose(Effect):
    """Effects one after the other, the first nearest to the scene.

        flow(p) = d_1,  d_i = d_(i+1) + f_i(p + d_(i+1)),  d_n = f_n(p)

    Warps that follow one another sample the image once, along their composed flow, so that it is blurred once. Under a
    tolerance the composed flow is computed at the nodes of one lattice. Photometric effects between warps keep their
    place: the image is sampled before them, and their maps move with the warps after them. `restore_flow` is the
    composition of the inverse flows; it is not valid where it misses by more than 0.5 px, as between the sheets of a
    fold.

    Args:
        effects: at least one; compositions may be nested.
        padding, interpolation, backend: of all samplings, in place of those of the effects and compositions inside;
            None takes those of the last warp that moves the sample, or of the outermost composition inside that has
            them.
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
        effects: Sequence[Effect],
        *,
        padding: str | None = None,
        interpolation: str | None = None,
        backend: str | None = None,
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(p=p)
        if not effects:
            raise ValueError("effects must be at least one effect, got none")
        for effect in effects:
            if not isinstance(effect, Effect):
                raise TypeError(f"effects must be effects of torchrefract, got {type(effect).__name__}")
        self.effects = nn.ModuleList(effects)
        self.padding = None if padding is None else check_choice("padding", padding, PADDINGS)
        self.interpolation = (
            None if interpolation is None else check_choice("interpolation", interpolation, INTERPOLATIONS)
        )
        self.backend = None if backend is None else check_choice("backend", backend, BACKENDS)
        self.tolerance_px = check_tolerance(tolerance_px)

    @property
    def keeps_uint8(self) -> bool:
        """Return True if all effects do."""
        return all(effect.keeps_uint8 for effect in self._children())

    def sample_params(self, stream: random.Stream, image: Tensor) -> ComposeParams:
        """Draw the parameters of each effect from a stream of its own."""
        applied, children_applied = self.sample_applied(stream)
        inner = random.fold(stream)
        children = [effect.sample_params(inner.at(i), image) for i, effect in enumerate(self._children())]
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
        for effect, child in zip(self._children(), params.children, strict=True):
            effect.check_params(child, image)

    def check_params(self, params: Any, image: Tensor) -> None:
        """Raise for parameters that do not belong to these effects and this batch."""
        if not isinstance(params, ComposeParams):
            raise TypeError(f"params must be ComposeParams, got {type(params).__name__}")
        if params.applied.shape != image.shape[:1]:
            raise ValueError(
                f"params.applied must have one row for each of the {image.shape[0]} images, "
                f"got {tuple(params.applied.shape)}"
            )
        self.validate(params, image)

    def for_params(self, params: ComposeParams, height: int, width: int) -> "Compose":
        """Return the composition with an exact effect wherever parameters lie outside the ranges."""
        pairs = zip(self._children(), params.children, strict=True)
        effects = [effect.for_params(child, height, width) for effect, child in pairs]
        if all(new is old for new, old in zip(effects, self._children(), strict=True)):
            return self
        composition = copy(self)
        composition._modules = {**self._modules, "effects": nn.ModuleList(effects)}
        return composition

    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> ComposePlan:
        """Return the plan for all parameters in the ranges."""
        effects = [effect for effect, _ in self._leaf_effects()]
        requests = self._requests(height, width, dtype)
        plans: dict[int, Any] = {}
        strides, error, stretch = [], 0.0, 1.0
        groups = self._groups([request is None for request in requests])
        for group in groups:
            warps = _planned_warps([effects[place] for place in group])
            plan = plan_composition(warps, cast(PlanRequest, requests[group[0]]))
            plans |= dict(zip(group, plan.plans, strict=True))
            strides.append(plan.stride)
            error += plan.error_px * stretch if plan.error_px else 0.0
            stretch *= 1 + plan.max_gradient
        each = tuple(
            plans[place] if place in plans else effect.plan_for_dtype(height, width, dtype)
            for place, effect in enumerate(effects)
        )
        names = tuple(type(effect).__name__ for effect in effects)
        samplings = sum(
            any(effects[place].p > 0 and not plans[place].is_identity for place in group) for group in groups
        )
        return ComposePlan(height, width, self.tolerance_px, names, each, tuple(strides), error, samplings)

    def degrade_batch(self, image: Tensor, params: ComposeParams, depth: Tensor | None) -> Degraded:
        """Pass the images through all effects."""
        height, width = image.shape[2:]
        dtype = field_dtype(image.dtype)
        pairs = zip(self.effects_with_params(params), self._leaf_effects(), strict=True)
        leaves = [_Leaf(effect, own, options) for (effect, own), (_, options) in pairs]
        state = _Progress(image, depth, len(params.applied))
        places: list[int] = []
        requests = self._constant_requests(id(self), height, width, dtype)

        def move() -> None:
            together = tuple(places)
            state.move(
                [leaves[place] for place in together],
                cast(PlanRequest, requests[together[0]]),
                lambda: self._constant_plan(id(self), together, height, width, dtype),
            )

        for place, leaf in enumerate(leaves):
            if isinstance(leaf.effect, WarpEffect):
                state.has_warps = True
                if leaf.effect.may_change(leaf.params) and height * width > 1:
                    places.append(place)
                continue
            changes_light = requests[place] is None or leaf.effect.may_change(leaf.params)
            if places and changes_light:  # the warps before it come first
                move()
                places.clear()
            state.shade(cast(PhotometricEffect, leaf.effect), leaf.params)
        if places:
            move()
        return state.result(params)

    def effects_with_params(self, params: ComposeParams) -> Iterator[tuple[Effect, Any]]:
        """Yield the effects that are not compositions, in order, with their parameters."""
        for effect, child in zip(self._children(), params.children, strict=True):
            if isinstance(effect, Compose):
                yield from effect.effects_with_params(child)
            else:
                yield effect, child

    def _leaf_effects(self, outer: SamplingOptions = _UNDECIDED) -> Iterator[tuple[Effect, SamplingOptions]]:
        options = outer.or_else(SamplingOptions(self.padding, self.interpolation, self.backend))
        for effect in self._children():
            if isinstance(effect, Compose):
                yield from effect._leaf_effects(options)
            elif isinstance(effect, WarpEffect):
                yield effect, options.or_else(SamplingOptions(effect.padding, effect.interpolation, effect.backend))
            else:
                yield effect, options

    def _groups(self, separates: Sequence[bool]) -> list[list[int]]:
        """Return the places of the warps that are sampled together."""
        groups: list[list[int]] = [[]]
        for place, (effect, _) in enumerate(self._leaf_effects()):
            if separates[place]:
                groups.append([])
            elif isinstance(effect, WarpEffect):
                groups[-1].append(place)
        return [group for group in groups if group]

    def _requests(self, height: int, width: int, dtype: torch.dtype) -> tuple[PlanRequest | None, ...]:
        """Return for each effect the request of its group of warps, or None if it separates groups.

        A photometric effect that may change something separates groups, whatever is drawn, so that a sample does not
        depend on the others of its batch.
        """
        effects = [effect for effect, _ in self._leaf_effects()]
        request = PlanRequest(height, width, self.tolerance_px, dtype is torch.float64).with_reachable_default()
        requests: list[PlanRequest | None] = [
            request if isinstance(effect, WarpEffect) or not _may_change(effect, height, width, dtype) else None
            for effect in effects
        ]
        if request.tolerance_px is None:
            return tuple(requests)
        request.remaining_px()  # raises for an unreachable tolerance
        tolerance_px = request.tolerance_px
        groups, stretch = self._groups([request is None for request in requests]), 1.0
        for group in groups if len(groups) > 1 else ():
            share = replace(request, tolerance_px=tolerance_px / len(groups) / stretch)
            if not share.is_reachable:
                share = replace(request, tolerance_px=None)
            for place in group:
                requests[place] = share
            stretch *= 1 + plan_composition(_planned_warps([effects[place] for place in group]), share).max_gradient
        return tuple(requests)

    @assume_constant_result
    def _constant_requests(self, _: int, height: int, width: int, dtype: torch.dtype) -> tuple[PlanRequest | None, ...]:
        return self._requests(height, width, dtype)

    @assume_constant_result
    def _constant_plan(
        self, _: int, places: tuple[int, ...], height: int, width: int, dtype: torch.dtype
    ) -> tuple[int, tuple[WarpPlan, ...]]:
        # torch.compile reads the fields of a constant, but not those of the dataclasses in it.
        effects = [effect for effect, _ in self._leaf_effects()]
        request = cast(PlanRequest, self._requests(height, width, dtype)[places[0]])
        plan = plan_composition(_planned_warps([effects[place] for place in places]), request)
        return plan.stride, plan.plans

    def _children(self) -> Iterator[Effect]:
        return cast(Iterator[Effect], iter(self.effects))


class _Segment(NamedTuple):
    """Warps that were sampled together."""

    applied: Tensor  # (N,), bool: one of the warps is applied
    active: Tensor  # (N,), bool: and moves the sample
    flow: BatchFlow

    def sample(self, image: Tensor, options: SamplingOptions) -> Tensor:
        """Sample images (N, C, H, W) along the flow."""
        return self.flow.sample(image, self.active, _Applied(self.applied, self.flow.parts[0].flow.nodes), options)


class _Applied(NamedTuple):
    """What `where_active` reads of parameters."""

    applied: Tensor
    nodes: Tensor


class _Progress:
    """Images on their way through the effects of a composition, and what their maps are computed from."""

    def __init__(self, image: Tensor, depth: Tensor | None, batch: int):
        self.image, self.depth = image, depth
        self.frames = image.shape[0] // max(batch, 1)
        self.has_warps = False
        self.segments: list[_Segment] = []
        self.warps: list[tuple[WarpEffect, Any, Callable[[], BatchFlow], Tensor]] = []  # with params, own flow, active
        self.valid: Callable[[], Tensor] | None = None  # None is everywhere
        self.light: dict[str, Callable[[], Tensor]] = {}

    def move(
        self,
        leaves: Sequence[_Leaf],
        request: PlanRequest,
        plan_all: Callable[[], tuple[int, tuple[WarpPlan, ...]]],
    ) -> None:
        """Sample the images along the composed flow of several warps.

        Args:
            leaves: the warps, in order.
            request: the frame and the tolerance of the composed flow.
            plan_all: returns the stride and the plans if all warps move all samples.
        """
        rows, _, height, width = self.image.shape
        leaves = [leaf._replace(params=params_per_frame(leaf.params, self.frames)) for leaf in leaves]
        warps = [(cast(WarpEffect, leaf.effect), leaf.params) for leaf in leaves]
        active = [effect.active(params, height, width) for effect, params in warps]
        groups = _group_samples(warps, active, request, plan_all)
        applied, moved = torch.stack([params.applied for _, params in warps]).any(dim=0), torch.stack(active).any(dim=0)
        parts = []
        for index, acting, stride, plans in groups:
            chosen = [warps[k] for k in acting]
            if index is not None:
                chosen = [(effect, select_params(params, index)) for effect, params in chosen]
            parts.append(FlowPart(index, *_composed_flow(chosen, stride, plans)))
            if all(plan.stride == 0 for plan in plans) and not _needs_gradient(chosen):
                moved = torch.zeros_like(moved) if index is None else moved.index_fill(0, index, False)
        segment = _Segment(applied, moved, BatchFlow(parts))
        self.image = _sample_segment(self.image, segment, leaves, active)
        if self.depth is not None:
            depth, detached = expand_batch(self.depth, rows), segment._replace(flow=segment.flow.detach())
            self.depth = detached.sample(depth, SamplingOptions("border", "nearest", "auto"))
        self.light = {name: _moved(value, segment) for name, value in self.light.items()}
        is_exact = request.tolerance_px is None
        for (effect, params), moves in zip(warps, active, strict=True):
            flow = _remember(
                lambda effect=effect, params=params: effect.planned_flow(params, height, width, is_exact=is_exact)
            )
            self.warps.append((effect, params, flow, moves))
            self.valid = _valid_after(self.valid, flow, moves)
        self.segments.append(segment)

    def shade(self, effect: PhotometricEffect, params: Any) -> None:
        """Apply a photometric effect."""
        shaded = effect.degrade_batch(self.image, params, self.depth)
        rows, before, valid = self.image.shape[0], dict(self.light), self.valid
        self.image = shaded.image
        self.valid = (
            (lambda: expand_batch(shaded.valid, rows))
            if valid is None
            else (lambda: valid() & expand_batch(shaded.valid, rows))
        )

        def own_map(name: str) -> Callable[[], Tensor] | None:
            return (lambda: expand_batch(getattr(shaded, name), rows)) if shaded.has(name) else None

        transmission = own_map("transmission")
        if "intensity" in before and transmission is not None:  # light that was added before is attenuated
            added = before["intensity"]
            before["intensity"] = lambda: added() * transmission()
        self.light = before
        for name, combine in _COMBINE.items():
            value = own_map(name)
            if value is not None:
                earlier = self.light.get(name)
                self.light[name] = value if earlier is None else _combined(combine, earlier, value)

    def result(self, params: ComposeParams) -> Degraded:
        """Return the images with all maps."""
        size, device = self.image.shape, self.image.device
        valid = self.valid or (lambda: torch.ones(size[0], 1, *size[2:], dtype=torch.bool, device=device))
        if not self.has_warps:
            return Degraded(self.image, params, valid=valid, light=self.light)
        return warped(
            self.image,
            params,
            flow=self._flow,
            valid=valid,
            inverse=self._inverse,
            is_composed=self._is_composed if len(self.warps) > 1 else None,
            light=self.light,
        )

    def _flow(self) -> Tensor:
        """Return (N, 2, H, W), px, the composed flow of all segments."""
        if not self.segments:
            rows, _, height, width = self.image.shape
            return torch.zeros(rows, 2, height, width, dtype=field_dtype(self.image.dtype), device=self.image.device)
        flow = self.segments[-1].flow.dense
        for segment in reversed(self.segments[:-1]):
            flow = torch.where(
                per_sample(segment.active),
                compose_flows(segment.flow.dense, flow),
                flow,
            )
        return flow

    def _is_composed(self) -> Tensor:
        """Return (N,), bool: samples that several warps move."""
        return torch.stack([moves for _, _, _, moves in self.warps]).sum(dim=0) > 1

    def _inverse(self) -> tuple[Tensor, Tensor]:
        """Compose the inverse flows of all warps, sample by sample of those that move it."""
        total: Tensor | None = None
        valid = moved = torch.empty(0)
        for effect, params, flow, moves in self.warps:
            inverse, exists = effect.masked_inverse_flow(params, flow().dense)
            exists = exists.expand(len(inverse), 1, *inverse.shape[2:])
            if total is None:
                total, valid, moved = inverse, exists, moves
                continue
            both, alone = per_sample(moved & moves), per_sample(moves)
            if eager_bool(both.any, of=both) is not False:
                exists = torch.where(both, valid & sees_only_valid(exists, total), exists)
                inverse = torch.where(both, compose_flows(inverse, total), inverse)
            total, valid = torch.where(alone, inverse, total), torch.where(alone, exists, valid)
            moved = moved | moves
        if total is None:
            flow = self._flow()
            return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)
        return total, valid


def _restrict(params: Any, applied: Tensor) -> Any:
    """Apply the effect only to samples that the composition around it is applied to."""
    if isinstance(params, ComposeParams):
        return ComposeParams(params.applied & applied, tuple(_restrict(child, applied) for child in params.children))
    return params._replace(applied=params.applied & applied)


def _remember(compute: Callable[[], BatchFlow]) -> Callable[[], BatchFlow]:
    """Compute a flow when it is first needed, and keep it."""
    computed: list[BatchFlow] = []

    def flow() -> BatchFlow:
        if not computed:
            computed.append(compute())
        return computed[0]

    return flow


def _valid_after(
    before: Callable[[], Tensor] | None, flow: Callable[[], BatchFlow], moves: Tensor
) -> Callable[[], Tensor]:
    """Return where an image is valid after one more warp."""

    def valid() -> Tensor:
        own = (flow().exists & inside(flow().dense)) | ~per_sample(moves)
        return own if before is None else own & sees_only_valid(before(), flow().dense)

    return valid


def _moved(value: Callable[[], Tensor], segment: _Segment) -> Callable[[], Tensor]:
    """Move a photometric map along."""
    return lambda: segment.sample(value(), SamplingOptions("border", "bilinear", "auto"))


def _combined(
    combine: Callable[[Tensor, Tensor], Tensor], first: Callable[[], Tensor], second: Callable[[], Tensor]
) -> Callable[[], Tensor]:
    return lambda: combine(first(), second())


def _sample_segment(image: Tensor, segment: _Segment, leaves: Sequence[_Leaf], active: Sequence[Tensor]) -> Tensor:
    """Sample the images, each with the options of the last warp that moves it."""
    result = segment.sample(image, leaves[-1].options)
    decided = active[-1]
    for leaf, moves in zip(reversed(leaves[:-1]), reversed(active[:-1]), strict=True):
        chosen = moves & ~decided
        if leaf.options != leaves[-1].options and eager_bool(chosen.any, of=chosen) is not False:
            result = torch.where(per_sample(chosen), segment.sample(image, leaf.options), result)
        decided = decided | moves
    return result


def _may_change(effect: Effect, height: int, width: int, dtype: torch.dtype) -> bool:
    return effect.p > 0 and not effect.plan_for_dtype(height, width, dtype).is_identity


def _planned_warps(effects: Sequence[Effect]) -> tuple[PlannedWarp, ...]:
    """Return warps as a plan needs them, with the error models of their ranges."""
    warps = cast(Sequence[WarpEffect], effects)
    return tuple([_planned_warp(warp, warp.error_model() if warp.tolerance_px else None) for warp in warps])


def _planned_warp(warp: WarpEffect, model: ErrorModel | None) -> PlannedWarp:
    return PlannedWarp(model, warp.rounding_ulps, warp.has_closed_form)


class _Group(NamedTuple):
    """Samples that the same warps move, by the same plan."""

    samples: Tensor | None  # (n,), their numbers; None for all
    acting: list[int]  # the numbers of the warps
    stride: int  # px, of the lattice of the composed flow
    plans: tuple[WarpPlan, ...]  # of each of the acting warps


def _group_samples(
    warps: Sequence[tuple[WarpEffect, Any]],
    active: Sequence[Tensor],
    request: PlanRequest,
    plan_all: Callable[[], tuple[int, tuple[WarpPlan, ...]]],
) -> list[_Group]:
    """Group the samples by the warps that move them and by their plan.

    If values cannot be read, there is one group with all warps, whose plan holds for any subset of them.
    """
    flags = None
    if not _needs_gradient(warps):
        flags = eager_values(lambda: torch.stack(list(active), dim=1), of=active[0])
    everything = list(range(len(warps)))
    if flags is None:
        return [_Group(None, everything, *plan_all())]
    planned = [_planned_samples(effect, params, request) for effect, params in warps]
    groups: dict[Any, tuple[list[int], list[int], CompositionPlan]] = {}
    for i, row in enumerate(flags):
        acting = [k for k in everything if row[k]] or everything[-1:]
        plan = plan_composition(tuple([planned[k][i] for k in acting]), request)
        groups.setdefault((tuple(acting), plan.key), ([], acting, plan))[0].append(i)
    return [
        _Group(None if len(groups) == 1 else torch.tensor(rows), acting, plan.stride, plan.plans)
        for rows, acting, plan in groups.values()
    ]


def _needs_gradient(warps: Sequence[tuple[WarpEffect, Any]]) -> bool:
    return any(requires_grad(params) for _, params in warps)


def _planned_samples(effect: WarpEffect, params: Any, request: PlanRequest) -> list[PlannedWarp]:
    """Return the warp as a plan needs it for each sample."""
    dtype = torch.float64 if request.is_double else torch.float32
    if not effect.has_sample_models or not effect.plan_for_dtype(request.height, request.width, dtype).is_per_sample:
        return list(_planned_warps([effect])) * len(params.applied)
    return [_planned_warp(effect, model) for model in effect.sample_models(params)]


def _composed_flow(
    warps: Sequence[tuple[WarpEffect, Any]], stride: int, plans: Sequence[WarpPlan]
) -> tuple[LatticeFlow, Tensor]:
    """Compute the composed flow of warps at the nodes of one lattice, and where it exists."""
    if len(warps) == 1:
        return warps[0][0].masked_flow(warps[0][1], plans[0])
    height, width = plans[0].height, plans[0].width
    lattice = lattice_with_stride(height, width, stride)
    dtype = flow_dtype(warps[0][1])
    device = warps[0][1].applied.device
    points = lattice.points(dtype=dtype, device=device)
    total: Tensor | None = None
    exists = torch.ones(1, 1, 1, 1, dtype=torch.bool, device=device)
    for (effect, params), plan in zip(reversed(warps), reversed(plans), strict=True):
        if plan.stride == 0:
            continue
        flow, flow_exists = effect.flow(params, points if total is None else points.displaced(total), plan)
        active = effect.active(params, height, width)
        flow = where_active(flow, 0.0, active, params)
        total = flow if total is None else total + flow
        exists = exists & (flow_exists | ~per_sample(active))
    if total is None:
        rows, columns = lattice.num_nodes
        total = torch.zeros(len(warps[0][1].applied), 2, rows, columns, dtype=dtype, device=device)
    return LatticeFlow(total, lattice), exists if stride == 1 else exists.new_ones(1, 1, 1, 1)
