"""The layout of figures: images and texts in rows and columns, on whole pixels.

Figures do not resample images: `resize_for_display` enlarges or reduces them first.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.transforms import Bbox, TransformedBbox
from torch import Tensor

from torchrefract._tensor import to_uint8

_DPI = 100
_SMALLEST_SIDE = 320  # px, longer side of a displayed image


def resize_for_display(images: Tensor, *, largest: int = 640) -> Tensor:
    """Bring images to the size of display: repeat the pixels of small ones, reduce large ones by area.

    Args:
        images: (B, C, H, W), floating; values outside [0, 1] are clamped, values that are not finite turn gray.
        largest: largest longer side of the result, px, at least 320.

    Returns:
        (B, C, h, w), float32 in [0, 1], on the CPU.
    """
    images = torch.where(images.isfinite(), images, 0.5).detach().float().cpu().clamp(0, 1)
    height, width = images.shape[2:]
    side = max(height, width)
    if side <= largest:
        factor = min(math.ceil(_SMALLEST_SIDE / side), largest // side)
        return images.repeat_interleave(factor, dim=2).repeat_interleave(factor, dim=3)
    scale = largest / side
    return F.interpolate(images, (max(1, round(height * scale)), max(1, round(width * scale))), mode="area")


@dataclass(frozen=True)
class FigureLayout:
    """A figure and the positions of its images and texts, in whole px from the top left."""

    rows: int
    columns: int
    height: int  # of an image
    width: int
    caption_lines: int  # above each row
    header_lines: int = 2  # above the first caption
    footer_lines: int = 4  # below the last row
    min_column_lines: int = 12  # smallest distance of columns, in lines: a narrow image leaves space for its title
    detailed: bool = False  # a second image below each

    @property
    def text(self) -> int:
        """Height of a line of text; letters fill four fifths of it."""
        return max(self.height, self.width) // 20

    @property
    def column_px(self) -> int:
        """Distance from column to column."""
        return max(self.width + self.text // 2, self.min_column_lines * self.text)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the figure."""
        return 2 * self.text + self.columns * self.column_px, self.top(self.rows) + self.footer_lines * self.text

    def left(self, column: int) -> int:
        """Left side of the images in a column."""
        return self.text + column * self.column_px + (self.column_px - self.width) // 2

    def top(self, row: int) -> int:
        """Upper side of the images in a row."""
        caption = round((1.3 * self.caption_lines + 0.8) * self.text)
        images = self.detail_offset + self.height if self.detailed else self.height
        return self.header_lines * self.text + row * (images + caption) + caption

    @property
    def detail_offset(self) -> int:
        """Distance from the upper side of an image to that of its details, below a line of text."""
        return self.height + 2 * self.text

    @cached_property
    def figure(self) -> Figure:
        """The figure, which is empty at first."""
        return Figure(figsize=(self.size[0] / _DPI, self.size[1] / _DPI), dpi=_DPI, facecolor="white")

    def write(self, text: str, x: float, y: float, *, ha: str = "left", weight: str = "normal") -> None:
        """Write a text whose lower edge is at y and whose left end, center or right end (`ha`) is at x."""
        position, points = (x / self.size[0], 1 - y / self.size[1]), 0.8 * self.text * 72 / _DPI
        self.figure.text(*position, text, ha=ha, va="bottom", weight=weight, fontsize=points, parse_math=False)

    def box(self, height: int, width: int, x: int, y: int) -> tuple[float, float, float, float]:
        """Return left, bottom, width and height of an image with its upper left corner at (x, y), as shares."""
        total_width, total_height = self.size
        return x / total_width, 1 - (y + height) / total_height, width / total_width, height / total_height

    def show(self, image: Tensor, x: int, y: int) -> None:
        """Place an image (3, h, w) in [0, 1] with its upper left corner at (x, y), pixel by pixel."""
        # Without axes, whose unseen ticks took a third of the time of a contact sheet.
        _, height, width = image.shape
        box = TransformedBbox(Bbox.from_bounds(*self.box(height, width, x, y)), self.figure.transFigure)
        shown = BboxImage(box, interpolation="nearest", origin="upper")
        shown.set_data(to_uint8(image[None])[0].movedim(0, -1).numpy())
        self.figure.add_artist(shown)

    def render(self) -> np.ndarray:
        """Draw the figure, and return its pixels (height, width, 3), uint8."""
        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3]

    def explain(self, image: Tensor, text: str, *, x: int, y: int) -> None:
        """Write a legend: a patch of an image (3, h, w), three lines wide and two high, and a text to its right."""
        self.show(image[:, : 2 * self.text, : 3 * self.text], x, y)
        self.write(text, x + 4 * self.text, y + round(1.5 * self.text))
