"""Camera files of OpenCV, ROS, Kalibr, ORB-SLAM and VINS are read as these define them, or refused with a way out."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefract.cameras.documents import parse_documents
from torchrefract.cameras.io import read_camera, read_covariance, read_opencv, write_opencv

RADIAL = (-0.28, 0.074, 2e-4, 1.8e-5)
FIVE = (-0.28, 0.17, 8e-4, -4e-4, -0.05)
EIGHT = (0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)
FISHEYE = (-0.0137, 0.0207, -0.0128, 0.0025)
MATRIX = [[510.25, 0.0, 322.5], [0.0, 505.75, 237.125], [0.0, 0.0, 1.0]]
SIZE = "image_width: 640\nimage_height: 480\n"
PINHOLE, POLYNOMIAL = ((0.0,) * 4, "opencv"), (FIVE, "opencv")


def storage(coefficients: tuple[float, ...], lines: str = SIZE) -> str:
    """Return YAML as OpenCV before version 5 writes it."""
    data = ", ".join(map(repr, coefficients))
    return f"""%YAML:1.0
---
{lines}camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 510.25, 0., 322.5, 0., 505.75, 237.125, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: {len(coefficients)}
   cols: 1
   dt: d
   data: [ {data} ]
"""


CHAIN = """%YAML:1.0

cam0:
  T_imu_cam: #rotation from camera to imu
    - [1.0, 0.0, 0.0, 0.0]
    - [0.0, 1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0, 0.0]
    - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.074, 0.0002, 0.000018]
  distortion_model: radtan
  intrinsics: [510.25, 505.75, 322.5, 237.125] #fu, fv, cu, cv
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.0137, 0.0207, -0.0128, 0.0025]
  distortion_model: equidistant
  intrinsics: [510.25, 505.75, 322.5, 237.125]
  resolution: [640, 480]
"""
ONE_CAMERA = CHAIN.partition("cam1:")[0]


def message(coefficients: tuple[float, ...], model: str, stamp: int = 0) -> str:
    """Return a message as `ros2 topic echo` prints it."""
    rows = "".join(f"- {value!r}\n" for value in coefficients)
    return f"""header:
  stamp:
    sec: {stamp}
    nanosec: 17
  frame_id: camera
height: 480
width: 640
distortion_model: {model}
d:{" []" if not rows else ""}
{rows}k:
- 510.25
- 0.0
- 322.5
- 0.0
- 505.75
- 237.125
- 0.0
- 0.0
- 1.0
r:
- 1.0
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""


