"""Cameras in COLMAP's cameras.txt."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io.documents import (
    camera_of,
    numbers,
    read_text,
    shortened,
    shown,
    unknown_model,
    whole,
    write_text,
)

# Pinhole and coefficients out of the parameters. COLMAP's order: f or fx fy, cx, cy, then the lens.
_Parts = tuple[Sequence[float], Sequence[float]]
_READERS: dict[str, tuple[int, str, Callable[[Sequence[float]], _Parts]]] = {
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
_HALF = 0.5  # px: COLMAP counts from the corner of the first pixel


def read_colmap(path: str | Path) -> dict[int, Camera]:
    """The cameras of a cameras.txt by their numbers.

    Pinholes, radial models, OPENCV and FULL_OPENCV are the model "opencv", those with FISHEYE "fisheye". Principal
    points move by half a pixel: COLMAP has the center of the first pixel at (0.5, 0.5).

    Raises:
        ValueError: a line that is no camera; a model without a counterpart here (FOV, THIN_PRISM_FISHEYE ...).
    """
    path = Path(path)
    lines = [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    return dict(_camera(path, words) for words in lines)


def write_colmap(path: str | Path, cameras: Mapping[int, Camera]) -> None:
    """A cameras.txt that `read_colmap` and COLMAP read.

    A camera is PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE, the first that holds its coefficients.

    Args:
        path: to write.
        cameras: by their numbers, of the model "fisheye", or "opencv" without prism and tilt.

    Raises:
        ValueError: another model, other coefficients.
    """
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", f"# Number of cameras: {len(cameras)}"]
    for number, camera in cameras.items():
        model, coefficients = _named(camera)
        pinhole = (camera.fx, camera.fy, camera.cx + _HALF, camera.cy + _HALF)
        values = " ".join(map(repr, (*pinhole, *coefficients)))
        lines.append(f"{number} {model} {camera.width} {camera.height} {values}")
    write_text(Path(path), "\n".join(lines) + "\n")


def _camera(path: Path, words: list[str]) -> tuple[int, Camera]:
    if len(words) < 4:
        raise ValueError(
            f"path must have a number, model, width and height in each line, got {path} with {shown(words)}"
        )
    number, width, height = (whole(path, "CAMERA_ID, WIDTH or HEIGHT", words[i]) for i in (0, 2, 3))
    if words[1] not in _READERS:
        raise ValueError(f"path must have a camera model of {', '.join(_READERS)}, got {path} with {words[1][:80]}")
    count, model, parts = _READERS[words[1]]
    (fx, fy, cx, cy), coefficients = parts(numbers(path, f"parameters of {words[1]}", words[4:], count=count))
    return number, camera_of(path, (width, height), (fx, fy, cx - _HALF, cy - _HALF), coefficients, model)


def _named(camera: Camera) -> tuple[str, Sequence[float]]:
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", camera.coefficients
    if camera.model != "opencv":
        raise unknown_model(camera, "opencv or fisheye")
    if not any(camera.coefficients):
        return "PINHOLE", ()
    few = not any(camera.coefficients[4:])
    return ("OPENCV", shortened(camera, 4)) if few else ("FULL_OPENCV", shortened(camera, 8))
