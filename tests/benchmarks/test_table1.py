import argparse
import math
from pathlib import Path
from typing import Any

import pytest
import table1
import torch
from pictures import save_picture
from table1 import MIX, Scores, effects_of

from torchrefract import Frame, LensDistortion, Pair
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.restoration.checkpoints import load_model
from torchrefract.restoration.tasks import Restored

SIZE = (48, 80)
OPTIONS: dict[str, Any] = {"device": torch.device("cpu"), "groups": ["drive2"], "frames": 0, "sampled": 1}


def test_the_mix_is_the_mean_of_its_effects_for_all_frames_and_for_each_group():
    line = table1.Line("deweather", "", "", "a method", Scores(*[math.nan] * 6), 0, SIZE)
    # The score of each frame is another power of two, so a sum identifies its frames.
    powers = 2.0 ** torch.arange(4).double()[:, None].expand(4, 6)
    by_effect = {name: powers * (1 + i) for i, name in enumerate(effects_of("deweather", SIZE[1]))}
    groups = {"all": {7, 8, 9, 11}, "br_*": {8, 11}, "others": {7, 9}}
    lines = list(table1._lines(line, by_effect, [7, 8, 9, 11], groups))
    mix = {line.group: (line.scores.psnr, line.frames) for line in lines if line.effect == MIX}
    assert mix == {"all": (2 * 15 / 4, 4), "br_*": (2 * (2 + 8) / 2, 2), "others": (2 * (1 + 4) / 2, 2)}
    effects = {line.effect: line.scores.psnr for line in lines if line.effect != MIX}
    assert effects == {name: (1 + i) * 15 / 4 for i, name in enumerate(by_effect)}


def test_lenses_fill_their_frames_but_in_the_tables_that_name_a_border():
    lenses = {
        n: effect for n, (effect, _) in effects_of("undistort", SIZE[1]).items() if isinstance(effect, LensDistortion)
    }
    assert {lens.frame for lens in lenses.values()} == {"fill"}
    names = ["cheap_dashcam lens, black border", "cheap_dashcam lens, mirrored border"]
    assert [*lenses] == ["cheap_dashcam lens", "wide lens", *names]
    frame = Frame(torch.ones(2, 3, *SIZE), torch.arange(2), torch.empty(0))
    plain, black, mirrored = (table1.corrupt([frame], lenses[n], n)[0] for n in ("cheap_dashcam lens", *names))
    assert plain.degraded.min() > 0.99
    assert mirrored.degraded.min() > 0.99
    assert 0.02 < (black.degraded == 0).float().mean() < 0.4


def test_scores_are_those_of_the_task_with_nan_for_a_missing_map():
    clean, flow = torch.full((2, 3, 8, 16), 0.5), torch.zeros(2, 2, 8, 16)
    pair = Pair(clean + 0.25, clean, flow, torch.ones(2, 1, 8, 16, dtype=torch.bool), torch.arange(2))
    moved = Restored(clean + 0.1, torch.tensor([2.0, -1.0]).view(1, 2, 1, 1).expand(2, -1, 8, 16))
    # 2 of 8 px and 1 of 4 px, halves of the frame, and 20 dB; 240 px and 135 px of 1920x1080.
    scores = table1.score("undistort", [moved], [pair])[0].tolist()
    assert scores[:4] + scores[5:] == pytest.approx([0.35, 0.1, 0.25, 20.0, math.hypot(240, 135)], rel=1e-4)
    scores = table1.score("deweather", [Restored(clean + 0.1)], [pair])[0].tolist()
    assert scores[:2] == pytest.approx([0.1, 0.1], rel=1e-4)
    assert math.isnan(scores[2])
    assert math.isnan(scores[5])


def write_frames(tmp_path: Path) -> Path:
    image, _ = render_road_scenes(torch.arange(4), *SIZE, seed=2)
    for i, picture in enumerate(image):
        path = tmp_path / "frames" / ("train" if i < 2 else "val") / f"drive{i}_{i:04d}.png"
        save_picture(path, (255 * picture).byte().permute(1, 2, 0).numpy())
    return tmp_path / "frames"


def test_a_finished_training_is_loaded_and_the_tables_hold_all_methods(tmp_path, known_model):
    run = tmp_path / "out" / "resunet_undistort_0"
    run.mkdir(parents=True)
    (run / "best.ckpt").write_bytes(known_model("undistort", (0.0, 0.0), size=SIZE).read_bytes())
    (run / "curves.png").write_bytes(b"")
    args = argparse.Namespace(source=write_frames(tmp_path), out=run.parent, scale="small", steps=[2], **OPTIONS)
    path = table1.train("resunet_undistort", args)
    assert path == run / "best.ckpt"
    lines = list(table1.score_task("undistort", {"resunet_undistort": load_model(path)}, args))
    scores = {(line.method, line.effect): line.scores for line in lines if line.group == "all"}
    model = next(line.method for line in lines if line.method.startswith("ResUNet"))
    # This network predicts 0.
    for effect in (*effects_of("undistort", SIZE[1]), MIX):
        assert scores[model, effect].epe == pytest.approx(scores["do nothing", effect].epe, rel=1e-4), effect
    text = table1.format_tables(lines)
    assert "### undistort: wide lens" in text
    assert "| paper: SegFormer, on its own frames | 0.146 | 0.085 | 0.055 | 16.29 |  | 69.82 |" in text
    assert text.count("best constant flow") == 10
    assert "### undistort: all of the paper's, frames drive2*" in text
    assert {line.group: line.frames for line in lines} == {"all": 2, "drive2*": 1, "others": 1}


@pytest.mark.quick
def test_a_stopped_training_is_resumed_and_a_missing_one_is_started(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(table1.subprocess, "run", lambda words, check: commands.append(words))
    args = argparse.Namespace(source=Path("frames"), out=tmp_path, scale="small", options=["trainer.max_epochs=1"])
    monkeypatch.setattr(table1, "commit", lambda: "abc")
    assert table1.train("ddpm_deweather", args) == tmp_path / "ddpm_deweather_0" / "best.ckpt"
    (tmp_path / "ddpm_deweather_0").mkdir()
    (tmp_path / "ddpm_deweather_0" / "last.ckpt").touch()
    assert table1.train("ddpm_deweather", args) == tmp_path / "ddpm_deweather_1" / "best.ckpt"
    first, second = commands
    assert {"+experiment=table1_ddpm_deweather", "scale=small", "trainer.max_epochs=1"} < {*first} & {*second}
    assert not any(word.startswith("ckpt_path=") for word in first)
    assert f"ckpt_path={tmp_path / 'ddpm_deweather_0' / 'last.ckpt'}" in second
    assert table1.describe_commits(["ddpm_deweather"], tmp_path) == "trained at commit abc, scored at abc"
    assert table1.describe_commits(["resunet_deweather"], tmp_path) == "trained at commit unknown, scored at abc"
