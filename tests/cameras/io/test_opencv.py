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


@pytest.mark.parametrize("ending", [".yml", ".xml"])
@pytest.mark.parametrize("name", VECTORS)
def test_written_files_are_read_back_and_by_opencv(name, ending, tmp_path, make_camera):
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
def test_files_written_by_opencv_are_read(ending, tmp_path, make_camera):
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


def test_a_file_is_replaced_atomically(tmp_path, make_camera):
    path = tmp_path / "camera.yaml"
    path.write_text("old")
    write_opencv(path, make_camera((0.0,) * 4))
    assert [entry.name for entry in tmp_path.iterdir()] == ["camera.yaml"]
    assert read_opencv(path) == make_camera((0.0,) * 4)
