import itertools
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

from torchrefract.cameras.calibration.boards import Board, Charuco
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.synthetic import render_views
from torchrefract.cameras.camera import Camera


@pytest.fixture(scope="session")
def small_camera() -> Camera:
    """Return the camera of the rendered pictures."""
    numbers = {"width": 640, "height": 400, "fx": 380.0, "fy": 381.0, "cx": 322.3, "cy": 196.6}
    return Camera(**numbers, coefficients=(-0.25, 0.08, 0.003, -0.002, 0.01))


@pytest.fixture(scope="session")
def small_board() -> Charuco:
    """Return the board of the rendered pictures."""
    return Charuco(squares="6x5", square_mm=30, marker_mm=20, dictionary="DICT_4X4_50")


@pytest.fixture(scope="session")
def rendered(small_board, small_camera) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return three pictures with their names and poses; the first one shows the whole board."""
    return [next(render_views(small_board, small_camera, count=1)), *render_views(small_board, small_camera, count=2)]


@pytest.fixture(scope="session")
def projected() -> Callable[..., list[View]]:
    """Return a function that projects a board by OpenCV in nine poses, with noise of so many px."""

    def project(board: Board, camera: Camera, *, noise: float = 0.0) -> list[View]:
        generator, views = np.random.default_rng(0), []
        width, height = board.size_mm
        corners = board.corners().reshape(-1, 1, 3)
        for k, (x, y) in enumerate(itertools.product((-0.5, 0.0, 0.5), (-0.25, 0.1, 0.3))):
            turn = generator.uniform(-0.5, 0.5, 3)
            move = np.array([x, y, 1.0]) * 1.3 * width - cv2.Rodrigues(turn)[0] @ (width / 2, height / 2, 0)
            if camera.model == "division":  # which OpenCV does not have
                points = camera.project(
                    torch.from_numpy(corners[:, 0] @ cv2.Rodrigues(turn)[0].T + move)
                ).points.numpy()
            else:
                lens = np.array(camera.matrix), np.array(camera.coefficients)
                points = (cv2.fisheye if camera.model == "fisheye" else cv2).projectPoints(corners, turn, move, *lens)[
                    0
                ]
            pixels = points.reshape(-1, 2)
            views.append(View(f"{k}.png", np.arange(len(pixels)), pixels + generator.normal(0, noise, pixels.shape)))
        return views

    return project
