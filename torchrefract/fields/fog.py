"""Koschmieder's law: how much light arrives through fog, and how much the fog adds."""

import math

import torch
from torch import Tensor

from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear

_FARTHEST = 1e12  # m; depths are clamped to it


def extinction(visibility: Tensor, threshold: float) -> Tensor:
    """Return the extinction k = -ln(threshold) / V in 1/m that leaves the contrast `threshold` at V meters.

    Args:
        visibility: V in m, above 0, inf for clear air; any shape.
        threshold: in (0, 1).

    Source: Koschmieder 1924; a threshold of 0.05 is the meteorological optical range of CIE and WMO.
    """
    return -math.log(threshold) / visibility


def transmission(depth: Tensor, k: Tensor) -> Tensor:
    """Return t = exp(-k d), the share of the light that arrives from d meters through an extinction k in 1/m.

    Args:
        depth: d in m, at least 0, may be inf.
        k: 1/m, broadcasts with the depth.
    """
    # An infinite depth times an extinction of 0 would be NaN, and so would be the gradient of an infinite product.
    return (k * -depth.clamp(max=_FARTHEST)).exp_()


def blend_fog(image: Tensor, t: Tensor, airlight: Tensor, *, linear_light: bool = False) -> Tensor:
    """Return I t + A (1 - t), exactly I where t = 1 and exactly A where t = 0 (in stored values).

    Args:
        image: (N, C, H, W), stored values (sRGB) in [0, 1].
        t: (N or 1, 1, H or 1, W or 1), in [0, 1].
        airlight: (N or 1, C, 1, 1), stored values.
        linear_light: blend linear light, not stored values.

    Returns:
        (N, C, H, W), stored values.
    """
    if linear_light:
        blended = torch.lerp(srgb_to_linear(airlight), srgb_to_linear(image), t)
        return torch.where(t == 1, image, linear_to_srgb(blended))
    if t.shape[3] == 1:
        # PyTorch does not vectorize a loop over pixels with two operands of stride 0.
        airlight = airlight.expand(-1, -1, -1, image.shape[3]).contiguous()
    return torch.lerp(airlight, image, t)


def unblend_fog(image: Tensor, t: Tensor, airlight: Tensor, *, linear_light: bool = False) -> Tensor:
    """Return A + (I - A) / t, the inverse of `blend_fog` with the same arguments, for t above 0."""
    if linear_light:
        return linear_to_srgb(torch.lerp(srgb_to_linear(airlight), srgb_to_linear(image), 1 / t))
    return torch.lerp(airlight, image, 1 / t)
