import json
import math
import sys

import inverses
import pytest
import timing
import torch
from inverses import FIXED_POINT, NEWTON, Row
from PIL import Image
from torch.testing import assert_close

from torchrefract import invert_flow

SIZE = (48, 64)


@pytest.fixture
def weak(waves, pixels):
    """A flow (1, 2, H, W) whose slope is 0.15, fp64."""
    return waves(*pixels(*SIZE), 1.5, 10.0)


def test_the_fixed_point_agrees_with_newton_on_a_weak_flow(weak):
    inverse, valid, residual = inverses.fixed_point(weak, steps=20)
    newton, sound, _ = invert_flow(weak)
    both = valid & sound
    assert both.double().mean() > 0.8
    assert_close((inverse - newton)[both.expand_as(inverse)].abs().max().item(), 0.0, atol=1e-4, rtol=0)
    assert residual[both].max() < 1e-4


def test_the_certificate_is_that_of_invert_flow(weak):
    inverse, valid, residual = invert_flow(weak, steps=2)
    found_valid, found_residual = inverses.certify(weak, inverse)
    assert torch.equal(found_valid, valid)
    assert_close(found_residual, residual)


def test_a_fixed_point_step_shrinks_the_residual_by_the_slope(pixels):
    x, _ = pixels(*SIZE)
    flow = torch.stack([0.25 * (x - 30), torch.zeros_like(x)])[None]
    residuals = [inverses.fixed_point(flow, steps=n)[2][0, 0, 20, 20:40] for n in (1, 2, 3)]
    # The error of a linear flow of slope a is -a times what it was.
    assert_close(residuals[1], 0.25 * residuals[0])
    assert_close(residuals[2], 0.25 * residuals[1])


def test_a_folded_pixel_is_not_certified(pixels):
    x, _ = pixels(*SIZE)
    flow = torch.stack([-2.0 * (x - 32), torch.zeros_like(x)])[None]  # p + flow(p) = 64 - p: the frame mirrored
    inverse, _, _ = invert_flow(flow)
    valid, residual = inverses.certify(flow, inverse)
    assert (residual[..., 8:-8] < 1e-9).all()
    assert not valid.any()


def test_both_methods_are_stopped_after_the_steps_that_are_asked_for(weak):
    solved = {(s.method, s.steps): s for s in inverses.solve(weak)}
    assert list(solved) == [(method, steps) for method, counts in inverses.STEPS.items() for steps in counts]
    for steps in (3, 8):
        assert_close(solved[FIXED_POINT, steps].inverse, inverses.fixed_point(weak, steps=steps)[0])
    assert_close(solved[NEWTON, 3].inverse, invert_flow(weak, steps=3)[0])


def test_the_bend_of_a_parabola_is_its_second_difference(pixels):
    x, y = pixels(*SIZE)
    flow = torch.stack([x * x, y * y])[None]
    everywhere = torch.ones(1, 1, *SIZE, dtype=torch.bool)
    assert inverses.bend(3 * flow, everywhere) > 3
    # Along x the first channel bends by 2 and the second by 0; along y the other way round.
    assert inverses.bend(flow, everywhere) == pytest.approx(math.sqrt(2))


def test_a_pixel_that_is_not_good_bends_nothing(pixels):
    x, _ = pixels(*SIZE)
    flow = torch.stack([x, x])[None]
    good = torch.ones(1, 1, *SIZE, dtype=torch.bool)
    flow[..., 10, 10], good[..., 10, 10] = 99.0, False
    assert inverses.bend(flow, good) == pytest.approx(0, abs=1e-12)


def test_a_solved_thin_plate_misses_the_spline_by_its_bilinear_reading():
    flow, params = inverses.draw("ThinPlateSpline", SIZE, key=0)
    inverse, valid, _ = invert_flow(flow, steps=8)
    missed = inverses.spline_residual(inverse, params)[valid]
    curve = max(flow.diff(n=2, dim=dim).norm(dim=1).max().item() for dim in (-1, -2))
    assert 1e-5 < missed.max() < curve / 8 * 2 + 1e-3
    assert inverses.spline_residual(0 * inverse, params)[valid].max() > 1


def test_newton_needs_fewer_steps_than_the_fixed_point():
    table = inverses.rows("DivergenceFree", [SIZE, SIZE], {f"{NEWTON} 2": 7.5})
    last = {row.method: row for row in table}
    assert last[FIXED_POINT].valid == pytest.approx(last[NEWTON].valid, abs=5e-3)
    first = {m: next(row for row in table if row.method == m and row.most_px <= 1e-3) for m in inverses.STEPS}
    assert first[NEWTON].steps < first[FIXED_POINT].steps
    assert next(row.ratio for row in table if (row.method, row.steps) == (NEWTON, 2)) == 7.5
    assert last[NEWTON].spline_px is None


def test_what_is_needed_is_the_first_row_under_the_goal():
    table = [
        Row(FIXED_POINT, 1, 1.0, 0.9, 0.5, 0.1, None, 3.0),
        Row(FIXED_POINT, 2, 0.1, 0.04, 0.9, 0.1, None, 4.0),
        Row(NEWTON, 1, 0.1, 0.01, 0.9, 0.1, None, 6.0),
        Row(NEWTON, 2, 0.01, 0.0009, 0.9, 0.1, None, 7.25),
    ]
    coarse, fine = inverses.needed(table)
    assert coarse == "99.9 % within 0.05 px: fixed point 2 steps, 4 x; Newton 1 steps, 6 x"
    assert fine == "99.9 % within 0.001 px: fixed point never; Newton 2 steps, 7.25 x"


def test_the_command_prints_a_table_for_each_effect(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(inverses, "EFFECTS", {n: inverses.EFFECTS[n] for n in ("DivergenceFree", "ThinPlateSpline")})
    monkeypatch.setattr(inverses, "STEPS", {FIXED_POINT: (1, 4), NEWTON: (1, 2)})
    Image.new("RGB", (SIZE[1], SIZE[0])).save(tmp_path / "frame.png")
    out = tmp_path / "run.json"
    monkeypatch.setattr(sys, "argv", ["inverses.py", str(tmp_path), "--threads", "1", "--out", str(out)])
    inverses.main()
    printed = capsys.readouterr().out
    assert "ThinPlateSpline: 1 draws" in printed
    content = json.loads(out.read_text())
    assert list(content["effects"]) == ["DivergenceFree", "ThinPlateSpline"]
    plate = content["effects"]["ThinPlateSpline"]
    assert [(row["method"], row["steps"]) for row in plate] == [
        (FIXED_POINT, 1), (FIXED_POINT, 4), (NEWTON, 1), (NEWTON, 2)
    ]  # fmt: skip  # one line for each row of a table
    assert all(row["ratio"] > 0 and row["spline_px"] > 0 for row in plate)
    assert content["conditions"]["frame"] == [1, 3, *SIZE]
