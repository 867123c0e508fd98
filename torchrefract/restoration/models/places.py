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
    x, y = place_axes(image)
    axes = (x.view(1, 1, 1, width), y.view(1, 1, height, 1))
    return torch.cat([axis.expand(batch, 1, height, width) for axis in axes], dim=1)


def place_axes(image: Tensor, *, cell: int = 1) -> tuple[Tensor, Tensor]:
    """x, (ceil(W / cell),), and y, (ceil(H / cell),), as of `places`: the centers of cells of so many pixels a side.

    That of a last cell which is partly outside may lie there, too.
    """
    height, width = image.shape[2:]
    count = (-(-height // cell), -(-width // cell))
    x, y = pixel_axes(*count, dtype=image.dtype, device=image.device)
    return cell * (2 * x.flatten() + 1) / width - 1, cell * (2 * y.flatten() + 1) / height - 1
