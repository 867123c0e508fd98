"""Flows at the nodes of a coarse lattice, with cubics between the nodes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefract._tensor import in_bands, rows_at_once
from torchrefract._validation import eager_values
from torchrefract.ops.sampling import interpolate_nodes, lagrange_basis
from torchrefract.warping.grid import Points

_CACHED_POINTS = 1 << 15  # where a flow is interpolated at once
_MARGIN = 8  # nodes around points, of which there are multiples


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
        more = 1 + 2 * self.margin
        return math.ceil(self.height / self.stride) + more, math.ceil(self.width / self.stride) + more

    def points(self, *, dtype: torch.dtype, device: torch.device) -> Points:
        """Return the positions of the nodes, px."""
        rows, columns = self.num_nodes
        index = torch.arange(max(rows, columns), dtype=dtype, device=device)
        position = (index - self.margin) * self.stride
        return Points(position[:columns].view(1, 1, 1, -1), position[:rows].view(1, 1, -1, 1), self)


def pixel_lattice(height: int, width: int) -> Lattice:
    """Return the lattice whose nodes are the pixels of a frame."""
    return Lattice(height, width, stride=1, margin=0)


def lattice_with_stride(height: int, width: int, stride: int, *, margin: int = 1) -> Lattice:
    """Return the lattice of the pixels for strides of 0 and 1, otherwise one with a margin."""
    return Lattice(height, width, stride, margin) if stride > 1 else pixel_lattice(height, width)


@dataclass(frozen=True)
class LatticeFlow:
    """Hold a flow at the nodes of a lattice; cubic polynomials through four nodes along each axis interpolate it.

    nodes: (N, 2, h, w), px.
    """

    nodes: Tensor
    lattice: Lattice

    def detach(self) -> "LatticeFlow":
        """Return the flow without its gradient."""
        return LatticeFlow(self.nodes.detach(), self.lattice)

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

        There must be four nodes along each axis. The result is differentiable in the nodes and the points.

        Args:
            points: of shape (N or 1, 1, h, w), px.

        Returns:
            (N, 2, h, w), px.
        """
        lattice = self.lattice
        if points.lattice == lattice and not points.is_displaced:
            return self.nodes
        rows, columns = self.nodes.shape[2:]
        x, y = _in_strides(points.x, lattice, columns), _in_strides(points.y, lattice, rows)
        count, each = torch.broadcast_shapes(x.shape, y.shape)[2:]

        def at_rows(start: int, stop: int) -> Tensor:
            return _cubic(self.nodes, x if x.shape[2] == 1 else x[:, :, start:stop], y[:, :, start:stop])

        band = rows_at_once(x.device, count, each=each, cached=_CACHED_POINTS)
        return in_bands(at_rows, length=count, band=band, dim=2)


def within_reach(points: Points) -> Points:
    """Move points that lie farther outside the frame than its longer side to that distance."""
    height, width = points.lattice.height, points.lattice.width
    reach = max(height, width)
    return points._replace(x=points.x.clamp(-reach, width + reach), y=points.y.clamp(-reach, height + reach))


def lattice_around(points: Points, stride: int) -> Lattice:
    """Return a lattice with nodes around all points that `within_reach` returns.

    If their positions cannot be read, the nodes reach a quarter of the longer side.
    """
    height, width = points.lattice.height, points.lattice.width
    longest = max(height, width)
    ends = eager_values(lambda: torch.stack([*points.x.aminmax(), *points.y.aminmax()]), of=points.x)
    left, right, top, bottom = ends or (0.0, width + longest / 4, 0.0, 0.0)
    outside = max(-left, right - width, -top, bottom - height, 0.0)
    reach = outside if outside < longest else longest  # also if it is NaN
    # The severities of a scene, whose reach differs by a few pixels, share their fields.
    return Lattice(height, width, stride, margin=_MARGIN * math.ceil((2 + reach / stride) / _MARGIN))


def _in_strides(position: Tensor, lattice: Lattice, count: int) -> Tensor:
    """Convert positions from px to indices of nodes, within [0, count - 1]."""
    return (position / lattice.stride + lattice.margin).nan_to_num(nan=0.0).clamp(0, count - 1)


def _cells(index: Tensor, count: int, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
    """Return the first of the four nodes around each fractional index, int64, and the weights of the four."""
    second = index.detach().clamp(1, count - 3).long()
    return second - 1, lagrange_basis((index - second).to(dtype))


def _cubic(nodes: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Interpolate nodes (N, 2, h, w) at fractional indices x and y, which broadcast to (N or 1, 1, n, m)."""
    batch, _, rows, columns = nodes.shape
    column, weights_x = _cells(x[:, 0], columns, nodes.dtype)
    row, weights_y = _cells(y[:, 0], rows, nodes.dtype)
    first = row * columns + column  # of the 4 x 4 nodes
    if batch > 1:
        first = first + rows * columns * torch.arange(batch, device=nodes.device).view(-1, 1, 1)
    index, components = first.flatten(), []
    # Each component by itself: PyTorch takes twice as long for the products of two components with one weight.
    for values in nodes.movedim(0, 1).flatten(1):
        component = torch.zeros((), dtype=nodes.dtype, device=nodes.device)
        for i, weight_y in enumerate(weights_y):
            line = torch.zeros((), dtype=nodes.dtype, device=nodes.device)
            for j, weight_x in enumerate(weights_x):
                node = values[i * columns + j :].index_select(0, index).view(first.shape)
                line = torch.addcmul(line, weight_x, node)
            component = torch.addcmul(component, weight_y, line)
        components.append(component)
    return torch.stack(components, dim=1)
