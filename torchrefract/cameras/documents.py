"""Contents of camera files as plain values: parsers of YAML, JSON and XML, and the checks that the readers share."""

import codecs
import json
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from torchrefract._validation import warn
from torchrefract.cameras.camera import Camera

HALF_PIXEL = 0.5  # px, where COLMAP and Metashape have the center of the first pixel; this library has it at 0
CALIBRATE = "; calibrate the camera for one of these models, such as with python -m torchrefract.calibrate"
_MAX_MESSAGE = 400  # characters of a parser's error to repeat
_FARTHEST_CENTER = 0.15  # widths or heights, of a principal point from the middle; of published lenses at most 0.13
_MAX_NAMES = 20  # names of a file to list in an error
_LARGEST_ICON, _LARGEST_SHARE = 64, 4.0  # px: no camera of larger frames has a smaller focal length and center
# A list that refers to itself through YAML's aliases is small in memory but endless in print.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 2, 14, 80, 80


class Document:
    """Values by their names in a file; every method raises ValueError, with the name of the file, for invalid ones."""

    def __init__(self, path: Path | str, values: Any):
        if not isinstance(values, dict):
            raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(values).__name__}")
        self.path, self.values = path, values

    def get(self, name: str) -> Any:
        if name not in self.values:
            raise ValueError(f"path must hold {name}, got {self.path} with {list_names(self.values)}")
        return self.values[name]

    def child(self, name: str) -> "Document":
        """Return the mapping that a name has as its value."""
        return Document(f"{self.path}, {name},", self.get(name))

    def find(self, name: str, *others: str) -> str:
        """Return the one key of the file that is one of the names but for case and underscores, else the first name."""
        wanted = {_plain(other) for other in (name, *others)}
        keys = [key for key in self.values if _plain(key) in wanted]
        if len(keys) > 1:
            raise ValueError(f"path must hold one {name}, got {self.path} with {list_names(keys)}")
        return keys[0] if keys else name

    def choice(self, name: str, choices: Mapping[str, Any], *, remedy: str = "") -> Any:
        """Return one of `choices` by the value of a name."""
        value = self.get(name)
        if not isinstance(value, str) or value not in choices:
            raise ValueError(
                f"path must have a {name} of {', '.join(choices)}, got {self.path} with {abbreviate(value)}{remedy}"
            )
        return choices[value]

    def numbers(self, name: str, *, count: int | None = None, is_matrix: bool = False) -> list[float]:
        """Return a number, a list of numbers, or a matrix: rows, or a mapping with the name data; None is no number."""
        values = self.get(name)
        if is_matrix and isinstance(values, list):  # of numbers or of rows
            values = [value for row in values for value in (row if isinstance(row, list) else [row])]
        elif is_matrix:
            if not isinstance(values, dict) or "data" not in values:
                raise ValueError(f"path must hold a matrix as {name}, got {self.path} with {abbreviate(values)}")
            values = values["data"]
        values = [] if values is None else values
        try:
            result = [float(value) for value in (values if isinstance(values, list) else [values])]
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"path must hold numbers as {name}, got {self.path} with {abbreviate(values)}") from None
        if count is not None and len(result) != count:
            raise ValueError(f"path must hold {count} numbers as {name}, got {self.path} with {len(result)}")
        if is_matrix and isinstance(matrix := self.values[name], dict) and {"rows", "cols"} <= matrix.keys():
            rows, columns = map(self.child(name).integer, ("rows", "cols"))
            if len(result) != rows * columns:
                raise ValueError(
                    f"path must hold {rows} x {columns} numbers as {name}, got {self.path} with {len(result)}"
                )
        return result

    def number(self, name: str) -> float:
        return self.numbers(name, count=1)[0]

    def integer(self, name: str) -> int:
        return self.integers(name, count=1)[0]

    def integers(self, name: str, *, count: int) -> list[int]:
        values = self.numbers(name, count=count)
        if wrong := [value for value in values if not value.is_integer()]:
            raise ValueError(f"path must hold a whole number as {name}, got {self.path} with {wrong[0]}")
        return [int(value) for value in values]

    def size(self, width: int | None, height: int | None, *, prefix: str = "image_") -> tuple[int, int]:
        """Return the width and height that the file states by the names with `prefix`, or else those that are given."""
        result = []
        for side, given in (("width", width), ("height", height)):
            key = self.find(f"{prefix}{side}", side)
            if key not in self.values and given is None:
                names = list_names(self.values)
                raise ValueError(
                    f"path must hold {key}, got {self.path} with {names}; add it, or state {side} in read_camera"
                )
            stated = self.integer(key) if key in self.values else given
            if given not in (None, stated):
                raise ValueError(
                    f"{side} must be {stated} as {self.path} states, got {given}; use camera.resized for other frames"
                )
            result.append(stated)
        return result[0], result[1]

    def pinhole(self, name: str) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy of a matrix without skew."""
        fx, skew, cx, zero, fy, cy, *last = self.numbers(name, count=9, is_matrix=True)
        if (skew, zero) != (0, 0) or last != [0.0, 0.0, 1.0]:
            remedy = "; transpose it, as programs store columns first" if (cx, cy, zero) == (0, 0, 0) else ""
            raise ValueError(
                f"path must hold a {name} without skew, got {self.path} with skew {skew:g}, last row {last}{remedy}"
            )
        return fx, fy, cx, cy

    def camera(
        self, size: Sequence[int], pinhole: Sequence[float], coefficients: Sequence[float], model: str
    ) -> Camera:
        (width, height), (fx, fy, cx, cy), lens = size, pinhole, tuple(coefficients)
        if min(width, height) > _LARGEST_ICON and max(map(abs, pinhole)) <= _LARGEST_SHARE:
            raise ValueError(
                f"path must hold fx, fy, cx, cy in px, got {self.path} with {fx:g}, {fy:g}, {cx:g}, {cy:g} for frames "
                f"of {width} x {height} px; multiply shares by the width and the height"
            )
        try:
            camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=lens, model=model)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"path must hold a camera, got {self.path}: {error}") from error
        if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _FARTHEST_CENTER and min(width, height) > _LARGEST_ICON:
            warn(
                f"{self.path} has its principal point at ({cx:g}, {cy:g}), far from the middle of {width} x {height} "
                "px; if the frames were calibrated at another size, state that size and use camera.resized"
            )
        return camera


def read_text(path: Path) -> str:
    """Read a text in UTF-8, with or without byte order mark, or in UTF-16 with one, as Windows PowerShell writes it."""
    data = path.read_bytes()
    encoding = "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    try:
        return data.decode(encoding).replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ValueError(f"path must hold text in UTF-8 or UTF-16, got {path}") from error


def abbreviate(value: Any) -> str:
    """Return a short representation of a value of a file, for errors."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return type(value).__name__


