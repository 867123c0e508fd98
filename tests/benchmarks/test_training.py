import json
import sys

import timing
import training

from torchrefract import UniformFog

SMALL = "tu-test_resnet"


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
