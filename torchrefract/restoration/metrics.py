"""How near a restoration comes: per image, on the pixels that count."""

import torch
from kornia.metrics import ssim as ssim_map
from torch import Tensor


def masked_mean(value: Tensor, valid: Tensor) -> Tensor:
    """(B,): the mean of value (B, C, H, W) over the pixels where valid (B, 1, H, W) is true; 0 where none is."""
    weight = valid.to(value.dtype)
    count = weight.sum(dim=(1, 2, 3)) * value.shape[1]
    return (value * weight).sum(dim=(1, 2, 3)) / count.clamp(min=1)


def psnr(restored: Tensor, clean: Tensor, valid: Tensor) -> Tensor:
    """(B,), dB: 10 log10(1 / mean (restored - clean)^2), restored clamped to [0, 1], up to 100 dB.

    Args:
        restored, clean: (B, C, H, W), in [0, 1].
        valid: (B, 1, H, W), bool, the pixels that count.
    """
    error = masked_mean((restored.clamp(0, 1) - clean).square(), valid)
    return -10 * torch.log10(error.clamp(min=1e-10))


def ssim(restored: Tensor, clean: Tensor, valid: Tensor) -> Tensor:
    """(B,): structural similarity with an 11 x 11 Gaussian window; arguments as for `psnr`.

    A window that reaches over pixels that do not count reads the clean ones there.

    Source: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment", IEEE TIP 13 (2004).
    """
    return masked_mean(ssim_map(torch.where(valid, restored.clamp(0, 1), clean), clean, window_size=11), valid)


def endpoint_error(flow: Tensor, target: Tensor, valid: Tensor, *, size: tuple[int, int]) -> Tensor:
    """(B,), px of a frame of `size` = (height, width): the mean length of flow - target.

    Args:
        flow, target: (B, 2, H, W), px of a frame of (H, W).
        valid: (B, 1, H, W), bool, the pixels that count.
        size: the frame whose pixels the error is given in.
    """
    scale = [size[1] / flow.shape[3], size[0] / flow.shape[2]]
    difference = (flow - target) * torch.tensor(scale, dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)
    return masked_mean(difference.square().sum(dim=1, keepdim=True).sqrt(), valid)
