"""Detection of the corners of a board in a picture, and explanations for pictures without the expected board."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from torchrefract.cameras.calibration.boards import (
    LARGEST_DICTIONARIES,
    MIN_CORNERS,
    Board,
    Charuco,
    marker_dictionary,
)

SEARCH_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
# Half the side of the window for the refinement of a corner: this share of the distance to the nearest marker, or of
# half a square, within these bounds in px. On small squares the lower bound is a share of the square.
_WINDOW_SHARE, _MIN_WINDOW_PX, _MAX_WINDOW_PX, _MIN_WINDOW_SQUARES = 0.7, 5, 10, 0.15
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
_MAX_MOVE = 0.05  # squares that the refinement may move a corner, or 1 px
_MAX_MISFIT = 0.2  # squares between a corner and its place by the homography of its neighbors
_NUM_NEIGHBORS = 8
_SMOOTHNESS = 0.9  # refined corners are used unless their rms misfit exceeds the original one divided by this
_PROBE = 0.1  # squares from a corner, along x and y, at which the colors of its four squares are read
_MIN_CONTRAST = 0.4  # of the median contrast of all corners
_MIN_REFINED = 0.75  # share of the corners that must stay near; otherwise none is refined
_BLURRED_PX = 5.0  # width of the sharpest edges
_MIN_MARKERS = 3
_SIDES = range(3, 21)  # squares along the sides of the boards to try


class View(NamedTuple):
    """The corners of a board in a picture; pixel centers are whole numbers."""

    name: str
    ids: np.ndarray  # (N,), int, of `Board.corners`
    corners: np.ndarray  # (N, 2), float64, px

    def only(self, mask: np.ndarray) -> "View":
        """Return the view with the corners of a mask (N,), bool."""
        return View(self.name, self.ids[mask], self.corners[mask])


class Detection(NamedTuple):
    """The result of the search for a board in a picture."""

    view: View
    size: tuple[int, int]  # width and height, px; (0, 0) for an unreadable picture
    edge_width_px: float  # of the sharpest edges
    problem: str  # why the view cannot be used; empty if it can


def detect(gray: np.ndarray, board: Board, *, name: str = "") -> View:
    """Find the corners of a board in a picture, to a few hundredths of a pixel.

    A ChArUco board is found by its markers, in the colors that show most of them and the pattern that they fit. A
    chessboard is found by OpenCV's `findChessboardCornersSB`, or else by `findChessboardCorners`. Each corner is then
    refined in a window that contains little but its four squares, so that a lens that bends lines does not move it.

    Drops corners that the refinement moves far, that lie at the border of the picture, or that do not fit their
    neighbors. Drops corners of a ChArUco board where black and white do not cross, such as behind a finger. Keeps the
    corners unrefined if many would move far, or if refined corners of a chessboard fit their neighbors worse, as on an
    overexposed board whose black squares do not touch. The picture is (H, W), uint8. A view without corners means that
    no board was found.
    """
    is_charuco = isinstance(board, Charuco)
    clearance = (board.square_mm - board.marker_mm) / board.square_mm / 2 if is_charuco else 0.5
    ids, corners = _find_charuco(gray, board) if is_charuco else _find_chessboard(gray, board)
    view = View(name, np.asarray(ids, dtype=int).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2))
    if len(view.ids) == 0:
        return view
    refined = _refine(gray, view, _WINDOW_SHARE * clearance)
    # Corners of ChArUco boards are interpolated from markers, so that they are smooth even where they are wrong.
    view = refined if is_charuco or _is_as_smooth(board, refined, view) else view
    view = _drop_misfits(board, view)
    return _drop_covered(gray, board, view) if is_charuco else view  # a chessboard is always visible as a whole


def has_enough_corners(view: View, board: Board) -> bool:
    """Return True if a view has at least six corners that are not all in one row or column."""
    row, column = np.divmod(view.ids, board.num_corners[0])
    return len(view.ids) >= MIN_CORNERS and len(np.unique(row)) > 1 and len(np.unique(column)) > 1


def candidates(option: str | bool) -> tuple[bool, ...]:
    """Return the values to try for an option that may be "auto"."""
    return (False, True) if option == "auto" else (bool(option),)


class _Markers(NamedTuple):
    """Markers of a dictionary in a picture."""

    picture: np.ndarray  # (H, W), uint8
    corners: Sequence[np.ndarray]  # each (1, 4, 2), px
    ids: np.ndarray  # (N, 1), int


def _find_markers(picture: np.ndarray, dictionary: str) -> _Markers:
    corners, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary)).detectMarkers(picture)
    return _Markers(picture, corners, np.empty((0, 1), dtype=np.int32) if ids is None else ids)


def _find_charuco(gray: np.ndarray, board: Charuco) -> tuple[Any, Any]:
    """Return ids and corners as OpenCV has them, or two empty tuples."""
    pictures = (255 - gray if is_inverted else gray for is_inverted in candidates(board.inverted))
    markers = max((_find_markers(picture, board.dictionary) for picture in pictures), key=lambda one: len(one.ids))
    return _interpolate(markers, _best_pattern(markers, board)[0])


def _interpolate(markers: _Markers, pattern: "cv2.aruco.CharucoBoard") -> tuple[Any, Any]:
    """Return ids and corners of a board by its markers, or two empty tuples."""
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1  # next to a corner, so that corners near the border of the picture count
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern, parameters).detectBoard(
        markers.picture, markerCorners=markers.corners, markerIds=markers.ids
    )
    return ((), ()) if ids is None else (ids, corners)


def _best_pattern(markers: _Markers, board: Charuco) -> tuple["cv2.aruco.CharucoBoard", float]:
    """Return the pattern of a board that fits markers best, the current one if both do, and their misfit."""
    # On boards with an odd number of rows both patterns are equal.
    legacies = candidates(board.legacy) if board.num_squares[1] % 2 == 0 else (False,)
    patterns = [board.to_opencv(legacy=legacy) for legacy in legacies]
    return min(((pattern, _marker_misfit(markers, pattern)) for pattern in patterns), key=lambda result: result[1])


def _marker_misfit(markers: _Markers, pattern: "cv2.aruco.CharucoBoard") -> float:
    """Return the rms distance of markers from their places on a board by one homography, in hundredths of a square.

    It is rounded, so that patterns that differ by the bending of a lens only are equal. Infinite without markers.
    """
    places, ids = pattern.getObjPoints(), markers.ids.ravel()
    on_board = [k for k, number in enumerate(ids) if number < len(places)]
    if not on_board:
        return math.inf
    plane = np.concatenate([np.asarray(places[ids[k]])[:, :2] for k in on_board])
    picture = np.concatenate([markers.corners[k][0] for k in on_board])
    matrix, _ = cv2.findHomography(picture, plane, 0)
    if matrix is None:
        return math.inf
    errors = cv2.perspectiveTransform(picture[:, None], matrix)[:, 0] - plane
    return round(100 * float((errors**2).sum(axis=1).mean()) ** 0.5 / pattern.getSquareLength())


def _find_chessboard(gray: np.ndarray, board: Board) -> tuple[Any, Any]:
    has_board, corners = cv2.findChessboardCornersSB(gray, board.num_corners, flags=SEARCH_FLAGS)
    if not has_board:
        has_board, corners = cv2.findChessboardCorners(gray, board.num_corners)
    return (range(len(corners)), corners) if has_board else ((), ())


def _refine(gray: np.ndarray, view: View, share: float) -> View:
    """Refine corners in windows with half sides of `share` times the distance to the next corner."""
    height, width = gray.shape
    refined, is_near, is_inside = view.corners.copy(), [], []
    for k, spacing in enumerate(_spacings(view.corners)):
        smallest = min(_MIN_WINDOW_PX, max(2, int(_MIN_WINDOW_SQUARES * spacing)))
        half = int(np.clip(share * spacing, smallest, _MAX_WINDOW_PX))
        start = view.corners[k].astype(np.float32).reshape(1, 1, 2)
        x, y = refined[k] = cv2.cornerSubPix(gray, start, (half, half), (-1, -1), _STOP).reshape(2)
        is_near.append(np.hypot(*(refined[k] - view.corners[k])) <= max(1.0, _MAX_MOVE * spacing))
        is_inside.append(min(x, y, width - 1 - x, height - 1 - y) > half + 1)
    if np.mean(is_near) < _MIN_REFINED:
        return view
    return view._replace(corners=refined).only(np.logical_and(is_near, is_inside))


def _is_as_smooth(board: Board, refined: View, original: View) -> bool:
    """Return True if refined corners fit their neighbors nearly as well as the original ones."""
    views = original.only(np.isin(original.ids, refined.ids)), refined
    error, refined_error = (np.square(_misfits(board, view)).mean() for view in views)
    return bool(error >= _SMOOTHNESS**2 * refined_error)


def _spacings(corners: np.ndarray) -> np.ndarray:
    """Return the distance of each corner to the nearest other one."""
    distances = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return distances.min(axis=1) if len(corners) > 1 else np.zeros(len(corners))


def _drop_misfits(board: Board, view: View) -> View:
    # The worst one is dropped first, since it misleads the others.
    while len(view.ids) > MIN_CORNERS:
        errors = _misfits(board, view) / _spacings(view.corners).clip(min=1e-6)
        if errors.max() <= _MAX_MISFIT:
            break
        view = view.only(np.arange(len(errors)) != errors.argmax())
    return view


def _misfits(board: Board, view: View) -> np.ndarray:
    """Return (N,), px, the distance of each corner from its place by the homography of its neighbors."""
    errors = np.zeros(len(view.ids))
    for k, point, matrix in _homographies(board, view):
        errors[k] = np.hypot(*(cv2.perspectiveTransform(point[None, None], matrix).reshape(2) - view.corners[k]))
    return errors


def _homographies(board: Board, view: View) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield corners on the board with the homography to the picture by their neighbors, unless these are collinear."""
    plane = board.corners(view.ids)[:, :2]
    distances = np.linalg.norm(plane[:, None] - plane[None], axis=2)
    for k, point in enumerate(plane):
        others = np.argsort(distances[k], kind="stable")[1 : _NUM_NEIGHBORS + 1]
        is_line = np.linalg.matrix_rank(plane[others] - plane[others].mean(axis=0)) < 2
        if len(others) >= 4 and not is_line:
            yield k, point, cv2.findHomography(plane[others], view.corners[others], 0)[0]


