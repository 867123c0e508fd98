"""A sheet of effects on one frame, one a row: frame, corrupted, checkerboard, map, restored."""

import textwrap
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract.cameras.brown_conrady import POLYNOMIAL12
from torchrefract.effects.air import Air
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.effects.defog import remove_fog
from torchrefract.effects.flare import LensFlare
from torchrefract.visualization.figures import FigureLayout, resize_for_display
from torchrefract.restoration.metrics import psnr
from torchrefract.types import Degraded
from torchrefract.visualization.color import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    rounded_up,
    transmission_to_rgb,
)
from torchrefract.warping.grid import length
from torchrefract.warping.flow import folded
from torchrefract.warping.warp import warp

_COLUMNS = ("frame", "corrupted", "checkerboard", "map", "restored")
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
    "contrast": lambda value: f"contrast {value:.2g}",
    "sun": lambda place: f"sun at {place[0]:.2f} widths, {place[1]:.2f} heights",
    "radius": lambda value: f"radius {value:.2g} diagonals",
    "strength": lambda value: f"strength {value:.2g}",
    "center": lambda moved: f"center off by ({moved[0]:.1g}, {moved[1]:.1g}) widths",
    "wind": lambda wind: f"wind ({wind[0]:.2g}, {wind[1]:.2g}) px/frame",
    "wind in space": lambda wind: f"wind ({', '.join(f'{v:.2g}' for v in wind.tolist())}) m/frame",
}
_UNITS = {"extinction": "/m"}
_OFF = {"transmission": 1.0, "intensity": 0.0}  # where nothing is changed


class Scale(NamedTuple):
    """A map, and what its last color stands for."""

    name: str  # in `Degraded`
    top: float  # px of a flow in full color, or so much light


class SheetRow(NamedTuple):
    """An effect on the frame; images are (3, h, w), in the pixels that they are drawn with."""

    title: str  # the effect, and what was drawn for it
    scores: str  # what it did
    frame: Tensor
    corrupted: Tensor
    checkerboard: Tensor
    map: Tensor | None
    scales: tuple[Scale, ...]  # of the map, one for each half if there are two
    restored: Tensor | None


