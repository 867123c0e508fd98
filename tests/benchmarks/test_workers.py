import json
import sys

import pytest
import timing
import torch
import workers
from timing import GRID_SAMPLE, Spread, Timing
from torch.utils.data import Dataset

from torchrefract import LensFlare, UniformFog


class Numbered(Dataset[int]):
    """The numbers from 0 on."""

    def __len__(self) -> int:
        return 100

    def __getitem__(self, index: int) -> int:
        return index


def test_frames_are_counted_from_the_first_on(monkeypatch):
    clock = iter(range(0, 10_000, 2))  # 2 s at each look
    monkeypatch.setattr(workers.benchmark, "timer", lambda: float(next(clock)))
    monkeypatch.setattr(workers, "loader", lambda frames: range(100))
    # Looks from the third frame on: 2 s after the start, then 4, 6, 8, 10; one more at the end.
    assert workers.rate(Numbered(), seconds=10.0) == pytest.approx(7 / 12)
    assert workers.rate(Numbered(), seconds=0.0) == pytest.approx(3 / 4)


def test_the_worker_has_one_thread_and_does_the_timing(monkeypatch):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    measured = workers.Measured({"fog": UniformFog()}, torch.rand(1, 3, 24, 32), 15)
    ((timings, notes, conditions),) = workers.loader(measured)
    assert conditions.threads == 1
    assert [t.name for t in timings] == [GRID_SAMPLE, timing.COPY, "fog"]
    assert notes == []


class Inverse:
    """A transform as albumentations has them."""

    def __call__(self, image):
        return {"image": 255 - image}


def test_both_degrade_the_same_frame():
    pixels = torch.randint(0, 256, (3, 24, 32), dtype=torch.uint8)
    found = workers.datasets({"flare": LensFlare(strength_range=(0.0, 0.0))}, {"flare: theirs": Inverse()}, pixels)
    ours, theirs = (next(iter(workers.loader(frames))) for frames in found.values())
    assert list(found) == ["ours: flare", "flare: theirs"]
    assert torch.equal(ours, pixels)
    assert torch.equal(theirs.movedim(-1, 0), 255 - pixels)


def test_the_bar_is_for_the_effects_that_are_named():
    timings = [
        Timing(name, 1, Spread(1, 1, 1), {GRID_SAMPLE: Spread(ratio, ratio, ratio)})
        for name, ratio in ((GRID_SAMPLE, 1.0), ("fog", 1.25), ("lens", 1.26), ("lens, exact", 15.0))
    ]
    fog, lens = workers.bars(timings, ["fog", "lens"])
    assert (fog.holds, lens.holds) == (True, False)


def test_the_command_counts_frames_per_second(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(workers, "effects", lambda: {"fog": UniformFog()})
    monkeypatch.setattr(workers, "WARPS", {})
    monkeypatch.setattr(workers, "find_packages", lambda: ({}, ["albumentations is left out (not here)"]))
    out = tmp_path / "new" / "workers.json"
    monkeypatch.setattr(sys, "argv", ["workers.py", "--size", "24x32", "--seconds", "0", "--out", str(out)])
    workers.main()
    assert "albumentations is left out (not here)" in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert list(content["frames_per_second"]) == ["ours: fog"]
    assert content["frames_per_second"]["ours: fog"] > 0
    assert content["conditions"]["threads"] == 1
