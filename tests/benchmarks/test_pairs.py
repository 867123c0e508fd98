import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pairs
import pytest
from PIL import Image


@pytest.fixture
def frames(tmp_path) -> Path:
    """Four pictures of two drives."""
    dice = np.random.default_rng(0)
    for number in range(4):
        path = tmp_path / "frames" / f"drive{number % 2}" / f"{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(dice.integers(0, 256, (24, 40, 3)).astype(np.uint8)).save(path)
    return tmp_path / "frames"


def test_a_pair_takes_longer_than_its_decoding_and_encoding(frames, on_threads):
    on_threads(1)
    single = pairs.one_by_one(Namespace(source=frames, scene="paper_refractive", size=(24, 40), maps="png"))
    assert single.made > single.bare > 0


def test_a_run_is_measured_and_its_files_are_counted(frames, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    options = {
        "source": frames,
        "scene": "limpopo_sun_glare",
        "size": (24, 40),
        "maps": "png",
        "count": 4,
        "workers": 1,
    }
    out = tmp_path / "out"
    found = pairs.measured(pairs.command(Namespace(**options), out), 4, out, cores=1)
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    stored = sum(file["bytes"] for row in rows for file in row["files"].values())
    others = sum(path.stat().st_size for path in out.iterdir() if path.is_file())
    assert (len(rows), found.disk_bytes) == (4, stored + others)
    assert found.busy > 0
    assert found.peak_bytes > 50e6
