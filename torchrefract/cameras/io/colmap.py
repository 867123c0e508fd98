"""Cameras in COLMAP's cameras.txt."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import documents

# For each model of COLMAP: its number of parameters, the model here, and how the parameters split into pinhole and
# coefficients. COLMAP's order is f or fx fy, cx, cy, then the lens.
_Parts = tuple[Sequence[float], Sequence[float]]
_MODELS: dict[str, tuple[int, str, Callable[[Sequence[float]], _Parts]]] = {
    "SIMPLE_PINHOLE": (3, "opencv", lambda p: ((p[0], *p), (0.0,) * 4)),
    "PINHOLE": (4, "opencv", lambda p: (p, (0.0,) * 4)),
    "SIMPLE_RADIAL": (4, "opencv", lambda p: ((p[0], *p[:3]), (p[3], 0.0, 0.0, 0.0))),
    "RADIAL": (5, "opencv", lambda p: ((p[0], *p[:3]), (p[3], p[4], 0.0, 0.0))),
    "OPENCV": (8, "opencv", lambda p: (p[:4], p[4:])),
    "FULL_OPENCV": (12, "opencv", lambda p: (p[:4], p[4:])),
    "OPENCV_FISHEYE": (8, "fisheye", lambda p: (p[:4], p[4:])),
    "SIMPLE_RADIAL_FISHEYE": (4, "fisheye", lambda p: ((p[0], *p[:3]), (p[3], 0.0, 0.0, 0.0))),
    "RADIAL_FISHEYE": (5, "fisheye", lambda p: ((p[0], *p[:3]), (p[3], p[4], 0.0, 0.0))),
}
_OFFSET = 0.5  # px: COLMAP has the center of the first pixel at (0.5, 0.5), this library at (0, 0)


def read_colmap(path: str | Path) -> dict[int, Camera]:
    """Read the cameras of a cameras.txt by their ids.

    Pinholes, radial models, OPENCV and FULL_OPENCV become "opencv", models with FISHEYE become "fisheye". The principal
    point moves by half a pixel between COLMAP's convention and the one of this library.

    Raises:
        ValueError: a line is not a camera, or its model has no counterpart (FOV, THIN_PRISM_FISHEYE and others).
    """
    path = Path(path)
    lines = [
        line.split() for line in documents.read_text(path).splitlines() if line.strip() and not line.startswith("#")
    ]
    return dict(_camera(path, words) for words in lines)


def write_colmap(path: str | Path, cameras: Mapping[int, Camera]) -> None:
    """Write a cameras.txt that `read_colmap` and COLMAP read.

    A camera becomes PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE, the first that holds its coefficients.

    Args:
        path: to write.
        cameras: by their ids, "fisheye", or "opencv" without prism and tilt.

    Raises:
        ValueError: a camera has another model or other coefficients.
    """
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", f"# Number of cameras: {len(cameras)}"]
    for number, camera in cameras.items():
        model, coefficients = _model(camera)
        pinhole = (camera.fx, camera.fy, camera.cx + _OFFSET, camera.cy + _OFFSET)
        values = " ".join(map(repr, (*pinhole, *coefficients)))
        lines.append(f"{number} {model} {camera.width} {camera.height} {values}")
    documents.write_text(Path(path), "\n".join(lines) + "\n")


def _camera(path: Path, words: list[str]) -> tuple[int, Camera]:
    if len(words) < 4:
        raise ValueError(
            f"path must have a number, model, width and height in each line, got {path} with "
            f"{documents.abbreviate(words)}"
        )
    number, width, height = (documents.integer(path, "CAMERA_ID, WIDTH or HEIGHT", words[i]) for i in (0, 2, 3))
    if words[1] not in _MODELS:
        raise ValueError(f"path must have a camera model of {', '.join(_MODELS)}, got {path} with {words[1][:80]}")
    count, model, split = _MODELS[words[1]]
    (fx, fy, cx, cy), coefficients = split(documents.numbers(path, f"parameters of {words[1]}", words[4:], count=count))
    return number, documents.create_camera(
        path, (width, height), (fx, fy, cx - _OFFSET, cy - _OFFSET), coefficients, model
    )


def _model(camera: Camera) -> tuple[str, Sequence[float]]:
    documents.check_opencv_model(camera)
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", camera.coefficients
    if not any(camera.coefficients):
        return "PINHOLE", ()
    is_short = not any(camera.coefficients[4:])
    return ("OPENCV", documents.fit_length(camera, 4)) if is_short else ("FULL_OPENCV", documents.fit_length(camera, 8))
