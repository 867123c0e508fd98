"""Numbers in [0, 1] and levels of 8 bits."""

import torch
from torch import Tensor

from torchrefract._bands import rows_at_once

_CACHED = 1 << 17  # values that stay in a core's cache


def numbers_of(levels: Tensor) -> Tensor:
    """Whole numbers, as uint8 or uint16, over the largest of their type, float32, as they lie in memory."""
    return levels.float().div_(torch.iinfo(levels.dtype).max)


def levels_of(numbers: Tensor) -> Tensor:
    """round(255 v) of each number v of images (N, C, H, W), which is cut to [0, 1] first; uint8, as they lie there."""
    numbers = numbers.detach()
    levels = torch.empty_like(numbers, dtype=torch.uint8)
    batch, channels, height, width = numbers.shape
    rows = rows_at_once(numbers.device, height, each=batch * channels * width, cached=_CACHED, shared=True)
    for place, band in zip(levels.split(rows, dim=2), numbers.split(rows, dim=2), strict=True):
        place.copy_(rounded(band * 255, torch.uint8))
    return levels


def rounded(values: Tensor, dtype: torch.dtype) -> Tensor:
    """The nearest of the whole numbers of a type, in the type of the values."""
    low, high = (0, 1) if dtype is torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    return values.clamp(low, high).round_()
