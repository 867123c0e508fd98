"""Errors of all readers and writers name the file and the rule."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from torchrefract.cameras.io.colmap import read_colmap, write_colmap
from torchrefract.cameras.io.kalibr import read_kalibr, write_kalibr
from torchrefract.cameras.io.opencv import read_opencv, write_opencv
from torchrefract.cameras.io.ros import read_ros, write_ros

OPENCV = """%YAML:1.0
---
image_width: 64
image_height: 48
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5., 0., 3., 0., 5., 4., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.1, 0., 0., 0. ]
"""
ROS = """image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [438.78, 0.0, 305.59, 0.0, 437.30, 243.74, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.36, 0.11, 0.001, 0.0005, 0.0]}
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.067, 0.0008, 0.0001]
  distortion_model: radtan
  intrinsics: [461.6, 460.1, 362.6, 246.0]
  resolution: [752, 480]
"""


def check(reader: Callable[[Path], Any], path: Path, text: str, rule: str) -> None:
    path.write_text(text)
    with pytest.raises(ValueError, match=rule):
        reader(path)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("64\n", "[64\n", "path must hold YAML, got .*camera.yaml: while parsing"),
        (OPENCV, "just words", "path must hold a mapping of names to values"),
        ("image_width: 64\n", "", "path must hold image_width, got .* with image_height"),
        ("64", "64.5", "path must hold a whole number as image_width, got .* with 64.5"),
        ("64", "wide", "path must hold numbers as image_width, got .* with .'wide'"),
        ("camera_matrix:", "camera_matrix: 7\nother:", "path must hold a matrix as camera_matrix"),
        ("5., 0., 3.", "5., x, 3.", "path must hold numbers as camera_matrix"),
        ("5., 0., 3.", "5., 0., 1., 3.", "path must hold 9 numbers as camera_matrix, got .* with 10"),
        ("5., 0., 3.", "5., 0.5, 3.", "camera_matrix without skew, got .* with skew 0.5"),
        ("distortion_coefficients", "other", "path must hold distortion_coefficients"),
        ("0.1, 0., 0., 0.", "0., 0.", "a camera, got .*: coefficients must be 4"),
        ("0.1", ".nan", "coefficients must not be NaN"),
    ],
)
def test_an_invalid_opencv_file_is_named(old, new, rule, tmp_path):
    check(read_opencv, tmp_path / "camera.yaml", OPENCV.replace(old, new, 1), rule)


def test_invalid_xml_is_named(tmp_path):
    path = tmp_path / "camera.xml"
    check(read_opencv, path, "<opencv_storage><image_width>64", r"path must hold XML, got .*camera.xml: ")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="path must hold text in UTF-8"):
        read_opencv(path)


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("plumb_bob", "thin_prism", "distortion_model of plumb_bob, .*, equidistant, got .*thin_prism"),
        ("438.78, 0.0", "438.78, 2.0", "camera_matrix without skew, got .* with skew 2"),
        ("438.78", "-1", "a camera, got .*ost.yaml: fx must be above 0, got -1"),
        ("data: [438", "date: [438", "path must hold a matrix as camera_matrix, got "),
        ("camera_matrix:", "camera_matrix: 4\nother:", "path must hold a matrix as camera_matrix"),
    ],
)
def test_an_invalid_ros_file_is_named(old, new, rule, tmp_path):
    check(read_ros, tmp_path / "ost.yaml", ROS.replace(old, new, 1), rule)


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("camera_model: pinhole", "camera_model: omni", "camera_model of pinhole, got .*cam0, with 'omni'"),
        ("radtan", "fov", "distortion_model of radtan, equidistant, none, got .*cam0, with 'fov'"),
        ("[752, 480]", "[752]", "path must hold 2 numbers as resolution, got .* with 1"),
        ("246.0]", "246.0, 1.0]", "path must hold 4 numbers as intrinsics"),
        ("0.0001]", "]", "path must hold 4 numbers as distortion_coeffs, got .* with 3"),
        ("  intrinsics: [461.6, 460.1, 362.6, 246.0]\n", "", "path must hold intrinsics, got .* with camera_model"),
        ("cam0:\n", "units: px\ncam0:\n", "path must hold a camera as units, got .* with 'px'"),
    ],
)
def test_an_invalid_kalibr_chain_is_named(old, new, rule, tmp_path):
    check(read_kalibr, tmp_path / "camchain.yaml", KALIBR.replace(old, new, 1), rule)


@pytest.mark.parametrize(
    ("line", "rule"),
    [
        ("1 FOV 640 480 500 505 320 240 0.9", "a camera model of SIMPLE_PINHOLE, .* got .* with FOV"),
        ("1 OPENCV 640 480 500 505 320 240 0.1", "path must hold 8 numbers as parameters of OPENCV, got .* with 5"),
        ("1 PINHOLE 640", "a number, model, width and height in each line"),
        ("1 PINHOLE 640.5 480 1 1 1 1", "path must hold a whole number as CAMERA_ID, WIDTH or HEIGHT"),
        ("1 PINHOLE 640 480 1 x 1 1", "path must hold numbers as parameters of PINHOLE"),
        ("1 PINHOLE 640 480 -1 1 1 1", "a camera, got .*cameras.txt: fx must be above 0"),
    ],
)
def test_an_invalid_colmap_line_is_named(line, rule, tmp_path):
    check(read_colmap, tmp_path / "cameras.txt", f"# Number of cameras: 1\n{line}\n", rule)


WRITERS = {
    "camera.yaml": write_opencv,
    "ost.yaml": write_ros,
    "camchain.yaml": lambda path, camera: write_kalibr(path, {"cam0": camera}),
    "cameras.txt": lambda path, camera: write_colmap(path, {1: camera}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_unsupported_models_are_not_written(name, tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"camera must be of the model opencv or fisheye .* got division"):
        WRITERS[name](tmp_path / name, make_camera((-0.2,), "division"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "count"), [("ost.yaml", 8), ("camchain.yaml", 4), ("cameras.txt", 8)])
def test_coefficients_that_a_format_cannot_hold_are_not_dropped(name, count, tmp_path, make_camera):
    with pytest.raises(ValueError, match=f"camera must have at most {count} coefficients for this file"):
        WRITERS[name](tmp_path / name, make_camera((0.0,) * 13 + (0.1,)))


def test_opencv_files_need_a_known_suffix(tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"path must end in .xml, .yml or .yaml, got .*camera.txt"):
        write_opencv(tmp_path / "camera.txt", make_camera((0.0,) * 4))
