import json
import random
import sys

import pytest
import timing
import torch
import tradeoff
from PIL import Image
from tradeoff import Variant, compare, frame_errors, pareto_front

SIZE = (96, 128)


def variants(name: str, setting: str) -> list[Variant]:
    return [variant for variant in tradeoff.settings()[name] if variant.setting == setting]


@pytest.fixture(scope="module")
def road() -> torch.Tensor:
    return tradeoff.read_frames(tradeoff.SYNTHETIC, SIZE, 1)[0]


def test_errors_stay_within_each_tolerance_and_better_interpolation_is_closer_to_splines(road):
    nearest, bilinear, bicubic = frame_errors(variants("mild lens", "interpolation"), road, 0)
    assert 0 < bicubic.mean_levels < bilinear.mean_levels < nearest.mean_levels
    errors = frame_errors(variants("mild lens", "tolerance_px"), road, 0)
    limits = (1e-3, *tradeoff.TOLERANCES_PX)  # of the exact effect in float32 first
    assert all(0 < (error.largest_px or 0) <= px for px, error in zip(limits, errors, strict=True))
    assert errors[0].mean_levels < 1e-3


def test_errors_are_in_px_and_levels():
    expected, zero = torch.full((1, 3, 2, 4), 0.5).double(), torch.zeros(1, 2, 2, 4).double()
    mask = torch.tensor([[[[True] * 4, [False] * 4]]])
    image, flow = expected.clone().float(), torch.zeros(1, 2, 2, 4)
    image[:, :, 0, 0] += 2 / 255
    image[:, :, 1] = 0.0  # outside the mask
    flow[:, 0, 0, 1], flow[:, 1, 0, 1] = 3.0, 4.0
    assert compare(image, flow, expected, zero, mask) == pytest.approx((5, 0.5, 2), rel=1e-5)
    assert compare(image, None, expected, None, mask).largest_px is None


@pytest.mark.quick
@pytest.mark.parametrize("seed", range(5))
def test_the_pareto_front_is_what_no_other_cost_dominates(seed):
    dice = random.Random(seed)
    costs = [(dice.randint(0, 9), dice.randint(0, 9)) for _ in range(dice.randint(0, 40))]

    def dominates(a: tuple[int, int], b: tuple[int, int]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    assert set(pareto_front(costs)) == {i for i, b in enumerate(costs) if not any(dominates(a, b) for a in costs)}


def test_the_command_writes_a_table_and_a_plot(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    few = {"lens": variants("mild lens", "tolerance_px")[::3], "flare": variants("flare", "tolerance")}
    monkeypatch.setattr(tradeoff, "settings", lambda: few)
    words = ["tradeoff.py", "--quick", "--frames", "synthetic", "--threads", "1", "--out", str(tmp_path / "new")]
    monkeypatch.setattr(sys, "argv", words)
    tradeoff.main()
    assert "| flare | tolerance | None |" in capsys.readouterr().out
    rows = json.loads((tmp_path / "new" / "tradeoff.json").read_text())["rows"]
    assert [row["value"] for row in rows] == ["None", "0.05", "1", "None", "0.1", "0.3", "1"]
    assert min(rows[:3], key=lambda row: row["mean_levels"])["is_pareto"]
    assert min(rows[:3], key=lambda row: row["ratio"])["is_pareto"]
    assert rows[3]["largest_px"] is None
    with Image.open(tmp_path / "new" / "tradeoff.png") as picture:
        assert picture.width > 500
