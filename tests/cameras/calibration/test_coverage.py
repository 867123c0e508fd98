from dataclasses import replace

import numpy as np

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import fit
from torchrefract.cameras.calibration.quality import coverage, doubts
from torchrefract.cameras.camera import Camera

BOARD = Chessboard(squares="9x7", square_mm=25)
MATRIX = np.array([[700.0, 0, 405.0], [0, 702.0, 297.0], [0, 0, 1]])
CAMERA = Camera.from_opencv(MATRIX, [-0.2, 0.06, 0.002, -0.001], width=800, height=600)


def test_corners_are_counted_in_their_parts_of_the_frame():
    # Pixel centers are whole numbers: the frame begins at -0.5, and its first part of 100 px ends at 99.5.
    view = View("", np.arange(4), np.array([[-0.4, -0.4], [99.4, 99.4], [99.6, 0.0], [799.4, 599.4]]))
    counts = coverage([view], (800, 600))
    assert counts.shape == (6, 8)
    assert (counts[0, 0], counts[0, 1], counts[5, 7], counts.sum()) == (2, 1, 1, 4)


def test_what_is_not_known_is_told(projected):
    views = projected(BOARD, MATRIX, np.array(CAMERA.coefficients), noise=0.2)
    fitted = fit(views, BOARD, model="opencv14", size=(800, 600))
    found = " ".join(doubts(views, fitted, replace(CAMERA, coefficients=(-0.9, 0.0, 0.0, 0.0))))
    assert "cannot be told from zero: " in found
    assert "tau_x" in found
    assert "The model folds back inside the frame: " in found
    middle = [view._replace(corners=400 + 0.2 * (view.corners - 400)) for view in views]
    assert any("left (6 of 6 parts)" in doubt for doubt in doubts(middle, fitted, CAMERA))


def test_a_good_set_leaves_no_doubt(projected):
    wide = np.array([[400.0, 0, 405.0], [0, 400.0, 297.0], [0, 0, 1]])
    views = [
        view._replace(corners=view.corners * (s, s) - (405 * (s - 1), 297 * (s - 1)))
        for s in (1.0, 1.6)
        for view in projected(BOARD, wide, np.zeros(4), noise=0.0)
    ]
    views = [view._replace(corners=view.corners[i], ids=view.ids[i]) for view in views for i in [inside(view.corners)]]
    fitted = fit(projected(BOARD, MATRIX, np.array(CAMERA.coefficients)), BOARD, model="opencv4", size=(800, 600))
    assert doubts(views, fitted, CAMERA) == []


def inside(corners: np.ndarray) -> np.ndarray:
    return np.flatnonzero(np.logical_and(corners >= 0, corners < (800, 600)).all(axis=1))
