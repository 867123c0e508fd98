import cv2
import numpy as np
import pytest

from torchrefract.cameras.io.opencv import read_opencv, write_opencv

VECTORS = {
    "4": ((-0.3, 0.1, 0.002, 1e-17), "opencv"),
    "8": ((0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 1 / 3), "opencv"),
    "14": ((-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05), "opencv"),
    "fisheye": ((-0.12, 0.043, -0.0088, -0.0037), "fisheye"),
}


@pytest.mark.parametrize("ending", [".yaml", ".yml", ".xml"])
@pytest.mark.parametrize("name", VECTORS)
def test_what_is_written_reads_back_here_and_by_opencv(name, ending, tmp_path, make_camera):
    camera = make_camera(*VECTORS[name])
    path = tmp_path / f"camera{ending}"
    write_opencv(path, camera)
    assert read_opencv(path) == camera
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    assert storage.getNode("image_width").real() == 640
    assert storage.getNode("image_height").real() == 480
    assert storage.getNode("fisheye_model").real() == (camera.model == "fisheye")
    assert np.array_equal(storage.getNode("camera_matrix").mat(), np.array(camera.matrix))
    assert np.array_equal(storage.getNode("distortion_coefficients").mat().ravel(), camera.coefficients)
    storage.release()


@pytest.mark.parametrize("ending", [".yaml", ".xml"])
def test_what_opencv_writes_is_read(ending, tmp_path, make_camera):
    camera = make_camera((-0.28, 0.17, 8e-4, -4e-20, -0.05))
    path = tmp_path / f"camera{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "today")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array(camera.matrix))
    storage.write("distortion_coefficients", np.array([camera.coefficients]).T)
    storage.write("per_view_reprojection_errors", np.ones((3, 1), dtype=np.float32))
    storage.release()
    assert read_opencv(path) == camera


def test_a_file_is_replaced_whole_and_nothing_is_left_beside_it(tmp_path, make_camera):
    path = tmp_path / "camera.yaml"
    path.write_text("old")
    write_opencv(path, make_camera((0.0,) * 4))
    assert [entry.name for entry in tmp_path.iterdir()] == ["camera.yaml"]
    assert read_opencv(path) == make_camera((0.0,) * 4)


HEAD = "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\n"
MATRIX = (
    "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 5., {skew}, 3., 0., 5., 4., 0., 0., 1. ]\n"
)
LENS = "distortion_coefficients: !!opencv-matrix\n   rows: {n}\n   cols: 1\n   dt: d\n   data: [ {data} ]\n"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("%YAML:1.0\n---\nimage_width: [64\n", "path must hold YAML, got .*camera.yaml: while parsing"),
        ("just words", "path must hold a mapping of names to values"),
        ("%YAML:1.0\n---\nimage_height: 48\n", "path must hold image_width, got .* with image_height"),
        (HEAD, "path must hold camera_matrix"),
        (HEAD.replace("64", "64.5"), "path must hold a whole number as image_width, got .* with 64.5"),
        (HEAD.replace("64", "wide"), "path must hold numbers as image_width, got .* with .'wide'"),
        (HEAD + "camera_matrix: 7\n", "path must hold a matrix as camera_matrix"),
        (HEAD + MATRIX.format(skew="x"), "path must hold numbers as camera_matrix"),
        (HEAD + MATRIX.format(skew="0., 1."), "path must hold 9 numbers as camera_matrix, got .* with 10"),
        (HEAD + MATRIX.format(skew="0.5"), "camera_matrix without skew, got .* with skew 0.5"),
        (HEAD + MATRIX.format(skew="0."), "path must hold distortion_coefficients"),
        (HEAD + MATRIX.format(skew="0.") + LENS.format(n=2, data="0., 0."), "a camera, got .*: coefficients must be 4"),
        (HEAD + MATRIX.format(skew="0.") + LENS.format(n=4, data="0., .nan, 0., 0."), "coefficients must not be NaN"),
    ],
)  # fmt: skip  # one line for each file
def test_a_broken_file_is_named_with_what_is_wrong(text, rule, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rule):
        read_opencv(path)


def test_broken_xml_is_named(tmp_path):
    path = tmp_path / "camera.xml"
    path.write_text("<opencv_storage><image_width>64")
    with pytest.raises(ValueError, match=r"path must hold XML, got .*camera.xml: "):
        read_opencv(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="path must hold text in UTF-8"):
        read_opencv(path)


def test_what_opencv_has_no_name_for_raises(tmp_path, make_camera):
    with pytest.raises(ValueError, match=r"camera must be of the model opencv or fisheye .* got division"):
        write_opencv(tmp_path / "camera.yaml", make_camera((-0.2,), "division"))
    with pytest.raises(ValueError, match=r"path must end in .xml, .yml or .yaml, got .*camera.txt"):
        write_opencv(tmp_path / "camera.txt", make_camera((0.0,) * 4))
    assert not list(tmp_path.iterdir())
