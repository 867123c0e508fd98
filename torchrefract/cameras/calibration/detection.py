"""The corners of a board in a picture."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from torchrefract.cameras.calibration.boards import Board, Charuco

FEWEST_CORNERS = 6
SEARCH = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
# Half the side of the window that a corner is refined in: of the way to the nearest marker, or of half a square, but
# so many px, of which less tell little, if that is no larger share of a square.
_CLEAR, _WINDOWS, _LEAST = 0.7, (5, 10), 0.15
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
_FARTHEST = 0.05  # squares that a refinement may move a corner by, or 1 px
_MISFIT = 0.2  # squares from where its neighbors say that a corner is
_NEIGHBORS = 8
_SMOOTHER = 0.9  # times as far off their neighbors, rms, corners as they were found are taken in place of refined ones
_BESIDE = 0.1  # squares from a corner, along x and y, where its four squares are looked at
_CONTRAST = 0.4  # of the median contrast of the corners that one must have
_SURE = 0.75  # of the corners that a refinement must keep to be believed


class View(NamedTuple):
    """What was found of a board in a picture; pixel centers are whole numbers."""

    name: str
    ids: np.ndarray  # (N,), int, of `Board.corners`
    corners: np.ndarray  # (N, 2), float64, px


def detect(gray: np.ndarray, board: Board, *, name: str = "") -> View:
    """The corners of a board that a picture shows, to a few hundredths of a pixel.

    A ChArUco board is found by its markers, in the patterns and colors that it may have, whichever shows more; a
    chessboard by `findChessboardCornersSB`, or else by `findChessboardCorners`. Each corner is then refined in a window
    that holds little but its four squares. Left out are those that move far, lie at the border of the picture, are not
    where their neighbors say, or, of a ChArUco board, not where black and white cross, as behind a finger. Where many
    would move far, or corners of a chessboard be off their neighbors by more than before, as on an overexposed board
    whose squares do not touch, all stay where they were found.

    Args:
        gray: (H, W), uint8.
        board: to look for.
        name: of the view.

    Returns:
        The view, of no corner where no board was found.
    """
    if isinstance(board, Charuco):
        ids, corners = _markers_and_corners(gray, board)
        share = (board.square_mm - board.marker_mm) / board.square_mm / 2
    else:
        ids, corners = _chessboard(gray, board)
        share = 0.5
    if len(ids):
        refined = _refined(gray, ids, corners, _CLEAR * share)
        # Those of ChArUco boards are found by way of their markers, and lie smoothly wherever they are.
        if isinstance(board, Charuco) or _is_as_smooth(board, refined, (ids, corners)):
            ids, corners = refined
        ids, corners = _consistent(board, ids, corners)
        if isinstance(board, Charuco):  # a chessboard was seen as a whole
            ids, corners = _crossed(gray, board, ids, corners)
    return View(name, ids, corners.astype(np.float64).reshape(-1, 2))


def is_enough(view: View, board: Board) -> bool:
    """Whether a view has six corners at least, not all in one row or column."""
    columns = board.inner[0]
    spread = min(len(set((view.ids // columns).tolist())), len(set((view.ids % columns).tolist())))
    return len(view.ids) >= FEWEST_CORNERS and spread > 1


def both(value: str | bool) -> tuple[bool, ...]:
    """The values to try."""
    return (False, True) if value == "auto" else (bool(value),)


def _markers_and_corners(gray: np.ndarray, board: Charuco) -> tuple[np.ndarray, np.ndarray]:
    best = np.empty(0, dtype=int), np.empty((0, 2))
    one = cv2.aruco.CharucoParameters()
    one.minMarkers = 1  # beside a corner, so that those near the border of the picture count; what misfits goes below
    legacies = both(board.legacy) if board.counts[1] % 2 == 0 else (False,)  # of odd rows both are the same
    for inverted in both(board.inverted):
        picture = 255 - gray if inverted else gray
        for legacy in legacies:
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv(legacy), one).detectBoard(picture)
            if ids is not None and len(ids) > len(best[0]):
                best = ids.ravel(), corners.reshape(-1, 2)
    return best


def _chessboard(gray: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    found, corners = cv2.findChessboardCornersSB(gray, board.inner, flags=SEARCH)
    if not found:
        found, corners = cv2.findChessboardCorners(gray, board.inner)
    if not found:
        return np.empty(0, dtype=int), np.empty((0, 2))
    return np.arange(len(corners)), corners.reshape(-1, 2)


def _refined(gray: np.ndarray, ids: np.ndarray, corners: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """The corners refined in windows of that share of the distance to the next corner."""
    height, width = gray.shape
    moved, near, inside = corners.copy(), [], []
    for k, spacing in enumerate(_spacings(corners)):
        least = min(_WINDOWS[0], max(2, int(_LEAST * spacing)))
        half = int(np.clip(share * spacing, least, _WINDOWS[1]))
        start = corners[k].astype(np.float32).reshape(1, 1, 2)
        moved[k] = cv2.cornerSubPix(gray, start.copy(), (half, half), (-1, -1), _STOP).reshape(2)
        near.append(np.hypot(*(moved[k] - corners[k])) <= max(1.0, _FARTHEST * spacing))
        inside.append(min(*moved[k], width - 1 - moved[k][0], height - 1 - moved[k][1]) > half + 1)
    if np.mean(near) < _SURE:
        return ids, corners
    kept = np.logical_and(near, inside)
    return ids[kept], moved[kept]


def _is_as_smooth(board: Board, new: tuple[np.ndarray, np.ndarray], old: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether corners lie where their neighbors say, nearly as well as those of the same numbers did before."""
    (ids, corners), before = new, old[1][np.isin(old[0], new[0])]
    plane = board.corners(ids)[:, :2]
    first, then = (np.square(_misfits(plane, places) * _spacings(places)).mean() for places in (before, corners))
    return bool(first >= _SMOOTHER**2 * then)


