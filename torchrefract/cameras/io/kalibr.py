"""Cameras in the camera chains of Kalibr."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import documents
from torchrefract.cameras.io.yaml_documents import dump_yaml, parse_yaml

_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}


def read_kalibr(path: str | Path) -> dict[str, Camera]:
    """Read the cameras of a camchain.yaml by their names, without poses and time offsets.

    Pinholes with radtan (k1, k2, p1, p2) or none become "opencv", with equidistant "fisheye".

    Raises:
        ValueError: the file holds no such cameras, or one with another camera_model (omni, eucm, ds) or
            distortion_model (fov).
    """
    path = Path(path)
    document = parse_yaml(path, documents.read_text(path))
    return {str(name): _camera(path, str(name), chain) for name, chain in document.items()}


def write_kalibr(path: str | Path, cameras: Mapping[str, Camera]) -> None:
    """Write a camchain.yaml that `read_kalibr` reads, without poses.

    Args:
        path: to write.
        cameras: by their names, such as cam0; "fisheye", or "opencv" with k1, k2, p1, p2 only.

    Raises:
        ValueError: a camera has another model or other coefficients.
    """
    documents.write_text(Path(path), dump_yaml({name: _chain(camera) for name, camera in cameras.items()}))


def _camera(path: Path, name: str, chain: Any) -> Camera:
    if not isinstance(chain, dict):
        raise ValueError(f"path must hold a camera as {name}, got {path} with {documents.abbreviate(chain)}")
    kind, lens = documents.entry(path, chain, "camera_model"), chain.get("distortion_model", "none")
    if kind != "pinhole":
        raise ValueError(
            f"path must have pinhole as the camera_model of {name}, got {path} with {documents.abbreviate(kind)}"
        )
    if not isinstance(lens, str) or lens not in _MODELS:
        raise ValueError(
            f"path must have a distortion_model of {', '.join(_MODELS)} for {name}, got {path} with "
            f"{documents.abbreviate(lens)}"
        )
    pinhole = documents.numbers(path, "intrinsics", documents.entry(path, chain, "intrinsics"), count=4)
    resolution = documents.numbers(path, "resolution", documents.entry(path, chain, "resolution"), count=2)
    size = [documents.integer(path, "resolution", value) for value in resolution]
    coefficients = [0.0] * 4
    if lens != "none":
        coefficients = documents.numbers(
            path, "distortion_coeffs", documents.entry(path, chain, "distortion_coeffs"), count=4
        )
    return documents.create_camera(path, size, pinhole, coefficients, _MODELS[lens])


def _chain(camera: Camera) -> dict[str, Any]:
    documents.check_opencv_model(camera)
    is_radtan = camera.model == "opencv"
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": "radtan" if is_radtan else "equidistant",
        "distortion_coeffs": list(documents.fit_length(camera, 4) if is_radtan else camera.coefficients),
        "resolution": [camera.width, camera.height],
    }
