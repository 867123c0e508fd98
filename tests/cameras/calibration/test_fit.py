from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.fit import (
    LENS_MODELS,
    camera_values,
    cross_validate,
    drop_outliers,
    errors_in_best_pose,
    fit_camera,
    leave_each_out,
    project,
    rms,
    with_values,
)
from torchrefract.cameras.camera import Camera

BOARD = Chessboard(squares="9x7", square_mm=25)
SIZE = (800, 600)
PINHOLE = Camera(width=800, height=600, fx=700.0, fy=702.0, cx=405.0, cy=297.0, coefficients=(0.0,) * 4)
_RATIONAL = (0.3, 0.05, 0.002, -0.001, 0.01, 0.5, 0.1, 0.02)
CAMERAS = {
    "opencv0": PINHOLE,
    "opencv1": replace(PINHOLE, coefficients=(-0.2, 0.0, 0.0, 0.0)),
    "opencv2": replace(PINHOLE, coefficients=(-0.2, 0.06, 0.0, 0.0)),
    "opencv4": replace(PINHOLE, coefficients=(-0.2, 0.06, 0.002, -0.001)),
    "opencv5": replace(PINHOLE, coefficients=(-0.2, 0.06, 0.002, -0.001, 0.01)),
    "opencv8": replace(PINHOLE, coefficients=_RATIONAL),
    "opencv12": replace(PINHOLE, coefficients=(*_RATIONAL, 0.001, -0.001, 0.002, 0.001)),
    "opencv14": replace(PINHOLE, coefficients=(*_RATIONAL, 0.001, -0.001, 0.002, 0.001, 0.02, -0.01)),
    "fisheye1": replace(PINHOLE, coefficients=(-0.03, 0.0, 0.0, 0.0), model="fisheye"),
    "fisheye2": replace(PINHOLE, coefficients=(-0.03, 0.01, 0.0, 0.0), model="fisheye"),
    "fisheye": replace(PINHOLE, coefficients=(-0.03, 0.01, -0.005, 0.001), model="fisheye"),
    "division": replace(PINHOLE, coefficients=(-0.2,), model="division"),
}


@pytest.fixture(scope="module")
def noisy(projected):
    """Return views of opencv5 with noise of 0.3 px in x and in y."""
    return projected(BOARD, CAMERAS["opencv5"], noise=0.3)


@pytest.mark.quick
@pytest.mark.parametrize("model", LENS_MODELS)
def test_exact_corners_give_the_exact_camera(model, projected):
    fit = fit_camera(projected(BOARD, CAMERAS[model]), BOARD, model=model, size=SIZE)
    assert fit.rms < 1e-3  # corners go to OpenCV as float32
    np.testing.assert_allclose(fit.values[:4], (700, 702, 405, 297), rtol=1e-4)
    if model not in ("opencv8", "opencv12", "opencv14"):  # their coefficients are strongly correlated
        np.testing.assert_allclose(fit.values[4:], CAMERAS[model].coefficients, atol=1e-3)
    assert fit.names[:5] == ("fx", "fy", "cx", "cy", "k" if model == "division" else "k1")
    assert len(fit.names) == len(fit.values) == 4 + len(CAMERAS[model].coefficients)
    assert fit.camera.model == CAMERAS[model].model


def test_slopes_of_the_division_model_match_central_differences():
    camera, pose, points = CAMERAS["division"], np.array([0.2, -0.3, 0.1, -90.0, -70.0, 300.0]), BOARD.corners()
    pixels, pose_slopes, slopes = project(camera, pose, points)
    turned = points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
    np.testing.assert_allclose(pixels, camera.project(torch.from_numpy(turned)).points, atol=1e-9)
    steps = 1e-5 * np.eye(11)

    def at(step):
        return project(with_values(camera, camera_values(camera) + step[6:]), pose + step[:6], points)[0].ravel()

    expected = np.stack([(at(step) - at(-step)) / 2e-5 for step in steps], axis=1)
    np.testing.assert_allclose(np.hstack([pose_slopes, slopes]), expected, rtol=1e-6, atol=1e-5)


def test_errors_and_deviations_match_opencv(noisy):
    fit = fit_camera(noisy, BOARD, model="opencv5", size=SIZE)
    objects = [BOARD.corners(view.ids).astype(np.float32) for view in noisy]
    images = [view.corners.astype(np.float32) for view in noisy]
    theirs = cv2.calibrateCameraExtended(objects, images, SIZE, np.eye(3), np.zeros(5))
    assert fit.rms == pytest.approx(theirs[0], rel=1e-4)
    np.testing.assert_allclose(fit.deviations, theirs[5].ravel()[:9], rtol=1e-2)
    np.testing.assert_allclose([rms(errors) for errors in fit.errors], theirs[7].ravel(), rtol=1e-2)


