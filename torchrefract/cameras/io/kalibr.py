"""Cameras in the camera chains of Kalibr."""

from collections.abc import Mapping
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

_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}


def read_kalibr(path: str | Path) -> dict[str, Camera]:
    """The cameras of a camchain.yaml by their names, cam0 and on; poses and times are not read.

    Pinholes with radtan (k1, k2, p1, p2) or without distortion are the model "opencv", with equidistant "fisheye".

    Raises:
        ValueError: a file that holds no such cameras; another camera_model (omni, eucm, ds) or distortion_model (fov).
    """
    path = Path(path)
    document = parse_yaml(path, read_text(path))
    return {str(name): _camera(path, str(name), chain) for name, chain in document.items()}


def write_kalibr(path: str | Path, cameras: Mapping[str, Camera]) -> None:
    """A camchain.yaml that `read_kalibr` reads, without poses.

    Args:
        path: to write.
        cameras: by their names, as cam0, of the model "fisheye", or "opencv" with k1, k2, p1, p2 alone.

    Raises:
        ValueError: another model, other coefficients.
    """
    write_text(Path(path), dump_yaml({name: _chain(camera) for name, camera in cameras.items()}))


def _camera(path: Path, name: str, chain: Any) -> Camera:
    if not isinstance(chain, dict):
        raise ValueError(f"path must hold a camera as {name}, got {path} with {shown(chain)}")
    kind, lens = entry(path, chain, "camera_model"), chain.get("distortion_model", "none")
    if kind != "pinhole":
        raise ValueError(f"path must have pinhole as the camera_model of {name}, got {path} with {shown(kind)}")
    if not isinstance(lens, str) or lens not in _MODELS:
        raise ValueError(
            f"path must have a distortion_model of {', '.join(_MODELS)} for {name}, got {path} with {shown(lens)}"
        )
    pinhole = numbers(path, "intrinsics", entry(path, chain, "intrinsics"), count=4)
    resolution = numbers(path, "resolution", entry(path, chain, "resolution"), count=2)
    size = [whole(path, "resolution", value) for value in resolution]
    coefficients = [0.0] * 4
    if lens != "none":
        coefficients = numbers(path, "distortion_coeffs", entry(path, chain, "distortion_coeffs"), count=4)
    return camera_of(path, size, pinhole, coefficients, _MODELS[lens])


def _chain(camera: Camera) -> dict[str, Any]:
    if camera.model not in ("opencv", "fisheye"):
        raise unknown_model(camera, "opencv or fisheye")
    radtan = camera.model == "opencv"
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": "radtan" if radtan else "equidistant",
        "distortion_coeffs": list(shortened(camera, 4) if radtan else camera.coefficients),
        "resolution": [camera.width, camera.height],
    }
