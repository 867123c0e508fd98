"""Texts and images of figures of Matplotlib, and where they lie."""

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from torch import Tensor


def texts(figure: Figure) -> list[str]:
    """Return the texts of a figure, in the order in which they are drawn."""
    return [text.get_text() for text in figure.texts]


def shown_images(figure: Figure) -> list[BboxImage]:
    """Return the images that lie on a figure."""
    return [artist for artist in figure.artists if isinstance(artist, BboxImage)]


def pixels_of(shown: BboxImage) -> Tensor:
    """Return the pixels of an image on a figure, (3, h, w), uint8."""
    return torch.from_numpy(np.asarray(shown.get_array())).movedim(-1, 0)


def assert_nothing_overlaps(figure: Figure) -> None:
    """Raise AssertionError if a text or an image overlaps another one or leaves the figure."""
    figure.canvas.draw()
    boxes = [artist.get_window_extent() for artist in (*shown_images(figure), *figure.texts)]
    assert len(boxes) > len(figure.texts)
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
        assert not any(box.padded(-0.5).overlaps(other) for other in boxes[i + 1 :])
