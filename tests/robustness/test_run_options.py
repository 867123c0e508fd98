import base64
import csv
import io
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from pictures import save_picture, save_turned
from PIL import Image

import torchrefract
from torchrefract import Camera, key_of, presets
from torchrefract.cameras.io import write_opencv
from torchrefract.data.images import read_image
from torchrefract.robustness.quantities import SCENES

MODEL = """
import torch

def brightness(images):
    return images.mean(dim=(1, 2, 3))[:, None]

def shaken(images):
    if images.amin() > 0.99:
        raise RuntimeError("a white picture")
    return 0.5 * brightness(images)

def blind(images):
    return torch.zeros(1, 1)

def darkness(prediction, target):
    return 1 - prediction.item()

def lightness(prediction, target):
    raise AssertionError

def half(prediction, target):
    return 0.5

def classes(images):
    return torch.tensor([[0.0, 1.0]])

def pixels(images):
    return torch.stack([1 - images[:, 0], images[:, 0] - 0.4], dim=1)

def boxes(images):
    return [{"boxes": torch.tensor([[8.0, 8, 30, 30]]), "labels": torch.ones(1).long(), "scores": torch.ones(1)}]
"""
RUN = ("robustness.__main__", "data=frames", "score=gray:darkness", "severity=[1,5]")
FOG = "scene=[cape_town_fog,cheap_dashcam]"
CAMERA = Camera(width=64, height=36, fx=80.0, fy=80.0, cx=31.5, cy=17.5, coefficients=(0.0,) * 5)


@pytest.fixture
def frames(tmp_path, write_module) -> Path:
    """Write four gray pictures and a white one, and models; the error of `brightness` is the mean of its picture."""
    for i, level in enumerate((0, 40, 80, 120, 255)):
        save_picture(tmp_path / "frames" / f"{i}.png", np.full((36, 64, 3), level, np.uint8))
    write_module("gray", MODEL)
    return tmp_path / "frames"


def scores(out: Path) -> dict[str, list]:
    """Return the scores of a run: for each picture, scene, severity, and score first of the next list."""
    return {row["name"]: row["levels"] for row in map(json.loads, (out / "scores.jsonl").read_text().splitlines()[1:])}


def test_a_picture_that_changed_after_it_was_scored_is_scored_again(call, tmp_path, frames):
    run = (*RUN, "scene=[cheap_dashcam]", "model=gray:brightness", "out=out")
    assert call(*run).code == 0
    before = scores(tmp_path / "out")
    save_picture(frames / "1.png", np.full((36, 64, 3), 100, np.uint8))
    assert call(*run).code == 0
    after = scores(tmp_path / "out")
    assert [name for name in after if after[name] != before[name]] == ["1.png"]
    assert after["1.png"][0][2][0] == pytest.approx(1 - 100 / 255, abs=0.01)  # `darkness` of a gray picture


# --- beside a base run


def test_a_run_beside_a_base_states_its_corruption_errors_and_the_pictures_left_out(call, results, tmp_path, frames):
    assert call(*RUN, FOG, "model=gray:shaken", "out=base").code == 0
    (frames / "0.png").unlink()
    outcome = call(*RUN, FOG, "model=gray:brightness", "out=out", "base=base")
    assert outcome.code == 0, outcome.err
    errors = {
        (out, scene): np.mean(
            [1 - of[0] for n in "123" for s, _, of in scores(tmp_path / out)[f"{n}.png"] if s == scene]
        )
        for out in ("out", "base")
        for scene in ("cape_town_fog", "cheap_dashcam")
    }
    expected = {name: errors["out", name] / errors["base", name] for name in ("cape_town_fog", "cheap_dashcam")}
    of_both = results()["corruption_error"]
    assert of_both["scenes"] == pytest.approx(expected, rel=1e-6)
    assert of_both["scenes"] == pytest.approx({scene: 2.0 for scene in expected}, rel=1e-4)  # half of the error
    assert of_both["mean"] == pytest.approx(np.mean(list(expected.values())))
    assert (of_both["num_images"], of_both["left_out"], of_both["left_out_of_base"]) == (3, 1, 1)
    assert (of_both["base"], of_both["model"]) == ("base", "gray:shaken")
    verdict = "mCE 2.000 beside gray:shaken, on the 3 pictures of both runs; left out: 1 of this one and 1 of base\n"
    assert verdict in outcome.out
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<td>cape_town_fog</td><td>2.000</td>" in page
    assert "<td>mCE</td><td>2.000</td>" in page
    assert "on the 3 images of both runs; 1 of this one and 1 of the base are left out" in page
    without = (tmp_path / "out" / "scores.jsonl").read_bytes()
    assert call(*RUN, FOG, "model=gray:brightness", "out=out").code == 0  # continues
    assert (tmp_path / "out" / "scores.jsonl").read_bytes() == without
    assert "corruption_error" not in results()
    assert "mCE" not in (tmp_path / "out" / "report.html").read_text()


