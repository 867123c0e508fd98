"""Rows: inside an effect the frames of a clip lie one after the other, (B T, ...).

What is the same in all frames of a clip has one row for each clip until it meets what is not.
"""

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._tensor import expand_batch
from torchrefract._validation import eager_bool, eager_values, requires_grad


def expand_alike(*values: Tensor) -> list[Tensor]:
    """The values with as many rows as the one of them that has most."""
    rows = max(value.shape[0] for value in values)
    return [expand_batch(value, rows) for value in values]


class Undrawn:
    """Parameters that are drawn when somebody reads them.

    Args:
        draw: what draws them.
    """

    def __init__(self, draw: Callable[[], Any]):
        self.draw = draw

    def then(self, change: Callable[[Any], Any]) -> "Undrawn":
        """The same, changed once they are drawn."""
        return Undrawn(lambda: change(self.draw()))


def drawn(params: Any) -> Any:
    """The parameters, with all that was left undrawn among them."""
    if isinstance(params, Undrawn):
        return params.draw()
    children = getattr(params, "children", None)
    return params if children is None else params._replace(children=tuple(map(drawn, children)))


def at_frames(params: Any, frames: Callable[[], Tensor]) -> Any:
    """The parameters of the same draw at other frames, (B, T), of the clips; those without a `frame` stay."""
    if isinstance(params, Undrawn):
        return params.then(lambda found: at_frames(found, frames))
    if "children" in params._fields:
        return params._replace(children=tuple(at_frames(child, frames) for child in params.children))
    return params._replace(frame=frames()) if "frame" in params._fields else params


def promote_params(params: Any, dtype: torch.dtype) -> Any:
    """The parameters, those that are floating in the given type or a wider one: fields are never half."""
    if isinstance(params, Undrawn):
        return params.then(lambda found: promote_params(found, dtype))
    if isinstance(params, Tensor):
        return params.to(torch.promote_types(params.dtype, dtype)) if params.is_floating_point() else params
    if "children" in params._fields:
        return params._replace(children=tuple(promote_params(child, dtype) for child in params.children))
    return type(params)(*(promote_params(value, dtype) for value in params))


def frame_mean(value: Tensor) -> Tensor:
    """(N, C, 1, 1), the mean over the frame of (N, C, H, W), to the same bits in any batch and on any thread."""
    # By rows, which no threads share.
    return value.sum(dim=3, keepdim=True).sum(dim=2, keepdim=True) / (value.shape[2] * value.shape[3])


def column(flags: Tensor) -> Tensor:
    """(B, 1, 1, 1) of (B,)."""
    return flags.view(-1, 1, 1, 1)


class _Swap(torch.autograd.Function):
    """The first tensor forward, the gradient of the second backward."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, path: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        return None

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]  # two inputs, two gradients
        return None, gradient


def where_active(changed: Tensor, same: Tensor | float, active: Tensor, params: Any) -> Tensor:
    """`changed` for the active samples and `same`, bit for bit, for the others.

    A sample at strength zero keeps the gradient of its parameters: descent must be able to start there.

    Args:
        changed: (N, ...).
        same: (N, ...), or a number.
        active: (N,) or (B,), bool: the samples that the effect changes at all.
        params: (B,) of everything; those of open gates keep their gradient.
    """
    if eager_bool(active.all, of=active):
        return changed
    rows = changed.shape[0]
    value = torch.where(column(expand_batch(active, rows)), changed, same)
    if not requires_grad(params):
        return value
    path = torch.where(column(expand_batch(params.applied, rows)), changed, same)
    return cast(Tensor, _Swap.apply(value.detach(), path))


def some(active: Tensor, params: Any) -> Tensor | None:
    """(n,), the numbers of the samples that are active, so that the others need not be computed.

    None where that would save nothing, cannot be told without waiting for a device, or where a gradient of the
    parameters is asked for.
    """
    flags = None if requires_grad(params) else eager_values(lambda: active)
    if flags is None or all(flags) or not any(flags):
        return None
    return torch.tensor([i for i, flag in enumerate(flags) if flag])


def part(value: Tensor, index: Tensor, batch: int) -> Tensor:
    """The rows of some samples of a batch; one row for all of them stays."""
    frames, odd = divmod(value.shape[0], batch)
    return value if odd else value[frames_of(index, frames)]


def params_part(params: Any, index: Tensor) -> Any:
    """The parameters of some samples."""
    return type(params)(*(value[index] for value in params))


def put(value: Tensor, index: Tensor, into: Tensor | float, batch: int) -> Tensor:
    """The rows of some samples in their places of a batch, the others as they are in `into`, or of that number."""
    value = expand_batch(value, max(len(index), value.shape[0]))
    frames = value.shape[0] // len(index)
    if not isinstance(into, Tensor):
        into = value.new_full((batch * frames, *value.shape[1:]), into)
    return into.index_copy(0, frames_of(index, frames), value)


def frames_of(index: Tensor, frames: int) -> Tensor:
    """(n frames,): the numbers of the rows of some samples, (n,), of so many frames each."""
    return (frames * index[:, None] + torch.arange(frames)).flatten()
