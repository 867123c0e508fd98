"""The views of a folder of pictures of a board, kept in a file so that a run that was stopped goes on."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View, detect, is_enough
from torchrefract.cameras.calibration.diagnosis import edge_width, explain, what_instead
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, files_in, pixels_of, read_image

_VERSION = 2  # of the file; another one is not read
_MOST_OF = 0.75  # of the pictures that must be of one size
_ASKED = 3  # pictures that are asked what they show instead of the board


class Look(NamedTuple):
    """What looking for a board in a picture came to."""

    view: View
    size: tuple[int, int]  # width and height, px; (0, 0) of a file that is no picture
    edges: float  # px, the width of the sharpest edges
    reason: str  # why it is no view, or empty


def pictures_of(folder: Path) -> list[Path]:
    """The pictures of a folder, sorted by name.

    Raises:
        UsageError: a folder that does not exist or holds none.
    """
    if not folder.is_dir():
        raise UsageError(f"images must be a folder of pictures, got {folder}, which is none")
    if not (files := files_in(folder)):
        raise UsageError(f"images must be a folder that holds {', '.join(EXTENSIONS)}, got {folder}")
    return files


def read_gray(path: Path) -> np.ndarray:
    """A picture (H, W), uint8, as OpenCV makes it gray."""
    return cv2.cvtColor(pixels_of(read_image(path)), cv2.COLOR_RGB2GRAY)


def look_at(files: Sequence[Path], board: Board, kept: Path) -> Iterator[Look]:
    """What each picture shows of a board; what was found before, for the same board and file, is not looked for again.

    Args:
        files: the pictures.
        board: to look for.
        kept: the file that keeps what was found, a line of JSON a picture.
    """
    key = {"version": _VERSION, "opencv": cv2.__version__, "board": board.describe()}
    before = _read(kept, key)
    with replace_file(kept) as path:
        lines = [key, *(_as_json(look, stamp) for (_, stamp), look in before.items())]
        path.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
    with kept.open("a", encoding="utf-8") as stream:
        for file in files:
            stamp = _stamp(file)
            if (look := before.get((file.name, stamp))) is None:
                look = _look(file, board)
                stream.write(json.dumps(_as_json(look, stamp)) + "\n")
                stream.flush()
            yield look


def main_size(looks: Sequence[Look]) -> tuple[int, int]:
    """The width and height that nearly all pictures have.

    Raises:
        UsageError: pictures of several sizes, none of which most have; none that can be read.
    """
    counts = Counter(look.size for look in looks if look.size != (0, 0))
    if not counts:
        raise UsageError(f"images must hold a picture that can be read, got {len(looks)} others: {looks[0].reason}")
    (size, most), *_ = counts.most_common()
    if most < _MOST_OF * counts.total():
        found = ", ".join(f"{count} of {width} x {height}" for (width, height), count in counts.most_common())
        raise UsageError(f"images must be of one size, as those of a camera are, got {found} (width x height)")
    return size


def shown_instead(files: Sequence[Path], looks: Sequence[Look], board: Board) -> str:
    """What the first of the sharpest pictures without the board that shows something shows instead; or empty."""
    paths = {file.name: file for file in files}
    failed = sorted((look for look in looks if look.reason and look.size != (0, 0)), key=lambda look: look.edges)
    for look in failed[:_ASKED]:
        if words := what_instead(read_gray(paths[look.view.name]), board):
            return f"{look.view.name} shows {words}"
    return ""


def _look(file: Path, board: Board) -> Look:
    try:
        gray = read_gray(file)
    except UnreadableImageError as error:
        return Look(View(file.name, np.empty(0, dtype=int), np.empty((0, 2))), (0, 0), 0.0, f"no picture: {error}")
    view = detect(gray, board, name=file.name)
    reason = "" if is_enough(view, board) else explain(gray, view, board)
    return Look(view, (gray.shape[1], gray.shape[0]), edge_width(gray), reason)


def _stamp(file: Path) -> str:
    """Changes with the file; empty where there is none."""
    try:
        stat = file.stat()
    except OSError:
        return ""
    return f"{stat.st_size} {stat.st_mtime_ns}"


def _read(path: Path, key: dict[str, Any]) -> dict[tuple[str, str], Look]:
    """What a file keeps, by name and stamp; a line that a stop has cut says nothing."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    documents = [_parsed(line) for line in lines]
    if not documents or documents[0] != key:
        return {}
    found = {}
    for document in documents[1:]:
        if document is not None:
            view = View(document["name"], np.array(document["ids"], dtype=int), _points(document["corners"]))
            look = Look(view, (document["width"], document["height"]), document["edges"], document["reason"])
            found[view.name, document["stamp"]] = look
    return found


def _parsed(line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None


def _points(values: Any) -> np.ndarray:
    return np.array(values, dtype=np.float64).reshape(-1, 2)


def _as_json(look: Look, stamp: str) -> dict[str, Any]:
    view, (width, height) = look.view, look.size
    corners = {"ids": view.ids.tolist(), "corners": view.corners.tolist()}
    size = {"width": width, "height": height, "edges": look.edges, "reason": look.reason}
    return {"name": view.name, "stamp": stamp, **size, **corners}
