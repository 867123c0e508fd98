import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pictures import load_clip, load_picture, save_clip, save_picture, save_turned, smooth_picture
from PIL import Image

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_opencv, write_kalibr, write_opencv
from torchrefract.data.video import video_info
from torchrefract.fields.rectification import camera_flow
from torchrefract.warping.grid import inside

WAVES = smooth_picture(128, 192)[::2, ::2]
PINHOLE = {"width": 96, "height": 64, "fx": 70.0, "fy": 71.0, "cx": 46.2, "cy": 33.1}
CAMERAS = {
    "opencv": Camera(**PINHOLE, coefficients=(-0.2, 0.05, 0.002, -0.001)),
    "rational": Camera(**PINHOLE, coefficients=(0.3, 0.05, 0.002, -0.001, 0.01, 0.5, 0.1, 0.02)),
    "fisheye": Camera(**PINHOLE, coefficients=(-0.03, 0.01, -0.005, 0.001), model="fisheye"),
}


def maps(camera: Camera, zoom: float) -> tuple[np.ndarray, np.ndarray]:
    matrix, vector, size = np.array(camera.matrix), np.array(camera.coefficients), (camera.width, camera.height)
    new = matrix * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
    if camera.model == "fisheye":
        return cv2.fisheye.initUndistortRectifyMap(matrix, vector, np.eye(3), new, size, cv2.CV_32FC1)
    return cv2.initUndistortRectifyMap(matrix, vector, np.eye(3), new, size, cv2.CV_32FC1)


