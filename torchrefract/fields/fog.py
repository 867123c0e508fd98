"""Fog after Koschmieder: what arrives of the light, and what the fog adds."""

import math

import torch
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
    return torch.exp(k * -_finite(depth))


def drifting_transmission_(noise: Tensor, scale: Tensor, offset: Tensor, depth: Tensor) -> Tensor:
    """t = exp(-(scale n + offset) d), through an extinction that is a noise n; in its memory if it has no gradient.

    Args:
        noise: (N, 1, H, W).
        scale, offset: (N, 1, 1, 1), 1/m.
        depth: (N or 1, 1, H, W or 1), m.
    """
    distance = -_finite(depth)
    scale, offset = scale * distance, offset * distance
    if (
        torch.compiler.is_compiling()
        or _is_mapped(noise, scale)
        or any(value.requires_grad for value in (noise, scale, offset))
    ):
        return torch.exp(noise * scale + offset)
    return noise.mul_(scale).add_(offset).exp_()


def veil(image: Tensor, t: Tensor, airlight: Tensor) -> Tensor:
    """I t + A (1 - t), exactly I where t = 1 and exactly A where t = 0; the three broadcast.

    Args:
        image: (B, C, H, W).
        t: (B, 1, H or 1, W or 1), in [0, 1].
        airlight: (B, C, 1, 1).
    """
    if t.shape[3] == 1:
        # With two numbers for each row the loop over a row's pixels is not vectorized: one is written out, once.
        airlight = airlight.expand(-1, -1, -1, image.shape[3]).contiguous()
    return torch.lerp(airlight, image, t)


def _is_mapped(*values: Tensor) -> bool:
    """Whether torch.vmap maps over one of them: what it hides from a sample may have a gradient."""
    try:
        for value in values:
            value.data_ptr()
    except RuntimeError:  # a sample has no memory of its own
        return True
    return False


def _finite(depth: Tensor) -> Tensor:
    # An infinite depth times an extinction of zero would be NaN, and so would be the slope of an infinite product.
    return depth.clamp(max=_FARTHEST)


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
