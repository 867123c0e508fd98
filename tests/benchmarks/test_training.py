import json
import sys

import pytest
import slow_timing
import timing
import torch
import training
from slow_timing import alternate
from timing import Spread
from torch.testing import assert_close

from torchrefract import LensFlare, UniformFog
from torchrefract.restoration.tasks import Deweather
from torchrefract.types import Frame

SMALL = "tu-mobilenetv3_small_050"


def test_candidates_return_the_gradient_of_the_image():
    frames = torch.rand(2, 3, 16, 24)
    # Thin fog and added light pass the gradient on unchanged.
    fog = UniformFog(visibility_range=(1e6, 1e6), deviation_range=(0.0, 0.0))
    torch.manual_seed(3)
    candidates = training.candidates(frames, {"clear": fog, "flare": LensFlare(clip=False)})
    torch.manual_seed(3)
    upstream = torch.rand_like(frames)
    assert list(candidates) == [training.BARE, "clear", "flare"]
    clear, flare = (torch.as_tensor(candidates[name]()) for name in ("clear", "flare"))
    assert_close(clear, upstream, atol=1e-3, rtol=0)
    assert_close(flare, upstream)


def test_a_step_changes_the_weights_and_draws_new_pairs_on_the_fly(monkeypatch):
    frames = Frame(torch.rand(2, 3, 64, 64), torch.arange(2), torch.empty(0))
    seeds = []
    make = training.make_pair

    def make_pair(frames, scene, *, seed):
        seeds.append(seed)
        return make(frames, scene, seed=seed)

    monkeypatch.setattr(training, "make_pair", make_pair)
    torch.manual_seed(0)
    steps = training.training_steps(frames, Deweather(), UniformFog(), encoder=SMALL)
    before, fly = steps[training.BEFORE], steps[training.FLY]
    losses = [torch.as_tensor(before()).item() for _ in range(3)]
    assert len(set(losses)) == 3  # the weights have changed
    assert seeds == [training.SEED]
    for _ in range(2):
        fly()
    assert seeds == [training.SEED, 0, 1]


def test_slow_candidates_alternate(monkeypatch):
    now, calls = [0.0], []

    def candidate(name: str, length: float):
        def call() -> None:
            calls.append(name)
            now[0] += length * len(calls)  # slower and slower

        return call

    monkeypatch.setattr(slow_timing.benchmark, "timer", lambda: now[0])
    one, two = alternate({"one": candidate("one", 1.0), "two": candidate("two", 2.0)}, reference="one", rounds=3)
    assert calls == ["one", "two"] * 4
    # Calls number 3, 5, 7 and 4, 6, 8 are timed.
    assert one.milliseconds == Spread(5e3, 3e3, 7e3)
    assert two.milliseconds == Spread(12e3, 8e3, 16e3)
    assert two.ratios["one"].median == pytest.approx(12 / 5)


def test_the_command_prints_and_saves_both_limits(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(training, "effects", lambda: {"fog": UniformFog()})
    out = tmp_path / "new" / "training.json"
    words = ["--batch", "2", "--size", "64x64", "--threads", "1", "--rounds", "1", "--encoder", SMALL]
    monkeypatch.setattr(sys, "argv", ["training.py", *words, "--out", str(out)])
    training.main()
    assert "undistort, cheap_dashcam: " in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert [row["name"] for row in content["timings"]] == [training.BARE, "fog"]
    assert [bar["name"] for bar in content["bars"]] == ["fog", *training.TASKS]
    for steps in content["steps"].values():
        assert [row["name"] for row in steps] == [training.BEFORE, training.FLY]
