"""A folder of clean frames, split by drive.

Neighboring frames of a drive look alike: a split by frame would test on what was trained on. So whole drives go to
training or to validation, and what a drive is follows from the folders or the file names.
"""

import hashlib
import os
import posixpath
import re
import stat
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import NamedTuple, NoReturn

import torch
from torch.utils.data import Dataset

from torchrefract._validation import check_choice, check_number, check_size
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, fit, image_size, read_image
from torchrefract.types import Frame

_SPLITS = {"train": "train", "val": "val", "valid": "val", "validation": "val"}  # names of folders that are a split
_NO_NAME = "."  # the drive of frames that lie in the root itself, or whose names are bare numbers
_BAD_SHARE = 0.1  # more unreadable frames than this are no accident
_SHOWN = 3  # examples in a message
_DATE = re.compile(r"(?:^|.*?[^0-9])(?:19|20)\d\d[-_.]?\d\d[-_.]?\d\d(?=[-_. T]?\d\d[-_.:]?\d\d[-_.:]?\d\d$)")
_NUMBERED = re.compile(r"\d[A-Za-z]?$")
_NUMBER = re.compile(r"[-_.\s\d]*\d[A-Za-z]?")


class Placed(NamedTuple):
    """Where a frame belongs."""

    path: str  # below the root, in posix form
    drive: str
    split: str  # train, val, or empty where a root with given splits has it in neither


