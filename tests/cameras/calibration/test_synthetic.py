import cv2
import numpy as np
import torch

from torchrefract.cameras.calibration import synthetic
from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.synthetic import on_plane, render_views, subpixel_points
from torchrefract.cameras.camera import Camera


def test_subpixel_rays_match_the_camera(small_camera):
    frame = np.stack(np.meshgrid(np.arange(640.0), np.arange(400.0)), axis=-1)
    mask = np.zeros((400, 640), dtype=bool)
    mask[5:395:13, 5:635:13] = True
    points = subpixel_points(on_plane(small_camera, frame), mask)
    steps = (np.arange(6) + 0.5) / 6 - 0.5
    exact = on_plane(
        small_camera, frame[mask][:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, 36, 2)
    )
    assert np.abs(points - exact).max() * small_camera.fx < 1e-2
    assert np.abs(points - exact).mean() * small_camera.fx < 1e-3


def test_a_pixel_is_the_mean_over_its_area(monkeypatch):
    # A pinhole in front of the board: 1 mm is 1 px, and squares of 10.5 px end in the middle of every second pixel.
    board = Chessboard(squares="6x4", square_mm=10.5)
    camera = Camera(width=90, height=70, fx=100.0, fy=100.0, cx=0.0, cy=0.0, coefficients=(0.0,) * 4)
    pose = np.array([0, 0, 0, 9.5, 11.5, 100.0])
    monkeypatch.setattr(synthetic, "_pose", lambda *_: pose)
    monkeypatch.setattr(synthetic, "_NOISE", 0.0)
    _, picture, _ = next(render_views(board, camera, count=1))
    # The exact mean over each pixel: the parity of squares is a product of signs along x and along y.
    edges = [np.clip(np.arange(n + 1) - 0.5 - start, 0, None) for n, start in ((90, 9.5), (70, 11.5))]
    waves = [np.diff(np.abs((edge + 10.5) % 21 - 10.5)) for edge in edges]
    x, y = slice(10, 9 + 63), slice(12, 11 + 42)
    parity = np.outer(waves[1], waves[0])[y, x]
    expected = 225 - (225 - 25) * (1 + parity) / 2
    assert np.abs(picture[y, x] - expected).max() <= 1


def test_the_board_moves_over_the_frame(small_board, small_camera, monkeypatch):
    monkeypatch.setattr(synthetic, "_shade", lambda _board, points, _pose: np.zeros(points.shape[:-1]))
    middles = []
    for _, _, pose in render_views(small_board, small_camera, count=6):
        width, height = small_board.size_mm
        middle = cv2.Rodrigues(pose[:3])[0] @ (width / 2, height / 2, 0) + pose[3:]
        pixel = small_camera.project(torch.from_numpy(middle[None])).points[0]
        middles.append(pixel.numpy() / (small_camera.width - 1, small_camera.height - 1))
    x, y = np.array(middles).T
    np.testing.assert_allclose(sorted(set(x.round(6))), 0.04 + 0.92 * np.array([1, 3, 5]) / 6, atol=1e-5)
    np.testing.assert_allclose(sorted(set(y.round(6))), 0.04 + 0.92 * np.array([1, 3]) / 4, atol=1e-5)
