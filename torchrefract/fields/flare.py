"""The light that the sun scatters over a lens: a Gaussian around the sun."""

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._validation import requires_grad
from torchrefract.warping.grid import pixel_axes

_MIN_RADIUS = 1e-6  # px


def flare_axes(center: Tensor, radius: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return the factors of m(x, y) = exp(-((x - cx)^2 + (y - cy)^2) / (2 r^2)) along both axes.

    m is 1 at the center and e^-1/2 at the distance r.

    Args:
        center: (B, 2), px, cx and cy, pixel centers being whole numbers; may lie outside the frame.
        radius: (B,), px, r, at least 0; smaller values than 1e-6 count as 1e-6.
        height, width: px.

    Returns:
        (B, 1, 1, W) along x and (B, 1, H, 1) along y; their product is m.
    """
    x, y = pixel_axes(height, width, dtype=center.dtype, device=center.device)
    cx, cy = center.view(-1, 2, 1, 1, 1).unbind(1)
    # The square of the distance has a gradient at the center, the distance has none.
    divisor = -2 * radius.clamp(min=_MIN_RADIUS).square().view(-1, 1, 1, 1)
    return torch.exp((x - cx).square() / divisor), torch.exp((y - cy).square() / divisor)


def add_light(image: Tensor, along_x: Tensor, along_y: Tensor, *, clip: bool) -> Tensor:
    """Return I + L with L = along_x along_y, clipped to [0, 1] if `clip`.

    Args:
        image: (N, C, H, W).
        along_x: (N, 1, 1, W).
        along_y: (N, C, H, 1).
        clip: clip the sum.
    """
    result = torch.addcmul(image, along_y, along_x)
    if not clip:
        return result
    if requires_grad((result,)) or torch.compiler.is_compiling():
        return result.clamp(0, 1)
    return F.hardtanh(result, 0.0, 1.0, inplace=True)  # a clamp in place that torch.vmap supports


def screen_light(image: Tensor, along_x: Tensor, along_y: Tensor) -> Tensor:
    """Return 1 - (1 - I) (1 - min(L, 1)), L = along_x along_y, the screen blend; arguments as for `add_light`."""
    return torch.addcmul(image, 1 - image, (along_y * along_x).clamp(max=1))
