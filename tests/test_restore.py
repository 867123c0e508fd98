import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from pictures import files_in, load_clip, save_clip, save_picture, smooth_picture
from PIL import Image

from torchrefract import __version__, warp
from torchrefract.cameras.io import read_camera
from torchrefract.cli import restoration
from torchrefract.cli.progress import Skipped
from torchrefract.data.images import pixels_of, read_image
from torchrefract.data.video import read_video, video_info, write_video
from torchrefract.fields.rectification import camera_flow

SIZES = {"a.png": (48, 96), "one/b.png": (90, 70), "one/two/b.png": (48, 96), "one/c.bmp": (1, 1)}


@pytest.fixture
def folder(tmp_path) -> Path:
    """Write pictures of several sizes into raw/ and return the working folder."""
    for i, (name, size) in enumerate(SIZES.items()):
        save_picture(tmp_path / "raw" / name, smooth_picture(*size, seed=i))
    return tmp_path


def rate(outcome) -> float:
    """Return the frames a second of the last line."""
    words = outcome.out.splitlines()[-1].split()
    assert words[1:2] + words[3:] == ["frames,", "frames", "a", "second", "on", "cpu"]
    return float(words[2])


def printed_deviation(outcome) -> float:
    """Return the standard deviation of the flow that a command prints, px."""
    deviation = re.search(r"^standard deviation of the flow: (\d+\.\d) px", outcome.out, re.MULTILINE)
    assert deviation
    return float(deviation[1])


@pytest.mark.parametrize("interpolation", ["bicubic", "bilinear"])
def test_pictures_keep_their_names_and_sizes_and_are_warped_along_the_flow(call, folder, shifted, interpolation):
    outcome = call("restore", f"ckpt_path={shifted}", "input=raw", "out=out", f"interpolation={interpolation}")
    assert outcome.out.splitlines()[0] == "out: 4 restored, 0 already existed, 0 skipped"
    assert rate(outcome) > 0
    assert outcome.err == ""
    assert files_in(folder / "out") == sorted([*SIZES, "config.json"])
    for name, (height, width) in SIZES.items():
        flow = torch.tensor([width / 16, -height / 32]).view(1, 2, 1, 1).expand(1, 2, height, width)
        image = read_image(folder / "raw" / name)[None].contiguous()
        expected = warp(image, flow, padding="border", interpolation=interpolation)[0][0]
        # Files hold bytes.
        assert (read_image(folder / "out" / name) - expected).abs().max() < 0.51 / 255 + 1e-4


def test_the_standard_deviation_of_a_flow_is_printed_in_px_of_the_frames(call, folder, undecided):
    outcome = call("restore", f"ckpt_path={undecided}", "input=raw/a.png", "out=out")
    assert printed_deviation(outcome) == pytest.approx(96 / 20, rel=0.2)  # of 64 samples


def test_maps_of_the_standard_deviation_lie_beside_the_pictures_of_a_model_that_samples(call, folder, undecided):
    words = (f"ckpt_path={undecided}", "input=raw", "out=out")
    outcomes = [call("restore", *words)]
    assert outcomes[0].code == 0
    assert files_in(folder / "out") == sorted([*SIZES, "config.json"])
    plain = {name: (folder / "out" / name).read_bytes() for name in SIZES}
    outcomes.append(call("restore", *words, "deviation=true"))  # adds them to a folder without
    assert outcomes[1].out.splitlines()[0] == "out: 4 restored, 0 already existed, 0 skipped"
    maps = {name: name.rsplit(".", 1)[0] + ".deviation.png" for name in SIZES}
    assert files_in(folder / "out") == sorted([*SIZES, *maps.values(), "config.json"])
    assert {name: (folder / "out" / name).read_bytes() for name in SIZES} == plain
    levels = {name: np.array(Image.open(folder / "out" / maps[name])) for name in SIZES}
    for name, size in SIZES.items():
        assert (levels[name].shape, levels[name].dtype) == (size, np.uint16)
        assert (levels[name] == levels[name][0, 0]).all()  # a constant shift
        assert levels[name][0, 0] / 256 == pytest.approx(size[1] / 20, rel=0.3)  # of 64 samples
    median = np.median([value[0, 0] / 256 for value in levels.values()])
    for outcome in outcomes:
        assert printed_deviation(outcome) == pytest.approx(median, abs=0.06)
    (folder / "out" / maps["one/b.png"]).unlink()
    assert "1 restored, 3 already existed" in call("restore", *words, "deviation=true").out
    assert files_in(folder / "out") == sorted([*SIZES, *maps.values(), "config.json"])


