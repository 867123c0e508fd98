import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.fit import Lens, cross_validate, errors_in_best_pose, fit, rms

BOARD = Chessboard(squares="9x7", square_mm=25)
SIZE = (800, 600)
MATRIX = np.array([[700.0, 0, 405.0], [0, 702.0, 297.0], [0, 0, 1]])
VECTORS = {
    "opencv4": (-0.2, 0.06, 0.002, -0.001),
    "opencv5": (-0.2, 0.06, 0.002, -0.001, 0.01),
    "opencv8": (0.3, 0.05, 0.002, -0.001, 0.01, 0.5, 0.1, 0.02),
    "fisheye": (-0.03, 0.01, -0.005, 0.001),
}


@pytest.mark.parametrize("model", VECTORS)
def test_a_known_camera_is_found_from_exact_corners(model, projected):
    views = projected(BOARD, MATRIX, np.array(VECTORS[model]), fisheye=model == "fisheye")
    found = fit(views, BOARD, model=model, size=SIZE)
    assert found.rms < 1e-3  # corners go to OpenCV as float32
    np.testing.assert_allclose(found.intrinsics.values[:4], MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-4)
    if model != "opencv8":  # whose coefficients trade with one another
        np.testing.assert_allclose(found.intrinsics.values[4:], VECTORS[model], atol=1e-3)
    assert found.intrinsics.names[:5] == ("fx", "fy", "cx", "cy", "k1")
    assert len(found.intrinsics.names) == len(found.intrinsics.values) == 4 + len(VECTORS[model])


def test_rms_and_deviations_are_those_of_opencv(projected):
    views = projected(BOARD, MATRIX, np.array(VECTORS["opencv5"]), noise=0.2)
    found = fit(views, BOARD, model="opencv5", size=SIZE)
    objects = [BOARD.corners(view.ids).astype(np.float32) for view in views]
    images = [view.corners.astype(np.float32) for view in views]
    theirs = cv2.calibrateCameraExtended(objects, images, SIZE, np.eye(3), np.zeros(5))
    assert found.rms == pytest.approx(theirs[0], rel=1e-4)
    np.testing.assert_allclose(found.deviations, theirs[5].ravel()[:9], rtol=1e-2)
    per_view = [rms(errors) for errors in found.errors]
    np.testing.assert_allclose(per_view, theirs[7].ravel(), rtol=1e-2)


def test_deviations_tell_how_far_off_a_fisheye_is(projected):
    truth = np.concatenate([MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]], VECTORS["fisheye"]])
    views = projected(BOARD, MATRIX, np.array(VECTORS["fisheye"]), noise=0.2, fisheye=True)
    found = fit(views, BOARD, model="fisheye", size=SIZE)
    assert (np.abs(found.intrinsics.values - truth) < 4 * found.deviations).all()
    assert (np.abs(found.intrinsics.values - truth) > 0.01 * found.deviations).sum() >= 6


def test_a_view_that_was_held_out_is_seen_in_its_best_pose(projected):
    vector = np.array(VECTORS["opencv5"])
    (view, *_) = projected(BOARD, MATRIX, vector, noise=0.3)
    lens = Lens("opencv5", MATRIX, vector)
    solved, turn, move = cv2.solvePnP(BOARD.corners(view.ids), view.corners, MATRIX, vector)
    turn, move = cv2.solvePnPRefineLM(BOARD.corners(view.ids), view.corners, MATRIX, vector, turn, move)
    theirs = view.corners - cv2.projectPoints(BOARD.corners(view.ids), turn, move, MATRIX, vector)[0].reshape(-1, 2)
    start = np.concatenate([turn.ravel() + 0.05, move.ravel() + 5])
    assert solved
    np.testing.assert_allclose(errors_in_best_pose(view, BOARD, lens, start), theirs, atol=1e-3)


def test_errors_held_out_are_larger_than_those_of_a_fit(projected):
    views = projected(BOARD, MATRIX, np.array(VECTORS["opencv5"]), noise=0.3)
    found = fit(views, BOARD, model="opencv5", size=SIZE)
    held = cross_validate(views, BOARD, found, size=SIZE, folds=3)
    assert [len(errors) for errors in held] == [len(view.ids) for view in views]
    # Noise of 0.3 px in x and in y.
    assert found.rms < rms(np.concatenate(held)) < 1.3 * 0.3 * np.sqrt(2)
    assert found.rms == pytest.approx(0.3 * np.sqrt(2), rel=0.1)


def test_two_views_are_too_few(projected):
    views = projected(BOARD, MATRIX, np.array(VECTORS["opencv5"]))[:2]
    with pytest.raises(ValueError, match="views must be at least 3, got 2"):
        fit(views, BOARD, model="opencv5", size=SIZE)


def test_a_fit_has_the_same_bits_every_time_and_leaves_opencv_its_threads(projected):
    views = projected(BOARD, MATRIX, np.array(VECTORS["opencv5"]), noise=0.2)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        found = {fit(views, BOARD, model="opencv5", size=SIZE).intrinsics.matrix.tobytes() for _ in range(15)}
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert len(found) == 1
