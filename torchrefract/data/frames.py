"""A folder of clean frames, split by drive.

Neighboring frames of a drive look alike, so a split by frame would validate on nearly the training frames. Whole drives
go to training or to validation instead. Folders or file names tell the drives apart.
"""

import os
import posixpath
import re
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import NamedTuple, NoReturn

import torch
from torch.utils.data import Dataset

from torchrefract._io import as_path, is_remote, sizes_in_store
from torchrefract._validation import check_choice, check_number, check_size, first_names, warn
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, fit, image_size, read_image, warn_of_unread
from torchrefract.random import key_of
from torchrefract.types import Frame

_SPLITS = {"train": "train", "val": "val", "valid": "val", "validation": "val"}  # folder names
_UNNAMED = "."  # the drive of frames in the root itself, or with bare numbers as names
_MAX_UNREADABLE = 0.1  # share of the frames
_REQUESTS = 32  # to a store at a time
_FEW = 3  # frames, which may be one of each drive
_DATE = re.compile(r"(?:^|.*?[^0-9])(?:19|20)\d\d[-_.]?\d\d[-_.]?\d\d(?=[-_. T]?\d\d[-_.:]?\d\d[-_.:]?\d\d$)")
_NUMBERED = re.compile(r"\d[A-Za-z]?$")
_NUMBER = re.compile(r"[-_.\s\d]*\d[A-Za-z]?")


class Source(NamedTuple):
    """A clean frame with its drive and split."""

    path: str  # relative to the root, with forward slashes
    drive: str
    split: str  # train, val, or empty for frames outside of the folders train and val
    frame: int | None = None  # index in a video
    bytes: int | None = None  # size of the file when it was listed

    @property
    def name(self) -> str:
        """A name that is unique in the root."""
        return self.path if self.frame is None else f"{self.path}#{self.frame}"