def test_maps_of_the_standard_deviation_that_cannot_be_written_are_one_line_of_error(
    call, folder, undecided, shifted, brighter
):
    (folder / "clip").mkdir()
    save_clip(folder / "clip" / "a.avi", [smooth_picture(64)] * 2)
    for name in ("a.png", "a.bmp"):
        save_picture(folder / "twice" / name, smooth_picture(8, 8))
    single = f"ckpt_path={undecided}", "+model.samples=1"
    rule = "deviation must be false for pool=lens, whose deviation is printed, and for any model but ddpm with at least"
    for words, message in (
        ((f"ckpt_path={shifted}", "input=raw"), rule),
        ((f"ckpt_path={brighter}", "input=raw"), rule),
        ((*single, "input=raw"), rule),
        ((f"ckpt_path={undecided}", "input=clip"), "deviation must be false for videos, got true with clip/a.avi"),
        ((f"ckpt_path={undecided}", "input=raw", "pool=lens"), rule),
        ((f"ckpt_path={undecided}", "input=twice"), "deviation must have a name for each map, got twice/a.bmp and "),
        ((f"ckpt_path={undecided}", "input=raw", "deviation=2"), "deviation must be True or False, got 2"),
    ):
        assert call("restore", "deviation=true", *words).message.startswith(message)
        assert not (folder / "restored").exists()
    assert "standard deviation" not in call("restore", *single, "input=raw", "out=out").out


def test_pooled_frames_of_a_camera_are_restored_along_one_flow(call, tmp_path, drive, shifted):
    for i, frame in enumerate(drive((-0.16, 0.06), 6)):
        save_picture(tmp_path / "raw" / f"{i}.png", pixels_of(frame))
    outcome = call("restore", f"ckpt_path={shifted}", "input=raw", "out=out", "pool=lens")
    assert re.search(r"out/camera.yaml: k1 -0\.\d+ .* from 6 frames", outcome.out)
    flow = camera_flow(read_camera(tmp_path / "out" / "camera.yaml"))[0]
    for i in range(6):
        image = read_image(tmp_path / "raw" / f"{i}.png")[None].contiguous()
        expected = warp(image, flow, padding="border", interpolation="bicubic")[0][0].clamp(0, 1)
        assert (read_image(tmp_path / "out" / f"{i}.png") - expected).abs().max() < 0.51 / 255 + 1e-4
    again = call("restore", f"ckpt_path={shifted}", "input=raw", "out=out", "pool=lens").out
    assert "out: 0 restored, 6 already existed" in again


def test_each_video_is_restored_along_one_lens_by_a_model_that_finds_lenses(call, tmp_path, drive):
    frames = [pixels_of(frame) for frame in drive((-0.16, 0.06), 6)]
    (tmp_path / "raw").mkdir()
    write_video(frames, tmp_path / "raw" / "a.mp4", fps=10, size=(480, 270))
    save_picture(tmp_path / "raw" / "b.png", frames[0])
    (tmp_path / "raw" / "damaged.mp4").write_bytes(b"no video")
    outcome = call("restore", "ckpt_path=lens_small", "input=raw", "out=out")
    assert outcome.out.splitlines()[0].startswith("out/a.camera.yaml: k1 -0.")
    assert "out: 2 restored, 0 already existed, 1 skipped" in outcome.out
    assert outcome.err.count("skipped: ") == 1
    assert files_in(tmp_path / "out") == ["a.camera.yaml", "a.mp4", "b.png", "config.json"]
    flow = camera_flow(read_camera(tmp_path / "out" / "a.camera.yaml"))[0]
    assert flow.abs().max() > 3
    before, after = (dict(read_video(tmp_path / name / "a.mp4", range(6))) for name in ("raw", "out"))
    for i, image in before.items():
        expected = warp(image, flow, padding="border", interpolation="bicubic")[0].clamp(0, 1)
        assert (after[i] - expected).abs().mean() < 0.01  # of the codec
    assert call("restore", "ckpt_path=lens_small", "input=raw", "out=alone", "pool=null").code == 0
    assert files_in(tmp_path / "alone") == ["a.mp4", "b.png", "config.json"]


@pytest.mark.parametrize("tile", ["null", "[20,40]"])
def test_weather_is_removed_from_resized_pictures_and_in_tiles(call, folder, brighter, tile):
    assert call("restore", f"ckpt_path={brighter}", "input=raw", "out=out", f"tile={tile}").code == 0
    change = torch.tensor([0.2, 0.0, -0.1]).view(3, 1, 1)
    for name in SIZES:
        expected = (read_image(folder / "raw" / name) + change).clamp(0, 1)
        assert (read_image(folder / "out" / name) - expected).abs().max() < 0.51 / 255 + 1e-3


