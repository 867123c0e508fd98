"""Several warps as one: their flows composed, for each sample those that move it."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrefract._bands import in_place
from torchrefract._checks import is_true, learns, read
from torchrefract.effects.rows import only
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.grid import Positions
from torchrefract.warping.mixed import Flow, dense, flow_rows, grid_of
from torchrefract.warping.resample import follow


class Step(NamedTuple):
    """One warp, or several as one, as `only` reads parameters."""

    gate: Tensor  # (B,), bool: the sample is degraded by one of them
    active: Tensor  # (B,), bool: and is moved
    path: Flow | Positions  # the flow, (B, 2, H, W), px, or in another form

    def of(self, index: Tensor) -> "Step":
        """The same for some of the rows."""
        return Step(self.gate[index], self.active[index], flow_rows(cast(Flow, self.path), index))


def exact(steps: Sequence[Step]) -> Step:
    """Warps in a row as one. Each flow is read once, where the later ones look; what is read twice is blurred twice."""
    steps = [step._replace(path=dense(cast(Flow, step.path))) for step in steps]
    return Step(*_any(steps), _each_by_itself(steps, _in_a_row))


def on_grid(steps: Sequence[Step], dtype: torch.dtype) -> Step:
    """The same in the sampler's own positions: faster, and off by their rounding."""

    def one(steps: Sequence[Step]) -> Tensor:
        if all(isinstance(step.path, Tensor) for step in steps):
            return grid_of(_in_a_row(steps), dtype)
        return _in_a_row_on_grid(steps, dtype)

    return Step(*_any(steps), Positions(_each_by_itself(steps, one)))


def _any(steps: Sequence[Step]) -> tuple[Tensor, Tensor]:
    """Gate and active of steps as one."""
    gates, active = [step.gate for step in steps], [step.active for step in steps]
    return functools.reduce(torch.logical_or, gates), functools.reduce(torch.logical_or, active)


def _each_by_itself(steps: Sequence[Step], one: Callable[[Sequence[Step]], Tensor]) -> Tensor:
    """What `one` makes of the steps, for the rows that a combination of them moves by those alone; 0 for the others."""
    apart = _apart(steps)
    if apart is None:
        return one(steps)
    found = list[tuple[Tensor, Tensor]]()
    for acting, rows in sorted(apart.items(), reverse=True):  # what moves nothing comes last
        index = torch.tensor(rows)
        own = [step.of(index) for step, acts in zip(steps, acting, strict=True) if acts]
        found.append((index, one(own) if own else found[0][1].new_zeros(len(rows), *found[0][1].shape[1:])))
    return in_place(found)


def _apart(steps: Sequence[Step]) -> dict[tuple[bool, ...], list[int]] | None:
    """The rows that each combination of the steps moves, by which of them do; None where that would save nothing."""
    flags = (
        None
        if any(map(learns, steps))
        else read(lambda: torch.stack([step.active for step in steps], dim=1), of=steps[0].active)
    )
    if flags is None or all(map(all, flags)) or not any(map(any, flags)):
        return None
    rows: dict[tuple[bool, ...], list[int]] = {}
    for i, acting in enumerate(flags):
        rows.setdefault(tuple(acting), []).append(i)
    return rows


def _in_a_row(steps: Sequence[Step]) -> Tensor:
    """(B, 2, H, W), px, of steps whose paths are flows."""
    *earlier, last = steps
    for step in reversed(earlier):
        own = cast(Tensor, step.path)
        flow = only(compose_flows(own, cast(Tensor, last.path)), own, last.active, last)
        last = Step(step.gate | last.gate, step.active | last.active, flow)
    return cast(Tensor, last.path)


def _in_a_row_on_grid(steps: Sequence[Step], dtype: torch.dtype) -> Tensor:
    """(B, H, W, 2)."""
    *earlier, last = steps
    grid = grid_of(cast(Flow, last.path), dtype)
    for step in reversed(earlier):
        own = cast(Flow, step.path)
        both = follow(own, grid)
        grid = both if is_true(last.active.all, of=last.active) else only(both, grid_of(own, dtype), last.active, last)
        last = Step(step.gate | last.gate, step.active | last.active, Positions(grid))
    return grid
