"""Readers and writers of camera files of OpenCV, ROS, Kalibr and COLMAP; YAML needs the `calibration` extra.

Readers raise ValueError with the name of the file if it does not hold what they describe. Writers raise ValueError if
the format cannot hold the camera; readers of the path find the old file or the complete new one.
"""

import reprlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchrefract._io import replace_file
from torchrefract.cameras.camera import Camera

_ROS_MODELS = {"plumb_bob": "opencv", "rational_polynomial": "opencv", "equidistant": "fisheye"}
_KALIBR_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}
# COLMAP's parameters are one or two focal lengths, cx, cy, then the lens: the model here, and the numbers of both.
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("opencv", 1, 0),
    "PINHOLE": ("opencv", 2, 0),
    "SIMPLE_RADIAL": ("opencv", 1, 1),
    "RADIAL": ("opencv", 1, 2),
    "OPENCV": ("opencv", 2, 4),
    "FULL_OPENCV": ("opencv", 2, 8),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
}
_COLMAP_OFFSET = 0.5  # px: COLMAP has the center of the first pixel at (0.5, 0.5), this library at (0, 0)
_MAX_MESSAGE = 400  # characters of PyYAML's error to repeat
# A list that refers to itself through YAML's aliases is small in memory but endless in print.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 2, 14, 80, 80


def read_opencv(path: str | Path) -> Camera:
    """Read image_width, image_height, camera_matrix, distortion_coefficients and fisheye_model of a camera.

    The model is "fisheye" if fisheye_model is present and not 0, otherwise "opencv".

    Args:
        path: ending in .xml, .yml or .yaml.
    """
    document = _read_storage(Path(path))
    is_fisheye = "fisheye_model" in document.values and document.integers("fisheye_model") != [0]
    return document.camera("fisheye" if is_fisheye else "opencv")


def read_covariance(path: str | Path) -> np.ndarray | None:
    """Read the covariance (4 + n, 4 + n) of fx, fy, cx, cy and n coefficients from a file of `write_opencv`.

    Returns None if the file has none. `LensDistortion.from_camera` takes the result.
    """
    document = _read_storage(Path(path))
    if "covariance" not in document.values:
        return None
    size = 4 + len(document.numbers("distortion_coefficients", is_matrix=True))
    return np.array(document.numbers("covariance", count=size * size, is_matrix=True)).reshape(size, size)


def _read_storage(path: Path) -> "_Document":
    if _is_xml(path):
        try:
            root = ElementTree.fromstring(_read(path))
        except ElementTree.ParseError as error:
            raise ValueError(f"path must hold XML, got {path}: {error}") from error
        return _Document(path, {node.tag: _xml_value(node) for node in root})
    text = _read(path)
    # OpenCV's first line, %YAML:1.0, is not a valid directive of YAML.
    return _parse_yaml(path, text.partition("\n")[2] if text.startswith("%YAML") else text)


def write_opencv(path: str | Path, camera: Camera, *, covariance: np.ndarray | None = None) -> None:
    """Write a file that `read_opencv` and `cv2.FileStorage` read.

    Args:
        path: ending in .xml, .yml or .yaml.
        camera: of the model "opencv" or "fisheye".
        covariance: (4 + n, 4 + n), of fx, fy, cx, cy and the n coefficients; None writes none.
    """
    path, coefficients = Path(path), _fit_coefficients(camera, (len(camera.coefficients),))
    is_fisheye = int(camera.model == "fisheye")
    scalars = {"image_width": camera.width, "image_height": camera.height, "fisheye_model": is_fisheye}
    matrices = {"camera_matrix": _matrix(3, chain(*camera.matrix))}
    matrices["distortion_coefficients"] = _matrix(len(coefficients), coefficients)
    if covariance is not None:
        size = 4 + len(coefficients)
        if np.shape(covariance) != (size, size):
            raise ValueError(f"covariance must have shape ({size}, {size}), got {np.shape(covariance)}")
        matrices["covariance"] = _matrix(size, np.asarray(covariance, dtype=float).ravel().tolist())
    if _is_xml(path):
        lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
        lines += [f"<{name}>{value}</{name}>" for name, value in scalars.items()]
        for name, matrix in matrices.items():
            data = " ".join(f"{value:.17e}" for value in matrix["data"])
            content = f"<rows>{matrix['rows']}</rows><cols>{matrix['cols']}</cols><dt>d</dt><data>{data}</data>"
            lines.append(f'<{name} type_id="opencv-matrix">{content}</{name}>')
        lines.append("</opencv_storage>")
    else:
        lines = ["%YAML:1.0", "---", *(f"{name}: {value}" for name, value in scalars.items())]
        for name, matrix in matrices.items():
            data = ", ".join(f"{value:.17e}" for value in matrix["data"])
            lines += [f"{name}: !!opencv-matrix", f"   rows: {matrix['rows']}", f"   cols: {matrix['cols']}"]
            lines += ["   dt: d", f"   data: [ {data} ]"]
    _write(path, "\n".join(lines) + "\n")


