"""Several warps as one: their flows composed, for each sample those that move it."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import torch
from torch import Tensor

from torchrefract._tensor import scatter_batch
from torchrefract._validation import eager_bool, eager_values, requires_grad
from torchrefract.effects.rows import where_active
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.followed import FollowedFlow, Read, followed
from torchrefract.warping.grid import Positions
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.mixed import Flow, MixedFlow, Part, PartFlow, dense, flow_rows, grid_of

_Found = TypeVar("_Found", bound=Flow | Positions)


class Step(NamedTuple):
    """One warp, or several as one, as `only` reads parameters."""

    applied: Tensor  # (B,), bool: the sample is degraded by one of them
    active: Tensor  # (B,), bool: and is moved
    path: Flow | Positions  # the flow, (B, 2, H, W), px, or in another form

    def of(self, index: Tensor) -> "Step":
        """The same for some of the rows."""
        path = flow_rows(cast(Flow, self.path), index)
        return Step(self.applied[index], self.active[index], path)

    def read(self) -> Read:
        """What later steps read of it."""
        path = cast(Flow, self.path)
        return path if isinstance(path, LatticeFlow) else dense(path)


def exact(steps: Sequence[Step]) -> Step:
    """Warps in a row as one. Each flow is read once, where the later ones look; what is read twice is blurred twice."""
    steps = [step._replace(path=dense(cast(Flow, step.path))) for step in steps]
    apart = _apart(steps)
    found = _in_a_row(steps) if apart is None else scatter_batch(_each(steps, apart, _in_a_row))
    return Step(*_any(steps), found)


def on_grid(steps: Sequence[Step], dtype: torch.dtype) -> Step:
    """The same in the sampler's own positions: faster, and off by their rounding."""

    def one(steps: Sequence[Step]) -> Flow | Positions:
        if len(steps) == 1:
            return steps[0].path
        if all(isinstance(step.path, Tensor) for step in steps):
            return _in_a_row(steps)
        last = steps[-1].path
        if isinstance(last, LatticeFlow) and not any(map(requires_grad, steps)):
            return FollowedFlow(last, tuple(step.read() for step in reversed(steps[:-1])))
        return Positions(_in_a_row_on_grid(steps, dtype))

    apart = _apart(steps)
    return Step(*_any(steps), one(steps) if apart is None else _together(_each(steps, apart, one), dtype))


def _any(steps: Sequence[Step]) -> tuple[Tensor, Tensor]:
    """Gate and active of steps as one."""
    gates, active = [step.applied for step in steps], [step.active for step in steps]
    return functools.reduce(torch.logical_or, gates), functools.reduce(torch.logical_or, active)


def _apart(steps: Sequence[Step]) -> dict[tuple[bool, ...], list[int]] | None:
    """The rows that each combination of the steps moves, by which of them do; None where that would save nothing."""
    flags = (
        None
        if any(map(requires_grad, steps))
        else eager_values(lambda: torch.stack([step.active for step in steps], dim=1), of=steps[0].active)
    )
    if flags is None or all(map(all, flags)) or not any(map(any, flags)):
        return None
    rows: dict[tuple[bool, ...], list[int]] = {}
    for i, acting in enumerate(flags):
        rows.setdefault(tuple(acting), []).append(i)
    return rows


def _each(
    steps: Sequence[Step], apart: dict[tuple[bool, ...], list[int]], one: Callable[[Sequence[Step]], _Found]
) -> list[tuple[Tensor, _Found]]:
    """What `one` makes of the steps, for the rows that a combination of them moves by those alone."""
    found = list[tuple[Tensor, _Found]]()
    for acting, rows in apart.items():
        index = torch.tensor(rows)
        # What none of them moves has a flow of 0 in any of them.
        own = [step.of(index) for step, acts in zip(steps, acting, strict=True) if acts] or [steps[-1].of(index)]
        found.append((index, one(own)))
    return found


def _together(found: Sequence[tuple[Tensor, Flow | Positions]], dtype: torch.dtype) -> Flow | Positions:
    """The rows of a batch in one form."""
    if any(isinstance(flow, Positions) for _, flow in found):
        grids = [(i, flow.grid if isinstance(flow, Positions) else grid_of(flow, dtype)) for i, flow in found]
        return Positions(scatter_batch(grids))
    parts = list[Part]()
    for index, flow in found:
        own = flow.parts if isinstance(flow, MixedFlow) else ((torch.arange(len(index)), cast(PartFlow, flow)),)
        parts += [(index[rows], part) for rows, part in own]
    return MixedFlow(tuple(parts))


def _in_a_row(steps: Sequence[Step]) -> Tensor:
    """(B, 2, H, W), px, of steps whose paths are flows."""
    *earlier, last = steps
    for step in reversed(earlier):
        own = cast(Tensor, step.path)
        flow = where_active(compose_flows(own, cast(Tensor, last.path)), own, last.active, last)
        last = Step(step.applied | last.applied, step.active | last.active, flow)
    return cast(Tensor, last.path)


def _in_a_row_on_grid(steps: Sequence[Step], dtype: torch.dtype) -> Tensor:
    """(B, H, W, 2)."""
    *earlier, last = steps
    grid = grid_of(cast(Flow, last.path), dtype)
    for step in reversed(earlier):
        both = followed(step.read(), grid)
        own = cast(Flow, step.path)
        grid = (
            both
            if eager_bool(last.active.all, of=last.active)
            else where_active(both, grid_of(own, dtype), last.active, last)
        )
        last = Step(step.applied | last.applied, step.active | last.active, Positions(grid))
    return grid
