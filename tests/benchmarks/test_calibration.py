import json
import sys

import calibration
import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.synthetic import render_views
from torchrefract.cameras.camera import Camera

CAMERA = Camera(
    width=640, height=400, fx=380.0, fy=381.0, cx=322.3, cy=196.6, coefficients=(-0.25, 0.08, 0.003, -0.002)
)
BOARD = Charuco(squares="6x5", square_mm=30, marker_mm=20, dictionary="DICT_4X4_50")
WORDS = {"squares_x": 6, "squares_y": 5, "square_m": 0.03, "marker_m": 0.02, "dictionary": "DICT_4X4_50"}


def test_a_board_is_that_of_its_entry():
    assert calibration.board_of({"board": WORDS}) == BOARD
    entry = {"pattern_inner_corners": [9, 6], "square_m": 0.05}
    assert calibration.board_of(entry) == Chessboard(squares="10x7", square_mm=50.0)


def test_bad_corners_are_as_bad_as_they_are_said_to_be():
    corners = np.random.default_rng(0).uniform(0, 99, (8, 2))
    bad = calibration.bad_corners(View("a", np.arange(8), corners), (101, 201))
    np.testing.assert_allclose(bad["enlarged"].corners - (50, 100), 1.1 * (corners - (50, 100)))
    moved = np.linalg.norm(bad["one off"].corners - corners, axis=1)
    assert sorted(moved.round(9)) == [0] * 7 + [5]
    different = np.flatnonzero((bad["swapped"].corners != corners).any(axis=1))
    np.testing.assert_array_equal(bad["swapped"].corners[different], corners[different[::-1]])
    assert len(different) == 2


def test_a_set_is_measured_beside_opencv_and_bad_views_are_planted(monkeypatch, tmp_path, capsys):
    folder = tmp_path / "charuco" / "rendered"
    folder.mkdir(parents=True)
    for name, gray, _ in render_views(BOARD, CAMERA, count=7):
        cv2.imwrite(str(folder / name), gray)
    entry = {"board": WORDS, "image_size": [640, 400], "published": {"fx": 380.0}}
    (tmp_path / "charuco" / "reference.json").write_text(json.dumps({"rendered": entry}))
    (tmp_path / "chessboard").mkdir()
    (tmp_path / "chessboard" / "reference.json").write_text("{}")
    out = tmp_path / "run.json"
    monkeypatch.setattr(sys, "argv", ["calibration.py", str(tmp_path), "--out", str(out)])
    calibration.main()
    (row,) = json.loads(out.read_text())
    assert (row["name"], row["pictures"], row["views"], row["plain_views"]) == ("rendered", 7, 7, 7)
    assert row["fx"] == pytest.approx(380, rel=5e-3)
    assert row["reference_fx_percent"] == pytest.approx(100 * (row["fx"] / 380 - 1))
    assert 0 < row["rms"] < row["plain_rms"] < 0.3
    assert row["straight"] < 0.2 < row["bent"]
    assert row["planted"]["bent"] == row["planted"]["swapped"] == row["planted"]["one off"] == "named"
    assert row["planted"]["mirrored"] == "no view"
    assert "rendered" in capsys.readouterr().out
