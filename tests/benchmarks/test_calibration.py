import json
from dataclasses import replace

import calibration
import numpy as np
import pytest

from torchrefract import Camera
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.lens_database import read_lenses

WEBCAM = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=24.0, coefficients=(-0.33, 0.05, 1e-3, -2e-3, 0.06))
FISHEYE = replace(WEBCAM, fx=25.0, fy=25.0, coefficients=(-0.02, 0.05, -0.05, 0.01), model="fisheye")


def table_row(name: str, camera: Camera, model: str, licence: str) -> dict:
    numbers = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    source = {"source_repo": "a/b", "source_path": "c.yaml", "commit": "1234", "camera": "Webcam", "lens": None}
    return {"id": name, "model": model, "coeffs": camera.coefficients, "licence": licence} | numbers | source


def test_errors_of_lenses_are_measured_and_the_table_is_written(monkeypatch, tmp_path, run_program):
    # A ray of a pixel 1 px off has an error of 1 px.
    pixels = WEBCAM.grid(4)
    rays = WEBCAM.unproject(pixels + pixels.new_tensor([0.6, 0.8])).points
    assert calibration.forward_error(WEBCAM, rays.numpy(), pixels.numpy()) == pytest.approx(np.ones(16), abs=1e-9)
    view = View("a", np.arange(8), np.random.default_rng(0).uniform(0, 99, (8, 2)))
    off = np.linalg.norm(calibration.bad_corners(view, (101, 201))["one off"].corners - view.corners, axis=1)
    assert sorted(off.round(9)) == [0] * 7 + [5]
    rows = [
        table_row("one", WEBCAM, "opencv5", "MIT"),
        table_row("two", FISHEYE, "fisheye4", "CC0-1.0"),
        table_row("shared", WEBCAM, "opencv5", "CC-BY-SA-3.0 (x)"),
    ]
    (tmp_path / "lenses.json").write_text(json.dumps(rows))
    options = ["lenses", "lenses.json", "--step", "16", "--out", "run.json", "--table", "lenses.csv"]
    monkeypatch.chdir(tmp_path)
    assert "not marked: ours 0 and OpenCV 2 of 3, kornia 2 of 2" in run_program(calibration, *options)
    results = json.loads((tmp_path / "run.json").read_text())
    assert [(row["name"], row["ours_wrong"], row["invalid"]) for row in results] == [(row["id"], 0, 0) for row in rows]
    lenses = read_lenses(tmp_path / "lenses.csv")
    assert [(lens.name, lens.camera) for lens in lenses] == [("one", WEBCAM), ("two", FISHEYE)]
    assert lenses[1].source == "a/b@1234: c.yaml"