def _drop_covered(gray: np.ndarray, board: Board, view: View) -> View:
    """Drop corners where two opposite squares are not clearly darker than the two others."""
    contrasts = np.full(len(view.ids), np.nan)
    steps = _PROBE * board.square_mm * np.array([(0, 0), (-1, -1), (1, 1), (-1, 1), (1, -1)])
    for k, point, matrix in _homographies(board, view):
        pixels = cv2.perspectiveTransform((point + steps)[None], matrix).reshape(-1, 2)
        x, y = (pixels[1:] - pixels[0] + view.corners[k]).astype(np.float32).T
        values = cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float).ravel()
        contrasts[k] = max(values[:2].min() - values[2:].max(), values[2:].min() - values[:2].max())
    if np.isnan(contrasts).all():
        return view
    return view.only(np.isnan(contrasts) | (contrasts > _MIN_CONTRAST * np.nanmedian(contrasts)))


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
    if text := _other_charuco(gray, board if isinstance(board, Charuco) else Charuco()):
        return text
    has_board, corners, cells = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), SEARCH_FLAGS | cv2.CALIB_CB_LARGER)
    if not has_board:
        return ""
    rows, columns = cells.shape
    x, y = np.abs(corners.reshape(rows, columns, 2)[0, -1] - corners.reshape(rows, columns, 2)[0, 0])
    if y > x:  # OpenCV counts along either side of the board
        rows, columns = columns, rows
    return f"a chessboard of {columns}x{rows} inner corners, which is squares={columns + 1}x{rows + 1}"


