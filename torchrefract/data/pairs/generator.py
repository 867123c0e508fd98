"""Generation of one pair: list clean frames, read one, degrade it by its own draw, encode the files."""

import hashlib
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import UsageError
from torchrefract.data.frames import assign_frames, list_files, path_key, select_val_drives
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, as_image, fit, pixels_of, read_pixels
from torchrefract.data.media import VIDEOS, read_video, video_info
from torchrefract.data.pairs.files import FLOWS, LIGHTS, PairArrays, count_out_of_range, encode_pair
from torchrefract.data.pairs.manifest import PairRow, StoredFile
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.types import Degraded


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


@dataclass(frozen=True)
class GenerationConfig:
    """Everything that a pair depends on, apart from its number and its frame.

    Args:
        effect: degrades the frames.
        scene: name of the effect.
        root: folder of the frames.
        size: (height, width), px, to crop and reduce frames to; None keeps their size.
        seed: of the draws.
        maps: format of the maps: "png", "npz" or "safetensors".
    """

    effect: Effect
    scene: str
    root: Path
    size: tuple[int, int] | None
    seed: int
    maps: str


class PairTask(NamedTuple):
    """A pair to generate."""

    number: int
    source: Source
    repeat: int  # how many times the source was used before


class GeneratedPair(NamedTuple):
    """An encoded pair."""

    row: PairRow  # its files have no path yet
    data: dict[str, bytes]  # content of each file by the suffix of its name; empty if the frame was skipped


class PairGenerator:
    """Generates pairs on the CPU, one at a time, so that a pair has the same bytes in any order and process."""

    def __init__(self, config: GenerationConfig):
        self.config = config
        self._reader = SourceReader(config.root, config.size)

    def generate(self, task: PairTask) -> GeneratedPair:
        """Generate a pair. An unreadable frame gives a row with the reason and no files.

        Raises:
            UsageError: the scene, the size or the format of the maps does not suit the frame.
        """
        config = self.config
        try:
            image, pixels = self._reader.read(task.source)
        except UnreadableImageError as error:
            return GeneratedPair(self._row(task, (0, 0), skipped=str(error).replace(f"{config.root}/", "")), {})
        except ValueError as error:
            raise UsageError(f"size: {error}") from error
        seed, key = draw_of(task.source, seed=config.seed, repeat=task.repeat)
        try:
            with warnings.catch_warnings(), torch.no_grad():
                warnings.simplefilter("ignore", UserWarning)  # of folded pixels, which the masks exclude
                degraded = config.effect.degrade(image[None], seed=seed, keys=[key])
        except (ValueError, TypeError, OSError) as error:
            raise UsageError(f"scene: {error}") from error
        pair = PairArrays(pixels, pixels_of(degraded.image[0]), _maps(degraded))
        try:
            data = encode_pair(pair, config.maps)
        except ValueError as error:
            raise UsageError(f"maps: {error}") from error
        row = self._row(
            task,
            (image.shape[1], image.shape[2]),
            effects=applied_effects(config.effect, degraded.params),
            beyond=_count_out_of_range(pair) if config.maps == "png" else {},
            files={name: StoredFile("", len(x), hashlib.sha256(x).hexdigest()) for name, x in data.items()},
        )
        return GeneratedPair(row, data)

    def _row(self, task: PairTask, size: tuple[int, int], **rest: Any) -> PairRow:
        seed, key = draw_of(task.source, seed=self.config.seed, repeat=task.repeat)
        source, (height, width) = task.source, size
        origin = (source.path, source.frame, source.drive, source.split)
        empty: dict[str, Any] = {"effects": [], "beyond": {}, "files": {}}
        return PairRow(task.number, *origin, self.config.scene, seed, key, height, width, **(empty | rest))


def applied_effects(effect: Effect, params: Any) -> list[dict[str, Any]]:
    """Return the name and the parameters of each effect that was applied to the first sample, in order."""
    leaves = effect.effects_with_params(params) if isinstance(effect, Compose) else [(effect, params)]
    return [
        {"effect": type(leaf).__name__}
        | {name: _plain(value[0].tolist()) for name, value in values._asdict().items() if name != "applied"}
        for leaf, values in leaves
        if values.applied[0]
    ]


def _plain(value: Any) -> Any:
    """Replace infinite numbers by words, because JSON has no infinity."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _maps(degraded: Degraded) -> dict[str, np.ndarray]:
    maps = {"valid": degraded.valid[0, 0].numpy()}
    if degraded.has("flow"):
        maps["restore_valid"] = degraded.restore_valid[0, 0].numpy()
        maps |= {name: getattr(degraded, name)[0].float().numpy() for name in FLOWS}
    return maps | {name: getattr(degraded, name)[0, 0].float().numpy() for name in LIGHTS if degraded.has(name)}


def _count_out_of_range(pair: PairArrays) -> dict[str, int]:
    maps = pair.maps
    counts = {name: count_out_of_range(maps[name], maps[mask]) for name, mask in FLOWS.items() if name in maps}
    return {name: count for name, count in counts.items() if count}
