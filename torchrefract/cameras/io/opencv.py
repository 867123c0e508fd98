"""Cameras in OpenCV's own files, YAML or XML, under the names that its calibration sample uses."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io.documents import (
    camera_of,
    entry,
    numbers,
    read_text,
    shown,
    unknown_model,
    whole,
    write_text,
)
from torchrefract.cameras.io.yaml_documents import parse_yaml

_XML, _YAML = ".xml", (".yml", ".yaml")


def read_opencv(path: str | Path) -> Camera:
    """The camera of a file with image_width, image_height, camera_matrix, distortion_coefficients and fisheye_model.

    Where fisheye_model is missing or 0 the model is "opencv", else "fisheye".

    Args:
        path: ending in .xml, .yml or .yaml.

    Raises:
        ValueError: a file that holds no such camera.
    """
    path = Path(path)
    document = _from_xml(path) if _is_xml(path) else parse_yaml(path, _plain_yaml(read_text(path)))
    size = [whole(path, name, entry(path, document, name)) for name in ("image_width", "image_height")]
    fx, skew, cx, _, fy, cy, *last = _matrix(path, document, "camera_matrix", count=9)
    if skew != 0 or last != [0.0, 0.0, 1.0]:
        raise ValueError(f"path must hold a camera_matrix without skew, got {path} with skew {skew:g}, last row {last}")
    coefficients = _matrix(path, document, "distortion_coefficients")
    fisheye = whole(path, "fisheye_model", document.get("fisheye_model", 0))
    return camera_of(path, size, (fx, fy, cx, cy), coefficients, "fisheye" if fisheye else "opencv")


def write_opencv(path: str | Path, camera: Camera) -> None:
    """A file that `read_opencv` and `cv2.FileStorage` read.

    Args:
        path: ending in .xml, .yml or .yaml.
        camera: of the model "opencv" or "fisheye".

    Raises:
        ValueError: another model, another ending.
    """
    path = Path(path)
    if camera.model not in ("opencv", "fisheye"):
        raise unknown_model(camera, "opencv or fisheye")
    plain = {"image_width": camera.width, "image_height": camera.height}
    plain["fisheye_model"] = int(camera.model == "fisheye")
    matrix = [value for row in camera.matrix for value in row]
    matrices = {
        "camera_matrix": (3, 3, matrix),
        "distortion_coefficients": (len(camera.coefficients), 1, list(camera.coefficients)),
    }
    write_text(path, (_xml_text if _is_xml(path) else _yaml_text)(plain, matrices))


def _is_xml(path: Path) -> bool:
    if path.suffix.lower() not in (_XML, *_YAML):
        raise ValueError(f"path must end in .xml, .yml or .yaml, got {path}")
    return path.suffix.lower() == _XML


def _plain_yaml(text: str) -> str:
    # OpenCV's first line, %YAML:1.0, is no directive of YAML.
    first, _, rest = text.partition("\n")
    return rest if first.startswith("%YAML") else text


def _from_xml(path: Path) -> dict[str, Any]:
    try:
        root = ElementTree.fromstring(read_text(path))
    except ElementTree.ParseError as error:
        raise ValueError(f"path must hold XML, got {path}: {error}") from error
    return {node.tag: _from_node(node) for node in root}


def _from_node(node: ElementTree.Element) -> Any:
    values = {child.tag: (child.text or "").strip() for child in node}
    if "data" in values:
        return values | {"data": values["data"].split()}
    return (node.text or "").strip()


def _matrix(path: Path, document: Any, name: str, *, count: int | None = None) -> list[float]:
    matrix = entry(path, document, name)
    if not isinstance(matrix, dict) or "data" not in matrix:
        raise ValueError(f"path must hold a matrix as {name}, got {path} with {shown(matrix)}")
    return numbers(path, name, matrix["data"], count=count)


def _yaml_text(plain: dict[str, int], matrices: dict[str, tuple[int, int, list[float]]]) -> str:
    lines = ["%YAML:1.0", "---", *(f"{name}: {value}" for name, value in plain.items())]
    for name, (rows, columns, values) in matrices.items():
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
        lines.append(f"   data: [ {', '.join(map(_number, values))} ]")
    return "\n".join(lines) + "\n"


def _xml_text(plain: dict[str, int], matrices: dict[str, tuple[int, int, list[float]]]) -> str:
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    lines += [f"<{name}>{value}</{name}>" for name, value in plain.items()]
    for name, (rows, columns, values) in matrices.items():
        data = " ".join(map(_number, values))
        inside = f"<rows>{rows}</rows><cols>{columns}</cols><dt>d</dt><data>{data}</data>"
        lines.append(f'<{name} type_id="opencv-matrix">{inside}</{name}>')
    return "\n".join([*lines, "</opencv_storage>"]) + "\n"


def _number(value: float) -> str:
    return f"{value:.17e}"
