"""Boards to calibrate with: where their corners are, and where they are black."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from torchrefract._validation import check_choice, check_positive

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
# Each of these begins with the markers of the smaller ones of its kind.
LARGEST_DICTIONARIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
)
_SMALLEST, _LARGEST = 3, 100  # squares of a side
TRIED = ("auto", True, False)  # values of what is tried both ways, or said


@dataclass(frozen=True, kw_only=True)
class Board:
    """A plane of squares, black and white in turn; x goes right and y down, from its upper left corner, in mm.

    squares: "11x8", columns x rows of squares, at least 3 of each.
    square_mm: the side of a square.
    """

    squares: str = "11x8"
    square_mm: float = 22.0

    def __post_init__(self) -> None:
        _counts(self.squares)
        check_positive("square_mm", self.square_mm)

    @cached_property
    def counts(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        return _counts(self.squares)

    @property
    def inner(self) -> tuple[int, int]:
        """Columns and rows of the corners where four squares meet."""
        columns, rows = self.counts
        return columns - 1, rows - 1

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height."""
        columns, rows = self.counts
        return columns * self.square_mm, rows * self.square_mm

    def corners(self, ids: np.ndarray | None = None) -> np.ndarray:
        """(N, 3), mm, the inner corners of these numbers, or all, row by row; z = 0."""
        columns, rows = self.inner
        ids = np.arange(columns * rows) if ids is None else ids
        row, column = np.divmod(ids, columns)
        return np.stack([column + 1, row + 1, np.zeros_like(row)], axis=1) * float(self.square_mm)

    def is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Where the board is black, at places in mm; what lies outside it is white."""
        columns, rows = self.counts
        i, j = np.floor(x / self.square_mm).astype(int), np.floor(y / self.square_mm).astype(int)
        return ((i + j) % 2 == 0) & (i >= 0) & (j >= 0) & (i < columns) & (j < rows)

    def breaks(self) -> tuple[np.ndarray, np.ndarray]:
        """The x and the y, mm, between which the board is of one color; both begin and end with its border."""
        columns, rows = self.counts
        return np.arange(columns + 1) * float(self.square_mm), np.arange(rows + 1) * float(self.square_mm)

    def describe(self) -> str:
        """The definition in one line, as the commands take it."""
        return f"board=chessboard squares={self.squares} square_mm={self.square_mm:g}"


@dataclass(frozen=True, kw_only=True)
class Chessboard(Board):
    """A chessboard: no square differs from the others, so that all of it must be seen."""


@dataclass(frozen=True, kw_only=True)
class Charuco(Board):
    """A chessboard with a marker in each white square, of which any part can be seen.

    marker_mm: the side of a marker, below that of a square.
    dictionary: OpenCV's name of the set of markers, whose first ones fill the board row by row.
    legacy: OpenCV's pattern up to version 4.6, another one where the rows are even in number: "auto" finds either.
    inverted: black and white exchanged: "auto" finds either.
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
            if getattr(self, name) not in TRIED:
                raise ValueError(f"{name} must be auto, true or false, got {getattr(self, name)!r}")
        held = len(markers(self.dictionary).bytesList)
        if self.markers > held:
            raise ValueError(
                f"dictionary must hold the {self.markers} markers of a board of {self.squares} squares, "
                f"got {self.dictionary} with {held}"
            )

    @property
    def markers(self) -> int:
        """How many there are."""
        columns, rows = self.counts
        return columns * rows // 2

    def opencv(self, legacy: bool) -> "cv2.aruco.CharucoBoard":
        """OpenCV's board in mm."""
        board = cv2.aruco.CharucoBoard(self.counts, self.square_mm, self.marker_mm, markers(self.dictionary))
        board.setLegacyPattern(legacy)
        return board

    @cached_property
    def _modules(self) -> np.ndarray:
        """(rows, columns, n, n), bool: the white cells of each square's marker; all of a black square are black."""
        columns, rows = self.counts
        first = self.legacy is True and rows % 2 == 0
        side = markers(self.dictionary).markerSize + 2
        cells = np.zeros((rows, columns, side, side), dtype=bool)
        places = [(j, i) for j in range(rows) for i in range(columns) if (i + j + first) % 2]
        for number, (j, i) in enumerate(places):
            cells[j, i] = cv2.aruco.generateImageMarker(markers(self.dictionary), number, side, borderBits=1) > 0
        return cells

    def is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Where the board is black, at places in mm; what lies outside it is white, or black if it is inverted."""
        columns, rows = self.counts
        i, j = np.floor(x / self.square_mm).astype(int), np.floor(y / self.square_mm).astype(int)
        inside = (i >= 0) & (j >= 0) & (i < columns) & (j < rows)
        i, j = i.clip(0, columns - 1), j.clip(0, rows - 1)
        side = self._modules.shape[2]
        module, margin = self.marker_mm / side, (self.square_mm - self.marker_mm) / 2
        u, v = (np.floor((p - k * self.square_mm - margin) / module).astype(int) for p, k in ((x, i), (y, j)))
        marked = (u >= 0) & (v >= 0) & (u < side) & (v < side)
        first = self.legacy is True and rows % 2 == 0
        white = (i + j + first) % 2 == 1
        dark = ~self._modules[j, i, v.clip(0, side - 1), u.clip(0, side - 1)]
        black = inside & (~white | (marked & dark))
        return ~black if self.inverted is True else black

    def breaks(self) -> tuple[np.ndarray, np.ndarray]:
        """The x and the y, mm, between which the board is of one color; both begin and end with its border."""
        side = self._modules.shape[2]
        margin = (self.square_mm - self.marker_mm) / 2
        modules = margin + np.arange(side + 1) * self.marker_mm / side
        x, y = ((np.arange(n)[:, None] * self.square_mm + modules).ravel() for n in self.counts)
        square_x, square_y = super().breaks()
        return np.union1d(square_x, x), np.union1d(square_y, y)

    def describe(self) -> str:
        """The definition in one line, as the commands take it."""
        return (
            f"board=charuco squares={self.squares} square_mm={self.square_mm:g} marker_mm={self.marker_mm:g} "
            f"dictionary={self.dictionary} legacy={str(self.legacy).lower()} inverted={str(self.inverted).lower()}"
        )


def markers(dictionary: str) -> "cv2.aruco.Dictionary":
    """OpenCV's set of markers of a name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def _counts(squares: str) -> tuple[int, int]:
    columns, _, rows = str(squares).lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise ValueError(f"squares must be columns x rows, such as 11x8, got {squares!r}")
    if not all(_SMALLEST <= int(n) <= _LARGEST for n in (columns, rows)):
        raise ValueError(f"squares must be from {_SMALLEST} to {_LARGEST} in columns and rows, got {squares}")
    return int(columns), int(rows)
