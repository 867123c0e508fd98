import pytest
import yaml

from torchrefract.cameras.io.ros import read_ros, write_ros

# The layout of ROS's camera_calibration, with the values of its documentation's kind.
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
def test_a_file_of_ros_is_read(name, tmp_path):
    path = tmp_path / "ost.yaml"
    model, values = MODELS[name]
    path.write_text(text(name, values))
    camera = read_ros(path)
    assert (camera.width, camera.height, camera.model, camera.coefficients) == (640, 480, model, values)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (438.783367, 437.302876, 305.593336, 243.738352)


@pytest.mark.parametrize("name", MODELS)
def test_what_is_written_has_the_layout_of_ros_and_reads_back(name, tmp_path, make_camera):
    path = tmp_path / "ost.yaml"
    model, values = MODELS[name]
    camera = make_camera(values, model)
    write_ros(path, camera, name="left")
    assert read_ros(path) == camera
    found, expected = yaml.safe_load(path.read_text()), yaml.safe_load(text(name, values))
    assert list(found) == list(expected)
    assert found["camera_name"] == "left"
    for field in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        assert {k: found[field][k] for k in ("rows", "cols")} == {k: expected[field][k] for k in ("rows", "cols")}
        assert len(found[field]["data"]) == found[field]["rows"] * found[field]["cols"]
    # Without rectification the view is that of the camera.
    rows = found["projection_matrix"]["data"]
    assert [rows[0], rows[2], rows[5], rows[6]] == [camera.fx, camera.cx, camera.fy, camera.cy]


def test_a_shorter_vector_is_filled_up(tmp_path, make_camera):
    path = tmp_path / "ost.yaml"
    write_ros(path, make_camera((-0.2, 0.05, 1e-3, 0.0)))
    assert read_ros(path) == make_camera((-0.2, 0.05, 1e-3, 0.0, 0.0))


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("plumb_bob", "thin_prism", "distortion_model of plumb_bob, .*, equidistant, got .*thin_prism"),
        ("image_height: 480\n", "", "path must hold image_height"),
        ("438.783367, 0.0", "438.783367, 2.0", "camera_matrix without skew, got .* with skew 2"),
        ("438.783367", "-1", "a camera, got .*ost.yaml: fx must be above 0, got -1"),
        ("data: [438", "date: [438", "path must hold data, got .* with rows, cols, date"),
        ("camera_matrix:\n  rows: 3", "camera_matrix: 4\nother:\n  rows: 3", "rows, cols and data as camera_matrix"),
        ("head", "[head", "path must hold YAML"),
    ],
)  # fmt: skip  # one line for each fault
def test_a_broken_file_is_named_with_what_is_wrong(old, new, rule, tmp_path):
    path = tmp_path / "ost.yaml"
    whole = text("plumb_bob", MODELS["plumb_bob"][1])
    assert old in whole
    path.write_text(whole.replace(old, new, 1))
    with pytest.raises(ValueError, match=rule):
        read_ros(path)


def test_what_ros_has_no_name_for_raises(tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"model opencv or fisheye .* got polynomial12"):
        write_ros(tmp_path / "ost.yaml", make_camera((0.0,) * 12, "polynomial12"))
    with pytest.raises(ValueError, match="camera must have at most 8 coefficients for this file"):
        write_ros(tmp_path / "ost.yaml", make_camera((0.0,) * 13 + (0.1,)))
