from dataclasses import replace

import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.choice import Candidate
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import fit_camera
from torchrefract.cameras.calibration.report import (
    calibration_warnings,
    camera_warnings,
    corner_counts,
    straightness,
    undistort_views,
)
from torchrefract.cameras.camera import Camera

BOARD = Chessboard(squares="9x7", square_mm=25)
PINHOLE = Camera(width=800, height=600, fx=700.0, fy=702.0, cx=405.0, cy=297.0, coefficients=(0.0,) * 4)
CAMERA = replace(PINHOLE, coefficients=(-0.2, 0.06, 0.002, -0.001))


def test_corners_are_counted_in_cells_of_the_frame():
    # Pixel centers are whole numbers: the frame begins at -0.5, and its first cell of 100 px ends at 99.5.
    view = View("", np.arange(4), np.array([[-0.4, -0.4], [99.4, 99.4], [99.6, 0.0], [799.4, 599.4]]))
    counts = corner_counts([view], (800, 600))
    assert counts.shape == (6, 8)
    assert (counts[0, 0], counts[0, 1], counts[5, 7], counts.sum()) == (2, 1, 1, 4)


def test_vague_coefficients_folds_and_empty_sides_are_warned_of(projected):
    views = projected(BOARD, CAMERA, noise=0.2)
    fit = fit_camera(views, BOARD, model="opencv14", size=(800, 600))
    folding = replace(CAMERA, coefficients=(-0.9, *(0.0,) * 13))
    text = " ".join(calibration_warnings(views, fit._replace(camera=folding)))
    assert "zero within two standard deviations: " in text
    assert "tau_x" in text
    assert "The model folds back inside the frame: " in text
    middle = [view._replace(corners=400 + 0.2 * (view.corners - 400)) for view in views]
    assert any("left (6 of 6 cells)" in message for message in calibration_warnings(middle, fit))


def test_fewer_coefficients_are_not_suggested_of_a_model_that_held_out_views_chose(projected):
    views = projected(BOARD, CAMERA, noise=0.2)
    fit = fit_camera(views, BOARD, model="opencv14", size=(800, 600))
    chosen = Candidate("opencv14", "none", 14, 0.2, 0.0, 0.0, "")
    assert any("fewer coefficients" in message for message in calibration_warnings(views, fit))
    assert not any("fewer coefficients" in message for message in calibration_warnings(views, fit, [chosen]))


def test_a_good_calibration_has_no_warnings(projected):
    fit = fit_camera(projected(BOARD, CAMERA), BOARD, model="opencv4", size=(800, 600))
    x, y = np.meshgrid(np.arange(10, 800, 20.0), np.arange(10, 600, 20.0))
    everywhere = View("", np.arange(x.size), np.stack([x.ravel(), y.ravel()], axis=1))
    assert calibration_warnings([everywhere], fit) == []


def test_a_pole_is_warned_of():
    (message,) = camera_warnings(replace(CAMERA, coefficients=(0.0,) * 5 + (-6.0, 0.0, 0.0)))[-1:]
    assert message.startswith("The model has a pole inside the frame: camera must keep its denominator")


def test_straightness_is_the_noise_of_a_pinhole(projected):
    assert straightness(projected(BOARD, PINHOLE), BOARD) < 1e-9
    assert straightness(projected(BOARD, PINHOLE, noise=0.3), BOARD) == pytest.approx(0.3, rel=0.05)


def test_one_corner_off_its_line_counts_by_its_distance():
    # Of 0, d, 0 at -1, 0, 1 the best line is at d / 3: the squares sum to d^2 (1 + 4 + 1) / 9, with one to spare.
    view = View("", np.array([0, 1, 2]), np.array([[-1.0, 0], [0, 0.01], [1, 0]]))
    assert straightness([view], BOARD) == pytest.approx(0.01 * np.sqrt(6) / 3, rel=1e-3)


def test_undistorted_corners_lie_on_straight_lines(projected):
    views = projected(BOARD, CAMERA)
    assert straightness(views, BOARD) > 0.5
    assert straightness(undistort_views(views, CAMERA), BOARD) < 1e-6


def test_two_corners_are_not_a_line():
    with pytest.raises(ValueError, match="views must have 3 corners of one row or column, got 1 views without"):
        straightness([View("", np.array([0, 1]), np.zeros((2, 2)))], BOARD)
