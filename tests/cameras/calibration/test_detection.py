import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration import detection
from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import View, detect, has_enough_corners
from torchrefract.cameras.calibration.synthetic import render_views


def expected(camera, board, view, pose) -> np.ndarray:
    matrix, vector = np.array(camera.matrix), np.array(camera.coefficients)
    return cv2.projectPoints(board.corners(view.ids), pose[:3], pose[3:], matrix, vector)[0].reshape(-1, 2)


def error(found, true) -> float:
    return float(np.sqrt(((found - true) ** 2).sum(axis=1).mean()))


def test_corners_are_found_to_a_tenth_of_a_pixel(rendered, small_board, small_camera):
    for name, gray, pose in rendered:
        view = detect(gray, small_board, name=name)
        assert view.name == name
        assert has_enough_corners(view, small_board)
        assert error(view.corners, expected(small_camera, small_board, view, pose)) < 0.1


def test_a_chessboard_is_found_up_to_half_a_turn(small_camera):
    board = Chessboard(squares="7x6", square_mm=30)
    _, gray, pose = next(render_views(board, small_camera, count=1))
    view = detect(gray, board)
    true = expected(small_camera, board, view, pose)
    assert len(view.ids) == 30
    assert min(error(view.corners, true), error(view.corners, true[::-1])) < 0.1


@pytest.mark.parametrize("squares", ["6x5", "5x6"])
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
def test_pattern_and_colors_need_not_be_said(squares, legacy, inverted, small_camera):
    known = {"squares": squares, "square_mm": 30, "marker_mm": 20, "dictionary": "DICT_4X4_50"}
    shown = Charuco(**known, legacy=legacy, inverted=inverted)
    _, gray, pose = next(render_views(shown, small_camera, count=1))
    view = detect(gray, Charuco(**known))
    assert has_enough_corners(view, shown)
    assert error(view.corners, expected(small_camera, shown, view, pose)) < 0.1
    other = Charuco(**known, inverted=not inverted)
    assert len(detect(gray, other).ids) == 0


def test_corners_behind_a_finger_are_left_out(rendered, small_board, small_camera):
    _, gray, pose = rendered[0]
    whole = detect(gray, small_board)
    middle = whole.corners.mean(axis=0)
    covered = np.abs(whole.corners - middle).max(axis=1) < 40
    x, y = middle.round().astype(int)
    hidden = gray.copy()
    hidden[y - 45 : y + 46, x - 45 : x + 46] = 130
    view = detect(hidden, small_board)
    assert covered.sum() >= 2
    assert not set(whole.ids[covered].tolist()) & set(view.ids.tolist())
    assert error(view.corners, expected(small_camera, small_board, view, pose)) < 0.15


def test_an_overexposed_chessboard_keeps_its_corners(small_camera):
    board = Chessboard(squares="7x6", square_mm=30)
    _, gray, pose = next(render_views(board, small_camera, count=1))
    bloomed = cv2.dilate(gray, np.ones((7, 7), np.uint8))  # white squares grow, so that black ones do not touch
    view = detect(bloomed, board)
    ways = [expected(small_camera, board, view._replace(ids=ids), pose) for ids in (view.ids, 29 - view.ids)]
    assert len(view.ids) >= 28
    assert min(error(view.corners, way) for way in ways) < 1.5  # gaps of 6 px between squares of 22


@pytest.mark.parametrize(("noise", "taken"), [(1.0, False), (0.01, True)])
def test_refined_corners_of_a_chessboard_are_taken_where_they_lie_as_smoothly(small_camera, monkeypatch, noise, taken):
    board, dice = Chessboard(squares="7x6", square_mm=30), np.random.default_rng(0)
    _, gray, _ = next(render_views(board, small_camera, count=1))
    found = np.asarray(cv2.findChessboardCornersSB(gray, board.num_corners, flags=detection.SEARCH_FLAGS)[1]).reshape(
        -1, 2
    )
    rough = found + dice.normal(0, noise, found.shape)
    monkeypatch.setattr(detection, "_refined", lambda *_: (np.arange(30), rough))
    np.testing.assert_allclose(detect(gray, board).corners, rough if taken else found, atol=1e-6)


def test_a_picture_without_a_board_shows_no_corner():
    noise = np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8)
    for board in (Charuco(), Chessboard()):
        assert detect(noise, board).corners.shape == (0, 2)


@pytest.mark.parametrize(
    ("ids", "enough"), [(range(6), False), ((0, 1, 2, 10, 11), False), ((0, 1, 2, 10, 11, 12), True)]
)
def test_six_corners_in_two_rows_are_enough(ids, enough):
    view = View("", np.array(ids), np.zeros((len(ids), 2)))
    assert has_enough_corners(view, Charuco(squares="11x8")) == enough