def by_opencv(raw: np.ndarray, camera: Camera) -> np.ndarray:
    return cv2.remap(raw.astype(np.float32), *maps(camera, 1.0), cv2.INTER_CUBIC).clip(0, 255)


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean difference of two pictures but for their borders."""
    return np.abs(one.astype(float) - other)[4:-4, 4:-4].mean()


@pytest.fixture
def folder(tmp_path) -> Path:
    """Write three pictures and a camera to the folder in which commands run."""
    for k in range(3):
        save_picture(tmp_path / "raw" / f"{k}.png", np.roll(WAVES, 7 * k, axis=1))
    write_opencv(tmp_path / "cam.yaml", CAMERAS["opencv"])
    return tmp_path


@pytest.mark.parametrize(("name", "zoom"), [("opencv", 1.0), ("opencv", 0.7), ("rational", 1.0), ("fisheye", 0.7)])
def test_the_flow_matches_the_maps_of_opencv(name, zoom, oracle):
    flow, exists, pinhole = camera_flow(CAMERAS[name], zoom=zoom)
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    expected = torch.from_numpy(np.stack(maps(CAMERAS[name], zoom)))
    oracle("rectifying flow, OpenCV's maps", flow[0] + torch.stack([x, y]), expected, 1e-3)
    assert exists.all()
    assert (pinhole.fx, pinhole.fy) == (zoom * 70.0, zoom * 71.0)
    assert (pinhole.cx, pinhole.cy, pinhole.coefficients) == (46.2, 33.1, (0.0,) * 4)


def test_an_uncertain_camera_is_warned_of_and_crop_keeps_the_certain_part(call, folder):
    covariance = np.diag([0.0] * 4 + [0.3**2, 0.0, 0.0, 0.0])
    write_opencv(folder / "cam.yaml", CAMERAS["opencv"], covariance=covariance)
    outcome = call("rectify", "input=raw", "camera=cam.yaml")
    match = re.search(r"up to (\d+\.\d) px; in the middle (\d+) x (\d+) px it is at most 2 px", outcome.err)
    assert match is not None
    assert float(match[1]) > 2
    assert call("rectify", "input=raw", "camera=cam.yaml", "crop=true", "out=cropped").err == ""
    picture, rectified = (load_picture(folder / name / "0.png") for name in ("cropped", "rectified"))
    assert picture.shape == (int(match[3]), int(match[2]), 3)
    left, top = (96 - int(match[2])) // 2, (64 - int(match[3])) // 2
    expected = rectified[top:, left:][: picture.shape[0], : picture.shape[1]]
    np.testing.assert_array_equal(picture, expected)
    assert read_opencv(folder / "cropped" / "camera.yaml").cx == 46.2 - left
    (folder / "cropped" / "1.png").unlink()
    again = call("rectify", "input=raw", "camera=cam.yaml", "crop=true", "out=cropped")
    assert again.out.startswith("cropped: 1 rectified, 2 already existed, 0 skipped")


def test_crop_leaves_no_black_border_of_a_pincushion_lens(call, folder):
    pincushion = Camera(**PINHOLE, coefficients=(0.3, 0.1, 0.0, 0.0))
    write_opencv(folder / "cam.yaml", pincushion)
    for k in range(3):
        save_picture(folder / "raw" / f"{k}.png", np.full((64, 96, 3), 200, np.uint8))
    assert call("rectify", "input=raw", "camera=cam.yaml").code == 0
    assert call("rectify", "input=raw", "camera=cam.yaml", "crop=true", "out=cropped").code == 0
    padded, cropped = (load_picture(folder / name / "0.png") for name in ("rectified", "cropped"))
    assert padded.min() == 0
    assert cropped.shape == (64, 96, 3)
    assert cropped.min() == 200
    camera = read_opencv(folder / "cropped" / "camera.yaml")
    assert camera.fx > 1.05 * PINHOLE["fx"]
    # With 2 % less zoom a border pixel would have looked outside.
    flow, exists, _ = camera_flow(pincushion, zoom=0.98 * camera.fx / PINHOLE["fx"])
    assert not (exists & inside(flow)).all()


@pytest.mark.parametrize("name", ["opencv", "fisheye"])
def test_rectified_pictures_match_opencv(call, folder, name):
    write_opencv(folder / "cam.yaml", CAMERAS[name])
    outcome = call("rectify", "input=raw", "camera=cam.yaml")
    expected = "rectified: 3 rectified, 0 already existed, 0 skipped; camera of the results: rectified/camera.yaml\n"
    assert (outcome.out, outcome.err) == (expected, "")
    for k in range(3):
        result, raw = load_picture(folder / "rectified" / f"{k}.png"), np.roll(WAVES, 7 * k, axis=1)
        assert distance(result, by_opencv(raw, CAMERAS[name])) < 1
        assert distance(result, raw) > 5
    assert read_opencv(folder / "rectified" / "camera.yaml") == camera_flow(CAMERAS[name])[2]


def test_a_chain_of_kalibr_is_a_camera_file(call, folder):
    other = replace(CAMERAS["opencv"], fx=60.0)
    write_kalibr(folder / "chain.yaml", {"cam0": CAMERAS["opencv"], "cam1": other})
    message = call("rectify", "input=raw", "camera=chain.yaml").message
    remedy = "state name in read_camera, or camera_name in rectify, or keep one camera in the file"
    assert message == f"camera: name must be one of the cameras in chain.yaml: cam0, cam1; got None; {remedy}"
    assert call("rectify", "input=raw", "camera=chain.yaml", "camera_name=cam1").code == 0
    assert read_opencv(folder / "rectified" / "camera.yaml").fx == 60.0


def test_an_interrupted_run_continues(call, folder):
    assert call("rectify", "input=raw", "camera=cam.yaml", "out=out").code == 0
    content = (folder / "out" / "1.png").read_bytes()
    (folder / "out" / "0.png").unlink()
    (folder / "out" / "1.png").write_bytes(content[: len(content) // 2])
    before = (folder / "out" / "2.png").stat().st_mtime_ns
    outcome = call("rectify", "input=raw", "camera=cam.yaml", "out=out")
    assert outcome.out.startswith("out: 2 rectified, 1 already existed, 0 skipped")
    assert (folder / "out" / "1.png").read_bytes() == content
    assert (folder / "out" / "2.png").stat().st_mtime_ns == before


@pytest.mark.parametrize("crop", ["true", "false"])
def test_a_picture_that_changed_after_it_was_rectified_is_rectified_again(call, folder, crop):
    write_opencv(folder / "cam.yaml", CAMERAS["opencv"], covariance=np.diag([0.0] * 4 + [0.3**2, 0.0, 0.0, 0.0]))
    words = ("input=raw", "camera=cam.yaml", "out=out", f"crop={crop}")
    assert call("rectify", *words).code == 0
    before = (folder / "out" / "1.png").read_bytes()
    save_picture(folder / "raw" / "1.png", 255 - WAVES)
    assert call("rectify", *words).out.startswith("out: 1 rectified, 2 already existed, 0 skipped")
    assert (folder / "out" / "1.png").read_bytes() != before


def test_a_folder_of_another_camera_is_rejected(call, folder):
    assert call("rectify", "input=raw", "camera=cam.yaml", "out=out").code == 0
    message = call("rectify", "input=raw", "camera=cam.yaml", "out=out", "zoom=0.5").message
    assert message == "out must be a folder of the same camera and zoom, got out with another camera.yaml"


def test_pictures_of_one_name_in_another_folder_are_not_taken_for_rectified_ones(call, folder):
    assert call("rectify", "input=raw", "camera=cam.yaml", "out=out").code == 0
    save_picture(folder / "other" / "0.png", 255 - WAVES)
    message = call("rectify", "input=other", "camera=cam.yaml", "out=out").message
    assert message == (
        f"out must be a folder of the same configuration, got out, where input is {folder / 'raw'} there and "
        f"{folder / 'other'} here; choose another folder"
    )


def test_smaller_frames_use_the_resized_camera(call, folder):
    small = cv2.resize(WAVES, (48, 32), interpolation=cv2.INTER_AREA)
    save_picture(folder / "small.png", small)
    outcome = call("rectify", "input=small.png", "camera=cam.yaml", "out=out")
    assert outcome.code == 0
    assert outcome.err == (
        "warning: out/camera.yaml is the camera of frames of 96 x 64 px; for those of 48 x 32 px scale its numbers, as "
        "camera.resized does\n"
    )
    expected = by_opencv(small, CAMERAS["opencv"].resized(width=48, height=32))
    assert distance(load_picture(folder / "out" / "small.png"), expected) < 1


def test_a_video_is_rectified_frame_by_frame(call, folder):
    save_clip(folder / "clip.avi", [np.roll(WAVES, 3 * k, axis=1) for k in range(5)])
    assert call("rectify", "input=clip.avi", "camera=cam.yaml", "out=out").code == 0
    assert video_info(folder / "out" / "clip.mp4") == (5, 12.0)
    first, *_ = load_clip(folder / "out" / "clip.mp4")
    assert distance(first, by_opencv(WAVES, CAMERAS["opencv"])) < 12  # two codecs in between
    assert "0 rectified, 1 already existed" in call("rectify", "input=clip.avi", "camera=cam.yaml", "out=out").out


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_picture_is_rectified_as_stored_and_shown_upright(call, folder, orientation):
    save_turned(folder / "phone.png", WAVES, orientation)
    outcome = call("rectify", "input=phone.png", "camera=cam.yaml", "out=out")
    assert outcome.err.startswith("warning: 1 of 1 files have a tag that turns them for display (EXIF orientation, or")
    with Image.open(folder / "out" / "phone.png") as result:
        assert result.getexif()[0x0112] == orientation
        assert distance(np.asarray(result), by_opencv(WAVES, CAMERAS["opencv"])) < 1
    assert "0 rectified, 1 already existed" in call("rectify", "input=phone.png", "camera=cam.yaml", "out=out").out


def test_losses_are_described_before_the_first_file_is_written(call, folder):
    pages = [Image.fromarray(np.roll(WAVES, k, axis=1)) for k in range(2)]
    pages[0].save(folder / "raw" / "0.png", save_all=True, append_images=pages[1:])
    outcome = call("rectify", "input=raw", "camera=cam.yaml", "out=out")
    assert outcome.err == "warning: the first of several frames is kept: 0.png\n"


def test_a_fold_inside_the_frame_is_warned_of(call, folder):
    # At 0.527 focal lengths from its center, see above.
    write_opencv(folder / "cam.yaml", Camera(**PINHOLE, coefficients=(-1.2, 0.0, 0.0, 0.0)))
    outcome = call("rectify", "input=raw", "camera=cam.yaml")
    y, x = np.mgrid[:64, :96]
    black = ((x - 46.2) / 70) ** 2 + ((y - 33.1) / 71) ** 2 > 1 / 3.6
    message = f"warning: the camera's model folds back inside the frame: {black.mean():.1%} of it stays black\n"
    assert (outcome.code, outcome.err) == (0, message)
    assert not load_picture(folder / "rectified" / "0.png")[black].any()


def test_a_pole_inside_the_frame_raises_before_anything_is_written(call, folder):
    write_opencv(folder / "cam.yaml", Camera(**PINHOLE, coefficients=(0.0,) * 5 + (-3.0, 0.0, 0.0)))
    message = call("rectify", "input=raw", "camera=cam.yaml").message
    assert message.startswith("camera must keep its denominator 1 + k4 r^2 + k5 r^4 + k6 r^6 above zero inside")
    assert not (folder / "rectified").exists()


def test_unreadable_pictures_are_reported_and_skipped(call, folder):
    (folder / "raw" / "1.png").write_bytes(b"")
    outcome = call("rectify", "input=raw", "camera=cam.yaml", "out=out")
    assert outcome.code == 0
    assert outcome.err == "skipped: raw/1.png is empty (0 bytes)\n"
    assert outcome.out.startswith("out: 2 rectified, 0 already existed, 1 skipped")


def test_a_file_that_vanishes_during_a_run_is_named_and_rectified_by_the_next(call, folder, monkeypatch):
    file, words = folder / "raw" / "1.png", ("input=raw", "camera=cam.yaml", "out=out")
    with monkeypatch.context() as patch:
        patch.setattr("torchrefract.data.media.describe_turned", lambda _: str(file.rename(folder / "away.png"))[:0])
        outcome = call("rectify", *words)
    assert outcome.code == 1
    assert outcome.out.startswith("out: 2 rectified, 0 already existed, 1 skipped")
    assert outcome.err.splitlines()[-1] == (
        "error: input must stay unchanged during a run, got raw/1.png cannot be opened (No such file or directory); "
        "the same command tries them again"
    )
    (folder / "away.png").rename(file)
    assert call("rectify", *words).out.startswith("out: 1 rectified, 2 already existed, 0 skipped")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("input=raw",), "camera must be given, as in camera=…, got nothing"),
        (
            ("input=none", "camera=cam.yaml"),
            "input must be a folder, a picture or a video, got none, which does not exist",
        ),
        (
            ("input=raw", "camera=bad.yaml"),
            "camera: path must hold a camera of OpenCV, ROS, Kalibr, COLMAP, ORB-SLAM, VINS, Gyroflow, lensfun or "
            "Metashape, got bad.yaml with other text (path must hold a mapping of names to values",
        ),
        (
            ("input=raw", "camera=short.yaml"),
            "camera: path must hold 4 x 1 numbers as distortion_coefficients, got short.yaml with 3",
        ),
        (
            ("input=raw", "camera=k4.xml"),
            "camera must be of the model opencv or fisheye for this file (convert(camera, to",
        ),
        (("input=raw", "camera=cam.yaml", "zoom=0"), "zoom must be a number in [0.05, 20], got 0"),
        (("input=raw", "camera=cam.yaml", "zoom=0.5", "crop=true"), "zoom must be at least 1 beside crop=true, which"),
        (("input=raw", "camera=cam.yaml", "out=raw"), "out must be another folder than that of input, got raw"),
        (
            ("input=wide.png", "camera=cam.yaml"),
            "input must hold a file that can be rectified, got wide.png: image must have the shape",
        ),
    ],
)
def test_invalid_options_are_one_line_of_error(call, folder, options, message):
    (folder / "bad.yaml").write_text("no camera")
    text = (folder / "cam.yaml").read_text()
    (folder / "short.yaml").write_text(text.rsplit(",", 1)[0] + " ]\n")
    sides = "<width>96</width><height>64</height><f>70</f>"
    (folder / "k4.xml").write_text(f"<calibration><projection>frame</projection>{sides}<k4>0.001</k4></calibration>")
    save_picture(folder / "wide.png", np.zeros((10, 90, 3), np.uint8))
    outcome = call("rectify", *options)
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1].startswith(f"error: {message}")
