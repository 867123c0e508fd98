import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco, Chessboard


@pytest.mark.quick
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("squares", ["6x5", "5x8"])
def test_a_charuco_board_is_black_where_opencv_draws_black(squares, legacy):
    board = Charuco(squares=squares, square_mm=30, marker_mm=18, dictionary="DICT_4X4_50", legacy=legacy)
    columns, rows = board.num_squares
    image = board.to_opencv(legacy=legacy).generateImage((100 * columns, 100 * rows), marginSize=0)
    y, x = np.mgrid[0 : 100 * rows, 0 : 100 * columns]
    assert np.array_equal(board.is_black((x + 0.5) * 0.3, (y + 0.5) * 0.3), image == 0)


def test_an_inverted_board_is_the_negative():
    board, negative = Charuco(squares="4x3"), Charuco(squares="4x3", inverted=True)
    x, y = np.random.default_rng(0).uniform(-10, 100, (2, 1000))
    assert np.array_equal(negative.is_black(x, y), ~board.is_black(x, y))


@pytest.mark.parametrize("board", [Charuco(), Chessboard(), Charuco(squares="5x8", legacy=True)], ids=str)
def test_a_board_has_one_color_between_its_color_edges(board):
    (xs, ys), generator = board.color_edges(), np.random.default_rng(0)
    x = xs[:-1] + np.diff(xs) * generator.uniform(0.01, 0.99, (5, 1))
    y = ys[:-1] + np.diff(ys) * generator.uniform(0.01, 0.99, (5, 1))
    middle = board.is_black(*np.meshgrid((xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2))
    for row, column in zip(x, y, strict=True):
        assert np.array_equal(board.is_black(*np.meshgrid(row, column)), middle)


def test_corners_match_opencv():
    board = Charuco(squares="7x4", square_mm=25, marker_mm=15)
    expected = np.asarray(board.to_opencv(legacy=False).getChessboardCorners())
    np.testing.assert_allclose(board.corners(), expected)
    np.testing.assert_allclose(board.corners(np.array([8, 0])), expected[[8, 0]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"squares": "11"}, "squares must be columns x rows, such as 11x8, got '11'"),
        ({"squares": "2x8"}, "squares must be from 3 to 100 in columns and rows, got 2x8"),
        ({"squares": "3x3"}, "squares must have at least 6 inner corners, which a view needs, got 3x3 with 4"),
        ({"square_mm": 0}, "square_mm must be above 0, got 0"),
        ({"marker_mm": 22}, "marker_mm must be below square_mm = 22, got 22"),
        ({"dictionary": "DICT_3X3"}, "dictionary must be one of .*, got 'DICT_3X3'"),
        ({"dictionary": "DICT_4X4_50", "squares": "20x20"}, "dictionary must hold the 200 markers .* with 50"),
        ({"legacy": "old"}, "legacy must be auto, true or false, got 'old'"),
        ({"inverted": None}, "inverted must be auto, true or false, got None"),
    ],
)
def test_invalid_boards_raise(options, message):
    with pytest.raises(ValueError, match=message):
        Charuco(**options)


def test_a_chessboard_has_the_corners_that_opencv_detects():
    with pytest.raises(ValueError, match="squares must be from 4 to 100 in columns and rows, got 3x7"):
        Chessboard(squares="3x7")


def test_a_description_lists_the_options_of_the_command():
    assert Chessboard(squares="9x6", square_mm=10.5).describe() == "board=chessboard squares=9x6 square_mm=10.5"
