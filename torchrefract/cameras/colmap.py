"""Reader and writer of the cameras of COLMAP models."""

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchrefract._io import write_file
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.documents import HALF_PIXEL, Document, abbreviate, fit_coefficients, list_names, read_text

# COLMAP's models by their numbers: the model here, None if there is none; the numbers of focal lengths and of
# coefficients, with cx and cy between them.
_MODELS: dict[str, tuple[str | None, int, int]] = {
    "SIMPLE_PINHOLE": ("opencv", 1, 0),
    "PINHOLE": ("opencv", 2, 0),
    "SIMPLE_RADIAL": ("opencv", 1, 1),
    "RADIAL": ("opencv", 1, 2),
    "OPENCV": ("opencv", 2, 4),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
    "FULL_OPENCV": ("opencv", 2, 8),
    "FOV": (None, 2, 1),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
    "THIN_PRISM_FISHEYE": (None, 2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": (None, 2, 12),
    "SIMPLE_DIVISION": ("division", 1, 1),
    "DIVISION": ("division", 2, 1),
    "SIMPLE_FISHEYE": ("fisheye", 1, 0),
    "FISHEYE": ("fisheye", 2, 0),
    "EUCM": (None, 2, 2),
    "EQUIRECTANGULAR": (None, 0, 0),
}
_FILES = ("cameras.bin", "cameras.txt")
_LINE = re.compile(r"\d+ +[A-Z][A-Z_]+ +\d+ +\d+ ")


def read_colmap(path: str | Path) -> dict[int, Camera]:
    """Read the cameras of a cameras.txt, a cameras.bin, or the folder of a COLMAP model by their ids.

    Pinholes, radial models, OPENCV and FULL_OPENCV become "opencv", models with FISHEYE "fisheye", those with DIVISION
    "division". Others (FOV, EUCM, models with THIN_PRISM and more) raise ValueError. The principal point moves by half
    a pixel between COLMAP's convention and the one of this library.
    """
    return {number: camera() for number, camera in colmap_rows(Path(path)).items()}


def write_colmap(path: str | Path, cameras: Mapping[int, Camera]) -> None:
    """Write a cameras.txt that `read_colmap` and COLMAP read.

    A camera becomes PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE, the first that holds its coefficients.

    Args:
        path: to write.
        cameras: by their ids, "fisheye", or "opencv" without prism and tilt.

    Raises:
        ValueError: a model, or coefficients, that the file cannot hold; see `convert`.
    """
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", f"# Number of cameras: {len(cameras)}"]
    for number, camera in cameras.items():
        coefficients = fit_coefficients(camera, (0, 4, 8))
        model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(coefficients)]
        model = "OPENCV_FISHEYE" if camera.model == "fisheye" else model
        pinhole = (camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL)
        values = " ".join(map(repr, (*pinhole, *coefficients)))
        lines.append(f"{number} {model} {camera.width} {camera.height} {values}")
    write_file(Path(path), "\n".join(lines) + "\n")


def is_colmap(path: Path) -> bool:
    """Return True for a folder, a binary file, and a text with a camera of COLMAP; raise for its database."""
    if path.is_dir() or path.suffix.lower() == ".bin":
        return True
    if path.suffix.lower() == ".db":
        raise ValueError(
            f"path must hold text or a COLMAP model, got the database {path}; export it by colmap model_converter"
        )
    if path.suffix.lower() != ".txt" or path.name == "cameras.txt":
        return path.name == "cameras.txt"
    return any(map(_LINE.match, _lines(path)))


def colmap_rows(path: Path) -> dict[int, Callable[[], Camera]]:
    """Return functions that create the cameras of a file or folder, by their ids."""
    if path.is_dir():
        files = [path / part / file for part in ("", "sparse", "sparse/0") for file in _FILES]
        files = [file for file in files if file.is_file()]
        if len(files) != 1:
            raise ValueError(
                f"path must be a folder with cameras.bin or cameras.txt, got {path} with "
                f"{list_names(map(str, files))}; state the file"
            )
        path = files[0]
    lines = _records(path) if path.suffix.lower() == ".bin" else map(str.split, _lines(path))
    rows = [_row(path, words) for words in lines]
    if repeated := [number for number, count in Counter(number for number, _ in rows).items() if count > 1]:
        raise ValueError(f"path must hold each camera once, got {path} with {repeated[0]} twice")
    return dict(rows)


def _lines(path: Path) -> list[str]:
    """Return the lines of a text but for empty ones and comments."""
    lines = (line.strip() for line in read_text(path).splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def _records(path: Path) -> Iterator[list[Any]]:
    """Yield id, model, width, height and parameters of a cameras.bin."""
    data, names = path.read_bytes(), list(_MODELS)
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            number, kind, *size = struct.unpack_from("<iiQQ", data, at)
            if not 0 <= kind < len(names):
                raise ValueError(f"path must have camera models of 0 to {len(names) - 1}, got {path} with {kind}")
            _, num_focal, num_coefficients = _MODELS[names[kind]]
            parameters = struct.unpack_from(f"<{num_focal + 2 + num_coefficients}d", data, at + 24)
            at += 24 + 8 * len(parameters)
            yield [number, names[kind], *size, *parameters]
    except struct.error as error:
        raise ValueError(f"path must hold the cameras that it counts, got {path}, which ends before them") from error
    if at != len(data):
        raise ValueError(f"path must end after its {count} cameras, got {path} with {len(data) - at} bytes more")


def _row(path: Path, words: Sequence[Any]) -> tuple[int, Callable[[], Camera]]:
    if len(words) < 4:
        raise ValueError(
            f"path must have a number, model, width and height in each line, got {path} with {abbreviate(words)}"
        )
    head = "CAMERA_ID, WIDTH or HEIGHT"
    document = Document(path, {head: [words[0], *words[2:4]], f"parameters of {words[1]}": list(words[4:])})
    number, *size = document.integers(head, count=3)
    return number, partial(_camera, document, words[1], size)


def _camera(document: Document, name: str, size: Sequence[int]) -> Camera:
    model, num_focal, num_coefficients = _MODELS.get(name, (None, 0, 0))
    if model is None:
        names = ", ".join(name for name, (model, *_) in _MODELS.items() if model)
        raise ValueError(
            f"path must have a camera model of {names}, got {document.path} with {name[:80]}; "
            "reconstruct with one of them"
        )
    values = document.numbers(f"parameters of {name}", count=num_focal + 2 + num_coefficients)
    (*focal, cx, cy), lens = values[: num_focal + 2], values[num_focal + 2 :]
    pinhole = focal[0], focal[-1], cx - HALF_PIXEL, cy - HALF_PIXEL
    return document.camera(size, pinhole, lens if model == "division" else (*lens, *(0.0,) * (4 - len(lens))), model)
