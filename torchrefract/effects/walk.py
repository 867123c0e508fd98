"""An image on its way through several effects: warps that follow one another are looked up together."""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract._validation import eager_bool, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.photometric_effect import RadianceEffect, clear_maps
from torchrefract.effects.plan import Plan
from torchrefract.effects.refraction import Moved, WarpEffect, looked_up, moving, sees
from torchrefract.effects.rows import column, expand_batch, where_active
from torchrefract.effects.steps import Step, exact, on_grid
from torchrefract.planning.photometric import LightPlan
from torchrefract.types import Degraded
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.grid import Positions, field_dtype, inside
from torchrefract.warping.mixed import dense
from torchrefract.warping.resample import sample_image, sampler_dtype

_Combine = Callable[[Tensor, Tensor], Tensor]
# How the maps of several effects of light make one.
_COMBINED: dict[str, _Combine] = {"transmission": torch.mul, "intensity": torch.add, "extinction": torch.add}


class Look(NamedTuple):
    """How an image is looked up, as for `warp`; None leaves it open."""

    padding: str | None = None
    interpolation: str | None = None
    backend: str | None = None

    def before(self, other: "Look") -> "Look":
        """This, and the other where it is left open."""
        return Look(*(own or others for own, others in zip(self, other, strict=True)))


