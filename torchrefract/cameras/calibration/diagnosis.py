"""Explanations for pictures without the expected board: blur, a mirrored picture, another board."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from torchrefract.cameras.calibration.boards import LARGEST_DICTIONARIES, Board, Charuco, marker_dictionary
from torchrefract.cameras.calibration.detection import (
    MIN_CORNERS,
    SEARCH_FLAGS,
    View,
    candidates,
    detect,
    has_enough_corners,
)

_BLURRED_PX = 5.0  # width of the sharpest edges
_MIN_MARKERS = 3
_SIDES = range(3, 21)  # squares along the sides of the boards to try


def edge_width(gray: np.ndarray) -> float:
    """Return the width of the sharpest edges of a picture, px: its range of gray over its steepest slope.

        (g_99% - g_1%) / |grad g|_99.9%

    An edge blurred by a Gaussian of standard deviation s gets 2.5 s. A uniform picture gets infinity.
    """
    values = gray.astype(np.float32)
    across, down = (cv2.Sobel(values, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    slope = float(np.percentile(np.hypot(across, down), 99.9))
    low, high = np.percentile(values, (1, 99))
    return float(high - low) / slope if slope > 0 else np.inf


def explain_failure(gray: np.ndarray, view: View, board: Board) -> str:
    """Say in a few words why a view has too few corners."""
    width = edge_width(gray)
    blur = f"; it is blurred, its sharpest edges are {width:.1f} px wide" if width > _BLURRED_PX else ""
    if isinstance(board, Charuco):
        mirrored = detect(np.ascontiguousarray(gray[:, ::-1]), board)
        if has_enough_corners(mirrored, board):
            return f"mirrored: flipped from left to right it shows {len(mirrored.ids)} corners"
    if len(view.ids):
        total = board.num_corners[0] * board.num_corners[1]
        return f"{len(view.ids)} of {total} corners, {MIN_CORNERS} in two rows and columns are needed{blur}"
    return f"no board found{blur}"


def describe_other_board(gray: np.ndarray, board: Board) -> str:
    """Describe the board that a picture shows instead of the expected one; empty if it shows none."""
    return _other_charuco(gray, board if isinstance(board, Charuco) else Charuco()) or _other_chessboard(gray)


def _other_chessboard(gray: np.ndarray) -> str:
    has_board, _, cells = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), SEARCH_FLAGS | cv2.CALIB_CB_LARGER)
    if not has_board:
        return ""
    rows, columns = cells.shape
    return f"a chessboard of {columns}x{rows} inner corners, which is squares={columns + 1}x{rows + 1}"


def _other_charuco(gray: np.ndarray, board: Charuco) -> str:
    searches = [_find_markers(picture, name) for picture in (gray, 255 - gray) for name in LARGEST_DICTIONARIES]
    best = max(searches, key=lambda search: len(search.corners))
    if len(best.corners) < _MIN_MARKERS:
        return ""
    low, high = int(best.ids.min()), int(best.ids.max())
    name = _smallest_dictionary(best.dictionary, high, preferred=board.dictionary)
    color = "" if best.picture is gray else ", black and white exchanged"
    text = f"{len(best.ids)} markers of {name}{color}, from number {low} to {high}"
    squares, count = _find_squares(best, replace(board, squares="3x3", dictionary=name))
    return f"{text}, with {count} corners as on a board of squares={squares}" if count >= MIN_CORNERS else text


class _Markers(NamedTuple):
    """The markers of a dictionary in a picture."""

    picture: np.ndarray
    dictionary: str
    ids: np.ndarray
    corners: Sequence[np.ndarray]


def _find_markers(picture: np.ndarray, dictionary: str) -> _Markers:
    corners, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary)).detectMarkers(picture)
    return _Markers(picture, dictionary, np.empty((0, 1), dtype=np.int32) if ids is None else ids, corners)


def _smallest_dictionary(dictionary: str, highest: int, *, preferred: str) -> str:
    """Return the preferred dictionary, or the smallest one of this kind, that has a marker with this number."""
    kind = dictionary.rpartition("_")[0]
    if not kind.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6", "DICT_7X7")):
        return dictionary
    if preferred.rpartition("_")[0] == kind and highest < int(preferred.rpartition("_")[2]):
        return preferred
    return next(f"{kind}_{count}" for count in (50, 100, 250, 1000) if highest < count)


def _find_squares(markers: _Markers, board: Charuco) -> tuple[str, int]:
    """Return the squares of the smallest board that turns these markers into most corners, and their number."""
    squares, num_corners, available = "", 0, len(marker_dictionary(board.dictionary).bytesList)
    for columns, rows in sorted(itertools.product(_SIDES, _SIDES), key=math.prod):
        if not markers.ids.max() < columns * rows // 2 <= available:
            continue
        candidate = replace(board, squares=f"{columns}x{rows}")
        for legacy in candidates(board.legacy):
            detector = cv2.aruco.CharucoDetector(candidate.to_opencv(legacy=legacy))
            _, ids, _, _ = detector.detectBoard(markers.picture, markerCorners=markers.corners, markerIds=markers.ids)
            if ids is not None and len(ids) > num_corners:
                squares, num_corners = candidate.squares, len(ids)
    return squares, num_corners
