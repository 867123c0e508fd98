"""Readers and writers of camera files; YAML needs the `calibration` extra.

`read_camera` takes every form. The other readers take one, and return all cameras where it holds several. All raise
ValueError with the name of the file if it does not hold what they describe. Writers raise ValueError if the format
cannot hold the camera; readers of the path find the old file or the complete new one.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from torchrefract._io import write_file
from torchrefract._validation import check_choice, warn
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.colmap import colmap_rows, is_colmap, read_colmap, write_colmap
from torchrefract.cameras.documents import (
    CALIBRATE,
    Document,
    abbreviate,
    dump_yaml,
    fit_coefficients,
    list_names,
    parse_documents,
    parse_xml,
    read_text,
    xml_document,
)
from torchrefract.cameras.lens_profiles import (
    gyroflow_camera,
    lensfun_rows,
    metashape_camera,
    orb_slam_rows,
    vins_camera,
)

__all__ = [
    "OPENCV_SUFFIXES",
    "read_camera",
    "read_colmap",
    "read_covariance",
    "read_kalibr",
    "read_opencv",
    "read_ros",
    "write_colmap",
    "write_kalibr",
    "write_opencv",
    "write_ros",
]

OPENCV_SUFFIXES = (".xml", ".yml", ".yaml")  # of the files that `write_opencv` writes
_ROS_MODELS = {"plumb_bob": "opencv", "rational_polynomial": "opencv", "equidistant": "fisheye"}
_KALIBR_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}
# Names for the matrix of the pinhole and for the coefficients, in any case, with or without underscores.
_MATRIX = ("camera_matrix", "K", "mtx", "intrinsic_matrix")
_COEFFICIENTS = ("distortion_coefficients", "D", "dist", "dist_coeffs", "dist_coeff", "dist_coefs")


def read_camera(
    path: str | Path,
    *,
    name: str | int | None = None,
    width: int | None = None,
    height: int | None = None,
    model: str | None = None,
    focal_mm: float | None = None,
    crop_factor: float | None = None,
) -> Camera:
    """Read one camera from a file of another program.

    The content tells the form: YAML, JSON or XML of OpenCV's FileStorage, and the same names in other YAML and JSON; a
    camera_info file of ROS or a recorded topic of it (`ros2 topic echo`); a camchain.yaml of Kalibr; cameras.txt,
    cameras.bin or the folder of a COLMAP model; settings of ORB-SLAM and VINS; a lens profile of Gyroflow; a file of
    lensfun's database; a calibration that Metashape saved as XML. An empty list of coefficients is no distortion.

    Args:
        path: of the file, or of a folder of COLMAP.
        name: of the camera in a file of several: cam0 of Kalibr, the id of COLMAP, the lens of lensfun, Camera1.
        width, height: of the frames, px, for a file that does not state them.
        model: "opencv" or "fisheye", for a file that does not state to which of them its four coefficients belong; None
            takes "opencv" there, and warns.
        focal_mm, crop_factor: of a lens of lensfun, see `lens_profiles.lensfun_rows`.

    Raises:
        ValueError: the file is of another form, has no exact counterpart here, leaves open what the arguments state,
            or contradicts them.

    Warns:
        UserWarning: four coefficients are taken as k1, k2, p1, p2 without a statement of the model; the principal point
            is more than 0.15 widths or heights off the middle, as for frames of another size.
    """
    if model is not None:
        check_choice("model", model, ("opencv", "fisheye"))
    form = _recognize(Path(path))
    options = {"name": name, "width": width, "height": height, "model": model}
    options |= {"focal_mm": focal_mm, "crop_factor": crop_factor}
    given = {key: value for key, value in options.items() if value is not None}
    if unused := [key for key in given if key not in form.options]:
        raise ValueError(f"{unused[0]} must be None for a file of {form.program}, got {given[unused[0]]!r} with {path}")
    chosen = [camera for key, camera in form.cameras.items() if name is None or str(name) == str(key)]
    if len(chosen) != 1:
        raise ValueError(
            f"name must be one of the cameras in {path}: {list_names(form.cameras)}; got {name!r}; state name "
            "in read_camera, or camera_name in rectify, or keep one camera in the file"
        )
    given.pop("name", None)
    return chosen[0](**given)


def read_opencv(path: str | Path) -> Camera:
    """Read image_width, image_height, camera_matrix, distortion_coefficients and fisheye_model of a camera.

    The model is "fisheye" if fisheye_model is present and not 0, "division" if division_model is, otherwise "opencv".
    Four coefficients without fisheye_model may be of two models: they are taken as k1, k2, p1, p2, with a warning.

    Args:
        path: of YAML, JSON or XML.

    Raises:
        ValueError: a file of another form, or a camera that no model here computes exactly.
    """
    return _plain_camera(_storage(Path(path)))


def read_covariance(path: str | Path) -> np.ndarray | None:
    """Read the covariance (4 + n, 4 + n) of fx, fy, cx, cy and n coefficients from a file of `write_opencv`.

    Returns None if the file has none. `LensDistortion.from_camera` takes the result.
    """
    if is_colmap(Path(path)):
        return None
    document = _storage(Path(path))[0]
    if "covariance" not in document.values:
        return None
    size = 4 + len(document.numbers("distortion_coefficients", is_matrix=True))
    return np.array(document.numbers("covariance", count=size * size, is_matrix=True)).reshape(size, size)


def _storage(path: Path) -> list[Document]:
    text = read_text(path)
    if text.lstrip().startswith("<") or path.suffix.lower() == ".xml":
        return [xml_document(path, parse_xml(path, text))]
    return parse_documents(path, text)


def write_opencv(path: str | Path, camera: Camera, *, covariance: np.ndarray | None = None) -> None:
    """Write a file that `read_opencv` and `cv2.FileStorage` read.

    Args:
        path: ending in .xml, .yml or .yaml.
        camera: of the model "opencv", "fisheye" or "division"; OpenCV itself computes nothing with the last.
        covariance: (4 + n, 4 + n), of fx, fy, cx, cy and the n coefficients; None writes none.

    Raises:
        ValueError: "polynomial12", see `convert`; a covariance of another shape; another suffix.
    """
    path, coefficients = Path(path), camera.coefficients
    scalars = {"image_width": camera.width, "image_height": camera.height}
    if camera.model == "division":
        scalars["division_model"] = 1
    else:
        coefficients = fit_coefficients(camera, (len(coefficients),))
        scalars["fisheye_model"] = int(camera.model == "fisheye")
    matrices = {"camera_matrix": _matrix(3, chain(*camera.matrix))}
    matrices["distortion_coefficients"] = _matrix(len(coefficients), coefficients)
    if covariance is not None:
        size = 4 + len(coefficients)
        if np.shape(covariance) != (size, size):
            raise ValueError(f"covariance must have shape ({size}, {size}), got {np.shape(covariance)}")
        matrices["covariance"] = _matrix(size, np.asarray(covariance, dtype=float).ravel().tolist())
    if path.suffix.lower() not in OPENCV_SUFFIXES:
        raise ValueError(f"path must end in .xml, .yml or .yaml, got {path}")
    if path.suffix.lower() == ".xml":
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
    write_file(path, "\n".join(lines) + "\n")


def read_ros(path: str | Path) -> Camera:
    """Read a camera_info file, as camera_calibration_parsers does.

    Reads a recorded topic as well. plumb_bob and rational_polynomial become "opencv", equidistant becomes "fisheye".
    The rectification and projection matrices are ignored: they describe a rectified view.

    Raises:
        ValueError: a file of another form, or a camera that no model here computes exactly.
    """
    documents = _storage(Path(path))
    documents[0].get("distortion_model")
    return _plain_camera(documents)


def write_ros(path: str | Path, camera: Camera, *, name: str = "camera") -> None:
    """Write a camera_info file that `read_ros` and ROS read, for frames that are not rectified.

    Args:
        path: to write.
        camera: "fisheye", or "opencv" without prism and tilt.
        name: of the camera.

    Raises:
        ValueError: a model, or coefficients, that the file cannot hold; see `convert`.
    """
    coefficients = fit_coefficients(camera, (5, 8))
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
    write_file(Path(path), dump_yaml(document))


def read_kalibr(path: str | Path) -> dict[str, Camera]:
    """Read the cameras of a camchain.yaml by their names, without poses and time offsets.

    Pinholes with radtan (k1, k2, p1, p2) or none become "opencv", with equidistant "fisheye". A camera with another
    camera_model (omni, eucm, ds) or distortion_model (fov) raises ValueError.
    """
    return {name: camera() for name, camera in _kalibr_rows(_storage(Path(path))).items()}


def write_kalibr(path: str | Path, cameras: Mapping[str, Camera]) -> None:
    """Write a camchain.yaml that `read_kalibr` reads, without poses.

    Args:
        path: to write.
        cameras: by their names, such as cam0; "fisheye", or "opencv" with k1, k2, p1, p2 only.

    Raises:
        ValueError: a model, or coefficients, that the file cannot hold; see `convert`.
    """
    chains = {
        name: {
            "camera_model": "pinhole",
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion_model": "radtan" if camera.model == "opencv" else "equidistant",
            "distortion_coeffs": list(fit_coefficients(camera, (4,))),
            "resolution": [camera.width, camera.height],
        }
        for name, camera in cameras.items()
    }
    write_file(Path(path), dump_yaml(chains))


class _Form(NamedTuple):
    """The form of a camera file."""

    program: str
    options: tuple[str, ...]  # arguments of `read_camera` that it takes
    cameras: Mapping[Any, Callable[..., Camera]]  # by their names; functions of the options but for name


def _recognize(path: Path) -> _Form:
    if is_colmap(path):
        return _Form("COLMAP", ("name",), colmap_rows(path))
    try:
        text = read_text(path)
    except ValueError as error:
        raise _unknown_form(path, "binary data") from error
    if text.lstrip().startswith("<"):
        return _recognize_xml(path, parse_xml(path, text))
    try:
        documents = parse_documents(path, text)
    except ValueError as error:
        raise _unknown_form(path, f"other text ({error})") from error
    return _recognize_values(documents)


def _recognize_xml(path: Path, root: ElementTree.Element) -> _Form:
    if root.tag == "lensdatabase":
        return _Form("lensfun", ("name", "width", "height", "focal_mm", "crop_factor"), lensfun_rows(path, root))
    if root.tag == "calibration":
        return _Form("Metashape", (), {"": partial(metashape_camera, path, root)})
    if root.tag != "opencv_storage":
        raise _unknown_form(path, f"<{root.tag}>")
    return _recognize_values([xml_document(path, root)])


def _recognize_values(documents: Sequence[Document]) -> _Form:
    first, values = documents[0], documents[0].values
    if "fisheye_params" in values or "calib_dimension" in values:
        return _Form("Gyroflow", (), {"": partial(gyroflow_camera, first)})
    if any(isinstance(value, dict) and "camera_model" in value for value in values.values()):
        return _Form("Kalibr", ("name",), _kalibr_rows(documents))
    if rows := orb_slam_rows(first):
        return _Form("ORB-SLAM", ("name", "width", "height"), rows)
    if "model_type" in values and "projection_parameters" in values:
        return _Form("VINS", (), {"": partial(vins_camera, first)})
    if first.find(*_MATRIX) not in values:
        raise _unknown_form(first.path, list_names(values))
    return _Form("OpenCV or ROS", ("width", "height", "model"), {"": partial(_plain_camera, documents)})


def _unknown_form(path: Path | str, content: str) -> ValueError:
    return ValueError(
        "path must hold a camera of OpenCV, ROS, Kalibr, COLMAP, ORB-SLAM, VINS, Gyroflow, lensfun or Metashape, got "
        f"{path} with {content}; create torchrefract.Camera(...) of its numbers"
    )


def _plain_camera(documents: Sequence[Document], **given: Any) -> Camera:
    """Return the camera that all documents of a file describe by the names of OpenCV and ROS."""
    cameras = Counter(_document_camera(document, **given) for document in documents)
    if len(cameras) > 1:
        raise ValueError(
            f"path must hold one camera, got {documents[0].path} with messages of {len(cameras)} different ones; keep "
            "those of one"
        )
    return next(iter(cameras))


def _document_camera(
    document: Document, *, width: int | None = None, height: int | None = None, model: str | None = None
) -> Camera:
    path, values = document.path, document.values
    pinhole = document.pinhole(document.find(*_MATRIX))
    size = document.size(width, height)
    region, frame = values.get("roi"), {"x_offset": 0, "y_offset": 0, "width": size[0], "height": size[1]}
    if isinstance(region, dict) and any(region.get(key) not in (None, 0, side) for key, side in frame.items()):
        raise ValueError(
            f"path must describe whole frames, got {path} with the roi {abbreviate(region)}; remove roi, and use "
            "camera.cropped"
        )
    binning = [document.integer(key) for key in ("binning_x", "binning_y") if values.get(key) is not None]
    if any(number not in (0, 1) for number in binning):
        raise ValueError(
            f"path must describe whole frames, got {path} with binning_x and binning_y of {binning}; remove them, and "
            "use camera.resized for frames of the reduced size"
        )
    coefficients = document.numbers(document.find(*_COEFFICIENTS), is_matrix=True)
    stated = _stated_model(document)
    if model is not None and stated not in (None, model):
        raise ValueError(f"model must be {stated} as {path} states, got {model}")
    model = stated or model
    if not coefficients and model == "fisheye":
        raise ValueError(f"path must hold the four coefficients of a fisheye, got {path} without")
    if len(coefficients) == 4 and model is None:
        warn(
            f"the four coefficients of {path} are taken as k1, k2, p1, p2, since it states no lens model; add "
            "fisheye_model: 1 if they are those of cv2.fisheye, or fisheye_model: 0; or state model= in read_camera"
        )
    return document.camera(size, pinhole, coefficients or [0.0] * 4, model or "opencv")


def _stated_model(document: Document) -> str | None:
    # A topic of ROS has an empty text for a camera that is not calibrated, or whose frames are rectified.
    if document.values.get("distortion_model") not in (None, ""):
        return document.choice("distortion_model", _ROS_MODELS, remedy=CALIBRATE)
    if "division_model" in document.values and document.integer("division_model") != 0:
        return "division"
    if "fisheye_model" in document.values:
        return "fisheye" if document.integer("fisheye_model") != 0 else "opencv"
    return None


def _kalibr_rows(documents: Sequence[Document]) -> dict[str, Callable[[], Camera]]:
    first = documents[0]
    if len(documents) > 1:
        raise ValueError(f"path must hold one chain of cameras, got {first.path} with {len(documents)} documents")
    return {str(name): partial(_kalibr_camera, first.child(name)) for name in first.values}


def _kalibr_camera(document: Document) -> Camera:
    document.values.setdefault("distortion_model", "none")
    remedy = "; calibrate again with pinhole-radtan or pinhole-equi"
    document.choice("camera_model", {"pinhole": ""}, remedy=remedy)
    model = document.choice("distortion_model", _KALIBR_MODELS, remedy=remedy)
    coefficients = document.numbers("distortion_coeffs") if "distortion_coeffs" in document.values else []
    kind = document.get("distortion_model")
    if kind == "none" and any(coefficients):
        raise ValueError(
            f"path must have no distortion_coeffs for the distortion_model none, got {document.path} with "
            f"{abbreviate(coefficients)}; state radtan or equidistant"
        )
    if kind == "equidistant" or (kind == "radtan" and coefficients):
        coefficients = document.numbers("distortion_coeffs", count=4)
    size, pinhole = document.integers("resolution", count=2), document.numbers("intrinsics", count=4)
    return document.camera(size, pinhole, coefficients or [0.0] * 4, model)


def _matrix(rows: int, values: Iterable[float]) -> dict[str, Any]:
    data = list(values)
    return {"rows": rows, "cols": len(data) // rows, "data": data}