def test_side_by_side_writes_input_and_restoration(call, folder, brighter):
    words = (f"ckpt_path={brighter}", "input=raw", "out=out", "side_by_side=true")
    assert call("restore", *words).code == 0
    for name, (_, width) in SIZES.items():
        left, right = read_image(folder / "out" / name).split(width, dim=2)
        raw = read_image(folder / "raw" / name)
        assert torch.equal(left, raw)
        assert (right[0] - (raw[0] + 0.2).clamp(0, 1)).abs().max() < 0.51 / 255 + 1e-3
    assert "0 restored, 4 already existed" in call("restore", *words).out


def test_a_stopped_run_is_resumed(call, folder, brighter):
    words = (f"ckpt_path={brighter}", "input=raw", "out=out", "batch=3")
    assert call("restore", *words).code == 0
    complete = {name: (folder / "out" / name).read_bytes() for name in SIZES}
    times = {name: (folder / "out" / name).stat().st_mtime_ns for name in SIZES}
    (folder / "out" / "a.png").unlink()
    (folder / "out" / "one" / "b.png").write_bytes(complete["one/b.png"][:100])
    outcome = call("restore", *words)
    assert outcome.out.startswith("out: 2 restored, 2 already existed, 0 skipped")
    assert {name: (folder / "out" / name).read_bytes() for name in SIZES} == complete
    assert [name for name in SIZES if (folder / "out" / name).stat().st_mtime_ns == times[name]] == [*SIZES][2:]


def test_a_folder_of_other_settings_is_not_continued(call, folder, brighter, shifted):
    words = (f"ckpt_path={brighter}", "input=raw", "out=out")
    assert call("restore", *words).code == 0
    for word, difference in (
        ("side_by_side=true", "side_by_side is "),
        ("tile=16", "tile is "),
        ("size=[64,128]", "size is "),
        (f"ckpt_path={shifted}", "checkpoint is "),
    ):
        message = call("restore", *(w for w in words if w.split("=")[0] != word.split("=")[0]), word).message
        assert message.startswith("out must be a folder of the same configuration, got out, where ")
        assert difference in message
    config = json.loads((folder / "out" / "config.json").read_text())
    assert config["settings"]["input"] == str(folder / "raw")
    assert config["made_with"]["torchrefract"] == __version__


def test_a_folder_of_other_files_is_left_alone(call, folder, brighter):
    save_picture(folder / "out" / "a.png", smooth_picture(48, 96))
    before = (folder / "out" / "a.png").read_bytes()
    message = call("restore", f"ckpt_path={brighter}", "input=raw", "out=out").message
    assert message.startswith("out must be a new folder or one of this command, got out, which holds a.png")
    assert (folder / "out" / "a.png").read_bytes() == before


