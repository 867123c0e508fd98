"""What the readers and writers of all formats share: text, numbers, and errors that name the file."""

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefract._io import replace_file
from torchrefract.cameras.camera import Camera

# A list that YAML's aliases fold into itself is small in memory, and without end in print.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 2, 14, 80, 80


def shown(value: Any) -> str:
    """A value of a file as an error prints it, short whatever the file holds."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # a whole number of more digits than Python prints
        return type(value).__name__


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: bytes that are no UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"path must hold text in UTF-8, got {path}") from error


def write_text(path: Path, text: str) -> None:
    """A file that is there whole or not at all."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def entry(path: Path, document: Mapping[str, Any], name: str) -> Any:
    """What a document has under a name.

    Raises:
        ValueError: nothing.
    """
    if name not in document:
        raise ValueError(f"path must hold {name}, got {path} with {', '.join(map(str, document)) or 'nothing'}")
    return document[name]


def numbers(path: Path, name: str, values: Any, *, count: int | None = None) -> list[float]:
    """A list of so many numbers.

    Raises:
        ValueError: something else.
    """
    try:
        if isinstance(values, str | Mapping):
            raise TypeError
        found = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"path must hold numbers as {name}, got {path} with {shown(values)}") from None
    if count is not None and len(found) != count:
        raise ValueError(f"path must hold {count} numbers as {name}, got {path} with {len(found)}")
    return found


def whole(path: Path, name: str, value: Any) -> int:
    """A whole number.

    Raises:
        ValueError: something else.
    """
    (found,) = numbers(path, name, [value])
    if not found.is_integer():
        raise ValueError(f"path must hold a whole number as {name}, got {path} with {shown(value)}")
    return int(found)


def camera_of(
    path: Path, size: Sequence[int], pinhole: Sequence[float], coefficients: Sequence[float], model: str
) -> Camera:
    """The camera of (width, height), (fx, fy, cx, cy) and coefficients.

    Raises:
        ValueError: numbers that are no camera, with the file's name.
    """
    fx, fy, cx, cy = pinhole
    try:
        return Camera(
            width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients), model=model
        )
    except ValueError as error:
        raise ValueError(f"path must hold a camera, got {path}: {error}") from error


def shortened(camera: Camera, count: int) -> tuple[float, ...]:
    """OpenCV's coefficients cut or filled up to a count.

    Raises:
        ValueError: others that are not zero.
    """
    first, rest = camera.coefficients[:count], camera.coefficients[count:]
    if any(rest):
        raise ValueError(f"camera must have at most {count} coefficients for this file, got {camera.coefficients}")
    return (*first, *(0.0,) * (count - len(first)))


def unknown_model(camera: Camera, known: str) -> ValueError:
    """The error for a camera of a model that a format has no name for."""
    return ValueError(
        f"camera must be of the model {known} for this file (convert(camera, to=...) finds the nearest), "
        f"got {camera.model}"
    )
