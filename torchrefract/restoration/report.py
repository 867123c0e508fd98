"""Two pictures of a training run: its curves over the epochs, and a panel of examples."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from torchrefract._io import replace_file
from torchrefract.restoration.history import metrics_rows
from torchrefract.visualization.color import flow_to_rgb, flow_wheel, full_color_px, hatch_invalid
from torchrefract.visualization.figures import FigureLayout, resize_for_display

_Columns = dict[str, dict[int, float]]  # name -> epoch -> value


class _Style(NamedTuple):
    column: str
    label: str
    color: str
    line: str


_STYLES = (
    _Style("train/{}", "training", "#7fb2dd", "-"),
    _Style("val/{}", "validation", "#08306b", "-"),
    _Style("val/{}_identity", "do nothing", "#6b6b6b", "--"),
    _Style("val/{}_constant", "best constant flow", "#d95f02", "--"),
)


def save_curves(run: Path, out: Path, *, epe_unit: str = "px") -> None:
    """The curves of a run as a picture: loss, PSNR and endpoint error over the epochs, beside what needs no network.

    A quantity whose columns are missing has no panel. Training values are means over an epoch's rows, validation
    values the last of an epoch; a value that is not finite leaves a gap. A label holds the last value in brackets.

    Args:
        run: the run folder, with the metrics.csv of Lightning's CSVLogger and, after a stop, metrics_before.csv.
        out: the picture to write; the suffix is its format.
        epe_unit: the unit of the endpoint error, with the image size that it holds for: "px at 1920x1080".
    """
    figure = _curves(run, epe_unit=epe_unit)
    with replace_file(out) as path:
        figure.savefig(path)


def _curves(run: Path, *, epe_unit: str) -> Figure:
    units = {"loss": "loss", "psnr": "PSNR (dB)", "epe": f"endpoint error ({epe_unit})"}
    columns = _read_columns(run, [style.column.format(quantity) for quantity in units for style in _STYLES])
    shown = {q: unit for q, unit in units.items() if any(style.column.format(q) in columns for style in _STYLES)}
    if not shown:
        raise ValueError(f"metrics must hold a loss, psnr or epe of some epoch, got none in {run}")
    figure = Figure(figsize=(4.8 * len(shown), 4.4), dpi=120, layout=ConstrainedLayoutEngine(w_pad=0.12))
    for axes, (quantity, unit) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
        _draw_quantity(axes, columns, quantity)
        axes.set_ylabel(unit, parse_math=False)
        axes.set_title(f"{unit.split(' (')[0]}, {'higher' if quantity == 'psnr' else 'lower'} is better", fontsize=11)
    return figure


def _draw_quantity(axes: Axes, columns: _Columns, quantity: str) -> None:
    for style in _STYLES:
        if column := columns.get(style.column.format(quantity)):
            _draw_curve(axes, column, style)
    axes.set_xlabel("epoch")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.grid(color="#e4e4e4", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False, fontsize=9)


def _draw_curve(axes: Axes, column: dict[int, float], style: _Style) -> None:
    epochs, values = list(column), list(column.values())
    label = f"{style.label} ({values[-1]:.4g})"
    if style.line == "--" and len(values) == 1:  # one point of a dashed line would not be seen
        axes.axhline(values[0], color=style.color, linestyle=style.line, label=label)
        return
    # Markers also show a point that stands alone between gaps.
    marker = "" if style.line == "--" else "o"
    axes.plot(epochs, values, style.line, color=style.color, marker=marker, markersize=3, linewidth=1.6, label=label)


def _read_columns(run: Path, names: Sequence[str]) -> _Columns:
    """Those of the columns `names` that have a value at all; a logger leaves most cells of a row empty."""
    cells: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in metrics_rows(run):
        for name in names:
            if row.get("epoch") and row.get(name):
                cells[name][int(row["epoch"])].append(float(row[name]))
    return {name: {epoch: _of_epoch(name, by[epoch]) for epoch in sorted(by)} for name, by in cells.items()}


def _of_epoch(name: str, values: list[float]) -> float:
    return fmean(values) if name.startswith("train/") else values[-1]


@dataclass(frozen=True)
class PanelRows:
    """The N examples of a panel, N from 1 to 8.

    degraded, clean, restored: (N, 3, H, W), float in [0, 1].
    flow, predicted_flow: (N, 2, H, W), px; None where the corruption moves nothing or the network predicts no flow.
    valid: (N, 1, H, W), bool, the pixels that the degraded image can still give back.
    captions: N texts.
    """

    degraded: Tensor
    clean: Tensor
    restored: Tensor
    valid: Tensor
    captions: Sequence[str]
    flow: Tensor | None = None
    predicted_flow: Tensor | None = None

    def __post_init__(self) -> None:
        if self.clean.ndim != 4 or self.clean.shape[1] != 3 or not 1 <= len(self.clean) <= 8:
            raise ValueError(f"clean must have shape (N, 3, H, W) with N from 1 to 8, got {tuple(self.clean.shape)}")
        for name, channels in (("degraded", 3), ("restored", 3), ("valid", 1), ("flow", 2), ("predicted_flow", 2)):
            _check_like(name, getattr(self, name), self.clean, channels=channels)
        if self.valid.dtype != torch.bool:
            raise TypeError(f"valid must be of type bool, got {self.valid.dtype}")
        if len(self.captions) != len(self.clean):
            raise ValueError(f"captions must be {len(self.clean)} texts, got {len(self.captions)}")


def save_panel(rows: PanelRows, out: Path) -> None:
    """Examples as a picture, one a row: clean, corrupted, restored, then true and predicted flow on one scale.

    Where there is no flow, the last column is the error |restored - clean|, four times brighter. Pixels that are not
    valid are hatched from the third column on; values that are not finite are gray.

    Args:
        rows: what to draw.
        out: the picture to write; the suffix is its format.
    """
    figure = _panel(rows)
    with replace_file(out) as path:
        figure.savefig(path)


def _check_like(name: str, value: Tensor | None, clean: Tensor, *, channels: int) -> None:
    shape = (clean.shape[0], channels, *clean.shape[2:])
    if value is not None and value.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(value.shape)}")


def _panel(rows: PanelRows) -> Figure:
    scale = _full_color_px(rows)
    columns = _columns(rows, scale)
    lines = 1 + max(caption.count("\n") for caption in rows.captions)
    height, width = columns["clean"].shape[2:]
    page = FigureLayout(len(rows.clean), len(columns), height, width, lines)
    figure = page.figure()
    for j, (title, images) in enumerate(columns.items()):
        page.write(figure, title, page.left(j) + page.width / 2, 2 * page.text, ha="center", weight="bold")
        for i, image in enumerate(images):
            page.show(figure, image, page.left(j), page.top(i))
    for i, caption in enumerate(rows.captions):
        page.write(figure, caption, page.left(0), page.top(i) - 0.3 * page.text)
    _draw_key(figure, page, rows, scale)
    return figure


def _columns(rows: PanelRows, scale: float) -> dict[str, Tensor]:
    """Title -> (N, 3, height, width), in the pixels that they are drawn with."""
    derived = {"restored": rows.restored}
    for title, flow in (("true flow", rows.flow), ("predicted flow", rows.predicted_flow)):
        if flow is not None:
            derived[title] = flow_to_rgb(flow, max_px=scale)
    if len(derived) == 1:
        derived["|restored - clean| x 4"] = 4 * (rows.restored - rows.clean).abs()
    hatched = {title: hatch_invalid(resize_for_display(image), rows.valid) for title, image in derived.items()}
    return {"clean": resize_for_display(rows.clean), "corrupted": resize_for_display(rows.degraded)} | hatched


def _full_color_px(rows: PanelRows) -> float:
    """The scale of the true flow, if it moves anything; a stray prediction must not pale the truth."""
    moving = [flow for flow in (rows.flow, rows.predicted_flow) if flow is not None and flow.any()]
    return full_color_px(moving[0], rows.valid) if moving else 1.0


def _draw_key(figure: Figure, page: FigureLayout, rows: PanelRows, scale: float) -> None:
    """A stripe below all rows: what hatching means and, where there is flow, the color wheel with its scale."""
    text, y = page.text, page.top(page.rows) - page.text
    if not rows.valid.all():
        stripes = hatch_invalid(torch.zeros(1, 3, page.height, page.width), torch.zeros(1, 1, 1, 1, dtype=torch.bool))
        page.explain(figure, stripes[0], "not valid: lost in the corrupted image", x=page.left(0), y=y + text)
    if rows.flow is None and rows.predicted_flow is None:
        return
    height, width = rows.clean.shape[2:]
    x = page.left(page.columns - 2)
    page.show(figure, flow_wheel(4 * text), x, y)
    for line, below in ((f"full color = {scale:g} px at {width}x{height}", 1.9), ("darker = longer", 3.4)):
        page.write(figure, line, x + 5 * text, y + below * text)
