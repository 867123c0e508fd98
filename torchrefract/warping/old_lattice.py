"""Smooth flows on a coarse lattice, and what lies between its nodes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, assume_constant_result, cached
from torchrefract.warping.grid import finite, pixel_axes, sampler_axes, sampler_positions
from torchrefract.warping.sums import across, across_twice, down, matrix_of

# Slopes of cubics are not smooth enough from cell to cell.
STREAM_NODES = 6
# In the sampler's coordinates: farther than a flow leads that is computed on a lattice, and finite in all products.
FARTHEST = 1e4


class Lattice(NamedTuple):
    """Nodes every `stride` px over a frame, with those around it that its pixels take."""

    height: int  # px, of the frame
    width: int
    stride: int  # px
    before: int = 1  # nodes before the frame along each axis
    after: int = 1  # and behind the last cell

    def cells(self) -> tuple[int, int]:
        """How many strides it takes to cover the rows and the columns."""
        return -(-self.height // self.stride), -(-self.width // self.stride)

    def axes(self) -> tuple[range, range]:
        """Px, of the rows and of the columns of nodes."""
        start, s = -self.before * self.stride, self.stride
        rows, columns = (range(start, (count + self.after) * s + 1, s) for count in self.cells())
        return rows, columns

    def places(self, *, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
        """x, (1, 1, 1, m), and y, (1, 1, n, 1), px, of the nodes."""
        y, x = (torch.arange(axis.start, axis.stop, axis.step, dtype=dtype, device=device) for axis in self.axes())
        return x.view(1, 1, 1, -1), y.view(1, 1, -1, 1)


def between_nodes(nodes: Tensor, lattice: Lattice) -> Tensor:
    """The field (B, C, H, W) at every pixel, by cubics through four nodes along one axis and then the other.

        f(s (i + t)) = sum_j w_j(t) f_(i + j),  j = -1 ... 2,  w_j the cubic that is 1 at j and 0 at the other three

    Cubics, and so every linear function, come out as they are. Elsewhere, with the derivatives along each axis, in px,

        |error| <= 9/384 s^4 (max |f_xxxx| + 5/4 max |f_yyyy|)

    Args:
        nodes: (B, C, n, m), the field at the nodes of the lattice.
        lattice: where they are, one of them before the frame.

    Source: the remainder of Lagrange's interpolation; de Boor, "A practical guide to splines" (1978), chapter 2.
    """
    return down(along_rows(nodes, lattice), _cubics(nodes, lattice), lattice.height)


def along_rows(nodes: Tensor, lattice: Lattice) -> Tensor:
    """(B, C, n, W), the field of `between_nodes` in the rows of nodes, at every column of pixels."""
    return across(nodes, _cubics(nodes, lattice), lattice.width)


def row_weights(like: Tensor, lattice: Lattice) -> Tensor:
    """(H, n), of the rows of nodes for each row of pixels, in the type of a tensor."""
    return matrix_of(_cubics(like, lattice), len(lattice.axes()[0]), lattice.height)


def lagrange_weights(stride: int, count: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(stride, count): weights of `count` nodes, an even number, for the pixels at 0, 1 / stride, 2 / stride ...

    Of the polynomial through the nodes at 1 - count / 2 ... count / 2.
    """
    # From numbers, which an accelerator need not be waited for to have.
    return as_device_tensor(_lagrange(stride, count), dtype=dtype, device=device)


