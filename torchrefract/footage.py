"""Pictures and videos that a command reads, changes and writes under the same names."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, count
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from torchrefract._validation import UsageError
from torchrefract.data.frames import walk
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, files_in, image_size
from torchrefract.data.media import VIDEOS, read_video, video_info, write_video

_FPS = 25.0  # of a video that does not say
_QUALITY = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95]}


def find_media(source: Path, *, deep: bool = False) -> Sequence[Path]:
    """The pictures and videos in a folder, in those below it too if `deep`, or the one that is named.

    Raises:
        UsageError: a source that is not there, or without any; two videos that would be written under one name.
    """
    if not source.exists():
        raise UsageError(f"input must be a folder, a picture or a video, got {source}, which does not exist")
    known = (*EXTENSIONS, *VIDEOS)
    inside = [source] if not source.is_dir() else sorted(walk(source)) if deep else files_in(source, known)
    files = [file for file in inside if file.suffix.lower() in known]
    if not files:
        raise UsageError(f"input must be, or hold, {', '.join(known)}, got {source}")
    names = [output_name(file) for file in files]
    if double := {str(name) for name in names if names.count(name) > 1}:
        raise UsageError(f"input must not hold two videos of one name, got {', '.join(sorted(double))}")
    return files


def check_output_folder(out: Path, source: Path, *, deep: bool = False) -> None:
    """Raise UsageError where what is written would take the place of what is read, or, if `deep`, lie among it."""
    folder = (source if source.is_dir() else source.parent).resolve()
    if out.resolve() == folder:
        raise UsageError(f"out must be another folder than that of input, got {out}")
    if deep and source.is_dir() and out.resolve().is_relative_to(folder):
        raise UsageError(f"out must be a folder that does not lie in that of input, got {out}")


def is_video(file: Path) -> bool:
    """Whether a file is a video, by its name."""
    return file.suffix.lower() in VIDEOS


def output_name(file: Path) -> Path:
    """The name that what comes of a file gets."""
    return file.with_suffix(".mp4") if is_video(file) else file


def is_complete(file: Path, target: Path, *, beside: int = 1) -> bool:
    """Whether what comes of a file is there whole: a picture with the sides, a video with the frames.

    `beside`: pictures that stand side by side in it.
    """
    if not target.is_file():
        return False
    if is_video(file):
        return video_info(target)[0] == video_info(file)[0] > 0
    try:
        height, width = image_size(file)
        return image_size(target) == (height, beside * width)
    except UnreadableImageError:
        return False


def write_picture(pixels: np.ndarray, path: Path) -> None:
    """Write (H, W, 3), uint8, RGB, in the format of the name.

    Raises:
        UsageError: a picture that the format cannot hold.
    """
    done, data = cv2.imencode(path.suffix, pixels[..., ::-1], _QUALITY.get(path.suffix.lower(), []))
    if not done:
        raise UsageError(f"{path} could not be written as {path.suffix}")
    path.write_bytes(data.tobytes())


def convert_video(file: Path, path: Path, *, change: Callable[[Iterator[Tensor]], Iterable[np.ndarray]]) -> int:
    """Write the frames of a video, changed, at the same rate; returns how many.

    Args:
        file: the video.
        path: ending in .mp4.
        change: frames (1, 3, H, W) in [0, 1] -> as many pictures, uint8, RGB, all of one size.

    Raises:
        UnreadableImageError: a video without a frame; pictures with an odd side.
    """
    pages = iter(change(frame for _, frame in read_video(file, count())))
    if (first := next(pages, None)) is None:
        raise UnreadableImageError(f"{file} is no video with a frame that can be decoded")
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise UnreadableImageError(f"{file} would give frames of {width} x {height}, and videos take even sides only")
    fps = video_info(file)[1] or _FPS
    return write_video(chain([first], pages), path, fps=fps, size=(width, height))
