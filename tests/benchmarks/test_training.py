import json
import sys

import timing
import torch
import training

from torchrefract import UniformFog
from torchrefract.restoration.tasks import Deweather
from torchrefract.types import Frame

SMALL = "tu-mobilenetv3_small_050"


def test_a_step_changes_the_weights_and_draws_new_pairs_on_the_fly(monkeypatch):
    frames = Frame(torch.rand(2, 3, 64, 64), torch.arange(2), torch.empty(0))
    seeds, make = [], training.make_pair

    def make_pair(frames, scene, *, seed):
        seeds.append(seed)
        return make(frames, scene, seed=seed)

    monkeypatch.setattr(training, "make_pair", make_pair)
    torch.manual_seed(0)
    steps = training.training_steps(frames, Deweather(), UniformFog(), encoder=SMALL)
    losses = [torch.as_tensor(steps[training.BEFORE]()).item() for _ in range(2)]
    assert losses[0] != losses[1]  # the weights have changed
    for _ in range(2):
        steps[training.FLY]()
    assert seeds == [training.SEED, 0, 1]


def test_the_command_prints_and_saves_both_limits(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(training, "effects", lambda: {"fog": UniformFog()})
    out = tmp_path / "training.json"
    words = ["--batch", "2", "--size", "64x64", "--threads", "1", "--rounds", "1", "--encoder", SMALL]
    monkeypatch.setattr(sys, "argv", ["training.py", *words, "--out", str(out)])
    training.main()
    assert "undistort, cheap_dashcam: " in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert [row["name"] for row in content["timings"]] == [training.BARE, "fog"]
    assert [bar["name"] for bar in content["bars"]] == ["fog", *training.TASKS]
    for steps in content["steps"].values():
        assert [row["name"] for row in steps] == [training.BEFORE, training.FLY]
