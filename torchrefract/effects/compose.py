"""Several effects in a row, with one look-up for all warps that follow one another; or one out of several."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrefract import draws
from torchrefract._checks import check_choice, check_number, is_true
from torchrefract.effects.base import Effect, column
from torchrefract.effects.refraction import Moved, WarpEffect, learns, moving, only, sees
from torchrefract.types import Degraded
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.resample import INTERPOLATIONS, PADDINGS, look_up


class ComposeParams(NamedTuple):
    """The parameters of all effects of a composition."""

    gate: Tensor  # (B,), bool: the sample is degraded; where it is not, no effect's own gate is open
    children: tuple[Any, ...]  # of each effect, in order

    def to(self, *args: Any, **kwargs: Any) -> "ComposeParams":
        """All tensors moved as by `Tensor.to`; a change of type leaves flags as they are."""
        gate = self.gate.to(*args, **kwargs).to(self.gate.dtype)
        return ComposeParams(gate, tuple(child.to(*args, **kwargs) for child in self.children))


class Compose(Effect):
    """Effects one after the other, the first nearest to the scene.

        flow(p) = f_n(p) + f_(n-1)(p + f_n(p)) + ...

    Warps that follow one another look the image up once, along the composite of their flows, so that the image is
    blurred once. Effects of light between them keep their place: the image is looked up before, and their maps move
    with the warps after. `restore_flow` is the composite of the flows back, in closed form where the effects have one.

    Args:
        effects: at least one; compositions may be nested.
        padding, interpolation: of the look-ups; None takes those of the last warp that moves the sample.
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

    params_type = ComposeParams

    def draw(self, source: draws.Stream, image: Tensor) -> ComposeParams:
        """Each effect's draw, from streams of their own."""
        gate = draws.uniform(source, 1)[:, 0] < self.p
        return self._draw_children(source, image, [gate] * len(self.effects), gate)

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
        if params.gate.shape != image.shape[:1]:
            raise ValueError(
                f"params.gate must have one row for each of the {image.shape[0]} images, got {tuple(params.gate.shape)}"
            )
        self.check(params, image)

    def compute(self, image: Tensor, params: ComposeParams, depth: Tensor | None) -> Degraded:
        """The batch through all effects."""
        walk = _Walk(image, depth, self.padding, self.interpolation)
        for effect, own in self.leaves(params):
            if isinstance(effect, WarpEffect):
                walk.move(effect, own)
            else:
                walk.shade(effect, own)
        return walk.arrive(params)

    def leaves(self, params: ComposeParams) -> Iterator[tuple[Effect, Any]]:
        """The effects that are no compositions, in order, with their parameters."""
        for effect, child in zip(self._effects(), params.children, strict=True):
            if isinstance(effect, Compose):
                yield from effect.leaves(child)
            else:
                yield effect, child

    def _draw_children(
        self, source: draws.Stream, image: Tensor, gates: Sequence[Tensor], gate: Tensor
    ) -> ComposeParams:
        inner = draws.fold(source)
        drawn = (effect.draw(inner.at(i), image) for i, effect in enumerate(self._effects()))
        return ComposeParams(gate, tuple(_closed(child, own) for child, own in zip(drawn, gates, strict=True)))

    def _effects(self) -> Iterator[Effect]:
        return cast(Iterator[Effect], iter(self.effects))


class OneOf(Compose):
    """One of several effects for each sample.

    Args:
        effects: to choose from.
        weights: how often each is chosen, relative to one another, above 0; None chooses all alike.
        padding, interpolation, p: as for `Compose`.

    Raises:
        ValueError, TypeError: as for `Compose`; weights that are not one positive number for each effect.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        *,
        weights: Sequence[float] | None = None,
        padding: str | None = None,
        interpolation: str | None = None,
        p: float = 1.0,
    ):
        super().__init__(effects, padding=padding, interpolation=interpolation, p=p)
        weights = [1.0] * len(effects) if weights is None else weights
        if len(weights) != len(effects):
            raise ValueError(f"weights must be one number for each of {len(effects)} effects, got {len(weights)}")
        self.weights = tuple(check_number("weights", weight, low=1e-9) for weight in weights)

    def draw(self, source: draws.Stream, image: Tensor) -> ComposeParams:
        """A choice for each sample, and each effect's draw."""
        values = draws.uniform(source, 2)
        gate, choice = values[:, 0] < self.p, values[:, 1] * sum(self.weights)
        ends = torch.tensor(self.weights, device=choice.device).cumsum(dim=0)[:-1]
        chosen = torch.bucketize(choice, ends, right=True)
        return self._draw_children(source, image, [gate & (chosen == i) for i in range(len(self.effects))], gate)


class _Group(NamedTuple):
    """Warps that one look-up does together, as `only` reads parameters."""

    gate: Tensor
    flow: Tensor