def slope_weights(stride: int, count: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(stride, count + 1): those of the nodes at -count / 2 ... count / 2 for (f(+1 px) - f(-1 px)) / 2 of the same."""
    weight = lagrange_weights(stride, count, dtype=torch.float64, device=device)
    own = F.pad(weight, (1, 0))
    # The pixel before belongs to the cell before, whose nodes are one farther to the left; the one behind to the next.
    last, first = F.pad(weight[-1:], (0, 1)), F.pad(weight[:1], (2, 0))[:, :-1]
    return ((torch.cat([own[1:], first]) - torch.cat([last, own[:-1]])) / 2).to(dtype)


class Lines(NamedTuple):
    """Where F.grid_sample(align_corners=False) looks, at every pixel of the rows of a lattice's nodes."""

    values: Tensor  # (B, 2, n, W)
    weight: Tensor  # (2, stride, taps), of x and of y: of the rows around a row of pixels, by its place in its cell
    height: int  # of the frame
    x: Tensor | None = None  # (W,), to be added to the x between the rows
    y: Tensor | None = None  # (H,), to be added to the y

    def grid(self) -> Tensor:
        """(B, H, W, 2): the same at every pixel."""
        found = down(self.values, self.weight, self.height)
        if self.x is not None and self.y is not None:
            found[:, :1] += self.x
            found[:, 1:] += self.y[:, None]
        return found.movedim(1, -1)


@dataclass(frozen=True)
class LatticeFlow:
    """A flow that is known at the nodes of a lattice, and by `between_nodes` everywhere."""

    nodes: Tensor  # (B, 2, n, m), px
    lattice: Lattice
    every: int = 1  # px, between nodes that a composite which ends with it may be known at

    @property
    def dtype(self) -> torch.dtype:
        """Of the nodes."""
        return self.nodes.dtype

    @property
    def requires_grad(self) -> bool:
        """Whether the nodes have a gradient."""
        return self.nodes.requires_grad

    def detach(self) -> "LatticeFlow":
        """The same flow without its gradient."""
        return self.with_nodes(self.nodes.detach())

    def with_nodes(self, nodes: Tensor) -> "LatticeFlow":
        """The same flow with other nodes."""
        return replace(self, nodes=nodes)

    def rows(self, index: Tensor) -> "LatticeFlow":
        """Some rows of the batch."""
        return self.with_nodes(self.nodes[index])

    def weights(self) -> tuple[Tensor, Tensor]:
        """Of the nodes around, along a row and along a column, (2, stride, taps): for u and v, by place in a cell."""
        weight = _cubics(self.nodes, self.lattice).expand(2, -1, -1)
        return weight, weight

    def dense(self) -> Tensor:
        """(B, 2, H, W), px."""
        return between_nodes(self.nodes, self.lattice)

    def sampler_grid(self, dtype: torch.dtype) -> Tensor:
        """(B, H, W, 2): where F.grid_sample(align_corners=False) looks; no flow of that size is written."""
        return self.lines(dtype).grid()

    def lines(self, dtype: torch.dtype) -> Lines:
        """Where it looks, at every pixel of the rows of nodes."""
        x, y = self.lattice.places(dtype=dtype, device=self.nodes.device)
        height, width = self.lattice.height, self.lattice.width
        # The identity is linear, so it may go through the cubics with the flow.
        positions = finite(sampler_positions(self.nodes.to(dtype), x, y, height=height, width=width), FARTHEST)
        values, weight = along_rows(positions, self.lattice), _cubics(positions, self.lattice)
        return Lines(values, weight.expand(2, -1, -1), height)


class StreamFlow(LatticeFlow):
    """The curl of a stream function that is known at the nodes of a lattice, (B, 1, n, m), px^2.

        flow = (D_y psi, -D_x psi) of psi between nodes, by polynomials through six of them along each axis

    The lattice has three nodes before the frame and two behind its last cell.

    D is the central difference, as in `curl`: the divergence taken with it vanishes, which that of a flow between nodes
    of its own does not.
    """

    def dense(self) -> Tensor:
        """(B, 2, H, W), px."""
        return down(*self._lines(self.nodes, (1.0, 1.0)), self.lattice.height)

    def lines(self, dtype: torch.dtype) -> Lines:
        """Where F.grid_sample(align_corners=False) looks, at every pixel of the rows of nodes."""
        height, width = self.lattice.height, self.lattice.width
        x, y = pixel_axes(height, width, dtype=dtype, device=self.nodes.device)
        x, y = sampler_axes(x, y, height=height, width=width)
        nodes = finite(self.nodes.to(dtype), FARTHEST)
        return Lines(*self._lines(nodes, (2 / width, 2 / height)), height, x.flatten(), y.flatten())

    def weights(self) -> tuple[Tensor, Tensor]:
        """Of the nodes around, along a row and along a column, (2, stride, taps): for u and v, by place in a cell."""
        return _curl_weights(self.lattice.stride, (1.0, 1.0), self.nodes.dtype, self.nodes.device)

    def _lines(self, nodes: Tensor, scale: tuple[float, float]) -> tuple[Tensor, Tensor]:
        """(B, 2, n, W) and (2, stride, taps): (D_y psi, -D_x psi), each times its scale, as in `Lines`."""
        (first, second), between = _curl_weights(self.lattice.stride, scale, nodes.dtype, nodes.device)
        return across_twice(nodes, (first, second), self.lattice.width), between


def once(flow: LatticeFlow, work: Callable[[LatticeFlow], Tensor]) -> Tensor:
    """What is made of a flow, (B, ...), once where all its rows are one, as for the frames of a clip."""
    nodes = flow.nodes
    if len(nodes) < 2 or nodes.stride(0) != 0:
        return work(flow)
    return work(flow.with_nodes(nodes[:1])).expand(len(nodes), -1, -1, -1)


@cached
def _curl_weights(
    stride: int, scale: tuple[float, float], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Those of a `StreamFlow`, along a row times a scale of u and one of v."""
    slope = slope_weights(stride, STREAM_NODES, dtype=dtype, device=device)
    weight = F.pad(lagrange_weights(stride, STREAM_NODES, dtype=dtype, device=device), (1, 0))
    return torch.stack([scale[0] * weight, -scale[1] * slope]), torch.stack([slope, weight])


@assume_constant_result
def _lagrange(stride: int, count: int) -> list[list[float]]:
    return _computed_lagrange(stride, count)  # of its own: compilers look through a cache, and warn of it


@lru_cache(maxsize=64)
def _computed_lagrange(stride: int, count: int) -> list[list[float]]:
    nodes = torch.arange(1 - count // 2, count // 2 + 1, dtype=torch.float64)
    t = torch.arange(stride, dtype=torch.float64)[:, None] / stride
    others = torch.stack([nodes[nodes != node] for node in nodes])
    return ((t[..., None] - others) / (nodes[:, None] - others)).prod(dim=2).tolist()


def _cubics(like: Tensor, lattice: Lattice) -> Tensor:
    """(stride, 4), in the type of a tensor."""
    return lagrange_weights(lattice.stride, 4, dtype=like.dtype, device=like.device)
