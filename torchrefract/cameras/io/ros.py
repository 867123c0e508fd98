"""Cameras in ROS's camera_info files, as camera_calibration_parsers reads and writes them."""

from pathlib import Path
from typing import Any

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io.documents import (
    camera_of,
    entry,
    numbers,
    read_text,
    shortened,
    shown,
    unknown_model,
    whole,
    write_text,
)
from torchrefract.cameras.io.yaml_documents import dump_yaml, parse_yaml

_MODELS = {"plumb_bob": "opencv", "rational_polynomial": "opencv", "equidistant": "fisheye"}


def read_ros(path: str | Path) -> Camera:
    """The camera of a file with image_width, image_height, camera_matrix, distortion_model, distortion_coefficients.

    plumb_bob and rational_polynomial are the model "opencv", equidistant is "fisheye". Rectification and projection
    matrices are not read: they are a choice of a view, not the camera's.

    Raises:
        ValueError: a file that holds no such camera; another distortion_model.
    """
    path = Path(path)
    document = parse_yaml(path, read_text(path))
    size = [whole(path, name, entry(path, document, name)) for name in ("image_width", "image_height")]
    name = entry(path, document, "distortion_model")
    if not isinstance(name, str) or name not in _MODELS:
        raise ValueError(f"path must have a distortion_model of {', '.join(_MODELS)}, got {path} with {shown(name)}")
    fx, skew, cx, _, fy, cy, *_ = _data(path, document, "camera_matrix", count=9)
    if skew != 0:
        raise ValueError(f"path must hold a camera_matrix without skew, got {path} with {skew:g}")
    coefficients = _data(path, document, "distortion_coefficients")
    return camera_of(path, size, (fx, fy, cx, cy), coefficients, _MODELS[name])


def write_ros(path: str | Path, camera: Camera, *, name: str = "camera") -> None:
    """A file that `read_ros` and ROS read, for frames that are not rectified yet.

    Args:
        path: to write.
        camera: of the model "fisheye", or "opencv" without tilt.
        name: of the camera.

    Raises:
        ValueError: another model; more coefficients than the formats have.
    """
    if camera.model not in ("opencv", "fisheye"):
        raise unknown_model(camera, "opencv or fisheye")
    coefficients, model = camera.coefficients, "equidistant"
    if camera.model == "opencv":
        few = not any(coefficients[5:])
        coefficients, model = shortened(camera, 5 if few else 8), "plumb_bob" if few else "rational_polynomial"
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        "distortion_model": model,
        "distortion_coefficients": _matrix(1, len(coefficients), list(coefficients)),
        "rectification_matrix": _matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": _matrix(3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    write_text(Path(path), dump_yaml(document))


def _data(path: Path, document: Any, name: str, *, count: int | None = None) -> list[float]:
    matrix = entry(path, document, name)
    if not isinstance(matrix, dict):
        raise ValueError(f"path must hold rows, cols and data as {name}, got {path} with {shown(matrix)}")
    return numbers(path, name, entry(path, matrix, "data"), count=count)


def _matrix(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": columns, "data": data}
