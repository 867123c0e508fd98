"""Documents of cameras: checked numbers, YAML, and errors that name the file."""

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefract._io import replace_file
from torchrefract.cameras.camera import Camera

_MAX_MESSAGE = 400  # characters of PyYAML's error to repeat
# A list that refers to itself through YAML's aliases is small in memory but endless in print.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 2, 14, 80, 80


class Document:
    """Values by their names in a file; every method raises ValueError, with the name of the file, for invalid ones."""

    def __init__(self, path: Path | str, values: Any):
        if not isinstance(values, Mapping):
            raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(values).__name__}")
        self.path, self.values = path, values

    def get(self, name: str) -> Any:
        """Return the value of a name."""
        if name not in self.values:
            names = ", ".join(map(str, self.values)) or "nothing"
            raise ValueError(f"path must hold {name}, got {self.path} with {names}")
        return self.values[name]

    def choice(self, name: str, choices: Mapping[str, str]) -> str:
        """Return one of `choices` by the value of a name."""
        value = self.get(name)
        if not isinstance(value, str) or value not in choices:
            raise ValueError(
                f"path must have a {name} of {', '.join(choices)}, got {self.path} with {abbreviate(value)}"
            )
        return choices[value]

    def numbers(self, name: str, *, count: int | None = None) -> list[float]:
        """Return a list of `count` numbers, or of any number of them if it is None."""
        return numbers(self.path, name, self.get(name), count=count)

    def integer(self, name: str) -> int:
        """Return a whole number."""
        return integer(self.path, name, self.get(name))

    def matrix(self, name: str) -> list[float]:
        """Return the numbers of a matrix, which is a mapping with the name data, row by row."""
        matrix = self.get(name)
        if not isinstance(matrix, Mapping) or "data" not in matrix:
            raise ValueError(f"path must hold a matrix as {name}, got {self.path} with {abbreviate(matrix)}")
        return numbers(self.path, name, matrix["data"])

    def camera(self, model: str) -> Camera:
        """Return the camera of the names that OpenCV and ROS use, without skew."""
        values = self.matrix("camera_matrix")
        fx, skew, cx, _, fy, cy, *last = numbers(self.path, "camera_matrix", values, count=9)
        if skew != 0 or last != [0.0, 0.0, 1.0]:
            raise ValueError(
                f"path must hold a camera_matrix without skew, got {self.path} with skew {skew:g}, last row {last}"
            )
        size = self.integer("image_width"), self.integer("image_height")
        return create_camera(self.path, size, (fx, fy, cx, cy), self.matrix("distortion_coefficients"), model)


def abbreviate(value: Any) -> str:
    """Return a short representation of a value of a file, for errors."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return type(value).__name__


def read_text(path: Path) -> str:
    """Read a text file in UTF-8; raise ValueError if it is not."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"path must hold text in UTF-8, got {path}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8; readers find the old file or the complete new one."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def numbers(path: Path | str, name: str, values: Any, *, count: int | None = None) -> list[float]:
    """Return values of a file as `count` numbers, or as any number of them; raise ValueError for other values."""
    try:
        if isinstance(values, str | Mapping):
            raise TypeError
        result = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"path must hold numbers as {name}, got {path} with {abbreviate(values)}") from None
    if count is not None and len(result) != count:
        raise ValueError(f"path must hold {count} numbers as {name}, got {path} with {len(result)}")
    return result


def integer(path: Path | str, name: str, value: Any) -> int:
    """Return a value of a file as an integer; raise ValueError if it is not a whole number."""
    (result,) = numbers(path, name, [value])
    if not result.is_integer():
        raise ValueError(f"path must hold a whole number as {name}, got {path} with {abbreviate(value)}")
    return int(result)


def create_camera(
    path: Path | str, size: Sequence[int], pinhole: Sequence[float], coefficients: Sequence[float], model: str
) -> Camera:
    """Create a camera of (width, height), (fx, fy, cx, cy) and coefficients; errors name the file."""
    (width, height), (fx, fy, cx, cy), numbers = size, pinhole, tuple(coefficients)
    try:
        return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=numbers, model=model)
    except ValueError as error:
        raise ValueError(f"path must hold a camera, got {path}: {error}") from error


def fit_length(camera: Camera, count: int) -> tuple[float, ...]:
    """Return OpenCV's coefficients truncated or padded with zeros; raise ValueError if others would be dropped."""
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


def parse_yaml(path: Path, text: str) -> Document:
    """Parse a text of plain values, and of OpenCV's matrices as mappings; raise ValueError for any other."""
    yaml = _import_yaml()

    class Loader(yaml.SafeLoader):
        def flatten_mapping(self, node: Any) -> None:
            # No camera file has merge keys, and a few lines of them can fill the memory.
            for key, _ in node.value:
                if key.tag == "tag:yaml.org,2002:merge":
                    raise yaml.constructor.ConstructorError(None, None, "found a merge key", key.start_mark)
            super().flatten_mapping(node)

    Loader.add_constructor(
        "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
    )
    try:
        values = yaml.load(text, Loader=Loader)
    except Exception as error:  # malformed scalars and keys raise many types besides YAMLError
        raise ValueError(f"path must hold YAML, got {path}: {' '.join(str(error).split())[:_MAX_MESSAGE]}") from error
    return Document(path, values)


def dump_yaml(values: Mapping[str, Any]) -> str:
    """Return a mapping as YAML, in its order, with each list on one line."""
    return _import_yaml().safe_dump(values, sort_keys=False, default_flow_style=None, width=1000)


def _import_yaml() -> Any:
    try:
        import yaml  # noqa: PLC0415
    except ModuleNotFoundError as missing:
        message = 'cameras in YAML files need PyYAML: pip install "torchrefract[calibration]"'
        raise ModuleNotFoundError(message, name=missing.name) from missing
    return yaml