def list_names(names: Iterable[Any]) -> str:
    """Return names of a file as a list in words, for errors."""
    words = [abbreviate(name).strip("'") for name in names]
    return ", ".join([*words[:_MAX_NAMES], *(["..."] if len(words) > _MAX_NAMES else [])]) or "nothing"


def parse_xml(path: Path, text: str) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"path must hold XML, got {path}: {error}") from error


def xml_document(path: Path | str, root: ElementTree.Element) -> Document:
    """Return the children of an element by their names: numbers, texts, and OpenCV's matrices as mappings."""
    return Document(path, _once(path, ((node.tag, _xml_value(node)) for node in root)))


def parse_documents(path: Path, text: str) -> list[Document]:
    """Parse JSON or YAML, of plain values and OpenCV's matrices; raise ValueError for any other.

    Several documents, such as a recorded topic of ROS, give one for each text that differs beyond its header.
    """
    form = "JSON" if text.lstrip().startswith("{") else "YAML"
    if form == "JSON":
        try:
            return [Document(path, json.loads(text, object_pairs_hook=partial(_once, path)))]
        except (ValueError, RecursionError):
            pass  # OpenCV writes .Nan and 1., which only YAML takes
    # OpenCV's first line, %YAML:1.0, is not a valid directive of YAML.
    text = text.partition("\n")[2] if text.startswith("%YAML") else text
    parts = re.split(r"^---(?=\s|$)", text, flags=re.M)
    texts = {re.sub(r"^header:[ \t]*\n(?:[ \t].*\n)+", "", part, flags=re.M).strip("\n"): None for part in parts}
    return [Document(path, _load_yaml(path, part, form)) for part in texts if part.strip()] or [Document(path, None)]


def dump_yaml(values: Mapping[str, Any]) -> str:
    """Return a mapping as YAML, in its order, with each list on one line."""
    return _import_yaml().safe_dump(values, sort_keys=False, default_flow_style=None, width=1000)


def fit_coefficients(camera: Camera, counts: Sequence[int]) -> tuple[float, ...]:
    """Return those of a fisheye, or those of OpenCV with zeros in the first of the lengths `counts` that holds them."""
    if camera.model not in ("opencv", "fisheye"):
        raise ValueError(
            "camera must be of the model opencv or fisheye for this file (convert(camera, to=...) finds the nearest), "
            f"got {camera.model}"
        )
    values = camera.coefficients
    if camera.model == "fisheye":
        return values
    for count in counts:
        if not any(values[count:]):
            return (*values[:count], *(0.0,) * (count - len(values)))
    raise ValueError(f"camera must have at most {counts[-1]} coefficients for this file, got {values}")


def _plain(name: Any) -> str:
    return name.replace("_", "").lower() if isinstance(name, str) else ""


def _once(path: Path | str, pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs as a mapping; raise ValueError if a name comes twice, of which parsers take the last."""
    values = dict[str, Any]()
    for name, value in pairs:
        if name in values:
            raise ValueError(f"path must hold {name} once, got {path} with it twice; keep one of them")
        values[name] = value
    return values


def _xml_value(node: ElementTree.Element) -> Any:
    values: dict[str, Any] = {child.tag: (child.text or "").strip() for child in node}
    if "data" in values:
        return values | {"data": values["data"].split()}
    return (node.text or "").strip()


def _load_yaml(path: Path, text: str, form: str) -> Any:
    yaml = _import_yaml()

    class Loader(yaml.SafeLoader):
        def flatten_mapping(self, node: Any) -> None:
            _once(path, ((key.value, None) for key, _ in node.value if isinstance(key.value, str)))
            # No camera file has merge keys, and a few lines of them can fill the memory.
            for key, _ in node.value:
                if key.tag == "tag:yaml.org,2002:merge":
                    raise yaml.constructor.ConstructorError(None, None, "found a merge key", key.start_mark)
            super().flatten_mapping(node)

    for kind in ("matrix", "nd-matrix"):  # OpenCV 5 writes the latter for arrays of one dimension
        Loader.add_constructor(
            f"tag:yaml.org,2002:opencv-{kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
        )
    try:
        return yaml.load(text, Loader=Loader)
    except (
        Exception
    ) as error:  # a name that comes twice, and malformed scalars and keys of many types besides YAMLError
        message = " ".join(str(error).split())[:_MAX_MESSAGE]
        raise ValueError(f"path must hold {form}, got {path}: {message}") from error


def _import_yaml() -> Any:
    try:
        import yaml  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as missing:
        message = 'cameras in YAML files need PyYAML: pip install "torchrefract[calibration]"'
        raise ModuleNotFoundError(message, name=missing.name) from missing
    return yaml
