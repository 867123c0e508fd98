"""Reading of images from files, and cropping and reducing them to one size.

A decoder may fill the missing part of a truncated file with gray and report success. A file is therefore readable only
if it is complete: if it has the end marker of JPEG and PNG, or the length that the header of WebP and BMP states.
"""

import io
import os
import re
import stat
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, NamedTuple, cast

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchrefract._io import is_remote, local_file, read_bytes, retried, store_of
from torchrefract._tensor import to_float, to_uint8
from torchrefract._validation import UsageError, check_size, check_tensor, first_names, warn
from torchrefract.cameras.camera import Camera
from torchrefract.data.jpeg import START_OF_SCAN, lacks_pixel_data

EXTENSIONS = (".jpg", ".jpeg", ".png", ".webp", ".bmp")

# Pictures and videos that no reader here takes, in folders that hold others.
_UNREAD = (".heic", ".heif", ".tif", ".tiff", ".avif", ".jxl", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw")
_UNREAD += (".jfif", ".jpe", ".ppm", ".pgm", ".pnm", ".tga", ".exr", ".hdr")
_UNREAD += (".wmv", ".flv", ".vob", ".insv", ".360", ".mpeg", ".asf", ".ogv", ".3g2", ".mxf", ".h264", ".hevc", ".dav")
_OUTPUTS = ("config.json", "report.md")  # in the folders that commands write pictures to
_TAIL = 4096  # bytes at the end that are searched first for an end marker
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_BARE_MARKERS = (0x01, *range(0xD0, 0xD8))  # TEM and RST0 to RST7 have no length
_LATE_CHUNKS = 1 << 16  # bytes at the end of a PNG, in which EXIF data behind the pixels lies
_PNG_DEPTH = 24  # position of the bits of a channel
_ORIENTATION = 0x0112
_EXIF_PREFIX = b"Exif\0\0"
_TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that swap height and width
OPENCV_LOG: Any = getattr(cv2.utils, "logging", cv2)  # has the functions of the log level in OpenCV 5; cv2 in 4
OPENCV_SILENT = 0
_LOG_LOCK = Lock()
_log_levels: list[int] = []  # OpenCV's previous log level, once for each thread that has silenced it


class UnreadableImageError(ValueError):
    """Raised for a file that is not a complete image."""


class ChangedImageError(UnreadableImageError):
    """Raised for a file of another size than it had when it was listed."""


def is_lost(error: Exception) -> bool:
    """Return True if a file could not be opened or has changed: this says nothing about the listed content."""
    cause = error.__cause__
    is_unopened = isinstance(error, UnreadableImageError) and isinstance(cause, OSError) and cause.errno is not None
    return is_unopened or isinstance(error, ChangedImageError)


class ImageHeader(NamedTuple):
    """Size, orientation and form of an image, by the header of its file."""

    size: tuple[int, int]  # (H, W) as stored, which is the frame of the sensor
    orientation: int  # of EXIF, 1 to 8: how a viewer turns the stored pixels; 1 is upright
    bits: int  # of a channel
    num_frames: int
    has_alpha: bool
    exif: bytes  # in the form of TIFF; empty without EXIF
    profile: bytes  # ICC profile; empty without one


def read_image(path: str | Path, *, upright: bool = True) -> Tensor:
    """Read a JPEG, PNG, WebP or BMP file without its alpha channel.

    Args:
        path: of the file.
        upright: True turns the image by its EXIF orientation, as a viewer does. False keeps the stored pixels, which
            lie in the frame of the sensor, where the geometry of a camera holds.

    Returns:
        (3, H, W), float32, in [0, 1], RGB: 8-bit values / 255 or 16-bit values / 65535; in memory, channels last.

    Raises:
        UnreadableImageError: the file is missing, damaged or not an image.
    """
    return decode_image(read_file(path), path, upright=upright)


def read_file(path: str | Path) -> bytes:
    """Read a file as a whole; errors are those of `opened`."""
    if not is_remote(path):
        with opened(path) as stream:
            return stream.read()
    with _unreadable(path):
        return read_bytes(cast(Path, path))


def decode_image(data: bytes, path: str | Path, *, upright: bool = True) -> Tensor:
    """Decode an image as `read_image` does.

    Args:
        data: the content of the file.
        path: of the file, for errors.
        upright: as for `read_image`.
    """
    # OpenCV would allocate any size that a header states; Pillow raises an error for a decompression bomb.
    orientation = read_header(path, io.BytesIO(data)).orientation
    if data.startswith(_PNG) and not has_complete_png_chunks(data):
        raise UnreadableImageError(f"{path} is damaged: its chunks are shorter than they state")
    pixels = _decode(path, data)
    if upright and orientation != 1:
        # OpenCV reads some orientations otherwise than Pillow, and then sizes would not be those of the header.
        pixels = pixels.swapaxes(0, 1) if orientation in _TRANSPOSED else pixels
        pixels = pixels[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1].copy()
    return to_float(torch.from_numpy(pixels)).permute(2, 0, 1)


def exif_of_result(header: ImageHeader, *, upright: bool) -> bytes:
    """Return the EXIF data of a header for other pixels: without its thumbnail, and if `upright` with orientation 1."""
    data = bytearray(header.exif)
    order = "little" if data.startswith(b"II") else "big"
    start = int.from_bytes(data[4:8], order) + 2
    end = start + 12 * int.from_bytes(data[start - 2 : start], order)
    for entry in range(start, end, 12):
        if upright and int.from_bytes(data[entry : entry + 2], order) == _ORIENTATION:
            data[entry + 8 : entry + 10] = (1).to_bytes(2, order)
    data[end : end + 4] = bytes(len(data[end : end + 4]))  # the offset of the directory of the thumbnail
    return bytes(data)


def pixels_of(image: Tensor, *, bits: int = 8) -> np.ndarray:
    """Convert an image (3, H, W) into (H, W, 3), uint8 or uint16: round(v (2^bits - 1)) of values v clipped to [0, 1].

    It inverts `read_image` of an image of 8 or 16 `bits` exactly.
    """
    if bits == 16:
        values = image.detach().cpu().permute(1, 2, 0).double().clamp(0, 1)
        return (values * 65535).round().numpy().astype(np.uint16)
    levels = to_uint8(image.detach().cpu()[None])[0]
    # OpenCV interleaves planes faster than a strided copy.
    return last.numpy() if (last := levels.permute(1, 2, 0)).is_contiguous() else cv2.merge([*levels.numpy()])


def image_size(path: str | Path) -> tuple[int, int]:
    """Return (H, W) of an upright image from the header and the end of its file, without decoding pixels.

    Errors are those of `image_header`.
    """
    header = image_header(path)
    height, width = header.size
    return (width, height) if header.orientation in _TRANSPOSED else (height, width)


def image_header(path: str | Path) -> ImageHeader:
    """Read the header of an image as `read_header` does."""
    # In a store, one request for the file is faster than several for its parts.
    with io.BytesIO(read_file(path)) if is_remote(path) else opened(path) as stream:
        return read_header(path, stream)


@contextmanager
def _unreadable(path: str | Path) -> Iterator[None]:
    """Turn errors of the system into UnreadableImageError."""
    try:
        yield
    except OSError as error:
        raise UnreadableImageError(f"{path} cannot be opened ({error.strerror})") from error


@contextmanager
def opened(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for reading; turn errors of the system into UnreadableImageError.

    Pipes and devices raise, because opening them could wait for ever.
    """
    if is_remote(path):
        store = cast(Path, path)
        with _unreadable(path):
            stream = cast(BinaryIO, retried(lambda: store_of(store).open(cast(Any, store).path, "rb"), store))
        with stream:
            yield stream
        return
    with _unreadable(path):
        mode = os.stat(path).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UnreadableImageError(f"{path} cannot be opened (a pipe or a device)")
        with open(path, "rb") as stream:
            yield stream


@contextmanager
def local_copy(path: Path) -> Iterator[Path]:
    """Yield a path on this machine with the content of a file, as `local_file` does; errors are those of `opened`."""
    with ExitStack() as stack:
        with _unreadable(path):
            copy = stack.enter_context(local_file(path))
        yield copy


def files_in(folder: Path, suffixes: Sequence[str] = EXTENSIONS) -> list[Path]:
    """List the files of a folder with some suffixes, in any case, sorted by name, without folders and hidden files.

    Raises PermissionError if the folder cannot be read. Warns as `warn_of_unread` does, and of folders beside the files
    that hold such files, too.
    """
    with os.scandir(folder) as entries:
        is_folder = {entry.name: entry.is_dir() for entry in entries if not entry.name.startswith(".")}
    names = [name for name in is_folder if not is_folder[name]]
    warn_of_unread(folder, names)
    files = sorted(folder / name for name in names if Path(name).suffix.lower() in suffixes)
    inner = sorted(name for name in is_folder if is_folder[name] and _holds_inputs(folder / name, suffixes))
    if files and inner:
        warn(
            f"{folder} holds folders with more files, {first_names(inner)}, which are not searched; give each by itself"
        )
    return files


def describe_folders(folder: Path) -> str:
    """Return the end of a message on a folder without files of some suffixes: its folders, if any, are not searched."""
    has_folders = any(path.is_dir() for path in folder.iterdir())
    return ", whose folders are not searched; give one of them" if has_folders else ""


def _holds_inputs(folder: Path, suffixes: Sequence[str]) -> bool:
    """Return True if a folder holds files with some suffixes and is not the output of a command."""
    names = os.listdir(folder) if os.access(folder, os.R_OK) else []
    return not {*_OUTPUTS}.intersection(names) and any(Path(name).suffix.lower() in suffixes for name in names)


def natural_order(name: str) -> list[str | int]:
    """Return a sort key by which 2.png comes before 10.png."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", name))]