def test_deviations_of_a_fisheye_match_its_errors(projected):
    exact = (700, 702, 405, 297, *CAMERAS["fisheye"].coefficients)
    views = projected(BOARD, CAMERAS["fisheye"], noise=0.2)
    fit = fit_camera(views, BOARD, model="fisheye", size=SIZE)
    assert (np.abs(fit.values - exact) < 4 * fit.deviations).all()
    assert (np.abs(fit.values - exact) > 0.01 * fit.deviations).sum() >= 6


def test_the_best_pose_matches_opencv(noisy):
    camera, view = CAMERAS["opencv5"], noisy[0]
    corners, lens = BOARD.corners(view.ids), (np.array(camera.matrix), np.array(camera.coefficients))
    _, turn, move = cv2.solvePnP(corners, view.corners, *lens)
    turn, move = cv2.solvePnPRefineLM(corners, view.corners, *lens, turn, move)
    theirs = view.corners - cv2.projectPoints(corners, turn, move, *lens)[0].reshape(-1, 2)
    start = np.concatenate([turn.ravel() + 0.05, move.ravel() + 5])
    errors = errors_in_best_pose(view, BOARD, camera, start)
    np.testing.assert_allclose(errors, theirs, atol=1e-3)


def test_errors_of_held_out_views_are_larger_than_those_of_the_fit(noisy):
    fit = fit_camera(noisy, BOARD, model="opencv5", size=SIZE)
    held_out = cross_validate(noisy, BOARD, fit, folds=3)
    assert [len(errors) for errors in held_out] == [len(view.ids) for view in noisy]
    assert fit.rms < rms(np.concatenate(held_out)) < 1.3 * 0.3 * np.sqrt(2)
    assert fit.rms == pytest.approx(0.3 * np.sqrt(2), rel=0.1)


def test_two_views_are_too_few(noisy):
    with pytest.raises(ValueError, match="views must be at least 3, got 2"):
        fit_camera(noisy[:2], BOARD, model="opencv5", size=SIZE)


def test_a_fit_is_reproducible_and_restores_the_threads_of_opencv(noisy):
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        cameras = {fit_camera(noisy, BOARD, model="opencv5", size=SIZE).camera for _ in range(8)}
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert len(cameras) == 1


def bend(view):
    """Shift the corners as on a board that sags by 8 px."""
    x = view.corners[:, 0]
    t = 2 * (x - x.min()) / (x.max() - x.min()) - 1
    return view._replace(corners=view.corners + np.stack([0 * x, 8 * (1 - t**2)], axis=1))


def test_no_view_of_a_good_set_is_dropped(noisy):
    selection = drop_outliers(noisy, BOARD, model="opencv5", size=SIZE)
    assert selection.dropped == {}
    assert [view.name for view in selection.views] == [view.name for view in noisy]
    assert [result.others for result in selection.ranking] == sorted(result.others for result in selection.ranking)


def test_bent_views_are_dropped_with_a_reason(noisy):
    mixed = [bend(view) if i in (0, 7) else view for i, view in enumerate(noisy)]
    selection = drop_outliers(mixed, BOARD, model="opencv5", size=SIZE)
    assert set(selection.dropped) == {noisy[0].name, noisy[7].name}
    good = fit_camera([view for i, view in enumerate(noisy) if i not in (0, 7)], BOARD, model="opencv5", size=SIZE)
    np.testing.assert_allclose(selection.fit.values, good.values, rtol=1e-6)
    assert all(reason.startswith("its error is ") for reason in selection.dropped.values())
    assert len(drop_outliers(mixed, BOARD, model="opencv5", size=SIZE, max_share=0.15).dropped) == 1
    assert drop_outliers(mixed, BOARD, model="opencv5", size=SIZE, max_share=0.0).dropped == {}


def test_leaving_a_view_out_is_a_fit_to_the_others(noisy):
    result = leave_each_out(noisy, BOARD, fit_camera(noisy, BOARD, model="opencv5", size=SIZE))[3]
    others = fit_camera(noisy[:3] + noisy[4:], BOARD, model="opencv5", size=SIZE)
    assert result.name == noisy[3].name
    assert result.others == pytest.approx(others.rms, rel=1e-5)
    assert result.median == pytest.approx(float(np.median([rms(errors) for errors in others.errors])), rel=1e-4)
    assert result.limit >= 3 * result.median
