"""A sheet of effects on one frame, one a row: frame, corrupted, checkerboard, UV map, restored."""

import textwrap
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract.cameras.distortion import POLYNOMIAL12
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.page import Page, as_drawn
from torchrefract.restoration.metrics import psnr
from torchrefract.types import Degraded
from torchrefract.viz import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    transmission_to_rgb,
)
from torchrefract.warping.grid import length
from torchrefract.warping.jacobian import folded
from torchrefract.warping.resample import warp

_COLUMNS = ("frame", "corrupted", "checkerboard", "UV map", "restored")
_LARGEST = 480  # px, the longer side of an image as drawn
_CELLS = 20  # squares of the checkerboard along the longer side
_UNTOUCHED = "left alone"
_WORDS: dict[str, Callable[[Tensor], str]] = {
    "amplitude": lambda value: f"amplitude {value:.2g} px",
    "length": lambda value: f"length {value:.3g} px",
    "aperture": lambda value: f"aperture {value:.2g} px",
    "displacement": lambda moved: f"{len(moved)} points moved by {moved.square().mean().sqrt():.2g} px rms in x and y",
    "coefficients": lambda row: ", ".join(f"{k} {v:.2g}" for k, v in zip(POLYNOMIAL12, row.tolist(), strict=True) if v),
    "focal": lambda row: f"focal length {row[0]:.2f} widths",
    "visibility": lambda value: f"visibility {value:.3g} m",
}


class SheetRow(NamedTuple):
    """An effect on the frame; images are (3, h, w), in the pixels that they are drawn with."""

    title: str  # the effect, and what was drawn for it
    scores: str  # what it did
    frame: Tensor
    corrupted: Tensor
    checkerboard: Tensor
    map_name: str  # what the map shows
    map: Tensor | None
    scale_px: float | None  # px of full color, of a map that shows a flow
    restored: Tensor | None


