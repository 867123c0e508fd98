"""A picture restored piece by piece."""

from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor

_OVERLAP = 4  # a tile shares a fourth of its length with the next


def in_tiles(restore: Callable[[Tensor], Tensor], image: Tensor, *, tile: tuple[int, int], batch: int) -> Tensor:
    """A picture whose tiles are restored apart, and blended where they overlap.

        out(p) = sum_i w(p - o_i) restored_i(p - o_i) / sum_i w(p - o_i),  w(x, y) = sin^2(pi x / w) sin^2(pi y / h)

    over the tiles i with corners o_i, pixels counted from half a pixel on. They lie evenly, and share a fourth of their
    length or more.

    Args:
        restore: images (B, C, h, w) -> the same restored.
        image: (C, H, W).
        tile: (h, w), px, cut to the picture where that is smaller.
        batch: tiles that are restored at once.

    Returns:
        (C, H, W).
    """
    height, width = (min(side, whole) for side, whole in zip(tile, image.shape[1:], strict=True))
    corners = list(product(_starts(image.shape[1], height), _starts(image.shape[2], width)))
    window = _bump(height, like=image)[:, None] * _bump(width, like=image)
    total, weight = torch.zeros_like(image), torch.zeros_like(image[:1])
    for some in (corners[i : i + batch] for i in range(0, len(corners), batch)):
        tiles = torch.stack([image[:, y : y + height, x : x + width] for y, x in some])
        for (y, x), restored in zip(some, restore(tiles), strict=True):
            total[:, y : y + height, x : x + width] += window * restored
            weight[:, y : y + height, x : x + width] += window
    return total / weight


def _starts(length: int, tile: int) -> list[int]:
    """Where tiles begin along an axis."""
    count = 1 + -(-(length - tile) // max(1, tile - tile // _OVERLAP))
    return [round(i * (length - tile) / max(1, count - 1)) for i in range(count)]


def _bump(length: int, *, like: Tensor) -> Tensor:
    """(length,): zero half a pixel beyond both ends, 1 in the middle."""
    places = (torch.arange(length, dtype=like.dtype, device=like.device) + 0.5) / length
    return (torch.pi * places).sin().square()
