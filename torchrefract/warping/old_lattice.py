"""Functions of lattices that the old effects use."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, assume_constant_result, cached
from torchrefract.warping.sums import across, down, matrix_of

# Slopes of cubics are not smooth enough from cell to cell.
STREAM_NODES = 6
# In the sampler's coordinates: farther than a flow leads that is computed on a lattice, and finite in all products.
FARTHEST = 1e4


def between_nodes(nodes: Tensor, lattice: Any) -> Tensor:
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


def along_rows(nodes: Tensor, lattice: Any) -> Tensor:
    """(B, C, n, W), the field of `between_nodes` in the rows of nodes, at every column of pixels."""
    return across(nodes, _cubics(nodes, lattice), lattice.width)


def row_weights(like: Tensor, lattice: Any) -> Tensor:
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


def once(flow: Any, work: Callable[[Any], Tensor]) -> Tensor:
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


def _cubics(like: Tensor, lattice: Any) -> Tensor:
    """(stride, 4), in the type of a tensor."""
    return lagrange_weights(lattice.stride, 4, dtype=like.dtype, device=like.device)
