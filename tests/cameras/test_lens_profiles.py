"""Lens profiles of Gyroflow, lensfun and Metashape are read as these define them, or refused with a way out."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from torchrefract.cameras.io import read_camera

FISHEYE = (-0.0137, 0.0207, -0.0128, 0.0025)
MATRIX = [[510.25, 0.0, 322.5], [0.0, 505.75, 237.125], [0.0, 0.0, 1.0]]


def gyroflow(coefficients: tuple[float, ...] = FISHEYE, **changes: Any) -> str:
    profile = {
        "name": "a camera",
        "calib_dimension": {"w": 640, "h": 480},
        "orig_dimension": {"w": 1504, "h": 960},
        "input_horizontal_stretch": 1.0,
        "asymmetrical": True,
        "use_opencv_fisheye": True,
        "fisheye_params": {
            "RMS_error": 0.4,
            "camera_matrix": MATRIX,
            "distortion_coeffs": coefficients,
            "radial_distortion_limit": None,
        },
        "distortion_model": None,
        "digital_lens": None,
        "compatible_settings": [{"width": 320, "height": 240}],
    }
    return json.dumps(profile | changes)


def metashape(terms: dict[str, float], projection: str = "frame") -> str:
    rows = "".join(f"  <{name}>{value!r}</{name}>\n" for name, value in terms.items())
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{projection}</projection>
  <width>640</width>
  <height>480</height>
{rows}  <date>2024-05-01T10:00:00Z</date>
</calibration>
"""


CENTER = {"f": 505.75, "cx": 3.0, "cy": -2.375, "b1": 4.5}  # 322.5 + 0.5 - 320, 237.125 + 0.5 - 240
TERMS = {"k1": -0.28, "k2": 0.17, "k3": -0.05, "p1": -4e-4, "p2": 8e-4}  # P1 and P2 are OpenCV's p2 and p1
K4 = dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
STANDARD = gyroflow((-0.28, 0.17, 8e-4, -4e-4, -0.05), distortion_model="opencv_standard")
PINHOLE = ((0.0,) * 4, "opencv")
# Content, coefficients and model.
PROFILES = {
    "Gyroflow": (gyroflow(), (FISHEYE, "fisheye")),
    "Gyroflow, standard": (STANDARD, ((-0.28, 0.17, 8e-4, -4e-4, -0.05), "opencv")),
    "Gyroflow, no coefficients": (gyroflow(()), PINHOLE),
    "Gyroflow, zeros, which it computes as a pinhole": (gyroflow((0.0,) * 4), PINHOLE),
    "Metashape": (metashape(CENTER | TERMS), ((-0.28, 0.17, 8e-4, -4e-4, -0.05), "opencv")),
    "Metashape, k4": (metashape(CENTER | K4), ((*FISHEYE, *(0.0,) * 8), "polynomial12")),
    "Metashape, fisheye": (metashape(CENTER | K4, "fisheye"), (FISHEYE, "fisheye")),
}


@pytest.mark.quick
@pytest.mark.parametrize("form", PROFILES)
def test_a_profile_is_read_as_its_program_defines_it(form, tmp_path, make_camera):
    content, lens = PROFILES[form]
    (tmp_path / "profile").write_text(content)
    assert read_camera(tmp_path / "profile") == make_camera(*lens)


@pytest.mark.parametrize("stated", [{"asymmetrical": False}, {"asymmetrical": None}])
def test_a_profile_of_gyroflow_that_is_not_asymmetrical_has_its_principal_point_in_the_middle(stated, tmp_path):
    (tmp_path / "profile").write_text(gyroflow(**stated))
    camera = read_camera(tmp_path / "profile")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (510.25, 505.75, 319.5, 239.5)


def lensfun(terms: str, *, kind: str = "", extra: str = "", aspect: str = "4:3") -> str:
    """Return a file of lensfun's database with one lens."""
    return f"""<!DOCTYPE lensdatabase SYSTEM "lensfun-database.dtd">
<lensdatabase version="2">
    <camera><maker>Make</maker><model>Body</model><mount>m</mount><cropfactor>5.5</cropfactor></camera>
    <lens>
        <maker>Make</maker>
        <model>Lens 3mm f/2.8</model>
        <model lang="de">festes Objektiv</model>
        {f"<type>{kind}</type>" if kind else ""}
        <cropfactor>5.5</cropfactor>
        <aspect-ratio>{aspect}</aspect-ratio>
        <calibration>
            <distortion {terms}/>
            {extra}
            <tca model="poly3" focal="3" vr="1.0001" vb="0.9999"/>
        </calibration>
    </lens>
</lensdatabase>
"""


