import json
import sys
from functools import partial

import composites
import one_resample
import pytest
import torch
from PIL import Image
from timing import Bar
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, compose_flows
from torchrefract.warping.grid import pixel_axes

SIZE = (120, 160)


@pytest.fixture
def still() -> Tensor:
    """The positions (1, 2, H, W) of the pixels, fp64."""
    return composites.positions(torch.zeros(1, 2, *SIZE))


def smooth_frame(height: int, width: int) -> Tensor:
    x, y = pixel_axes(height, width, dtype=torch.float32, device=torch.device("cpu"))
    waves = [torch.sin(x / length + y / (2 * length)) + torch.cos(y / length) for length in (2.5, 4.0, 7.0)]
    return 0.5 + torch.cat(waves, dim=1) / 5


def inner(value: Tensor, margin: int) -> Tensor:
    return value[..., margin:-margin, margin:-margin]


def test_the_reference_of_translation_and_scaling_is_the_analytic_composite(still):
    middle = torch.tensor([70.0, 55.0], dtype=torch.float64).view(1, 2, 1, 1)
    shift = torch.tensor([1.3, -2.7], dtype=torch.float64).view(1, 2, 1, 1)
    scaling = 0.02 * (still - middle)
    found = composites.composite([scaling, shift.expand_as(still), scaling])
    # Scaled about the middle, shifted, scaled again.
    once = middle + 1.02 * (still - middle) + shift
    truth = middle + 1.02 * (once - middle) - still
    # A line that ends at the border bends the spline there, by 0.43 of the bend for each pixel inward.
    assert_close(inner(found, 32), inner(truth, 32), atol=1e-9, rtol=0)


def test_the_order_of_flows_is_that_of_compose(still):
    frame = smooth_frame(*SIZE)
    made = one_resample.scene(frame, 3)
    flow = Compose(one_resample.warps()).apply(frame, made.params).flow
    assert one_resample.error_px(flow, made.flow) < 0.1
    backward = composites.composite(made.flows[::-1])
    assert one_resample.error_px(backward.float(), made.flow) > 1


@pytest.mark.parametrize("compose", [lambda *flows: composites.composite(flows), compose_flows])
def test_a_composite_reads_the_first_flow_where_the_second_looks(still, compose):
    # Linear flows are read exactly by both.
    first = torch.cat([still[:, 1:] / 8, -still[:, :1] / 16], dim=1)
    then = torch.full_like(first, 2.5)
    truth = then + torch.cat([(still[:, 1:] + 2.5) / 8, -(still[:, :1] + 2.5) / 16], dim=1)
    assert_close(inner(compose(first, then), 36), inner(truth, 36), atol=1e-9, rtol=0)


def test_closed_forms_are_the_flows_of_the_effects(still):
    made = one_resample.scene(smooth_frame(*SIZE), 1)
    known = composites.closed_forms(made.params, height=SIZE[0], width=SIZE[1])
    assert_close(known["lens"](still), made.flows[0], atol=1e-9, rtol=0)
    assert_close(known["plate"](still), made.flows[2], atol=1e-9, rtol=0)
    sine = known["sine"](still)
    assert_close(sine[0, 0, 50, 0].item(), 4.0)  # a quarter of the wavelength down
    assert_close(sine[0, 1, 0, 100].item(), 0.0, atol=1e-12, rtol=0)


def test_splines_read_a_thin_plate_far_better_than_bilinear_look_ups():
    made = one_resample.scene(smooth_frame(*SIZE), 2)
    known = composites.closed_forms(made.params, height=SIZE[0], width=SIZE[1])
    plate, then = made.flows[2:]
    truth = then + known["plate"](composites.positions(then))
    spline, bilinear = (
        one_resample.error_px(flow, truth) for flow in (composites.composite([plate, then]), compose_flows(plate, then))
    )
    # At a control point the plate has no second derivative, and no reading is exact.
    assert spline < bilinear / 10


