"""Scores of a restoration: one number an image, over the valid pixels only; NaN for an image that has none."""

import torch
from kornia.metrics import ssim as ssim_map
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract.effects.fog import MIN_TRANSMISSION
from torchrefract.types import Pair


def masked_mean(value: Tensor, valid: Tensor) -> Tensor:
    """Average over the valid pixels and all channels of each image.

    Args:
        value: (B, C, H, W).
        valid: (B, 1, H, W), bool; the same for all scores.

    Returns:
        (B,); 0 for an image without a valid pixel.
    """
    weight = valid.to(value.dtype)
    count = weight.sum(dim=(1, 2, 3)) * value.shape[1]
    return (value * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1)


def _score(value: Tensor, valid: Tensor) -> Tensor:
    """Return `masked_mean`, but NaN for an image without a valid pixel, which has no score."""
    return masked_mean(value, valid).where(valid.flatten(1).any(dim=1), torch.nan)


def psnr(restored: Tensor, clean: Tensor, valid: Tensor) -> Tensor:
    """Compute the peak signal-to-noise ratio (B,), dB, of images (B, C, H, W) in [0, 1].

    psnr = 10 log10(1 / mean (clamp(restored, 0, 1) - clean)^2), at most 100 dB
    """
    error = _score((restored.clamp(0, 1) - clean).square(), valid)
    return -10 * torch.log10(error.clamp(min=1e-10))


def through_fog(pair: Pair) -> Tensor:
    """Return the pixels (B, 1, H, W), bool, that 8 bits still show through fog: valid ones with t >= 1/255."""
    return pair.valid & (pair.transmission >= MIN_TRANSMISSION)


def restore_by_transmission(pair: Pair) -> Tensor:
    """Remove fog from the degraded images (B, 3, H, W), rounded to 8 bits, by their true transmission and airlight.

        J = (I_8 - V) / t where 1/255 <= t < 1, else I_8,  V = I - J_clean t = A (1 - t)

    It is what a model can reach that knows the fog exactly, and nothing about roads. Other light, as of a flare, stays.

    Args:
        pair: has a transmission, (B, 1, H, W).
    """
    rounded, t = to_float(to_uint8(pair.degraded)).to(pair.degraded.dtype), pair.transmission
    added = pair.degraded - pair.clean * t
    return torch.where((t >= MIN_TRANSMISSION) & (t < 1), (rounded - added) / t.clamp(min=MIN_TRANSMISSION), rounded)


def ssim(restored: Tensor, clean: Tensor, valid: Tensor) -> Tensor:
    """Compute the structural similarity (B,), at most 1, of images (B, C, H, W) in [0, 1].

    The window is an 11 x 11 Gaussian. Invalid pixels inside a window count as clean ones.

    Source: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment", IEEE TIP 13 (2004).
    """
    return _score(ssim_map(torch.where(valid, restored.clamp(0, 1), clean), clean, window_size=11), valid)


def endpoint_error(flow: Tensor, target: Tensor, valid: Tensor, *, size: tuple[int, int]) -> Tensor:
    """Compute the mean length (B,) of `flow - target`, each (B, 2, H, W), px.

    Args:
        flow, target: px of a frame of (H, W).
        valid: as for `masked_mean`.
        size: (height, width) of the frame whose pixels are the unit of the result.
    """
    scale = [size[1] / flow.shape[3], size[0] / flow.shape[2]]
    difference = (flow - target) * torch.tensor(scale, dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)
    return _score(difference.square().sum(dim=1, keepdim=True).sqrt(), valid)


def coverage(flow: Tensor, deviation: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Compute the share (B,) of the values of `target` within two standard deviations of `flow`, each (B, 2, H, W).

    It is 0.95 for a normal distribution with this deviation.
    """
    return _score(((flow - target).abs() <= 2 * deviation).to(flow), valid)
