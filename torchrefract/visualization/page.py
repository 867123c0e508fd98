"""A page of pictures in rows and columns, with texts between them."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract._tensor import to_uint8

_DPI = 100
_SMALLEST = 320  # px, the longer side of an image as drawn


def as_drawn(images: Tensor, *, largest: int = 640) -> Tensor:
    """The images in the pixels that they are drawn with, so that a page never resamples them.

    Small images repeat their pixels a whole number of times, large ones shrink by area; what is not finite turns gray.

    Args:
        images: (B, C, H, W), floating in [0, 1]; values outside are clamped.
        largest: px, the longer side of what is returned at most, at least 320.

    Returns:
        (B, C, h, w), float32 in [0, 1], on the CPU.
    """
    images = torch.where(images.isfinite(), images, 0.5).detach().float().cpu().clamp(0, 1)
    height, width = images.shape[2:]
    if max(height, width) <= largest:
        side = max(height, width)
        factor = min(math.ceil(_SMALLEST / side), largest // side)
        return images.repeat_interleave(factor, dim=2).repeat_interleave(factor, dim=3)
    share = largest / max(height, width)
    return F.interpolate(images, (max(1, round(height * share)), max(1, round(width * share))), mode="area")


class Page(NamedTuple):
    """Where things lie, in px from the top left: whole pixels, so that drawing does not resample the images."""

    rows: int
    columns: int
    height: int  # of an image, as drawn
    width: int
    caption_lines: int  # above each row
    header_lines: int = 2  # above the first caption
    footer_lines: int = 4  # below the last row and as much space as a caption
    narrowest: int = 12  # lines, from column to column: a narrow image still leaves room for its title

    @property
    def text(self) -> int:
        """The height of a line, that its letters fill by four fifths."""
        return max(self.height, self.width) // 20

    @property
    def pitch(self) -> int:
        """From column to column."""
        return max(self.width + self.text // 2, self.narrowest * self.text)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return 2 * self.text + self.columns * self.pitch, self.top(self.rows) + self.footer_lines * self.text

    def left(self, column: int) -> int:
        """The left side of the images of a column."""
        return self.text + column * self.pitch + (self.pitch - self.width) // 2

    def top(self, row: int) -> int:
        """The upper side of the images of a row."""
        caption = round((1.3 * self.caption_lines + 0.8) * self.text)
        return self.header_lines * self.text + row * (self.height + caption) + caption

    def figure(self) -> Figure:
        """An empty page."""
        return Figure(figsize=(self.size[0] / _DPI, self.size[1] / _DPI), dpi=_DPI, facecolor="white")

    def write(self, figure: Figure, text: str, x: float, y: float, *, ha: str = "left", weight: str = "normal") -> None:
        """A text that ends above y and begins at x, or has it for its middle or end."""
        where, size = (x / self.size[0], 1 - y / self.size[1]), 0.8 * self.text * 72 / _DPI
        figure.text(*where, text, ha=ha, va="bottom", weight=weight, fontsize=size, parse_math=False)

    def show(self, figure: Figure, image: Tensor, x: int, y: int) -> None:
        """An image (3, h, w) in [0, 1] with its upper left corner at x and y, pixel by pixel."""
        (height, width), size = image.shape[1:], self.size
        axes = figure.add_axes((x / size[0], 1 - (y + height) / size[1], width / size[0], height / size[1]))
        axes.set_axis_off()
        axes.imshow(to_uint8(image[None])[0].movedim(0, -1).numpy(), interpolation="nearest", aspect="auto")

    def explain(self, figure: Figure, image: Tensor, text: str, *, x: int, y: int) -> None:
        """A patch of an image (3, page.height, page.width), three lines wide and two high, and its text beside."""
        self.show(figure, image[:, : 2 * self.text, : 3 * self.text], x, y)
        self.write(figure, text, x + 4 * self.text, y + round(1.5 * self.text))
