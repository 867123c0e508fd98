import argparse
import json
import sys

import gpu
import pytest
import timing
import torch
from arguments import shape
from timing import COPY, Spread, Timing

from torchrefract import LensFlare, ThinPlateSpline
from torchrefract.effects.base import Effect


def timed(name: str, ms: float) -> Timing:
    return Timing(name, 1, Spread(ms, ms, ms), {})


def test_without_a_gpu_the_command_is_one_line_and_fails(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit) as stop:
        gpu.main()
    assert stop.value.code == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "error: cuda must be a device of this machine, and torch sees no GPU here\n"


def test_speeds_count_the_image_read_and_written():
    frames = torch.zeros(2, 3, 100, 100)
    speeds = gpu.bytes_per_second([timed(COPY, 1.0), timed("fog", 4.0)], frames)
    assert speeds[COPY] == pytest.approx(2 * 2 * 3 * 100 * 100 * 4 / 1e-3)
    copy, fog = gpu.traffic(speeds)
    assert copy.endswith("1.00 of a copy")
    assert fog.endswith("0.25 of a copy")


class Off(ThinPlateSpline):
    """A spline that is off by a fifth of a px the second time it is asked."""

    def flow(self, params, *, height: int, width: int):
        flow, exists = super().flow(params, height=height, width=width)
        self.calls = getattr(self, "calls", 0) + 1
        return flow + 0.2 * (self.calls > 1), exists


def test_what_differs_from_the_cpu_is_told():
    frame = torch.rand(1, 3, 24, 32)
    chosen: dict[str, Effect] = {"plate": ThinPlateSpline(), "flare": LensFlare(), "off": Off()}
    plate, plate_rounded, flare, _, off, _ = gpu.agreement(chosen, frame)
    assert plate_rounded.name == "plate as on the CPU, TF32 allowed"
    assert plate_rounded.holds
    assert (plate.value, plate.unit, plate.holds) == (0, "px", True)
    assert (flare.value, flare.unit, flare.holds) == (0, "levels", True)
    assert off.value == pytest.approx(0.2 * 2**0.5, rel=1e-4)
    assert not off.holds


def test_what_cannot_be_called_is_left_out_and_told():
    def fail() -> None:
        raise RuntimeError("out of memory\nwith a long report")

    kept, failed = gpu.working({"fine": lambda: None, "broken": fail})
    assert list(kept) == ["fine"]
    assert failed == ["broken is left out: RuntimeError: out of memory"]


def test_a_shape_has_four_sides():
    assert shape("16x3x1080x1920") == (16, 3, 1080, 1920)
    for text in ("3x4x5", "1x3x0x5", "1x3xax5"):
        with pytest.raises(argparse.ArgumentTypeError, match="must be BATCHxCHANNELSxHEIGHTxWIDTH"):
            shape(text)


def test_the_command_times_eager_and_compiled_graphs(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(gpu, "subjects", lambda: {"flare": LensFlare(), "plate": ThinPlateSpline()})
    out = tmp_path / "new" / "gpu.json"
    words = ["gpu.py", "--device", "cpu", "--shape", "2x3x24x32", "--backend", "eager", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    gpu.main()
    said = capsys.readouterr().out
    assert "flare as on the CPU: 0 levels" in said
    assert "flare, compiled: first call" in said
    content = json.loads(out.read_text())
    names = [row["name"] for row in content["timings"]]
    assert names[2:] == ["flare", "flare, compiled", "plate", "plate, compiled"]
    for row in content["timings"]:
        nbytes = 2 * 2 * 3 * 24 * 32 * 4
        assert row["bytes_per_second"] == pytest.approx(1e3 * nbytes / row["milliseconds"]["median"])


def test_effects_can_be_chosen(monkeypatch, tmp_path, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(gpu, "subjects", lambda: {"flare": LensFlare(), "plate": ThinPlateSpline()})
    out = tmp_path / "gpu.json"
    words = ["gpu.py", "--device", "cpu", "--shape", "2x3x24x32", "--backend", "eager", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", [*words, "--only", "plate"])
    gpu.main()
    assert [row["name"] for row in json.loads(out.read_text())["timings"]][2:] == ["plate", "plate, compiled"]
    monkeypatch.setattr(sys, "argv", [*words, "--only", "plate", "--eager"])
    gpu.main()
    assert [row["name"] for row in json.loads(out.read_text())["timings"]][2:] == ["plate"]
