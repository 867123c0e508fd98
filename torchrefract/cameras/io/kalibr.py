"""Cameras in the camera chains of Kalibr."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import documents

_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}


def read_kalibr(path: str | Path) -> dict[str, Camera]:
    """Read the cameras of a camchain.yaml by their names, without poses and time offsets.

    Pinholes with radtan (k1, k2, p1, p2) or none become "opencv", with equidistant "fisheye".

    Raises:
        ValueError: the file holds no such cameras, or one with another camera_model (omni, eucm, ds) or
            distortion_model (fov).
    """
    path = Path(path)
    document = documents.parse_yaml(path, documents.read_text(path))
    return {str(name): _camera(path, str(name), chain) for name, chain in document.values.items()}


def write_kalibr(path: str | Path, cameras: Mapping[str, Camera]) -> None:
    """Write a camchain.yaml that `read_kalibr` reads, without poses.

    Args:
        path: to write.
        cameras: by their names, such as cam0; "fisheye", or "opencv" with k1, k2, p1, p2 only.

    Raises:
        ValueError: a camera has another model or other coefficients.
    """
    documents.write_text(Path(path), documents.dump_yaml({name: _chain(camera) for name, camera in cameras.items()}))


def _camera(path: Path, name: str, chain: Any) -> Camera:
    if not isinstance(chain, Mapping):
        raise ValueError(f"path must hold a camera as {name}, got {path} with {documents.abbreviate(chain)}")
    values = documents.Document(
        f"{path}, {name},", {**chain, "distortion_model": chain.get("distortion_model", "none")}
    )
    values.choice("camera_model", {"pinhole": ""})
    model = values.choice("distortion_model", _MODELS)
    width, height = (
        documents.integer(values.path, "resolution", value) for value in values.numbers("resolution", count=2)
    )
    has_lens = values.get("distortion_model") != "none"
    coefficients = values.numbers("distortion_coeffs", count=4) if has_lens else [0.0] * 4
    return documents.create_camera(
        values.path, (width, height), values.numbers("intrinsics", count=4), coefficients, model
    )


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
