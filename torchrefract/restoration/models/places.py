"""Where pixels lie: what every network is told beside the image."""

import torch
from torch import Tensor

from torchrefract.warping.grid import pixel_axes


def places(image: Tensor) -> Tensor:
    """(B, 2, H, W), in [-1, 1]: where the pixels of images (B, C, H, W) lie on their frame, x and y.

        x = (2 column + 1) / W - 1,  y = (2 row + 1) / H - 1

    Without them a convolution cannot know where it looks, and what a lens does depends on that.
    """
    batch, _, height, width = image.shape
    x, y = pixel_axes(height, width, dtype=image.dtype, device=image.device)
    axes = ((2 * axis + 1) / size - 1 for axis, size in ((x, width), (y, height)))
    return torch.cat([axis.expand(batch, 1, height, width) for axis in axes], dim=1)