class _Walk:
    """An image on its way through effects; warps wait until something needs the image."""

    def __init__(self, image: Tensor, depth: Tensor | None, padding: str | None, interpolation: str | None):
        self.image, self.depth = image, depth
        self.padding, self.interpolation = padding, interpolation
        self.waiting: Tensor | None = None  # the composite flow of the warps that wait
        self.active = self.gate = torch.zeros(image.shape[0], dtype=torch.bool, device=image.device)
        self.modes: dict[tuple[str, str], Tensor] = {}  # of the look-up: the samples that ask for it, (B,), bool
        self.moved: list[tuple[WarpEffect, Any, Moved]] = []
        self.total: Callable[[], Tensor] | None = None
        self.valid: Callable[[], Tensor] = self._everywhere
        self.transmission: Callable[[], Tensor] | None = None
        self.intensity: Callable[[], Tensor] | None = None
        self.refracts = False

    def move(self, effect: WarpEffect, params: Any) -> None:
        """One more warp waits."""
        self.refracts = True
        if is_true((params.gate & effect.moves(params)).any) is False and not learns(params):
            return
        moved = effect.gated(params, height=self.image.shape[2], width=self.image.shape[3])
        before, valid = self.waiting, self.valid
        if before is None:
            self.waiting = moved.flow
        else:
            self.waiting = only(compose_flows(before, moved.flow), before, moved.active, params)
        self.valid = lambda: moved.exists & inside(moved.flow) & sees(valid(), moved.flow)
        self.active, self.gate = self.active | moved.active, self.gate | params.gate
        self._choose(effect, moved.active)
        self.moved.append((effect, params, moved))

    def shade(self, effect: Effect, params: Any) -> None:
        """The image in other light, after the warps that wait."""
        self._look_up()
        shaded = effect.compute(self.image, params, self.depth)
        valid, intensity, transmission = self.valid, self.intensity, self.transmission
        self.image = shaded.image
        self.valid = lambda: valid() & shaded.valid
        passed, added = shaded.has("transmission"), shaded.has("intensity")
        if passed:
            self.transmission = lambda: _product(transmission, shaded.transmission)
        if added or (passed and intensity is not None):
            self.intensity = lambda: _sum(intensity, shaded.transmission, shaded.intensity)

    def arrive(self, params: ComposeParams) -> Degraded:
        """What has become of the image, with all maps."""
        self._look_up()
        if not self.refracts:
            return Degraded(
                self.image, params, valid=self.valid, transmission=self.transmission, intensity=self.intensity
            )
        return moving(
            self.image,
            params,
            flow=self._still if self.total is None else self.total,
            valid=self.valid,
            undo=self._undo,
            transmission=self.transmission,
            intensity=self.intensity,
        )

    def _look_up(self) -> None:
        """What waits is done."""
        flow = self.waiting
        if flow is None:
            return
        active, group, total = self.active, _Group(self.gate, flow), self.total
        self.image = only(self._looked_up(flow), self.image, active, group)
        if self.depth is not None:
            near = look_up(self.depth, flow.detach(), padding="border", interpolation="nearest")
            self.depth = only(near, self.depth, active, group)

        def moved_along(value: Callable[[], Tensor] | None) -> Callable[[], Tensor] | None:
            if value is None:
                return None
            return lambda: only(
                look_up(value(), flow, padding="border", interpolation="bilinear"), value(), active, group
            )

        self.transmission, self.intensity = moved_along(self.transmission), moved_along(self.intensity)
        self.total = (
            (lambda: flow) if total is None else (lambda: only(compose_flows(total(), flow), total(), active, group))
        )
        self.waiting, self.active, self.gate = None, torch.zeros_like(active), torch.zeros_like(active)
        self.modes = {}

    def _choose(self, effect: WarpEffect, active: Tensor) -> None:
        """The samples that an effect moves are looked up as it asks, unless the whole composition says how."""
        mode = self.padding or effect.padding, self.interpolation or effect.interpolation
        asked = self.modes.pop(mode, torch.zeros_like(active))
        self.modes = {other: samples & ~active for other, samples in self.modes.items()} | {mode: asked | active}

    def _looked_up(self, flow: Tensor) -> Tensor:
        warped = None
        for (padding, interpolation), samples in reversed(self.modes.items()):
            if warped is not None and is_true(samples.any) is False:
                continue
            found = look_up(self.image, flow, padding=padding, interpolation=interpolation)
            warped = found if warped is None else torch.where(column(samples), found, warped)
        return cast(Tensor, warped)

    def _undo(self) -> tuple[Tensor, Tensor]:
        total, known, done = self._still(), self._everywhere(), torch.zeros_like(self.active)
        for effect, params, moved in self.moved:
            back, exists = effect.gated_undo(params, moved)
            # A flow that is zero is left out, not looked up: a sample must not depend on what moves the others.
            moves = params.gate if learns(params) else moved.active
            both, last = column(done & moves), column(moves)
            if is_true(both.any) is not False:
                exists = torch.where(both, known & sees(exists, total), exists)
                back = torch.where(both, compose_flows(back, total), back)
            known, total = torch.where(last, exists, known), torch.where(last, back, total)
            done = done | moves
        return total, known

    def _still(self) -> Tensor:
        batch, _, height, width = self.image.shape
        return torch.zeros(batch, 2, height, width, dtype=field_dtype(self.image.dtype), device=self.image.device)

    def _everywhere(self) -> Tensor:
        batch, _, height, width = self.image.shape
        return torch.ones(batch, 1, height, width, dtype=torch.bool, device=self.image.device)


def _closed(params: Any, gate: Tensor) -> Any:
    """Parameters that leave the samples alone for which the gate is closed."""
    if isinstance(params, ComposeParams):
        return ComposeParams(params.gate & gate, tuple(_closed(child, gate) for child in params.children))
    return params._replace(gate=params.gate & gate)


def _product(before: Callable[[], Tensor] | None, value: Tensor | None) -> Tensor:
    return cast(Tensor, value) if before is None else before() * cast(Tensor, value)


def _sum(before: Callable[[], Tensor] | None, passed: Tensor | None, added: Tensor | None) -> Tensor:
    """Light added so far, as much of it as comes through, and what is added now."""
    if before is None:
        return cast(Tensor, added)
    arrives = before() if passed is None else before() * passed
    return arrives if added is None else arrives + added
