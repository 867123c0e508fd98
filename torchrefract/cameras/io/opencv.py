"""Cameras in OpenCV's own files, YAML or XML, under the names of its calibration sample."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import documents

_XML, _YAML = ".xml", (".yml", ".yaml")


def read_opencv(path: str | Path) -> Camera:
    """Read image_width, image_height, camera_matrix, distortion_coefficients and fisheye_model of a camera.

    The model is "fisheye" if fisheye_model is present and not 0, otherwise "opencv".

    Args:
        path: ending in .xml, .yml or .yaml.

    Raises:
        ValueError: the file holds no such camera.
    """
    path = Path(path)
    document = _parse_xml(path) if _is_xml(path) else _parse_yaml(path)
    is_fisheye = "fisheye_model" in document.values and document.integer("fisheye_model")
    return document.camera("fisheye" if is_fisheye else "opencv")


def write_opencv(path: str | Path, camera: Camera) -> None:
    """Write a file that `read_opencv` and `cv2.FileStorage` read.

    Args:
        path: ending in .xml, .yml or .yaml.
        camera: of the model "opencv" or "fisheye".

    Raises:
        ValueError: the camera has another model, or the path another ending.
    """
    path = Path(path)
    documents.check_opencv_model(camera)
    scalars = {"image_width": camera.width, "image_height": camera.height}
    scalars["fisheye_model"] = int(camera.model == "fisheye")
    matrix = [value for row in camera.matrix for value in row]
    matrices = {
        "camera_matrix": (3, 3, matrix),
        "distortion_coefficients": (len(camera.coefficients), 1, list(camera.coefficients)),
    }
    documents.write_text(path, (_xml_text if _is_xml(path) else _yaml_text)(scalars, matrices))


def _is_xml(path: Path) -> bool:
    if path.suffix.lower() not in (_XML, *_YAML):
        raise ValueError(f"path must end in .xml, .yml or .yaml, got {path}")
    return path.suffix.lower() == _XML


def _parse_yaml(path: Path) -> documents.Document:
    # OpenCV's first line, %YAML:1.0, is not a valid directive of YAML.
    text = documents.read_text(path)
    first, _, rest = text.partition("\n")
    return documents.parse_yaml(path, rest if first.startswith("%YAML") else text)


def _parse_xml(path: Path) -> documents.Document:
    try:
        root = ElementTree.fromstring(documents.read_text(path))
    except ElementTree.ParseError as error:
        raise ValueError(f"path must hold XML, got {path}: {error}") from error
    return documents.Document(path, {node.tag: _value(node) for node in root})


def _value(node: ElementTree.Element) -> Any:
    values = {child.tag: (child.text or "").strip() for child in node}
    if "data" in values:
        return values | {"data": values["data"].split()}
    return (node.text or "").strip()


def _yaml_text(scalars: dict[str, int], matrices: dict[str, tuple[int, int, list[float]]]) -> str:
    lines = ["%YAML:1.0", "---", *(f"{name}: {value}" for name, value in scalars.items())]
    for name, (rows, columns, values) in matrices.items():
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
        lines.append(f"   data: [ {', '.join(map(_number, values))} ]")
    return "\n".join(lines) + "\n"


def _xml_text(scalars: dict[str, int], matrices: dict[str, tuple[int, int, list[float]]]) -> str:
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    lines += [f"<{name}>{value}</{name}>" for name, value in scalars.items()]
    for name, (rows, columns, values) in matrices.items():
        data = " ".join(map(_number, values))
        content = f"<rows>{rows}</rows><cols>{columns}</cols><dt>d</dt><data>{data}</data>"
        lines.append(f'<{name} type_id="opencv-matrix">{content}</{name}>')
    return "\n".join([*lines, "</opencv_storage>"]) + "\n"


def _number(value: float) -> str:
    return f"{value:.17e}"