class Walk:
    """An image on its way through effects; warps wait until something needs the image."""

    def __init__(self, image: Tensor, depth: Tensor | None):
        self.image, self.depth = image, depth
        self.done: list[list[Step]] = []  # those that were looked up together
        self.waiting: list[Step] = []
        self.modes: dict[Look, Tensor] = {}  # of the look-up: the samples that ask for it, (B,), bool
        self.moved: list[tuple[WarpEffect, Any, Moved]] = []
        self.valid: Callable[[], Tensor] | None = None  # everywhere
        self.light: dict[str, Callable[[], Tensor]] = {}  # the maps of light, by their names in `Degraded`
        self.clear: set[str] = set()  # the names of those of effects that change nothing
        self.refracts = False

    def rest(self, effect: Effect) -> None:
        """One that changes nothing; maps say so."""
        if isinstance(effect, RadianceEffect):
            self.clear.update(effect.maps)
        else:
            self.refracts = True

    def move(self, effect: WarpEffect, params: Any, plan: Plan, look: Look) -> None:
        """One more warp waits; what `look` leaves open is looked up as the warp asks."""
        self.refracts = True
        rows, _, height, width = self.image.shape
        planned = {"plan": plan} if isinstance(effect, LatticeWarp) else {}
        if not effect.stirs(params, height, width, **planned):
            return
        own = effect.masked_flow(params, height=height, width=width, **planned)
        moved, valid = own.expand_batch(rows), self.valid
        self.waiting.append(Step(expand_batch(params.applied, rows), moved.active, moved.path))

        def own_valid() -> Tensor:
            return moved.exists & inside(moved.flow)

        self.valid = own_valid if valid is None else lambda: own_valid() & sees(valid(), moved.flow)
        self._choose(look.before(Look(effect.padding, effect.interpolation, effect.backend)), moved.active)
        self.moved.append((effect, params, own))

    def shade(self, effect: RadianceEffect, params: Any, plan: Plan | LightPlan) -> None:
        """The image in other light, after the warps that wait; if that is planned to be none, they go on waiting."""
        # By the plan: where some samples are in other light and some are not, all are looked up alike.
        if plan.acts or effect.stirs(params):
            self._look_up()
        shaded = effect.compute(self.image, params, self.depth)
        rows, before, valid = self.image.shape[0], dict(self.light), self.valid
        self.image = shaded.image
        self.valid = lambda: (
            expand_batch(shaded.valid, rows) if valid is None else valid() & expand_batch(shaded.valid, rows)
        )

        def now(name: str) -> Callable[[], Tensor] | None:
            return (lambda: expand_batch(getattr(shaded, name), rows)) if shaded.has(name) else None

        passed = now("transmission")
        if "intensity" in before and passed is not None:  # of the light added before, so much comes through
            added = before["intensity"]
            before["intensity"] = lambda: added() * passed()
        self.light = before
        for name, combine in _COMBINED.items():
            self._add(name, now(name), combine)

    def arrive(self, params: Any) -> Degraded:
        """What has become of the image, with all maps."""
        self._look_up()
        # Not a method of its own, through which the walk and all its maps would hold themselves.
        valid = self.valid or functools.partial(_everywhere, self.image.shape, self.image.device)
        light = clear_maps(self.clear, self.image) | self.light
        if not self.refracts:
            return Degraded(self.image, params, valid=valid, light=light)
        return moving(
            self.image,
            params,
            flow=self._flow,
            valid=valid,
            undo=self._undo,
            several=self._several if len(self.moved) > 1 else None,
            light=light,
        )

    def _flow(self) -> Tensor:
        """(B, 2, H, W), px: of all that is done."""
        if not self.done:
            return self._still()
        if len(self.moved) == 1:
            return self.moved[0][2].expand_batch(self.image.shape[0]).flow
        # The first is read where the others look, and the last leads there: neither is read twice, and blurred.
        first, *others = self.done
        between = itertools.chain.from_iterable(others[:-1])
        return cast(Tensor, exact([self._as_one(first), *between, *map(self._as_one, others[-1:])]).path)

    def _as_one(self, steps: list[Step]) -> Step:
        """Warps that were looked up together, as one with a flow (B, 2, H, W), px."""
        # Made again for who asks: kept, it would be as large as the image for who does not.
        whole = self._composite(steps)
        return exact(steps) if isinstance(whole.path, Positions) else whole._replace(path=dense(whole.path))

    def _add(self, name: str, value: Callable[[], Tensor] | None, combine: _Combine) -> None:
        """One more effect's share in a map of light."""
        before = self.light.get(name)
        if value is not None:
            self.light[name] = value if before is None else lambda: combine(before(), value())

    def _look_up(self) -> None:
        """What waits is done."""
        if not self.waiting:
            return
        group = self._composite(self.waiting)
        self.image = self._looked_up(group)
        if self.depth is not None:
            self.depth = expand_batch(self.depth, self.image.shape[0])
            near = sample_image(self.depth, group.path.detach(), padding="border", interpolation="nearest")
            self.depth = where_active(near, self.depth, group.active, group)

        def moved_along(value: Callable[[], Tensor]) -> Callable[[], Tensor]:
            return lambda: where_active(
                sample_image(value(), group.path, padding="border", interpolation="bilinear"),
                value(),
                group.active,
                group,
            )

        self.light = {name: moved_along(value) for name, value in self.light.items()}
        self.done.append([group] if isinstance(group.path, Tensor) and not self.done else self.waiting)
        self.waiting, self.modes = [], {}

    def _composite(self, steps: list[Step]) -> Step:
        """Warps that are looked up together, as one."""
        if len(steps) == 1:
            return steps[0]
        if all(isinstance(step.path, Tensor) for step in steps):
            return exact(steps)
        flows = functools.reduce(torch.promote_types, [step.path.dtype for step in steps])
        return on_grid(steps, sampler_dtype(self.image, flows))

    def _choose(self, mode: Look, active: Tensor) -> None:
        """The samples that an effect moves are looked up as is asked for it."""
        asked = self.modes.pop(mode, torch.zeros_like(active))
        self.modes = {other: samples & ~active for other, samples in self.modes.items()} | {mode: asked | active}

    def _looked_up(self, group: Step) -> Tensor:
        """The image where a group of warps leads."""
        (latest, _), *before = reversed(self.modes.items())
        others = [(mode, samples) for mode, samples in before if eager_bool(samples.any, of=samples) is not False]
        if not others:
            return looked_up(self.image, group.path, group.active, group, **latest._asdict())
        warped = sample_image(self.image, group.path, **latest._asdict())
        for mode, samples in others:
            warped = torch.where(column(samples), sample_image(self.image, group.path, **mode._asdict()), warped)
        return where_active(warped, self.image, group.active, group)

    def _moves(self) -> list[Tensor]:
        """(B,), bool, of each warp: the samples that it may move."""
        # A flow that is zero is left out, not looked up: a sample must not depend on what moves the others.
        rows = self.image.shape[0]
        return [expand_batch(own.applied if requires_grad(own) else moved.active, rows) for _, own, moved in self.moved]

    def _several(self) -> Tensor:
        """(B,), bool: the samples that several warps may move."""
        return torch.stack(self._moves()).sum(dim=0) > 1

    def _undo(self) -> tuple[Tensor, Tensor]:
        rows, found = self.image.shape[0], None
        for (effect, params, moved), moves in zip(self.moved, self._moves(), strict=True):
            back, exists = (expand_batch(value, rows) for value in effect.masked_inverse_flow(params, moved))
            if found is None:
                found = back, exists, moves
                continue
            total, known, done = found
            both, last = column(done & moves), column(moves)
            if eager_bool(both.any, of=both) is not False:
                exists = torch.where(both, known & sees(exists, total), exists)
                back = torch.where(both, compose_flows(back, total), back)
            found = torch.where(last, back, total), torch.where(last, exists, known), done | moves
        return found[:2] if found else (self._still(), _everywhere(self.image.shape, self.image.device))

    def _still(self) -> Tensor:
        batch, _, height, width = self.image.shape
        return torch.zeros(batch, 2, height, width, dtype=field_dtype(self.image.dtype), device=self.image.device)


def _everywhere(shape: torch.Size, device: torch.device) -> Tensor:
    """(B, 1, H, W), bool, of an image (B, C, H, W)."""
    batch, _, height, width = shape
    return torch.ones(batch, 1, height, width, dtype=torch.bool, device=device)