class FrameFolder(Dataset[Frame]):
    """The frames below a folder, cut to one size, all of them or those of one split.

    Files are found in all sub-folders, hidden ones aside, and in sorted order; links are followed, each folder is
    visited once. What belongs together is a drive, and `drive_by` says how it is told:

    - "folder": a drive is a sub-folder, at the first level where the frames part into several.
    - "prefix": a drive is what `name_prefix` leaves of the file name; folders do not matter.
    - "auto": where the root has sub-folders train and val (or valid, validation), these are the splits as given.
      Otherwise by folder where the frames lie in more than one, else by prefix.

    Without given splits, drives go to val whole, in an order that depends on `seed` and their names alone, as long as
    that brings val closer to `val_share` of the frames. Neither more frames of a drive nor a renamed root changes the
    order, so a new drive moves few of the others. Recorders that cut a drive into clips make each clip a drive, by
    name: give each drive a folder.

    Every file's header and end are checked at once: unreadable ones are skipped with one warning and listed in
    `skipped`; more than a tenth of them, or a frame smaller than `size`, is an error. Pixels are read in
    `__getitem__`; its key hashes the path below `root`, so a frame keeps its corruption when others come and go.

    `size`: (height, width), px.
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
    ):
        self.root = Path(root).expanduser()
        self.size = check_size("size", size)
        check_choice("split", split, ("all", "train", "val"))
        check_choice("drive_by", drive_by, ("auto", "folder", "prefix"))
        if not 0 < check_number("val_share", val_share) < 1:
            raise ValueError(f"val_share must be a number between 0 and 1, got {val_share}")
        found = _find(self.root)
        drive_of = _select(self.root, found, split=split, drive_by=drive_by, val_share=val_share, seed=seed)
        kept, self.skipped = _check_frames(self.root, sorted(drive_of), self.size)
        self.paths = [self.root / path for path in kept]
        self.drives = sorted({drive_of[path] for path in kept})
        self.keys = [path_key(path) for path in kept]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> Frame:
        """Frame of an image (3, h, w), a key () and an empty depth, for no depth is known."""
        image = read_image(self.paths[index])
        return Frame(fit(image, self.size), torch.tensor(self.keys[index]), torch.empty(0))


def place_frames(
    root: Path, *, size: Sequence[int] | None, drive_by: str = "auto", val_share: float = 0.2, seed: int = 0
) -> tuple[list[Placed], list[tuple[Path, str]]]:
    """All frames of a root, in the order and the splits that `FrameFolder` gives them, and those that are unreadable.

    A root with a single drive, which cannot be split, is all for training. Arguments and errors as for `FrameFolder`;
    without a size, frames of any size will do.
    """
    options = {"drive_by": drive_by, "val_share": val_share, "seed": seed}
    found = _find(root)
    drive_of = _select(root, found, split="all", **options)
    kept, skipped = _check_frames(root, sorted(drive_of), (1, 1) if size is None else check_size("size", size))
    given = drive_by == "auto" and bool(_given_splits(root))
    if not given and len(set(drive_of.values())) < 2:
        return [Placed(path, drive_of[path], "train") for path in kept], skipped
    val = _select(root, found, split="val", **options)
    train = _select(root, found, split="train", **options) if given else drive_of.keys() - val.keys()
    return [Placed(p, drive_of[p], "val" if p in val else "train" if p in train else "") for p in kept], skipped


def name_prefix(stem: str) -> str:
    """The drive that a file name, without its extension, tells of: the name up to what tells one frame from the next.

    In doubt it takes off more rather than less: drives merged by mistake cost variety, a drive cut in two would put
    neighboring frames on both sides of the split.

    - A name that ends in a date and a time is cut after the date: `cam_2024-05-01_12-30-07` -> `cam_2024-05-01`.
    - Otherwise the name is a row of words, divided by `_` or blanks, or by `-` where there are none of those. It is
      cut before its last word; or, where that does not end in a digit (one letter may follow), before the last word
      that is a number, if there is one. The first word always stays: `drive-07_000123` -> `drive-07`,
      `GH010123_000456` -> `GH010123`, `2024-05-01_12-30-00_0001` -> `2024-05-01_12-30-00`,
      `aachen_000000_000019_left` -> `aachen_000000`, `highway_clear` -> `highway`.
    - A single word gives the letters before its number, `frame.0012` -> `frame`, or "." where it is nothing like it.
    """
    if date := _DATE.match(stem):
        return date.group()
    divider = r"[_\s]+" if re.search(r"[_\s]", stem.strip("_ ")) else r"-+"
    ends = [match.start() for match in re.finditer(divider, stem) if match.start() > 0]
    if not ends:
        word = re.fullmatch(r"(\D*?)[-_.\s]*\d+", stem)
        return (word and word.group(1)) or _NO_NAME
    words = {end: stem[end:following] for end, following in zip(ends, [*ends[1:], len(stem)], strict=True)}
    numbers = [end for end in ends if _NUMBER.fullmatch(words[end])]
    return stem[: ends[-1] if _NUMBERED.search(stem) or not numbers else numbers[-1]]


def _find(root: Path) -> list[str]:
    """The picture files below `root`, relative to it, in posix form, sorted."""
    try:
        is_folder = stat.S_ISDIR(root.stat().st_mode)
    except PermissionError as error:
        _refuse(error)
    except OSError as error:
        raise FileNotFoundError(f"root must be a folder of frames, got {root}, which does not exist") from error
    if not is_folder:
        raise NotADirectoryError(f"root must be a folder of frames, got the file {root}; give the folder it lies in")
    files = sorted(path.relative_to(root).as_posix() for path in walk(root))
    found = [file for file in files if file.lower().endswith(EXTENSIONS)]
    if not found:
        raise ValueError(
            f"root must hold {', '.join(EXTENSIONS)} files, got {root} with {len(files)} other files; "
            "of a video, extract the frames first"
        )
    return found


def walk(root: Path) -> Iterator[Path]:
    """The files below `root`, hidden ones aside; links are followed, each folder is visited once."""
    seen = set()
    for folder, subfolders, files in os.walk(root, followlinks=True, onerror=_refuse):
        status = os.stat(folder)
        new = (status.st_dev, status.st_ino) not in seen  # links may make a loop, or show a folder twice
        seen.add((status.st_dev, status.st_ino))
        subfolders[:] = sorted(name for name in subfolders if new and not name.startswith("."))
        yield from (Path(folder, name) for name in files if new and not name.startswith("."))


def _refuse(error: OSError) -> NoReturn:
    if isinstance(error, PermissionError):
        raise PermissionError(
            f"root must be readable with all its folders, got no permission for {error.filename}; change that"
        ) from error
    raise error


def _select(root: Path, found: list[str], *, split: str, drive_by: str, val_share: float, seed: int) -> dict[str, str]:
    """The drive of each file in the split."""
    given = _given_splits(root) if drive_by == "auto" else {}
    if given:
        return _select_given(root, found, split=split, given=given)
    drive_of = _drives(found, drive_by)
    if split == "all":
        return drive_of
    val = val_drives(root, drive_of, val_share=val_share, seed=seed)
    return {path: drive for path, drive in drive_of.items() if (drive in val) == (split == "val")}


def _given_splits(root: Path) -> dict[str, str]:
    """Split by sub-folder where `root` has both, else nothing."""
    splits = {path.name: _SPLITS[path.name.lower()] for path in root.iterdir() if path.name.lower() in _SPLITS}
    splits = {name: split for name, split in splits.items() if (root / name).is_dir()}
    return splits if len(set(splits.values())) == 2 else {}


def _select_given(root: Path, found: list[str], *, split: str, given: dict[str, str]) -> dict[str, str]:
    """Train and val by the folders of that name; frames beside them belong to "all" alone."""
    groups: dict[str, list[str]] = {"train": [], "val": [], "": []}
    for path in found:
        groups[given.get(PurePosixPath(path).parts[0], "")].append(path)
    drives = {name: _drives(group, "auto", below=1 if name else 0) for name, group in groups.items()}
    shared = sorted(set(drives["train"].values()) & set(drives["val"].values()) - {_NO_NAME})
    if shared:
        message = f"train and val in {root} both hold frames of {some(shared)}, by name; a drive belongs in one of them"
        warnings.warn(message, stacklevel=4)
    if split == "all":
        return drives["train"] | drives["val"] | drives[""]
    if not groups[split]:
        raise ValueError(f"root must hold frames in its folder for {split}, got none in {root}")
    return drives[split]


def _drives(paths: list[str], drive_by: str, *, below: int = 0) -> dict[str, str]:
    """The drive of each path; of its folders, the first `below` do not count."""
    folders = {path: PurePosixPath(path).parts[below:-1] for path in paths}
    if drive_by == "prefix" or (drive_by == "auto" and len(set(folders.values())) < 2):
        return {path: name_prefix(PurePosixPath(path).stem) for path in paths}
    # A drive's level is where the folders first part; deeper ones, as in drive_1/front and drive_1/rear, belong to it.
    level = len(PurePosixPath(posixpath.commonpath("/".join(parts) for parts in folders.values())).parts) + 1
    return {path: "/".join(parts[:level]) or _NO_NAME for path, parts in folders.items()}


def val_drives(root: Path, drive_of: Mapping[str, str], *, val_share: float, seed: int) -> set[str]:
    """The drives that go to val, by the drive of each frame.

    Raises:
        ValueError: fewer than two drives.
    """
    frames = Counter(drive_of.values())
    if len(frames) < 2:
        raise ValueError(
            f"root must hold two or more drives to be split, got one, {next(iter(frames))!r}, in {root}; put each "
            "drive in a sub-folder of its own, or name its frames <drive>_<number>, or make sub-folders train and val"
        )
    if 2 * len(frames) > len(drive_of) > _SHOWN:
        message = (
            f"{len(drive_of)} frames in {root} seem to come from {len(frames)} drives ({some(sorted(frames))}): if "
            "that is wrong, train and val share drives; put each drive in a sub-folder of its own"
        )
        warnings.warn(message, stacklevel=4)
    val, missing = set(), val_share * len(drive_of)
    order = sorted(frames, key=lambda drive: path_key(f"{seed}/{drive}"))
    for drive in order:
        if abs(missing - frames[drive]) < missing:
            val.add(drive)
            missing -= frames[drive]
    smallest = min(order, key=lambda drive: frames[drive])
    return (val or {smallest}) if len(val) < len(frames) else val - {smallest}  # each split has a drive at least


def _check_frames(root: Path, paths: list[str], size: tuple[int, int]) -> tuple[list[str], list[tuple[Path, str]]]:
    """The paths that can be read, and the others with what is wrong with them."""
    with ThreadPoolExecutor() as pool:
        results = list(pool.map(_size_or_reason, [root / path for path in paths]))
    skipped = [(root / path, result) for path, result in zip(paths, results, strict=True) if isinstance(result, str)]
    if skipped:
        examples = some([f"{path.relative_to(root).as_posix()} {reason}" for path, reason in skipped])
        if len(skipped) > _BAD_SHARE * len(paths):
            raise ValueError(
                f"root must hold readable frames, got {len(skipped)} of {len(paths)} in {root} that are not: "
                f"{examples}; remove them or copy them again"
            )
        message = f"{len(skipped)} of {len(paths)} frames in {root} cannot be read and are skipped: {examples}"
        warnings.warn(message, stacklevel=3)
    sizes = {path: result for path, result in zip(paths, results, strict=True) if not isinstance(result, str)}
    small = [f"{path} of {H}x{W}" for path, (H, W) in sizes.items() if size[0] > H or size[1] > W]
    if small:
        raise ValueError(
            f"frames must be at least size = {size[0]}x{size[1]} (height x width), got {some(small)} in {root}; "
            "ask for a smaller size or remove them"
        )
    return list(sizes), skipped


def _size_or_reason(path: Path) -> tuple[int, int] | str:
    try:
        return image_size(path)
    except UnreadableImageError as error:
        return str(error).removeprefix(f"{path} ")


def some(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def path_key(text: str) -> int:
    """A whole number below 2^63, the same on every machine; names that are no valid Unicode count by their bytes."""
    return int.from_bytes(hashlib.blake2b(os.fsencode(text), digest_size=8).digest(), "big") >> 1
