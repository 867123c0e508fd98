"""Fog after Koschmieder: what arrives of the light, and what the fog adds."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# Farther than anything.
_FARTHEST = 1e12


def extinction(visibility: Tensor, threshold: float) -> Tensor:
    """k = -ln(threshold) / V in 1/m, the extinction that leaves the contrast `threshold` at V meters; any shape.

    Source: Koschmieder 1924; a threshold of 0.05 is the meteorological optical range of CIE and WMO.
    """
    return -math.log(threshold) / visibility


def transmission(depth: Tensor, k: Tensor) -> Tensor:
    """t = exp(-k d), the share of light that arrives from d meters through an extinction k in 1/m; they broadcast."""
    # An infinite depth times an extinction of zero would be NaN, and so would be the slope of an infinite product.
    return torch.exp(k * -depth.clamp(max=_FARTHEST))


def veil(image: Tensor, t: Tensor, airlight: Tensor) -> Tensor:
    """I t + A (1 - t), exactly I where t = 1 and exactly A where t = 0; the three broadcast.

    Args:
        image: (B, C, H, W).
        t: (B, 1, H or 1, W or 1), in [0, 1].
        airlight: (B, C, 1, 1).
    """
    rows = math.prod(image.shape[:3])
    if rows == 0 or t.shape[3] > 1 or image.device.type != "cpu" or torch.compiler.is_compiling():
        return torch.lerp(airlight, image, t)
    # With a number for each row, lerp does not vectorize. A batch norm that is not training is one such pass,
    # x w + b for each channel; each row is a channel here.
    t = t.expand(-1, -1, image.shape[2], -1)
    added = (airlight * (1 - t)).expand(*image.shape[:3], 1)
    # The mean of zero serves as the variance too, beside an epsilon of 1.
    lines, zero = image.contiguous().view(1, rows, image.shape[3]), image.new_zeros(rows)
    return F.batch_norm(lines, zero, zero, t.expand_as(added).reshape(rows), added.reshape(rows), eps=1.0).view_as(
        image
    )


def srgb_to_linear(value: Tensor) -> Tensor:
    """Linear light of stored values in [0, 1], any shape. Source: IEC 61966-2-1."""
    low = value / 12.92
    return torch.where(value <= 0.04045, low, _power((value.clamp(min=0.04045) + 0.055) / 1.055, 2.4))


def linear_to_srgb(value: Tensor) -> Tensor:
    """Stored values of linear light in [0, 1], any shape. Source: IEC 61966-2-1."""
    high = 1.055 * _power(value.clamp(min=0.0031308), 1 / 2.4) - 0.055
    return torch.where(value <= 0.0031308, 12.92 * value, high)


def _power(value: Tensor, exponent: float) -> Tensor:
    """value^exponent of what is above 0, to the same bits in any batch, as `pow` is not."""
    return torch.exp(exponent * torch.log(value))
