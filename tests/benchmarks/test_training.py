import json

import training

from torchrefract import UniformFog

SMALL = "tu-test_resnet"


def test_the_command_prints_and_saves_both_limits(monkeypatch, tmp_path, run_program, on_threads):
    on_threads(1)
    monkeypatch.setattr(training, "effects", lambda: {"fog": UniformFog()})
    out = tmp_path / "training.json"
    words = ["--batch", "2", "--size", "64x64", "--threads", "1", "--rounds", "1", "--encoder", SMALL]
    assert "undistort, cheap_dashcam: " in run_program(training, *words, "--out", out)
    content = json.loads(out.read_text())
    assert [row["name"] for row in content["timings"]] == [training.BARE, "fog"]
    assert [bar["name"] for bar in content["bars"]] == ["fog", *training.TASKS]
    for steps in content["steps"].values():
        assert [row["name"] for row in steps] == [training.BEFORE, training.FLY]
