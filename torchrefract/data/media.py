"""Picture and video files: find those of a folder, describe what their outputs lack, and write pictures.

Stored pixels lie in the frame of the sensor, where the geometry of a camera holds. A tag of the file (EXIF orientation,
display matrix) turns them for display. Readers take `upright`: True for the displayed frame, False for that of the
sensor. Writers keep the tag of a frame of the sensor, so that viewers show every output upright.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from torchrefract._io import is_remote
from torchrefract._validation import UsageError, first_names, warn
from torchrefract.data.frames import list_files
from torchrefract.data.images import (
    EXTENSIONS,
    OPENCV_LOG,
    OPENCV_SILENT,
    UnreadableImageError,
    describe_folders,
    exif_of_result,
    files_in,
    image_header,
    image_size,
    pixels_of,
    warn_of_unread,
)
from torchrefract.data.video import count_frames, decodable_frames, is_turned_video, video_info, video_losses

# OpenCV prints to the terminal; problems are raised as errors instead.
OPENCV_LOG.setLogLevel(OPENCV_SILENT)

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".gif", ".m4v", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".3gp")

_ENCODING = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95]}
_TAGGED = (".jpg", ".jpeg", ".png", ".webp")  # formats that hold EXIF data and color profiles


def find_media(source: Path, *, out: Path | None = None, deep: bool = False, name: str = "input") -> Sequence[Path]:
    """Find the pictures and videos of a folder, or return the one file that `source` names.

    Args:
        source: the folder or the file.
        out: folder of the outputs; None without any.
        deep: True to search the folders below `source`, too.
        name: of the option that gives `source`.

    Raises:
        UsageError: if `source` does not exist or holds no picture or video, if two videos would be written under one
            name, or if outputs would replace files of `source` or, with `deep`, be among them.
    """
    if not source.exists():
        raise UsageError(f"{name} must be a folder, a picture or a video, got {source}, which does not exist")
    suffixes = (*EXTENSIONS, *VIDEOS)
    try:
        candidates = (
            [source] if not source.is_dir() else sorted(list_files(source)) if deep else files_in(source, suffixes)
        )
    except PermissionError as error:
        raise UsageError(f"{name} must be a folder that can be read, got {error}") from error
    if deep:
        warn_of_unread(source, map(str, candidates))
    files = [file for file in candidates if file.suffix.lower() in suffixes]
    if not files:
        remedy = describe_folders(source) if not deep and source.is_dir() else ""
        raise UsageError(f"{name} must be, or hold, {', '.join(suffixes)}, got {source}{remedy}")
    names = Counter(str(output_name(file)) for file in files if is_video(file))
    if repeated := [name for name, count in names.items() if count > 1]:
        raise UsageError(f"{name} must not hold two videos of one name, got {', '.join(sorted(repeated))}")
    if out is not None and is_remote(out) == is_remote(source):
        folder = (source if source.is_dir() else source.parent).resolve()
        if out.resolve() == folder:
            raise UsageError(f"out must be another folder than that of {name}, got {out}")
        if deep and source.is_dir() and out.resolve().is_relative_to(folder):
            raise UsageError(f"out must be a folder that does not lie in that of {name}, got {out}")
    return files


def is_video(file: Path) -> bool:
    """Return True if the suffix of a file is that of a video."""
    return file.suffix.lower() in VIDEOS


def output_name(file: Path) -> Path:
    """Return the name of the output for an input file: videos become .mp4."""
    return file.with_suffix(".mp4") if is_video(file) else file


def is_complete(file: Path, target: Path, *, num_columns: int = 1) -> bool:
    """Return True if the output of a file is newer, and has its number of frames (video) or its sides (picture).

    The output of a picture may hold several, side by side. A file of a store is not read for it.
    """
    if not target.is_file() or is_remote(file):
        return target.is_file()
    if is_older(target, file):
        return False
    if is_video(file):
        num = video_info(target)[0]
        # The header of a trimmed video counts frames that are not shown, and only decoding tells damaged ones.
        return num > 0 and (num in (video_info(file)[0], count_frames(file)) or num == decodable_frames(file))
    try:
        height, width = image_size(file)
        return image_size(target) == (height, num_columns * width)
    except UnreadableImageError:
        return False


def is_older(target: Path, file: Path) -> bool:
    """Return True if a file exists and was written to after its output."""
    if not (file.is_file() and target.is_file()):
        return False
    # Cameras in another time zone date files into the future, which says nothing.
    return target.stat().st_mtime_ns < file.stat().st_mtime_ns <= time.time_ns()


def describe_losses(files: Sequence[Path], *, upright: bool) -> list[str]:
    """Describe what outputs of files will lack, one line for each kind of loss; unreadable files are ignored."""
    lossy = defaultdict[str, list[str]](list)
    for file in files:
        try:
            losses = list(video_losses(file) if is_video(file) else _picture_losses(file, upright=upright))
        except UnreadableImageError:
            continue
        for loss in dict.fromkeys(losses):
            lossy[loss].append(file.name)
    return [f"{loss}: {first_names(affected)}" for loss, affected in lossy.items()]


def describe_turned(files: Sequence[Path], *, upright: bool = False) -> str:
    """Describe the files whose tags turn the stored pixels for display; empty without such files."""
    turned = [file.name for file in files if _is_turned(file)]
    if not turned:
        return ""
    use = (
        "They are read as displayed, and so labels and a camera must be of the displayed pictures"
        if upright
        else "Their pixels are used as stored, since a camera's geometry holds in that frame"
    )
    return (
        f"{len(turned)} of {len(files)} files have a tag that turns them for display (EXIF orientation, or rotation of "
        f"a video): {first_names(turned)}. {use}"
    )


def write_picture(image: Tensor, path: Path, *, source: Path, upright: bool = True) -> None:
    """Write an image (3, H, W) in [0, 1], made from the picture `source`, in the format of the suffix.

    EXIF data, but for a thumbnail, and a color profile of `source` are kept, and 16 bits in PNG. Image and orientation
    are those of `read_image(source, upright=upright)`. Raises UsageError if the format cannot hold the picture.
    """
    header, suffix = image_header(source), path.suffix.lower()
    pixels = pixels_of(image, bits=header.bits if suffix == ".png" else 8)[..., ::-1]
    data = {cv2.IMAGE_METADATA_EXIF: exif_of_result(header, upright=upright)}
    if header.profile[16:20] == b"RGB ":  # profiles of gray or CMYK do not hold for RGB
        data[cv2.IMAGE_METADATA_ICCP] = header.profile
    kept = {kind: np.frombuffer(value, np.uint8) for kind, value in data.items() if value and suffix in _TAGGED}
    options = _ENCODING.get(suffix, [])
    is_encoded, encoded = cv2.imencodeWithMetadata(path.suffix, pixels, [*kept], [*kept.values()], options)
    if not is_encoded and kept.pop(cv2.IMAGE_METADATA_ICCP, None) is not None:
        warn(f"{source} has an invalid color profile, which is not kept")
        is_encoded, encoded = cv2.imencodeWithMetadata(path.suffix, pixels, [*kept], [*kept.values()], options)
    if not is_encoded:
        raise UsageError(f"{path} could not be written as {path.suffix}")
    path.write_bytes(encoded.tobytes())


def _is_turned(file: Path) -> bool:
    """Return True if a tag turns a file for display; False if it is unreadable."""
    try:
        return is_turned_video(file) if is_video(file) else image_header(file).orientation != 1
    except UnreadableImageError:
        return False


def _picture_losses(file: Path, *, upright: bool) -> Iterator[str]:
    header, suffix = image_header(file), file.suffix.lower()
    if header.num_frames > 1:
        yield "the first of several frames is kept"
    if header.has_alpha:
        yield "transparency is not kept"
    if header.bits > 8 and suffix != ".png":
        yield f"{header.bits} bits a channel are written as 8, since {suffix} holds no more"
    if header.orientation != 1 and not upright and suffix not in _TAGGED:
        yield f"the orientation is not kept, since {suffix} cannot hold it"