def test_a_damaged_picture_is_reported_and_skipped(call, folder, brighter):
    data = (folder / "raw" / "one" / "b.png").read_bytes()
    (folder / "raw" / "one" / "b.png").write_bytes(data[: len(data) // 2])
    outcome = call("restore", f"ckpt_path={brighter}", "input=raw", "out=out", "batch=1")
    assert outcome.out.startswith("out: 3 restored, 0 already existed, 1 skipped")
    assert outcome.err.startswith("skipped: raw/one/b.png is truncated")
    assert files_in(folder / "out") == sorted({*SIZES, "config.json"} - {"one/b.png"})


@pytest.mark.parametrize("name", ["one/b.png", "one/clip.avi"])
def test_a_file_that_vanishes_during_a_run_is_named_and_restored_by_the_next(call, folder, brighter, monkeypatch, name):
    save_clip(folder / "raw" / "one" / "clip.avi", [smooth_picture(64)] * 3)
    file, away, words = folder / "raw" / name, folder / "away", (f"ckpt_path={brighter}", "input=raw", "out=out")
    with monkeypatch.context() as patch:
        patch.setattr("torchrefract.cli.restoration.describe_losses", lambda *_, **__: [file.rename(away)][1:])
        outcome = call("restore", *words)
    assert outcome.code == 1
    assert outcome.out.startswith("out: 4 restored, 0 already existed, 1 skipped")
    reason = f"raw/{name} cannot be opened (No such file or directory)"
    assert outcome.err.splitlines() == [
        f"skipped: {reason}",
        f"error: input must stay unchanged during a run, got {reason}; the same command tries them again",
    ]
    away.rename(file)
    assert call("restore", *words).out.startswith("out: 1 restored, 4 already existed, 0 skipped")


def test_a_video_keeps_its_number_and_rate_of_frames(call, folder, brighter):
    frames = [smooth_picture(64, seed=k) for k in range(5)]
    save_clip(folder / "raw" / "one" / "clip.avi", frames)
    words = (f"ckpt_path={brighter}", "input=raw", "out=out", "batch=2", "side_by_side=true")
    outcome = call("restore", *words)
    assert outcome.out.startswith("out: 5 restored")
    assert outcome.out.splitlines()[1].startswith("9 frames, ")
    assert video_info(folder / "out" / "one" / "clip.mp4") == (5, 12.0)
    for raw, frame in zip(frames, load_clip(folder / "out" / "one" / "clip.mp4"), strict=True):
        expected = np.concatenate([raw, (raw + np.array([51, 0, -25.5])).clip(0, 255)], axis=1)
        assert np.abs(frame - expected).mean() < 8  # two lossy codecs
    assert "0 restored, 5 already existed" in call("restore", *words).out


def test_a_video_that_is_skipped_is_closed_at_once(call, tmp_path, brighter, monkeypatch):
    """An exception that is kept keeps frames, open files and the thread that prints the progress: a text does not."""
    (tmp_path / "raw").mkdir()
    Image.fromarray(smooth_picture(33, 65)).save(tmp_path / "raw" / "a.gif")
    all_skipped = list[Skipped]()
    monkeypatch.setattr(restoration, "Skipped", lambda: all_skipped.append(Skipped()) or all_skipped[-1])
    assert call("restore", f"ckpt_path={brighter}", "input=raw", "out=out").code == 1
    assert [type(error) for skipped in all_skipped for error in skipped.errors] == [str]


def test_a_video_with_an_odd_side_is_rejected(call, tmp_path, brighter):
    pages = [Image.fromarray(smooth_picture(63, 96, seed=k)) for k in range(2)]
    pages[0].save(tmp_path / "clip.gif", save_all=True, append_images=pages[1:])
    outcome = call("restore", f"ckpt_path={brighter}", "input=clip.gif", "out=out")
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1].startswith("error: input must hold a file that can be restored, got ")
    assert "clip.gif would give frames of 96 x 63, and videos take even sides only; crop it first: " in outcome.err
    assert outcome.err.endswith('ffmpeg -i INPUT -vf "crop=trunc(iw/2)*2:trunc(ih/2)*2" OUTPUT\n')
    assert files_in(tmp_path / "out") == ["config.json"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("out=raw",), "out must be another folder than that of input, got raw"),
        (("out=raw/restored",), "out must be a folder that does not lie in that of input, got raw/restored"),
        (("input=none",), "input must be a folder, a picture or a video, got none, which does not exist"),
        (("input=empty",), "input must be, or hold, .jpg, .jpeg, .png,"),
        (("tile=0",), "tile must be at least 1, got 0"),
        (("tile=half",), "tile must be (height, width), got 'half'"),
        (("size=64",), "size must be (height, width), got 64"),
        (
            ("size=[32,64]", "tile=32"),
            "size must be null beside tile, which has the resolution of the frame, got [32, 64]",
        ),
        (("batch=0",), "batch must be at least 1, got 0"),
        (("interpolation=cubic",), "interpolation must be one of nearest, bilinear, bicubic"),
        (("side_by_side=2",), "side_by_side must be True or False, got 2"),
        (("pool=lens",), "pool must be auto, null, or lens for the task undistort, got lens for deweather"),
        (("device=gpu",), "device must be auto, cpu or another device of this machine, got gpu"),
        (
            ("ckpt_path=none.ckpt",),
            "ckpt_path must be a checkpoint file, such as <run>/last.ckpt, or the name lens_small, got none.ckpt",
        ),
        (("ckpt_path=raw/a.png",), "ckpt_path must be an intact checkpoint, got raw/a.png, which is damaged"),
        (("tiles=3",), "an option must be one of ckpt_path, input, out, size, tile,"),
        (("+model.depth=3",), "ckpt_path must be of a model that can be built"),
    ],
)
def test_an_invalid_option_is_one_line_of_error(call, folder, brighter, words, message):
    (folder / "empty").mkdir()
    given = {word.split("=")[0] for word in words}
    others = [w for w in (f"ckpt_path={brighter}", "input=raw", "out=out") if w.split("=")[0] not in given]
    assert call("restore", *others, *words).message.startswith(message)
    assert sorted(path.name for path in folder.iterdir()) == ["empty", "raw"]


def test_a_model_that_predicts_a_flow_has_no_tiles(call, folder, shifted):
    message = call("restore", f"ckpt_path={shifted}", "input=raw", "tile=32").message
    assert message == "tile must be null for undistort, whose model needs the complete frame, got 32"
