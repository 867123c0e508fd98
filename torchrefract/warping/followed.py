"""Warps in a row: what the earlier ones add where a later one looks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract._checks import learns
from torchrefract._constants import constant
from torchrefract._threads import share
from torchrefract.warping.grid import FAR, finite
from torchrefract.warping.grid_sample import by_grid_sample
from torchrefract.warping.lattice import FARTHEST, SmoothFlow, once


@dataclass(frozen=True)
class Reading:
    """A flow as others read it: known every few px, bilinear between, outside of the frame as at its border."""

    values: Tensor  # (B, 2, n, m), px, at so many px from one another, from the first row and column on
    every: int  # px
    size: tuple[int, int]  # px, height and width of the frame
    far: float  # where sums lie within, in the sampler's coordinates

    @classmethod
    def of(cls, flow: Tensor | SmoothFlow) -> "Reading":
        """That of a flow (B, 2, H, W), px; one that is not on a lattice is known at every pixel."""
        if isinstance(flow, Tensor):
            flow = flow if flow[:1].is_contiguous() else flow.contiguous()
            return cls(flow, 1, (flow.shape[2], flow.shape[3]), FAR)
        return cls(once(flow, lambda own: own.read()), flow.every, flow.lattice[:2], FARTHEST)

    def to(self, dtype: torch.dtype) -> "Reading":
        """The same in a type."""
        return replace(self, values=self.values.to(dtype))

    def addresses(self) -> list[int]:
        """Where the values of each row begin."""
        values = self.values
        if not values[:1].is_contiguous():
            raise ValueError(f"values must have the planes of a row one after the other, got strides {values.stride()}")
        apart = values.stride(0) * values.element_size()
        return [values.data_ptr() + i * apart for i in range(len(values))]

    def followed(self, grid: Tensor) -> Tensor:
        """(B, n, m, 2): the grid, where F.grid_sample(align_corners=False) looks, moved by the flow that is there."""
        own = self.to(grid.dtype)
        if len(own.values) != len(grid):  # F.grid_sample raises, too; a kernel would read what is not there
            raise ValueError(f"grid must have a row for each of {len(own.values)} flows, got {len(grid)}")
        large = grid.shape[1] * grid.shape[2] >= compiled.SMALLEST and not learns((own.values, grid))
        return (
            own._filled(grid)
            if large and compiled.obstacle(own.values, grid) is None
            else own.moved(grid, own.at(grid))
        )

    def _filled(self, grid: Tensor) -> Tensor:
        """The same by a kernel."""
        before = grid.movedim(-1, 1).contiguous()
        out = torch.empty_like(before)
        kernel, into = compiled.kernels("warping.kernels.look_up").follow, out.numpy()
        work = partial(kernel, before.numpy(), *of_readings((self,), self.size))
        lines, columns = grid.shape[1:3]
        share(lambda start, stop: work(start, stop, into), len(grid) * lines, least=compiled.SMALLEST // columns + 1)
        return out.movedim(1, -1)

    def at(self, grid: Tensor) -> Tensor:
        """(B, 2, n, m), px: what is read along a grid."""
        return by_grid_sample(self.values, self._places(grid), padding="border", interpolation="bilinear")

    def moved(self, grid: Tensor, by: Tensor) -> Tensor:
        """The grid, moved by so many px, (B, 2, n, m)."""
        height, width = self.size
        scale = constant((2 / width, 2 / height), dtype=grid.dtype, device=grid.device)
        both = torch.addcmul(grid, by.movedim(1, -1), scale)
        return both if self.far == FARTHEST else finite(both, self.far)

    def _places(self, grid: Tensor) -> Tensor:
        """The grid in the coordinates of the values."""
        if self.every == 1:
            return grid
        along = zip(grid.unbind(-1), self.size[::-1], self.values.shape[:1:-1], strict=True)
        places = (
            (2 / self.every * ((at + 1) * (size / 2) - 0.5).clamp(0, size - 1) + 1) / count - 1
            for at, size, count in along
        )
        return torch.stack(list(places), dim=-1)


@dataclass(frozen=True)
class FollowedFlow:
    """A smooth flow, and the flows of warps before it that are read where it looks, one after the other."""

    last: SmoothFlow
    earlier: tuple[Reading, ...]  # of the same batch; the later ones first

    @property
    def dtype(self) -> torch.dtype:
        """Of the positions."""
        return self.last.dtype

    @property
    def requires_grad(self) -> bool:
        """Whether one of the flows has a gradient."""
        return self.last.requires_grad or any(own.values.requires_grad for own in self.earlier)

    @property
    def nodes(self) -> Tensor:
        """What the last flow is known by."""
        return self.last.nodes

    def detach(self) -> "FollowedFlow":
        """The same without gradients."""
        earlier = (replace(own, values=own.values.detach()) for own in self.earlier)
        return FollowedFlow(self.last.detach(), tuple(earlier))

    def rows(self, index: Tensor) -> "FollowedFlow":
        """Some rows of the batch."""
        earlier = (replace(own, values=own.values[index]) for own in self.earlier)
        return FollowedFlow(self.last.rows(index), tuple(earlier))

    def dense(self) -> Tensor:
        """(B, 2, H, W), px: the last flow, and what is read of the others where they are read for a look-up."""
        grid, total = self.last.sampler_grid(self.dtype), self.last.dense()
        for own in self.earlier:
            read = own.at(grid)
            grid, total = own.moved(grid, read), total + read
        return total

    def sampler_grid(self, dtype: torch.dtype) -> Tensor:
        """(B, H, W, 2): where F.grid_sample(align_corners=False) looks."""
        grid = self.last.sampler_grid(dtype)
        for own in self.earlier:
            grid = own.followed(grid)
        return grid


def of_readings(readings: Sequence[Reading], size: tuple[int, int]) -> tuple[Any, ...]:
    """Where the flows of each row lie in memory, (B, k), and what else `follow_row` is told of them.

    Who calls keeps the readings for as long as they are read.
    """
    flows = np.array([own.addresses() for own in readings], np.uint64)
    table = np.array([(*own.values.shape[2:], own.every) for own in readings])
    far = np.array([own.far for own in readings], np.float32)
    return flows.T.copy(), table, far, size
