"""Quality of a calibration: coverage of the frame, warnings, and straightness of lines."""

from collections.abc import Sequence

import numpy as np
import torch

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import Fit
from torchrefract.cameras.camera import Camera

CELLS = (6, 8)  # rows and columns of the cells that divide the frame
_NUM_DEVIATIONS = 2.0  # standard deviations within which a coefficient may be zero
_SIDES = {"left": np.s_[:, 0], "right": np.s_[:, -1], "top": np.s_[0], "bottom": np.s_[-1]}
_MIN_LINE = 3  # corners of a line; two always lie on one


def corner_counts(views: Sequence[View], size: tuple[int, int]) -> np.ndarray:
    """Count the corners in each of 6 x 8 cells of a frame of (width, height) px."""
    corners = np.concatenate([view.corners for view in views]) + 0.5
    limits = [(0, size[1]), (0, size[0])]
    return np.histogram2d(corners[:, 1], corners[:, 0], bins=CELLS, range=limits)[0].astype(int)


def calibration_warnings(views: Sequence[View], fit: Fit, camera: Camera) -> list[str]:
    """Return warnings about a calibration: sides without corners, coefficients near zero, and `camera_warnings`."""
    counts, messages = corner_counts(views, (camera.width, camera.height)), []
    empty = [
        f"{side} ({np.sum(counts[cells] == 0)} of {counts[cells].size} cells)"
        for side, cells in _SIDES.items()
        if (counts[cells] == 0).mean() >= 0.5
    ]
    if empty:
        messages.append(
            f"The frame has few corners at the {', '.join(empty)}: the model is extrapolated there. Add pictures with "
            "the board near the border."
        )
    rows = zip(fit.intrinsics.names[4:], fit.intrinsics.values[4:], fit.deviations[4:], strict=True)
    vague = [
        f"{name} = {value:.4g} +- {deviation:.2g}"
        for name, value, deviation in rows
        if abs(value) < _NUM_DEVIATIONS * deviation
    ]
    if vague:
        messages.append(
            f"These coefficients are zero within two standard deviations: {', '.join(vague)}. A lens_model with fewer "
            "coefficients may be enough."
        )
    return [*messages, *camera_warnings(camera)]


def camera_warnings(camera: Camera) -> list[str]:
    """Return warnings about a model that folds back, or has a pole, inside the frame."""
    messages = []
    if (share := camera.coverage()) < 1:
        messages.append(
            f"The model folds back inside the frame: {1 - share:.1%} of it has no ray. Use a lens_model with fewer "
            "coefficients, or add pictures with corners near the border."
        )
    try:
        camera.check_pole()
    except ValueError as error:
        messages.append(f"The model has a pole inside the frame: {error}. Use a lens_model with fewer coefficients.")
    return messages


def straightness(views: Sequence[View], board: Board) -> float:
    """Return the distance of corners of one row or column of a board from the line that fits them best, px rms.

        sqrt(sum d^2 / sum (n - 2)),  d the distances of the n corners of a line, over all lines with n >= 3

    A line has two parameters, so that noise of s px in each coordinate gives s.

    Raises:
        ValueError: no row or column has three corners.
    """
    squares, degrees_of_freedom = 0.0, 0
    for view in views:
        for line in _lines(view, board):
            # The smaller singular value is the root of the sum of squared distances from the line.
            squares += float(np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1]) ** 2
            degrees_of_freedom += len(line) - 2
    if degrees_of_freedom == 0:
        raise ValueError(f"views must have {_MIN_LINE} corners of one row or column, got {len(views)} views without")
    return (squares / degrees_of_freedom) ** 0.5


def undistort_views(views: Sequence[View], camera: Camera) -> list[View]:
    """Undistort the corners of views, as the camera's pinhole shows them; corners without a ray are dropped."""
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    undistorted = []
    for view in views:
        points, valid, _ = camera.undistort(torch.from_numpy((view.corners - center) / focal))
        keep = valid.numpy()
        undistorted.append(View(view.name, view.ids[keep], points.numpy()[keep] * focal + center))
    return undistorted


def _lines(view: View, board: Board) -> list[np.ndarray]:
    """Return the corners (n, 2) of each row and column that has at least three."""
    row, column = np.divmod(view.ids, board.num_corners[0])
    groups = [view.corners[axis == k] for axis in (row, column) for k in np.unique(axis)]
    return [group for group in groups if len(group) >= _MIN_LINE]
