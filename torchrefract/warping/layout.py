"""How images lie in memory."""

import torch
from torch import Tensor


def is_channels_last(image: Tensor) -> bool:
    """Whether the image (B, C, H, W) lies in memory in that format and in no other."""
    # A batch of one, or one channel, counts as both formats; only a real channels_last image asks for its own.
    return not image.is_contiguous() and has_format(image) and image.is_contiguous(memory_format=torch.channels_last)


def has_format(image: Tensor) -> bool:
    """Whether it can be said how the image lies in memory."""
    try:
        image.is_contiguous(memory_format=torch.channels_last)
    except RuntimeError:  # inside torch.vmap a sample has no format
        return False
    return True
