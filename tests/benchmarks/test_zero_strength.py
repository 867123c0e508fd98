import json
import sys

import pytest
import timing
import torch
import zero_strength
from timing import Spread, Timing
from zero_strength import SCENE


def test_what_is_added_changes_nothing():
    frame = torch.rand(2, 3, 24, 32)
    for name, more in zero_strength.zeros().items():
        assert len(more) == 3
        for effect in more:
            assert torch.equal(effect(frame), frame), name


@pytest.mark.parametrize(("ratio", "holds"), [(0.96, False), (0.98, True), (1.02, True), (1.04, False)])
def test_the_bar_is_two_sided(ratio, holds):
    timings = [
        Timing(name, 1, Spread(1, 1, 1), {SCENE: Spread(value, value, value)})
        for name, value in ((SCENE, 1.0), ("more", ratio))
    ]
    (bar,) = zero_strength.bars(timings)
    assert bar.holds is holds


def test_the_command_holds_scenes_against_the_one_without(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    out = tmp_path / "zero.json"
    words = ["zero_strength.py", "--size", "24x32", "--threads", "1", "--repeats", "15", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    zero_strength.main()
    assert "three warps at strength zero" in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert [list(row["ratios"]) for row in content["timings"]] == [[SCENE]] * 3
    assert len(content["bars"]) == 2
