import math
from dataclasses import replace

import lens_estimation
import pytest
import torch

from torchrefract.data.video import read_video
from torchrefract.fields.rectification import camera_flow


def test_errors_are_in_px_of_a_frame_1920_px_wide_and_grow_with_the_lens():
    truth = lens_estimation.to_camera(torch.tensor([-0.16, 0.06]), (54, 96))
    assert lens_estimation.errors(truth, truth)[0] == 0
    moved = replace(truth, cx=truth.cx + 0.1, coefficients=(0.0,) * 4)
    none = replace(truth, coefficients=(0.0,) * 4)
    assert lens_estimation.errors(moved, none)[0] == pytest.approx(0, abs=1e-9)  # a pinhole's center does not show
    error, nothing = lens_estimation.errors(none, truth)
    assert error == pytest.approx(nothing)
    half = lens_estimation.errors(lens_estimation.to_camera(torch.tensor([-0.08, 0.03]), (54, 96)), truth)[0]
    assert half == pytest.approx(nothing / 2)


def test_rendered_roads_have_the_size_of_the_camera(monkeypatch):
    monkeypatch.setattr(lens_estimation, "_NUM_RENDERED", 1)
    monkeypatch.setattr(lens_estimation, "_RENDERED_SIZE", (54, 96))
    (frame,), camera = lens_estimation.rendered((-0.16, 0.06))
    assert frame.shape == (1, 3, camera.height, camera.width) == (1, 3, 54, 96)
    assert frame.std() > 0.05


def test_a_network_that_sees_the_lens_has_rows_without_an_error():
    size, truth = (54, 96), lens_estimation.to_camera(torch.tensor([-0.16, 0.06]), (54, 96))
    flow = camera_flow(truth)[0]
    network = lens_estimation.Network(lambda frame: flow, torch.zeros(1, 2, *size))
    rows, _ = lens_estimation.measure("gray", [torch.full((1, 3, *size), 0.5)] * 2, truth, network=network)
    errors = {row.method: row.error for row in rows if row.frames == 2}
    assert errors["network"] < 0.1
    assert errors["both"] < 0.5 * rows[0].nothing
    assert errors["constant"] == pytest.approx(rows[0].nothing)
    assert errors["lines"] > 0.5 * rows[0].nothing


def test_a_clip_pans_behind_a_lens_that_stays_and_jitter_is_in_px_of_1920(tmp_path, monkeypatch):
    monkeypatch.setattr(lens_estimation, "_RENDERED_SIZE", (54, 96))
    lens_estimation.render_clip(3, tmp_path / "clip.mp4")
    first, second, third = (frame for _, frame in read_video(tmp_path / "clip.mp4", range(3)))
    assert first.shape == (1, 3, 54, 96)
    assert (first - second).abs().mean() > 0.02
    assert (second - third).abs().mean() > 0.02
    flows = [torch.zeros(1, 2, 54, 96), torch.full((1, 2, 54, 96), 3.0), torch.full((1, 2, 54, 96), 3.0)]
    assert lens_estimation.jitter(flows) == pytest.approx((1920 / 96) * math.hypot(3, 3) / 2)
