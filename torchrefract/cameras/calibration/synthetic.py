"""Rendered pictures of a board as a known camera takes them, to test a calibration."""

from collections.abc import Iterator

import cv2
import numpy as np
import torch

from torchrefract.cameras.calibration.boards import Board, Charuco
from torchrefract.cameras.camera import Camera

CAMERA = Camera(
    width=960, height=600, fx=470.0, fy=472.0, cx=487.3, cy=292.6, coefficients=(-0.25, 0.1, 0.006, -0.005, 0.03)
)
NUM_VIEWS = 30
_SAMPLES = 6  # rays along each side of a pixel
_MAX_TILT, _MAX_TURN = 0.4, 0.4  # rad
# Range of the width of the board, and margin for its middle, in sides of the frame. A chessboard must be visible as a
# whole, a ChArUco board may leave the frame.
_CHARUCO_LAYOUT, _CHESSBOARD_LAYOUT = ((0.4, 0.6), 0.04), ((0.3, 0.45), 0.22)
_BLACK, _WHITE, _WALL = 25.0, 225.0, 130.0  # of 255
_NOISE = 1.0  # of 255, standard deviation


def render_views(
    board: Board, camera: Camera = CAMERA, *, count: int = NUM_VIEWS, seed: int = 0
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Render pictures of a board with a white margin of one square in front of a gray wall.

    A pixel is the mean of 6 x 6 rays, with noise, rounded to 8 bits. The board moves over the frame in rows; "auto"
    patterns are rendered as False. `seed` is that of the poses and of the noise.

    Yields:
        The name of the picture; the picture (H, W), uint8; the pose of the board (6,), rotation vector and translation,
        mm.
    """
    generator = np.random.default_rng(seed)
    pixels = np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1)
    rays = on_plane(camera, pixels)
    for number in range(count):
        pose = _pose(board, camera, number, count, generator)
        shade = _shade(board, rays, pose)
        contrast = cv2.dilate(shade, np.ones((3, 3))) - cv2.erode(shade, np.ones((3, 3)))
        edges = contrast > 0  # all rays of any other pixel meet one color
        shade[edges] = _shade(board, subpixel_points(rays, edges), pose).mean(axis=-1)
        shade += generator.normal(0, _NOISE, shade.shape)
        yield f"view_{number:02d}.png", shade.round().clip(0, 255).astype(np.uint8), pose


def subpixel_points(rays: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return (N, n^2, 2), n x n points in each pixel of a mask (H, W), linearized with an error below 1e-3 px.

    `rays` are the points (H, W, 2) where the rays of pixels meet the plane z = 1.
    """
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    right, down = (offsets.reshape(-1, 1) for offsets in np.meshgrid(steps, steps))
    slopes = (np.gradient(rays, axis=axis)[mask][:, None] for axis in (1, 0))
    return rays[mask][:, None] + right * next(slopes) + down * next(slopes)


def on_plane(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return where the rays of pixels (..., 2) meet the plane z = 1; NaN where there is none."""
    rays, valid, _ = camera.unproject(torch.from_numpy(pixels.reshape(-1, 2)))
    in_front = valid & (rays[:, 2] > 0)
    points = torch.where(in_front[:, None], rays[:, :2] / torch.where(in_front, rays[:, 2], 1.0)[:, None], torch.nan)
    return points.numpy().reshape(pixels.shape)


def _pose(board: Board, camera: Camera, number: int, count: int, generator: np.random.Generator) -> np.ndarray:
    """Place the middle of the board at the next point of a raster over the frame, tilted against the ray to it."""
    columns = int(np.ceil(np.sqrt(1.5 * count)))
    raster = (np.array([number % columns, number // columns]) + 0.5) / (columns, np.ceil(count / columns))
    width_range, margin = _CHARUCO_LAYOUT if isinstance(board, Charuco) else _CHESSBOARD_LAYOUT
    x, y = on_plane(camera, (margin + (1 - 2 * margin) * raster) * (camera.width - 1, camera.height - 1))
    # The smallest rotation that turns the axis of the camera toward (x, y).
    facing = np.arctan(np.hypot(x, y)) * np.array([-y, x, 0]) / max(np.hypot(x, y), 1e-9)
    rotation = (
        cv2.Rodrigues(facing)[0] @ cv2.Rodrigues(generator.uniform(-1, 1, 3) * (_MAX_TILT, _MAX_TILT, _MAX_TURN))[0]
    )
    width, height = board.size_mm
    distance = width * camera.fx / camera.width / generator.uniform(*width_range)
    middle = rotation @ (width / 2, height / 2, 0)
    position = distance * np.array([x, y, 1]) / np.sqrt(x * x + y * y + 1)
    return np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), position - middle])


def _shade(board: Board, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the brightness, of 255, that rays through points (..., 2) of the plane z = 1 meet."""
    matrix = cv2.Rodrigues(pose[:3])[0]
    inverse = np.linalg.inv(np.stack([matrix[:, 0], matrix[:, 1], pose[3:]], axis=1)).astype(points.dtype)
    x, y, depth = np.moveaxis(points @ inverse[:, :2].T + inverse[:, 2], -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y = x / depth, y / depth
        (width, height), margin = board.size_mm, board.square_mm
        inside = (np.abs(x - width / 2) < width / 2 + margin) & (np.abs(y - height / 2) < height / 2 + margin)
        on_page = inside & (depth > 0)
    x, y = np.where(on_page, x, -margin), np.where(on_page, y, -margin)
    return np.where(on_page, np.where(board.is_black(x, y), _BLACK, _WHITE), _WALL)
