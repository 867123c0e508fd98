"""The list of the clean frames of a set: names, sizes, drives, splits and keys, scanned once and kept as Parquet."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from torchrefract._io import is_remote, read_bytes, replace_file, sizes_in_store
from torchrefract._validation import UsageError, first_names
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.frames import Source, check_sizes, evenly_spaced, list_names, select_val_drives, split_frames
from torchrefract.data.images import EXTENSIONS, warn_of_unread
from torchrefract.data.media import VIDEOS
from torchrefract.data.pairs.configuration import differences
from torchrefract.data.video import video_info
from torchrefract.random import key_of

LIST = "sources.parquet"  # the list in the folder of a set
_SAMPLES = 16  # images whose headers are read, and depth maps that are compared, before a set is started
_BATCH = 10_000  # rows that are Python objects at a time


class Sources(NamedTuple):
    """All clean frames of a root, in order, in the columns of an Arrow table, which takes about 50 bytes a frame."""

    root: Path
    table: pa.Table  # the fields of `Source`, and the key of each frame
    skipped: Sequence[str] = ()  # unreadable videos, relative to the root

    @property
    def num_frames(self) -> int:
        """The number of frames."""
        return len(self.table)

    def frame(self, index: int) -> Source:
        """Return a frame."""
        return _source(*(column[index].as_py() for column in self.table.columns[: len(Source._fields)]))

    def frames(self) -> Iterator[Source]:
        """Yield all frames."""
        for batch in self.table.to_batches(_BATCH):
            yield from map(_source, *(column.to_pylist() for column in batch.columns[: len(Source._fields)]))

    @property
    def has_one_drive(self) -> bool:
        """Return True if there is no validation split, because the frames are of one drive."""
        return len(self.table.group_by(["drive", "split"]).aggregate([])) < 2

    def limited(self, count: int) -> "Sources":
        """Keep at most `count` frames, evenly spaced."""
        if count >= self.num_frames:
            return self
        return self._replace(table=self.table.take(evenly_spaced(self.num_frames, count)))

    def digest(self) -> str:
        """Return a SHA-256 digest of the names, drives, splits and sizes of the files."""
        digest = hashlib.sha256()
        for frame in self.frames():
            digest.update(ascii([*frame]).encode())
        return digest.hexdigest()

    def depth_digests(self, depth: DepthFolder) -> dict[str, str]:
        """Return SHA-256 digests of the names and sizes of the depth maps, and of the bytes of 16 of them.

        Other maps in .npy have the same sizes. To read all of a large set would take minutes.

        Raises:
            UsageError: a frame has none, or two frames share one.
        """
        names, content = hashlib.sha256(), hashlib.sha256()
        paths = depth.check((frame.path, frame.frame) for frame in self.frames())
        for path in paths:
            names.update(ascii([path.name, depth.size_bytes(path)]).encode())
        for index in evenly_spaced(len(paths), _SAMPLES):
            content.update(read_bytes(paths[index]))
        return {"depth": names.hexdigest(), "depth_content": content.hexdigest()}

    def write(self, path: Path, options: dict[str, Any]) -> None:
        """Write the list and the options of its scan as a Parquet file."""
        about = {"options": json.dumps(options), "skipped": json.dumps(list(self.skipped))}
        # PyArrow would take a relative path with a colon for an address.
        with replace_file(path) as temporary, temporary.open("wb") as stream:
            # Small groups of rows, without a dictionary of names that differ, take little memory.
            groups: dict[str, Any] = {"row_group_size": _BATCH, "use_dictionary": ["drive", "split"]}
            pq.write_table(self.table.replace_schema_metadata(about), stream, **groups)


def read_sources(path: Path, root: Path, options: dict[str, Any]) -> Sources:
    """Read a list that `Sources.write` wrote.

    Raises:
        UsageError: the file is not such a list, or other options were given when it was written.
    """
    try:
        # A thread of PyArrow that frees the bytes while Python exits would abort the process.
        table = pq.ParquetFile(pa.BufferReader(read_bytes(path))).read(use_threads=False)
        about = {name.decode(): json.loads(text) for name, text in (table.schema.metadata or {}).items()}
        previous, skipped = about["options"], about["skipped"]
    except (pa.ArrowInvalid, ValueError, KeyError) as error:
        raise UsageError(f"files must be a list of frames that generate wrote, got {path}") from error
    if different := differences({name: previous.get(name) for name in options}, options, "there", "here"):
        raise UsageError(
            f"files must be a list of the same options, got {path}, where {different}; choose another folder"
        )
    return Sources(root, table.replace_schema_metadata(), skipped)


def find_sources(
    source: Path, *, size: tuple[int, int] | None, every: int, drive_by: str, val_share: float, seed: int
) -> Sources:
    """List the frames of a folder of images, a video or a folder of videos, with drives and splits.

    Arguments and errors are those of `FrameFolder`; with size None, images may have any size. The headers of a few
    images are read: others that turn out to be unreadable are skipped when their pair is made. Each `every`-th frame of
    a video is listed. Videos of one folder are a drive each; of several folders, each folder is a drive.

    Raises:
        UsageError: there are no images or videos, or both.
    """
    if not source.exists():
        raise UsageError(f"source must be a folder of images or videos, or a video, got {source}, which does not exist")
    if source.is_file():
        if source.suffix.lower() not in VIDEOS:
            raise UsageError(f"source must be a folder, or a video ({', '.join(VIDEOS)}), got the file {source}")
        return _find_video_frames(source.parent, {source.name: source.stat().st_size}, every, val_share, seed)
    sizes = sizes_in_store(source) if is_remote(source) else None
    files = sorted(list_names(source) if sizes is None else sizes)

    def size_of(name: str) -> int | None:
        return _size(f"{source}/{name}") if sizes is None else sizes[name]

    images, videos = ([file for file in files if file.lower().endswith(kinds)] for kinds in (EXTENSIONS, VIDEOS))
    if not images and not videos:
        warn_of_unread(source, files)
        raise UsageError(f"source must hold {', '.join((*EXTENSIONS, *VIDEOS))} files, got {source}")
    if not videos:
        options = {"drive_by": drive_by, "val_share": val_share, "seed": seed}
        frames = split_frames(source, files, split=None, **options)
        sample = [frame.path for frame in frames[:: len(frames) // _SAMPLES or 1]]
        unreadable = check_sizes(source, sample, size or (1, 1))
        if len(unreadable) == len(sample):
            reasons = first_names([f"{path} {reason}" for path, reason in unreadable.items()])
            raise ValueError(f"root must hold readable frames, got {reasons} in {source}")
        return Sources(source, table_of(frames, size_of))
    if images:
        both = f"{images[0]} and {videos[0]}"
        raise UsageError(f"source must hold images or videos, got both in {source}, such as {both}")
    return _find_video_frames(source, {name: size_of(name) for name in videos}, every, val_share, seed)


def _find_video_frames(root: Path, sizes: Mapping[str, int | None], every: int, val_share: float, seed: int) -> Sources:
    paths = list(sizes)
    counts = {path: video_info(root / path)[0] for path in paths}
    frames = [(path, index) for path in paths for index in range(0, counts[path], every)]
    if not frames:
        raise UsageError(f"source must be a video with frames, or hold one, got {root} with {first_names(paths)}")
    folders = {path: path.rpartition("/")[0] for path in paths}
    drives = folders if len(set(folders.values())) > 1 else {path: path for path in paths}
    drive_of = {f"{path}#{index}": drives[path] for path, index in frames}
    has_one_drive = len(set(drive_of.values())) < 2
    val = set() if has_one_drive else select_val_drives(root, drive_of, val_share=val_share, seed=seed)
    sources = [Source(path, drives[path] or ".", "val" if drives[path] in val else "train", i) for path, i in frames]
    return Sources(root, table_of(sources, sizes.__getitem__), [path for path, count in counts.items() if count == 0])


def draw_of(source: Source, *, seed: int, repeat: int) -> tuple[int, int]:
    """Return the seed and the key of the draw for a source that was used `repeat` times before, in a set of a seed.

    At repeat 0 they are those of the first epoch of `PairData` with the same seed, and of its validation.
    """
    key = key_of(source.name if repeat == 0 else f"{source.name}\0{repeat}")
    return (seed << 32) + (source.split != "val"), key


def table_of(frames: Sequence[Source], size_of: Callable[[str], int | None]) -> pa.Table:
    """Make the table of frames, with the size of the file of each path, and their keys."""
    columns = {
        "path": _texts([frame.path for frame in frames]),
        "drive": _texts([frame.drive for frame in frames]).dictionary_encode(),
        "split": pa.array([frame.split for frame in frames]).dictionary_encode(),
        "frame": pa.array([frame.frame for frame in frames], pa.int32()),
        "bytes": pa.array([size_of(frame.path) for frame in frames], pa.int64()),
        "key": pa.array([key_of(frame.name) for frame in frames], pa.int64()),
    }
    return pa.table(columns)


def _size(path: str) -> int | None:
    """Return the size of a file in bytes; None if it cannot be opened, which is an error when the frame is read."""
    try:
        return os.stat(path).st_size
    except OSError:
        return None


def _texts(texts: Sequence[str]) -> pa.Array:
    """Make a column of names: bytes if a name is not valid Unicode."""
    try:
        return pa.array(texts, pa.string())
    except UnicodeEncodeError:
        return pa.array(map(os.fsencode, texts), pa.binary())


def _source(path: str | bytes, drive: str | bytes, split: str, frame: int | None, size: int | None) -> Source:
    return Source(os.fsdecode(path), os.fsdecode(drive), split, frame, size)