class FrameFolder(Dataset[Frame]):
    """The frames in a folder and its sub-folders, cropped and reduced to one size.

    Hidden files are ignored, links are followed, each folder is visited once, and files are sorted. `drive_by` selects
    how drives are distinguished:

    - "folder": a drive is a sub-folder, at the first level where the frames are in several folders.
    - "prefix": a drive is `name_prefix` of the file name, in any folder.
    - "auto": if the root has sub-folders train and val (or valid, validation), they are the splits. Otherwise "folder"
      if the frames are in several folders, and "prefix" if they are in one.

    Without sub-folders train and val, drives are sorted by a hash of `seed` and their names. Each goes to val if that
    brings val closer to `val_share` of the frames. A new drive therefore moves few of the others.

    The header and the end of every file are checked at once. Unreadable frames are listed in `skipped`, with one
    warning. Pixels are read on access. The key of a frame is a hash of its path relative to `root`, so that a frame
    keeps its corruption if other frames are added or removed.

    Args:
        root: the folder, or its address in a store.
        size: (height, width), px.
        split: "all", "train" or "val".
        drive_by: "auto", "folder" or "prefix".
        val_share: share of the frames in val, between 0 and 1.
        seed: of the split.
        depth: folder of depth maps of the frames, see `DepthFolder`; each frame needs one.

    Raises:
        ValueError: an argument is out of range; the folder has no frames, or has only one drive to split; more than a
            tenth of the frames are unreadable; a frame is smaller than `size`.
        OSError: the folder does not exist or is not readable.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        size: Sequence[int] = (64, 112),
        split: str = "all",
        drive_by: str = "auto",
        val_share: float = 0.2,
        seed: int = 0,
        depth: str | Path | None = None,
    ):
        self.root = as_path(root)
        self.depth = None if depth is None else DepthFolder(as_path(depth))
        self.size = check_size("size", size)
        check_choice("split", split, ("all", "train", "val"))
        check_choice("drive_by", drive_by, ("auto", "folder", "prefix"))
        if not 0 < check_number("val_share", val_share) < 1:
            raise ValueError(f"val_share must be a number between 0 and 1, got {val_share}")
        options = {"drive_by": drive_by, "val_share": val_share, "seed": seed}
        frames = split_frames(self.root, _find_files(self.root), split=split, **options)
        unreadable = _check_frames(self.root, [frame.path for frame in frames], self.size)
        self.skipped = [(self.root / path, reason) for path, reason in unreadable.items()]
        frames = [frame for frame in frames if frame.path not in unreadable]
        self.names = [frame.path for frame in frames]
        self.drive_names = [frame.drive for frame in frames]
        self.drives = sorted(set(self.drive_names))
        self.keys = [key_of(frame.path) for frame in frames]
        if self.depth is not None:
            self.depth.check((frame.path, None) for frame in frames)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def paths(self) -> list[Path]:
        """The paths of the frames."""
        return [self.root / name for name in self.names]

    def __getitem__(self, index: int) -> Frame:
        """Read a frame: image (3, h, w), key (), and its depth (1, h, w), m, or an empty one (0,)."""
        name = self.names[index]
        image, depth = read_image(self.root / name), torch.empty(0, dtype=torch.float32, device="cpu")
        if self.depth is not None:
            depth = self.depth.read(name, frame_size=(image.shape[1], image.shape[2]), size=self.size)
        return Frame(fit(image, self.size), torch.tensor(self.keys[index], device="cpu"), depth)


def split_frames(
    root: Path, files: Sequence[str], *, split: str | None, drive_by: str, val_share: float, seed: int
) -> list[Source]:
    """Assign the images among the files of a root to drives and splits, by their names alone.

    Arguments and errors are those of `FrameFolder`; files are relative to the root, with forward slashes. With split
    None, all frames are returned, and those of a root with a single drive are for training.
    """
    paths = _frames_of(root, files)
    if folders := _split_folders(root) if drive_by == "auto" else {}:
        frames = _assign_by_folder(root, paths, folders)
    else:
        drive_of, val = drives_of(paths, drive_by), set[str]()
        if split in ("train", "val") or (split is None and len(set(drive_of.values())) > 1):
            val = select_val_drives(root, drive_of, val_share=val_share, seed=seed)
        frames = [Source(path, drive, "val" if drive in val else "train") for path, drive in drive_of.items()]
    for name in ("train", "val") if folders and split is None else (split,):
        if name in ("train", "val") and name not in {frame.split for frame in frames}:
            raise ValueError(f"root must hold frames in its folder for {name}, got none in {root}")
    return sorted(frame for frame in frames if split in (None, "all", frame.split))


def evenly_spaced(total: int, count: int) -> list[int]:
    """Return at most `count` of the numbers below `total`, evenly spaced."""
    count = min(count, total)
    return [i * total // count for i in range(count)]


def name_prefix(stem: str) -> str:
    """Return the drive of a file name without extension: the name up to the number of the frame.

    In doubt, the prefix is shorter. Merged drives cost variety, but a drive cut in two would put neighboring frames on
    both sides of the split.

    - A name that ends in a date and a time is cut after the date: `cam_2024-05-01_12-30-07` -> `cam_2024-05-01`.
    - Otherwise the name is a row of words, divided by `_` or blanks, or by `-` if there are neither. It is cut before
      its last word if that ends in a digit (one letter may follow), else before the last word that is a number, else
      before the last word. The first word always stays: `drive-07_000123` -> `drive-07`,
      `GH010123_000456` -> `GH010123`, `2024-05-01_12-30-00_0001` -> `2024-05-01_12-30-00`,
      `aachen_000000_000019_left` -> `aachen_000000`, `highway_clear` -> `highway`.
    - A single word gives the letters before its number, `frame.0012` -> `frame`, or "." if there are none.
    """
    if date := _DATE.match(stem):
        return date.group()
    divider = r"[_\s]+" if re.search(r"[_\s]", stem.strip("_ ")) else r"-+"
    ends = [match.start() for match in re.finditer(divider, stem) if match.start() > 0]
    if not ends:
        word = re.fullmatch(r"(\D*?)[-_.\s]*\d+", stem)
        return (word and word.group(1)) or _UNNAMED
    words = {end: stem[end:following] for end, following in zip(ends, [*ends[1:], len(stem)], strict=True)}
    numbers = [end for end in ends if _NUMBER.fullmatch(words[end])]
    return stem[: ends[-1] if _NUMBERED.search(stem) or not numbers else numbers[-1]]


def _find_files(root: Path) -> list[str]:
    """List the files of a root: sorted paths relative to it, with forward slashes."""
    if is_remote(root):  # which has no folders without files
        if root.is_file() or not root.exists():
            problem = "is a file" if root.is_file() else "does not exist"
            raise FileNotFoundError(f"root must be a folder of frames, got {root}, which {problem}")
        return sorted(list_names(root))
    try:
        is_folder = stat.S_ISDIR(root.stat().st_mode)
    except PermissionError as error:
        _raise_permission_error(error)
    except OSError as error:
        raise FileNotFoundError(f"root must be a folder of frames, got {root}, which does not exist") from error
    if not is_folder:
        raise NotADirectoryError(f"root must be a folder of frames, got the file {root}; give the folder it lies in")
    return sorted(list_names(root))


def _frames_of(root: Path, files: Sequence[str]) -> list[str]:
    """Return the files that are images; raise ValueError if there are none."""
    warn_of_unread(root, files)
    frames = [file for file in files if file.lower().endswith(EXTENSIONS)]
    if not frames:
        raise ValueError(
            f"root must hold {', '.join(EXTENSIONS)} files, got {root} with {len(files)} other files; "
            "of a video, extract the frames first"
        )
    return frames


def list_files(root: Path) -> Iterator[Path]:
    """Yield the files of a root and its sub-folders without hidden ones; follow links, visit each folder once."""
    return (root / name for name in list_names(root))


def list_names(root: Path) -> Iterator[str]:
    """Yield the names of the files of `list_files` relative to the root, with forward slashes."""
    if is_remote(root):
        yield from sizes_in_store(root)
        return
    visited, starts = set(), [str(root)]
    for start in starts:  # links come last, so that files have the names of their folders and not of a link to them
        for folder, subfolders, files in os.walk(start, onerror=_raise_permission_error):
            status = os.stat(folder)
            is_new = (status.st_dev, status.st_ino) not in visited  # links may form a loop, or lead to a folder twice
            visited.add((status.st_dev, status.st_ino))
            subfolders[:] = sorted(name for name in subfolders if is_new and not name.startswith("."))
            starts += filter(os.path.islink, [os.path.join(folder, name) for name in subfolders])
            inner = Path(folder).relative_to(root).as_posix()
            prefix = "" if inner == "." else f"{inner}/"
            # A path object for each file would take longer than the scan.
            yield from (prefix + name for name in files if is_new and not name.startswith("."))


def _raise_permission_error(error: OSError) -> NoReturn:
    if isinstance(error, PermissionError):
        raise PermissionError(
            f"root must be readable with all its folders, got no permission for {error.filename}; change that"
        ) from error
    raise error


def _split_folders(root: Path) -> dict[str, str]:
    """Return the split of each sub-folder named train or val; empty unless the root has both."""
    splits = {path.name: _SPLITS[path.name.lower()] for path in root.iterdir() if path.name.lower() in _SPLITS}
    splits = {name: split for name, split in splits.items() if (root / name).is_dir()}
    return splits if len(set(splits.values())) == 2 else {}


def _assign_by_folder(root: Path, paths: list[str], folders: dict[str, str]) -> list[Source]:
    """Assign frames to the splits of their folders; frames outside of both belong to "all" alone."""
    groups: dict[str, list[str]] = {"train": [], "val": [], "": []}
    for path in paths:
        groups[folders.get(path.split("/")[0], "")].append(path)
    drives = {name: drives_of(group, "auto", skip_levels=1 if name else 0) for name, group in groups.items()}
    shared = sorted(set(drives["train"].values()) & set(drives["val"].values()) - {_UNNAMED})
    if shared:
        names = first_names(shared)
        warn(f"train and val in {root} both hold frames of {names}, by name; a drive belongs in one of them")
    return [Source(path, drive, split) for split, group in drives.items() for path, drive in group.items()]


def drives_of(paths: list[str], drive_by: str, *, skip_levels: int = 0) -> dict[str, str]:
    """Return the drive of each path, without regard to its first `skip_levels` folders; see `FrameFolder`."""
    # Of the folders, which are few, so that paths of a drive share one text.
    folders = {
        folder: f"{folder}/".split("/")[skip_levels:-1] for folder in {path.rpartition("/")[0] for path in paths}
    }
    if drive_by == "prefix" or (drive_by == "auto" and len(set(map(tuple, folders.values()))) < 2):
        return {path: name_prefix(posixpath.splitext(posixpath.basename(path))[0]) for path in paths}
    # Deeper folders, as in drive_1/front and drive_1/rear, belong to the same drive.
    level = len(PurePosixPath(posixpath.commonpath("/".join(parts) for parts in folders.values())).parts) + 1
    drives = {folder: "/".join(parts[:level]) or _UNNAMED for folder, parts in folders.items()}
    return {path: drives[path.rpartition("/")[0]] for path in paths}


def select_val_drives(root: Path, drive_of: Mapping[str, str], *, val_share: float, seed: int) -> set[str]:
    """Select the drives of val from the drive of each frame; raises ValueError if there are fewer than two."""
    frames = Counter(drive_of.values())
    if len(frames) < 2:
        raise ValueError(
            f"root must hold two or more drives to be split, got one, {next(iter(frames))!r}, in {root}; put each "
            "drive in a sub-folder of its own, or name its frames <drive>_<number>, or make sub-folders train and val"
        )
    if 2 * len(frames) > len(drive_of) > _FEW:
        names = first_names(sorted(frames))
        warn(
            f"{len(drive_of)} frames in {root} seem to come from {len(frames)} drives ({names}): if that is wrong, "
            "train and val share drives; put each drive in a sub-folder of its own"
        )
    val, missing = set(), val_share * len(drive_of)
    order = sorted(frames, key=lambda drive: key_of(f"{seed}/{drive}"))
    for drive in order:
        if abs(missing - frames[drive]) < missing:
            val.add(drive)
            missing -= frames[drive]
    smallest = min(order, key=lambda drive: frames[drive])
    return (val or {smallest}) if len(val) < len(frames) else val - {smallest}  # each split has at least one drive


def _check_frames(root: Path, paths: list[str], size: tuple[int, int]) -> dict[str, str]:
    """Return the result of `check_sizes`; warn of unreadable frames, and raise ValueError if they are many."""
    if unreadable := check_sizes(root, paths, size):
        examples = first_names([f"{path} {reason}" for path, reason in unreadable.items()])
        if len(unreadable) > _MAX_UNREADABLE * len(paths):
            raise ValueError(
                f"root must hold readable frames, got {len(unreadable)} of {len(paths)} in {root} that are unreadable: "
                f"{examples}; remove them or copy them again"
            )
        warn(f"{len(unreadable)} of {len(paths)} frames in {root} cannot be read and are skipped: {examples}")
    return unreadable


def check_sizes(root: Path, paths: Sequence[str], size: tuple[int, int]) -> dict[str, str]:
    """Return why frames are unreadable, by path; raise ValueError if one of the others is smaller than `size`."""
    with ThreadPoolExecutor(_REQUESTS if is_remote(root) else None) as pool:
        results = dict(zip(paths, pool.map(_size_or_reason, [root / path for path in paths]), strict=True))
    unreadable = {path: result for path, result in results.items() if isinstance(result, str)}
    sizes = {path: result for path, result in results.items() if not isinstance(result, str)}
    if small := [f"{path} of {H}x{W}" for path, (H, W) in sizes.items() if size[0] > H or size[1] > W]:
        raise ValueError(
            f"frames must be at least size = {size[0]}x{size[1]} (height x width), got {first_names(small)} in {root}; "
            "choose a smaller size or remove them"
        )
    return unreadable


def _size_or_reason(path: Path) -> tuple[int, int] | str:
    try:
        return image_size(path)
    except UnreadableImageError as error:
        return str(error).removeprefix(f"{path} ")
