"""Calibration boards: their corners, where they are black, and pages with a board at true scale."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from torchrefract._validation import check_choice, check_positive

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
# Each of these begins with the markers of the smaller dictionaries of its kind.
LARGEST_DICTIONARIES = (
    *(f"DICT_{cells}_1000" for cells in ("4X4", "5X5", "6X6", "7X7")),
    "DICT_ARUCO_ORIGINAL",
    *(f"DICT_APRILTAG_{kind}" for kind in ("16h5", "25h9", "36h10", "36h11")),
)
MIN_CORNERS = 6  # of a view
_MAX_SQUARES = 100  # along a side
_MM_PER_INCH = 25.4
_CAPTION_MM = 12.0  # height of the strip below the margin
_RULER_MM = 100.0
_FONT_MM = 2.6


@dataclass(frozen=True, kw_only=True)
class Board:
    """A plane of alternating black and white squares.

    Coordinates are in mm from the upper left corner of the board, x to the right and y down.

    Args:
        squares: columns x rows of squares, such as "11x8", at least 3 of each and 6 inner corners.
        square_mm: side of a square.
    """

    squares: str = "11x8"
    square_mm: float = 22.0
    min_squares: ClassVar[int] = 3  # along a side

    def __post_init__(self) -> None:
        _ = self.num_squares
        check_positive("square_mm", self.square_mm)

    @cached_property
    def num_squares(self) -> tuple[int, int]:
        """Return the numbers of columns and rows of squares."""
        columns, _, rows = str(self.squares).lower().partition("x")
        if not (columns.isdecimal() and rows.isdecimal()):
            raise ValueError(f"squares must be columns x rows, such as 11x8, got {self.squares!r}")
        if not all(self.min_squares <= int(n) <= _MAX_SQUARES for n in (columns, rows)):
            raise ValueError(
                f"squares must be from {self.min_squares} to {_MAX_SQUARES} in columns and rows, got {self.squares}"
            )
        if (count := (int(columns) - 1) * (int(rows) - 1)) < MIN_CORNERS:
            raise ValueError(
                f"squares must have at least {MIN_CORNERS} inner corners, which a view needs, got {self.squares} with "
                f"{count}"
            )
        return int(columns), int(rows)

    @property
    def num_corners(self) -> tuple[int, int]:
        """Return the numbers of columns and rows of inner corners, where four squares meet."""
        columns, rows = self.num_squares
        return columns - 1, rows - 1

    @property
    def size_mm(self) -> tuple[float, float]:
        """Return width and height."""
        columns, rows = self.num_squares
        return columns * self.square_mm, rows * self.square_mm

    def corners(self, ids: np.ndarray | None = None) -> np.ndarray:
        """Return the inner corners with these ids, (N, 3), mm, z = 0; None returns all, row by row."""
        columns, rows = self.num_corners
        ids = np.arange(columns * rows) if ids is None else ids
        row, column = np.divmod(ids, columns)
        return np.stack([column + 1, row + 1, np.zeros_like(row)], axis=1) * float(self.square_mm)

    def is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return True where the board is black at points in mm; everything outside of it is white."""
        i, j, inside = self._square_at(x, y)
        return ((i + j) % 2 == 0) & inside

    def color_edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sorted x and y, mm, from border to border, such that each cell between them has one color."""
        columns, rows = self.num_squares
        return np.arange(columns + 1) * float(self.square_mm), np.arange(rows + 1) * float(self.square_mm)

    def describe(self) -> str:
        """Return the options of the commands that define this board."""
        return f"board=chessboard squares={self.squares} square_mm={self.square_mm:g}"

    def _square_at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return column and row of the square at points in mm, and whether it is on the board."""
        columns, rows = self.num_squares
        i, j = np.floor(x / self.square_mm).astype(int), np.floor(y / self.square_mm).astype(int)
        return i, j, (i >= 0) & (j >= 0) & (i < columns) & (j < rows)


class Chessboard(Board):
    """A chessboard; all of it must be visible, since its squares look alike. It has at least 4 x 4 squares."""

    min_squares: ClassVar[int] = 4  # OpenCV detects three inner corners and more


