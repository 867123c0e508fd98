"""The picture in the card of a set of pairs: what their effects' parameters were."""

import io
import math
from collections.abc import Iterable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrefract.cameras.distortion import POLYNOMIAL12
from torchrefract.data.pairs.card import Contents, Values

_COLUMNS, _MOST_BINS = 4, 30
_AXES = ("x", "y", "z")
_UNITS = {
    "amplitude": "px",
    "length": "px",
    "aperture": "px",
    "displacement": "px",
    "visibility": "m",
    "focal": "widths of the frame",
    "radius": "diagonals of the frame",
}


def histograms(found: Contents) -> bytes | None:
    """A PNG with a histogram of each parameter that is not the same in all pairs, or None without one."""
    panels = list(_panels(found.values))
    if not panels:
        return None
    rows = -(-len(panels) // _COLUMNS)
    width, height = 3.2 * _COLUMNS, 2.3 * rows
    figure = Figure(figsize=(width, height), dpi=100)
    # In inches, what panels of this size need.
    figure.subplots_adjust(0.6 / width, 0.5 / height, 1 - 0.15 / width, 1 - 0.3 / height, wspace=0.25, hspace=0.55)
    FigureCanvasAgg(figure)
    for i, (title, label, values) in enumerate(panels):
        axes = figure.add_subplot(rows, _COLUMNS, i + 1)
        axes.hist(values, bins=min(_MOST_BINS, math.isqrt(len(values)) + 1), color="tab:blue", edgecolor="white")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(label, fontsize=8)
        axes.set_ylabel("count" if i % _COLUMNS == 0 else "", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _panels(values: Values) -> Iterable[tuple[str, str, np.ndarray]]:
    """Of each parameter that varies a title, a label and its values; those of many components are put together."""
    for (effect, name), columns in sorted(values.items()):
        arrays = [np.frombuffer(column) for column in columns]
        varied = {i: column for i, column in enumerate(arrays) if np.isfinite(column).all() and np.ptp(column) > 0}
        unit = f", {_UNITS[name]}" if name in _UNITS else ""
        if name == "coefficients" and len(arrays) == len(POLYNOMIAL12):
            yield from ((effect, POLYNOMIAL12[i], column) for i, column in varied.items())
        elif len(arrays) > len(_AXES) and varied:
            yield effect, f"{name}{unit}, all components", np.concatenate(list(varied.values()))
        else:
            for i, column in varied.items():
                yield effect, f"{name}{f' {_AXES[i]}' if len(arrays) > 1 else ''}{unit}", column
