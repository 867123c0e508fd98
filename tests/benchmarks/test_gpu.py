import json
import sys

import gpu
import pytest
import timing
import torch

from torchrefract import LensFlare, ThinPlateSpline


@pytest.mark.quick
def test_without_a_gpu_the_command_prints_one_line_and_fails(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit) as stop:
        gpu.main()
    assert stop.value.code == 1
    assert capsys.readouterr() == ("", "error: cuda must be a device of this machine, but torch finds no GPU\n")


def test_the_command_times_eager_and_compiled_effects_and_compares_devices(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(gpu, "all_effects", lambda: {"flare": LensFlare(), "spline": ThinPlateSpline()})
    monkeypatch.setattr(torch, "compile", lambda effect, **_: effect)
    out = tmp_path / "gpu.json"
    words = ["gpu.py", "--device", "cpu", "--shape", "2x3x24x32", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    gpu.main()
    printed = capsys.readouterr().out
    for expected in ("flare, device and CPU: 0 levels", "spline, device and CPU, TF32 allowed: 0 px"):
        assert expected in printed
    content = json.loads(out.read_text())
    rows = {row["name"]: row["milliseconds"]["median"] for row in content["timings"]}
    assert list(rows)[2:] == ["flare", "flare, compiled", "spline", "spline, compiled"]
    read_and_written = 2 * 2 * 3 * 24 * 32 * 4
    assert content["bytes_per_second"]["flare"] == pytest.approx(1e3 * read_and_written / rows["flare"])
