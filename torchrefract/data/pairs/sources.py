"""Where clean frames come from: a folder of pictures, a video, or a folder of videos."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchrefract._validation import UsageError
from torchrefract.data.frame_folder import path_key, place_frames, val_drives, walk
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, as_image, fit, pixels_of, read_pixels
from torchrefract.data.media import VIDEOS, read_video, video_info


class Source(NamedTuple):
    """A clean frame."""

    path: str  # below the root, in posix form
    drive: str
    split: str  # train or val; empty where given splits hold it in neither
    frame: int | None = None  # number in a video

    @property
    def name(self) -> str:
        """Tells it from all other frames of the root."""
        return self.path if self.frame is None else f"{self.path}#{self.frame}"


class Sources(NamedTuple):
    """All clean frames of a root, in their order."""

    root: Path
    frames: Sequence[Source]
    skipped: Sequence[str]  # files that cannot be read, below the root
    alone: bool  # whether there is a single drive, which cannot be split

    def thinned(self, count: int) -> "Sources":
        """So many of them at most, out of all parts of their order."""
        total = len(self.frames)
        return self._replace(
            frames=self.frames if count >= total else [self.frames[i * total // count] for i in range(count)]
        )

    def digest(self) -> str:
        """Changes with the names, drives, splits and sizes of the files."""
        whole = hashlib.sha256()
        sizes = {path: (self.root / path).stat().st_size for path in {frame.path for frame in self.frames}}
        for frame in self.frames:
            whole.update(ascii([*frame, sizes[frame.path]]).encode())
        return whole.hexdigest()


class Reader:
    """Reads frames, of a video best in their order."""

    def __init__(self, root: Path, size: tuple[int, int] | None):
        self.root, self.size = root, size
        self._wanted = 0
        self._open: tuple[str, int, Iterator[tuple[int, Tensor]]] | None = None  # a video, its last frame, the others

    def read(self, source: Source) -> tuple[Tensor, np.ndarray]:
        """The frame, cut and reduced to the size if there is one.

        Returns:
            image: (3, H, W), float32 in [0, 1].
            pixels: (H, W, 3), uint8, the same.

        Raises:
            UnreadableImageError: a damaged file, or a video that ends before the frame.
        """
        if source.frame is not None:
            image = self._fitting(self._video(source.path, source.frame))
            return image, pixels_of(image)
        pixels = read_pixels(self.root / source.path)
        image = self._fitting(as_image(pixels))
        as_it_was = pixels.dtype == np.uint8 and pixels.shape[:2] == image.shape[1:]
        return image, pixels if as_it_was else pixels_of(image)

    def _fitting(self, image: Tensor) -> Tensor:
        return image.contiguous() if self.size is None else fit(image, self.size)

    def _video(self, path: str, frame: int) -> Tensor:
        if self._open is None or self._open[0] != path or self._open[1] >= frame:
            self._open = (path, -1, read_video(self.root / path, self._times()))
        frames, self._wanted = self._open[2], frame
        self._open = (path, frame, frames)
        if (found := next(frames, None)) is None:
            self._open = None
            raise UnreadableImageError(f"{self.root / path} ends before its frame {frame}")
        return found[1][0]

    def _times(self) -> Iterator[int]:
        while True:
            yield self._wanted


def find_sources(
    source: Path, *, size: tuple[int, int] | None, every: int, drive_by: str, val_share: float, seed: int
) -> Sources:
    """The frames of a folder of pictures, of a video or of a folder of videos, with drives and splits.

    Args:
        source: the folder or the video.
        size: (height, width), px, that pictures must have at least.
        every: of a video each frame of that many is one.
        drive_by, val_share, seed: as for `FrameFolder`; a video without others in its folder is a drive.

    Raises:
        UsageError: nothing of the kind, or both kinds.
        ValueError, OSError: what `FrameFolder` raises.
    """
    if not source.exists():
        raise UsageError(
            f"source must be a folder of pictures or videos, or a video, got {source}, which does not exist"
        )
    if source.is_file():
        if source.suffix.lower() not in VIDEOS:
            raise UsageError(f"source must be a folder, or a video ({', '.join(VIDEOS)}), got the file {source}")
        return _videos(source.parent, [source.name], every, val_share, seed)
    files = sorted(path.relative_to(source).as_posix() for path in walk(source))
    videos = [file for file in files if file.lower().endswith(VIDEOS)]
    if not videos:
        placed, skipped = place_frames(source, size=size, drive_by=drive_by, val_share=val_share, seed=seed)
        alone = len({(frame.drive, frame.split) for frame in placed}) < 2
        names = [path.relative_to(source).as_posix() for path, _ in skipped]
        return Sources(source, [Source(*frame) for frame in placed], names, alone)
    if pictures := [file for file in files if file.lower().endswith(EXTENSIONS)]:
        both = f"{pictures[0]} and {videos[0]}"
        raise UsageError(f"source must hold pictures or videos, got both in {source}, such as {both}")
    return _videos(source, videos, every, val_share, seed)


def _videos(root: Path, paths: Sequence[str], every: int, val_share: float, seed: int) -> Sources:
    counts = {path: video_info(root / path)[0] for path in paths}
    frames = [(path, t) for path in paths for t in range(0, counts[path], every)]
    if not frames:
        raise UsageError(f"source must be a video with frames, or hold one, got {root} with {', '.join(paths[:3])}")
    folders = {path: path.rpartition("/")[0] for path in paths}
    drives = folders if len(set(folders.values())) > 1 else {path: path for path in paths}
    drive_of = {f"{path}#{t}": drives[path] for path, t in frames}
    several = len(set(drive_of.values())) > 1
    val = val_drives(root, drive_of, val_share=val_share, seed=seed) if several else set()
    found = [Source(path, drives[path] or ".", "val" if drives[path] in val else "train", t) for path, t in frames]
    return Sources(root, found, [path for path, count in counts.items() if count == 0], not several)


def draw_of(source: Source, *, seed: int, lap: int) -> tuple[int, int]:
    """The seed and the key of the draw for a source that is used the (1 + lap)-th time.

    In the first lap they are those of the first epoch of training on the fly, and of its validation.
    """
    key = path_key(source.name if lap == 0 else f"{source.name}\0{lap}")
    return (seed << 32) + (source.split != "val"), key
