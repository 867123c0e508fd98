"""Clean frames for pairs: a folder of images, a video, or a folder of videos."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchrefract._validation import UsageError
from torchrefract.data.frames import assign_frames, list_files, path_key, select_val_drives
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, as_image, fit, pixels_of, read_pixels
from torchrefract.data.media import VIDEOS, read_video, video_info


class Source(NamedTuple):
    """A clean frame."""

    path: str  # relative to the root, with forward slashes
    drive: str
    split: str  # train, val, or empty for frames outside of the folders train and val
    frame: int | None = None  # index in a video

    @property
    def name(self) -> str:
        """A name that is unique in the root."""
        return self.path if self.frame is None else f"{self.path}#{self.frame}"


class Sources(NamedTuple):
    """All clean frames of a root, in order."""

    root: Path
    frames: Sequence[Source]
    skipped: Sequence[str]  # unreadable files, relative to the root
    has_one_drive: bool  # so that there is no validation split

    def limited(self, count: int) -> "Sources":
        """Keep at most `count` frames, evenly spaced."""
        total = len(self.frames)
        if count >= total:
            return self
        return self._replace(frames=[self.frames[i * total // count] for i in range(count)])

    def digest(self) -> str:
        """Return a SHA-256 digest of the names, drives, splits and sizes of the files."""
        digest = hashlib.sha256()
        sizes = {path: (self.root / path).stat().st_size for path in {frame.path for frame in self.frames}}
        for frame in self.frames:
            digest.update(ascii([*frame, sizes[frame.path]]).encode())
        return digest.hexdigest()


class SourceReader:
    """Reads clean frames. Frames of a video are read fastest in their order.

    Args:
        root: folder of the sources.
        size: (height, width), px, to crop and reduce frames to; None keeps their size.
    """

    def __init__(self, root: Path, size: tuple[int, int] | None):
        self.root, self.size = root, size
        self._next_index = 0
        self._video: tuple[str, int, Iterator[tuple[int, Tensor]]] | None = None  # path, last index, further frames

    def read(self, source: Source) -> tuple[Tensor, np.ndarray]:
        """Read a frame.

        Returns:
            image: (3, H, W), float32, in [0, 1].
            pixels: (H, W, 3), uint8, the image rounded to 8 bits.

        Raises:
            UnreadableImageError: the file is damaged, or the video ends before the frame.
        """
        if source.frame is not None:
            image = self._fit(self._read_video(source.path, source.frame))
            return image, pixels_of(image)
        pixels = read_pixels(self.root / source.path)
        image = self._fit(as_image(pixels))
        is_unchanged = pixels.dtype == np.uint8 and pixels.shape[:2] == image.shape[1:]
        return image, pixels if is_unchanged else pixels_of(image)

    def _fit(self, image: Tensor) -> Tensor:
        return image.contiguous() if self.size is None else fit(image, self.size)

    def _read_video(self, path: str, index: int) -> Tensor:
        if self._video is None or self._video[0] != path or self._video[1] >= index:
            self._video = (path, -1, read_video(self.root / path, self._indices()))
        frames, self._next_index = self._video[2], index
        self._video = (path, index, frames)
        frame = next(frames, None)
        if frame is None:
            self._video = None
            raise UnreadableImageError(f"{self.root / path} ends before its frame {index}")
        return frame[1][0]

    def _indices(self) -> Iterator[int]:
        while True:
            yield self._next_index


def find_sources(
    source: Path, *, size: tuple[int, int] | None, every: int, drive_by: str, val_share: float, seed: int
) -> Sources:
    """List the frames of a folder of images, a video or a folder of videos, with drives and splits.

    Args:
        source: the folder or the video.
        size: smallest (height, width) of images, px; None for no limit.
        every: step between the frames of a video.
        drive_by, val_share, seed: as for `FrameFolder`. Videos of one folder are a drive each; of several folders, each
            folder is a drive.

    Raises:
        UsageError: there are no images or videos, or both.
        ValueError, OSError: as of `FrameFolder`.
    """
    if not source.exists():
        raise UsageError(f"source must be a folder of images or videos, or a video, got {source}, which does not exist")
    if source.is_file():
        if source.suffix.lower() not in VIDEOS:
            raise UsageError(f"source must be a folder, or a video ({', '.join(VIDEOS)}), got the file {source}")
        return _find_video_frames(source.parent, [source.name], every, val_share, seed)
    files = sorted(path.relative_to(source).as_posix() for path in list_files(source))
    videos = [file for file in files if file.lower().endswith(VIDEOS)]
    if not videos:
        frames, skipped = assign_frames(source, size=size, drive_by=drive_by, val_share=val_share, seed=seed)
        has_one_drive = len({(frame.drive, frame.split) for frame in frames}) < 2
        names = [path.relative_to(source).as_posix() for path, _ in skipped]
        return Sources(source, [Source(*frame) for frame in frames], names, has_one_drive)
    if images := [file for file in files if file.lower().endswith(EXTENSIONS)]:
        both = f"{images[0]} and {videos[0]}"
        raise UsageError(f"source must hold images or videos, got both in {source}, such as {both}")
    return _find_video_frames(source, videos, every, val_share, seed)


def _find_video_frames(root: Path, paths: Sequence[str], every: int, val_share: float, seed: int) -> Sources:
    counts = {path: video_info(root / path)[0] for path in paths}
    frames = [(path, index) for path in paths for index in range(0, counts[path], every)]
    if not frames:
        raise UsageError(f"source must be a video with frames, or hold one, got {root} with {', '.join(paths[:3])}")
    folders = {path: path.rpartition("/")[0] for path in paths}
    drives = folders if len(set(folders.values())) > 1 else {path: path for path in paths}
    drive_of = {f"{path}#{index}": drives[path] for path, index in frames}
    has_one_drive = len(set(drive_of.values())) < 2
    val = set() if has_one_drive else select_val_drives(root, drive_of, val_share=val_share, seed=seed)
    sources = [Source(path, drives[path] or ".", "val" if drives[path] in val else "train", i) for path, i in frames]
    return Sources(root, sources, [path for path, count in counts.items() if count == 0], has_one_drive)


def draw_of(source: Source, *, seed: int, repeat: int) -> tuple[int, int]:
    """Return the seed and the key of the draw for a source.

    At repeat 0 they are those of the first epoch of `PairData` with the same seed, and of its validation.

    Args:
        source: the frame.
        seed: of the set.
        repeat: how many times the source was used before.
    """
    key = path_key(source.name if repeat == 0 else f"{source.name}\0{repeat}")
    return (seed << 32) + (source.split != "val"), key
