"""Flows of one batch in several forms."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from torchrefract._tensor import scatter_batch
from torchrefract.warping.followed import FollowedFlow
from torchrefract.warping.grid import sampler_grid
from torchrefract.warping.lattice import LatticeFlow, once

PartFlow = Tensor | LatticeFlow | FollowedFlow
Part = tuple[Tensor, PartFlow]


@dataclass(frozen=True)
class MixedFlow:
    """Flows of a batch, of which some rows are known at every pixel and others on lattices, each as it is alone.

    parts: for each form, (n,), the rows of the batch, and their flow, (n, 2, H, W), px, or on a lattice.
    """

    parts: tuple[Part, ...]

    @property
    def dtype(self) -> torch.dtype:
        """Of all parts."""
        return self.parts[0][1].dtype

    @property
    def requires_grad(self) -> bool:
        """Whether a part has a gradient."""
        return any(flow.requires_grad for _, flow in self.parts)

    def detach(self) -> "MixedFlow":
        """The same flows without their gradient."""
        return MixedFlow(tuple((index, flow.detach()) for index, flow in self.parts))

    def rows(self, index: Tensor) -> "MixedFlow":
        """Some rows of the batch."""
        parts = list[Part]()
        for own, flow in self.parts:
            here, places = (index[:, None] == own).nonzero().unbind(1)
            if len(here):
                parts.append((here, cast(PartFlow, flow_rows(flow, places))))
        return MixedFlow(tuple(parts))

    def dense(self) -> Tensor:
        """(B, 2, H, W), px."""
        return self._each(dense)

    def sampler_grid(self, dtype: torch.dtype) -> Tensor:
        """(B, H, W, 2): where F.grid_sample(align_corners=False) looks."""
        # Planes of x and of y, as the parts have them.
        return self._each(lambda flow: grid_of(flow, dtype).movedim(-1, 1)).movedim(1, -1)

    def _each(self, work: Callable[[PartFlow], Tensor]) -> Tensor:
        if len(self.parts) == 1:  # of all rows, in their order
            return work(self.parts[0][1])
        return scatter_batch([(index, work(flow)) for index, flow in self.parts])


# A flow (B, 2, H, W), px, or in another form.
Flow = Tensor | LatticeFlow | FollowedFlow | MixedFlow


def dense(flow: Flow) -> Tensor:
    """(B, 2, H, W), px, of a flow in any form."""
    if isinstance(flow, LatticeFlow):
        return once(flow, lambda own: own.dense())
    return flow if isinstance(flow, Tensor) else flow.dense()


def grid_of(flow: Flow, dtype: torch.dtype) -> Tensor:
    """(B, H, W, 2): where F.grid_sample(align_corners=False) looks along a flow in any form, finite."""
    if isinstance(flow, LatticeFlow):
        return once(flow, lambda own: own.sampler_grid(dtype))
    if not isinstance(flow, Tensor):
        return flow.sampler_grid(dtype)
    if len(flow) < 2 or flow.stride(0) != 0:
        return sampler_grid(flow.to(dtype))
    return sampler_grid(flow[:1].to(dtype)).expand(len(flow), -1, -1, -1)


def flow_rows(flow: Flow, index: Tensor) -> Flow:
    """Some rows of a flow."""
    return flow[index] if isinstance(flow, Tensor) else flow.rows(index)


def known(flow: Flow) -> Tensor:
    """What a flow is computed from, or part of that."""
    if isinstance(flow, MixedFlow):
        return known(flow.parts[0][1])
    return flow if isinstance(flow, Tensor) else flow.nodes
