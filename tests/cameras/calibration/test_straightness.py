import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.quality import rectified, straightness
from torchrefract.cameras.camera import Camera

BOARD = Chessboard(squares="9x7", square_mm=25)
MATRIX = np.array([[700.0, 0, 405.0], [0, 702.0, 297.0], [0, 0, 1]])
VECTOR = np.array([-0.2, 0.06, 0.002, -0.001])
CAMERA = Camera.from_opencv(MATRIX, VECTOR, width=800, height=600)


def test_a_pinhole_shows_straight_lines_straight(projected):
    assert straightness(projected(BOARD, MATRIX, np.zeros(4)), BOARD) < 1e-9


def test_noise_of_a_size_has_that_size(projected):
    assert straightness(projected(BOARD, MATRIX, np.zeros(4), noise=0.3), BOARD) == pytest.approx(0.3, rel=0.05)


def test_one_corner_off_its_line_counts_by_its_distance():
    # Of 0, d, 0 at -1, 0, 1 the best line is at d / 3: the squares sum to d^2 (1 + 4 + 1) / 9, with one to spare.
    view = View("", np.array([0, 1, 2]), np.array([[-1.0, 0], [0, 0.01], [1, 0]]))
    assert straightness([view], BOARD) == pytest.approx(0.01 * np.sqrt(6) / 3, rel=1e-3)


def test_a_camera_straightens_what_it_has_bent(projected):
    views = projected(BOARD, MATRIX, VECTOR)
    assert straightness(views, BOARD) > 0.5
    assert straightness(rectified(views, CAMERA), BOARD) < 1e-6


def test_two_corners_are_no_line():
    with pytest.raises(ValueError, match="views must have 3 corners of one row or column, got 1 views without"):
        straightness([View("", np.array([0, 1]), np.zeros((2, 2)))], BOARD)
