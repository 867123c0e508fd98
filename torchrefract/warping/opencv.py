"""Looking an image up by OpenCV's remap, where that is F.grid_sample but for the rounding of float32.

From version 5 on remap takes the positions of images of 1, 3 or 4 channels as they are; before, it rounded to 1/32 px.
"""

import importlib
from collections.abc import Iterable
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import requires_grad, why_not_eager
from torchrefract.warping.grid import mirror, pixel_positions

_PADDINGS = {"zeros": "BORDER_CONSTANT", "border": "BORDER_REPLICATE", "reflection": "BORDER_REPLICATE"}
_INTERPOLATIONS = {"nearest": "INTER_NEAREST", "bilinear": "INTER_LINEAR"}
_CHANNELS = (1, 3, 4)
_OLDEST = 5
# So few positions stay in a core's cache, and PyTorch does not share them among its threads, which would stand in the
# way of OpenCV's.
_AT_ONCE = 1 << 15


def obstacle(image: Tensor, flow: Tensor, *, interpolation: str, positions: torch.dtype) -> str | None:
    """Why OpenCV cannot look the image up as F.grid_sample does, None where it can.

    Args:
        image: (B, C, H, W).
        flow: what decides on the positions.
        interpolation: of the look-up.
        positions: the type that F.grid_sample takes the positions in.
    """
    if torch.compiler.is_compiling():  # where no other question may be asked
        return "under torch.compile"
    if interpolation not in _INTERPOLATIONS:
        return f"for {interpolation} interpolation"
    if image.dtype not in (torch.float32, torch.uint8) or image.shape[1] not in _CHANNELS:
        return f"for an image of {image.shape[1]} channels, {image.dtype}"
    if positions is not torch.float32:
        return f"for positions that are {positions}"
    if requires_grad((image, flow)):
        return "where a gradient is asked for"
    return why_not_eager(image) or why_not_eager(flow) or _missing()


def remapped(image: Tensor, grids: Iterable[Tensor], *, padding: str, interpolation: str) -> Tensor:
    """The image (B, C, H, W) of float32 or uint8, in channels_last format, looked up along the sampler's grid.

    Bytes are rounded to the nearest. The threads are OpenCV's own.

    Args:
        image: of which `obstacle` has nothing to say.
        grids: (B, n, W, 2), bands of rows of the grid, one below the other.
        padding, interpolation: of the look-up.
    """
    cv2 = _opencv()
    options = {
        "interpolation": getattr(cv2, _INTERPOLATIONS[interpolation]),
        "borderMode": getattr(cv2, _PADDINGS[padding]),
        "hint": cv2.ALGO_HINT_ACCURATE,
    }
    source = image.detach().contiguous(memory_format=torch.channels_last)
    batch, channels, height, width = source.shape
    # Not `empty_like`, which gives a frame of one pixel strides that OpenCV cannot write to.
    out = source.new_empty(batch, height, width, channels).movedim(-1, 1)
    remap, start = partial(cv2.remap, **options), 0
    for grid in grids:
        band = _pictures(out)[:, start : start + grid.shape[1]]
        _remap_rows(remap, _pictures(source), band, grid, mirrored=padding == "reflection")
        start += grid.shape[1]
    return out


def _remap_rows(remap: Any, source: np.ndarray, out: np.ndarray, grid: Tensor, *, mirrored: bool) -> None:
    batch, height, width = grid.shape[:3]
    rows = max(1, _AT_ONCE // width)
    room = grid.new_empty(2, min(rows, height), width)
    for i, start in product(range(batch), range(0, height, rows)):
        band = slice(start, min(height, start + rows))
        size = {"height": source.shape[1], "width": source.shape[2]}
        x, y = pixel_positions(grid[i, band], **size, out=room[:, : band.stop - start]).numpy()
        if mirrored:
            mirror(x, size["width"])
            mirror(y, size["height"])
        remap(source[i], x, y, dst=out[i, band])


def _pictures(image: Tensor) -> np.ndarray:
    """(B, H, W, C), or (B, H, W) of one channel, as OpenCV has it: the same memory."""
    pixels = image.movedim(1, -1).numpy()
    return pixels[..., 0] if image.shape[1] == 1 else pixels


def _missing() -> str | None:
    return (
        None
        if _opencv()
        else f"without OpenCV {_OLDEST} or later (pip install 'opencv-contrib-python-headless>={_OLDEST}')"
    )


@cache
def _opencv() -> Any:
    """OpenCV, None where it is missing or rounds positions."""
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError:
        return None
    return cv2 if int(cv2.__version__.partition(".")[0]) >= _OLDEST else None