def warn_of_unread(source: str | Path, names: Iterable[str]) -> None:
    """Warn of pictures and videos among the files of a folder whose format is not read."""
    if unread := [name for name in names if name.lower().endswith(_UNREAD)]:
        warn(
            f"{source} holds {len(unread)} pictures or videos in formats that are not read, such as {unread[0]}; they "
            "are left out: convert them to PNG or MP4"
        )


def has_complete_png_chunks(data: bytes) -> bool:
    """Return True if the data holds every chunk of a PNG up to its end.

    OpenCV allocates the length that a chunk states, so a damaged length could exhaust the memory.
    """
    position = len(_PNG) if data.startswith(_PNG) else len(data)
    while position + 12 <= len(data):
        end = position + 12 + int.from_bytes(data[position : position + 4], "big")
        if data[position + 4 : position + 8] == _PNG_END[:4]:
            return end <= len(data)
        position = end
    return False


def fit(image: Tensor, size: Sequence[int]) -> Tensor:
    """Crop the center of an image to the aspect ratio of `size` and reduce it by area averaging.

    Each output pixel is the mean of the input pixels that it covers, weighted by the covered area, as of a coarser
    sensor.

    Args:
        image: (3, H, W), float32, in [0, 1], on the CPU.
        size: (h, w), at most (H, W).

    Returns:
        (3, h, w), float32, in [0, 1].

    Raises:
        ValueError: the image is smaller than `size` or has another shape.
        TypeError: the image is not float32 on the CPU.
    """
    height, width = check_size("size", size)
    if check_tensor("image", image).ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"image must have shape (3, H, W), got {tuple(image.shape)}")
    if image.dtype != torch.float32 or image.device.type != "cpu":
        raise TypeError(f"image must be float32 on the CPU, got {image.dtype} on {image.device}")
    if (height, width) == image.shape[1:]:
        return image.detach().clone(memory_format=torch.contiguous_format)
    # The weights sum to 1 up to rounding, so a mean may exceed 1.
    return reduce_by_area(crop_center(image.detach(), size), size).clamp_(0, 1)


