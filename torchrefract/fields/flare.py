"""The veil of light that the sun throws over a lens."""

import torch
from torch import Tensor

_SMALLEST = 1e-6  # px


def flare_axes(center: Tensor, radius: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The two factors of m(x, y) = exp(-((x - cx)^2 + (y - cy)^2) / (2 r^2)), 1 at the center and e^-1/2 at r.

    Args:
        center: (B, 2), px, cx and cy, pixel centers being whole numbers; anywhere, also outside the frame.
        radius: (B,), px, at least 0; below 1e-6 it counts as that.
        height, width: px.

    Returns:
        along x, (B, 1, 1, W), and along y, (B, 1, H, 1); their product is m.
    """
    x = torch.arange(width, dtype=center.dtype, device=center.device).view(1, 1, 1, width)
    y = torch.arange(height, dtype=center.dtype, device=center.device).view(1, 1, height, 1)
    cx, cy = center.view(-1, 2, 1, 1, 1).unbind(1)
    # Squares, since the root of the distance has no slope at the center.
    blunt = -2 * radius.clamp(min=_SMALLEST).square().view(-1, 1, 1, 1)
    return torch.exp((x - cx).square() / blunt), torch.exp((y - cy).square() / blunt)
