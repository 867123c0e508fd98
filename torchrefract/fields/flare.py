"""The veil of light that the sun throws over a lens."""

import torch
from torch import Tensor


def flare_axes(center: Tensor, radius: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The two factors of m(x, y) = exp(-((x - cx)^2 + (y - cy)^2) / (2 r^2)), 1 at the center and e^-1/2 at r.

    Args:
        center: (B, 2), px, cx and cy, pixel centers being whole numbers; anywhere, also outside the frame.
        radius: (B,), px; 0 is no flare: the factor along y is 0.
        height, width: px.

    Returns:
        along x, (B, 1, 1, W), and along y, (B, 1, H, 1); their product is m.
    """
    x = torch.arange(width, dtype=center.dtype, device=center.device).view(1, 1, 1, width)
    y = torch.arange(height, dtype=center.dtype, device=center.device).view(1, 1, height, 1)
    # Squares, since the root of the distance has no slope at the center.
    shines = radius > 0
    blunt = -2 * torch.where(shines, radius, 1).square()
    cx, cy, blunt, shines = (value.view(-1, 1, 1, 1) for value in (*center.unbind(1), blunt, shines))
    along_x, along_y = torch.exp((x - cx).square() / blunt), torch.exp((y - cy).square() / blunt)
    return along_x, torch.where(shines, along_y, 0)


def flare_mask(center: Tensor, radius: Tensor, *, height: int, width: int) -> Tensor:
    """(B, 1, H, W), m of `flare_axes`, in [0, 1]; arguments as there."""
    along_x, along_y = flare_axes(center, radius, height=height, width=width)
    return along_y * along_x
