"""Warps in a row: what the earlier ones add where a later one looks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract._tensor import as_device_tensor
from torchrefract._threads import share
from torchrefract._validation import requires_grad
from torchrefract.warping.grid import FAR, finite, pixel_axes, sampler_axes
from torchrefract.warping.grid_sample import by_grid_sample
from torchrefract.warping.lattice import FARTHEST, LatticeFlow, Lines, StreamFlow, lagrange_weights, once

# A flow that is read: known at every pixel, (B, 2, H, W), px, lines between, or on a lattice, cubics between.
Read = Tensor | LatticeFlow
Size = tuple[int, int]
Reading = tuple[np.ndarray, np.ndarray, np.ndarray, Size]
_WIDEST = 32  # nodes in a row that kernels read together


def followed(flow: Read, grid: Tensor) -> Tensor:
    """(B, n, m, 2): the grid, where F.grid_sample(align_corners=False) looks, moved by the flow that is there.

    Outside of the frame a flow is as at its border. One on a lattice is read at its pixels, with lines between.
    """
    values = _at_pixels(flow).to(grid.dtype)
    if len(values) != len(grid):  # F.grid_sample raises, too; a kernel would read what is not there
        raise ValueError(f"grid must have a row for each of {len(values)} flows, got {len(grid)}")
    size, far = (values.shape[2], values.shape[3]), _far(flow)
    if (
        requires_grad((values, grid))
        or grid.shape[1] * grid.shape[2] < compiled.SMALLEST
        or compiled.obstacle(values, grid)
    ):
        return _moved(grid, _at(values, grid), size=size, far=far)
    before = grid.movedim(-1, 1).contiguous()
    out = torch.empty_like(before)
    readings = of_readings([values], [0], far=[far], size=size)
    work, into = partial(compiled.kernels("warping.kernels.following").follow, before.numpy(), *readings), out.numpy()
    lines, columns = grid.shape[1:3]
    share(lambda start, stop: work(start, stop, into), len(grid) * lines, least=compiled.SMALLEST // columns + 1)
    return out.movedim(1, -1)


class Trail(NamedTuple):
    """What kernels are told of flows in a row; `warping.kernels.composed` says what it is."""

    last: tuple[Any, ...]
    earlier: Reading
    known: tuple[Any, ...]
    held: Sequence[tuple[Tensor, int]]  # what is read, for as long as this is kept


@dataclass(frozen=True)
class FollowedFlow:
    """A smooth flow, and the flows of warps before it that are read where it looks, one after the other.

    By kernels their composite is known at nodes every `last.every` px, by cubics between; without these, each pixel is
    followed.
    """

    last: LatticeFlow
    earlier: tuple[Read, ...]  # of the same batch; the later ones first

    @property
    def dtype(self) -> torch.dtype:
        """Of the positions."""
        return self.last.dtype

    @property
    def requires_grad(self) -> bool:
        """Whether one of the flows has a gradient."""
        return self.last.requires_grad or any(own.requires_grad for own in self.earlier)

    @property
    def nodes(self) -> Tensor:
        """What the last flow is known by."""
        return self.last.nodes

    def detach(self) -> "FollowedFlow":
        """The same without gradients."""
        return FollowedFlow(self.last.detach(), tuple(own.detach() for own in self.earlier))

    def rows(self, index: Tensor) -> "FollowedFlow":
        """Some rows of the batch."""
        earlier = (own[index] if isinstance(own, Tensor) else own.rows(index) for own in self.earlier)
        return FollowedFlow(self.last.rows(index), tuple(earlier))

    def dense(self) -> Tensor:
        """(B, 2, H, W), px: where it is looked up, less where the pixels are."""
        height, width = self.last.lattice[:2]
        grid = self.sampler_grid(self.dtype).movedim(-1, 1)
        x, y = sampler_axes(
            *pixel_axes(height, width, dtype=grid.dtype, device=grid.device), height=height, width=width
        )
        u, v = grid.split(1, dim=1)
        return torch.cat([(u - x) * (width / 2), (v - y) * (height / 2)], dim=1)

    def sampler_grid(self, dtype: torch.dtype) -> Tensor:
        """(B, H, W, 2): where F.grid_sample(align_corners=False) looks."""
        height, width = self.last.lattice[:2]
        values = (self.last.nodes, *(own if isinstance(own, Tensor) else own.nodes for own in self.earlier))
        if dtype is torch.float32 and height * width >= compiled.SMALLEST and not compiled.obstacle(*values):
            return self._filled()
        grid = self.last.sampler_grid(dtype)
        for own in self.earlier:
            grid = followed(own, grid)
        return grid

    def _filled(self) -> Tensor:
        """The same by a kernel."""
        height, width = self.last.lattice[:2]
        out = self.last.nodes.new_empty(len(self.last.nodes), 2, height, width)
        work, into = partial(compiled.kernels("warping.kernels.composed").positions, *self.trail[:3]), out.numpy()
        share(lambda start, stop: work(start, stop, into), len(out) * height, least=compiled.SMALLEST // width + 1)
        return out.movedim(1, -1)

    @cached_property
    def trail(self) -> Trail:
        """What kernels are told."""
        values, flows = compiled.of_batch(self.last.nodes)
        lines = self.last.with_nodes(values).lines(values.dtype)
        size, far = self.last.lattice[:2], [_far(own) for own in self.earlier]
        held = [_in_memory(own) if self.last.every > 1 else (_at_pixels(own), 0) for own in self.earlier]
        earlier = of_readings(*zip(*held, strict=True), far=far, size=size)
        return Trail(of_lines(lines, flows), earlier, self._known(lines, flows, earlier), held)

    def _known(self, lines: Lines, flows: np.ndarray, earlier: Reading) -> tuple[Any, ...]:
        """Nodes of the composite."""
        px, (height, width) = self.last.every, self.last.lattice[:2]
        rows, columns = ((height - 1) // px + 1, (width - 1) // px + 1) if px > 1 else (0, 0)
        # Of torch, which gives the same memory again: what is new has to be cleared first.
        out = self.last.nodes.new_empty(len(flows), 2, rows, columns).numpy()
        spans = np.empty((len(flows), rows, 2), np.int64)
        if px == 1:
            return out, spans, np.empty((4, 0), np.float32)
        x = None if lines.x is None else lines.x[::px]
        last = of_lines(lines._replace(values=lines.values[..., ::px], x=x), flows)
        work = partial(compiled.kernels("warping.kernels.composed").compose, last, earlier, px)
        share(lambda start, stop: work(start, stop, out, spans), len(out) * rows, least=compiled.SMALLEST // width + 1)
        weight = lagrange_weights(px, 4, dtype=torch.float32, device=torch.device("cpu")).numpy()
        return out, spans, np.ascontiguousarray(weight.T)


def of_lines(lines: Lines, flows: np.ndarray) -> tuple[Any, ...]:
    """As kernels have them, with the flow of each row."""
    values, weight = lines.values.contiguous(), lines.weight.contiguous()
    x = values.new_zeros(values.shape[3]) if lines.x is None else lines.x.contiguous()
    y = values.new_zeros(lines.height) if lines.y is None else lines.y
    return values.numpy(), flows, weight.numpy(), x.numpy(), y.numpy()


def of_readings(flows: Sequence[Tensor], strides: Sequence[int], *, far: Sequence[float], size: Size) -> Reading:
    """Where the flows of each row lie in memory, (B, k), and what else `follow_row` is told of them.

    Who calls keeps the flows for as long as they are read.

    Args:
        flows: (B, 2, n, m), px, at every pixel or at nodes.
        strides: px, of the nodes; 0 for every pixel.
        far: where sums lie within, in the sampler's coordinates.
        size: px, height and width of the frame.
    """
    addresses = np.array([_addresses(*own) for own in zip(flows, strides, strict=True)], np.uint64)
    table = np.array([(*values.shape[2:], stride) for values, stride in zip(flows, strides, strict=True)])
    return addresses.T.copy(), table, np.array(far, np.float32), size


def _addresses(values: Tensor, px: int) -> list[int]:
    """Where the values of each row begin."""
    form = _form() if px else torch.contiguous_format
    if not values[:1].is_contiguous(memory_format=form):
        own = "both numbers of a node together" if form is torch.channels_last else "the planes of a row in one piece"
        raise ValueError(f"values must have {own}, got strides {values.stride()}")
    apart = values.stride(0) * values.element_size()
    return [values.data_ptr() + i * apart for i in range(len(values))]


def _at_pixels(flow: Read) -> Tensor:
    if isinstance(flow, LatticeFlow):
        return once(flow, lambda own: own.dense())
    return flow if flow[:1].is_contiguous() else flow.contiguous()


def _in_memory(flow: Read) -> tuple[Tensor, int]:
    """What kernels read of a flow, and the stride of its nodes, 0 for pixels."""
    if not isinstance(flow, LatticeFlow) or isinstance(flow, StreamFlow):
        return _at_pixels(flow), 0
    few = max(0, _WIDEST - flow.nodes.shape[3])

    def wide(own: LatticeFlow) -> Tensor:
        return (F.pad(own.nodes, (0, few)) if few else own.nodes).contiguous(memory_format=_form())

    return once(flow, wide), flow.lattice.stride


def _form() -> torch.memory_format:
    """How kernels have nodes."""
    together = compiled.kernels("warping.kernels.following_pixels").TOGETHER
    return torch.channels_last if together else torch.contiguous_format


def _far(flow: Read) -> float:
    """Where a sum with it lies within, in the sampler's coordinates."""
    return FARTHEST if isinstance(flow, LatticeFlow) else FAR


def _at(values: Tensor, grid: Tensor) -> Tensor:
    """(B, 2, n, m), px: what is read along a grid of a flow at every pixel."""
    return by_grid_sample(values, grid, padding="border", interpolation="bilinear")


def _moved(grid: Tensor, by: Tensor, *, size: Size, far: float) -> Tensor:
    """The grid, moved by so many px, (B, 2, n, m)."""
    height, width = size
    both = torch.addcmul(
        grid, by.movedim(1, -1), as_device_tensor((2 / width, 2 / height), dtype=grid.dtype, device=grid.device)
    )
    return both if far == FARTHEST else finite(both, far)