def test_a_base_without_an_error_gives_no_number_and_says_so(call, results, tmp_path, frames):
    assert call(*RUN, "scene=cape_town_fog", "model=gray:blind", "out=base").code == 0
    outcome = call(*RUN, "scene=cape_town_fog", "model=gray:brightness", "out=out", "base=base")
    of_both = results()["corruption_error"]
    assert of_both["scenes"] == {"cape_town_fog": None}
    assert of_both["mean"] is None
    assert "warning: there is no mCE, as the base makes no error in cape_town_fog\n" in outcome.err
    assert "nan" not in outcome.out


def test_a_base_without_labels_is_said_to_state_another_number(call, frames):
    words = ("scene=cheap_dashcam", "model=gray:brightness", "base=base")
    assert call(*RUN, *words[:2], "out=base").code == 0
    warning = "warning: without labels, each error is the disagreement of a model with its own clean predictions"
    assert warning in call(*RUN, *words, "out=out").err


def test_a_base_of_other_settings_is_one_line_before_the_first_prediction(call, tmp_path, frames):
    (tmp_path / "others").mkdir()
    for path in frames.iterdir():
        (tmp_path / "others" / path.name).write_bytes(path.read_bytes())
    assert call(*RUN, FOG, "model=gray:shaken", "out=base").code == 0
    run = (*RUN, FOG, "model=gray:brightness", "out=out", "base=base")
    for word, got in {
        "seed=1": "seed=0",
        "severity=[1,4]": "severity=[1, 5]",
        "scene=cheap_dashcam": "scene=['cape_town_fog', 'cheap_dashcam']",
        "data=others": f"data={frames}",
        "score=gray:lightness": "score=gray:darkness",
        "horizon=0.4": "horizon=None",
    }.items():
        assert call(*run, word).message == (
            f"base must be a run on the same data with the same settings, got one with {got}; score that model again "
            "with the options of this run"
        )
    message = call(*run, "base=nowhere").message
    assert message.startswith("base must be a folder of an earlier run, got nowhere, which has no scores.jsonl")
    lines = (tmp_path / "base" / "scores.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "base" / "scores.jsonl").write_text("".join(line for line in lines if '"0.png"' not in line))
    message = call(*run, "limit=1").message
    assert message.startswith("base must have scores of the same images, got none of 0.png")
    assert not (tmp_path / "out").exists()


def test_a_base_whose_pictures_had_other_draws_is_one_line_and_no_table(call, tmp_path, frames):
    assert call(*RUN, "scene=cape_town_fog", "model=gray:shaken", "out=base").code == 0
    path = tmp_path / "base" / "scores.jsonl"
    settings, *rows = map(json.loads, path.read_text().splitlines())
    for row in rows:  # as of a version that draws other fogs
        row["levels"] = [[*level, [score, 7000.0, *rest]] for *level, (score, _, *rest) in row["levels"]]
    path.write_text("".join(json.dumps(row) + "\n" for row in [settings, *rows]))
    outcome = call(*RUN, "scene=cape_town_fog", "model=gray:brightness", "out=out", "base=base")
    *_, error = outcome.err.splitlines()
    assert error.startswith("error: base must be of the same draws, by the same seed and version, got a visib")
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name[0] != "."] == ["scores.jsonl"]