def crop_center(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Crop the center of maps (C, H, W) to the aspect ratio of `size` = (h, w), at most (H, W)."""
    (height, width), (H, W) = size, maps.shape[1:]
    if height > H or width > W:
        raise ValueError(f"image must be at least size = {height}x{width} (height x width), got {H}x{W}")
    top, left, crop_height, crop_width = center_crop((H, W), size)
    return maps[:, top : top + crop_height, left : left + crop_width]


def check_frame_of_camera(camera: Camera | None, name: str, *, height: int, width: int) -> None:
    """Raise UsageError if a frame of a file has another shape than the frames of the camera."""
    try:
        if camera is not None:
            camera.resized(width=width, height=height)
    except ValueError as error:
        raise UsageError(f"camera must be that of all frames, got {name}: {error}") from error


def center_crop(frame_size: Sequence[int], size: Sequence[int]) -> tuple[int, int, int, int]:
    """Return (top, left, height, width), px, of the center of a frame (H, W) of the aspect ratio of `size` = (h, w)."""
    (H, W), (height, width) = frame_size, size
    crop_height, crop_width = min(H, round(W * height / width)), min(W, round(H * width / height))
    return (H - crop_height) // 2, (W - crop_width) // 2, crop_height, crop_width


def reduce_by_area(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Reduce maps (C, H, W), float32, to (C, h, w) of `size` = (h, w): the mean of the pixels that a pixel covers."""
    parts = []
    for part in maps.split(4):  # OpenCV takes at most 4 channels
        small = cv2.resize(part.permute(1, 2, 0).contiguous().numpy(), (size[1], size[0]), interpolation=cv2.INTER_AREA)
        parts.append(torch.from_numpy(small).view(*size, -1).permute(2, 0, 1))
    return torch.cat(parts).contiguous()


def read_header(path: str | Path, stream: BinaryIO) -> ImageHeader:
    """Read the header of an image from the stream of its file, without decoding pixels, and check its end.

    Raises:
        UnreadableImageError: the file is empty, truncated or not an image. Damage in between is detected by
            `read_image` alone.
    """
    _check_complete(path, stream)
    try:
        with Image.open(stream) as header:
            width, height = header.size
            info = header.info
            num_frames, has_alpha = getattr(header, "n_frames", 1), header.has_transparency_data
        stream.seek(0)
        head = stream.read(_PNG_DEPTH + 1)
        # Pillow's getexif decodes a whole PNG to search for EXIF data, and takes an orientation of XMP, which viewers
        # and OpenCV ignore.
        exif, tags = info.get("exif") or _late_exif(head, stream), Image.Exif()
        tags.load(exif)
        orientation = tags.get(_ORIENTATION, 1)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UnreadableImageError(f"{path} has a damaged header ({error})") from error
    bits = max(8, head[_PNG_DEPTH]) if head.startswith(_PNG) else 8
    orientation = orientation if orientation in range(1, 9) else 1  # as viewers treat invalid values
    exif = exif.removeprefix(_EXIF_PREFIX)
    return ImageHeader((height, width), orientation, bits, num_frames, has_alpha, exif, info.get("icc_profile") or b"")


def _late_exif(head: bytes, stream: BinaryIO) -> bytes:
    """Return the EXIF data of a PNG that stand behind its pixels, as ExifTool writes them; empty without."""
    if not head.startswith(_PNG):
        return b""
    stream.seek(max(0, stream.seek(0, os.SEEK_END) - _LATE_CHUNKS))
    tail = stream.read()
    start = tail.rfind(b"eXIf")
    if start < 4:
        return b""
    length = int.from_bytes(tail[start - 4 : start], "big")
    chunk, checksum = tail[start : start + 4 + length], tail[start + 4 + length : start + 8 + length]
    return chunk[4:] if zlib.crc32(chunk) == int.from_bytes(checksum, "big") else b""


def _decode(path: str | Path, data: bytes) -> np.ndarray:
    # From a file instead of memory, OpenCV would fill the missing rows of a truncated JPEG with gray.
    mode = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with _silent_opencv():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise UnreadableImageError(f"{path} cannot be decoded ({error.err})") from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError(f"{path} is damaged: its pixels cannot be decoded")
    if data.startswith(_JPEG) and lacks_pixel_data(data, pixels):
        raise UnreadableImageError(f"{path} is damaged: a part of its pixels is missing")
    return pixels


@contextmanager
def _silent_opencv() -> Iterator[None]:
    """Silence OpenCV's log, because failures raise an error."""
    # The level belongs to the process: of threads that decode at once, the first sets it, and the last restores it.
    with _LOG_LOCK:
        level = OPENCV_LOG.setLogLevel(OPENCV_SILENT)
        _log_levels.append(_log_levels[0] if _log_levels else level)
    try:
        yield
    finally:
        with _LOG_LOCK:
            level = _log_levels.pop()
            if not _log_levels:
                OPENCV_LOG.setLogLevel(level)


def _check_complete(path: str | Path, stream: BinaryIO) -> None:
    """Raise UnreadableImageError unless a stream is an image file with its end."""
    length = stream.seek(0, os.SEEK_END)
    if length == 0:
        raise UnreadableImageError(f"{path} is empty (0 bytes)")
    stream.seek(0)
    head = stream.read(16)
    if head.startswith(_JPEG):
        is_complete = _contains(stream, _JPEG_END, _scan_start(stream, length), length)
    elif head.startswith(_PNG):
        is_complete = _contains(stream, _PNG_END, 8, length)
    elif head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        is_complete = int.from_bytes(head[4:8], "little") + 8 <= length
    elif head.startswith(b"BM"):
        is_complete = length >= 26 and int.from_bytes(head[2:6], "little") <= length
    else:
        raise UnreadableImageError(f"{path} is not a JPEG, PNG, WebP or BMP image")
    if not is_complete:
        raise UnreadableImageError(f"{path} is truncated ({length} bytes, its end is missing)")


def _contains(stream: BinaryIO, marker: bytes, start: int, length: int) -> bool:
    """Return True if the marker is at `start` or later; programs may append bytes to a complete image."""
    for begin in (max(start, length - _TAIL), start):
        stream.seek(begin)
        if marker in stream.read():
            return True
    return False


def _scan_start(stream: BinaryIO, length: int) -> int:
    """Return the position of the first scan of a JPEG, or its length; a thumbnail with its own end may precede it."""
    position = 2
    while position + 4 <= length:
        stream.seek(position)
        fill, marker, high, low = stream.read(4)
        if fill != 0xFF or marker == START_OF_SCAN:
            return position
        # A marker may be preceded by any number of fill bytes 0xFF.
        position += 1 if marker == 0xFF else 2 if marker in _BARE_MARKERS else 2 + 256 * high + low
    return length
