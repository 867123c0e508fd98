import json
import sys
from dataclasses import replace

import lenses
import numpy as np
import pytest
import torch

from torchrefract import Camera
from torchrefract.cameras.lens_database import read_lenses

WEBCAM = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=24.0, coefficients=(-0.33, 0.05, 1e-3, -2e-3, 0.06))
FISHEYE = replace(WEBCAM, fx=25.0, fy=25.0, coefficients=(-0.02, 0.05, -0.05, 0.01), model="fisheye")
NUMBERS = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 24.0}
WORDS = {"camera": "Webcam", "lens": None, "source_repo": "a/b", "source_path": "c.yaml", "commit": "1234"}
ROWS = [
    {"id": "one", "model": "opencv5", "coeffs": WEBCAM.coefficients, "licence": "MIT", **NUMBERS, **WORDS},
    {"id": "two", "model": "fisheye4", "coeffs": [-0.02, 0.05, -0.04, 0.01], "licence": "CC0-1.0", **NUMBERS, **WORDS},
    {"id": "shared", "model": "opencv5", "coeffs": [-0.1] * 5, "licence": "CC-BY-SA-3.0 (x)", **NUMBERS, **WORDS},
    {"id": "bare", "model": "pinhole", "coeffs": [], "licence": "MIT", **NUMBERS, **WORDS},
]


def test_a_frame_is_looked_at_from_border_to_border():
    pixels = lenses.lattice(WEBCAM, 10)
    assert pixels[:, 0].unique().tolist() == [0, 10, 20, 30, 40, 50, 60, 63]
    assert pixels[:, 1].unique().tolist() == [0, 10, 20, 30, 40, 47]


@pytest.mark.parametrize("camera", [WEBCAM, FISHEYE], ids=["opencv", "fisheye"])
def test_a_ray_that_is_a_pixel_off_is_a_pixel_off(camera):
    pixels = lenses.lattice(camera, 16)
    rays = camera.unproject(pixels + torch.tensor([0.6, 0.8], dtype=torch.float64))
    assert rays.valid.all()
    error = lenses.forward_error(camera, rays.points.numpy(), pixels.numpy())
    assert error == pytest.approx(np.ones(len(pixels)), abs=1e-9)


def test_what_others_leave_is_counted():
    row = lenses.inverse_row("webcam", WEBCAM, step=4)
    assert (row.wrong, row.invalid) == (0, 0)
    assert row.largest_px < 1e-9
    assert row.opencv_px > 1e-3
    assert row.kornia_px == pytest.approx(row.opencv_px, rel=0.1)  # the same five steps
    assert row.opencv_wrong > 0.1


def test_a_fisheye_is_compared_where_a_plane_shows_it():
    wide = replace(FISHEYE, fx=14.0, fy=14.0)
    assert wide.unproject(wide.grid(3)).points[:, 2].min() < 0
    row = lenses.inverse_row("wide", wide, step=4)
    assert row.kornia_px is None
    assert (row.wrong, row.opencv_wrong) == (0, 0)


def test_the_command_prints_both_tables_and_writes_the_csv(monkeypatch, tmp_path, capsys):
    table, out, made = tmp_path / "lenses.json", tmp_path / "run.json", tmp_path / "lenses.csv"
    table.write_text(json.dumps(ROWS))
    words = [str(table), "--step", "16", "--out", str(out), "--table", str(made)]
    monkeypatch.setattr(sys, "argv", ["lenses.py", *words])
    lenses.main()
    printed = capsys.readouterr().out
    assert "3 lenses with focal length and coefficients, 1 rows without" in printed
    assert "of 3 lenses wrong somewhere and not marked: 0 here, 2 by OpenCV; of 2 by kornia 2" in printed
    content = json.loads(out.read_text())
    assert [row["name"] for row in content["inverses"]] == ["one", "two", "shared"]
    assert content["conversions"]["two"]["opencv"]["max_px"] < 0.1
    kept = read_lenses(made)
    assert [lens.name for lens in kept] == ["one", "two"]
    assert kept[0].camera == WEBCAM
    assert kept[1].source == "a/b@1234: c.yaml"
    assert kept[1].residual_px > 0
