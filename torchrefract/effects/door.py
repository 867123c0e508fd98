"""The door of every effect: which images come in, and that they leave as they came."""

import torch
from torch import Tensor

from torchrefract._checks import check_tensor
from torchrefract.warping.resample import is_channels_last


def check_image(image: Tensor) -> None:
    """Raise unless the image is (B, C, H, W) or (C, H, W), with a channel and a pixel, floating or uint8."""
    check_tensor("image", image)
    if image.ndim not in (3, 4) or 0 in image.shape[-3:]:
        raise ValueError(f"image must have shape (B, C, H, W) or (C, H, W), got {tuple(image.shape)}")
    if not image.is_floating_point() and image.dtype is not torch.uint8:
        raise TypeError(f"image must be floating in [0, 1] or uint8, got {image.dtype}")


def enter(image: Tensor) -> Tensor:
    """(B, C, H, W), float32 or float64, in [0, 1]."""
    batched = image if image.ndim == 4 else image[None]
    if image.dtype is torch.uint8:
        return batched.float() / 255
    return batched if image.dtype is torch.float64 else batched.float()


def leave(result: Tensor, image: Tensor, *, untouched: bool) -> Tensor:
    """The result (B, C, H, W) in the shape, type and memory format of the image that came in."""
    if untouched:
        return image
    if image.dtype is torch.uint8:
        result = (result * 255).round().clamp(0, 255)
    last = image.ndim == 4 and is_channels_last(image)
    result = result.to(image.dtype).contiguous(memory_format=torch.channels_last if last else torch.contiguous_format)
    return result if image.ndim == 4 else result[0]
