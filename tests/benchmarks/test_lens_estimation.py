from dataclasses import replace

import lens_estimation
import pytest
import torch


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
    (gray,), camera = lens_estimation.rendered((-0.16, 0.06))
    assert gray.shape == (camera.height, camera.width) == (54, 96)
    assert gray.std() > 10
