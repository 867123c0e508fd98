"""One flow for two warps."""

import torch
from torch import Tensor

from torchrefract._validation import check_flow
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.warp import sample_image


def compose_flows(first: Tensor, then: Tensor) -> Tensor:
    """The flow of two warps in a row, so that one look-up does the work of both.

        flow(p) = then(p) + first(p + then(p)),  warp(image, flow) = warp(warp(image, first), then)

    `first` is read bilinearly, and outside the frame as at its border.

    Args:
        first: (B, 2, H, W), px, the flow of the warp that is applied first.
        then: (B, 2, H, W), px, the flow of the warp that is applied to its result.

    Returns:
        (B, 2, H, W), px, float32, or float64 where one of them is.

    Raises:
        ValueError: flows of different shapes, or none of (B, 2, H, W).
    """
    check_flow("first", first)
    check_flow("then", then)
    if first.shape != then.shape:
        raise ValueError(f"then must have the shape of first, {tuple(first.shape)}, got {tuple(then.shape)}")
    dtype = field_dtype(torch.promote_types(first.dtype, then.dtype))
    first, then = first.to(dtype), then.to(dtype)
    return then + sample_image(first, then, padding="border", interpolation="bilinear")