def _other_charuco(gray: np.ndarray, board: Charuco) -> str:
    pictures = (gray, ""), (255 - gray, ", black and white exchanged")
    tried = [
        (_find_markers(picture, name), name, color) for picture, color in pictures for name in LARGEST_DICTIONARIES
    ]
    markers, name, color = max(tried, key=lambda one: len(one[0].ids))
    if len(markers.ids) < _MIN_MARKERS:
        return ""
    low, high = int(markers.ids.min()), int(markers.ids.max())
    name = _smallest_dictionary(name, high, preferred=board.dictionary)
    text = f"{len(markers.ids)} markers of {name}{color}, from number {low} to {high}"
    squares, count = _find_squares(markers, replace(board, squares="3x4", dictionary=name))
    return f"{text}, with {count} corners as on a board of squares={squares}" if count >= MIN_CORNERS else text


def _smallest_dictionary(dictionary: str, highest: int, *, preferred: str) -> str:
    """Return the preferred dictionary, or the smallest one of this kind, that has a marker with this number."""
    kind, _, size = dictionary.rpartition("_")
    if size != "1000":
        return dictionary
    sizes = [preferred.rpartition("_")[2]] if preferred.rpartition("_")[0] == kind else []
    return next(f"{kind}_{count}" for count in (*sizes, 50, 100, 250, 1000) if highest < int(count))


def _find_squares(markers: _Markers, board: Charuco) -> tuple[str, int]:
    """Return the squares of the smallest of the boards that fit markers best, and the number of corners on it."""
    available = len(marker_dictionary(board.dictionary).bytesList)
    sizes = sorted(itertools.product(_SIDES, _SIDES), key=math.prod)
    sizes = [(columns, rows) for columns, rows in sizes if markers.ids.max() < columns * rows // 2 <= available]
    boards = [replace(board, squares=f"{columns}x{rows}") for columns, rows in sizes if columns + rows > 2 * _SIDES[0]]
    results = [(*_best_pattern(markers, one), one.squares) for one in boards]
    if not results:
        return "", 0
    pattern, _, squares = min(results, key=lambda result: result[1])
    return squares, len(_interpolate(markers, pattern)[0])


def measure_marker(gray: np.ndarray, view: View, board: Charuco) -> float:
    """Return the median side of the markers in a picture, mm; NaN if no marker has four corners of a view around it.

    A homography of the nearest corners of the view maps a marker to the board. Blur shrinks the side by a few percent.
    """
    sides = []
    for inverted in candidates(board.inverted):
        for marker in _find_markers(255 - gray if inverted else gray, board.dictionary).corners:
            nearest = np.argsort(np.linalg.norm(view.corners - marker[0].mean(axis=0), axis=1))[:_NUM_NEIGHBORS]
            plane = board.corners(view.ids[nearest])[:, :2]
            if len(nearest) < 4 or np.linalg.matrix_rank(plane - plane.mean(axis=0)) < 2:
                continue
            matrix, _ = cv2.findHomography(view.corners[nearest], plane, 0)
            if matrix is not None:
                sides.append(cv2.contourArea(cv2.perspectiveTransform(marker, matrix)) ** 0.5)
    return float(np.median(sides)) if sides else np.nan
