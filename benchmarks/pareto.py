"""What no other choice beats in both time and error, and the picture of it."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from torchrefract._files import replacing

# What is drawn at the foot of a panel: errors that small are rounding, or none at all.
FLOOR = 1e-5
_COLORS = ("#1f77b4", "#d1495b", "#2e8b57", "#8a5fbf", "#c77f1a")
_COLUMNS = 2


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
    for axes, (title, points) in zip(places, panels.items(), strict=False):
        _draw_panel(axes, title, points)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    figure.supxlabel(x, fontsize=11)
    figure.supylabel(y, fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _draw_panel(axes: Axes, title: str, points: Sequence[Point]) -> None:
    by_series: dict[str, list[Point]] = defaultdict(list)
    for point in points:
        by_series[point.series].append(point)
    for color, (series, own) in zip(_COLORS, by_series.items(), strict=False):
        best = sorted((point.time, max(point.error, FLOOR)) for point in own if point.joined)
        axes.plot(*zip(*best, strict=True) if best else ([], []), color=color, linewidth=1.2)
        shown = [(point.time, max(point.error, FLOOR)) for point in own]
        axes.plot(*zip(*shown, strict=True), "o", color=color, markersize=5, label=series)
        for i, (point, place) in enumerate(zip(own, shown, strict=True)):
            # Neighbors on a front lie close to one another: every other label goes to the left. All others lean.
            left = point.joined and i % 2 == 1
            offset, turned = ((-5, -3) if left else (5, -3), 0) if point.joined else ((2, 4), 40)
            style = {"fontsize": 8, "color": color, "ha": "right" if left else "left", "rotation": turned}
            axes.annotate(point.label, place, offset, textcoords="offset points", rotation_mode="anchor", **style)
    _dress(axes, title, [point.time for point in points])


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
