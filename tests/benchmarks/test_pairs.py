import json
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pairs
import pytest
import torch
from PIL import Image

from torchrefract import UniformFog


@pytest.fixture
def args(tmp_path, monkeypatch) -> Namespace:
    """Options for four images of two drives."""
    generator = np.random.default_rng(0)
    for number in range(4):
        path = tmp_path / "frames" / f"drive{number % 2}" / f"{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(generator.integers(0, 256, (24, 40, 3)).astype(np.uint8)).save(path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    return Namespace(source=tmp_path / "frames", scene="paper_refractive", size=(24, 40), maps="png", count=4)


def test_the_peak_memory_is_what_a_call_holds_at_once():
    x = torch.zeros(64, 1024)
    for call, tensors in ((x.clone, 1), (lambda: (x + 1) * 2, 2), (lambda: (x + 1) + (x + 2), 3)):
        assert pairs.peak_bytes(call) == pytest.approx(tensors * x.nbytes, rel=1e-3)


def test_the_command_writes_all_measurements(args, tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "make_effects", lambda: {"fog": UniformFog()})
    monkeypatch.setattr(pairs, "measure_run", lambda *_: pairs.Run(1, 2.0, 1.0, 10, 20.0))
    monkeypatch.setattr(pairs, "measure_one_pair", lambda _: {"generated": 2.0, "read_and_encode": 1.0})
    out = tmp_path / "new" / "pairs.json"
    words = ["--source", str(args.source), "--size", "24x40", "--workers", "1", "--seconds", "0", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["pairs.py", *words])
    pairs.main()
    content = json.loads(out.read_text())
    assert pairs.PROTOCOL.keys() <= content.keys()
    assert content["loader"]["fog"] > 0
    assert 1 <= content["memory"]["fog"] <= 3
    assert content["scaling"]["fog"]["pixels"] == [8 * 10, 12 * 20, 24 * 40]
