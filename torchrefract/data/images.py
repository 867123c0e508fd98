"""Reading clean pictures, and cutting them to one size.

A damaged picture must not slip in: a decoder may fill what is missing with gray and call it a success. So a file
counts as readable only where its format's own mark of completeness is there: the end marker of JPEG and PNG, the
length that WebP and BMP state at their start.
"""

import io
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract._validation import check_size, check_tensor

EXTENSIONS = (".jpg", ".jpeg", ".png", ".webp", ".bmp")

_TAIL = 4096  # bytes read first in the search for an end marker: nearly all files have it in the last few
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"
_START_OF_SCAN = 0xDA
_BARE_MARKERS = (0x01, *range(0xD0, 0xD8))  # TEM and RST0 to RST7 carry no length
_ORIENTATION = 0x0112
_TURNED = (5, 6, 7, 8)  # EXIF orientations that swap height and width
_QUIETING = Lock()
_levels: list[int] = []  # OpenCV's log level before, once for each thread that has it off


class UnreadableImageError(ValueError):
    """A file that is no complete picture. The message names it and says what is wrong."""


def read_image(path: str | Path) -> Tensor:
    """The picture in a JPEG, PNG, WebP or BMP file, upright as its EXIF orientation says, without its alpha channel.

    Returns:
        (3, H, W), float32 in [0, 1], RGB, 8-bit values / 255 and 16-bit values / 65535; strides as decoded, so
        channels last.
    """
    return as_image(read_pixels(path))


def read_pixels(path: str | Path) -> np.ndarray:
    """The picture of `read_image` as the file has it: (H, W, 3), RGB, uint8 or uint16."""
    with opened(path) as stream:
        data = stream.read()
    _check_whole(path, io.BytesIO(data), len(data))
    if data.startswith(_PNG) and not png_fits(data):
        raise UnreadableImageError(f"{path} is damaged: its parts are not as long as they say")
    # Where a header claims 30000 x 30000 pixels OpenCV would make them, though the file holds a hundred bytes.
    _header_size(path, io.BytesIO(data))
    return _decode(path, data)


def as_image(pixels: np.ndarray) -> Tensor:
    """(3, H, W), float32 in [0, 1], of a picture (H, W, 3), uint8 or uint16."""
    return to_float(torch.from_numpy(pixels)).permute(2, 0, 1)


def pixels_of(image: Tensor) -> np.ndarray:
    """(H, W, 3), uint8, round(255 v) of each value v of a picture (3, H, W), which is cut to [0, 1] first.

    What `read_image` has read from 8 bits comes back as it was.
    """
    levels = to_uint8(image.detach().cpu()[None])[0]
    # OpenCV interleaves planes sooner than a copy in another order of strides does.
    return last.numpy() if (last := levels.permute(1, 2, 0)).is_contiguous() else cv2.merge([*levels.numpy()])


def image_size(path: str | Path) -> tuple[int, int]:
    """(H, W) of what `read_image` returns, from the file's header and tail, without decoding a pixel.

    A file that lacks its end, is empty, or is no picture raises UnreadableImageError, as `read_image` does; one that
    is damaged in between is found by `read_image` alone.
    """
    with opened(path) as stream:
        _check_whole(path, stream, os.fstat(stream.fileno()).st_size)
        return _header_size(path, stream)


@contextmanager
def opened(path: str | Path) -> Iterator[BinaryIO]:
    """A file to read from; what the system says against it is an UnreadableImageError.

    A pipe is refused: opening it would wait for somebody who writes.
    """
    try:
        mode = os.stat(path).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UnreadableImageError(f"{path} cannot be opened (a pipe or a device)")
        with open(path, "rb") as stream:
            yield stream
    except OSError as error:
        raise UnreadableImageError(f"{path} cannot be opened ({error.strerror})") from error


def files_in(folder: Path, suffixes: Sequence[str] = EXTENSIONS) -> list[Path]:
    """The files of a folder whose names end so, in any case, by name; folders and hidden files aside.

    What is hidden is no picture of the user's, but what a stop has left half written, or another system's notes.
    """
    found = (file for file in folder.glob("[!.]*") if file.suffix.lower() in suffixes)
    return sorted(file for file in found if not file.is_dir())


def png_fits(data: bytes) -> bool:
    """Whether every part of a PNG, up to its end, lies in the file: OpenCV makes room for as much as a part claims."""
    position = len(_PNG) if data.startswith(_PNG) else len(data)
    while position + 12 <= len(data):
        end = position + 12 + int.from_bytes(data[position : position + 4], "big")
        if data[position + 4 : position + 8] == _PNG_END[:4]:
            return end <= len(data)
        position = end
    return False


