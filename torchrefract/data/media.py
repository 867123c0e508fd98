"""Picture and video files: find those of a folder, read videos frame by frame, write pictures and videos."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, count
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import to_float
from torchrefract._validation import UsageError
from torchrefract.data.frames import list_files
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, files_in, image_size, opened

# OpenCV and its FFmpeg print to the terminal; problems are raised as errors instead.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".gif")

_DEFAULT_FPS = 25.0  # of a video whose header has no rate
_ENCODING = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95]}


def find_media(source: Path, *, deep: bool = False) -> Sequence[Path]:
    """Find the pictures and videos of a folder, or return the one file that `source` names.

    With `deep`, the folders below it are searched too.

    Raises:
        UsageError: if `source` does not exist or holds no picture or video, or if two videos would be written under one
            name.
    """
    if not source.exists():
        raise UsageError(f"input must be a folder, a picture or a video, got {source}, which does not exist")
    suffixes = (*EXTENSIONS, *VIDEOS)
    candidates = [source] if not source.is_dir() else sorted(list_files(source)) if deep else files_in(source, suffixes)
    files = [file for file in candidates if file.suffix.lower() in suffixes]
    if not files:
        raise UsageError(f"input must be, or hold, {', '.join(suffixes)}, got {source}")
    names = [output_name(file) for file in files]
    if repeated := {str(name) for name in names if names.count(name) > 1}:
        raise UsageError(f"input must not hold two videos of one name, got {', '.join(sorted(repeated))}")
    return files


def check_output_folder(out: Path, source: Path, *, deep: bool = False) -> None:
    """Raise UsageError if files in `out` would replace those of `source` or, if `deep`, be among them."""
    folder = (source if source.is_dir() else source.parent).resolve()
    if out.resolve() == folder:
        raise UsageError(f"out must be another folder than that of input, got {out}")
    if deep and source.is_dir() and out.resolve().is_relative_to(folder):
        raise UsageError(f"out must be a folder that does not lie in that of input, got {out}")


def is_video(file: Path) -> bool:
    """Return True if the suffix of a file is that of a video."""
    return file.suffix.lower() in VIDEOS


def output_name(file: Path) -> Path:
    """Return the name of the output for an input file: videos become .mp4."""
    return file.with_suffix(".mp4") if is_video(file) else file


def is_complete(file: Path, target: Path, *, num_columns: int = 1) -> bool:
    """Return True if the output of a file exists and has its number of frames (video) or its sides (picture).

    The output of a picture may hold several, side by side.
    """
    if not target.is_file():
        return False
    if is_video(file):
        return video_info(target)[0] == video_info(file)[0] > 0
    try:
        height, width = image_size(file)
        return image_size(target) == (height, num_columns * width)
    except UnreadableImageError:
        return False


def write_picture(pixels: np.ndarray, path: Path) -> None:
    """Write (H, W, 3), uint8, RGB, in the format of the suffix; raises UsageError if it cannot hold the picture."""
    is_encoded, data = cv2.imencode(path.suffix, pixels[..., ::-1], _ENCODING.get(path.suffix.lower(), []))
    if not is_encoded:
        raise UsageError(f"{path} could not be written as {path.suffix}")
    path.write_bytes(data.tobytes())


def read_video(path: Path, times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
    """Read the frames of a video with rising numbers, until it ends.

    Yields:
        the frame number, and the frame (1, 3, H, W), float32 in [0, 1], RGB.
    """
    _check_opens(path)
    # FFmpeg takes the part of a relative path before a colon for a protocol.
    capture, position = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG), 0
    try:
        for t in times:
            while position < t + 1:
                if not capture.grab():
                    return
                position += 1
            pixels = torch.from_numpy(capture.retrieve()[1][..., ::-1].copy())
            yield t, to_float(pixels.permute(2, 0, 1)[None].contiguous())
    finally:
        capture.release()


def video_info(path: Path) -> tuple[int, float]:
    """Return the number of frames and the frames per second of a video's header; zeros if the file is not a video."""
    _check_opens(path)
    capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    num_frames, fps = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    capture.release()
    # FFmpeg answers -1 for a file that it cannot open.
    return max(0, round(num_frames)), max(0.0, fps)


def write_video(pictures: Iterable[np.ndarray], path: Path, *, fps: float, size: tuple[int, int]) -> int:
    """Write pictures as an MPEG-4 video, one by one; return their number.

    Args:
        pictures: (H, W, 3), uint8, RGB, all of one size.
        path: ending in .mp4.
        fps: frames per second.
        size: (width, height), px, both even.

    Raises:
        OSError: if the file does not hold all frames, as on a full disk.
    """
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    num_frames = 0
    try:
        for picture in pictures:
            writer.write(picture[..., ::-1])
            num_frames += 1
    finally:
        writer.release()
    # OpenCV does not report a failed write.
    if video_info(path)[0] != num_frames:
        raise OSError(errno.EIO, "the video is incomplete; the disk may be full")
    return num_frames


def convert_video(source: Path, path: Path, *, change: Callable[[Iterator[Tensor]], Iterable[np.ndarray]]) -> int:
    """Write the changed frames of a video at its rate; return their number.

    Args:
        source: the video.
        path: of the new video, ending in .mp4.
        change: takes frames (1, 3, H, W) in [0, 1], gives as many pictures (H, W, 3), uint8, RGB, all of one size.

    Raises:
        UnreadableImageError: if no frame can be decoded, or a side of the pictures is odd.
    """
    pictures = iter(change(frame for _, frame in read_video(source, count())))
    if (first := next(pictures, None)) is None:
        raise UnreadableImageError(f"{source} is not a video with a frame that can be decoded")
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise UnreadableImageError(f"{source} would give frames of {width} x {height}, and videos take even sides only")
    fps = video_info(source)[1] or _DEFAULT_FPS
    return write_video(chain([first], pictures), path, fps=fps, size=(width, height))


def _check_opens(path: Path) -> None:
    with opened(path):
        return