def read_ros(path: str | Path) -> Camera:
    """Read a camera_info file, as camera_calibration_parsers does.

    plumb_bob and rational_polynomial become "opencv", equidistant becomes "fisheye". The rectification and projection
    matrices are ignored: they describe a rectified view.
    """
    document = _parse_yaml(Path(path), _read(Path(path)))
    return document.camera(document.choice("distortion_model", _ROS_MODELS))


def write_ros(path: str | Path, camera: Camera, *, name: str = "camera") -> None:
    """Write a camera_info file that `read_ros` and ROS read, for frames that are not rectified.

    Args:
        path: to write.
        camera: "fisheye", or "opencv" without prism and tilt.
        name: of the camera.
    """
    coefficients = _fit_coefficients(camera, (5, 8))
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(3, chain(*camera.matrix)),
        "distortion_model": {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[len(coefficients)],
        "distortion_coefficients": _matrix(1, coefficients),
        "rectification_matrix": _matrix(3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": _matrix(3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    _write(path, _dump_yaml(document))


def read_kalibr(path: str | Path) -> dict[str, Camera]:
    """Read the cameras of a camchain.yaml by their names, without poses and time offsets.

    Pinholes with radtan (k1, k2, p1, p2) or none become "opencv", with equidistant "fisheye". A camera with another
    camera_model (omni, eucm, ds) or distortion_model (fov) raises ValueError.
    """
    chains = _parse_yaml(Path(path), _read(Path(path))).values
    return {str(name): _kalibr_camera(_Document(f"{path}, {name},", chain)) for name, chain in chains.items()}


def write_kalibr(path: str | Path, cameras: Mapping[str, Camera]) -> None:
    """Write a camchain.yaml that `read_kalibr` reads, without poses.

    Args:
        path: to write.
        cameras: by their names, such as cam0; "fisheye", or "opencv" with k1, k2, p1, p2 only.
    """
    chains = {
        name: {
            "camera_model": "pinhole",
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion_model": "radtan" if camera.model == "opencv" else "equidistant",
            "distortion_coeffs": list(_fit_coefficients(camera, (4,))),
            "resolution": [camera.width, camera.height],
        }
        for name, camera in cameras.items()
    }
    _write(path, _dump_yaml(chains))


def read_colmap(path: str | Path) -> dict[int, Camera]:
    """Read the cameras of a cameras.txt by their ids.

    Pinholes, radial models, OPENCV and FULL_OPENCV become "opencv", models with FISHEYE become "fisheye". Others (FOV,
    THIN_PRISM_FISHEYE and more) raise ValueError. The principal point moves by half a pixel between COLMAP's convention
    and the one of this library.
    """
    lines = [line.split() for line in _read(Path(path)).splitlines() if line.strip() and not line.startswith("#")]
    return dict(_colmap_camera(path, words) for words in lines)


def write_colmap(path: str | Path, cameras: Mapping[int, Camera]) -> None:
    """Write a cameras.txt that `read_colmap` and COLMAP read.

    A camera becomes PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE, the first that holds its coefficients.

    Args:
        path: to write.
        cameras: by their ids, "fisheye", or "opencv" without prism and tilt.
    """
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", f"# Number of cameras: {len(cameras)}"]
    for number, camera in cameras.items():
        coefficients = _fit_coefficients(camera, (0, 4, 8))
        model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(coefficients)]
        model = "OPENCV_FISHEYE" if camera.model == "fisheye" else model
        pinhole = (camera.fx, camera.fy, camera.cx + _COLMAP_OFFSET, camera.cy + _COLMAP_OFFSET)
        values = " ".join(map(repr, (*pinhole, *coefficients)))
        lines.append(f"{number} {model} {camera.width} {camera.height} {values}")
    _write(path, "\n".join(lines) + "\n")


class _Document:
    """Values by their names in a file; every method raises ValueError, with the name of the file, for invalid ones."""

    def __init__(self, path: Path | str, values: Any):
        if not isinstance(values, dict):
            raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(values).__name__}")
        self.path, self.values = path, values

    def get(self, name: str) -> Any:
        if name not in self.values:
            names = ", ".join(map(str, self.values)) or "nothing"
            raise ValueError(f"path must hold {name}, got {self.path} with {names}")
        return self.values[name]

    def choice(self, name: str, choices: Mapping[str, Any]) -> Any:
        """Return one of `choices` by the value of a name."""
        value = self.get(name)
        if not isinstance(value, str) or value not in choices:
            raise ValueError(
                f"path must have a {name} of {', '.join(choices)}, got {self.path} with {_abbreviate(value)}"
            )
        return choices[value]

    def numbers(self, name: str, *, count: int | None = None, is_matrix: bool = False) -> list[float]:
        """Return a number, a list of numbers, or a matrix, which is a mapping with the name data, as a list."""
        values = self.get(name)
        if is_matrix:
            if not isinstance(values, dict) or "data" not in values:
                raise ValueError(f"path must hold a matrix as {name}, got {self.path} with {_abbreviate(values)}")
            values = values["data"]
        try:
            result = [float(value) for value in (values if isinstance(values, list) else [values])]
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"path must hold numbers as {name}, got {self.path} with {_abbreviate(values)}") from None
        if count is not None and len(result) != count:
            raise ValueError(f"path must hold {count} numbers as {name}, got {self.path} with {len(result)}")
        return result

    def integers(self, name: str, *, count: int = 1) -> list[int]:
        values = self.numbers(name, count=count)
        if wrong := [value for value in values if not value.is_integer()]:
            raise ValueError(f"path must hold a whole number as {name}, got {self.path} with {wrong[0]}")
        return [int(value) for value in values]

    def camera(self, model: str) -> Camera:
        """Return the camera of the names that OpenCV and ROS use, without skew."""
        fx, skew, cx, _, fy, cy, *last = self.numbers("camera_matrix", count=9, is_matrix=True)
        if skew != 0 or last != [0.0, 0.0, 1.0]:
            raise ValueError(
                f"path must hold a camera_matrix without skew, got {self.path} with skew {skew:g}, last row {last}"
            )
        size = (*self.integers("image_width"), *self.integers("image_height"))
        coefficients = self.numbers("distortion_coefficients", is_matrix=True)
        return self.create_camera(size, (fx, fy, cx, cy), coefficients, model)

    def create_camera(
        self, size: Sequence[int], pinhole: Sequence[float], coefficients: Sequence[float], model: str
    ) -> Camera:
        (width, height), (fx, fy, cx, cy), lens = size, pinhole, tuple(coefficients)
        try:
            return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=lens, model=model)
        except ValueError as error:
            raise ValueError(f"path must hold a camera, got {self.path}: {error}") from error


