import csv
import json
import math
import sys
from dataclasses import replace
from functools import partial

import accuracy
import pytest
import subjects
import sweeps
import timing
import torch
import tradeoff
from accuracy import Errors, compare, decibels, frame_errors, together
from PIL import Image
from sweeps import SWEEPS, Variant
from torch.testing import assert_close
from torchrefract.effects.lattice_warp import LatticeWarp

from torchrefract.data.images import image_size

SIZE = (96, 128)


@pytest.fixture(scope="module")
def road() -> torch.Tensor:
    (frame,) = tradeoff.read_frames(tradeoff.SYNTHETIC, SIZE, 1)
    return frame


def chosen(name: str, knob: str) -> list[Variant]:
    return [variant for variant in SWEEPS[name] if variant.knob == knob]


@pytest.mark.parametrize("name", [subjects.LENS, subjects.AIR, subjects.SWIRLS, "all four warps"])
def test_errors_grow_with_the_tolerance_and_stay_within_it(road, name):
    exact, *within = frame_errors(chosen(name, "tolerance_px"), road, 0)
    assert exact.largest_px is not None
    assert exact.largest_px < 1e-3
    assert exact.mean_levels < 1e-3
    pairs = zip(sweeps.TOLERANCES_PX, within, strict=True)
    assert all(exact.largest_px < (error.largest_px or 0) <= px for px, error in pairs)
    for quantity in ("largest_px", "mean_px", "mean_levels", "square"):
        values = [getattr(error, quantity) for error in (exact, *within)]
        assert values == sorted(values), quantity


def test_a_better_look_up_is_nearer_to_the_splines(road):
    nearest, bilinear, bicubic = frame_errors(chosen(subjects.LENS, "interpolation"), road, 0)
    assert bicubic.square < bilinear.square < nearest.square
    assert bilinear.mean_levels > 0.1  # not held against its own reading


def test_more_steps_and_more_scales_come_nearer_to_the_truth(road):
    steps = frame_errors(chosen(subjects.SWIRLS, "steps"), road, 0)
    assert [error.largest_px for error in steps] == sorted((error.largest_px or 0 for error in steps), reverse=True)
    every, *_, one = frame_errors(chosen(subjects.DRIFTS, "scales"), road, 0)
    assert every.mean_levels < 1e-3 < one.mean_levels


def test_errors_are_counted_in_px_and_levels():
    true = accuracy.Truth(
        torch.full((1, 3, 2, 4), 0.5).double(),
        torch.zeros(1, 2, 2, 4).double(),
        torch.tensor([[[[True] * 4, [False] * 4]]]),
    )
    image, flow = true.image.clone().float(), torch.zeros(1, 2, 2, 4)
    image[:, :, 0, 0] += 2 / 255
    image[:, :, 1] = 0.0  # where nothing is judged
    flow[:, 0, 0, 1], flow[:, 1, 0, 1] = 3.0, 4.0
    error = compare(image, flow, true)
    assert error.largest_px == pytest.approx(5)
    assert error.mean_px == pytest.approx(5 / 8)
    assert error.largest_levels == pytest.approx(2, rel=1e-5)
    assert error.mean_levels == pytest.approx(0.5, rel=1e-5)
    assert error.square == pytest.approx((2 / 255) ** 2 / 4, rel=1e-5)


def test_light_moves_nothing(road):
    error, *_ = frame_errors(chosen(subjects.FLARE, "tolerance"), road, 0)
    assert (error.largest_px, error.mean_px) == (None, None)


def test_frames_together_keep_the_largest_and_the_mean():
    found = together([Errors(1.0, 0.5, 4.0, 2.0, 0.01), Errors(3.0, 0.1, 2.0, 1.0, 0.03)])
    assert_close(torch.tensor(found), torch.tensor([3.0, 0.3, 4.0, 1.5, 0.02]))


def test_decibels_are_those_of_a_mean_square():
    assert decibels(0.01) == pytest.approx(20)
    assert decibels(0.0) == math.inf


def test_all_values_of_a_knob_share_one_draw(road):
    for name, variants in SWEEPS.items():
        first, *others = (accuracy.draw_params(v.make(), road, 3) for v in variants if v.knob != "scales")
        for other in others:
            torch.testing.assert_close(other, first, msg=name)


