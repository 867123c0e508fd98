"""Readers of settings and lens profiles of single programs: ORB-SLAM, VINS, Gyroflow, lensfun and Metashape.

Each takes the parsed file, raises ValueError with the name of the file if it does not hold what the reader describes,
and refuses a lens that no model of this library computes exactly.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

from torchrefract._validation import check_count, check_positive
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.documents import CALIBRATE, HALF_PIXEL, Document, abbreviate, list_names, xml_document

_ORB_SLAM_MODELS = {"PinHole": "opencv", "Pinhole": "opencv", "Rectified": "opencv", "KannalaBrandt8": "fisheye"}
# The model here, and the names of focal lengths, center and coefficients.
_VINS_MODELS = {
    "PINHOLE": ("opencv", ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2")),
    "KANNALA_BRANDT": ("fisheye", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
}
_GYROFLOW_MODELS = {"opencv_fisheye": "fisheye", "opencv_standard": "opencv"}
_LENSFUN_TYPES = {"rectilinear": "opencv", "fisheye": "fisheye"}  # lensfun's fisheye is the equidistant one
_METASHAPE_TYPES = {"frame": "opencv", "fisheye": "fisheye"}
_FILM_DIAGONAL_MM = math.hypot(36, 24)  # of crop factor 1
_MAX_ASPECT_ERROR = 0.01
_NO_EXACT_LENS = "; no lens model here computes it exactly: calibrate the camera with python -m torchrefract.calibrate"


def orb_slam_rows(document: Document) -> dict[str, Callable[[], Camera]]:
    """Return functions that create the cameras of settings of ORB-SLAM 2 and 3, by their prefixes Camera or Camera1."""
    fields = [re.fullmatch(r"(Camera\d*)\.fx", str(key)) for key in document.values]
    return {field[1]: partial(_orb_slam_camera, document, field[1]) for field in fields if field}


def _orb_slam_camera(document: Document, prefix: str, *, width: int | None = None, height: int | None = None) -> Camera:
    values = {"Camera.type": "PinHole"} | document.values
    document = Document(document.path, values)
    model = document.choice("Camera.type", _ORB_SLAM_MODELS, remedy=_NO_EXACT_LENS)
    terms = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    stated = [str(key) for key in values if re.fullmatch(rf"{prefix}\.[kp]\d", str(key))]
    if other := [key for key in stated if key.rpartition(".")[2] not in terms]:
        raise ValueError(
            f"path must hold {', '.join(terms)} of a {values['Camera.type']}, got {document.path} with {other[0]}; "
            "state Camera.type"
        )
    if model == "opencv":
        values |= {f"{prefix}.{term}": 0.0 for term in terms if f"{prefix}.{term}" not in values}
    numbers = [document.number(f"{prefix}.{name}") for name in ("fx", "fy", "cx", "cy", *terms)]
    return document.camera(document.size(width, height, prefix="Camera."), numbers[:4], numbers[4:], model)


def vins_camera(document: Document) -> Camera:
    """Return the camera of a file of VINS, of the library camodocal; its k2 ... k5 are the k1 ... k4 of "fisheye"."""
    model, center, terms = document.choice("model_type", _VINS_MODELS, remedy=CALIBRATE)
    parts = ("distortion_parameters", "projection_parameters")
    merged = {k: v for part in parts if part in document.values for k, v in document.child(part).values.items()}
    parameters = Document(document.path, merged)
    numbers = [parameters.number(name) for name in (*center, *terms)]
    return document.camera(document.size(None, None), numbers[:4], numbers[4:], model)


def gyroflow_camera(document: Document) -> Camera:
    """Return the camera of a Gyroflow lens profile, of frames of calib_dimension.

    opencv_fisheye becomes "fisheye" and opencv_standard "opencv". The principal point is the middle of the frame unless
    the profile is asymmetrical: Gyroflow ignores the stored one, which is that of another specimen. Profiles of
    stretched frames, of a digital lens (GoPro's SuperView), of several focal lengths, and of other distortion models
    raise ValueError.
    """
    values = {"distortion_model": "opencv_fisheye"} | {k: v for k, v in document.values.items() if v is not None}
    document = Document(document.path, values)
    for name in ("digital_lens", "interpolations", "input_horizontal_stretch", "input_vertical_stretch", "crop"):
        value = values.get(name)
        # Gyroflow writes a stretch of 0 or 1 for none.
        if value and value != 1:
            raise ValueError(
                f"path must hold a lens profile without {name}, got {document.path} with {abbreviate(value)}"
                f"{_NO_EXACT_LENS}"
            )
    model = document.choice("distortion_model", _GYROFLOW_MODELS, remedy=_NO_EXACT_LENS)
    size, lens = document.child("calib_dimension"), document.child("fisheye_params")
    coefficients = lens.numbers("distortion_coeffs", is_matrix=True)
    if values.get("use_opencv_fisheye") is False:
        raise ValueError(
            f"path must hold a profile of OpenCV's fisheye, got {document.path} with use_opencv_fisheye of false"
            f"{_NO_EXACT_LENS}"
        )
    # Gyroflow computes a fisheye whose coefficients are all zero as a pinhole.
    if not any(coefficients):
        model, coefficients = "opencv", [0.0] * 4
    width, height = size.integer("w"), size.integer("h")
    fx, fy, *center = lens.pinhole("camera_matrix")
    if not values.get("asymmetrical"):
        center = (width - 1) / 2, (height - 1) / 2
    return document.camera((width, height), (fx, fy, *center), coefficients, model)


def metashape_camera(path: Path, root: ElementTree.Element) -> Camera:
    """Return the camera of a calibration that Metashape (Agisoft) saves as XML.

        u = W / 2 + cx + f x' + b1 x',  x' = x (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + P1 (r^2 + 2 x^2) + 2 P2 x y

    P1 and P2 are OpenCV's p2 and p1. "frame" becomes "opencv", or "polynomial12" with K4; "fisheye" becomes "fisheye".

    Source: Agisoft, "Metashape User Manual", appendix on camera models.
    """
    document = xml_document(path, root)
    if "fx" in document.values:
        raise ValueError(
            f"path must hold a calibration with f, got {path} with fx, as PhotoScan wrote before version 1.2; open it "
            "in Metashape and save it again, or as OpenCV's XML"
        )
    model = document.choice("projection", _METASHAPE_TYPES, remedy=_NO_EXACT_LENS)
    names = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    f = document.number("f")
    number = {name: document.number(name) if name in document.values else 0.0 for name in names}
    unsupported = ("b2", "p3", "p4", *(("p1", "p2") if model == "fisheye" else ()))
    if wrong := [name for name in unsupported if number[name]]:
        raise ValueError(
            f"path must hold a calibration of a {document.values['projection']} without {wrong[0]}, got {path} with "
            f"{number[wrong[0]]:g}; optimize the cameras in Metashape without it"
        )
    k1, k2, k3, k4, p1, p2 = (number[name] for name in ("k1", "k2", "k3", "k4", "p2", "p1"))
    coefficients: Sequence[float] = (k1, k2, p1, p2, k3)
    if model == "fisheye":
        coefficients = (k1, k2, k3, k4)
    elif k4:
        model, coefficients = "polynomial12", (k1, k2, k3, k4, 0.0, 0.0, p1, p2, 0.0, 0.0, 0.0, 0.0)
    width, height = document.integer("width"), document.integer("height")
    center = (side / 2 + number[name] - HALF_PIXEL for side, name in ((width, "cx"), (height, "cy")))
    return document.camera((width, height), (f + number["b1"], f, *center), coefficients, model)


def lensfun_rows(path: Path, root: ElementTree.Element) -> dict[str, Callable[..., Camera]]:
    """Return functions that create the cameras of the lenses in a file of lensfun's database, by their models.

        poly3:  r_d = r_u (1 - k1 + k1 r_u^2)
        poly5:  r_d = r_u (1 + k1 r_u^2 + k2 r_u^4)
        ptlens: r_d = r_u (1 - a - b - c + c r_u + b r_u^2 + a r_u^3)

    r is 1 at half of the shorter side of the sensor that the lens was calibrated with. With r in focal lengths poly3,
    poly5, and ptlens without a and c become k1 and k2 of "opencv", or of "fisheye" for a lens of the type fisheye.
    Odd powers and other types have no exact counterpart and raise ValueError. The functions take

        focal_mm: one of the focal lengths that the lens was calibrated at; may be None if it is one.
        width, height: of the frames, px; the file does not hold them.
        crop_factor: of the frames, 43.27 mm / their diagonal; None if they show the whole sensor of the calibration.

    Source: lensfun, manual, "Correction models".
    """
    lenses = [lens for lens in root.iter("lens") if lens.find(".//distortion") is not None]
    counts, rows = Counter(lens.findtext("model") for lens in lenses), dict[str, Callable[..., Camera]]()
    for lens in lenses:
        name = str(lens.findtext("model"))
        if counts[name] > 1:
            name += f" (crop factor {lens.findtext('cropfactor')})"
        name += f", number {len(rows) + 1}" if name in rows else ""
        rows[name] = partial(_lensfun_camera, Path(f"{path}, {name},"), lens)
    return rows


def _lensfun_camera(
    path: Path,
    lens: ElementTree.Element,
    *,
    focal_mm: float | None = None,
    width: int | None = None,
    height: int | None = None,
    crop_factor: float | None = None,
) -> Camera:
    calibration, distortion, focal = _choose_distortion(path, lens, focal_mm)
    if width is None or height is None:
        raise ValueError(f"width and height must be those of the frames, which {path} does not hold, got None")
    check_count("width", width)
    check_count("height", height)
    kind = Document(path, {"type": lens.findtext("type") or "rectilinear"})
    model = kind.choice("type", _LENSFUN_TYPES, remedy=_NO_EXACT_LENS)
    for element in ("center", "fov", "field-of-view"):
        if lens.find(f".//{element}") is not None:
            raise ValueError(f"path must hold a lens without {element}, got {path} with it{_NO_EXACT_LENS}")
    calibrated_crop = _positive(path, "cropfactor", calibration.get("cropfactor") or lens.findtext("cropfactor"))
    ratio = calibration.get("aspect-ratio") or lens.findtext("aspect-ratio") or "3:2"
    long, _, short = ratio.partition(":")
    aspect = _positive(path, "aspect-ratio", long) / (_positive(path, "aspect-ratio", short) if short else 1.0)
    frame_aspect = max(width, height) / min(width, height)
    if crop_factor is None and abs(frame_aspect / aspect - 1) > _MAX_ASPECT_ERROR:
        raise ValueError(
            f"width and height must have the aspect ratio {ratio} of {path} unless crop_factor states the part of the "
            f"sensor that the frames show, got {width} x {height}"
        )
    crop_factor = calibrated_crop if crop_factor is None else check_positive("crop_factor", crop_factor)

    center_factor, k1, k2 = _lensfun_terms(path, distortion)
    if not center_factor > 0:
        raise ValueError(f"path must hold a distortion that grows at the center, got {path} with {center_factor:g}")
    measured = [distortion, *calibration.findall("real-focal-length")]
    real = [m.get("real-focal") for m in measured if math.isclose(_positive(path, "focal", m.get("focal")), focal)]
    real_mm = next((_positive(path, "real-focal", text) for text in real if text), focal * center_factor)
    half_height_mm = _FILM_DIAGONAL_MM / calibrated_crop / math.hypot(aspect, 1) / 2
    scale = real_mm / half_height_mm / center_factor  # of r_u, from focal lengths
    square = scale * scale
    coefficients = (k1 * square / center_factor, k2 * square * square / center_factor, 0.0, 0.0)
    pixel_mm = _FILM_DIAGONAL_MM / crop_factor / math.hypot(width, height)
    pinhole = (real_mm / pixel_mm, real_mm / pixel_mm, (width - 1) / 2, (height - 1) / 2)
    return Document(path, {}).camera((width, height), pinhole, coefficients, model)


def _choose_distortion(
    path: Path, lens: ElementTree.Element, focal_mm: float | None
) -> tuple[ElementTree.Element, ElementTree.Element, float]:
    """Return the calibration, its distortion of a focal length, and that focal length in mm."""
    rows = [
        (calibration, distortion, _positive(path, "focal", distortion.get("focal")))
        for calibration in lens.findall("calibration")
        for distortion in calibration.findall("distortion")
    ]
    if focal_mm is not None:
        check_positive("focal_mm", focal_mm)
    chosen = [row for row in rows if focal_mm is None or math.isclose(row[2], focal_mm)]
    if len(chosen) != 1:
        available = list_names(f"{focal:g}" for *_, focal in rows)
        raise ValueError(
            f"focal_mm must be one of the focal lengths, in mm, that {path} was calibrated at once: {available}; got "
            f"{focal_mm}"
        )
    return chosen[0]


def _lensfun_terms(path: Path, distortion: ElementTree.Element) -> tuple[float, float, float]:
    """Return c, k1, k2 of r_d = r_u (c + k1 r_u^2 + k2 r_u^4)."""
    model, zeros = distortion.get("model"), dict.fromkeys(("k1", "k2", "a", "b", "c"), 0.0)
    k1, k2, a, b, c = map(Document(path, zeros | distortion.attrib).number, zeros)
    if model == "poly3":
        return 1 - k1, k1, 0.0
    if model == "poly5":
        return 1.0, k1, k2
    if model != "ptlens" or a or c:
        terms = f" and a = {a:g}, c = {c:g}, odd powers of the radius" if model == "ptlens" else ""
        raise ValueError(
            f"path must hold poly3, poly5, or ptlens with a = 0 and c = 0, got {path} with {model}{terms}"
            f"{_NO_EXACT_LENS}"
        )
    return 1 - b, b, 0.0


def _positive(path: Path, name: str, text: str | None) -> float:
    value = Document(path, {name: text}).number(name)
    if not 0 < value < math.inf:
        raise ValueError(f"path must hold a number above 0 as {name}, got {path} with {value:g}")
    return value