def lensfun_pixels(
    rays: np.ndarray,
    term: Callable[[np.ndarray], np.ndarray],
    *,
    fisheye: bool = False,
    crop: float = 5.5,
    size: tuple[int, int] = (800, 600),
) -> np.ndarray:
    """Project rays (N, 3) by lensfun's definition: radius 1 is half the height of the calibrated sensor, 4:3."""
    tangent = np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]
    half_height_mm = np.hypot(36, 24) / 5.5 * 3 / 5 / 2
    undistorted = 3.0 * (np.arctan(tangent) if fisheye else tangent) / half_height_mm
    radius_mm = term(undistorted) * half_height_mm
    radius_px = radius_mm / (np.hypot(36, 24) / crop / np.hypot(*size))
    directions = rays[:, :2] / rays[:, 2:] / tangent[:, None]
    return directions * radius_px[:, None] + (np.array(size) - 1) / 2


LENSFUN: dict[str, tuple[str, str, Callable[[np.ndarray], np.ndarray]]] = {
    "poly3": ('model="poly3" focal="3" k1="-0.03"', "", lambda r: r * (1.03 - 0.03 * r**2)),
    "poly5": ('model="poly5" focal="3" k1="-0.05" k2="0.006"', "", lambda r: r * (1 - 0.05 * r**2 + 0.006 * r**4)),
    "ptlens": ('model="ptlens" focal="3" a="0" b="-0.02" c="0"', "", lambda r: r * (1.02 - 0.02 * r**2)),
    "fisheye": ('model="poly3" focal="3" k1="-0.03"', "fisheye", lambda r: r * (1.03 - 0.03 * r**2)),
}


@pytest.mark.parametrize("name", LENSFUN)
def test_lenses_of_lensfun_project_as_it_defines(name, rays, tmp_path, oracle):
    terms, kind, function = LENSFUN[name]
    path = tmp_path / "misc.xml"
    path.write_text(lensfun(terms, kind=kind))
    expected = torch.from_numpy(lensfun_pixels(rays.numpy(), function, fisheye=bool(kind)))
    oracle("pixels of lensfun", read_camera(path, width=800, height=600).project(rays).points, expected, 1e-9)
    # A part of the sensor, whose diagonal is smaller by 5.5 / 7.
    part = read_camera(path, width=800, height=400, crop_factor=7, name="Lens 3mm f/2.8", focal_mm=3.0)
    expected = lensfun_pixels(rays.numpy(), function, fisheye=bool(kind), crop=7, size=(800, 400))
    oracle("pixels of a part", part.project(rays).points, torch.from_numpy(expected), 1e-9)


def test_a_measured_focal_length_of_lensfun_is_the_one_at_the_center(tmp_path):
    path = tmp_path / "misc.xml"
    terms = 'model="poly3" focal="3" k1="-0.03"'
    path.write_text(lensfun(f'{terms} real-focal="3.3"'))
    stated = read_camera(path, width=800, height=600)
    path.write_text(lensfun(terms, extra='<real-focal-length focal="3" real-focal="3.3"/>'))
    assert read_camera(path, width=800, height=600) == stated
    assert stated.fx == pytest.approx(3.3 * 1000 * 5.5 / np.hypot(36, 24))
    path.write_text(lensfun(terms))
    assert read_camera(path, width=800, height=600).fx == pytest.approx(stated.fx * 3.0 * 1.03 / 3.3)


def test_the_lens_and_its_focal_length_are_asked_for(tmp_path):
    path = tmp_path / "misc.xml"
    size: dict[str, Any] = {"width": 800, "height": 600}
    one = lensfun('model="poly3" focal="3" k1="-0.03"', extra='<distortion model="poly3" focal="5" k1="0.01"/>')
    path.write_text(one)
    with pytest.raises(
        ValueError, match=r"focal_mm must be one of the focal lengths, .*Lens 3mm.* once: 3, 5; got None"
    ):
        read_camera(path, **size)
    with pytest.raises(ValueError, match="once: 3, 5; got 4"):
        read_camera(path, focal_mm=4.0, **size)
    assert read_camera(path, focal_mm=5.0, **size).coefficients[0] > 0
    first, last = one.index("    <lens>"), one.index("</lensdatabase>")
    lens = one[first:last]
    path.write_text(one[:first] + lens + lens.replace("Lens 3mm", "Other") + lens.replace(">5.5<", ">6<") + one[last:])
    names = r"Lens 3mm f/2.8 \(crop factor 5.5\), Other f/2.8, Lens 3mm f/2.8 \(crop factor 6\)"
    with pytest.raises(ValueError, match=f"name must be one of the cameras in .*: {names}; got 'Lens 3mm f/2.8'"):
        read_camera(path, name="Lens 3mm f/2.8", focal_mm=5.0, **size)
    wide, narrow = (
        read_camera(path, name=f"Lens 3mm f/2.8 (crop factor {crop})", focal_mm=5.0, **size) for crop in ("5.5", "6")
    )
    assert narrow.fx / wide.fx == pytest.approx(6 / 5.5)


