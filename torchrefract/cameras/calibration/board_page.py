"""Pages with a board at true scale, with a ruler and the definition of the board below it."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from torchrefract.cameras.calibration.boards import Board

_MM_PER_INCH = 25.4
_CAPTION_MM = 12.0  # height of the strip below the margin
_RULER_MM = 100.0
_FONT_MM = 2.6


def board_page(board: Board, *, margin_mm: float) -> Figure:
    """Draw a board with a margin and, below it, a ruler and the definition of the board.

    A PDF of the figure has true scale; a PNG has dpi / 25.4 px for each mm.

    Args:
        board: to draw; "auto" patterns are drawn as False.
        margin_mm: around the board, white, or black for an inverted board.
    """
    (width, height), margin = board.size_mm, float(margin_mm)
    page = width + 2 * margin, height + 2 * margin + _CAPTION_MM
    figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(-margin, page[0] - margin)
    axes.set_ylim(page[1] - margin, -margin)
    axes.set_axis_off()
    axes.add_patch(PathPatch(_black_outline(board, margin), facecolor="black", lw=0, snap=False))
    _draw_caption(figure, board, margin, page)
    return figure


def _draw_caption(figure: Figure, board: Board, margin: float, page: tuple[float, float]) -> None:
    """Draw the ruler and two lines of text; they start at the left edge of the board."""
    axes, top = figure.axes[0], page[1] - _CAPTION_MM
    length = min(_RULER_MM, 10 * (board.size_mm[0] // 10))
    y = top + 2 - margin
    axes.plot([0, length], [y, y], color="black", lw=0.6)
    for x in (0.0, length):
        axes.plot([x, x], [y - 1, y + 1], color="black", lw=0.6)
    lines = (f"this line is {length:g} mm long if printed at true scale (100 %)", board.describe())
    for text, offset in zip(lines, (6.5, 10.0), strict=True):
        place = margin / page[0], 1 - (top + offset) / page[1]
        figure.text(*place, text, fontsize=_FONT_MM / _MM_PER_INCH * 72, parse_math=False)


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
