"""Videos read frame by frame, and written as MPEG-4."""

import errno
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import to_float
from torchrefract.data.images import opened

# OpenCV and its FFmpeg write to the terminal on their own; what goes wrong is raised as an error.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".gif")


def read_video(path: Path, times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
    """The frames of a video at times that rise, (1, 3, H, W) in [0, 1], until it ends."""
    _check_opens(path)
    # By its whole path, since FFmpeg takes what is before a colon for a protocol.
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


def video_facts(path: Path) -> tuple[int, float]:
    """How many frames a video says that it has, and how many a second; zero for what is no video."""
    _check_opens(path)
    capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    count, fps = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    capture.release()
    # For what it cannot open FFmpeg says -1.
    return max(0, round(count)), max(0.0, fps)


def write_video(pages: Iterable[np.ndarray], path: Path, *, fps: float, size: tuple[int, int]) -> int:
    """Pictures (H, W, 3), uint8, RGB, as a video; returns how many.

    Args:
        pages: all of one size.
        path: ending in .mp4.
        fps: frames a second.
        size: width and height, px, both even.

    Raises:
        OSError: a file that does not hold them all, as on a full disk.
    """
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    count = 0
    try:
        for page in pages:
            writer.write(page[..., ::-1])
            count += 1
    finally:
        writer.release()
    # OpenCV says nothing when it fails.
    if video_facts(path)[0] != count:
        raise OSError(errno.EIO, "the video is not whole, as on a full disk")
    return count


def _check_opens(path: Path) -> None:
    with opened(path):
        return
