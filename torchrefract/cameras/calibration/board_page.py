"""Boards on paper, at true scale, with their definition below."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from torchrefract.cameras.calibration.boards import Board

_INCH = 25.4  # mm
_TEXT = 12.0  # mm of height below the margin of the board
_RULER = 100.0  # mm
_SMALL = 2.6  # mm, the height of letters


def board_page(board: Board, *, margin_mm: float) -> Figure:
    """A page with a board, a margin around it, and below that a ruler and the definition.

    Saved as PDF it is as many mm large as its board needs; saved as PNG it has dpi / 25.4 px for each mm.

    Args:
        board: in its first pattern and colors where it may have two.
        margin_mm: around the board, white, or black around one that is inverted.
    """
    (width, height), margin = board.size_mm, float(margin_mm)
    page = width + 2 * margin, height + 2 * margin + _TEXT
    figure = Figure(figsize=(page[0] / _INCH, page[1] / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(-margin, page[0] - margin)
    axes.set_ylim(page[1] - margin, -margin)
    axes.set_axis_off()
    axes.add_patch(PathPatch(_black(board, margin), facecolor="black", lw=0, snap=False))
    _write(figure, board, (margin, page[1] - _TEXT), page)
    return figure


def _write(figure: Figure, board: Board, start: tuple[float, float], page: tuple[float, float]) -> None:
    """A ruler from a place, mm from the upper left, and texts."""
    (left, top), axes = start, figure.axes[0]
    long = min(_RULER, 10 * (board.size_mm[0] // 10))
    origin = axes.get_xlim()[0]
    y = top + 2 + origin
    axes.plot([left + origin, left + origin + long], [y, y], color="black", lw=0.6)
    for x in (0.0, long):
        axes.plot([x, x], [y - 1, y + 1], color="black", lw=0.6)
    points = _SMALL / _INCH * 72
    text = f"this line is {long:g} mm long if printed at true scale (100 %)"
    figure.text(left / page[0], 1 - (top + 6.5) / page[1], text, fontsize=points, parse_math=False)
    figure.text(left / page[0], 1 - (top + 10.0) / page[1], board.describe(), fontsize=points, parse_math=False)


def _black(board: Board, margin: float) -> Path:
    """The outline of all that is black, in one piece, so that no viewer draws seams between rectangles that touch."""
    xs, ys = (np.concatenate([[-margin], breaks, [breaks[-1] + margin]]) for breaks in board.breaks())
    x, y = np.meshgrid((xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2)
    corners, codes = [], []
    for j, row in enumerate(board.is_black(x, y)):
        edges = np.flatnonzero(np.diff(row.astype(int), prepend=0, append=0))
        for start, end in edges.reshape(-1, 2):
            left, right, top, bottom = xs[start], xs[end], ys[j], ys[j + 1]
            corners += [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
            codes += [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path(corners, codes)