# --- versions


def state_versions(out: Path, **versions: str) -> None:
    """Replace the versions that a run has stored; without any, it is one that stored none."""
    path = out / "scores.jsonl"
    settings, *rows = path.read_text().splitlines(keepends=True)
    settings = {name: of for name, of in json.loads(settings).items() if name != "versions"}
    path.write_text(json.dumps(settings | ({"versions": versions} if versions else {})) + "\n" + "".join(rows))


def test_a_run_of_another_version_is_not_continued_and_both_are_named(call, tmp_path, frames):
    words = (*RUN, "scene=cheap_dashcam", "model=gray:brightness", "out=out")
    assert call(*words).err == ""
    state_versions(tmp_path / "out", torchrefract="0.1.9", torch=torch.__version__)
    before = (tmp_path / "out" / "scores.jsonl").read_bytes()
    assert call(*words).message == (
        f"out must be a folder of a run of torchrefract {torchrefract.__version__}, got one of 0.1.9, whose draws may "
        "differ; choose another, or continue with that version"
    )
    assert (tmp_path / "out" / "scores.jsonl").read_bytes() == before
    state_versions(tmp_path / "out", torchrefract=torchrefract.__version__, torch="2.9.1")
    assert call(*words).err == (
        f"warning: out was begun with torch 2.9.1 and continues with {torch.__version__}: last digits may differ\n"
    )
    state_versions(tmp_path / "out")
    assert call(*words).err == (
        f"warning: out was begun by an unknown version of torchrefract and continues with {torchrefract.__version__}: "
        "draws may differ\n"
    )


def test_a_base_of_another_version_is_said(call, tmp_path, frames):
    assert call(*RUN, "scene=cheap_dashcam", "model=gray:shaken", "out=base").code == 0
    state_versions(tmp_path / "base", torchrefract="0.1.9", torch=torch.__version__)
    outcome = call(*RUN, "scene=cheap_dashcam", "model=gray:brightness", "out=out", "base=base")
    assert outcome.code == 0
    version = torchrefract.__version__
    assert f"warning: base was run with torchrefract 0.1.9, this is {version}: its pictures may differ\n" in outcome.err


# --- columns of the table


