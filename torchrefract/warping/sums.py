"""Sums of the nodes around: along rows of a lattice, and between these, by weights for each place in a cell."""

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels, obstacle, with_gradients
from torchrefract._tensor import by_samples, exact_matmul
from torchrefract._threads import share

# Up to so many nodes along an axis one product with all of them is faster than one for each cell.
_FEW_ROWS, _FEW_COLUMNS = 24, 64
_SMALLEST_LINES = 1 << 10  # pixels of a sample's rows of nodes, from which on a kernel is faster


def across(nodes: Tensor, weight: Tensor, width: int) -> Tensor:
    """(B, C, n, W) of (B, C, n, m), by weights (stride, taps)."""

    def plain(nodes: Tensor) -> Tensor:
        return by_samples(nodes, lambda own: _multiplied_across(own, weight, width))

    if nodes.shape[2] * width < _SMALLEST_LINES or obstacle(nodes, weight):
        return plain(nodes)
    return with_gradients(lambda nodes: _filled_across(nodes, weight, width), plain, nodes)


def across_twice(nodes: Tensor, weights: tuple[Tensor, Tensor], width: int) -> Tensor:
    """(B, 2, n, W) of (B, 1, n, m): what `across` makes of it by one of the weights and by the other."""

    def plain(nodes: Tensor) -> Tensor:
        return torch.cat([across(nodes, weight, width) for weight in weights], dim=1)

    if nodes.shape[2] * width < _SMALLEST_LINES or obstacle(nodes, *weights):
        return plain(nodes)
    return with_gradients(lambda nodes: _filled_twice(nodes, weights, width), plain, nodes)


def down(lines: Tensor, weight: Tensor, height: int) -> Tensor:
    """(B, C, H, W) of (B, C, n, W), by weights (stride, taps), or (C, stride, taps)."""

    def plain(lines: Tensor) -> Tensor:
        return by_samples(lines, lambda own: _multiplied_down(own, weight, height))

    if height * lines.shape[3] < SMALLEST or obstacle(lines, weight):
        return plain(lines)
    return with_gradients(lambda lines: _filled_down(lines, weight, height), plain, lines)


def _filled_across(nodes: Tensor, weight: Tensor, width: int) -> Tensor:
    """`across` by a kernel."""
    rows = nodes.shape[:3].numel()
    out = nodes.new_empty(*nodes.shape[:3], width)
    values = nodes.contiguous().view(rows, -1).numpy(), weight.mT.contiguous().numpy()
    work, into = partial(kernels("warping.kernels.lines").across, *values), out.view(rows, width).numpy()
    share(lambda start, stop: work(start, stop, into), rows, least=SMALLEST // width + 1)
    return out


def _filled_twice(nodes: Tensor, weights: tuple[Tensor, Tensor], width: int) -> Tensor:
    """`across_twice` by a kernel."""
    batch, _, rows, _ = nodes.shape
    out = nodes.new_empty(batch, 2, rows, width)
    values = nodes.contiguous().view(batch * rows, -1).numpy(), *(own.mT.contiguous().numpy() for own in weights)
    work, into = partial(kernels("warping.kernels.lines").across_twice, *values), out.numpy()
    share(lambda start, stop: work(start, stop, into), batch * rows, least=SMALLEST // width + 1)
    return out


def _filled_down(lines: Tensor, weight: Tensor, height: int) -> Tensor:
    """`down` by a kernel."""
    batch, channels, _, width = lines.shape
    out = lines.new_empty(batch, channels, height, width)
    values = lines.contiguous().numpy(), weight.expand(channels, -1, -1).contiguous().numpy()
    work = partial(kernels("warping.kernels.lines").down, *values)
    share(lambda start, stop: work(start, stop, out.numpy()), batch * channels * height, least=SMALLEST // width + 1)
    return out


def _multiplied_across(nodes: Tensor, weight: Tensor, width: int) -> Tensor:
    """`across` by products of matrices."""
    if nodes.shape[3] <= _FEW_COLUMNS:
        return exact_matmul(nodes, matrix_of(weight, nodes.shape[3], width).mT)
    cells = exact_matmul(nodes.unfold(3, weight.shape[-1], 1), weight.mT)
    return cells.flatten(3)[..., :width]


def _multiplied_down(lines: Tensor, weight: Tensor, height: int) -> Tensor:
    """`down` by products of matrices."""
    if lines.shape[2] <= _FEW_ROWS:
        return exact_matmul(matrix_of(weight, lines.shape[2], height), lines)
    bands = exact_matmul(weight.unsqueeze(-3), lines.unfold(2, weight.shape[-1], 1).mT)
    return bands.flatten(2, 3)[:, :, :height]


def matrix_of(weight: Tensor, nodes: int, length: int) -> Tensor:
    """(..., length, nodes): the weights (..., stride, taps) of each pixel's own nodes, among all of them."""
    *lead, stride, taps = weight.shape
    cells = nodes - taps + 1
    # One cell's rows again and again, each time one longer than there are nodes: so they move on by one.
    rows = F.pad(weight, (0, cells)).repeat(*[1] * len(lead), 1, cells)
    own = rows[..., : cells * nodes].reshape(*lead, stride, cells, nodes)
    return own.transpose(-3, -2).reshape(*lead, cells * stride, nodes)[..., :length, :]
