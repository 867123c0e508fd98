import math

import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import detect
from torchrefract.cameras.calibration.diagnosis import describe_other_board, edge_width, explain_failure
from torchrefract.cameras.calibration.synthetic import render_views


@pytest.mark.parametrize("sigma", [2.0, 4.0, 8.0])
def test_the_width_of_a_blurred_edge_is_that_of_its_gaussian(sigma):
    # The steepest slope of a step c through a Gaussian is c / (s sqrt(2 pi)).
    step = np.repeat([[20.0] * 150 + [220.0] * 150], 100, axis=0)
    blurred = cv2.GaussianBlur(step, (0, 0), sigma).round().astype(np.uint8)
    assert edge_width(blurred) == pytest.approx(sigma * math.sqrt(2 * math.pi), rel=0.1)


def test_a_picture_of_one_gray_has_no_edge():
    assert edge_width(np.full((30, 40), 90, np.uint8)) == math.inf


def test_a_mirrored_board_is_told(whole, small_board):
    flipped = np.ascontiguousarray(whole[:, ::-1])
    view = detect(flipped, small_board)
    assert explain_failure(flipped, view, small_board) == "mirrored: flipped from left to right it shows 20 corners"


def test_a_blurred_board_is_told(whole, small_board):
    blurred = cv2.GaussianBlur(whole, (0, 0), 6)
    reason = explain_failure(blurred, detect(blurred, small_board), small_board)
    assert reason.startswith("no board found; it is blurred, its sharpest edges are 1")


def test_few_corners_are_counted(whole, small_board):
    view = detect(whole, small_board)
    few = view._replace(ids=view.ids[:4], corners=view.corners[:4])
    assert explain_failure(whole, few, small_board) == "4 of 20 corners, 6 in two rows and columns are needed"


@pytest.mark.parametrize(
    "words",
    [
        {"squares": "6x5", "dictionary": "DICT_6X6_250"},
        {"squares": "5x6", "dictionary": "DICT_4X4_50"},
        {"squares": "6x5", "dictionary": "DICT_4X4_50", "inverted": True},
    ],
)
def test_another_charuco_board_is_named(words, whole):
    board = Charuco(square_mm=30, marker_mm=20, **words)
    found = describe_other_board(whole, board)
    assert found == "15 markers of DICT_4X4_50, from number 0 to 14, with 20 corners as on a board of squares=6x5"


def test_a_charuco_board_is_named_where_a_chessboard_was_asked_for(whole):
    assert describe_other_board(whole, Chessboard(squares="6x5")).startswith("15 markers of DICT_4X4_50, from")


@pytest.mark.parametrize("asked", [Chessboard(squares="9x6"), Charuco(squares="7x6")], ids=["chessboard", "charuco"])
def test_another_chessboard_is_named(asked, small_camera):
    _, gray, _ = next(render_views(Chessboard(squares="7x6", square_mm=30), small_camera, count=1))
    assert "inner corners, which is squares=7x6" in describe_other_board(gray, asked).replace("6x7", "7x6")


def test_nothing_is_said_of_a_picture_that_shows_no_board():
    assert describe_other_board(np.full((200, 300), 90, np.uint8), Charuco()) == ""
