import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefract.cameras.calibration import detection
from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import (
    View,
    describe_other_board,
    detect,
    edge_width,
    explain_failure,
    has_enough_corners,
)
from torchrefract.cameras.calibration.synthetic import render_views


@pytest.fixture(scope="module")
def chessboard(small_camera) -> tuple[Chessboard, np.ndarray, np.ndarray]:
    """Return a chessboard, a picture of it, and its pose."""
    board = Chessboard(squares="7x6", square_mm=30)
    _, gray, pose = next(render_views(board, small_camera, count=1))
    return board, gray, pose


def expected_corners(camera, board, ids, pose) -> np.ndarray:
    matrix, vector = np.array(camera.matrix), np.array(camera.coefficients)
    return cv2.projectPoints(board.corners(ids), pose[:3], pose[3:], matrix, vector)[0].reshape(-1, 2)


def rms_error(corners, expected) -> float:
    return float(np.sqrt(((corners - expected) ** 2).sum(axis=1).mean()))


@pytest.mark.quick
def test_corners_are_found_to_a_tenth_of_a_pixel(rendered, small_board, small_camera):
    for name, gray, pose in rendered:
        view = detect(gray, small_board, name=name)
        assert view.name == name
        assert has_enough_corners(view, small_board)
        assert rms_error(view.corners, expected_corners(small_camera, small_board, view.ids, pose)) < 0.1


def test_a_chessboard_is_found_up_to_half_a_turn(small_camera, chessboard):
    board, gray, pose = chessboard
    view = detect(gray, board)
    expected = expected_corners(small_camera, board, view.ids, pose)
    assert len(view.ids) == 30
    assert min(rms_error(view.corners, expected), rms_error(view.corners, expected[::-1])) < 0.1


@pytest.mark.parametrize(
    ("squares", "legacy", "inverted"), [("6x5", False, True), ("5x6", False, False), ("5x6", True, True)]
)
def test_pattern_and_colors_are_detected(squares, legacy, inverted, small_camera):
    options = {"squares": squares, "square_mm": 30, "marker_mm": 20, "dictionary": "DICT_4X4_50"}
    board = Charuco(**options, legacy=legacy, inverted=inverted)
    _, gray, pose = next(render_views(board, small_camera, count=1))
    view = detect(gray, Charuco(**options))
    assert has_enough_corners(view, board)
    assert rms_error(view.corners, expected_corners(small_camera, board, view.ids, pose)) < 0.1
    assert len(detect(gray, Charuco(**options, inverted=not inverted)).ids) == 0


def drawn(board, *, px_per_mm=3, margin_mm=30) -> np.ndarray:
    """Draw a board seen from the front, with a margin."""
    x, y = (np.arange((side + 2 * margin_mm) * px_per_mm) / px_per_mm - margin_mm for side in map(int, board.size_mm))
    return np.where(board.is_black(*np.meshgrid(x, y)), 20, 230).astype(np.uint8)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("part", [np.s_[:360], np.s_[200:], np.s_[:, 300:], np.s_[200:, :560], np.s_[:]], ids=str)
def test_a_part_of_a_board_shows_its_pattern(legacy, part):
    board = Charuco(squares="5x4", square_mm=40, marker_mm=28, dictionary="DICT_4X4_50", legacy=legacy)
    view = detect(np.ascontiguousarray(drawn(board)[part]), replace(board, legacy="auto"))
    rows, columns = part if isinstance(part, tuple) else (part, slice(None))
    offset = np.array([columns.start or 0, rows.start or 0])
    assert has_enough_corners(view, board)
    moved = view.corners + offset - 3 * (board.corners(view.ids)[:, :2] + 30)
    # Two rows of markers may be those of a board one square aside, which is another pose for all corners.
    assert np.ptp(moved, axis=0).max() < 1


@pytest.mark.parametrize(
    "lens",
    [
        {"coefficients": (-0.4, 0.17, 0.002, -0.003, -0.025)},
        {"fx": 300.0, "fy": 300.0, "coefficients": (-0.02, 0.005, 0.0, 0.0), "model": "fisheye"},
    ],
    ids=["barrel", "fisheye"],
)
def test_a_strong_lens_moves_no_corner(lens, small_camera):
    camera = replace(small_camera, **lens)
    board = Charuco(squares="5x4", square_mm=40, marker_mm=28, dictionary="DICT_4X4_50", legacy=False, inverted=False)
    corners, errors = 0, []
    for _, gray, pose in render_views(board, camera, count=4):
        rays = torch.from_numpy(board.corners() @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
        expected = camera.project(rays).points.numpy()
        view = detect(gray, board)
        errors.append(np.linalg.norm(view.corners - expected[view.ids], axis=1))
        corners += len(view.ids)
    assert corners >= 30
    assert np.concatenate(errors).max() < 0.2


def test_corners_behind_a_finger_are_dropped(rendered, small_board, small_camera):
    _, gray, pose = rendered[0]
    view = detect(gray, small_board)
    middle = view.corners.mean(axis=0)
    is_covered = np.abs(view.corners - middle).max(axis=1) < 40
    x, y = middle.round().astype(int)
    covered = gray.copy()
    covered[y - 45 : y + 46, x - 45 : x + 46] = 130
    remaining = detect(covered, small_board)
    assert is_covered.sum() >= 2
    assert not set(view.ids[is_covered].tolist()) & set(remaining.ids.tolist())
    assert rms_error(remaining.corners, expected_corners(small_camera, small_board, remaining.ids, pose)) < 0.15


def test_an_overexposed_chessboard_keeps_its_corners(small_camera, chessboard):
    board, gray, pose = chessboard
    bloomed = cv2.dilate(gray, np.ones((7, 7), np.uint8))  # white squares grow, so that black ones do not touch
    view = detect(bloomed, board)
    expected = [expected_corners(small_camera, board, ids, pose) for ids in (view.ids, 29 - view.ids)]
    assert len(view.ids) >= 28
    assert min(rms_error(view.corners, corners) for corners in expected) < 1.5  # gaps of 6 px between squares of 22


@pytest.mark.parametrize(("noise", "uses_refined"), [(1.0, False), (0.01, True)])
def test_refined_chessboard_corners_are_used_if_they_are_as_smooth(chessboard, monkeypatch, noise, uses_refined):
    board, gray, _ = chessboard
    original = cv2.findChessboardCornersSB(gray, board.num_corners, flags=detection.SEARCH_FLAGS)[1].reshape(-1, 2)
    refined = original + np.random.default_rng(0).normal(0, noise, original.shape)
    monkeypatch.setattr(detection, "_refine", lambda *_: View("", np.arange(30), refined))
    np.testing.assert_allclose(detect(gray, board).corners, refined if uses_refined else original, atol=1e-6)


def test_a_picture_without_a_board_has_no_corners():
    noise = np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8)
    for board in (Charuco(), Chessboard()):
        assert detect(noise, board).corners.shape == (0, 2)


