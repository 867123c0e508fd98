"""Several effects in a row, with one look-up for all warps that follow one another."""

import itertools
import math
from collections.abc import Iterator, Sequence
from copy import copy
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrefract import random
from torchrefract._tensor import assume_constant_result
from torchrefract._validation import check_choice
from torchrefract.effects.base import Effect, moved
from torchrefract.effects.compose_plan import ComposePlan, compose_plan
from torchrefract.effects.plan import TOLERANCE_PX, Plan, PlanRequest, check_tolerance
from torchrefract.effects.radiance import RadianceEffect
from torchrefract.effects.refraction import WarpEffect
from torchrefract.effects.rows import Undrawn, drawn
from torchrefract.effects.walk import Look, Walk
from torchrefract.types import Degraded
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.resample import BACKENDS, INTERPOLATIONS, PADDINGS

_OPEN = Look()
_MOST_SETS = 64  # of effects that act together, for each of which there is a plan


class ComposeParams(NamedTuple):
    """The parameters of all effects of a composition."""

    applied: Tensor  # (B,), bool: the sample is degraded; where it is not, no effect's own gate is open
    children: tuple[Any, ...]  # of each effect, in order

    def to(self, *args: Any, **kwargs: Any) -> "ComposeParams":
        """All tensors moved as by `Tensor.to`; a change of type leaves flags as they are."""
        return ComposeParams(
            moved(self.applied, *args, **kwargs), tuple(child.to(*args, **kwargs) for child in self.children)
        )


class Compose(Effect):
    """Effects one after the other, the first nearest to the scene.

        flow(p) = d_1,  d_i = d_(i+1) + f_i(p + d_(i+1)),  d_n = f_n(p)

    Warps that follow one another look the image up once, along the composite of their flows, so that the image is
    blurred once. Effects of light between them keep their place: the image is looked up before, and their maps move
    with the warps after. `restore_flow` is the composite of the flows back, in closed form where the effects have one;
    it is not valid where it misses by more than 0.5 px, as between the sheets of a fold.

    Args:
        effects: at least one; compositions may be nested.
        padding, interpolation, backend: of the look-ups, whatever the effects and compositions inside have; None
            takes those of the last warp that moves the sample, or of the outermost composition inside that has it.
        tolerance_px: how far the composite of all flows may be from the exact one, px, see `plan`; None is exact. It
            takes the place of what the effects and compositions inside have, but an effect that has None stays exact.
            As for warps, the default is exact in frames too large for it.
        p: chance that a sample is degraded at all.

    Raises:
        ValueError, TypeError: no effect, or something else among them.
    """

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

    params_type = ComposeParams

    @property
    def takes_levels(self) -> bool:
        """Whether all its effects do."""
        return all(effect.takes_levels for effect in self._effects())

    def at_rest(self) -> bool:
        """Whether none of its effects acts."""
        return all(effect.idle for effect in self._effects())

    def draw(self, source: random.Stream, image: Tensor) -> ComposeParams:
        """Each effect's draw, from streams of their own."""
        return drawn(self.draw_sparingly(source, image))

    def draw_sparingly(self, source: random.Stream, image: Tensor) -> ComposeParams:
        """The same, but what is idle is drawn when somebody reads it."""
        return self._draw_sparingly(source, image, idle=False)

    def _draw_sparingly(self, source: random.Stream, image: Tensor, *, idle: bool) -> ComposeParams:
        applied, gates = self._gates(source)
        inner, idle = random.fold(source), idle or self.p == 0
        children: list[Any] = []
        for i, effect in enumerate(self._effects()):
            if isinstance(effect, Compose):
                children.append(effect._draw_sparingly(inner.at(i), image, idle=idle))
            elif idle or effect.idle:
                children.append(_later(effect, inner.at(i), image))
            else:
                children.append(effect.draw(inner.at(i), image))
        return ComposeParams(applied, tuple(map(_closed, children, gates)))

    def check(self, params: ComposeParams, image: Tensor) -> None:
        """Raise for parameters that one of the effects refuses."""
        if len(params.children) != len(self.effects):
            raise ValueError(
                f"params.children must be those of {len(self.effects)} effects, got {len(params.children)}"
            )
        for effect, child in zip(self._effects(), params.children, strict=True):
            effect.check_params(child, image)

    def check_params(self, params: Any, image: Tensor) -> None:
        """Raise for parameters that are not of these effects and this batch."""
        if not isinstance(params, ComposeParams):
            raise TypeError(f"params must be ComposeParams, got {type(params).__name__}")
        if params.applied.shape != image.shape[:1]:
            raise ValueError(
                f"params.applied must have one row for each of the {image.shape[0]} images, got {tuple(params.applied.shape)}"
            )
        self.check(params, image)

    def compute(self, image: Tensor, params: ComposeParams, depth: Tensor | None) -> Degraded:
        """The batch through all effects."""
        walk = Walk(image, depth)
        height, width = image.shape[2:]
        leaves = list(self.leaves(params))
        idle = tuple(
            isinstance(own, Undrawn) or (rests and not _stirs(effect, own, height, width))
            for (effect, own), rests in zip(leaves, self._idle(), strict=True)
        )
        plans = self._constant(id(self), height, width, field_dtype(image.dtype), idle).plans
        for (effect, own), plan, look, rests in zip(leaves, plans, self._looks(), idle, strict=True):
            if rests:
                walk.rest(effect)
            elif isinstance(effect, WarpEffect):
                walk.move(effect, own, cast(Plan, plan), look)
            else:
                walk.shade(cast(RadianceEffect, effect), own, plan)
        return walk.arrive(lambda: drawn(params))

    def planned(self, height: int, width: int, dtype: torch.dtype) -> ComposePlan:
        """The plan for fields of a type."""
        return self._planned(height, width, dtype, list(self._idle()))

    def _planned(self, height: int, width: int, dtype: torch.dtype, idle: Sequence[bool]) -> ComposePlan:
        """That without some effects."""
        ask = PlanRequest(height, width, self.tolerance_px, dtype is torch.float64).of_default
        return compose_plan(list(zip(self._leaves(), idle, strict=True)), self._together(), ask)

    @assume_constant_result
    def _constant(self, _: int, height: int, width: int, dtype: torch.dtype, idle: Sequence[bool]) -> ComposePlan:
        # As for `PlannedLight`.
        return self._planned(height, width, dtype, idle)

    def for_params(self, params: ComposeParams, height: int, width: int) -> "Compose":
        """The composition, with each effect that relies on ranges which its parameters lie outside of exact."""
        pairs = zip(self._effects(), params.children, strict=True)
        effects = [effect.for_params(child, height, width) for effect, child in pairs]
        if all(new is old for new, old in zip(effects, self._effects(), strict=True)):
            return self
        for_params = copy(self)
        for_params._modules = {**self._modules, "effects": nn.ModuleList(effects)}
        return for_params

    def leaves(self, params: ComposeParams) -> Iterator[tuple[Effect, Any]]:
        """The effects that are no compositions, in order, with their parameters."""
        for effect, child in zip(self._effects(), params.children, strict=True):
            if isinstance(effect, Compose):
                yield from effect.leaves(child)
            else:
                yield effect, child

    def _gates(self, source: random.Stream) -> tuple[Tensor, list[Tensor]]:
        """(B,), bool: that of the composition, and those of its effects."""
        applied = random.uniform(source, 1)[:, 0] < self.p
        return applied, [applied] * len(self.effects)

    def _leaves(self) -> Iterator[Effect]:
        """The effects that are no compositions, in order."""
        for effect in self._effects():
            yield from effect._leaves() if isinstance(effect, Compose) else [effect]

    def _looks(self, outer: Look = _OPEN) -> Iterator[Look]:
        """How each of them is looked up, as far as the compositions say."""
        own = outer.before(Look(self.padding, self.interpolation, self.backend))
        for effect in self._effects():
            if isinstance(effect, Compose):
                yield from effect._looks(own)
            else:
                yield own

    def _idle(self, *, idle: bool = False) -> Iterator[bool]:
        """Whether each of them is idle; in an idle composition all are."""
        idle = idle or self.p == 0
        for effect in self._effects():
            if isinstance(effect, Compose):
                yield from effect._idle(idle=idle)
            else:
                yield idle or effect.idle

    def _together(self) -> list[tuple[int, ...]]:
        """The effects that are no compositions, by their places in order, as sets that may act on one sample."""
        first, sets = 0, list[list[tuple[int, ...]]]()
        for effect in self._effects():
            own = effect._together() if isinstance(effect, Compose) else [(0,)]
            sets.append([tuple(first + place for place in places) for places in own])
            first += 1 + max(itertools.chain.from_iterable(own))
        return self._joined(sets)

    def _joined(self, sets: Sequence[Sequence[tuple[int, ...]]]) -> list[tuple[int, ...]]:
        """The sets of all children, from those of each."""
        if math.prod(map(len, sets)) > _MOST_SETS:
            return [tuple(sorted({place for own in sets for places in own for place in places}))]
        return [tuple(itertools.chain.from_iterable(chosen)) for chosen in itertools.product(*sets)]

    def _effects(self) -> Iterator[Effect]:
        return cast(Iterator[Effect], iter(self.effects))


