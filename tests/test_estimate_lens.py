import math
import re

import numpy as np
import pytest
from pictures import save_picture

from torchrefract import LensDistortion
from torchrefract.cameras.io import read_camera, read_covariance
from torchrefract.data.images import pixels_of
from torchrefract.data.video import can_write_videos, write_video

BARREL = (-0.16, 0.06)  # relative to the half diagonal


@pytest.fixture
def folder(tmp_path, drive):
    """Write six frames of straight edges through a barrel lens into raw/ and return the working folder."""
    for i, frame in enumerate(drive(BARREL, 6)):
        save_picture(tmp_path / "raw" / f"{i}.png", pixels_of(frame))
    return tmp_path


def test_the_camera_of_a_drive_is_written_with_its_covariance_for_rectify_and_effects(call, folder):
    outcome = call("estimate_lens", "input=raw", "out=cam.yaml")
    assert outcome.err == ""
    printed = re.fullmatch(
        r"cam.yaml: k1 (\S+) \+- (\S+), k2 (\S+) \+- (\S+) for a focal length of 432 px, from 6 frames with (\d+) "
        r"straight edges of (\d+); standard deviation of the rectified position: (\S+) px at the left and right edge, "
        r"(\S+) px in the corners\n",
        outcome.out,
    )
    assert printed, outcome.out
    camera, covariance = read_camera(folder / "cam.yaml"), read_covariance(folder / "cam.yaml")
    assert covariance is not None
    scale = 432 / (math.hypot(270, 480) / 2)
    # The shift half way to a corner, where k1 and k2 are known best.
    expected, found = (
        k1 / 4 + k2 / 16 for k1, k2 in (BARREL, np.array(camera.coefficients[:2]) / (scale**2, scale**4))
    )
    assert found == pytest.approx(expected, abs=0.004)
    assert [float(printed[i]) for i in (1, 3)] == pytest.approx(camera.coefficients[:2], abs=5e-4)
    assert [float(printed[i]) for i in (2, 4)] == pytest.approx(np.sqrt(covariance.diagonal()[4:6]), abs=5e-4)
    LensDistortion.from_camera(camera, covariance=covariance)
    assert call("rectify", "input=raw", "camera=cam.yaml", "out=rectified").code == 0


@pytest.mark.skipif(not can_write_videos(), reason="needs FFmpeg with libx264")
def test_frames_of_a_video_are_evenly_spaced_and_a_blank_one_is_warned_of(call, tmp_path):
    gray = np.full((64, 96, 3), 127, np.uint8)
    write_video([gray] * 10, tmp_path / "drive.mp4", fps=10, size=(96, 64))
    outcome = call("estimate_lens", "input=drive.mp4", "frames=4")
    assert "from 4 frames with 0 straight edges of 0" in outcome.out
    few, vague = outcome.err.splitlines()
    assert few.startswith("warning: the frames hold 0 straight edges that could tell a lens, fewer than 10: add frames")
    assert vague.startswith("warning: the lens cannot be distinguished from no distortion (95 %)")


def test_frames_of_several_drives_by_their_names_are_warned_of(call, folder):
    for i, name in enumerate(("front_1", "front_2", "front_3", "rear_1", "rear_2", "rear_3")):
        (folder / "raw" / f"{i}.png").rename(folder / "raw" / f"{name}.png")
    outcome = call("estimate_lens", "input=raw")
    assert outcome.code == 0
    assert outcome.err == (
        "warning: frames of 2 drives by their names, front, rear, are taken for those of one camera: "
        "estimate each camera by itself\n"
    )


def test_a_damaged_video_is_named_and_the_others_are_used(call, folder):
    (folder / "raw" / "bad.mp4").write_bytes(b"no video")
    outcome = call("estimate_lens", "input=raw")
    assert "from 6 frames" in outcome.out
    assert outcome.err.splitlines()[0].startswith("skipped: raw/bad.mp4 is not a video with a frame that")
    assert call("estimate_lens", "input=raw/bad.mp4").message.startswith("raw/bad.mp4 is not a video with a frame")
    (folder / "bad").mkdir()
    for name in ("a.mp4", "b.mp4"):
        (folder / "bad" / name).write_bytes(b"no video")
    last = call("estimate_lens", "input=bad").err.splitlines()[-1]
    assert last.startswith("error: input must hold a readable picture or video, got bad/b.mp4 is not a video with")


def test_the_flows_of_a_checkpoint_are_used(call, folder, shifted):
    alone = call("estimate_lens", "input=raw", "out=a.yaml").out.removeprefix("a.yaml")
    both = call("estimate_lens", "input=raw", "out=b.yaml", f"checkpoint={shifted}").out.removeprefix("b.yaml")
    # The network predicts a shift, which is no lens: its prior at zero is narrower than that of published lenses.
    assert alone != both
    assert read_camera(folder / "b.yaml").coefficients[0] == pytest.approx(
        read_camera(folder / "a.yaml").coefficients[0], abs=0.1
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("input=raw", "frames=0"), "frames must be at least 1, got 0"),
        (("input=raw", "fov_deg=180"), "fov_deg must be a number in [1, 170], got 180"),
        (("input=raw", "fov_deg=wide"), "fov_deg must be a real number, got 'wide'"),
        (("input=raw", "out=cam.txt"), "out must end in .xml, .yml or .yaml, got cam.txt"),
        (("input=raw", "out=raw"), "out must end in .xml, .yml or .yaml, got raw"),
        (("input=raw", "out=raw/0.png/cam.yaml"), "out must name what can be read or written, got raw/0.png: "),
        (("input=raw", "out=/proc/cam.yaml"), "out must name what exists, got /proc: "),
        (("input=nothing",), "input must be a folder, a picture or a video, got nothing, which does not exist"),
        (("input=raw", "checkpoint=none.ckpt"), "checkpoint must be a checkpoint file, such as "),
        (("input=raw", "checkpoint=raw/0.png"), "checkpoint must be an intact checkpoint, got raw/0.png, "),
    ],
)
def test_an_invalid_option_is_one_line_of_error_before_frames_are_read(call, folder, monkeypatch, words, message):
    def refuse(*_, **__):
        raise AssertionError("the frames were read")

    monkeypatch.setattr("torchrefract.cli.estimation.read_image", refuse)
    assert call("estimate_lens", *words).message.startswith(message)


def test_pictures_of_two_sizes_and_a_checkpoint_of_another_task_are_errors(call, folder, brighter):
    message = call("estimate_lens", "input=raw", f"checkpoint={brighter}").message
    assert message.startswith("checkpoint must be of the task undistort, got ")
    save_picture(folder / "raw" / "9.png", np.zeros((40, 60, 3), np.uint8))
    message = call("estimate_lens", "input=raw").message
    assert message.startswith("input: frames must be of one size, since they are of one camera, got 480 x 270 px and")
    assert message.endswith("in raw/9.png, 60 x 40 px")
