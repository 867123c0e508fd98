"""Flows at the nodes of a coarse lattice, with cubics between the nodes."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefract._validation import eager_values
from torchrefract.ops.cubic import interpolate_nodes, lagrange_basis
from torchrefract.ops.sampling import grid_sample
from torchrefract.warping.grid import Points


@dataclass(frozen=True)
class Lattice:
    """Describe nodes every `stride` px over a frame, with `margin` more of them before it and beyond it.

    Node (i, j) lies at x = (j - margin) stride, y = (i - margin) stride. There are as many nodes as a cubic through
    four of them needs at the last pixel, and margin - 1 more. Stride 1 and margin 0 is the grid of the pixels.

    height, width: px, of the frame.
    stride: px, between nodes.
    margin: nodes before the first pixel, at least 1, or 0 with stride 1.
    """

    height: int
    width: int
    stride: int = 1
    margin: int = 1

    @property
    def num_nodes(self) -> tuple[int, int]:
        """Return the numbers of rows and of columns of nodes."""
        if self.margin == 0:
            return self.height, self.width
        rows, columns = (-(-size // self.stride) + 1 + 2 * self.margin for size in (self.height, self.width))
        return rows, columns

    def points(self, *, dtype: torch.dtype, device: torch.device) -> Points:
        """Return the positions of the nodes, px."""
        y, x = (
            (torch.arange(count, dtype=dtype, device=device) - self.margin) * self.stride for count in self.num_nodes
        )
        return Points(x.view(1, 1, 1, -1), y.view(1, 1, -1, 1), self)


def pixel_lattice(height: int, width: int) -> Lattice:
    """Return the lattice whose nodes are the pixels of a frame."""
    return Lattice(height, width, stride=1, margin=0)


@dataclass(frozen=True)
class LatticeFlow:
    """Hold a flow at the nodes of a lattice; cubic polynomials through four nodes along each axis interpolate it.

    nodes: (N, 2, h, w), px.
    """

    nodes: Tensor
    lattice: Lattice

    @property
    def dtype(self) -> torch.dtype:
        """Return the type of the nodes."""
        return self.nodes.dtype

    @property
    def requires_grad(self) -> bool:
        """Return True if the nodes require a gradient."""
        return self.nodes.requires_grad

    def detach(self) -> "LatticeFlow":
        """Return the flow without its gradient."""
        return self.with_nodes(self.nodes.detach())

    def with_nodes(self, nodes: Tensor) -> "LatticeFlow":
        """Return a flow with other nodes on the same lattice."""
        return replace(self, nodes=nodes)

    def dense(self) -> Tensor:
        """Return the flow at every pixel, (N, 2, H, W), px."""
        lattice, nodes = self.lattice, self.nodes
        is_shared = len(nodes) > 1 and nodes.stride(0) == 0  # one flow for the frames of a clip
        flow = interpolate_nodes(
            nodes[:1] if is_shared else nodes,
            stride=lattice.stride,
            margin=lattice.margin,
            height=lattice.height,
            width=lattice.width,
        )
        return flow.contiguous().expand(len(nodes), -1, -1, -1)

    def at(self, points: Points) -> Tensor:
        """Interpolate the flow at points, which may lie anywhere; positions beyond the nodes are clamped.

        Points of a lattice get the cubic polynomials. Displaced points get bilinear interpolation between the cubic
        values at the nodes of the lattice that they were displaced from, s px apart, with an error of up to
        s^2 / 8 (|f_xx| + |f_yy|). The result is differentiable with respect to the nodes and the points.

        Args:
            points: of shape (N or 1, 1, h, w), px.

        Returns:
            (N, 2, h, w), px.
        """
        lattice = self.lattice
        if points.is_displaced:
            step = min(points.lattice.stride, lattice.stride)
            if step < lattice.stride:
                margin = lattice.margin * lattice.stride // step
                finer = Lattice(lattice.height, lattice.width, step, margin)
                finer_points = finer.points(dtype=self.dtype, device=self.nodes.device)
                return LatticeFlow(self.at(finer_points), finer).at(points)
            rows, columns = self.nodes.shape[2:]
            x, y = _in_strides(points.x, lattice, columns), _in_strides(points.y, lattice, rows)
            return _bilinear(self.nodes, x, y)
        if points.lattice == lattice:
            return self.nodes
        if points.lattice == pixel_lattice(lattice.height, lattice.width):
            return self.dense()
        rows, columns = self.nodes.shape[2:]
        x, y = _in_strides(points.x, lattice, columns), _in_strides(points.y, lattice, rows)
        # Columns first: there are fewer rows of nodes than of points, and copies of whole rows are faster.
        return _cubic(_cubic(self.nodes, x.flatten(), dim=3), y.flatten(), dim=2)


def lattice_around(points: Points, stride: int) -> Lattice | None:
    """Return a lattice with nodes around all points.

    None if their positions cannot be read, or if one lies farther outside the frame than the frame is long.
    """
    height, width = points.lattice.height, points.lattice.width
    ends = eager_values(lambda: torch.stack([*points.x.aminmax(), *points.y.aminmax()]), of=points.x)
    if ends is None:
        return None
    left, right, top, bottom = ends
    outside = max(-left, right - width, -top, bottom - height, 0.0)
    if not outside < max(height, width):  # nor is NaN
        return None
    return Lattice(height, width, stride, margin=2 + math.ceil(outside / stride))


def _in_strides(position: Tensor, lattice: Lattice, count: int) -> Tensor:
    """Convert positions from px to indices of nodes, within [0, count - 1]."""
    return (position / lattice.stride + lattice.margin).nan_to_num(nan=0.0).clamp(0, count - 1)


def _cell(index: Tensor, count: int) -> Tensor:
    """Return the second of the four nodes around each fractional index, int64."""
    return index.detach().floor().clamp(1, count - 3).long()


def _cubic(nodes: Tensor, index: Tensor, *, dim: int) -> Tensor:
    """Interpolate nodes along a dimension at fractional indices (n,)."""
    cell = _cell(index, nodes.shape[dim])
    weights = lagrange_basis(index - cell).to(nodes.dtype)
    shape = [1] * nodes.ndim
    shape[dim] = -1
    parts = [nodes.index_select(dim, cell + (j - 1)) * weights[:, j].view(shape) for j in range(4)]
    return parts[0] + parts[1] + parts[2] + parts[3]


def _bilinear(nodes: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Interpolate nodes (N, 2, h, w) at fractional indices, each (N or 1, 1, n, m)."""
    rows, columns = nodes.shape[2:]
    x, y = torch.broadcast_tensors((2 * x + 1) / columns - 1, (2 * y + 1) / rows - 1)
    grid = torch.cat([x, y], dim=1).movedim(1, -1)
    batch = max(len(nodes), len(grid))
    return grid_sample(nodes.expand(batch, -1, -1, -1), grid, padding="border", interpolation="bilinear")
