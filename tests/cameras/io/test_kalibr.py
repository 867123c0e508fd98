import yaml

from torchrefract.cameras.io.kalibr import read_kalibr, write_kalibr

# The layout of Kalibr's wiki.
TEXT = """cam0:
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


def test_kalibr_chains_are_read(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(TEXT)
    cameras = read_kalibr(path)
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    first, second, third = cameras.values()
    assert (first.width, first.height, first.fx, first.fy, first.cx, first.cy) == (752, 480, 461.6, 460.1, 362.6, 246.0)
    assert (first.model, first.coefficients) == ("opencv", (-0.27, 0.067, 0.0008, 0.0001))
    assert (second.model, second.coefficients) == ("fisheye", (-0.013, 0.05, -0.045, 0.012))
    assert (third.model, third.coefficients) == ("opencv", (0.0,) * 4)


def test_written_files_have_the_layout_of_kalibr_and_are_read_back(tmp_path, make_camera):
    path = tmp_path / "camchain.yaml"
    cameras = {
        "cam0": make_camera((-0.3, 0.1, 0.002, 1e-7)),
        "cam1": make_camera((-0.01, 0.05, -0.04, 0.01), "fisheye"),
    }
    write_kalibr(path, cameras)
    assert read_kalibr(path) == cameras
    written, layout = yaml.safe_load(path.read_text()), yaml.safe_load(TEXT)
    assert set(written["cam0"]) <= set(layout["cam0"])
    assert [written[name]["distortion_model"] for name in cameras] == ["radtan", "equidistant"]
    write_kalibr(path, {"cam0": make_camera((-0.3, 0.1, 0.002, 0.0, 0.0))})
    assert read_kalibr(path)["cam0"] == make_camera((-0.3, 0.1, 0.002, 0.0))
