"""How straight a camera shows straight lines."""

from collections.abc import Sequence

import numpy as np
import torch

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.camera import Camera

_FEWEST = 3  # points of a line; two are always on one


def straightness(views: Sequence[View], board: Board) -> float:
    """How far corners of one row or column of a board are off the line that fits them best, px rms.

        sqrt(sum d^2 / sum (n - 2)),  d the distances of the n corners of a line, over all lines of three or more

    A line takes two numbers of its n, so that corners off by s px in every direction give s.
    """
    squares, free = 0.0, 0
    for view in views:
        for line in _lines(view, board):
            # The smaller singular value is the root of the sum of squares across the line.
            squares += float(np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1]) ** 2
            free += len(line) - 2
    if free == 0:
        raise ValueError(f"views must have {_FEWEST} corners of one row or column, got {len(views)} views without")
    return (squares / free) ** 0.5


def rectified(views: Sequence[View], camera: Camera) -> list[View]:
    """The views as the camera's pinhole shows them: each corner undistorted; those that have no ray are left out."""
    found = []
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    for view in views:
        points, valid, _ = camera.undistort(torch.from_numpy((view.corners - center) / focal))
        kept = valid.numpy()
        found.append(View(view.name, view.ids[kept], points.numpy()[kept] * focal + center))
    return found


def _lines(view: View, board: Board) -> list[np.ndarray]:
    """(n, 2) of each row and column with enough corners."""
    row, column = np.divmod(view.ids, board.inner[0])
    groups = [view.corners[axis == k] for axis in (row, column) for k in np.unique(axis)]
    return [group for group in groups if len(group) >= _FEWEST]