@pytest.mark.parametrize(
    ("model", "words", "metric"),
    [
        ("brightness", ("score=gray:darkness",), "agreement (gray:darkness)"),
        ("classes", (), "agreement (accuracy)"),
        ("pixels", (), "agreement (IoU by image)"),
        ("boxes", (), "agreement (AP50 by image)"),
        ("boxes", ("labels=labels",), "AP50 by image"),
        ("boxes", ("labels=labels", "score=gray:half"), "gray:half"),
    ],
)
def test_each_line_of_the_table_names_its_metric_seed_and_versions(
    call, results, tmp_path, frames, model, words, metric
):
    (tmp_path / "labels").mkdir()
    for path in frames.iterdir():
        (tmp_path / "labels" / f"{path.stem}.txt").write_text(f"1 {19 / 64} {19 / 36} {22 / 64} {22 / 36}\n")
    run = ("robustness.__main__", f"model=gray:{model}", "data=frames", "out=out", "seed=3", "limit=2", *words)
    run += ("scene=cheap_dashcam", "severity=[1,3]")
    for _ in range(2):  # the second run takes all scores of the first
        assert call(*run).code == 0
        with (tmp_path / "out" / "results.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        earlier = ["scene", "severity", "quantity", "value", "unit", "num_images", "score", "drop", "low", "high"]
        assert list(rows[0])[: len(earlier)] == earlier
        assert len(rows) == 2
        for row in rows:
            assert (row["metric"], row["seed"]) == (metric, "3")
            assert (row["torchrefract"], row["torch"]) == (torchrefract.__version__, torch.__version__)
        assert results()["about"]["metric"] == metric


# --- the camera and the horizon of the frames


def test_the_camera_and_the_horizon_are_those_of_each_scene(call, results, tmp_path, frames):
    picture = np.random.default_rng(0).integers(0, 255, (36, 64, 3), np.uint8)
    save_picture(frames / "0.png", (np.linspace(0.2, 1, 36)[:, None, None] * picture).astype(np.uint8))
    write_opencv(tmp_path / "my camera=1.yaml", CAMERA)
    words = (*RUN[:-1], "severity=4", "limit=1", "model=gray:brightness")
    assert call(*words, "out=out", "camera=my camera=1.yaml", "horizon=0.4").code == 0
    assert call(*words, "out=without").code == 0
    given, without = ({s: of[0] for s, _, of in scores(tmp_path / out)["0.png"]} for out in ("out", "without"))
    assert list(given) == [name for name in SCENES if name != "night_fog"]  # of frames by day
    image = read_image(frames / "0.png")
    for scene, score in given.items():
        options = {"width": 64} if scene in ("highveld_heat_haze", "unpaved_road") else {}
        effect = getattr(presets, scene)(4, camera=CAMERA, horizon=0.4, **options)
        degraded = effect.degrade(image, seed=0, keys=[key_of("0.png")])
        assert score == pytest.approx(1 - degraded.image.mean().item(), abs=1e-6), scene
    same = {scene for scene in given if given[scene] == without[scene]}
    assert same == {"cheap_dashcam"}  # a lens of its own, and no horizon
    about = results()["about"]
    assert (about["camera"]["fx"], about["camera"]["width"], about["horizon"]) == (80.0, 64, 0.4)


def test_pictures_that_a_tag_turns_are_warned_of_beside_a_camera(call, tmp_path, frames):
    write_opencv(tmp_path / "camera.yaml", CAMERA)
    save_turned(frames / "0.jpg", np.zeros((36, 64, 3), np.uint8), 3)
    words = (*RUN, "scene=cheap_dashcam", "model=gray:brightness", "limit=1")
    for out, camera in (("with", ["camera=camera.yaml"]), ("without", [])):
        outcome = call(*words, *camera, f"out={out}")
        assert outcome.code == 0, outcome.err
        assert ("(EXIF orientation, or rotation of a video): 0.jpg. They are read as" in outcome.err) == bool(camera)


def test_a_run_is_not_continued_with_another_camera_or_horizon(call, tmp_path, frames):
    words = (*RUN, "scene=cheap_dashcam", "model=gray:brightness", "camera=camera.yaml", "horizon=0.5")
    write_opencv(tmp_path / "camera.yaml", CAMERA)
    assert call(*words, "out=out").code == 0
    assert call(*words, "out=out").code == 0
    assert call(*words, "out=out", "horizon=0.4").message.endswith("got one with horizon=0.5; choose another")
    write_opencv(tmp_path / "camera.yaml", replace(CAMERA, fx=90.0))
    message = call(*words, "out=out").message
    assert message.startswith("out must be a folder of the same settings, got one with camera={'width': 64, ")
    assert "'fx': 80.0" in message
    message = call(*words, "out=o2", "base=out").message
    assert "base must be a run on the same data with the same settings, got one with camera={" in message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("camera=lost.yaml",), "camera must name what exists, got lost.yaml: No such file"),
        (("camera=gray.py",), "camera: path must hold a camera of OpenCV"),
        (("horizon=up",), "horizon must be a real number, got 'up'"),
        (("horizon=540",), "horizon must be a number in [-10, 10], got 540"),
        (
            ("camera=large.yaml",),
            "camera must be that of all frames, got 0.png: image must have the shape of the camera's frames, "
            "100 x 30 px, got 64 x 36",
        ),
    ],
)
def test_an_invalid_camera_or_horizon_is_one_line(call, tmp_path, frames, words, message):
    write_opencv(tmp_path / "large.yaml", replace(CAMERA, width=100, height=30, cx=49.5, cy=14.5))
    error = call(*RUN, "scene=cheap_dashcam", "model=gray:brightness", "out=out", *words).message
    assert error.startswith(message)