@pytest.mark.parametrize(
    ("ids", "enough"), [(range(6), False), ((0, 1, 2, 10, 11), False), ((0, 1, 2, 10, 11, 12), True)]
)
def test_six_corners_in_two_rows_are_enough(ids, enough):
    view = View("", np.array(ids), np.zeros((len(ids), 2)))
    assert has_enough_corners(view, Charuco(squares="11x8")) == enough


@pytest.fixture(scope="module")
def picture(rendered) -> np.ndarray:
    """Return a picture of the whole small board."""
    return rendered[0][1]


@pytest.mark.parametrize("sigma", [2.0, 8.0])
def test_the_width_of_a_blurred_edge_matches_its_gaussian(sigma):
    # The steepest slope of a step c through a Gaussian is c / (s sqrt(2 pi)).
    step = np.repeat([[20.0] * 150 + [220.0] * 150], 100, axis=0)
    blurred = cv2.GaussianBlur(step, (0, 0), sigma).round().astype(np.uint8)
    assert edge_width(blurred) == pytest.approx(sigma * math.sqrt(2 * math.pi), rel=0.1)


def test_a_uniform_picture_has_no_edge():
    assert edge_width(np.full((30, 40), 90, np.uint8)) == math.inf


def test_mirrored_and_blurred_pictures_and_few_corners_are_explained(picture, small_board):
    flipped = np.ascontiguousarray(picture[:, ::-1])
    problem = explain_failure(flipped, detect(flipped, small_board), small_board)
    assert problem == "mirrored: flipped from left to right it shows 20 corners"
    blurred = cv2.GaussianBlur(picture, (0, 0), 6)
    problem = explain_failure(blurred, detect(blurred, small_board), small_board)
    assert problem.startswith("no board found; it is blurred, its sharpest edges are 1")
    view = detect(picture, small_board)
    few = view._replace(ids=view.ids[:4], corners=view.corners[:4])
    problem = explain_failure(picture, few, small_board)
    assert problem == "4 of 20 corners, 6 in two rows and columns are needed"


@pytest.mark.parametrize(
    "expected",
    [
        Charuco(squares="6x5", dictionary="DICT_6X6_250"),
        Charuco(squares="5x6", dictionary="DICT_4X4_50", inverted=True),
        Chessboard(squares="6x5"),
    ],
)
def test_another_charuco_board_is_described(expected, picture):
    text = "15 markers of DICT_4X4_50, from number 0 to 14, with 20 corners as on a board of squares=6x5"
    assert describe_other_board(picture, expected) == text


@pytest.mark.parametrize(
    ("squares", "legacy"),  # which changes boards of an even number of rows
    [("3x4", False), ("4x4", True), ("6x4", False)],
)
def test_a_description_has_the_squares_and_corners_of_the_board(squares, legacy):
    board = Charuco(squares=squares, dictionary="DICT_4X4_50", legacy=legacy)
    picture = drawn(board)
    picture[90:156, 90:156] = 130  # the first square
    text = describe_other_board(picture, Charuco(squares="11x8", dictionary="DICT_4X4_50"))
    count = len(detect(picture, replace(board, legacy="auto")).ids)
    assert text.endswith(f"with {count} corners as on a board of squares={squares}")


@pytest.mark.parametrize("squares", ["4x4", "4x6", "7x6"])
def test_columns_and_rows_of_a_chessboard_are_those_of_the_picture(squares):
    board = Chessboard(squares=squares)
    columns, rows = board.num_corners
    text = f"a chessboard of {columns}x{rows} inner corners, which is squares={squares}"
    assert describe_other_board(drawn(board), Chessboard()) == text


def test_another_chessboard_is_described(small_camera):
    _, gray, _ = next(render_views(Chessboard(squares="7x6", square_mm=30), small_camera, count=1))
    text = describe_other_board(gray, Chessboard(squares="9x6"))
    assert "inner corners, which is squares=7x6" in text.replace("6x7", "7x6")


def test_a_picture_without_a_board_has_no_description():
    assert describe_other_board(np.full((200, 300), 90, np.uint8), Charuco()) == ""
