"""Helpers of all camera readers and writers: text, checked numbers, and errors that name the file."""

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefract._io import replace_file
from torchrefract.cameras.camera import Camera

# A list that refers to itself through YAML's aliases is small in memory but endless in print.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 2, 14, 80, 80


def abbreviate(value: Any) -> str:
    """Return a short representation of a value of a file, for errors."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return type(value).__name__


def read_text(path: Path) -> str:
    """Read a text file in UTF-8.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"path must hold text in UTF-8, got {path}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8; readers find the old file or the complete new one."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def entry(path: Path, document: Mapping[str, Any], name: str) -> Any:
    """Return the value of a name in a document, or raise ValueError if it is missing."""
    if name not in document:
        raise ValueError(f"path must hold {name}, got {path} with {', '.join(map(str, document)) or 'nothing'}")
    return document[name]


def numbers(path: Path, name: str, values: Any, *, count: int | None = None) -> list[float]:
    """Return values as a list of `count` numbers, or of any number of them if it is None.

    Raises:
        ValueError: the values are not numbers, or not as many.
    """
    try:
        if isinstance(values, str | Mapping):
            raise TypeError
        result = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"path must hold numbers as {name}, got {path} with {abbreviate(values)}") from None
    if count is not None and len(result) != count:
        raise ValueError(f"path must hold {count} numbers as {name}, got {path} with {len(result)}")
    return result


def integer(path: Path, name: str, value: Any) -> int:
    """Return a value as an integer, or raise ValueError if it is not a whole number."""
    (result,) = numbers(path, name, [value])
    if not result.is_integer():
        raise ValueError(f"path must hold a whole number as {name}, got {path} with {abbreviate(value)}")
    return int(result)


def pinhole_of_matrix(path: Path, name: str, values: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of the nine numbers of a camera matrix, row by row.

    Raises:
        ValueError: the values are not nine numbers, or the matrix has skew or another last row than 0, 0, 1.
    """
    fx, skew, cx, _, fy, cy, *last = numbers(path, name, values, count=9)
    if skew != 0 or last != [0.0, 0.0, 1.0]:
        raise ValueError(f"path must hold a {name} without skew, got {path} with skew {skew:g}, last row {last}")
    return fx, fy, cx, cy


def create_camera(
    path: Path, size: Sequence[int], pinhole: Sequence[float], coefficients: Sequence[float], model: str
) -> Camera:
    """Create a camera of (width, height), (fx, fy, cx, cy) and coefficients.

    Raises:
        ValueError: a number is out of range; the error names the file.
    """
    fx, fy, cx, cy = pinhole
    try:
        return Camera(
            width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients), model=model
        )
    except ValueError as error:
        raise ValueError(f"path must hold a camera, got {path}: {error}") from error


def fit_length(camera: Camera, count: int) -> tuple[float, ...]:
    """Return OpenCV's coefficients truncated or padded with zeros to `count`.

    Raises:
        ValueError: a coefficient that would be dropped is not zero.
    """
    first, rest = camera.coefficients[:count], camera.coefficients[count:]
    if any(rest):
        raise ValueError(f"camera must have at most {count} coefficients for this file, got {camera.coefficients}")
    return (*first, *(0.0,) * (count - len(first)))


def check_opencv_model(camera: Camera) -> None:
    """Raise ValueError unless the camera has a model of OpenCV, "opencv" or "fisheye"."""
    if camera.model not in ("opencv", "fisheye"):
        raise ValueError(
            "camera must be of the model opencv or fisheye for this file (convert(camera, to=...) finds the nearest), "
            f"got {camera.model}"
        )
