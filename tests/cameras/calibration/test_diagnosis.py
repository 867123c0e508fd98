import math

import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import describe_other_board, detect, edge_width, explain_failure
from torchrefract.cameras.calibration.synthetic import render_views


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


def test_another_chessboard_is_described(small_camera):
    _, gray, _ = next(render_views(Chessboard(squares="7x6", square_mm=30), small_camera, count=1))
    text = describe_other_board(gray, Chessboard(squares="9x6"))
    assert "inner corners, which is squares=7x6" in text.replace("6x7", "7x6")


def test_a_picture_without_a_board_has_no_description():
    assert describe_other_board(np.full((200, 300), 90, np.uint8), Charuco()) == ""
