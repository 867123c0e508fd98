"""What no other choice beats in both time and error, and the picture of it."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Annotation
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from torchrefract._io import replace_file

# What is drawn at the foot of a panel: errors that small are rounding, or none at all.
FLOOR = 1e-5
_COLORS = ("#1f77b4", "#d1495b", "#2e8b57", "#8a5fbf", "#c77f1a")
_COLUMNS = 2
_MARKER, _STEP, _MOST_STEPS = 5, 5, 8  # points: of markers, and steps from those to labels
# Where labels are tried in each step, from their points.
_AROUND = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))


class Point(NamedTuple):
    """One choice of a panel."""

    label: str
    series: str  # whose points are held against the same truth
    time: float
    error: float
    joined: bool  # by a line with the others of its series that are


def front(costs: Sequence[tuple[float, float]]) -> list[int]:
    """The places, by rising first cost, of what no other beats: as good in one and better in the other."""
    best, found = float("inf"), []
    for i in sorted(range(len(costs)), key=lambda i: costs[i]):
        if costs[i][1] < best or (found and costs[i] == costs[found[-1]]):
            found.append(i)
            best = costs[i][1]
    return found


def draw(path: Path, panels: Mapping[str, Sequence[Point]], *, x: str, y: str) -> None:
    """A picture with a panel for each effect, the fronts of its series drawn; the file is there whole or not at all."""
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(5.2 * _COLUMNS, 3.1 * rows), dpi=110, layout="constrained")
    places = list(figure.subplots(rows, _COLUMNS, squeeze=False, sharey=True).flat)
    drawn = list(zip(places, panels.items(), strict=False))
    for axes, (title, points) in drawn:
        _draw_panel(axes, title, points)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    figure.supxlabel(x, fontsize=11)
    figure.supylabel(y, fontsize=11)
    figure.draw_without_rendering()  # from here on everything has its place
    figure.set_layout_engine("none")
    for axes, (_, points) in drawn:
        _label(axes, points)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        figure.savefig(temporary)


def _draw_panel(axes: Axes, title: str, points: Sequence[Point]) -> None:
    for color, (series, own) in _colored(points):
        best = sorted(_place(point) for point in own if point.joined)
        axes.plot(*zip(*best, strict=True) if best else ([], []), color=color, linewidth=1.2)
        axes.plot(*zip(*map(_place, own), strict=True), "o", color=color, markersize=_MARKER, label=series)
    _dress(axes, title, [point.time for point in points])


def _colored(points: Sequence[Point]) -> Iterator[tuple[str, tuple[str, list[Point]]]]:
    """The series, each with its color."""
    by_series: dict[str, list[Point]] = defaultdict(list)
    for point in points:
        by_series[point.series].append(point)
    return zip(_COLORS, by_series.items(), strict=False)


def _place(point: Point) -> tuple[float, float]:
    return point.time, max(point.error, FLOOR)


def _label(axes: Axes, points: Sequence[Point]) -> None:
    """Each label beside its point, clear of markers, lines, the legend and one another, where there is such a place.

    Those that have to go farther away have a line to their point.
    """
    half = cast(Figure, axes.get_figure(root=True)).dpi / 72 * _MARKER / 2
    taken = [_around(axes.transData.transform(_place(point)), half) for point in points]
    for line in axes.get_lines():
        corners = axes.transData.transform(np.stack(line.get_data(), axis=1))
        if line.get_linestyle() != "None":
            taken += [_around(at, 1.0) for ends in pairwise(corners) for at in np.linspace(*ends, num=100)]
    taken.append(cast(Legend, axes.get_legend()).get_window_extent())
    for color, (_, own) in _colored(points):
        for point in sorted((point for point in own if point.label), key=lambda point: not point.joined):
            options = {"textcoords": "offset points", "fontsize": 8, "color": color}
            text = axes.annotate(point.label, _place(point), (0, 0), **options)
            taken.append(_put(text, taken, axes.get_window_extent()))
            if max(map(abs, text.get_position())) > _STEP:
                leader = {"arrowstyle": "-", "color": color, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 0}
                axes.annotate("", _place(point), text.get_position(), textcoords="offset points", arrowprops=leader)


def _around(at: NDArray[np.float64], half: float) -> Bbox:
    return Bbox.from_extents(at[0] - half, at[1] - half, at[0] + half, at[1] + half)


def _put(text: Annotation, taken: Sequence[Bbox], inside: Bbox) -> Bbox:
    """The label where it is clear of others, as near as can be, or at its first place; the box it has there."""
    places = [(steps, side) for steps in range(1, _MOST_STEPS + 1) for side in _AROUND]
    for steps, (right, up) in (*places, places[0]):
        text.set_position((_STEP * steps * right, _STEP * steps * up))
        text.set(ha=("right", "center", "left")[right + 1], va=("top", "center", "bottom")[up + 1])
        box = text.get_window_extent()
        if inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and not box.count_overlaps(taken):
            return box
    return text.get_window_extent()


def _dress(axes: Axes, title: str, times: Sequence[float]) -> None:
    axes.set(xscale="log", yscale="log")
    middle, half = (max(times) * min(times)) ** 0.5, max((max(times) / min(times)) ** 0.5, 1.5)
    axes.set_xlim(middle / half**1.5, middle * half**1.5)
    axes.set_ylim(FLOOR / 3, 1000)  # with room for the legend
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title(title, fontsize=11)
    axes.grid(color="#e4e4e4", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper right", frameon=False, fontsize=8)