def _closed(params: Any, applied: Tensor) -> Any:
    """Parameters that leave the samples alone for which the gate is closed."""
    if isinstance(params, Undrawn):
        return params.then(lambda found: _closed(found, applied))
    if isinstance(params, ComposeParams):
        return ComposeParams(params.applied & applied, tuple(_closed(child, applied) for child in params.children))
    return params._replace(applied=params.applied & applied)


def _stirs(effect: Effect, params: Any, height: int, width: int) -> bool:
    """Whether an effect that is no composition may change a sample, or a gradient is asked for that could."""
    if isinstance(effect, WarpEffect):
        return effect.stirs(params, height, width)
    return cast(RadianceEffect, effect).stirs(params)


def _later(effect: Effect, source: random.Stream, image: Tensor) -> Undrawn:
    """The draw of an effect as it is now, whatever becomes of its ranges; compilers follow no copies."""
    now = effect if torch.compiler.is_compiling() else _as_now(effect)
    return Undrawn(partial(_draw_for, now, source, image.shape, image.dtype, image.device))  # and holds no picture


def _draw_for(effect: Effect, source: random.Stream, size: torch.Size, dtype: torch.dtype, device: torch.device) -> Any:
    return effect.draw(source, torch.empty((), dtype=dtype, device=device).expand(size))


def _as_now(effect: Effect) -> Effect:
    """What `copy` makes of an effect, in a tenth of its time: most compositions with idle effects never read it."""
    now = object.__new__(type(effect))
    vars(now).update(vars(effect))
    return now
