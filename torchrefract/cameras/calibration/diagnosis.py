"""Why a picture shows no board: what it shows instead."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from torchrefract.cameras.calibration.boards import LARGEST_DICTIONARIES, Board, Charuco, markers
from torchrefract.cameras.calibration.detection import FEWEST_CORNERS, SEARCH, View, both, detect, is_enough

BLURRED = 5.0  # px, the width of the sharpest edges
_FEWEST_MARKERS = 3
_SIDES = range(3, 21)  # squares of the boards that are tried


def edge_width(gray: np.ndarray) -> float:
    """The width of the sharpest edges of a picture, px: its range of gray over its steepest slope.

        (g_99% - g_1%) / |grad g|_99.9%

    An edge that is blurred by a Gaussian of width s gets 2.5 s; a picture of one gray has no edge, and infinity.
    """
    values = gray.astype(np.float32)
    across, down = (cv2.Sobel(values, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    slope = float(np.percentile(np.hypot(across, down), 99.9))
    low, high = np.percentile(values, (1, 99))
    return float(high - low) / slope if slope > 0 else np.inf


def explain(gray: np.ndarray, view: View, board: Board) -> str:
    """Why a view that is not enough is none, in a few words."""
    width = edge_width(gray)
    blurred = f"; it is blurred, its sharpest edges are {width:.1f} px wide" if width > BLURRED else ""
    if isinstance(board, Charuco):
        mirrored = detect(np.ascontiguousarray(gray[:, ::-1]), board)
        if is_enough(mirrored, board):
            return f"mirrored: flipped from left to right it shows {len(mirrored.ids)} corners"
    if len(view.ids):
        total = board.inner[0] * board.inner[1]
        return f"{len(view.ids)} of {total} corners, {FEWEST_CORNERS} in two rows and columns are needed{blurred}"
    return f"no board found{blurred}"


def what_instead(gray: np.ndarray, board: Board) -> str:
    """The board that a picture shows where it does not show the one asked for, in words; empty if it shows none."""
    return _other_charuco(gray, board if isinstance(board, Charuco) else Charuco()) or _other_chessboard(gray)


def _other_chessboard(gray: np.ndarray) -> str:
    found, _, cells = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), SEARCH | cv2.CALIB_CB_LARGER)
    if not found:
        return ""
    rows, columns = cells.shape
    return f"a chessboard of {columns}x{rows} inner corners, which is squares={columns + 1}x{rows + 1}"


def _other_charuco(gray: np.ndarray, board: Charuco) -> str:
    tried = [_markers(picture, name) for picture in (gray, 255 - gray) for name in LARGEST_DICTIONARIES]
    found = max(tried, key=lambda one: len(one.corners))
    if len(found.corners) < _FEWEST_MARKERS:
        return ""
    low, high = int(found.ids.min()), int(found.ids.max())
    name = _smallest(found.dictionary, high, like=board.dictionary)
    color = "" if found.picture is gray else ", black and white exchanged"
    words = f"{len(found.ids)} markers of {name}{color}, from number {low} to {high}"
    squares, count = _squares(found, replace(board, squares="3x3", dictionary=name))
    return f"{words}, with {count} corners as on a board of squares={squares}" if count >= FEWEST_CORNERS else words


class _Markers(NamedTuple):
    """The markers of a dictionary that a picture shows."""

    picture: np.ndarray
    dictionary: str
    ids: np.ndarray
    corners: Sequence[np.ndarray]


def _markers(picture: np.ndarray, dictionary: str) -> _Markers:
    corners, ids, _ = cv2.aruco.ArucoDetector(markers(dictionary)).detectMarkers(picture)
    return _Markers(picture, dictionary, np.empty((0, 1), dtype=np.int32) if ids is None else ids, corners)


def _smallest(dictionary: str, highest: int, *, like: str) -> str:
    """The smallest dictionary like this one that has a marker of that number, or the one asked for if that has."""
    kind = dictionary.rpartition("_")[0]
    if not kind.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6", "DICT_7X7")):
        return dictionary
    if like.rpartition("_")[0] == kind and highest < int(like.rpartition("_")[2]):
        return like
    return next(f"{kind}_{count}" for count in (50, 100, 250, 1000) if highest < count)


def _squares(found: _Markers, board: Charuco) -> tuple[str, int]:
    """The squares on which markers lie like these, and how many corners they then give."""
    best, most, held = "", 0, len(markers(board.dictionary).bytesList)
    # Of boards that explain as many corners, the smallest.
    for columns, rows in sorted(itertools.product(_SIDES, _SIDES), key=math.prod):
        if not found.ids.max() < columns * rows // 2 <= held:
            continue
        tried = replace(board, squares=f"{columns}x{rows}")
        for legacy in both(board.legacy):
            detector = cv2.aruco.CharucoDetector(tried.opencv(legacy))
            _, ids, _, _ = detector.detectBoard(found.picture, markerCorners=found.corners, markerIds=found.ids)
            if ids is not None and len(ids) > most:
                best, most = tried.squares, len(ids)
    return best, most
