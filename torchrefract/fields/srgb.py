"""Stored values (sRGB), linear light, and luma."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor

REC_709 = (0.2126, 0.7152, 0.0722)  # shares of red, green and blue in the luma
# Where the line and the power of the curve meet. The standard rounds it to 0.0031308, and its inverse to 0.04045.
LINEAR_TOE = 0.003130668442500535
STORED_TOE = 12.92 * LINEAR_TOE
_HIGHEST = 1e4  # stored value; higher ones, whose power would be infinite, count as this


def color_per_channel(name: str, color: Sequence[float], channels: int) -> Sequence[float]:
    """Return a color with one number for each channel; images of one channel take the luma of red, green and blue.

    Raises:
        ValueError: the numbers do not fit the channels.
    """
    if channels == 1 and len(color) == len(REC_709):
        return [sum(share * value for share, value in zip(REC_709, color, strict=True))]
    if len(color) not in (1, channels):
        raise ValueError(f"{name} must have 1 number or {channels}, one for each channel, got {tuple(color)}")
    return color if len(color) == channels else [color[0]] * channels


def color_of_images(name: str, color: Sequence[float], image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return (B, C), a color as by `color_per_channel` for each image (B, C, H, W)."""
    rows = [color_per_channel(name, color, image.shape[1])] * len(image)
    return as_device_tensor(rows, dtype=dtype, device=image.device).view(image.shape[:2])


def srgb_to_linear(value: Tensor) -> Tensor:
    """Convert stored values in [0, 1] to linear light, any shape. Source: IEC 61966-2-1."""
    # A sum of line and power, which meet: torch.where and pow take several times as long.
    power = value.clamp(min=STORED_TOE, max=_HIGHEST).add_(0.055).log2_().mul_(2.4).exp2_()
    return value.clamp(max=STORED_TOE).sub_(STORED_TOE).mul_(1 / 12.92).add_(power, alpha=1.055**-2.4)


def linear_to_srgb(value: Tensor) -> Tensor:
    """Convert linear light in [0, 1] to stored values, any shape. Source: IEC 61966-2-1."""
    power = value.clamp(min=LINEAR_TOE).log2_().mul_(1 / 2.4).exp2_()
    line = value.clamp(max=LINEAR_TOE).mul_(12.92).sub_(12.92 * LINEAR_TOE + 0.055)
    return line.add_(power, alpha=1.055)


def luma(image: Tensor) -> Tensor:
    """Return the luma (N, 1, H, W) of images (N, C, H, W): Rec. 709 for three channels, otherwise their mean."""
    if image.shape[1] != 3:
        return image.mean(dim=1, keepdim=True)
    red, green, blue = image.unbind(1)
    return (REC_709[0] * red + REC_709[1] * green + REC_709[2] * blue)[:, None]