@dataclass(frozen=True, kw_only=True)
class Charuco(Board):
    """A chessboard with an ArUco marker in each white square; any part of it may be visible.

    Args:
        squares, square_mm: as for `Board`.
        marker_mm: side of a marker, below `square_mm`.
        dictionary: OpenCV's name of the set of markers; its first markers fill the board row by row.
        legacy: True for the pattern of OpenCV up to version 4.6, which differs on boards with an even number of rows;
            "auto" detects either.
        inverted: True if black and white are exchanged; "auto" detects either.
    """

    marker_mm: float = 14.0
    dictionary: str = "DICT_5X5_250"
    legacy: str | bool = "auto"
    inverted: str | bool = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not check_positive("marker_mm", self.marker_mm) < self.square_mm:
            raise ValueError(f"marker_mm must be below square_mm = {self.square_mm:g}, got {self.marker_mm:g}")
        check_choice("dictionary", self.dictionary, DICTIONARIES)
        for name in ("legacy", "inverted"):
            if getattr(self, name) not in ("auto", True, False):
                raise ValueError(f"{name} must be auto, true or false, got {getattr(self, name)!r}")
        available, (columns, rows) = len(marker_dictionary(self.dictionary).bytesList), self.num_squares
        if columns * rows // 2 > available:
            raise ValueError(
                f"dictionary must hold the {columns * rows // 2} markers of a board of {self.squares} squares, "
                f"got {self.dictionary} with {available}"
            )

    def to_opencv(self, *, legacy: bool) -> "cv2.aruco.CharucoBoard":
        """Create OpenCV's board, in mm."""
        board = cv2.aruco.CharucoBoard(
            self.num_squares, self.square_mm, self.marker_mm, marker_dictionary(self.dictionary)
        )
        board.setLegacyPattern(legacy)
        return board

    @property
    def _white_parity(self) -> int:
        """Return (column + row) % 2 of white squares."""
        return 0 if self.legacy is True and self.num_squares[1] % 2 == 0 else 1

    @cached_property
    def _marker_cells(self) -> np.ndarray:
        """Return (rows, columns, n, n), bool: the white cells of the marker in each white square."""
        columns, rows = self.num_squares
        dictionary = marker_dictionary(self.dictionary)
        side = dictionary.markerSize + 2
        cells = np.zeros((rows, columns, side, side), dtype=bool)
        white = [(j, i) for j in range(rows) for i in range(columns) if (i + j) % 2 == self._white_parity]
        for number, (j, i) in enumerate(white):
            cells[j, i] = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=1) > 0
        return cells

    def is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return True where the board is black at points in mm; outside is white, or black if it is inverted."""
        i, j, inside = self._square_at(x, y)
        columns, rows = self.num_squares
        i, j = i.clip(0, columns - 1), j.clip(0, rows - 1)
        side = self._marker_cells.shape[2]
        cell_mm, margin = self.marker_mm / side, (self.square_mm - self.marker_mm) / 2
        u, v = (np.floor((p - k * self.square_mm - margin) / cell_mm).astype(int) for p, k in ((x, i), (y, j)))
        on_marker = (u >= 0) & (v >= 0) & (u < side) & (v < side)
        is_black_cell = ~self._marker_cells[j, i, v.clip(0, side - 1), u.clip(0, side - 1)]
        black = inside & (((i + j) % 2 != self._white_parity) | (on_marker & is_black_cell))
        return ~black if self.inverted is True else black

    def color_edges(self) -> tuple[np.ndarray, np.ndarray]:
        side = self._marker_cells.shape[2]
        margin = (self.square_mm - self.marker_mm) / 2
        cells = margin + np.arange(side + 1) * self.marker_mm / side
        x, y = ((np.arange(n)[:, None] * self.square_mm + cells).ravel() for n in self.num_squares)
        square_x, square_y = super().color_edges()
        return np.union1d(square_x, x), np.union1d(square_y, y)

    def describe(self) -> str:
        return (
            f"board=charuco squares={self.squares} square_mm={self.square_mm:g} marker_mm={self.marker_mm:g} "
            f"dictionary={self.dictionary} legacy={str(self.legacy).lower()} inverted={str(self.inverted).lower()}"
        )


def marker_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """Return OpenCV's set of markers of a name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def board_page(board: Board, *, margin_mm: float) -> Figure:
    """Draw a board with a margin and, below it, a ruler and the definition of the board.

    A PDF of the figure has true scale; a PNG has dpi / 25.4 px for each mm. "auto" patterns are drawn as False. The
    margin is white, or black for an inverted board.
    """
    (width, height), margin = board.size_mm, float(margin_mm)
    page = width + 2 * margin, height + 2 * margin + _CAPTION_MM
    figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(-margin, page[0] - margin)
    axes.set_ylim(page[1] - margin, -margin)
    axes.set_axis_off()
    axes.add_patch(PathPatch(_black_outline(board, margin), facecolor="black", lw=0, snap=False))
    # The ruler and two lines of text start at the left edge of the board.
    length, top = min(_RULER_MM, 10 * (width // 10)), height + margin + 2
    axes.plot([0, length], [top, top], color="black", lw=0.6)
    for x in (0.0, length):
        axes.plot([x, x], [top - 1, top + 1], color="black", lw=0.6)
    lines = (f"this line is {length:g} mm long if printed at true scale (100 %)", board.describe())
    for text, y in zip(lines, (5.5, 2.0), strict=True):
        figure.text(margin / page[0], y / page[1], text, fontsize=_FONT_MM / _MM_PER_INCH * 72, parse_math=False)
    return figure


def _black_outline(board: Board, margin: float) -> Path:
    """Return everything black as one path: viewers draw seams between separate rectangles that touch."""
    xs, ys = (np.concatenate([[-margin], edges, [edges[-1] + margin]]) for edges in board.color_edges())
    x, y = np.meshgrid((xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2)
    corners, codes = [], []
    for j, row in enumerate(board.is_black(x, y)):
        runs = np.flatnonzero(np.diff(row.astype(int), prepend=0, append=0))
        for start, end in runs.reshape(-1, 2):
            left, right, top, bottom = xs[start], xs[end], ys[j], ys[j + 1]
            corners += [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
            codes += [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path(corners, codes)