def fit(image: Tensor, size: Sequence[int]) -> Tensor:
    """The middle of a picture, cut to the aspect of `size` and reduced to it by area averaging.

    Each output pixel is the mean of the input pixels that it covers, those at its border by the share covered: a
    scene seen by a coarser sensor. (An antialiased bilinear filter would reach twice as far and blur more.)

    Args:
        image: (3, H, W), float32 in [0, 1], on the CPU.
        size: (h, w), at most (H, W): nothing is ever enlarged.

    Returns:
        (3, h, w), float32 in [0, 1].
    """
    height, width = check_size("size", size)
    _check_image(image)
    H, W = image.shape[1:]
    if height > H or width > W:
        raise ValueError(f"image must be at least size = {height}x{width} (height x width), got {H}x{W}")
    if (height, width) == (H, W):
        return image.detach().clone(memory_format=torch.contiguous_format)
    crop_height, crop_width = min(H, round(W * height / width)), min(W, round(H * width / height))
    top, left = (H - crop_height) // 2, (W - crop_width) // 2
    crop = image.detach()[:, top : top + crop_height, left : left + crop_width].permute(1, 2, 0).contiguous().numpy()
    small = cv2.resize(crop, (width, height), interpolation=cv2.INTER_AREA)
    # Weights that sum to 1 only up to rounding may step over 1.
    return torch.from_numpy(small).permute(2, 0, 1).contiguous().clamp_(0, 1)


def _check_image(image: Tensor) -> None:
    check_tensor("image", image)
    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"image must have shape (3, H, W), got {tuple(image.shape)}")
    if image.dtype != torch.float32 or image.device.type != "cpu":
        raise TypeError(f"image must be float32 on the CPU, got {image.dtype} on {image.device}")


def _header_size(path: str | Path, stream: BinaryIO) -> tuple[int, int]:
    try:
        with Image.open(stream) as picture:
            width, height = picture.size
            # Asked without need, Pillow decodes a whole PNG in search of EXIF data behind its pixels.
            turned = "exif" in picture.info and picture.getexif().get(_ORIENTATION) in _TURNED
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UnreadableImageError(f"{path} has a damaged header ({error})") from error
    return (width, height) if turned else (height, width)


def _decode(path: str | Path, data: bytes) -> np.ndarray:
    # Decoding from memory: from a file OpenCV would fill the missing rows of a cut JPEG with gray, and call it well.
    try:
        with _quiet():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise UnreadableImageError(f"{path} cannot be decoded ({error.err})") from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError(f"{path} is damaged: its pixels cannot be decoded")
    return pixels


@contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV's log lines off: what they say is raised as an error."""
    # The level is the process's own: of threads that read at once, the first sets it, and the last sets it back.
    with _QUIETING:
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _levels.append(_levels[0] if _levels else level)
    try:
        yield
    finally:
        with _QUIETING:
            level = _levels.pop()
            if not _levels:
                cv2.utils.logging.setLogLevel(level)


def _check_whole(path: str | Path, stream: BinaryIO, length: int) -> None:
    """Raise unless `stream`, of `length` bytes, is a picture file with its end in place."""
    if length == 0:
        raise UnreadableImageError(f"{path} is empty (0 bytes)")
    head = stream.read(16)
    if head.startswith(b"\xff\xd8\xff"):
        whole = _contains(stream, _JPEG_END, _scan_start(stream, length), length)
    elif head.startswith(_PNG):
        whole = _contains(stream, _PNG_END, 8, length)
    elif head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        whole = int.from_bytes(head[4:8], "little") + 8 <= length
    elif head.startswith(b"BM"):
        whole = length >= 26 and int.from_bytes(head[2:6], "little") <= length
    else:
        raise UnreadableImageError(f"{path} is not a JPEG, PNG, WebP or BMP picture")
    if not whole:
        raise UnreadableImageError(f"{path} is truncated ({length} bytes, its end is missing)")


def _contains(stream: BinaryIO, marker: bytes, start: int, length: int) -> bool:
    """Whether `marker` lies at `start` or later: programs append bytes to whole pictures, so not just at the end."""
    for begin in (max(start, length - _TAIL), start):
        stream.seek(begin)
        if marker in stream.read():
            return True
    return False


def _scan_start(stream: BinaryIO, length: int) -> int:
    """Where the coded pixels of a JPEG begin, or its length: what lies before may hold a thumbnail with its own end."""
    position = 2
    while position + 4 <= length:
        stream.seek(position)
        fill, marker, high, low = stream.read(4)
        if fill != 0xFF or marker == _START_OF_SCAN:
            return position
        # A marker may be preceded by any number of fill bytes 0xFF.
        position += 1 if marker == 0xFF else 2 if marker in _BARE_MARKERS else 2 + 256 * high + low
    return length
