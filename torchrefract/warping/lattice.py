"""Smooth fields on a coarse lattice, and what lies between its nodes."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract.warping.grid import finite, sampler_positions

# Of the cubic through four nodes a unit apart, between the inner two: |f - p| <= 9/384 max |f''''|, and the largest sum
# of the magnitudes of its weights.
CUBIC_ERROR = 9 / 384
CUBIC_GAIN = 1.25
# In the sampler's coordinates: farther than a flow can lead that is computed on a lattice, and finite in all products.
_FARTHEST = 1e4


class Lattice(NamedTuple):
    """Nodes every `stride` px over a frame, one more before it and at least one more behind it along each axis."""

    height: int  # px, of the frame
    width: int
    stride: int  # px

    @property
    def cells(self) -> tuple[int, int]:
        """How many strides it takes to cover the rows and the columns."""
        return -(-self.height // self.stride), -(-self.width // self.stride)

    def axes(self, *, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
        """x, (1, 1, 1, m), and y, (1, 1, n, 1), px, of the nodes."""
        rows, columns = (
            self.stride * (torch.arange(count + 3, dtype=dtype, device=device) - 1) for count in self.cells
        )
        return columns.view(1, 1, 1, -1), rows.view(1, 1, -1, 1)


class SmoothFlow(NamedTuple):
    """A flow that is known at the nodes of a lattice, and by `between_nodes` everywhere."""

    nodes: Tensor  # (B, 2, n, m), px
    lattice: Lattice

    def dense(self) -> Tensor:
        """(B, 2, H, W), px."""
        return between_nodes(self.nodes, self.lattice)

    def sampler_grid(self, dtype: torch.dtype) -> Tensor:
        """(B, H, W, 2): where F.grid_sample(align_corners=False) looks; no flow of that size is written."""
        x, y = self.lattice.axes(dtype=dtype, device=self.nodes.device)
        size = {"height": self.lattice.height, "width": self.lattice.width}
        # The identity is linear, so it may go through the cubics with the flow.
        positions = finite(sampler_positions(self.nodes.to(dtype), x, y, **size), _FARTHEST)
        return between_nodes(positions, self.lattice).movedim(1, -1)


def between_nodes(nodes: Tensor, lattice: Lattice) -> Tensor:
    """The field (B, C, H, W) at every pixel, by cubics through four nodes along one axis and then the other.

        f(s (i + t)) = sum_j w_j(t) f_(i + j),  j = -1 ... 2,  w_j the cubic that is 1 at j and 0 at the other three

    Cubics, and so every linear function, come out as they are. Elsewhere, with the derivatives along each axis, in px,

        |error| <= 9/384 s^4 (max |f_xxxx| + 5/4 max |f_yyyy|)

    Args:
        nodes: (B, C, n, m), the field at the nodes of the lattice.
        lattice: where they are.

    Source: the remainder of Lagrange's interpolation; de Boor, "A practical guide to splines" (1978), chapter 2.
    """
    batch, channels, rows, _ = nodes.shape
    weight = cubic_weights(lattice.stride, dtype=nodes.dtype, device=nodes.device)
    lines = (nodes.unfold(3, 4, 1) @ weight.mT).reshape(batch, channels, rows, -1)[..., : lattice.width]
    bands = weight @ lines.unfold(2, 4, 1).mT
    return bands.reshape(batch, channels, -1, lattice.width)[:, :, : lattice.height]


def cubic_weights(stride: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(stride, 4): the weights of the nodes at -1, 0, 1, 2 for the pixels at 0, 1 / stride, 2 / stride ..."""
    t = torch.arange(stride, dtype=torch.float64, device=device) / stride
    before, here, next_, after = t + 1, t, t - 1, t - 2
    weights = (
        -here * next_ * after / 6,
        before * next_ * after / 2,
        -before * here * after / 2,
        before * here * next_ / 6,
    )
    return torch.stack(weights, dim=1).to(dtype)