def _spacings(corners: np.ndarray) -> np.ndarray:
    """The distance of each corner to the next one."""
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1) if len(corners) > 1 else np.zeros(len(corners))


def _consistent(board: Board, ids: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those that lie where their neighbors say; the one that is farthest off goes first, as it misleads others."""
    while len(ids) > FEWEST_CORNERS:
        errors = _misfits(board.corners(ids)[:, :2], corners)
        worst = int(errors.argmax())
        if errors[worst] <= _MISFIT:
            break
        ids, corners = np.delete(ids, worst), np.delete(corners, worst, axis=0)
    return ids, corners


def _misfits(plane: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N,), squares, between each corner and where the homography of its neighbors puts it."""
    spacings, errors = _spacings(corners), np.zeros(len(corners))
    for k, matrix in enumerate(_homographies(plane, corners)):
        if matrix is not None:
            place = cv2.perspectiveTransform(plane[None, k : k + 1], matrix).reshape(2)
            errors[k] = np.hypot(*(place - corners[k])) / spacings[k]
    return errors


def _homographies(plane: np.ndarray, corners: np.ndarray) -> Iterator[np.ndarray | None]:
    """From the board to the picture near each corner, by its neighbors; None where these are in a line."""
    apart = np.linalg.norm(plane[:, None] - plane[None], axis=2)
    for k in range(len(corners)):
        others = np.argsort(apart[k], kind="stable")[1 : _NEIGHBORS + 1]
        flat = np.linalg.matrix_rank(plane[others] - plane[others].mean(axis=0)) < 2
        yield None if flat or len(others) < 4 else cv2.findHomography(plane[others], corners[others], 0)[0]


def _crossed(gray: np.ndarray, board: Board, ids: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those where two squares are clearly darker than the two others."""
    plane, gaps = board.corners(ids)[:, :2], np.full(len(ids), np.nan)
    signs = np.array([(-1, -1), (1, 1), (-1, 1), (1, -1)])
    for k, matrix in enumerate(_homographies(plane, corners)):
        if matrix is not None:
            around = np.vstack([plane[k], plane[k] + _BESIDE * board.square_mm * signs])
            places = cv2.perspectiveTransform(around[None], matrix).reshape(-1, 2)
            x, y = (places[1:] - places[0] + corners[k]).astype(np.float32).T
            seen = cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float).ravel()
            gaps[k] = max(seen[:2].min() - seen[2:].max(), seen[2:].min() - seen[:2].max())
    kept = np.isnan(gaps) | (gaps > _CONTRAST * np.nanmedian(gaps)) if not np.isnan(gaps).all() else gaps != 0
    return ids[kept], corners[kept]