def make_row(name: str, effect: Effect, *, frame: Tensor, seed: int, depth: Tensor | None = None) -> SheetRow:
    """The row of an effect: what `effect.degrade(frame, seed=seed, depth=depth)` makes of a frame, and its maps.

        restored = warp(corrupted, restore_flow), bicubic; of a fog alone, remove_fog(round(255 corrupted) / 255)

    The checkerboard goes through the same draw; its folded pixels are marked. Its pixels, those of a flow's map and of
    the restored frame that are not valid are hatched. All is computed in the frame's pixels, and shrunk to be drawn.

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
    scales, restored, folds = map_scales(degraded), _restored(effect, degraded), _folded(degraded)
    return SheetRow(
        title=": ".join(filter(None, (name, drawn(effect, degraded.params)))),
        scores=_scores(degraded, frame, restored=restored, folds=folds),
        frame=_shrunk(frame)[0],
        corrupted=_shrunk(degraded.image)[0],
        checkerboard=mark_folded(hatch_invalid(_shrunk(bent), degraded.valid), folds)[0],
        map=map_picture(degraded, scales, largest=_LARGEST) if scales else None,
        scales=scales,
        restored=None if restored is None else hatch_invalid(_shrunk(restored.image), restored.valid)[0],
    )


def drawn(effect: Effect, params: Any) -> str:
    """The parameters of the first sample in words, "amplitude 2.3 px, length 31 px", those of zero left out."""
    if isinstance(effect, Compose):
        leaves = [
            f"{type(leaf).__name__} ({drawn(leaf, own)})" for leaf, own in effect.leaves(params) if own.applied[0]
        ]
        return " + ".join(leaves) or _UNTOUCHED
    if not params.applied[0]:
        return _UNTOUCHED
    values = _named(effect, {name: value[0] for name, value in zip(params._fields, params, strict=True)})
    return ", ".join(words(values[name]) for name, words in _WORDS.items() if name in values and values[name].any())


def map_scales(degraded: Degraded) -> tuple[Scale, ...]:
    """The maps to show of what was done: its flow, else its light; an extinction where it is not the same everywhere.

    The scale of a flow is that of its valid pixels, that of an intensity or extinction their largest value.
    """
    if _moves(degraded):
        return (Scale("flow", full_color_px(degraded.flow, degraded.valid)),)
    present = [name for name in _OFF if degraded.has(name)]
    acting = [name for name in present if (getattr(degraded, name) != _OFF[name]).any()]
    light = (acting or present or [None])[0]
    if light == "intensity":
        return (Scale(light, rounded_up(degraded.intensity.amax().item())),)
    if light is None:
        return ()
    k = degraded.extinction if degraded.has("extinction") else torch.zeros(1)
    varied = (Scale("extinction", rounded_up(k.amax().item())),) if k.amax() > 1.001 * k.amin() else ()
    return (Scale(light, 1.0), *varied)


def map_picture(degraded: Degraded, scales: Sequence[Scale], *, largest: int) -> Tensor:
    """The map of the first sample as it is drawn: of two maps the left half of the one, the right half of the other.

    A flow is hatched where it is not valid; light is known everywhere.

    Args:
        degraded: a batch of images.
        scales: of `map_scales`, at least one.
        largest: px, the longer side of what is returned at most, at least 320.

    Returns:
        (3, h, w), in [0, 1].
    """
    if scales[0].name == "flow":
        rgb = flow_to_rgb(degraded.flow[:1], max_px=scales[0].top)
        return hatch_invalid(resize_for_display(rgb, largest=largest), degraded.valid[:1])[0]
    lights = (resize_for_display(getattr(degraded, scale.name)[:1] / scale.top, largest=largest) for scale in scales)
    first, *others = (transmission_to_rgb(light)[0] for light in lights)
    middle = first.shape[2] // 2
    return torch.cat([first[..., :middle], others[0][..., middle:]], dim=2) if others else first


def sheet(rows: Sequence[SheetRow], *, title: str) -> Figure:
    """The rows below a title, as a picture; above each map is its own scale.

    Args:
        rows: at least one, all of one frame.
        title: one line.
    """
    page = FigureLayout(len(rows), len(_COLUMNS), *rows[0].frame.shape[1:], caption_lines=1, header_lines=4, footer_lines=1)
    # A letter is about half as wide as a line is high; a caption ends where the legend of the map begins.
    letters = 2 * _COLUMNS.index("map") * page.pitch // page.text
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
    return resize_for_display(image, largest=_LARGEST)


def _folded(degraded: Degraded) -> Tensor:
    """(1, 1, H, W), as `Degraded.folding` counts them."""
    return folded(degraded.flow, degraded.valid) if _moves(degraded) else torch.zeros_like(degraded.valid)


class _Restored(NamedTuple):
    image: Tensor  # (1, 3, H, W)
    valid: Tensor  # (1, 1, H, W), bool
    how: str  # beside its score


def _restored(effect: Effect, degraded: Degraded) -> _Restored | None:
    """What undoing the flow, or the fog, gives back; None where there is nothing to undo."""
    if _moves(degraded):
        shaded = degraded.has("transmission") or degraded.has("intensity")
        image = warp(degraded.image, degraded.restore_flow, interpolation="bicubic")[0]
        return _Restored(image, degraded.restore_valid, "restored, the light left as it is" if shaded else "restored")
    air = getattr(effect, "air", None)
    if not isinstance(air, Air):
        return None
    # Of the float image it would be exact, which no file is.
    stored = to_float(to_uint8(degraded.image))
    t, airlight = degraded.transmission, degraded.params.airlight
    return _Restored(*remove_fog(stored, t, airlight, linear_light=air.linear_light), "restored from 8 bits")


def _scores(degraded: Degraded, frame: Tensor, *, restored: _Restored | None, folds: Tensor) -> str:
    """What happened to the pixels that count: those that can be restored or, if nothing can be undone, are valid."""
    valid = degraded.valid if restored is None else restored.valid
    texts = [f"{valid.float().mean().item():.1%} valid"]
    if valid.any():
        texts.append(f"{psnr(degraded.image, frame, valid).item():.1f} dB corrupted")
    if _moves(degraded):
        longest = (length(degraded.flow) * degraded.valid).max().item()
        texts.insert(0, f"longest displacement {longest:.3g} px")
    if restored is not None and valid.any():
        texts[-1] += f", {psnr(restored.image, frame, valid).item():.1f} dB {restored.how}"
    if folds.any():
        texts.append(f"{100 * folds.float().mean().item():.2g}% folded")
    return "; ".join(texts)


def _named(effect: Effect, values: dict[str, Tensor]) -> dict[str, Tensor]:
    """The values by their names in `_WORDS`, where one name means several things."""
    mode = getattr(effect, "mode", None)  # of a fog that is not the same everywhere
    if mode == "image":
        values.pop("contrast", None)  # which only a fog in space has
    if mode == "ray":
        values["wind in space"] = values.pop("wind")
    if isinstance(effect, LensFlare):
        values["sun"] = values.pop("center")
    return values


def _draw_row(figure: Figure, page: FigureLayout, row: SheetRow, i: int) -> None:
    images = (row.frame, row.corrupted, row.checkerboard, row.map, row.restored)
    for j, image in enumerate(images):
        if image is not None:
            page.show(figure, image, page.left(j), page.top(i))
        else:
            text = "no flow to undo" if _COLUMNS[j] == "restored" else "nothing to map"
            page.write(figure, text, page.left(j) + page.width / 2, page.top(i) + page.height / 2, ha="center")
    draw_legend(figure, page, row.scales, x=page.left(_COLUMNS.index("map")), y=page.top(i))


def draw_legend(figure: Figure, page: FigureLayout, scales: Sequence[Scale], *, x: int, y: int) -> None:
    """Above a map with its upper left corner at x and y: the color wheel, or the colors of light, with their scale."""
    text = page.text
    if scales and scales[0].name == "flow":
        size = round(2.6 * text)
        page.show(figure, flow_wheel(size), x, y - 3 * text)
        page.write(figure, f"UV: full color = {scales[0].top:g} px", x + size + text / 2, y - 1.7 * text)
        page.write(figure, "darker = longer", x + size + text / 2, y - 0.4 * text)
        return
    bar = transmission_to_rgb(torch.linspace(0, 1, 3 * text).expand(1, 1, text, -1))[0]
    for i, scale in enumerate(reversed(scales)):
        line = y - (0.4 + 1.3 * i) * text
        page.write(figure, "0", x, line)
        page.show(figure, bar, x + text, round(line - 1.1 * text))
        side = "" if len(scales) == 1 else " (right)" if i == 0 else " (left)"
        page.write(figure, f"{scale.top:g}{_UNITS.get(scale.name, '')} {scale.name}{side}", x + 4.4 * text, line)


def _draw_key(figure: Figure, page: FigureLayout) -> None:
    """A stripe below all rows: what the marks mean."""
    plain, none = torch.zeros(1, 3, page.height, page.width), torch.zeros(1, 1, 1, 1, dtype=torch.bool)
    y = page.top(page.rows) - 2 * page.text
    page.explain(figure, hatch_invalid(plain, none)[0], "not valid: lost, or outside the frame", x=page.left(0), y=y)
    marked = mark_folded(plain + 0.5, ~none)[0]
    page.explain(figure, marked, "folded: shown twice or mirrored", x=page.left(2), y=y)
