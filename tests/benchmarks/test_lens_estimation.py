import math
from dataclasses import replace
from statistics import fmean

import lens_estimation
import numpy as np
import pytest
import severity
import torch
from pictures import save_picture

from torchrefract.data.frames import FrameFolder
from torchrefract.data.video import read_video
from torchrefract.fields.rectification import camera_flow
from torchrefract.presets import cheap_dashcam


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


def poles(height: int, width: int) -> np.ndarray:
    """Return a picture (H, W, 3) of vertical and horizontal straight edges all over it."""
    picture = np.full((height, width, 3), 60, np.uint8)
    for x in range(20, width, 60):
        picture[:, x : x + 25] = 200
    picture[height - 40 : height - 20] = 120
    picture[20:40] = 120
    return picture


def test_lines_of_one_frame_choose_among_the_lenses_of_an_effect():
    effect, size = cheap_dashcam(), (216, 384)
    prior = lens_estimation.draw_prior(effect, size, count=64)
    assert prior.lenses.shape == (64, 2)
    flow = lens_estimation.posterior_flow(lens_estimation.costs_of_lenses([np.zeros(size, np.uint8)], prior), prior)
    torch.testing.assert_close(flow, prior.flows.mean(dim=0))  # a frame without edges tells nothing
    clean = torch.from_numpy(poles(*size)).permute(2, 0, 1)[None] / 255
    degraded = effect.degrade(clean, seed=1, keys=[5])
    costs = lens_estimation.costs_of_lenses([severity.gray_levels(degraded.image[0])], prior)
    flow = lens_estimation.posterior_flow(costs, prior)
    true = lens_estimation.sparse(degraded.restore_flow)[0]
    assert (flow - true).norm(dim=0).mean() < 0.25 * (prior.flows.mean(dim=0) - true).norm(dim=0).mean()


def test_held_out_frames_leave_out_drives_whose_lens_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lens_estimation, "_NUM_LENSES", 8)
    for name in ("train/a_1.png", "val/b_1.png", "val/bent_1.png"):
        save_picture(tmp_path / name, poles(144, 256))
    rows = lens_estimation.held_out(tmp_path, (144, 256), without=("bent_",))
    assert [row["frame"] for row in rows] == ["val/b_1.png"] * 4
    assert len({row["nothing"] for row in rows}) == 4  # lenses
    assert rows[0]["lines"] < 0.5 * min(rows[0]["constant"], rows[0]["nothing"])
    lines, constant, nothing = (fmean(row[kind] for row in rows) for kind in ("lines", "constant", "nothing"))
    assert lines < 0.5 * min(constant, nothing)
    assert "4 lenses of 1 frames" in capsys.readouterr().out


def test_a_network_that_is_right_improves_on_the_lines_of_a_frame(tmp_path, monkeypatch):
    monkeypatch.setattr(lens_estimation, "_NUM_LENSES", 32)
    monkeypatch.setattr(lens_estimation, "_NUM_DRAWS", 1)
    for name in ("train/a_1.png", "val/b_1.png"):
        save_picture(tmp_path / name, np.zeros((144, 256, 3), np.uint8))  # no lines
    frames = FrameFolder(tmp_path, size=(144, 256), split="val")
    true = cheap_dashcam().degrade(frames[0].image[None], seed=0, keys=[frames.keys[0]]).restore_flow
    network = lens_estimation.Network(lambda _: true, true)
    (row,) = lens_estimation.held_out(tmp_path, (144, 256), network=network)
    assert row["network"] == pytest.approx(0, abs=1e-3)
    assert row["both"] < 0.7 * row["lines"]


def test_pooled_frames_of_a_drive_have_one_lens_and_tell_more_of_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lens_estimation, "_NUM_LENSES", 32)
    monkeypatch.setattr(lens_estimation, "_NUM_POOLED_LENSES", 32)
    for name in ("train/a_1.png", "val/b_1.png", "val/b_2.png"):
        picture = poles(144, 256) if name == "val/b_1.png" else np.zeros((144, 256, 3), np.uint8)  # without lines
        save_picture(tmp_path / name, picture)
    alone = lens_estimation.held_out(tmp_path, (144, 256))
    pooled = lens_estimation.held_out(tmp_path, (144, 256), pool=True)
    assert [row["frame"] for row in pooled] == ["b"] * 4
    # The drive is seen through the lenses of its first frame, to whose picture the other one adds nothing.
    for together, first in zip(pooled, alone[:4], strict=True):
        assert together["nothing"] == pytest.approx(first["nothing"])
        assert together["lines"] == pytest.approx(first["lines"], rel=0.05)
    assert fmean(row["lines"] for row in pooled) < 0.5 * fmean(row["lines"] for row in alone[4:])
    assert "4 lenses of 1 drives" in capsys.readouterr().out
