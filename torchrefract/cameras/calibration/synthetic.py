"""Pictures of a board as a known camera would take them, to try a calibration on."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
import torch

from torchrefract.cameras.calibration.boards import Board, Charuco
from torchrefract.cameras.camera import Camera

CAMERA = Camera(
    width=960, height=600, fx=470.0, fy=472.0, cx=487.3, cy=292.6, coefficients=(-0.25, 0.1, 0.006, -0.005, 0.03)
)
VIEWS = 30
_FINE = 6  # rays along each side of a pixel
_TILT, _TURN = 0.4, 0.4  # rad, the largest
# Of the frame: how wide the board is in front of a pinhole, and where along the sides its middle never is. Any part of
# a ChArUco board can be seen, a chessboard as a whole.
_PARTLY, _WHOLE = ((0.4, 0.6), 0.04), ((0.3, 0.45), 0.22)
_BLACK, _WHITE, _WALL = 25.0, 225.0, 130.0  # of 255
_NOISE = 1.0  # of 255, standard deviation


class Rays(NamedTuple):
    """Where the rays of a camera meet the plane z = 1; NaN where there is none."""

    centers: np.ndarray  # (H, W, 2), of the pixels' centers
    slopes: np.ndarray  # (2, H, W, 2), per px to the right and per px down

    def between(self, where: np.ndarray) -> np.ndarray:
        """(N, n^2, 2), of n x n places in each pixel of a mask, along its slopes: by 1e-3 px at most beside the ray."""
        steps = (np.arange(_FINE) + 0.5) / _FINE - 0.5
        right, down = (offsets.reshape(-1, 1) for offsets in np.meshgrid(steps, steps))
        center, slopes = self.centers[where][:, None], self.slopes[:, where][:, :, None]
        return center + right * slopes[0] + down * slopes[1]


def render_views(
    board: Board, camera: Camera = CAMERA, *, count: int = VIEWS, seed: int = 0
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Pictures of a board, with a margin of one square, on a gray wall.

    A pixel is the mean of 6 x 6 rays, each followed to the plane of the board, with noise, rounded to 8 bits.

    Args:
        board: in its first pattern and colors where it may have two.
        camera: which looks at it.
        count: of pictures; the board goes over the frame in rows.
        seed: of the poses and of the noise.

    Yields:
        The name of a picture, the picture (H, W), uint8, and the pose of the board, (6,), rotation vector and
        translation, mm.
    """
    rays, dice = rays_of(camera), np.random.default_rng(seed)
    for number in range(count):
        pose = _pose(board, camera, number, count, dice)
        shade = _render(board, rays, pose) + dice.normal(0, _NOISE, (camera.height, camera.width))
        yield f"view_{number:02d}.png", shade.round().clip(0, 255).astype(np.uint8), pose


def rays_of(camera: Camera) -> Rays:
    """The rays of a camera."""
    pixels = np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1)
    centers = _on_plane(camera, pixels)
    return Rays(centers, np.stack([np.gradient(centers, axis=1), np.gradient(centers, axis=0)]))


def _on_plane(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) on the plane z = 1."""
    rays, valid, _ = camera.unproject(torch.from_numpy(pixels.reshape(-1, 2)))
    ahead = valid & (rays[:, 2] > 0)
    places = torch.where(ahead[:, None], rays[:, :2] / torch.where(ahead, rays[:, 2], 1.0)[:, None], torch.nan)
    return places.numpy().reshape(pixels.shape)


def _pose(board: Board, camera: Camera, number: int, count: int, dice: np.random.Generator) -> np.ndarray:
    """A board whose middle is seen at the next place of a raster over the frame, tilted against the ray to it."""
    columns = int(np.ceil(np.sqrt(1.5 * count)))
    raster = (np.array([number % columns, number // columns]) + 0.5) / (columns, np.ceil(count / columns))
    across, margin = _PARTLY if isinstance(board, Charuco) else _WHOLE
    x, y = _on_plane(camera, (margin + (1 - 2 * margin) * raster) * (camera.width - 1, camera.height - 1))
    turn = _facing(x, y) @ cv2.Rodrigues(dice.uniform(-1, 1, 3) * (_TILT, _TILT, _TURN))[0]
    width, height = board.size_mm
    far = width * camera.fx / camera.width / dice.uniform(*across)
    middle = turn @ (width / 2, height / 2, 0)
    place = far * np.array([x, y, 1]) / np.sqrt(x * x + y * y + 1)
    return np.concatenate([cv2.Rodrigues(turn)[0].ravel(), place - middle])


def _facing(x: float, y: float) -> np.ndarray:
    """The rotation that turns the axis of a camera toward (x, y) on the plane z = 1, the shortest way."""
    angle = np.arctan(np.hypot(x, y))
    return cv2.Rodrigues(angle * np.array([-y, x, 0]) / max(np.hypot(x, y), 1e-9))[0]


def _render(board: Board, rays: Rays, pose: np.ndarray) -> np.ndarray:
    shade = _shade(board, rays.centers, pose)
    spread = cv2.dilate(shade, np.ones((3, 3))) - cv2.erode(shade, np.ones((3, 3)))
    edges = spread > 0  # elsewhere all rays of a pixel meet one color
    shade[edges] = _shade(board, rays.between(edges), pose).mean(axis=-1)
    return shade


def _shade(board: Board, places: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """What rays through places (..., 2) of the plane z = 1 see, of 255."""
    matrix = cv2.Rodrigues(pose[:3])[0]
    inverse = np.linalg.inv(np.stack([matrix[:, 0], matrix[:, 1], pose[3:]], axis=1)).astype(places.dtype)
    x, y, depth = np.moveaxis(places @ inverse[:, :2].T + inverse[:, 2], -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y = x / depth, y / depth
        (width, height), margin = board.size_mm, board.square_mm
        inside = (np.abs(x - width / 2) < width / 2 + margin) & (np.abs(y - height / 2) < height / 2 + margin)
        seen = inside & (depth > 0)
    x, y = np.where(seen, x, -margin), np.where(seen, y, -margin)
    return np.where(seen, np.where(board.is_black(x, y), _BLACK, _WHITE), _WALL)
