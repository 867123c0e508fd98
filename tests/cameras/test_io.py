import cv2
import numpy as np
import pytest
import torch
import yaml

from torchrefract import Camera, LensDistortion
from torchrefract.cameras import io

VECTORS = {
    "4": ((-0.3, 0.1, 0.002, 1e-17), "opencv"),
    "8": ((0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 1 / 3), "opencv"),
    "14": ((-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05), "opencv"),
    "fisheye": ((-0.12, 0.043, -0.0088, -0.0037), "fisheye"),
}


@pytest.mark.parametrize("ending", [".yml", ".xml"])
@pytest.mark.parametrize("name", VECTORS)
def test_written_files_are_read_back_and_by_opencv(name, ending, tmp_path, make_camera):
    camera = make_camera(*VECTORS[name])
    path = tmp_path / f"camera{ending}"
    io.write_opencv(path, camera)
    assert io.read_opencv(path) == camera
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    assert storage.getNode("image_width").real() == 640
    assert storage.getNode("image_height").real() == 480
    assert storage.getNode("fisheye_model").real() == (camera.model == "fisheye")
    assert np.array_equal(storage.getNode("camera_matrix").mat(), np.array(camera.matrix))
    assert np.array_equal(storage.getNode("distortion_coefficients").mat().ravel(), camera.coefficients)
    storage.release()


@pytest.mark.parametrize("ending", [".yml", ".xml"])
@pytest.mark.parametrize("vector", [VECTORS["4"], ((-0.2,), "division")], ids=["opencv", "division"])
def test_a_covariance_is_read_back_and_varies_a_lens(vector, ending, tmp_path, make_camera):
    camera, path = make_camera(*vector), tmp_path / f"camera{ending}"
    size = 4 + len(camera.coefficients)
    root = np.tril(np.linspace(-1, 1, size * size).reshape(size, size)) * 1e-3
    io.write_opencv(path, camera, covariance=root @ root.T)
    covariance = io.read_covariance(path)
    assert covariance is not None
    assert np.array_equal(covariance, root @ root.T)
    assert io.read_opencv(path) == camera
    effect = LensDistortion.from_camera(io.read_opencv(path), covariance=covariance)
    drawn = effect.sample(torch.zeros(2, 3, 48, 64), seed=0).coefficients
    assert not torch.equal(drawn[0], drawn[1])
    io.write_opencv(path, camera)
    assert io.read_covariance(path) is None
    with pytest.raises(ValueError, match=rf"covariance must have shape \({size}, {size}\), got \(9, 9\)"):
        io.write_opencv(path, camera, covariance=np.eye(9))


# The layout of ROS's camera_calibration, with values like those of its documentation.
ROS = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336, 0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{data}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.65, 0.0, 322.79, 0.0, 0.0, 393.65, 241.09, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
ROS_LENSES = {
    "plumb_bob": ("opencv", (-0.361976, 0.110510, 0.001014, 0.000505, 0.0)),
    "rational_polynomial": ("opencv", (0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)),
    "equidistant": ("fisheye", (-0.0328, 0.0067, -0.0057, 0.0012)),
}


def ros_text(name: str) -> str:
    values = ROS_LENSES[name][1]
    return ROS.format(model=name, count=len(values), data=", ".join(map(repr, values)))


@pytest.mark.parametrize("name", ROS_LENSES)
def test_ros_files_are_read_and_written_in_the_same_layout(name, tmp_path):
    path, (model, values) = tmp_path / "ost.yaml", ROS_LENSES[name]
    path.write_text(ros_text(name))
    camera = io.read_ros(path)
    assert (camera.width, camera.height, camera.model, camera.coefficients) == (640, 480, model, values)
    fx, fy, cx, cy = 438.783367, 437.302876, 305.593336, 243.738352
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (fx, fy, cx, cy)
    io.write_ros(path, camera, name="head")
    assert io.read_ros(path) == camera
    written, expected = yaml.safe_load(path.read_text()), yaml.safe_load(ros_text(name))
    # Without rectification the projection is the one of the camera.
    expected["projection_matrix"]["data"] = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    assert list(written.items()) == list(expected.items())


