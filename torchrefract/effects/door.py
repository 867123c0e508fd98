"""The door of every effect: which images and clips come in, and that they leave as they came."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import is_channels_last, to_float, to_uint8
from torchrefract._validation import check_tensor
from torchrefract.labels.targets import is_tv_tensor


class Layout(NamedTuple):
    """How images come in. Inside they are rows (N, C, H, W), the frames of a clip one after the other."""

    batch: int  # B: single images, or clips
    frames: int  # T, 1 for single images
    lead: tuple[int, ...]  # (), (B,), (T,) or (B, T): the dimensions before C, H and W

    @property
    def rows(self) -> int:
        """N = B T."""
        return self.batch * self.frames

    @property
    def is_clip(self) -> bool:
        """Whether there is a dimension of time."""
        return self.lead not in ((), (self.batch,))

    def unrolled(self, value: Tensor) -> Tensor:
        """A map of N rows, or of one row for all frames of each of B clips, with the dimensions of the images."""
        if self.lead == (self.batch,):
            return value
        value = value.reshape(self.batch, -1 if self.batch else self.frames, *value.shape[1:])
        value = value.expand(-1, self.frames, *value.shape[2:])
        return value if len(self.lead) == 2 else value[0] if self.is_clip else value[0, 0]


def check_image(image: Tensor) -> Layout:
    """The layout of images (B, C, H, W) or (C, H, W) or clips (B, T, C, H, W), floating or uint8.

    A `Video` of torchvision is a clip, (T, C, H, W), or several.

    Raises:
        ValueError, TypeError: anything else; no channel, no pixel, a clip without a frame.
    """
    check_tensor("image", image)
    if image.ndim not in (3, 4, 5) or 0 in image.shape[-3:]:
        raise ValueError(
            f"image must have shape (B, C, H, W), (C, H, W) or, of clips, (B, T, C, H, W), got {tuple(image.shape)}"
        )
    if not image.is_floating_point() and image.dtype is not torch.uint8:
        raise TypeError(f"image must be floating in [0, 1] or uint8, got {image.dtype}")
    lead = tuple(image.shape[:-3])
    if len(lead) == 1 and not is_tv_tensor(image, "Video"):
        return Layout(lead[0], 1, lead)
    batch, frames = (1, *lead)[-2:] if lead else (1, 1)
    if frames == 0:
        raise ValueError(f"image must have at least one frame in a clip, got {tuple(image.shape)}")
    return Layout(batch, frames, lead)


def check_depth_fits(depth: Any, image: Tensor, layout: Layout) -> Tensor:
    """The depth as rows: N, or B where one frame stands for all of a clip.

    Raises:
        ValueError, TypeError: a depth that is no floating tensor, or none of (..., 1, H, W) for (..., C, H, W).
    """
    if not isinstance(depth, Tensor) or not depth.is_floating_point():
        raise TypeError(f"depth must be a floating tensor, got {getattr(depth, 'dtype', type(depth).__name__)}")
    size = (1, *image.shape[-2:])
    static = (*layout.lead[:-1], 1)
    if depth.shape != (*layout.lead, *size) and not (layout.is_clip and depth.shape == (*static, *size)):
        same = f", or {(*static, *size)} where it is the same in all frames" if layout.is_clip else ""
        raise ValueError(
            f"depth must have one channel of the size of the image, {(*layout.lead, *size)}{same}, "
            f"got {tuple(depth.shape)}"
        )
    return depth.reshape(-1, *size)


def enter(image: Tensor, *, levels: bool = False) -> Tensor:
    """(N, C, H, W), float32 or float64, in [0, 1]; with `levels` uint8 stays as it is."""
    rows = image if image.ndim == 4 else image.reshape(-1, *image.shape[-3:])
    if image.dtype is torch.uint8:
        return rows if levels else to_float(rows)
    return rows if image.dtype is torch.float64 else rows.float()


def leave(result: Tensor, image: Tensor, rows: Tensor) -> Tensor:
    """The result (N, C, H, W) in the shape, type and memory format of the image that came in as these rows."""
    if result is rows:
        return image
    if image.dtype is torch.uint8 and result.is_floating_point():
        result = to_uint8(result)
    last = is_channels_last(rows)
    result = result.to(image.dtype).contiguous(memory_format=torch.channels_last if last else torch.contiguous_format)
    return result if image.ndim == 4 else result.view(image.shape)
