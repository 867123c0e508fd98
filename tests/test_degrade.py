"""The command `degrade`: pictures and videos of a keyed draw, resumable, in processes."""

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from pictures import (
    files_in,
    load_clip,
    load_picture,
    save_media,
    save_picture,
    save_turned,
    smooth_picture,
    sound_of,
    times_of,
)
from processes import running, wait_for
from pycocotools.coco import COCO

from torchrefract import __version__, key_of, presets, warp, warp_boxes, warp_mask
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import write_opencv
from torchrefract.data.images import read_image
from torchrefract.data.pairs.files import decode_flow, encode_flow
from torchrefract.data.video import read_video, write_video

NAMES = ("a.png", "one/b.png", "one/two/c.bmp")
TIMES_MS = (0, 40, 80, 600)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Write pictures into raw/ and return the working folder."""
    for i, name in enumerate(NAMES):
        save_picture(tmp_path / "raw" / name, smooth_picture(width=96 + 32 * i, seed=i))
    return tmp_path


WORDS = ("source=raw", "out=out", "scene=cheap_dashcam", "severity=4", "workers=0")


def degraded(folder: Path, name: str, effect: Any, seed: int = 0) -> Any:
    image = read_image(folder / "raw" / name)[None].contiguous()
    return effect.degrade(image, seed=seed, keys=[key_of(name)])


def test_pictures_keep_their_names_and_are_drawn_by_them(call, folder):
    outcome = call("degrade", *WORDS, "seed=5")
    assert outcome.out.splitlines()[0] == "out: 3 degraded, 0 already existed, 0 skipped"
    assert (outcome.code, outcome.err) == (0, "")
    assert files_in(folder / "out") == sorted([*NAMES, "config.json"])
    settings = json.loads((folder / "out" / "config.json").read_text())["settings"]
    assert settings["scene"] == {"_target_": "torchrefract.presets.cheap_dashcam", "severity": 4}
    assert (settings["source"], settings["seed"]) == (str(folder / "raw"), 5)
    for name in NAMES:
        expected = degraded(folder, name, presets.cheap_dashcam(4), seed=5).image[0]
        assert (read_image(folder / "out" / name) - expected).abs().max() < 0.51 / 255 + 1e-5
    # A file keeps its draw if it is the only one.
    (folder / "raw" / "a.png").unlink()
    assert call("degrade", *WORDS, "seed=5", "out=more").code == 0
    assert (folder / "more" / NAMES[1]).read_bytes() == (folder / "out" / NAMES[1]).read_bytes()


def test_a_folder_of_another_version_is_continued_with_a_warning(call, folder):
    (folder / "raw" / NAMES[1]).rename(folder / "b.png")
    assert call("degrade", *WORDS).code == 0
    path = folder / "out" / "config.json"
    config = json.loads(path.read_text())
    expected = {"torchrefract": __version__, "torch": torch.__version__, "numpy": np.__version__}
    assert config["made_with"] == expected | {"opencv": cv2.__version__}
    path.write_text(json.dumps(config | {"made_with": expected | {"torchrefract": "0.0"}}))
    (folder / "b.png").rename(folder / "raw" / NAMES[1])
    outcome = call("degrade", *WORDS)
    assert outcome.out.startswith("out: 1 degraded, 2 already existed")
    assert outcome.err.startswith("warning: the files in out were made with torchrefract 0.0, torch ")
    assert call("degrade", *WORDS).err == ""


def test_a_stopped_run_is_resumed_with_the_same_bytes_in_processes(call, folder):
    assert call("degrade", *WORDS).code == 0
    complete = {name: (folder / "out" / name).read_bytes() for name in NAMES}
    (folder / "out" / "a.png").unlink()
    (folder / "out" / NAMES[1]).write_bytes(complete[NAMES[1]][:100])
    outcome = call("degrade", *WORDS, "workers=2")
    assert outcome.out.startswith("out: 2 degraded, 1 already existed, 0 skipped")
    assert {name: (folder / "out" / name).read_bytes() for name in NAMES} == complete
    message = call("degrade", *WORDS, "severity=3").message
    assert message.startswith("out must be a folder of the same configuration, got out, where scene.severity is 4")


def test_ctrl_c_while_the_processes_start_is_one_line(folder):
    with running("-m", "torchrefract.degrade", *WORDS, "out=later", "workers=1", cwd=folder) as process:
        wait_for((folder / "later").exists, process)
        time.sleep(1)  # the server of the processes imports the package, which takes seconds
        os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it
        _, message = process.communicate(timeout=60)
    assert process.returncode == 130
    lines = [
        line
        for line in message.splitlines()
        if not line.startswith(("warning: ", "torchrefract: loading", "degrading: "))
    ]
    assert lines == ["stopped; the same command continues"]


def test_displacements_scale_with_the_width_of_each_picture_unless_a_width_is_given(call, folder):
    words = ("source=raw", "scene=paper_refractive", "maps=true", "workers=0")
    assert call("degrade", *words, "out=own").code == 0
    assert call("degrade", *words, "out=given", "scene.width=640").code == 0
    for out, width in (("own", None), ("given", 640)):
        for i, name in enumerate(NAMES):
            expected = degraded(folder, name, presets.paper_refractive(width=width or 96 + 32 * i))
            data = (folder / out / "maps" / Path(name).with_suffix(".flow.png")).read_bytes()
            flow, valid = (torch.from_numpy(array) for array in decode_flow(data))
            assert torch.equal(valid, expected.valid[0, 0])
            assert (flow - expected.flow[0]).abs()[:, valid].max() < 0.01


def test_flows_beyond_the_range_of_a_png_are_warned_of(call, folder):
    save_picture(folder / "raw" / "a" / "wide.png", smooth_picture(32, 4000))
    (folder / "conf" / "scene").mkdir(parents=True)
    scene = "_target_: torchrefract.LensDistortion\nk1_range: [-0.9, -0.9]\nframe: pad\n"
    (folder / "conf" / "scene" / "mine.yaml").write_text(scene)
    for maps, is_warned in (("png", True), ("npz", False)):
        words = ("--config-dir", "conf", "source=raw/a", f"out={maps}", "scene=mine", f"maps={maps}", "workers=0")
        outcome = call("degrade", *words)
        assert outcome.code == 0, outcome.err
        assert ("the flows of wide.png exceed 512 px, the range of a PNG" in outcome.err) == is_warned


def test_maps_are_those_of_the_effect(call, folder):
    words = ("source=raw", "out=out", "scene=paper_weather", "workers=0", "maps=npz")
    assert call("degrade", *words).code == 0
    stems = [Path(name).with_suffix("").as_posix() for name in NAMES]
    names = [f"images/{name}" for name in NAMES] + [f"maps/{stem}.maps.npz" for stem in stems]
    assert files_in(folder / "out") == sorted([*names, "config.json"])
    for name, stem in zip(NAMES, stems, strict=True):
        expected = degraded(folder, name, presets.paper_weather())
        with np.load(folder / "out" / "maps" / f"{stem}.maps.npz") as maps:
            assert np.array_equal(maps["valid"], expected.valid[0, 0].numpy())
            for kind in ("transmission", "intensity"):
                assert (kind in maps) == expected.has(kind)
                if expected.has(kind):
                    np.testing.assert_allclose(maps[kind], getattr(expected, kind)[0, 0].numpy(), atol=1e-5)


def test_fog_takes_depth_maps(call, folder):
    for name in NAMES:
        path = folder / "depth" / Path(name).with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(
            path,
            np.full(read_image(folder / "raw" / name).shape[1:], 30, np.float32),
        )
    words = ("source=raw", "scene=cape_town_fog", "workers=0")
    assert "depth maps, as estimate_depth writes them, are better" in call("degrade", *words, "out=assumed").err
    outcome = call("degrade", *words, "out=given", "depth=depth")
    assert (outcome.code, outcome.err) == (0, "")
    near = presets.cape_town_fog(depth=lambda image: torch.full_like(image[:, :1], 30.0))
    for name in NAMES:
        expected = degraded(folder, name, near).image[0]
        assert (read_image(folder / "given" / name) - expected).abs().max() < 0.51 / 255 + 1e-4


def test_files_whose_depth_map_changed_after_they_were_degraded_are_degraded_again(call, folder):
    (folder / "raw" / "one").rename(folder / "one")  # one picture is enough
    write_video([smooth_picture(16, 32)] * 2, folder / "raw" / "c.mp4", fps=10, size=(32, 16))
    maps = [folder / "depth" / name for name in ("a.png", "c.mp4/000000.png", "c.mp4/000001.png")]
    for path, size in zip(maps, ((48, 96), (16, 32), (16, 32)), strict=True):
        save_picture(path, np.full(size, 30 * 256, np.uint16))
    words = ("source=raw", "scene=cape_town_fog", "workers=0", "out=out", "depth=depth")
    assert call("degrade", *words).code == 0
    before = (folder / "out" / "a.png").read_bytes()
    save_picture(maps[0], np.full((48, 96), 60 * 256, np.uint16))
    assert call("degrade", *words).out.startswith("out: 1 degraded, 1 already existed, 0 skipped")
    assert (folder / "out" / "a.png").read_bytes() != before
    save_picture(maps[2], np.full((16, 32), 60 * 256, np.uint16))
    assert call("degrade", *words).out.startswith("out: 1 degraded, 1 already existed, 0 skipped")


@pytest.mark.parametrize("scene", ["cheap_dashcam", "cape_town_fog"])
def test_a_video_is_one_clip_that_keeps_its_orientation_times_and_sound(call, tmp_path, scene):
    # Later frames are darker: the color of fog must stay that of the first one.
    frames = [(smooth_picture(64, 96, seed=k) * (1 - 0.2 * k)).astype(np.uint8) for k in range(4)]
    quarter_turn = (0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    save_media(tmp_path / "drive.mov", frames, times=TIMES_MS, sound="aac", matrix=quarter_turn)
    words = ("source=drive.mov", "out=out", f"scene={scene}", "severity=5", "workers=0", "maps=npz")
    assert call("degrade", *words).code == 0
    source, target = tmp_path / "drive.mov", tmp_path / "out" / "images" / "drive.mp4"
    clip = torch.stack([frame[0] for _, frame in read_video(source, range(4))])[None]
    assert clip.shape == (1, 4, 3, 96, 64)  # upright
    expected = getattr(presets, scene)(5).degrade(clip, seed=0, keys=[key_of("drive.mov")])
    for (t, frame), image in zip(read_video(target, range(4)), expected.image[0], strict=True):
        assert (frame[0] - image).abs().mean() < 0.02, t  # of the codec
        with np.load(tmp_path / "out" / "maps" / "drive.mov" / f"{t:06d}.maps.npz") as maps:
            name = "flow" if expected.has("flow") else "transmission"
            np.testing.assert_allclose(maps[name].squeeze(), getattr(expected, name)[0, t].squeeze(), atol=1e-3)
    assert np.abs(load_clip(target)[0] / 255 - expected.image[0, 0].movedim(0, -1).numpy()).mean() < 0.02
    assert times_of(target) == pytest.approx([t / 1000 for t in TIMES_MS], abs=1e-3)
    assert np.array_equal(sound_of(source)[1], sound_of(target)[1])
    assert call("degrade", *words).out.startswith("out: 0 degraded, 1 already existed, 0 skipped")


def test_a_picture_is_degraded_as_displayed_and_keeps_16_bits(call, tmp_path):
    save_picture(tmp_path / "raw" / "deep.png", smooth_picture().astype(np.uint16) * 257)
    save_turned(tmp_path / "raw" / "phone.png", smooth_picture(), 6)
    assert call("degrade", *WORDS).code == 0
    for name, shape, bits in (("phone.png", (3, 96, 48), 8), ("deep.png", (3, 48, 96), 16)):
        expected = degraded(tmp_path, name, presets.cheap_dashcam(4)).image[0]
        assert expected.shape == shape
        assert (read_image(tmp_path / "out" / name) - expected).abs().max() < 0.51 / (2**bits - 1) + 1e-5


def test_a_picture_that_changed_after_it_was_degraded_is_degraded_again(call, folder):
    assert call("degrade", *WORDS).code == 0
    source, target = folder / "raw" / "one" / "b.png", folder / "out" / "one" / "b.png"
    before = target.read_bytes()
    save_picture(source, 255 - smooth_picture())
    assert call("degrade", *WORDS).out.startswith("out: 1 degraded, 2 already existed, 0 skipped")
    assert target.read_bytes() != before
    later = time.time() + 3600
    os.utime(source, (later, later))  # by the clock of a camera in another time zone
    assert call("degrade", *WORDS).out.startswith("out: 0 degraded, 3 already existed, 0 skipped")


def test_what_is_no_picture_is_named_and_skipped(call, folder):
    (folder / "raw" / "text.jpg").write_text("no picture")
    outcome = call("degrade", *WORDS)
    assert (outcome.code, outcome.out.splitlines()[0]) == (0, "out: 3 degraded, 0 already existed, 1 skipped")
    assert outcome.err == "skipped: raw/text.jpg is not a JPEG, PNG, WebP or BMP image\n"


def test_a_file_that_vanishes_during_a_run_is_named_and_degraded_by_the_next(call, folder, monkeypatch):
    file, away = folder / "raw" / "one" / "b.png", folder / "away.png"
    with monkeypatch.context() as patch:
        patch.setattr("torchrefract.data.media.describe_losses", lambda *_, **__: [file.rename(away)][1:])
        outcome = call("degrade", *WORDS, "workers=1")
    assert outcome.code == 1
    reason = "raw/one/b.png cannot be opened (No such file or directory)"
    assert outcome.err.splitlines() == [
        f"skipped: {reason}",
        f"error: source must stay unchanged during a run, got {reason}; the same command tries them again",
    ]
    away.rename(file)
    assert call("degrade", *WORDS).out.startswith("out: 1 degraded, 2 already existed, 0 skipped")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("source=empty",), "source must be, or hold, .jpg, .jpeg, .png,"),
        (("source=no.png",), "source must hold a file that can be degraded, got no.png is not a JPEG, PNG, WebP"),
        (("out=raw",), "out must be another folder than that of source, got raw"),
        (("out=other",), "out must be a new folder or one of this command, got other, which holds a.png"),
        (("severity=6",), "scene: severity must be one of 1, 2, 3, 4, 5, got 6"),
        (("maps=jpg",), "maps must be one of png, npz, safetensors, got 'jpg'"),
        (("labels=empty",), "labels must be a COCO JSON, or a folder of YOLO files (.txt) or masks (.png), got empty"),
        (("severities=3",), "an option must be one of source, out, severity, labels,"),
    ],
)
def test_an_invalid_option_is_one_line_of_error(call, folder, words, message):
    (folder / "empty").mkdir()
    (folder / "no.png").write_text("no picture")
    save_picture(folder / "other" / "a.png", smooth_picture())
    before = files_in(folder)
    given = {word.split("=")[0] for word in words}
    outcome = call("degrade", *(word for word in WORDS if word.split("=")[0] not in given), *words)
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1].startswith(f"error: {message}")
    assert [name for name in files_in(folder) if name != "out/config.json"] == before  # nothing is lost


def coco(folder: Path, **changes: Any) -> Path:
    """Write a COCO JSON of the pictures, each with a box in the middle and one in a corner."""
    images, annotations = [], []
    for i, name in enumerate(NAMES):
        width = 96 + 32 * i
        images.append({"id": 7 * i, "file_name": name, "height": 48, "width": width})
        for k, (x, y) in enumerate([(width / 2 - 10, 14.0), (0.0, 0.0)]):
            box = {"bbox": [x, y, 20.0, 18.0], "area": 360.0, "category_id": 3, "iscrowd": 0}
            annotations.append({"id": 10 * i + k, "image_id": 7 * i, **box})
    document = {"info": {"year": 2026}, "images": images, "annotations": annotations, "categories": [{"id": 3}]}
    (folder / "boxes.json").write_text(json.dumps(document | changes))
    return folder / "boxes.json"


def test_labels_of_coco_follow_the_flow_of_their_picture_also_after_a_resume(call, folder, capsys):
    coco(folder)
    words = (*WORDS, "labels=boxes.json")
    assert call("degrade", *words).out.splitlines()[0].endswith("0 skipped; 0 labels left the frame")
    complete = (folder / "out" / "labels" / "boxes.json").read_bytes()
    labels = COCO(folder / "out" / "labels" / "boxes.json")
    capsys.readouterr()
    for i, name in enumerate(NAMES):
        flow = degraded(folder, name, presets.cheap_dashcam(4)).flow[0]
        x, y = (96 + 32 * i) / 2 - 10.5, 13.5
        expected, _ = warp_boxes(torch.tensor([[x, y, x + 20, y + 18], [-0.5, -0.5, 19.5, 17.5]]), flow)
        rows = labels.loadAnns(labels.getAnnIds(imgIds=[7 * i]))
        boxes = torch.tensor([row["bbox"] for row in rows])
        torch.testing.assert_close(boxes[:, :2], expected[:, :2] + 0.5, atol=2e-3, rtol=0)
        torch.testing.assert_close(boxes[:, 2:], expected[:, 2:] - expected[:, :2], atol=2e-3, rtol=0)
        assert [row["area"] for row in rows] == pytest.approx(boxes[:, 2:].prod(dim=1).tolist(), rel=1e-3)
        assert labels.loadImgs([7 * i])[0]["file_name"] in files_in(folder / "out" / "images")
    # A run that was killed leaves a picture without its line, and a line without its end.
    journal = folder / "out" / ".labels.jsonl"
    lines = journal.read_text().split("\n")
    journal.write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:30])
    (folder / "out" / "labels" / "boxes.json").unlink()
    assert call("degrade", *words).out.startswith("out: 1 degraded, 2 already existed, 0 skipped")
    assert (folder / "out" / "labels" / "boxes.json").read_bytes() == complete


def test_a_picture_without_result_is_left_out_of_the_labels(call, folder):
    coco(folder)
    (folder / "raw" / "a.png").write_text("no picture")
    save_picture(folder / "raw" / "new.png", smooth_picture())
    outcome = call("degrade", *WORDS, "labels=boxes.json")
    assert outcome.err.splitlines() == [
        "warning: labels do not list 1 of the files: new.png",
        "skipped: raw/a.png is not a JPEG, PNG, WebP or BMP image",
    ]
    document = json.loads((folder / "out" / "labels" / "boxes.json").read_text())
    assert [image["file_name"] for image in document["images"]] == [*NAMES[1:]]
    assert {annotation["image_id"] for annotation in document["annotations"]} == {7, 14}


@pytest.mark.parametrize("kind", ["yolo", "masks"])
def test_labels_in_a_folder_are_written_under_the_names_of_their_pictures(call, folder, kind):
    for name in NAMES:
        path = folder / "labels" / Path(name).with_suffix(".txt" if kind == "yolo" else ".png")
        ids = np.zeros(read_image(folder / "raw" / name).shape[1:], np.uint8)
        ids[12:36, 24:72] = 7
        save_picture(path.with_suffix(".png"), ids)
        if kind == "yolo":
            path.with_suffix(".png").unlink()
            path.write_text(f"4 {48 / ids.shape[1]} 0.5 {48 / ids.shape[1]} 0.5\n")
    assert call("degrade", *WORDS, "labels=labels").code == 0
    for name in NAMES:
        flow = degraded(folder, name, presets.cheap_dashcam(4)).flow[0]
        path = folder / "out" / "labels" / Path(name).with_suffix(".txt" if kind == "yolo" else ".png")
        if kind == "masks":
            source = load_picture(folder / "labels" / Path(name).with_suffix(".png"))
            expected = warp_mask(torch.from_numpy(source)[None], flow)[0].numpy()
            assert np.array_equal(load_picture(path), expected)
        else:
            label, *numbers = path.read_text().split()
            x, y, w, h = (float(n) * side for n, side in zip(numbers, [flow.shape[2], 48] * 2, strict=True))
            box, _ = warp_boxes(torch.tensor([[23.5, 11.5, 71.5, 35.5]]), flow)
            expected = (box[0] + 0.5).tolist()
            assert label == "4"
            assert [x - w / 2, y - h / 2, x + w / 2, y + h / 2] == pytest.approx(expected, abs=2e-3)


def test_labels_that_name_no_picture_are_an_error_before_anything_is_written(call, folder):
    coco(folder)
    (folder / "raw" / "a.png").unlink()
    message = call("degrade", *WORDS, "labels=boxes.json").message
    assert message == (
        "labels must name pictures of source, got a.png in boxes.json, which source does not hold; give the folder "
        "that these names are relative to, or remove them"
    )
    (folder / "labels").mkdir()
    (folder / "labels" / "z.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    assert call("degrade", *WORDS, "labels=labels").message.startswith("labels must name pictures of source, got z.txt")
    assert not (folder / "out").exists()


def test_pictures_that_would_share_labels_or_maps_are_an_error(call, folder):
    save_picture(folder / "raw" / "one" / "b.jpg", smooth_picture())
    message = call("degrade", *WORDS, "maps=true").message
    assert message.startswith("source must hold pictures whose names differ in more than their extension")
    assert message.endswith("got two of one/b")
    assert call("degrade", *WORDS).code == 0


def test_another_camera_under_the_name_of_the_first_is_not_mixed_with_its_pictures(call, folder):
    save_picture(folder / "square" / "a.png", smooth_picture(64, 64))
    words = ("source=square", "out=out", "scene=cape_town_fog", "scene.camera=camera.yaml", "workers=0")
    for focal, code in ((50.0, 0), (50.0, 0), (60.0, 1)):
        camera = Camera(width=64, height=64, fx=focal, fy=focal, cx=31.5, cy=31.5, coefficients=(0.0,) * 4)
        write_opencv(folder / "camera.yaml", camera)
        outcome = call("degrade", *words)
        assert outcome.code == code, outcome.err
    assert "error: out must be a folder of the same configuration, got out, where files.camera.yaml is" in outcome.err


@pytest.mark.parametrize("kind", ["coco", "yolo"])
def test_dust_is_thicker_behind_the_vehicles_among_the_labels(call, folder, kind):
    document = {
        "images": [{"id": 1, "file_name": "a.png", "height": 48, "width": 96}],
        "categories": [{"id": 3, "name": "Car"}, {"id": 1, "name": "person"}],
        "annotations": [
            {"id": i, "image_id": 1, "category_id": category, "bbox": box}
            for i, (category, box) in enumerate([(3, [30.0, 20, 18, 14]), (1, [70.0, 20, 6, 14])])
        ],
    }
    (folder / "labels.json").write_text(json.dumps(document))
    (folder / "yolo").mkdir()
    (folder / "yolo" / "a.txt").write_text("2 0.40625 0.5625 0.1875 0.2916667\n0 0.760417 0.5625 0.0625 0.2916667\n")
    labels = ("labels=labels.json",) if kind == "coco" else ("labels=yolo", "scene.vehicle_labels=[2]")
    words = ("source=raw/a.png", "out=out", "scene=unpaved_road", "scene.width=96", "maps=npz", "workers=0")
    assert call("degrade", *words, *labels).code == 0
    image, scene = read_image(folder / "raw" / "a.png")[None], presets.unpaved_road(width=96)
    params = scene.sample(image, seed=0, keys=[key_of("a.png")])
    dust = params.children[0]._replace(vehicles=torch.tensor([[[29.5, 19.5, 47.5, 33.5]]]))
    expected = scene.apply(image, params._replace(children=(dust, *params.children[1:])))
    with np.load(folder / "out" / "maps" / "a.maps.npz") as maps:
        assert np.abs(maps["transmission"] - expected.transmission[0, 0].numpy()).max() < 1e-5
    assert (expected.transmission - scene.apply(image, params).transmission).abs().max() > 0.1


@pytest.mark.parametrize("kind", [".flo", ".png"])
def test_optical_flow_leads_to_where_the_next_degraded_picture_shows_it(call, tmp_path, kind):
    # The picture moves by 3 px to the right and 1 px up from frame to frame.
    scene = smooth_picture(96, 140, seed=3)
    motion = np.broadcast_to(np.array([3, -1], np.float32), (72, 96, 2))
    for i in range(3):
        save_picture(tmp_path / "raw" / f"{i + 9}.png", scene[10 + i : 82 + i, 20 - 3 * i : 116 - 3 * i])
        path = tmp_path / "flow" / f"{i + 9}{kind}"
        path.parent.mkdir(exist_ok=True)
        if i < 2:
            data = encode_flow(motion.transpose(2, 0, 1), np.ones((72, 96), bool))
            assert path.write_bytes(data) if kind == ".png" else cv2.writeOpticalFlow(str(path), motion)
    words = ("source=raw", "out=out", "scene=paper_refractive", "severity=5", "workers=0", "labels=flow")
    outcome = call("degrade", *words)
    assert (outcome.code, outcome.err) == (0, "")
    assert files_in(tmp_path / "out" / "labels") == sorted(f"{i}{kind}" for i in (9, 10))
    effect = presets.paper_refractive(5, width=96)
    results = [degraded(tmp_path, f"{i}.png", effect) for i in (9, 10, 11)]
    for i in range(2):
        path = tmp_path / "out" / "labels" / f"{i + 9}{kind}"
        if kind == ".png":
            flow, valid = decode_flow(path.read_bytes())
        else:
            flow = cv2.readOpticalFlow(str(path)).transpose(2, 0, 1)
            valid = np.abs(flow).max(axis=0) < 1e9
        assert valid.mean() > 0.6
        moved, _ = warp(results[i + 1].image, torch.from_numpy(np.where(valid, flow, 0).astype(np.float32))[None])
        miss = (moved - results[i].image).abs()[..., torch.from_numpy(valid)]
        assert miss.max() < 0.03  # by two interpolations of the picture
        plain, _ = warp(results[i + 1].image, torch.from_numpy(motion.transpose(2, 0, 1).copy())[None])
        assert miss.mean() < (plain - results[i].image).abs()[..., torch.from_numpy(valid)].mean() / 5
    (tmp_path / "raw" / "11.png").unlink()
    message = call("degrade", *words, "out=more").message
    assert message.startswith("source must hold the picture after each that has an optical flow, got none after 10.png")


def test_pictures_of_a_drive_are_one_clip_like_a_video(call, tmp_path):
    names = ["one/2.png", "one/10.png", "one/11.png", "two/front/5.png"]  # 10 is after 2
    for i, name in enumerate(names):
        save_picture(tmp_path / "raw" / name, smooth_picture(seed=i))
    words = ("degrade", "source=raw", "scene=cape_town_fog", "severity=4", "workers=0", "seed=3")
    assert call(*words, "out=out", "drive_by=folder").code == 0
    effect = presets.cape_town_fog(4)
    for drive, clip in (("one", names[:3]), ("two", names[3:])):
        frames = [read_image(tmp_path / "raw" / name)[None].contiguous() for name in clip]
        params = effect.sample(frames[0], seed=3, keys=[key_of(drive)])
        for t, (name, frame) in enumerate(zip(clip, frames, strict=True)):
            expected = effect.apply(frame, params, frame=t).image[0]
            assert (read_image(tmp_path / "out" / name) - expected).abs().max() < 0.51 / 255 + 1e-5, name
    complete = {name: (tmp_path / "out" / name).read_bytes() for name in names}
    (tmp_path / "out" / names[1]).unlink()
    assert call(*words, "out=out", "drive_by=folder").code == 0
    assert {name: (tmp_path / "out" / name).read_bytes() for name in names} == complete
    # Another listing would move pictures to other times.
    save_picture(tmp_path / "raw" / "one" / "4.png", smooth_picture())
    *_, error = call(*words, "out=out", "drive_by=folder").err.splitlines()
    assert error.startswith("error: out must ")
    assert "drives" in error
    save_picture(tmp_path / "raw" / "one" / "4.png", smooth_picture(width=64))
    outcome = call(*words, "out=more", "drive_by=prefix")
    assert "4.png: pictures of a drive must have the size of its first one, one/2.png, 96x48, got 64x48" in outcome.err
    *_, error = call(*words, "out=none", "drive_by=car").err.splitlines()
    assert error.startswith("error: drive_by must be one of auto, folder, prefix")