def make_row(name: str, effect: Effect, *, frame: Tensor, seed: int, depth: Tensor | None = None) -> SheetRow:
    """The row of an effect: what `effect.degrade(frame, seed=seed, depth=depth)` makes of a frame, and its maps.

        restored = warp(corrupted, restore_flow), bicubic

    The checkerboard goes through the same draw; its folded pixels are marked. Its, the map's and the restored frame's
    pixels that are not valid are hatched. All is computed in the pixels of the frame, and shrunk to be drawn.

    Args:
        name: what the row is called.
        effect: any.
        frame: (1, 3, H, W), float in [0, 1].
        seed: of the draw.
        depth: (1, 1, H, W), m, for the effects that ask for it.

    Raises:
        ValueError: what the effect raises for this frame.
    """
    height, width = frame.shape[2:]
    board = checkerboard(height, width, cell=max(1, round(max(height, width) / _CELLS)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of folds, which the sheet shows
        degraded = effect.degrade(frame, seed=seed, depth=depth)
        bent = effect.apply(board, degraded.params, depth=depth).image
    map_name, map_image, scale_px = _map(degraded)
    restored = warp(degraded.image, degraded.restore_flow, interpolation="bicubic")[0] if _moves(degraded) else None
    folds = _folded(degraded)
    return SheetRow(
        title=": ".join(filter(None, (name, drawn(effect, degraded.params)))),
        scores=_scores(degraded, frame, restored=restored, folds=folds),
        frame=_shrunk(frame)[0],
        corrupted=_shrunk(degraded.image)[0],
        checkerboard=mark_folded(hatch_invalid(_shrunk(bent), degraded.valid), folds)[0],
        map_name=map_name,
        map=None if map_image is None else hatch_invalid(_shrunk(map_image), degraded.valid)[0],
        scale_px=scale_px,
        restored=None if restored is None else hatch_invalid(_shrunk(restored), degraded.restore_valid)[0],
    )


def drawn(effect: Effect, params: Any) -> str:
    """The parameters of the first sample in words, "amplitude 2.3 px, length 31 px", those of zero left out."""
    if isinstance(effect, Compose):
        leaves = [f"{type(leaf).__name__} ({drawn(leaf, own)})" for leaf, own in effect.leaves(params) if own.gate[0]]
        return " + ".join(leaves) or _UNTOUCHED
    if not params.gate[0]:
        return _UNTOUCHED
    values = {name: value[0] for name, value in zip(params._fields, params, strict=True)}
    return ", ".join(words(values[name]) for name, words in _WORDS.items() if name in values and values[name].any())


def sheet(rows: Sequence[SheetRow], *, title: str) -> Figure:
    """The rows below a title, as a picture; above each UV map is its own scale.

    Args:
        rows: at least one, all of one frame.
        title: one line.
    """
    page = Page(len(rows), len(_COLUMNS), *rows[0].frame.shape[1:], caption_lines=1, header_lines=4, footer_lines=1)
    # A letter is about half as wide as a line is high; a caption ends where the legend of the map begins.
    letters = 2 * _COLUMNS.index("UV map") * page.pitch // page.text
    captions = [(textwrap.wrap(row.title, letters), textwrap.wrap(row.scores, letters)) for row in rows]
    page = page._replace(caption_lines=max(len(head) + len(tail) for head, tail in captions))
    figure = page.figure()
    page.write(figure, title, page.left(0), 2 * page.text, weight="bold")
    for j, column in enumerate(_COLUMNS):
        page.write(figure, column, page.left(j) + page.width / 2, 4 * page.text, ha="center", weight="bold")
    for i, (row, (head, tail)) in enumerate(zip(rows, captions, strict=True)):
        y = page.top(i) - 0.3 * page.text
        page.write(figure, "\n".join(tail), page.left(0), y)
        page.write(figure, "\n".join(head), page.left(0), y - 1.3 * len(tail) * page.text, weight="bold")
        _draw_row(figure, page, row, i)
    _draw_key(figure, page)
    return figure


def _moves(degraded: Degraded) -> bool:
    return degraded.has("flow")


def _shrunk(image: Tensor) -> Tensor:
    return as_drawn(image, largest=_LARGEST)


def _folded(degraded: Degraded) -> Tensor:
    """(1, 1, H, W), as `Degraded.folding` counts them."""
    return folded(degraded.flow, degraded.valid) if _moves(degraded) else torch.zeros_like(degraded.valid)


def _map(degraded: Degraded) -> tuple[str, Tensor | None, float | None]:
    """What there is to map, its picture, and the scale of a flow."""
    if _moves(degraded):
        scale_px = full_color_px(degraded.flow, degraded.valid)
        return "flow", flow_to_rgb(degraded.flow, max_px=scale_px), scale_px
    for name in ("transmission", "intensity"):
        if degraded.has(name):
            return name, transmission_to_rgb(getattr(degraded, name)), None
    return "nothing", None, None


def _scores(degraded: Degraded, frame: Tensor, *, restored: Tensor | None, folds: Tensor) -> str:
    """What happened to the pixels that count: those that can be restored or, without a flow, those that are valid."""
    valid = degraded.valid if restored is None else degraded.restore_valid
    texts = [f"{valid.float().mean().item():.1%} valid"]
    if valid.any():
        texts.append(f"{psnr(degraded.image, frame, valid).item():.1f} dB corrupted")
    if restored is not None:
        longest = (length(degraded.flow) * degraded.valid).max().item()
        texts.insert(0, f"longest displacement {longest:.3g} px")
    if restored is not None and valid.any():
        shaded = degraded.has("transmission") or degraded.has("intensity")
        rest = ", the light left as it is" if shaded else ""
        texts[-1] += f", {psnr(restored, frame, valid).item():.1f} dB restored{rest}"
    if folds.any():
        texts.append(f"{100 * folds.float().mean().item():.2g}% folded")
    return "; ".join(texts)


def _draw_row(figure: Figure, page: Page, row: SheetRow, i: int) -> None:
    images = (row.frame, row.corrupted, row.checkerboard, row.map, row.restored)
    for j, image in enumerate(images):
        if image is not None:
            page.show(figure, image, page.left(j), page.top(i))
        else:
            text = "no flow to undo" if _COLUMNS[j] == "restored" else "nothing to map"
            page.write(figure, text, page.left(j) + page.width / 2, page.top(i) + page.height / 2, ha="center")
    if row.map is not None:
        _draw_legend(figure, page, row, i)


def _draw_legend(figure: Figure, page: Page, row: SheetRow, i: int) -> None:
    """Above the map: the color wheel with its scale, or the colors from 0 to 1."""
    text, x = page.text, page.left(_COLUMNS.index("UV map"))
    y = page.top(i) - 3 * text
    if row.scale_px is not None:
        size = round(2.6 * text)
        page.show(figure, flow_wheel(size), x, y)
        page.write(figure, f"full color = {row.scale_px:g} px", x + size + text / 2, y + 1.3 * text)
        page.write(figure, "darker = longer", x + size + text / 2, y + 2.6 * text)
        return
    bar = transmission_to_rgb(torch.linspace(0, 1, 6 * text).expand(1, 1, text, -1))[0]
    page.write(figure, row.map_name, x + text, y + 1.2 * text)
    page.write(figure, "0", x, y + 2.6 * text)
    page.show(figure, bar, x + text, y + round(1.5 * text))
    page.write(figure, "1", x + 7.4 * text, y + 2.6 * text)


def _draw_key(figure: Figure, page: Page) -> None:
    """A stripe below all rows: what the marks mean."""
    plain, none = torch.zeros(1, 3, page.height, page.width), torch.zeros(1, 1, 1, 1, dtype=torch.bool)
    y = page.top(page.rows) - 2 * page.text
    page.explain(figure, hatch_invalid(plain, none)[0], "not valid: lost, or outside the frame", x=page.left(0), y=y)
    marked = mark_folded(plain + 0.5, ~none)[0]
    page.explain(figure, marked, "folded: shown twice or mirrored", x=page.left(2), y=y)
