import pytest
import yaml

from torchrefract.cameras.io.ros import read_ros, write_ros

# The layout of ROS's camera_calibration, with values like those of its documentation.
TEXT = """image_width: 640
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
MODELS = {
    "plumb_bob": ("opencv", (-0.361976, 0.110510, 0.001014, 0.000505, 0.0)),
    "rational_polynomial": ("opencv", (0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)),
    "equidistant": ("fisheye", (-0.0328, 0.0067, -0.0057, 0.0012)),
}


def text(model: str, values: tuple[float, ...]) -> str:
    return TEXT.format(model=model, count=len(values), data=", ".join(map(repr, values)))


@pytest.mark.parametrize("name", MODELS)
def test_ros_files_are_read(name, tmp_path):
    path = tmp_path / "ost.yaml"
    model, values = MODELS[name]
    path.write_text(text(name, values))
    camera = read_ros(path)
    assert (camera.width, camera.height, camera.model, camera.coefficients) == (640, 480, model, values)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (438.783367, 437.302876, 305.593336, 243.738352)


@pytest.mark.parametrize("name", MODELS)
def test_written_files_have_the_layout_of_ros_and_are_read_back(name, tmp_path, make_camera):
    path = tmp_path / "ost.yaml"
    model, values = MODELS[name]
    camera = make_camera(values, model)
    write_ros(path, camera, name="left")
    assert read_ros(path) == camera
    written, expected = yaml.safe_load(path.read_text()), yaml.safe_load(text(name, values))
    assert list(written) == list(expected)
    assert written["camera_name"] == "left"
    for field in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        assert {k: written[field][k] for k in ("rows", "cols")} == {k: expected[field][k] for k in ("rows", "cols")}
        assert len(written[field]["data"]) == written[field]["rows"] * written[field]["cols"]
    # Without rectification the projection is the one of the camera.
    rows = written["projection_matrix"]["data"]
    assert [rows[0], rows[2], rows[5], rows[6]] == [camera.fx, camera.cx, camera.fy, camera.cy]


def test_short_coefficients_are_padded(tmp_path, make_camera):
    path = tmp_path / "ost.yaml"
    write_ros(path, make_camera((-0.2, 0.05, 1e-3, 0.0)))
    assert read_ros(path) == make_camera((-0.2, 0.05, 1e-3, 0.0, 0.0))