def _kalibr_camera(document: _Document) -> Camera:
    document.values.setdefault("distortion_model", "none")
    document.choice("camera_model", {"pinhole": ""})
    model = document.choice("distortion_model", _KALIBR_MODELS)
    has_lens = document.get("distortion_model") != "none"
    coefficients = document.numbers("distortion_coeffs", count=4) if has_lens else [0.0] * 4
    size, pinhole = document.integers("resolution", count=2), document.numbers("intrinsics", count=4)
    return document.create_camera(size, pinhole, coefficients, model)


def _colmap_camera(path: str | Path, words: list[str]) -> tuple[int, Camera]:
    if len(words) < 4:
        raise ValueError(
            f"path must have a number, model, width and height in each line, got {path} with {_abbreviate(words)}"
        )
    if words[1] not in _COLMAP_MODELS:
        raise ValueError(
            f"path must have a camera model of {', '.join(_COLMAP_MODELS)}, got {path} with {words[1][:80]}"
        )
    model, num_focal, num_coefficients = _COLMAP_MODELS[words[1]]
    parameters, head = f"parameters of {words[1]}", "CAMERA_ID, WIDTH or HEIGHT"
    document = _Document(path, {head: [words[0], *words[2:4]], parameters: words[4:]})
    number, *size = document.integers(head, count=3)
    values = document.numbers(parameters, count=num_focal + 2 + num_coefficients)
    (*focal, cx, cy), lens = values[: num_focal + 2], values[num_focal + 2 :]
    pinhole = focal[0], focal[-1], cx - _COLMAP_OFFSET, cy - _COLMAP_OFFSET
    return number, document.create_camera(size, pinhole, (*lens, *(0.0,) * (4 - len(lens))), model)


def _xml_value(node: ElementTree.Element) -> Any:
    values: dict[str, Any] = {child.tag: (child.text or "").strip() for child in node}
    if "data" in values:
        return values | {"data": values["data"].split()}
    return (node.text or "").strip()


def _matrix(rows: int, values: Iterable[float]) -> dict[str, Any]:
    data = list(values)
    return {"rows": rows, "cols": len(data) // rows, "data": data}


def _fit_coefficients(camera: Camera, counts: Sequence[int]) -> tuple[float, ...]:
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


def _is_xml(path: Path) -> bool:
    if path.suffix.lower() not in (".xml", ".yml", ".yaml"):
        raise ValueError(f"path must end in .xml, .yml or .yaml, got {path}")
    return path.suffix.lower() == ".xml"


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"path must hold text in UTF-8, got {path}") from error


def _write(path: str | Path, text: str) -> None:
    with replace_file(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _abbreviate(value: Any) -> str:
    """Return a short representation of a value of a file, for errors."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return type(value).__name__


def _parse_yaml(path: Path, text: str) -> _Document:
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
    return _Document(path, values)


def _dump_yaml(values: Mapping[str, Any]) -> str:
    """Return a mapping as YAML, in its order, with each list on one line."""
    return _import_yaml().safe_dump(values, sort_keys=False, default_flow_style=None, width=1000)


def _import_yaml() -> Any:
    try:
        import yaml  # noqa: PLC0415
    except ModuleNotFoundError as missing:
        message = 'cameras in YAML files need PyYAML: pip install "torchrefract[calibration]"'
        raise ModuleNotFoundError(message, name=missing.name) from missing
    return yaml