# --- batches and the device


def test_batches_of_a_picture_give_the_scores_of_single_ones(call, tmp_path, frames):
    (tmp_path / "batches.py").write_text(
        "import torch, gray\nsizes = []\n\ndef pixels(images):\n    sizes.append(len(images))\n"
        "    return gray.pixels(images)\n\ndef one(images):\n    return gray.pixels(images)[:1]\n"
    )
    words = ("robustness.__main__", "data=frames", "scene=[cape_town_fog,cheap_dashcam]", "severity=[1,5]")
    words += ("model=batches:pixels", "device=cpu", "limit=2")
    for i, search in enumerate(((), ("worst_case=true", "worst_case_draws=2"))):
        single, batch = f"out=single{i}", f"out=batch{i}"
        assert call(*words, single, *search).code == 0
        sys.modules["batches"].sizes.clear()
        assert call(*words, batch, "batch_size=3", *search).code == 0
        sizes = [1, 3, 3, 2] if search else [1, 3, 1]  # of the clean picture, and of degraded versions
        assert sys.modules["batches"].sizes[: 2 * len(sizes)] == 2 * sizes
        files = [tmp_path / out.removeprefix("out=") / "scores.jsonl" for out in (single, batch)]
        assert files[0].read_bytes() == files[1].read_bytes()
    *_, message = call(*words[:4], "model=batches:one", "out=one", "batch_size=4").err.splitlines()
    assert message == (
        "error: predict must return a sequence of 4 predictions for as many images, got Tensor of 1; return a list, or "
        "a tensor (4, ...); or set batch_size=1"
    )
    assert call(*words, "out=none", "batch_size=0").message.startswith("batch_size must be at least 1")


# --- the worst pictures of a segmenter


def test_the_report_draws_the_classes_of_the_clean_and_the_degraded_picture_side_by_side(call, tmp_path, frames):
    for path in frames.iterdir():
        path.unlink()
    clean = np.full((200, 400, 3), 40, np.uint8)
    clean[:, 200:] = 140
    clean[:, :100] = 250
    save_picture(frames / "0.png", clean)
    words = ("robustness.__main__", "data=frames", "model=gray:pixels", "out=out", "severity=5", "worst=1")
    assert call(*words, "scene=cape_town_fog").code == 0
    page = (tmp_path / "out" / "report.html").read_text()
    (figure,) = re.findall(r"<figure>(.*?)</figure>", page)
    pictures = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(of)))) for of in re.findall(r"base64,([^\"]+)", figure)
    ]
    first, second = (255 * np.array(colormaps["tab20"](i)[:3]) for i in (0, 2))
    effect = presets.cape_town_fog(5)
    image = read_image(frames / "0.png")
    degraded = effect.degrade(image, seed=0, keys=[key_of("0.png")]).image
    for picture, plain in zip(pictures, (image, degraded), strict=True):
        bright = (plain[0] > 0.7)[..., None].numpy()
        expected = 127.5 * plain.movedim(0, -1).numpy() + 0.5 * np.where(bright, second, first)
        assert picture.shape == expected.shape
        assert np.median(abs(picture - expected)) < 3
    assert not np.array_equal((image[0] > 0.7).numpy(), (degraded[0] > 0.7).numpy())
    colors = ["rgb" + str(tuple(round(value) for value in color)) for color in (first, second)]
    legend = " ".join(f'<span class="class" style="background: {of}"></span>{i}' for i, of in enumerate(colors))
    assert legend in figure
    assert "Colors are the predicted classes, for the clean image and for the degraded one." in page