NO_LENS = "no lens model here computes it exactly: calibrate the camera"
POLY3 = 'model="poly3" focal="3" k1="-0.03"'
ODD = lensfun('model="ptlens" focal="3" a="0.01" b="-0.03" c="0.02"')
PHOTOSCAN = metashape({"fx": 510.25, "fy": 505.75, "cx": 322.5, "cy": 237.125})
FIELD_OF_VIEW = '<field-of-view focal="3" fov="90"/>'
FRAME: dict[str, Any] = {"width": 800, "height": 600}
# Content, arguments, message.
REFUSED: dict[str, tuple[str, dict[str, Any], str]] = {
    "Gyroflow, another model": (gyroflow(distortion_model="gopro"), {}, f"of opencv_f.*, got .* 'gopro'; {NO_LENS}"),
    "Gyroflow, SuperView": (gyroflow(digital_lens="gopro_superview"), {}, f"l_lens, got .*_superview'; {NO_LENS}"),
    "Gyroflow, stretched": (gyroflow(input_horizontal_stretch=1.33), {}, "input_horizontal_stretch, got .* 1.33"),
    "Gyroflow, zoom": (gyroflow(interpolations={"18": {}}), {}, "without interpolations"),
    "Gyroflow, no size": (gyroflow(calib_dimension=None), {}, "must hold calib_dimension"),
    "Gyroflow, given a size": (gyroflow(), {"width": 320}, "width must be None for a file of Gyroflow, got 320"),
    "lensfun, odd powers": (ODD, FRAME, f"with a = 0 and c = 0, got .*Lens 3mm.*a = 0.01, c = 0.02, .*; {NO_LENS}"),
    "lensfun, another model": (lensfun('model="acm" focal="3"'), FRAME, "hold poly3, poly5, or .*, got .* with acm"),
    "lensfun, another type": (
        lensfun(POLY3, kind="equisolid"),
        FRAME,
        "of rectilinear, fisheye, got .*'equisolid'",
    ),
    "lensfun, no size": (lensfun(POLY3), {}, "width and height must be those of the frames, which .* does not hold"),
    "lensfun, 16:9": (lensfun(POLY3), FRAME | {"height": 450}, "aspect ratio 4:3 of .* unless crop_factor .*800 x 450"),
    "lensfun, field of view": (lensfun(POLY3, extra=FIELD_OF_VIEW), FRAME, "without field-of-view"),
    "Metashape, p1 of a fisheye": (metashape(CENTER | {"p1": 0.1}, "fisheye"), {}, "without p1, got .* 0.1; optimize"),
    "Metashape, skew": (metashape(CENTER | {"b2": 0.3}), {}, "of a frame without b2, got .* with 0.3; optimize"),
    "Metashape, spherical": (metashape(CENTER, "spherical"), {}, f"frame, fisheye, got .* 'spherical'; {NO_LENS}"),
    "PhotoScan": (PHOTOSCAN, {}, "got .* with fx, as PhotoScan .*; open it in Metashape"),
}


@pytest.mark.quick
@pytest.mark.parametrize("case", REFUSED)
def test_a_profile_without_an_exact_camera_raises_with_the_way_out(case, tmp_path):
    content, options, rule = REFUSED[case]
    (tmp_path / "profile").write_text(content)
    with pytest.raises(ValueError, match=rule):
        read_camera(tmp_path / "profile", **options)


def test_published_profiles_are_read(shared_data, published, tmp_path):
    rows = {row["id"]: row for row in json.loads((shared_data / "lenses.json").read_text())}
    path, num_read = tmp_path / "profile", 0
    for key, camera in published.items():
        if rows[key]["source_repo"] == "gyroflow/lens_profiles":
            parameters = {"camera_matrix": camera.matrix, "distortion_coeffs": camera.coefficients}
            size = {"w": camera.width, "h": camera.height}
            path.write_text(gyroflow(calib_dimension=size, fisheye_params=parameters))
            assert read_camera(path) == camera
            num_read += 1
    assert num_read == 26
    num_exact = 0
    for row in rows.values():
        if row["model"].startswith("lensfun"):
            kind, model = row["note"].partition("projection ")[2].partition(";")[0], row["model"].partition("-")[2]
            names = ("k1",) if model == "poly3" else ("a", "b", "c")
            terms = " ".join(f'{name}="{value}"' for name, value in zip(names, row["coeffs"], strict=True))
            path.write_text(lensfun(f'model="{model}" focal="{row["focal_mm"]}" {terms}', kind=kind))
            if kind in ("", "fisheye") and model == "poly3":
                assert read_camera(path, **FRAME).coverage() == 1
                num_exact += 1
            else:
                with pytest.raises(ValueError, match=NO_LENS):
                    read_camera(path, **FRAME)
    assert num_exact == 7