# The layout of Kalibr's wiki.
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.067, 0.0008, 0.0001]
  distortion_model: radtan
  intrinsics: [461.6, 460.1, 362.6, 246.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.013, 0.05, -0.045, 0.012]
  distortion_model: equidistant
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
cam2:
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [300.0, 300.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def test_kalibr_chains_are_read_and_written_in_the_same_layout(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    cameras = io.read_kalibr(path)
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    first, second, third = cameras.values()
    assert (first.width, first.height, first.fx, first.fy, first.cx, first.cy) == (752, 480, 461.6, 460.1, 362.6, 246.0)
    assert (first.model, first.coefficients) == ("opencv", (-0.27, 0.067, 0.0008, 0.0001))
    assert (second.model, second.coefficients) == ("fisheye", (-0.013, 0.05, -0.045, 0.012))
    assert (third.model, third.coefficients) == ("opencv", (0.0,) * 4)
    io.write_kalibr(path, cameras)
    assert io.read_kalibr(path) == cameras
    written, layout = yaml.safe_load(path.read_text()), yaml.safe_load(KALIBR)
    for name in ("cam0", "cam1"):
        assert all(written[name][field] == layout[name][field] for field in written[name])


# The layout of COLMAP's documentation; parameters in the order of its camera models.
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 9
1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
2 PINHOLE 3072 2304 2560.56 2559.69 1536 1152
3 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
4 RADIAL 640 480 500 320 240 -0.1 0.02
5 OPENCV 640 480 500 505 320 240 -0.1 0.02 0.001 -0.002
6 FULL_OPENCV 640 480 500 505 320 240 0.6 0.12 0.001 -0.0005 0.01 0.95 0.25 0.03
7 OPENCV_FISHEYE 640 480 300 305 320 240 -0.01 0.05 -0.04 0.01
8 SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 -0.01
9 RADIAL_FISHEYE 640 480 300 320 240 -0.01 0.05
"""
COLMAP_LENSES = {
    1: ("opencv", 2559.81, 2559.81, (0.0, 0.0, 0.0, 0.0)),
    2: ("opencv", 2560.56, 2559.69, (0.0, 0.0, 0.0, 0.0)),
    3: ("opencv", 2559.69, 2559.69, (-0.0218531, 0.0, 0.0, 0.0)),
    4: ("opencv", 500.0, 500.0, (-0.1, 0.02, 0.0, 0.0)),
    5: ("opencv", 500.0, 505.0, (-0.1, 0.02, 0.001, -0.002)),
    6: ("opencv", 500.0, 505.0, (0.6, 0.12, 0.001, -0.0005, 0.01, 0.95, 0.25, 0.03)),
    7: ("fisheye", 300.0, 305.0, (-0.01, 0.05, -0.04, 0.01)),
    8: ("fisheye", 300.0, 300.0, (-0.01, 0.0, 0.0, 0.0)),
    9: ("fisheye", 300.0, 300.0, (-0.01, 0.05, 0.0, 0.0)),
}


def test_colmap_cameras_are_read_with_centers_half_a_pixel_lower_and_written_back(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(COLMAP)
    cameras = io.read_colmap(path)
    for number, expected in COLMAP_LENSES.items():
        camera = cameras[number]
        assert (camera.model, camera.fx, camera.fy, camera.coefficients) == expected
        # COLMAP's (W / 2, H / 2) is the middle of the frame; so is ((W - 1) / 2, (H - 1) / 2) here.
        assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)
    io.write_colmap(path, cameras)
    assert io.read_colmap(path) == cameras
    lines, layout = (text.splitlines()[-9:] for text in (path.read_text(), COLMAP))
    models = ["PINHOLE", "PINHOLE", "OPENCV", "OPENCV", "OPENCV", "FULL_OPENCV", *["OPENCV_FISHEYE"] * 3]
    assert [line.split()[1] for line in lines] == models
    for k in (1, 4, 5, 6):  # in the same models
        words, expected = lines[k].split(), layout[k].split()
        assert [float(word) for word in words[2:]] == [float(word) for word in expected[2:]]


@pytest.mark.parametrize(("name", "count"), [("ost.yaml", 5), ("camchain.yaml", 4), ("cameras.txt", 4)])
def test_short_and_long_coefficients_are_fitted_to_the_format(name, count, tmp_path, make_camera):
    read = {"ost.yaml": io.read_ros, "camchain.yaml": io.read_kalibr, "cameras.txt": io.read_colmap}[name]
    for length in (4, 5, 8):
        WRITERS[name](tmp_path / name, make_camera((-0.3, 0.1, 0.002, 1 / 3, *(0.0,) * (length - 4))))
        camera = read(tmp_path / name)
        camera = camera if isinstance(camera, Camera) else next(iter(camera.values()))
        assert camera == make_camera((-0.3, 0.1, 0.002, 1 / 3, *(0.0,) * (count - 4)))


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


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "old", "new", "rule"),
    [
        ("camera.yaml", "64\n", "[64\n", "path must hold YAML, got .*camera.yaml: while parsing"),
        ("camera.yaml", OPENCV, "just words", "path must hold a mapping of names to values"),
        ("camera.yaml", "image_width: 64\n", "", "path must hold image_width, got .* with image_height"),
        ("camera.yaml", "64", "64.5", "path must hold a whole number as image_width, got .* with 64.5"),
        ("camera.yaml", "64", "wide", "path must hold numbers as image_width, got .* with 'wide'"),
        ("camera.yaml", "camera_matrix:", "camera_matrix: 7\nother:", "path must hold a matrix as camera_matrix"),
        ("camera.yaml", "5., 0., 3.", "5., x, 3.", "path must hold numbers as camera_matrix"),
        ("camera.yaml", "5., 0., 3.", "5., 0., 1., 3.", "path must hold 9 numbers as camera_matrix, got .* with 10"),
        ("camera.yaml", "5., 0., 3.", "5., 0.5, 3.", "camera_matrix without skew, got .* with skew 0.5"),
        (
            "camera.yaml",
            "4\n   cols: 1\n   dt: d\n   data: [ 0.1, 0., ",
            "2\n   cols: 1\n   dt: d\n   data: [ ",
            "must be 4",
        ),
        ("camera.yaml", "0.1, 0., 0., 0.", "0., 0.", "4 x 1 numbers as distortion_coefficients, got .* with 2"),
        ("camera.xml", OPENCV, "<opencv_storage><image_width>64", r"path must hold XML, got .*camera.xml: "),
        ("camera.xml", OPENCV, "\udcff", "path must hold text in UTF-8"),
        ("ost.yaml", "438.783367", "-1", "a camera, got .*ost.yaml: fx must be above 0, got -1"),
        ("ost.yaml", "data: [438", "date: [438", "path must hold a matrix as camera_matrix, got "),
        ("chain.yaml", "[752, 480]", "[752]", "path must hold 2 numbers as resolution, got .* with 1"),
        ("chain.yaml", "0.0001]", "]", "path must hold 4 numbers as distortion_coeffs, got .* with 3"),
        ("chain.yaml", "intrinsics: [461", "other: [461", "path must hold intrinsics, got .* with cam_overlaps"),
        ("chain.yaml", "cam0:\n", "units: px\ncam0:\n", "a mapping of names to values, got .*, units, with str"),
        ("cameras.txt", "1 SIMPLE_PINHOLE", "1 FOV", "a camera model of SIMPLE_PINHOLE, .* got .* with FOV"),
        ("cameras.txt", " -0.1 0.02\n", "\n", "path must hold 5 numbers as parameters of RADIAL, got .* with 3"),
        ("cameras.txt", "3072 2304 2559.81 1536 1152", "", "a number, model, width and height in each line"),
        ("cameras.txt", "3072", "640.5", "path must hold a whole number as CAMERA_ID, WIDTH or HEIGHT"),
        ("cameras.txt", "2559.81", "x", "path must hold numbers as parameters of SIMPLE_PINHOLE"),
        ("cameras.txt", "2559.81", "-1", "a camera, got .*cameras.txt: fx must be above 0"),
    ],
)
def test_an_invalid_file_is_named(name, old, new, rule, tmp_path):
    readers = {
        "camera.yaml": (io.read_opencv, OPENCV),
        "camera.xml": (io.read_opencv, OPENCV),
        "ost.yaml": (io.read_ros, ros_text("plumb_bob")),
        "chain.yaml": (io.read_kalibr, KALIBR),
        "cameras.txt": (io.read_colmap, COLMAP),
    }
    read, text = readers[name]
    (tmp_path / name).write_text(text.replace(old, new, 1), errors="surrogateescape")
    with pytest.raises(ValueError, match=rule):
        read(tmp_path / name)


WRITERS = {
    "camera.yaml": io.write_opencv,
    "ost.yaml": io.write_ros,
    "camchain.yaml": lambda path, camera: io.write_kalibr(path, {"cam0": camera}),
    "cameras.txt": lambda path, camera: io.write_colmap(path, {1: camera}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_unsupported_models_are_not_written(name, tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"camera must be of the model opencv or fisheye .* got polynomial12"):
        WRITERS[name](tmp_path / name, make_camera((-0.2, *(0.0,) * 11), "polynomial12"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "count"), [("ost.yaml", 8), ("camchain.yaml", 4), ("cameras.txt", 8)])
def test_coefficients_that_a_format_cannot_hold_are_not_dropped(name, count, tmp_path, make_camera):
    with pytest.raises(ValueError, match=f"camera must have at most {count} coefficients for this file"):
        WRITERS[name](tmp_path / name, make_camera((0.0,) * 13 + (0.1,)))


def test_opencv_files_need_a_known_suffix(tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"path must end in .xml, .yml or .yaml, got .*camera.txt"):
        io.write_opencv(tmp_path / "camera.txt", make_camera((0.0,) * 4))
