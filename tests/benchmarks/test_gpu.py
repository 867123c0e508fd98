import json

import gpu
import pytest
import torch

from torchrefract import LensFlare, ThinPlateSpline


@pytest.mark.quick
def test_without_a_gpu_the_command_prints_one_line_and_fails(monkeypatch, run_program, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as stop:
        run_program(gpu)
    assert stop.value.code == 1
    assert capsys.readouterr() == ("", "error: cuda must be a device of this machine, but torch finds no GPU\n")


def test_the_command_times_eager_and_compiled_effects_and_compares_devices(monkeypatch, tmp_path, run_program):
    monkeypatch.setattr(gpu, "all_effects", lambda: {"flare": LensFlare(), "spline": ThinPlateSpline()})
    monkeypatch.setattr(torch, "compile", lambda effect, **_: effect)
    out = tmp_path / "gpu.json"
    printed = run_program(gpu, "--device", "cpu", "--shape", "2x3x24x32", "--out", out)
    for expected in ("flare, device and CPU: 0 levels", "spline, device and CPU, TF32 allowed: 0 px"):
        assert expected in printed
    content = json.loads(out.read_text())
    rows = {row["name"]: row["milliseconds"]["median"] for row in content["timings"]}
    assert list(rows)[2:] == ["flare", "flare, compiled", "spline", "spline, compiled"]
    read_and_written = 2 * 2 * 3 * 24 * 32 * 4
    assert content["bytes_per_second"]["flare"] == pytest.approx(1e3 * read_and_written / rows["flare"])
