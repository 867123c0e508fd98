import argparse
import math
from pathlib import Path
from typing import Any

import cv2
import pytest
import table1
import torch
from restoration_scores import MIX, Scores, constant_flow, corrupted, effects_of, mean_of, references, score
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import LensDistortion, UniformFog
from torchrefract.data.frames import FrameFolder
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.loading import Loaded, load_model
from torchrefract.restoration.tasks import Restored, Undistort
from torchrefract.types import Frame, Pair

SIZE = (48, 80)
PLAIN: dict[str, Any] = {"device": torch.device("cpu"), "apart": ["drive2"]}


def frames(count: int = 3) -> list[Frame]:
    keys = torch.arange(count)
    image, _ = render_road_scenes(keys, *SIZE, seed=2)
    return [Frame(image, keys, torch.empty(0))]


def still(pair: Pair) -> Restored:
    return Restored(pair.degraded, torch.zeros_like(pair.flow))


def test_doing_nothing_is_off_by_the_flow_itself_and_the_true_flow_by_nothing():
    lens = LensDistortion(k1_range=(-0.3, -0.2))
    pairs = corrupted(frames(), lens)
    found = {name: mean_of(each) for name, each in references("undistort", lens, frames(), pairs).items()}
    (pair,) = pairs
    # In px of 1920 x 1080, on valid pixels, the mean of the frames.
    length = (pair.flow * torch.tensor([1920 / 80, 1080 / 48]).view(1, 2, 1, 1)).norm(dim=1, keepdim=True)
    expected = torch.stack([own[valid].mean() for own, valid in zip(length, pair.valid, strict=True)]).mean()
    assert found["do nothing"].epe == pytest.approx(expected.item(), rel=1e-5)
    assert found["the true flow"].epe == 0
    assert found["the true flow"].psnr > found["best constant flow"].psnr > found["do nothing"].psnr


def test_the_constant_flow_is_the_mean_of_many_others():
    still: dict[str, Any] = {f"{name}_range": (0.0, 0.0) for name in ("center_x", "center_y", "p1", "p2", "k2", "k3")}
    lens = LensDistortion(k1_range=(-0.25, -0.25), focal_range=(1.0, 1.0), aspect_range=(1.0, 1.0), **still)
    (pair,) = corrupted(frames(1), lens)
    seen = pair.valid.expand(1, 2, -1, -1)
    assert_close(constant_flow(lens, pair.clean)[seen], pair.flow[seen], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["uniform fog", "heterogeneous fog", "lens flare"])
def test_the_true_map_undoes_weather_as_far_as_eight_bits_allow(name):
    effect, in_mix = effects_of("deweather", SIZE[1])[name]
    assert in_mix
    every = references("deweather", effect, frames(), corrupted(frames(), effect))
    found = {name: mean_of(each) for name, each in every.items()}
    assert found["the true map"].psnr > found["do nothing"].psnr + 4
    assert math.isnan(found["the true map"].epe)


def test_losses_are_those_that_the_networks_learn_by():
    lens = LensDistortion(k1_range=(-0.3, -0.2))
    pairs = corrupted(frames(), lens)
    (pair,) = pairs
    flow = torch.full_like(pair.flow, 2.0)
    found = mean_of(score([Restored(pair.degraded, flow)], pairs))
    image, halves = [], []
    for i in range(3):
        where = pair.valid[i, 0]
        image.append((pair.degraded[i] - pair.clean[i])[:, where].abs().mean())
        halves.append(((2.0 - pair.flow[i])[:, where].abs() / torch.tensor([[40.0], [24.0]])).mean())
    assert found.image_loss == pytest.approx(torch.stack(image).mean().item(), rel=1e-5)
    assert found.flow_loss == pytest.approx(torch.stack(halves).mean().item(), rel=1e-5)
    assert found.loss == pytest.approx(found.image_loss + found.flow_loss, rel=1e-6)


def test_the_mix_is_the_mean_of_its_effects_for_all_frames_and_for_each_kind():
    of = table1.Line("deweather", "", "", "a method", Scores(*[math.nan] * 6), 0, SIZE)
    effects = effects_of("deweather", SIZE[1])
    # Each frame's score is a power of two: a sum tells which frames are in it.
    each = {name: 2.0 ** torch.arange(4).double()[:, None].expand(4, 6) * (1 + i) for i, name in enumerate(effects)}
    groups = {"all": {7, 8, 9, 11}, "br_*": {8, 11}, "others": {7, 9}}
    lines = list(table1._lines(of, each, [7, 8, 9, 11], groups))
    mix = {line.which: (line.scores.psnr, line.frames) for line in lines if line.effect == MIX}
    assert mix == {"all": (2 * 15 / 4, 4), "br_*": (2 * (2 + 8) / 2, 2), "others": (2 * (1 + 4) / 2, 2)}
    own = {line.effect: line.scores.psnr for line in lines if line.effect != MIX}
    assert own == {name: (1 + i) * 15 / 4 for i, name in enumerate(effects)}


