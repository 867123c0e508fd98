import json
import sys

import effects
import pytest
import timing
import torch
from effects import count_calls
from timing import GRID_SAMPLE, Spread, Timing

from torchrefract import LensDistortion, LensFlare, warp_mask


@pytest.mark.quick
def test_calls_are_those_inside_the_package():
    mask, flow = torch.zeros(1, 4, 5), torch.zeros(2, 4, 5)
    assert count_calls(lambda: torch.zeros(3)).calls == 0
    once = count_calls(lambda: warp_mask(mask, flow))
    assert 3 <= once.files <= once.functions <= once.calls  # maps, checks and sampling
    twice = count_calls(lambda: (warp_mask(mask, flow), warp_mask(mask, flow)))
    assert (twice.files, twice.functions, twice.calls) == (once.files, once.functions, 2 * once.calls)
    (most,) = twice.most_called(1)
    assert int(most.split()[0]) == max(twice.entered.values())
    assert sys.getprofile() is None


@pytest.mark.quick
def test_rows_above_their_limit_are_marked():
    rows = {"mild lens, within 0.05 px": 0.95, "mild lens, within 0.05 px, torch": 0.95, "uniform fog": 0.2}
    bars = effects.speed_bars([Timing(n, 1, Spread(r, r, r), {GRID_SAMPLE: Spread(r, r, r)}) for n, r in rows.items()])
    assert [(bar.name, bar.limit, bar.holds) for bar in bars] == [
        ("mild lens, within 0.05 px", 0.9, False),
        ("mild lens, within 0.05 px, torch", 1.6, True),
        ("uniform fog", 0.3, True),
    ]


def test_the_command_times_each_backend_or_counts_calls(monkeypatch, tmp_path, run_program):
    monkeypatch.setattr(effects, "WARPS", {"mild lens": timing.WARPS["mild lens"]})
    monkeypatch.setattr(effects, "OTHER_WARPS", {})
    monkeypatch.setattr(effects, "PHOTOMETRIC", {"flare": LensFlare})
    monkeypatch.setattr(effects, "all_warps", LensDistortion)
    out = tmp_path / "effects.json"
    printed = run_program(effects, "--size", "24x40", "--threads", "1", "--out", out)
    assert "bar <= 0.9 x bare grid_sample" in printed
    names = {row["name"] for row in json.loads(out.read_text())["timings"]}
    assert {"mild lens, within 0.05 px", "mild lens, exact, torch", "all four warps, exact", "flare"} <= names
    monkeypatch.setattr(effects, "CALL_SIZE", (24, 40))
    lines = run_program(effects, "--calls", "--verbose").splitlines()
    assert sum(line.startswith("composition of four warps and fog, warm: ") for line in lines) == 3
    assert len(lines) == 4 * (3 + effects.NUM_FUNCTIONS)