def test_compositions_in_closed_form_keep_the_bar():
    made = one_resample.scene(smooth_frame(*SIZE), 0)
    errors = one_resample.closed_errors(made)
    assert len(errors) == 6
    assert errors["in closed form, lens, then sine"] < 2e-3
    # A bilinear reading of a sine is off by up to (2 pi / wavelength)^2 / 8 of its amplitude on each axis; it is 0 in
    # none of these, so a comparison of the truth with itself would show.
    bound = composites.SINE_PX * (2 * torch.pi / composites.SINE_WAVELENGTH_PX) ** 2 / 8 * 2**0.5
    assert bound / 4 < errors["in closed form, sine, then lens"] < bound + 1e-4


@pytest.mark.parametrize("mode", one_resample.MODES)
def test_one_resample_of_a_smooth_frame_beats_four(mode):
    frame = smooth_frame(*SIZE)
    row = one_resample.compare(frame, one_resample.scene(frame, 0), interpolation=mode, name="waves")
    assert row.gain_db > 6
    assert row.one_db > 30
    assert 0.2 < row.share < 1


@pytest.mark.parametrize("mode", one_resample.MODES)
def test_a_frame_that_is_rectified_for_another_lens_is_sharper_after_one_resample_than_after_two(mode):
    frame, chain = smooth_frame(*SIZE), partial(one_resample.rectified, height=SIZE[0], width=SIZE[1])
    row = one_resample.compare(frame, one_resample.scene(frame, 0, chain), chain, interpolation=mode, name="waves")
    assert row.gain_db > 2
    assert row.one_db > 30
    assert 0.2 < row.share < 1


def test_pixels_near_what_is_not_valid_are_not_compared():
    margin = one_resample.MARGIN_PX
    valid = torch.ones(1, 1, 60, 80, dtype=torch.bool)
    valid[0, 0, 30, 40] = False
    flow = torch.zeros(1, 2, 60, 80)
    flow[:, 0, :, 60] = 80 - 1 - 60 - margin + 0.5  # looks half a pixel too far out
    good = one_resample.sound(valid, flow)[0, 0]
    y, x = torch.meshgrid(torch.arange(60), torch.arange(80), indexing="ij")
    deep = (x >= margin) & (x < 80 - margin) & (y >= margin) & (y < 60 - margin)
    near = ((x - 40).abs() <= margin) & ((y - 30).abs() <= margin)
    assert torch.equal(good, deep & ~near & (x != 60))


@pytest.mark.parametrize(
    ("bar", "holds", "text"),
    [
        (Bar("gain", 6.0, ">=", 6.0, "dB"), True, "gain: 6 dB, bar >= 6 dB: holds"),
        (Bar("gain", 5.9, ">=", 6.0, "dB"), False, "gain: 5.9 dB, bar >= 6 dB: DOES NOT HOLD"),
        (Bar("error", 0.003, "<=", 0.002, "px"), False, "error: 0.003 px, bar <= 0.002 px: DOES NOT HOLD"),
    ],
)
def test_a_bar_holds_on_its_side(bar, holds, text):
    assert bar.holds is holds
    assert str(bar) == text


def test_the_command_compares_the_frames_of_a_folder(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    pixels = (smooth_frame(*SIZE)[0].movedim(0, -1) * 255).round().byte().numpy()
    for name in ("a.png", "b.png", "c.png"):
        Image.fromarray(pixels).save(tmp_path / name)
    out = tmp_path / "results" / "run.json"
    monkeypatch.setattr(sys, "argv", ["one_resample.py", str(tmp_path), "--frames", "2", "--out", str(out)])
    one_resample.main()
    printed = capsys.readouterr().out
    assert "mean of 2" in printed
    content = json.loads(out.read_text())
    names = ["a.png", "a.png", "b.png", "b.png", *["a.png, rectified"] * 2, *["b.png, rectified"] * 2]
    means = ["mean of 2", "mean of 2", "mean of 2 rectified", "mean of 2 rectified"]
    assert [row["frame"] for row in content["rows"]] == [*names, *means]
    first, _, second, *_ = content["rows"]
    mean = content["rows"][len(names)]
    assert mean["gain_db"] == pytest.approx((first["gain_db"] + second["gain_db"]) / 2)
    assert len(content["bars"]) == 4
