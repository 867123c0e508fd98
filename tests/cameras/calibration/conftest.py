import itertools
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Board, Charuco
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.synthetic import render_views
from torchrefract.cameras.camera import Camera

SMALL = Camera(
    width=640, height=400, fx=380.0, fy=381.0, cx=322.3, cy=196.6, coefficients=(-0.25, 0.08, 0.003, -0.002, 0.01)
)


@pytest.fixture(scope="session")
def small_camera() -> Camera:
    return SMALL


@pytest.fixture(scope="session")
def small_board() -> Charuco:
    return Charuco(squares="6x5", square_mm=30, marker_mm=20, dictionary="DICT_4X4_50")


@pytest.fixture(scope="session")
def rendered(small_board, small_camera) -> list[tuple[str, np.ndarray, np.ndarray]]:
    return list(render_views(small_board, small_camera, count=6))


@pytest.fixture(scope="session")
def whole(small_board, small_camera) -> np.ndarray:
    """A picture of all of the board."""
    return next(render_views(small_board, small_camera, count=1))[1]


@pytest.fixture(scope="session")
def projected() -> Callable[..., list[View]]:
    """Views of a board as OpenCV projects it, in poses that differ, with noise of so many px."""

    def make(board: Board, matrix: np.ndarray, vector: np.ndarray, *, noise: float = 0.0, fisheye=False) -> list[View]:
        dice, views = np.random.default_rng(0), []
        width, height = board.size_mm
        corners = board.corners().reshape(-1, 1, 3)
        for k, (x, y) in enumerate(itertools.product((-0.5, 0.0, 0.5), (-0.25, 0.1, 0.3))):
            turn = dice.uniform(-0.5, 0.5, 3)
            move = np.array([x, y, 1.0]) * 1.3 * width - cv2.Rodrigues(turn)[0] @ (width / 2, height / 2, 0)
            project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
            places = project(corners, turn, move, matrix, vector)[0].reshape(-1, 2)
            views.append(View(f"{k}.png", np.arange(len(places)), places + dice.normal(0, noise, places.shape)))
        return views

    return make