def test_frames_are_taken_evenly():
    assert table1._evenly(10, 0) == list(range(10))
    assert table1._evenly(10, 3) == [0, 3, 6]
    assert table1._evenly(2, 5) == [0, 1]
    lens = LensDistortion(k1_range=(-0.3, -0.2))
    pairs = [pair for some in (frames(3), frames(2)) for pair in corrupted(some, lens)]
    (thin,) = table1._thinned(pairs, 3)
    assert thin.key.tolist() == [0, 1, 0]  # of 0 1 2 0 1
    assert_close(thin.degraded, torch.stack([pairs[0].degraded[0], pairs[0].degraded[1], pairs[1].degraded[0]]))


def folder(tmp_path: Path) -> Path:
    image, _ = render_road_scenes(torch.arange(4), *SIZE, seed=2)
    for i, picture in enumerate(image):
        path = tmp_path / "frames" / ("train" if i < 2 else "val") / f"drive{i}_{i:04d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), (255 * picture).byte().permute(1, 2, 0).numpy()[..., ::-1])
    return tmp_path / "frames"


def test_what_is_trained_is_loaded_and_the_page_tells_all(tmp_path, known_model):
    out, made = tmp_path / "out", known_model("undistort", (0.0, 0.0), size=SIZE)
    run = out / "resunet_undistort_0"
    run.mkdir(parents=True)
    (run / "best.ckpt").write_bytes(made.read_bytes())
    (run / "curves.png").write_bytes(b"")
    args = argparse.Namespace(source=folder(tmp_path), out=out, frames=0, form="small", steps=[2], sampled=1, **PLAIN)
    path = table1.trained("resunet_undistort", args)
    assert path == run / "best.ckpt"
    lines = list(table1.scored("undistort", {"resunet_undistort": load_model(path)}, args))
    found = {(line.method, line.effect): line.scores for line in lines if line.which == "all"}
    model = next(line.method for line in lines if line.method.startswith("ResUNet"))
    # A network that answers 0 does nothing.
    for effect in (*effects_of("undistort", SIZE[1]), MIX):
        assert found[model, effect].epe == pytest.approx(found["do nothing", effect].epe, rel=1e-4), effect
    text = table1.page(lines)
    assert "### undistort: wide lens" in text
    assert "| paper: SegFormer, on its own frames |  |  |  | 16.29 |  | 69.82 |" in text
    assert text.count("best constant flow") == 8
    assert "### undistort: all of the paper's, frames drive2*" in text
    assert {line.which: line.frames for line in lines} == {"all": 2, "drive2*": 1, "others": 1}


def test_a_diffusion_model_is_compared_with_doing_nothing_to_the_same_frames(tmp_path):
    class Quiet(nn.Module):
        def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
            return torch.zeros_like(noisy)

    args = argparse.Namespace(source=folder(tmp_path), frames=0, steps=[1], sampled=1, **PLAIN)
    model = Diffusion(lambda _: Quiet(), Undistort(0.1))
    loaded = Loaded(model, "Quiet", "undistort", SIZE, {})
    lines = list(table1.scored("undistort", {"ddpm_undistort": loaded}, args))
    found = {(line.method, line.effect): line for line in lines if line.which == "all"}
    every, one, own = (
        found[name, "wide lens"] for name in ("do nothing", "do nothing, frames of DDPM", "DDPM, 1 steps")
    )
    assert (every.frames, one.frames, own.frames) == (2, 1, 1)
    assert one.scores.epe != pytest.approx(every.scores.epe, rel=1e-3)
    held_out = FrameFolder(args.source, size=SIZE, split="val")
    first = [Frame(*(value[None] for value in held_out[0]))]
    (alone,) = corrupted(first, effects_of("undistort", SIZE[1])["wide lens"][0])
    assert one.scores.epe == pytest.approx(mean_of(score([still(alone)], [alone])).epe, rel=1e-6)
    part = table1.page(lines).partition("### undistort: wide lens\n")[2].partition("###")[0]
    (row,) = (line.split(" | ") for line in part.splitlines() if line.startswith("| DDPM"))
    assert float(row[7]) == pytest.approx(own.scores.epe / one.scores.epe, abs=0.006)


def test_a_stopped_training_goes_on_and_what_is_not_there_is_trained(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(table1.subprocess, "run", lambda words, check: asked.append(words))
    args = argparse.Namespace(source=Path("frames"), out=tmp_path, form="small")
    assert table1.trained("ddpm_deweather", args) == tmp_path / "ddpm_deweather_0" / "best.ckpt"
    (tmp_path / "ddpm_deweather_0").mkdir()
    (tmp_path / "ddpm_deweather_0" / "last.ckpt").touch()
    assert table1.trained("ddpm_deweather", args) == tmp_path / "ddpm_deweather_1" / "best.ckpt"
    first, second = asked
    assert "+experiment=table1_ddpm_deweather_small" in first
    assert not any(word.startswith("ckpt_path=") for word in first)
    assert f"ckpt_path={tmp_path / 'ddpm_deweather_0' / 'last.ckpt'}" in second


def test_fog_has_no_flow_and_its_cells_are_empty():
    found = references("deweather", UniformFog(), frames(), corrupted(frames(), UniformFog()))
    scores = mean_of(found["do nothing"])
    cells = table1._cells(table1.Line("deweather", "uniform fog", "all", "do nothing", scores, 3, SIZE), scores)
    assert cells[3] == cells[6] == cells[7] == ""
