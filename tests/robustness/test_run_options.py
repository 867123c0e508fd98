import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchrefract import Camera, key_of, presets
from torchrefract.cameras.io import write_opencv
from torchrefract.data.images import read_image
from torchrefract.robustness.quantities import QUANTITIES

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

def classes(images):
    return torch.tensor([[0.0, 1.0]])

def pixels(images):
    return torch.stack([1 - images[:, 0], images[:, 0] - 0.4], dim=1)

def boxes(images):
    return [{"boxes": torch.tensor([[8.0, 8, 30, 30]]), "labels": torch.ones(1).long(), "scores": torch.ones(1)}]
"""
RUN = ("robustness.__main__", "data=frames", "score=bright:darkness", "severity=[1,5]")
FOG = "scene=[cape_town_fog,cheap_dashcam]"
CAMERA = Camera(width=64, height=36, fx=80.0, fy=80.0, cx=31.5, cy=17.5, coefficients=(0.0,) * 5)


@pytest.fixture
def frames(tmp_path, monkeypatch) -> Path:
    """Write four gray pictures and a white one, and models; the error of `brightness` is the mean of its picture."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for i, level in enumerate((0, 40, 80, 120, 255)):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((36, 64, 3), level, np.uint8))
    (tmp_path / "bright.py").write_text(MODEL)
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def results(out: Path) -> dict:
    return json.loads((out / "results.json").read_text())


def scores(out: Path) -> dict[str, list]:
    """Return the scores of a run: for each picture, scene, severity, and score first of the next list."""
    return {row["name"]: row["levels"] for row in map(json.loads, (out / "scores.jsonl").read_text().splitlines()[1:])}


# --- beside a base run


def test_a_run_beside_a_base_states_its_corruption_errors_and_the_pictures_left_out(call, tmp_path, frames):
    assert call(*RUN, FOG, "model=bright:shaken", "out=base").code == 0
    (frames / "0.png").unlink()
    outcome = call(*RUN, FOG, "model=bright:brightness", "out=out", "base=base")
    assert outcome.code == 0, outcome.err
    errors = {
        (out, scene): np.mean(
            [1 - of[0] for n in "123" for s, _, of in scores(tmp_path / out)[f"{n}.png"] if s == scene]
        )
        for out in ("out", "base")
        for scene in ("cape_town_fog", "cheap_dashcam")
    }
    expected = {
        scene: errors["out", scene] / errors["base", scene] for scene in dict.fromkeys(scene for _, scene in errors)
    }
    of_both = results(tmp_path / "out")["corruption_error"]
    assert of_both["scenes"] == pytest.approx(expected, rel=1e-6)
    assert of_both["scenes"] == pytest.approx({scene: 2.0 for scene in expected}, rel=1e-4)  # half of the error
    assert of_both["mean"] == pytest.approx(np.mean(list(expected.values())))
    assert (of_both["num_images"], of_both["left_out"], of_both["left_out_of_base"]) == (3, 1, 1)
    assert (of_both["base"], of_both["model"]) == ("base", "bright:shaken")
    assert (
        "mCE 2.000 beside bright:shaken, on the 3 pictures of both runs; left out: 1 of this one and 1 of base\n"
        in (outcome.out)
    )
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<td>cape_town_fog</td><td>2.000</td>" in page
    assert "<td>mCE</td><td>2.000</td>" in page
    assert "on the 3 images of both runs; 1 of this one and 1 of the base are left out" in page
    without = (tmp_path / "out" / "scores.jsonl").read_bytes()
    assert call(*RUN, FOG, "model=bright:brightness", "out=out").code == 0  # continues
    assert (tmp_path / "out" / "scores.jsonl").read_bytes() == without
    assert "corruption_error" not in results(tmp_path / "out")
    assert "mCE" not in (tmp_path / "out" / "report.html").read_text()


def test_a_base_without_an_error_gives_no_number_and_says_so(call, tmp_path, frames):
    assert call(*RUN, "scene=cape_town_fog", "model=bright:blind", "out=base").code == 0
    outcome = call(*RUN, "scene=cape_town_fog", "model=bright:brightness", "out=out", "base=base")
    of_both = results(tmp_path / "out")["corruption_error"]
    assert of_both["scenes"] == {"cape_town_fog": None}
    assert of_both["mean"] is None
    assert "warning: there is no mCE, as the base makes no error in cape_town_fog\n" in outcome.err
    assert "nan" not in outcome.out


def test_a_base_without_labels_is_said_to_state_another_number(call, frames):
    words = ("scene=cheap_dashcam", "model=bright:brightness", "base=base")
    assert call(*RUN, *words[:2], "out=base").code == 0
    warning = "warning: without labels, each error is the disagreement of a model with its own clean predictions"
    assert warning in call(*RUN, *words, "out=out").err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("seed=1",), "got one with seed=0; "),
        (("severity=[1,4]",), "got one with severity=[1, 5]; "),
        (("scene=cheap_dashcam",), "got one with scene=['cape_town_fog', 'cheap_dashcam']; "),
        (("data=others",), "/frames; "),
        (("score=bright:lightness",), "got one with score=bright:darkness; "),
        (("horizon=0.4",), "got one with horizon=None; "),
        (("base=nowhere",), "base must be a folder of an earlier run, got nowhere, which has no scores.jsonl"),
        (("limit=1",), "base must have scores of the same images, got none of 0.png"),
    ],
)
def test_a_base_of_other_settings_is_one_line_before_the_first_prediction(call, tmp_path, frames, words, message):
    (tmp_path / "others").mkdir()
    for path in frames.iterdir():
        (tmp_path / "others" / path.name).write_bytes(path.read_bytes())
    with (tmp_path / "bright.py").open("a") as file:
        file.write("\n\ndef lightness(prediction, target):\n    raise AssertionError\n")
    assert call(*RUN, FOG, "model=bright:shaken", "out=base").code == 0
    lines = (tmp_path / "base" / "scores.jsonl").read_text().splitlines(keepends=True)
    if "limit=1" in words:
        (tmp_path / "base" / "scores.jsonl").write_text("".join(line for line in lines if '"0.png"' not in line))
    error = call(*RUN, FOG, "model=bright:brightness", "out=out", "base=base", *words).message
    assert message in error
    assert not (tmp_path / "out").exists()
    if "got one with" in message:
        assert error.startswith("base must be a run on the same data with the same settings, got one with ")
        assert error.endswith("; score that model again with the options of this run")


def test_a_base_whose_pictures_had_other_draws_is_one_line_and_no_table(call, tmp_path, frames):
    assert call(*RUN, "scene=cape_town_fog", "model=bright:shaken", "out=base").code == 0
    path = tmp_path / "base" / "scores.jsonl"
    settings, *rows = map(json.loads, path.read_text().splitlines())
    for row in rows:  # as of a version that draws other fogs
        row["levels"] = [[*level, [score, 7000.0, *rest]] for *level, (score, _, *rest) in row["levels"]]
    path.write_text("".join(json.dumps(row) + "\n" for row in [settings, *rows]))
    outcome = call(*RUN, "scene=cape_town_fog", "model=bright:brightness", "out=out", "base=base")
    *_, error = outcome.err.splitlines()
    assert error.startswith("error: base: base must be of the same draws, by the same seed and version, got a visib")
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name[0] != "."] == ["scores.jsonl"]