def test_every_effect_is_there_in_every_tolerance():
    for name, make in subjects.SMOOTH.items():
        values = [variant.value for variant in chosen(name, "tolerance_px")]
        assert values == ["None", *(f"{px:g}" for px in sweeps.TOLERANCES_PX)]
        effect = chosen(name, "tolerance_px")[1].make()
        assert isinstance(effect, LatticeWarp)
        assert effect.tolerance_px == sweeps.TOLERANCES_PX[0]
        assert type(effect) is type(make())
    assert set(subjects.WEATHER) < set(SWEEPS)


def test_kinds_are_series_of_their_own_in_the_picture():
    row = tradeoff.Row("air", "covariance", "gaussian", sweeps.ITSELF, 1.0, 1.0, 1.0, None, None, 0.1, 0.01, 90.0, True)
    assert tradeoff.point(row)[:2] == ("", "covariance gaussian")
    within = replace(row, knob="tolerance_px", value="0.1", against=sweeps.DENSE, front=False)
    assert tradeoff.point(within) == ("0.1", "tolerance_px", 1.0, 0.01, False)
    assert tradeoff.point(replace(within, against="16 steps")).series == "tolerance_px, against 16 steps"


def test_frames_are_cut_to_the_size_and_small_ones_left_out(tmp_path):
    for name, size in (("a.png", (40, 30)), ("b.png", (200, 100)), ("c.jpg", (128, 96)), ("d.png", (300, 150))):
        Image.new("RGB", size, "gray").save(tmp_path / name)
    frames = tradeoff.read_frames(str(tmp_path), SIZE, 2)
    assert [tuple(frame.shape) for frame in frames] == [(1, 3, *SIZE)] * 2
    with pytest.raises(ValueError, match=r"at least 900x900 px .* the word 'synthetic', got .* with 4 pictures"):
        tradeoff.read_frames(str(tmp_path), (900, 900), 1)


def test_frames_that_are_not_there_end_the_command(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["tradeoff.py", "--frames", str(tmp_path / "none")])
    with pytest.raises(SystemExit) as stop:
        tradeoff.main()
    assert stop.value.code == 2
    assert "got " + str(tmp_path / "none") in capsys.readouterr().err


def test_the_command_writes_what_it_measures(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    few = {"lens": chosen(subjects.LENS, "tolerance_px")[::3], "flare": SWEEPS[subjects.FLARE]}
    still = partial(subjects.SMOOTH[subjects.AIR], amplitude_range=(0.0, 0.0))
    few["still air"] = [Variant("tolerance_px", "None", still, still)]
    monkeypatch.setattr(tradeoff, "SWEEPS", few)
    words = ["tradeoff.py", "--quick", "--frames", "synthetic", "--threads", "1", "--out", str(tmp_path / "new")]
    monkeypatch.setattr(sys, "argv", words)
    tradeoff.main()
    printed = capsys.readouterr().out
    assert "| flare | tolerance | None |" in printed
    with (tmp_path / "new" / "tradeoff.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["effect"], row["value"]) for row in rows] == [
        *(("lens", value) for value in ("None", "0.05", "1")),
        *(("flare", value) for value in ("None", "0.1", "0.3", "1", "screen")),
        ("still air", "None"),
    ]
    lens = [float(row["mean_px"]) for row in rows[:3]]
    assert lens == sorted(lens)
    assert all(float(row["ratio_lower"]) <= float(row["ratio"]) <= float(row["ratio_upper"]) for row in rows)
    assert rows[3]["largest_px"] == ""
    assert float(rows[8]["psnr_db"]) == math.inf
    content = json.loads((tmp_path / "new" / "tradeoff.json").read_text())
    assert content["rows"][8]["psnr_db"] is None
    assert content["conditions"]["frame"] == [1, 3, *tradeoff.QUICK]
    # In each knob the most exact one is on the front, and so is the fastest.
    lens_rows = content["rows"][:3]
    assert min(lens_rows, key=lambda row: row["mean_levels"])["front"]
    assert min(lens_rows, key=lambda row: row["ratio"])["front"]
    assert image_size(tmp_path / "new" / "tradeoff.png")[1] > 500
