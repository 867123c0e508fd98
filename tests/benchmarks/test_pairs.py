import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pairs
import pytest
import torch
from pictures import save_picture

from torchrefract import UniformFog


@pytest.fixture
def args(tmp_path, monkeypatch) -> Namespace:
    """Options for four images of two drives."""
    generator = np.random.default_rng(0)
    for number in range(4):
        path = tmp_path / "frames" / f"drive{number % 2}" / f"{number}.png"
        save_picture(path, generator.integers(0, 256, (24, 40, 3), np.uint8))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    return Namespace(source=tmp_path / "frames", scene="paper_refractive", size=(24, 40), maps="png", count=4)


def test_the_peak_memory_is_what_a_call_holds_at_once():
    x = torch.zeros(64, 1024)
    for call, tensors in ((x.clone, 1), (lambda: (x + 1) * 2, 2), (lambda: (x + 1) + (x + 2), 3)):
        assert pairs.peak_bytes(call) == pytest.approx(tensors * x.nbytes, rel=1e-3)


def test_engines_are_compared_by_the_time_of_3000_pairs_in_each_round():
    costs = {"local": [(10.0, 4.0, 30.0, 20.0), (20.0, 4.0, 40.0, 20.0)], "ray": [(40.0, 8.0, 20.0, 24.0)] * 2}
    runs = [pairs.Run(engine, 2, 1.0, 1.0, 0, 0.0, *costs[engine][i]) for i in range(2) for engine in costs]
    local, ray = pairs.compare_engines(runs)
    assert (local["engine"], local["seconds"], local["core_seconds"], local["speed"]) == ("local", 120.0, 64.0, 1.0)
    assert (ray["engine"], ray["seconds"], ray["core_seconds"]) == ("ray", 100.0, 80.0)
    assert ray["speed"] == (100 / 100 + 140 / 100) / 2
    assert ray["speed_by_core_seconds"] == 64 / 80


def test_the_command_writes_all_measurements(args, tmp_path, monkeypatch, run_program):
    monkeypatch.setattr(pairs, "make_effects", lambda: {"fog": UniformFog()})
    monkeypatch.setattr(
        pairs, "measure_run", lambda *_: pairs.Run("local", 1, 2.0, 1.0, 10, 20.0, 5.0, 4.0, 50.0, 40.0)
    )
    monkeypatch.setattr(pairs, "measure_one_pair", lambda _: {"generated": 2.0, "read_and_encode": 1.0})
    out = tmp_path / "new" / "pairs.json"
    words = ["--source", args.source, "--size", "24x40", "--workers", "1", "--seconds", "0", "--out", out]
    run_program(pairs, *words)
    content = json.loads(out.read_text())
    assert pairs.PROTOCOL.keys() <= content.keys()
    assert content["loader"]["fog"] > 0
    assert 1 <= content["memory"]["fog"] <= 3
    assert content["scaling"]["fog"]["pixels"] == [8 * 10, 12 * 20, 24 * 40]