ROS1 = """header:
  seq: 12
  frame_id: "camera"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.28, 0.17, 0.0008, -0.0004, -0.05]
K: [510.25, 0.0, 322.5, 0.0, 505.75, 237.125, 0.0, 0.0, 1.0]
---
""".replace("header:", "header: ")
INFO = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [510.25, 0, 322.5, 0, 505.75, 237.125, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {data}
"""


def info(model: str, coefficients: tuple[float, ...]) -> str:
    return INFO.format(model=model, count=len(coefficients), data=list(coefficients))


ORB_SLAM = """%YAML:1.0

Camera.type: "PinHole"
Camera.fx: 510.25
Camera.fy: 505.75
Camera.cx: 322.5
Camera.cy: 237.125

Camera.k1: -0.28
Camera.k2: 0.074
Camera.p1: 0.0002
Camera.p2: 0.000018

Camera.width: 640
Camera.height: 480
Camera.fps: 20
"""
ORB_FISHEYE = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 510.25
Camera1.fy: 505.75
Camera1.cx: 322.5
Camera1.cy: 237.125
Camera1.k1: -0.0137
Camera1.k2: 0.0207
Camera1.k3: -0.0128
Camera1.k4: 0.0025
Camera.width: 640
Camera.height: 480
"""
VINS = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 640
image_height: 480
projection_parameters:
   k2: -0.0137
   k3: 0.0207
   k4: -0.0128
   k5: 0.0025
   mu: 510.25
   mv: 505.75
   u0: 322.5
   v0: 237.125
"""
LISTS = json.dumps({"camera_matrix": MATRIX, "dist_coeff": [list(FIVE)]})
EMPTY_CHAIN = ONE_CAMERA.replace("[-0.28, 0.074, 0.0002, 0.000018]", "[]")
STATED = {"width": 640, "height": 480}
# File, content, arguments, coefficients and model.
FILES = {
    "OpenCV": ("a.yaml", storage(FIVE), {}, POLYNOMIAL),
    "OpenCV, an empty matrix": ("a.yaml", storage(()), {}, PINHOLE),
    "OpenCV, fisheye": ("a.yml", storage(FISHEYE, SIZE + "fisheye_model: 1\n"), {}, (FISHEYE, "fisheye")),
    "OpenCV, four of a polynomial": ("a.yml", storage(RADIAL), {"model": "opencv"}, (RADIAL, "opencv")),
    "OpenCV, four of a fisheye": ("a.yml", storage(FISHEYE), {"model": "fisheye"}, (FISHEYE, "fisheye")),
    "OpenCV without size": ("a.yml", storage(FIVE, ""), STATED, POLYNOMIAL),
    "OpenCV, byte order mark": ("a.yml", "\ufeff" + storage(FIVE), {}, POLYNOMIAL),
    "lists of Python": ("a.json", LISTS, STATED, POLYNOMIAL),
    "Kalibr, the first of two": ("camchain.yaml", CHAIN, {"name": "cam0"}, (RADIAL, "opencv")),
    "Kalibr, the second of two": ("camchain.yaml", CHAIN, {"name": "cam1"}, (FISHEYE, "fisheye")),
    "Kalibr, one camera": ("camchain.yaml", ONE_CAMERA, {}, (RADIAL, "opencv")),
    "Kalibr, no coefficients": ("camchain.yaml", EMPTY_CHAIN, {}, PINHOLE),
    "ROS 2, three messages": ("a.yaml", "".join(message(FIVE, "plumb_bob", k) for k in range(3)), {}, POLYNOMIAL),
    "ROS 2, a text file": ("topic.txt", message(EIGHT, "rational_polynomial"), {}, (EIGHT, "opencv")),
    "ROS 2, fisheye": ("a.yaml", message(FISHEYE, "equidistant"), {}, (FISHEYE, "fisheye")),
    "ROS 2, empty d": ("a.yaml", message((), "plumb_bob"), {}, PINHOLE),
    "ROS 2, empty d and model": ("a.yaml", message((), "''"), {}, PINHOLE),
    "ROS 1": ("a.yaml", ROS1 * 2, {}, POLYNOMIAL),
    "camera_info": ("ost.yaml", info("plumb_bob", FIVE), {}, POLYNOMIAL),
    "camera_info, rational": ("ost.yaml", info("rational_polynomial", EIGHT), {}, (EIGHT, "opencv")),
    "camera_info, fisheye": ("ost.yaml", info("equidistant", FISHEYE), {}, (FISHEYE, "fisheye")),
    "camera_info, no coefficients": ("ost.yaml", info("plumb_bob", ()), {}, PINHOLE),
    "ORB-SLAM": ("EuRoC.yaml", ORB_SLAM, {}, ((*RADIAL, 0.0), "opencv")),
    "ORB-SLAM, fisheye": ("TUM.yaml", ORB_FISHEYE, {}, (FISHEYE, "fisheye")),
    "VINS": ("cam0.yaml", VINS, {}, (FISHEYE, "fisheye")),
}


@pytest.mark.quick
@pytest.mark.parametrize("form", FILES)
def test_a_file_is_read_as_its_program_defines_it(form, tmp_path, make_camera):
    name, content, options, lens = FILES[form]
    (tmp_path / name).write_text(content, encoding="utf-8")
    assert read_camera(tmp_path / name, **options) == make_camera(*lens)
    assert read_covariance(tmp_path / name) is None


@pytest.mark.quick
@pytest.mark.parametrize("form", ["ROS 2, three messages", "OpenCV", "lists of Python", "VINS"])
def test_a_file_that_powershell_wrote_in_utf_16_is_read(form, tmp_path, make_camera):
    name, content, options, lens = FILES[form]
    (tmp_path / name).write_text(content, encoding="utf-16", newline="\r\n")
    assert read_camera(tmp_path / name, **options) == make_camera(*lens)


def test_a_long_recording_of_equal_messages_is_parsed_once(tmp_path):
    messages = [message(FIVE, "plumb_bob", stamp) for stamp in range(500)]
    assert len(parse_documents(tmp_path, "".join(messages))) == 1
    assert len(parse_documents(tmp_path, ROS1 + ROS1.replace("seq: 12", "seq: 13"))) == 1
    assert len(parse_documents(tmp_path, "".join([*messages, ROS1]))) == 2


@pytest.mark.parametrize("ending", ["json", "xml", "yaml"])
@pytest.mark.parametrize("lens", [(FIVE, "opencv"), (FISHEYE, "fisheye")])
@pytest.mark.parametrize("shape", [(-1, 1), (-1,)])  # the latter is an n-dimensional matrix of OpenCV 5
def test_files_that_opencv_writes_are_read(shape, lens, ending, tmp_path, make_camera):
    path, (coefficients, model) = tmp_path / f"a.{ending}", lens
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Fri Nov 27 2026")
    for name, value in (("image_width", 640), ("image_height", 480), ("fisheye_model", int(model == "fisheye"))):
        file.write(name, value)
    file.write("camera_matrix", np.array(MATRIX))
    file.write("distortion_coefficients", np.reshape(coefficients, shape))
    file.write("avg_reprojection_error", float("nan"))
    file.release()
    assert read_camera(path) == read_opencv(path) == make_camera(coefficients, model)


UNKNOWN = "path must hold a camera of OpenCV, ROS, .*, got .* with"
ORB_UNTYPED = ORB_FISHEYE.replace('Camera.type: "KannalaBrandt8"', "")
ROI = message(FIVE, "plumb_bob").replace("x_offset: 0", "x_offset: 8")
HALF = message(FIVE, "plumb_bob").replace("height: 0", "height: 240")
TWO = message(FIVE, "plumb_bob") + message(EIGHT, "rational_polynomial")
ZERO_K = message((), "plumb_bob").replace("510.25", "0.0")
BINNED = message(FIVE, "plumb_bob").replace("binning_x: 0", "binning_x: 2")
SHARES = storage(FIVE).replace("510.25, 0., 322.5, 0., 505.75, 237.125", "0.8, 0., 0.5, 0., 1.05, 0.5")
TWICE = "must hold K once, got .* with it twice; keep one of them"
kalibr_with = ONE_CAMERA.replace
# Content, arguments, message.
REFUSED = {
    "another model": (message(FISHEYE, "equidistant"), {"model": "opencv"}, "be fisheye as .* states, got opencv"),
    "no size": (storage(FIVE, ""), {}, "must hold image_width, got .*; add it, or state width in read_camera"),
    "another size": (storage(FIVE), {"width": 320}, "width must be 640 as .* states, got 320; use camera.resized"),
    "an option of others": (storage(FIVE), {"focal_mm": 3}, "focal_mm must be None for a file of OpenCV or ROS, got 3"),
    "two matrices": (storage(FIVE) + "K: [1]\n", {}, "must hold one camera_matrix, got .* with camera_matrix, K"),
    "a stereo pair": (storage(FIVE).replace("camera_matrix", "M1"), {}, f"{UNKNOWN} .*M1, .*create torchrefract.Cam"),
    "messages that differ": (TWO, {}, "must hold one camera, got .* of 2 different ones; keep those of one"),
    "a part of the frame": (ROI, {}, "whole frames, got .* the roi .*; remove roi, and use camera.cropped"),
    "the upper half": (HALF, {}, "must describe whole frames, got .* the roi .*; remove roi, and use camera.cropped"),
    "binned frames": (BINNED, {}, r"got .* with binning_x and binning_y of \[2, 0\]; remove them, and use camera.res"),
    "a matrix twice": (storage(FIVE) + "camera_matrix: [1]\n", {}, "must hold camera_matrix once, got .* twice; keep"),
    "a matrix twice, JSON": ('{"image_width": 640, "K": [1], "K": [2]}', {}, TWICE),
    "a matrix twice, XML": ("<opencv_storage><K>1</K><K>2</K></opencv_storage>", {}, TWICE),
    "shares of the frame": (SHARES, {}, "fx, fy, cx, cy in px, got .* for frames of 640 x 480 px; multiply shares by"),
    "a model of others": (storage(FIVE), {"model": "omni"}, "model must be one of opencv, fisheye, got 'omni'"),
    "a fisheye without k": (message((), "equidistant"), {}, "must hold the four coefficients of a fisheye"),
    "a fisheye with five": (message(FIVE, "equidistant"), {}, "must be 4 numbers for the model fisheye, got 5"),
    "ROS, another model": (message(FIVE, "thin_prism"), {}, "_model of plumb_bob, .*, got .* 'thin_prism'; calibrate"),
    "ROS, not calibrated": (ZERO_K, {}, "fx must be above 0"),
    "Kalibr, two cameras": (CHAIN, {}, "name must be one of the cameras in .*: cam0, cam1; got None"),
    "Kalibr, another name": (CHAIN, {"name": "left"}, "cam0, cam1; got 'left'"),
    "Kalibr, omni": (kalibr_with("pinhole", "omni"), {}, "camera_model of pinhole, got .* 'omni'; calibrate aga"),
    "Kalibr, fov": (kalibr_with("radtan", "fov"), {}, "radtan, equidistant, none, got .* 'fov'; calibrate again"),
    "Kalibr, none with k1": (kalibr_with("radtan", "none"), {}, "no distortion_coeffs for .*; state radtan or"),
    "Kalibr, empty fisheye": (EMPTY_CHAIN.replace("radtan", "equidistant"), {}, "must hold 4 numbers as distortion_co"),
    "ORB-SLAM, no type": (ORB_UNTYPED, {}, "k3 of a PinHole, got .* with Camera1.k4; state Camera.type"),
    "ORB-SLAM, no size": (ORB_SLAM.replace("Camera.width", "w"), {}, "hold Camera.width, got .*; add it, or state"),
    "VINS, MEI": (VINS.replace("KANNALA_BRANDT", "MEI"), {}, "of PINHOLE, KANNALA_BRANDT, got .* 'MEI'; calibrate"),
    "another XML": ("<document><chunk/></document>", {}, f"{UNKNOWN} <document>; create"),
    "TOML": ("[cams.0]\nsize = [640, 480]\n", {}, f"{UNKNOWN} other text .*; create"),
    "a recording": (b"#ROSBAG V2.0\n\xff\xfe", {}, f"{UNKNOWN} binary data; create"),
}


@pytest.mark.quick
@pytest.mark.parametrize("case", REFUSED)
def test_a_file_without_one_exact_camera_raises_with_the_way_out(case, tmp_path):
    content, options, rule = REFUSED[case]
    (tmp_path / "file").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=rule):
        read_camera(tmp_path / "file", **options)


@pytest.mark.parametrize("coefficients", [FISHEYE, (0.0,) * 4])
def test_four_coefficients_without_a_model_are_taken_as_k1_k2_p1_p2_with_a_warning(coefficients, tmp_path, make_camera):
    path = tmp_path / "a.yaml"
    path.write_text(storage(coefficients))
    for read in (read_camera, read_opencv):
        with pytest.warns(UserWarning, match="a.yaml are taken as k1, k2, p1, p2, .* add fisheye_model: 1 if"):
            assert read(path) == make_camera(coefficients)
    assert read_camera(path, model="fisheye") == make_camera(coefficients, "fisheye")
    write_opencv(path, make_camera(RADIAL))  # which states the model
    assert read_camera(path) == make_camera(RADIAL)


@pytest.mark.quick
def test_a_principal_point_far_from_the_middle_is_warned_of_and_a_transposed_matrix_is_named(tmp_path):
    rows, path = [[510.0, 0.0, 322.0], [0.0, 505.0, 237.0], [0.0, 0.0, 1.0]], tmp_path / "a.json"
    values = {"image_width": 960, "image_height": 720, "camera_matrix": rows, "D": [-0.3, 0.1, 0.0, 0.0, 0.0]}
    path.write_text(json.dumps(values))
    with pytest.warns(UserWarning, match=r"principal point at \(322, 237\), far from the middle of 960 x 720 px; if"):
        assert read_camera(path).cx == 322.0
    path.write_text(json.dumps(values | {"image_width": 720, "image_height": 540}))
    assert read_camera(path).width == 720
    path.write_text(json.dumps(values | {"camera_matrix": [list(column) for column in zip(*rows, strict=True)]}))
    with pytest.raises(ValueError, match=r"without skew, got .* last row \[322\.0, 237\.0, 1\.0\]; transpose it, as"):
        read_camera(path)


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_read_cameras_project_as_opencv(model, rays, tmp_path, oracle):
    coefficients = EIGHT if model == "opencv" else FISHEYE
    kind = "rational_polynomial" if model == "opencv" else "equidistant"
    (tmp_path / "a.yaml").write_text(message(coefficients, kind))
    result = read_camera(tmp_path / "a.yaml").project(rays).points
    project = cv2.projectPoints if model == "opencv" else cv2.fisheye.projectPoints
    zero, matrix, points = np.zeros(3), np.array(MATRIX), rays.numpy()[:, None]
    pixels = project(points, zero, zero, matrix, np.array(coefficients))[0][:, 0]
    oracle("pixels of OpenCV", result, torch.from_numpy(pixels), 1e-9)


def test_published_chains_of_kalibr_are_read(shared_data, published, tmp_path):
    rows = {row["id"]: row for row in json.loads((shared_data / "lenses.json").read_text())}
    cameras = {key: camera for key, camera in published.items() if rows[key]["source_repo"] == "rpng/open_vins"}
    text = "%YAML:1.0\n\n"
    for key, camera in cameras.items():
        kind = "radtan" if camera.model == "opencv" else "equidistant"
        text += f"{key}:\n  camera_model: pinhole\n  distortion_coeffs: {list(camera.coefficients[:4])}\n"
        text += f"  distortion_model: {kind}\n  intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
        text += f"  resolution: [{camera.width}, {camera.height}]\n"
    (tmp_path / "chain.yaml").write_text(text)
    assert len(cameras) == 11
    for key, camera in cameras.items():
        result = read_camera(tmp_path / "chain.yaml", name=key)
        assert replace(result, coefficients=camera.coefficients) == camera
        assert result.coefficients == camera.coefficients[:4]
