"""Interpolate values between the nodes of a lattice by cubic Lagrange polynomials."""

import torch
from torch import Tensor

from torchrefract._tensor import (
    as_device_tensor,
    assume_constant_result,
    cached_constant,
    exact_matmul,
    without_autocast,
)


def lagrange_weights(stride: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights of the four nodes around the pixels of a cell.

        w_j(t) = prod_(k != j) (t - k) / (j - k),  j, k = -1 ... 2,  t = 0, 1/stride, 2/stride ...

    Args:
        stride: px, between nodes.
        dtype, device: of the result.

    Returns:
        (stride, 4).
    """
    return as_device_tensor(_constant_weights(stride), dtype=dtype, device=device)


def lagrange_basis(t: Tensor) -> list[Tensor]:
    """Evaluate each of the four weights of `lagrange_weights` at any t, in its shape."""
    below, above, far = t + 1, t - 1, t - 2
    outer, inner = t * below, above * far
    return [t * inner / -6, below * inner / 2, outer * far / -2, outer * above / 6]


def interpolate_nodes(nodes: Tensor, *, stride: int, margin: int, height: int, width: int) -> Tensor:
    """Interpolate a lattice of nodes at every pixel, along rows and then along columns.

    Cubics, and so linear functions, are exact. Elsewhere, with the derivatives along each axis,

        |error| <= 9/384 stride^4 (max |f_xxxx| + 5/4 max |f_yyyy|)

    Args:
        nodes: (N, C, h, w), one every `stride` px.
        stride: px, between nodes.
        margin: nodes before the first pixel, at least 1, or 0 with stride 1.
        height, width: px, of the frame.

    Returns:
        (N, C, H, W).

    Source: the remainder of Lagrange's interpolation; de Boor, "A practical guide to splines" (1978), chapter 2.
    """
    if stride == 1:
        return nodes[..., margin : margin + height, margin : margin + width]
    rows, columns = -(-height // stride) + 3, -(-width // stride) + 3
    nodes = nodes[..., margin - 1 : margin - 1 + rows, margin - 1 : margin - 1 + columns]
    weights = lagrange_weights(stride, dtype=nodes.dtype, device=nodes.device)
    with without_autocast(nodes.device):  # half types would round positions to several px
        lines = exact_matmul(nodes.unfold(3, 4, 1), weights.mT).flatten(3)[..., :width]
        # One product a cell: with a matrix on the left, matmul would copy the lines to fold them into one matrix.
        return exact_matmul(weights[None], lines.unfold(2, 4, 1).mT).flatten(2, 3)[:, :, :height]


@assume_constant_result
def _constant_weights(stride: int) -> list[list[float]]:
    return _cached_weights(stride)  # called indirectly, since torch.compile warns of caches that it traces


@cached_constant(maxsize=64)
def _cached_weights(stride: int) -> list[list[float]]:
    t = torch.arange(stride, dtype=torch.float64, device="cpu") / stride
    return torch.stack(lagrange_basis(t), dim=1).tolist()
