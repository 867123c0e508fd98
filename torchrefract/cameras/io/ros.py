"""Cameras in ROS's camera_info files, as camera_calibration_parsers reads and writes them."""

from pathlib import Path
from typing import Any

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import documents

_MODELS = {"plumb_bob": "opencv", "rational_polynomial": "opencv", "equidistant": "fisheye"}


def read_ros(path: str | Path) -> Camera:
    """Read image_width, image_height, camera_matrix, distortion_model and distortion_coefficients of a camera.

    plumb_bob and rational_polynomial become "opencv", equidistant becomes "fisheye". The rectification and projection
    matrices are ignored: they describe a rectified view.

    Raises:
        ValueError: the file holds no such camera, or one with another distortion_model.
    """
    path = Path(path)
    document = documents.parse_yaml(path, documents.read_text(path))
    return document.camera(document.choice("distortion_model", _MODELS))


def write_ros(path: str | Path, camera: Camera, *, name: str = "camera") -> None:
    """Write a file that `read_ros` and ROS read, for frames that are not rectified.

    Args:
        path: to write.
        camera: "fisheye", or "opencv" without prism and tilt.
        name: of the camera.

    Raises:
        ValueError: the camera has another model or other coefficients.
    """
    documents.check_opencv_model(camera)
    coefficients, model = camera.coefficients, "equidistant"
    if camera.model == "opencv":
        is_short = not any(coefficients[5:])
        coefficients = documents.fit_length(camera, 5 if is_short else 8)
        model = "plumb_bob" if is_short else "rational_polynomial"
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
    documents.write_text(Path(path), documents.dump_yaml(document))


def _matrix(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": columns, "data": data}
