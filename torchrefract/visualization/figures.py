"""The contact sheet of effects on one frame, and the maps and legends that other figures share with it."""

import textwrap
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract.cameras.brown_conrady import POLYNOMIAL12
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.effects.flare import LensFlare
from torchrefract.effects.fog import remove_fog
from torchrefract.effects.physical_turbulence import PhysicalTurbulence
from torchrefract.effects.rolling_shutter import RollingShutter
from torchrefract.effects.sun_glare import SunGlare
from torchrefract.types import Degraded
from torchrefract.visualization.color import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    round_up,
    transmission_to_rgb,
)
from torchrefract.visualization.details import FlowArrows, cut_detail, detail_rows, draw_arrows, flow_arrows
from torchrefract.visualization.layout import FigureLayout, resize_for_display
from torchrefract.warping.flow import folded
from torchrefract.warping.grid import length
from torchrefract.warping.warp import warp

_SHEET_SIDE = 480  # px, largest longer side of an image on a contact sheet
_COLUMNS = ("frame", "corrupted", "checkerboard", "map", "restored")  # fields of ContactSheetRow
_DETAILS = ("horizon", "horizon, corrupted", "road", "road, corrupted")
_SQUARES = 20  # of the checkerboard along the longer side
_PARAMETER_TEXTS: dict[str, Callable[[Tensor], str]] = {
    "amplitude": lambda value: f"amplitude {value:.2g} px",
    "length": lambda value: f"length {value:.3g} px",
    "aperture": lambda value: f"aperture {value:.2g} px",
    "displacement": lambda value: f"{len(value)} control points, {value.square().mean().sqrt():.2g} px rms in x and y",
    "coefficients": lambda value: ", ".join(
        f"{name} {k:.2g}" for name, k in zip(POLYNOMIAL12, value.tolist(), strict=True) if k
    ),
    "focal": lambda value: f"focal length {value[0]:.2f} widths",
    "visibility": lambda value: f"visibility {value:.3g} m",
    "contrast": lambda value: f"contrast {value:.2g}",
    "sun": lambda value: f"sun at {value[0]:.2f} widths, {value[1]:.2f} heights",
    "radius": lambda value: f"radius {value:.2g} diagonals",
    "scatter": lambda value: f"{value:.2g} of the light scattered",
    "speed": lambda value: f"{value:.3g} km/h",
    "readout": lambda value: f"readout {value:.3g} ms",
    "vibration": lambda value: f"vibration {value.abs().max():.2g} deg",
    "difference": lambda value: f"road {value:.2g} K hotter",
    "tilt": lambda value: f"tilt {value:.3g} microradians",
    "ratio": lambda value: f"D / r0 {value:.2g}",
    "scale": lambda value: (
        f"red {value[0]:.2g}, blue {value[-1]:.2g} larger" if value.ndim else f"scale {value:.2g} deg"
    ),
    "target": lambda value: f"mean light {value:.2g}",
    "sunlight": lambda value: f"{value[2]:.0%} of sunlight from {value[0]:.0f} deg right, {value[1]:.0f} deg high",
    "strength": lambda value: f"strength {value:.2g}",
    "center": lambda value: f"center off by ({value[0]:.1g}, {value[1]:.1g}) widths",
    "wind": lambda value: f"wind ({value[0]:.2g}, {value[1]:.2g}) px/frame",
    "wind_s": lambda value: f"wind ({value[0]:.2g}, {value[1]:.2g}) m/s",
    "wind_m": lambda value: f"wind ({', '.join(f'{v:.2g}' for v in value.tolist())}) m/frame",
}
_MAP_UNITS = {"extinction": "/m"}
_WHITE = 1.0  # the largest light of an intensity that is shown
_EQUAL_DB = 100.0  # above it, no image file holds the difference
_NEUTRAL = {"transmission": 1.0, "intensity": 0.0}  # value of a map that changes nothing


_sheet_size = partial(resize_for_display, largest=_SHEET_SIDE)


class MapScale(NamedTuple):
    """A map of `Degraded`, and the value of its last color."""

    name: str
    top: float  # px of a flow in full color, 1/m of an extinction, light of an intensity


class ContactSheetRow(NamedTuple):
    """An effect on a frame; images are (3, h, w), at the size of display."""

    title: str  # name and parameters of the effect
    scores: str
    frame: Tensor
    corrupted: Tensor
    checkerboard: Tensor
    map: Tensor | None
    scales: tuple[MapScale, ...]  # of the map, one for each half if there are two
    restored: Tensor | None
    details: tuple[Tensor, Tensor, Tensor, Tensor]  # horizon and road, each of the frame and corrupted, pixel by pixel
    arrows: FlowArrows | None


class _Restored(NamedTuple):
    image: Tensor  # (1, 3, H, W)
    valid: Tensor  # (1, 1, H, W), bool
    label: str  # follows its score


def contact_sheet_row(
    name: str, effect: Effect, *, frame: Tensor, seed: int, depth: Tensor | None = None
) -> ContactSheetRow:
    """Degrade a frame and a checkerboard by one draw of an effect, and restore the frame.

    The restored image is warp(corrupted, restore_flow), bicubic, or remove_fog(round(255 corrupted) / 255) for fog
    alone. Invalid pixels are hatched, folded ones of the checkerboard tinted. All is computed at the frame's size.

    Args:
        name: of the effect.
        effect: any.
        frame: (1, 3, H, W), float in [0, 1].
        seed: of the draw.
        depth: (1, 1, H, W), m, for effects that depend on it.

    Raises:
        ValueError: if the effect cannot degrade this frame.
    """
    height, width = frame.shape[2:]
    board = checkerboard(height, width, cell=max(1, round(max(height, width) / _SQUARES)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # The sheet marks the folds that effects warn of.
        degraded = effect.degrade(frame, seed=seed, depth=depth)
        degraded_board = effect.apply(board, degraded.params, depth=depth).image
    scales, restored = map_scales(degraded), _restore(effect, degraded)
    folds = folded(degraded.flow, degraded.valid) if degraded.has("flow") else torch.zeros_like(degraded.valid)
    hatched_board = hatch_invalid(_sheet_size(degraded_board), degraded.valid)
    size = dict(zip(("height", "width"), hatched_board.shape[2:], strict=True))
    arrows = flow_arrows(degraded.flow, degraded.valid, **size) if degraded.has("flow") else None
    horizon, road = (
        [cut_detail(image, row, **size) for image in (frame, degraded.image)] for row in detail_rows(effect)
    )
    return ContactSheetRow(
        title=": ".join(filter(None, (name, describe_params(effect, degraded.params)))),
        scores=_scores(degraded, frame, restored=restored, folds=folds),
        frame=_sheet_size(frame)[0],
        corrupted=_sheet_size(degraded.image)[0],
        checkerboard=mark_folded(hatched_board, folds)[0],
        map=map_image(degraded, scales, largest=_SHEET_SIDE) if scales else None,
        scales=scales,
        restored=None if restored is None else hatch_invalid(_sheet_size(restored.image), restored.valid)[0],
        details=(horizon[0], horizon[1], road[0], road[1]),
        arrows=arrows,
    )


def contact_sheet(rows: Sequence[ContactSheetRow], *, title: str) -> Figure:
    """Draw the rows below a title; the scale of each map stands above it.

    Args:
        rows: at least one, all of one frame.
        title: one line.
    """
    layout = FigureLayout(
        len(rows),
        len(_COLUMNS),
        *rows[0].frame.shape[1:],
        caption_lines=1,
        header_lines=4,
        footer_lines=1,
        detailed=True,
    )
    # A letter is about half as wide as a line is high. A caption ends where the legend of the map begins.
    letters = 2 * _COLUMNS.index("map") * layout.column_px // layout.text
    captions = [(textwrap.wrap(row.title, letters), textwrap.wrap(row.scores, letters)) for row in rows]
    layout = replace(layout, caption_lines=max(len(head) + len(tail) for head, tail in captions))
    layout.write(title, layout.left(0), 2 * layout.text, weight="bold")
    for j, column in enumerate(_COLUMNS):
        layout.write(column, layout.left(j) + layout.width / 2, 4 * layout.text, ha="center", weight="bold")
    for i, (row, (head, tail)) in enumerate(zip(rows, captions, strict=True)):
        y = layout.top(i) - 0.3 * layout.text
        layout.write("\n".join(tail), layout.left(0), y)
        layout.write("\n".join(head), layout.left(0), y - 1.3 * len(tail) * layout.text, weight="bold")
        _draw_row(layout, row, i)
    y = layout.top(layout.rows) - 2 * layout.text
    draw_invalid_key(layout, x=layout.left(0), y=y)
    gray = torch.full((1, 3, layout.height, layout.width), 0.5)
    tinted = mark_folded(gray, torch.ones(1, 1, 1, 1, dtype=torch.bool))[0]
    layout.explain(tinted, "folded: shown twice or mirrored", x=layout.left(2), y=y)
    return layout.figure


def describe_params(effect: Effect, params: Any) -> str:
    """Describe the parameters of the first sample, "amplitude 2.3 px, length 31 px"; zeros are left out."""
    if isinstance(effect, Compose):
        leaves = [
            f"{type(leaf).__name__} ({describe_params(leaf, leaf_params)})".removesuffix(" ()")
            for leaf, leaf_params in effect.effects_with_params(params)
            if leaf_params.applied[0]
        ]
        return " + ".join(leaves) or "not applied"
    if not params.applied[0]:
        return "not applied"
    values = {name: value[0] for name, value in params._asdict().items() if value is not None}
    # One field means different things in different effects.
    if isinstance(effect, LensFlare | SunGlare):
        values["sun"] = values.pop("center")
    elif values.get("sun") is not None:
        values["sunlight"] = values.pop("sun")
    if isinstance(effect, PhysicalTurbulence):
        values["wind_s"] = values.pop("wind")
    if isinstance(effect, RollingShutter):
        values["vibration"] = values.pop("amplitude")
    mode = getattr(effect, "mode", None)
    if mode == "image":
        values.pop("contrast")  # used in mode="ray" only
    elif mode == "ray":
        values["wind_m"] = values.pop("wind")
    names = [name for name in _PARAMETER_TEXTS if values.get(name) is not None and values[name].any()]
    return ", ".join(_PARAMETER_TEXTS[name](values[name]) for name in names)


def map_scales(degraded: Degraded) -> tuple[MapScale, ...]:
    """Choose the maps to show: the flow; else transmission or intensity, and an extinction that varies.

    The scale of a flow is that of its valid pixels, the scale of an extinction its largest value. That of an intensity
    ends at 1, the light of white: the disc of the sun has tens of thousands, and would leave the rest of the map dark.
    """
    if degraded.has("flow"):
        return (MapScale("flow", full_color_px(degraded.flow, degraded.valid)),)
    names = [name for name in _NEUTRAL if degraded.has(name)]
    if not names:
        return ()
    name = next((name for name in names if (getattr(degraded, name) != _NEUTRAL[name]).any()), names[0])
    if name == "intensity":
        return (MapScale(name, min(_WHITE, round_up(degraded.intensity.amax().item()))),)
    k = degraded.extinction if degraded.has("extinction") else torch.zeros(1)
    varies = k.amax() > 1.001 * k.amin()
    return (MapScale(name, 1.0), *([MapScale("extinction", round_up(k.amax().item()))] if varies else []))


def map_image(degraded: Degraded, scales: Sequence[MapScale], *, largest: int) -> Tensor:
    """Color the map of the first sample; of two maps, show the left half of the first and the right half of the other.

    Args:
        degraded: a batch of images.
        scales: of `map_scales`, at least one.
        largest: largest longer side of the result, px, at least 320.

    Returns:
        (3, h, w), in [0, 1]; a flow is hatched where it is invalid.
    """
    if scales[0].name == "flow":
        rgb = flow_to_rgb(degraded.flow[:1], max_px=scales[0].top)
        return hatch_invalid(resize_for_display(rgb, largest=largest), degraded.valid[:1])[0]
    maps = (resize_for_display(getattr(degraded, scale.name)[:1] / scale.top, largest=largest) for scale in scales)
    first, *others = (transmission_to_rgb(value)[0] for value in maps)
    middle = first.shape[2] // 2
    return torch.cat([first[..., :middle], others[0][..., middle:]], dim=2) if others else first


def draw_legend(layout: FigureLayout, scales: Sequence[MapScale], *, x: int, y: int) -> None:
    """Draw the color wheel or the color bars of a map above its upper left corner (x, y)."""
    text = layout.text
    if scales and scales[0].name == "flow":
        size = round(2.6 * text)
        layout.show(flow_wheel(size), x, y - 3 * text)
        layout.write(f"full color = {scales[0].top:g} px", x + size + text / 2, y - 1.7 * text)
        layout.write("darker = longer", x + size + text / 2, y - 0.4 * text)
        return
    bar = transmission_to_rgb(torch.linspace(0, 1, 3 * text).expand(1, 1, text, -1))[0]
    for i, scale in enumerate(reversed(scales)):
        line = y - (0.4 + 1.3 * i) * text
        layout.write("0", x, line)
        layout.show(bar, x + text, round(line - 1.1 * text))
        side = "" if len(scales) == 1 else " (right)" if i == 0 else " (left)"
        rest = " or more," if scale == MapScale("intensity", _WHITE) else _MAP_UNITS.get(scale.name, "")
        layout.write(f"{scale.top:g}{rest} {scale.name}{side}", x + 4.4 * text, line)


def draw_invalid_key(layout: FigureLayout, *, x: int, y: int) -> None:
    """Draw the legend of hatched pixels."""
    black = torch.zeros(1, 3, layout.height, layout.width)
    stripes = hatch_invalid(black, torch.zeros(1, 1, 1, 1, dtype=torch.bool))[0]
    layout.explain(stripes, "invalid: lost, or outside the frame", x=x, y=y)


def _restore(effect: Effect, degraded: Degraded) -> _Restored | None:
    """Undo the flow or the fog; None for an effect that has neither."""
    if degraded.has("flow"):
        image = warp(degraded.image, degraded.restore_flow, interpolation="bicubic")[0]
        remaining = [text for name, text in (("transmission", "fog"), ("intensity", "flare")) if degraded.has(name)]
        label = f"restored except {' and '.join(remaining)}" if remaining else "restored"
        return _Restored(image, degraded.restore_valid, label)
    if "airlight" not in degraded.params._fields:
        return None
    # A float image would be restored exactly, which no image file allows.
    stored, fog = to_float(to_uint8(degraded.image)), cast(Any, effect)
    t, airlight = degraded.transmission, degraded.params.airlight
    if getattr(degraded.params, "sun", None) is not None:
        airlight = fog.airlight_map(degraded.params, *stored.shape[2:])
    return _Restored(*remove_fog(stored, t, airlight, linear_light=fog.medium.linear_light), "restored from 8 bits")


def _scores(degraded: Degraded, frame: Tensor, *, restored: _Restored | None, folds: Tensor) -> str:
    """Score the pixels that can be restored or, if nothing can be undone, the valid ones."""
    valid = degraded.valid if restored is None else restored.valid
    texts = [f"{valid.float().mean().item():.1%} valid"]
    if valid.any():
        before = _psnr(degraded.image, frame, valid)
        score = "unchanged" if before >= _EQUAL_DB else f"{before:.1f} dB corrupted"
        if restored is not None and before < _EQUAL_DB:
            score += f", {_psnr(restored.image, frame, valid):.1f} dB {restored.label}"
        texts.append(score)
    if degraded.has("flow"):
        longest = (length(degraded.flow) * degraded.valid).max().item()
        texts.insert(0, f"largest displacement {longest:.3g} px")
    if folds.any():
        texts.append(f"{100 * folds.float().mean().item():.2g}% folded")
    return "; ".join(texts)


def _psnr(image: Tensor, frame: Tensor, valid: Tensor) -> float:
    """Compute the peak signal-to-noise ratio on valid pixels, dB."""
    mse = (image.clamp(0, 1) - frame)[valid.expand_as(frame)].square().mean()
    return -10 * mse.log10().item()


def _draw_row(layout: FigureLayout, row: ContactSheetRow, i: int) -> None:
    for j, column in enumerate(_COLUMNS):
        x, y = layout.left(j), layout.top(i)
        if (image := getattr(row, column)) is not None:
            layout.show(image, x, y)
        else:
            text = "no flow or fog to undo" if column == "restored" else "no map"
            layout.write(text, x + layout.width / 2, y + layout.height / 2, ha="center")
    draw_legend(layout, row.scales, x=layout.left(_COLUMNS.index("map")), y=layout.top(i))
    y = layout.top(i) + layout.detail_offset
    for j, (name, detail) in enumerate(zip(_DETAILS, row.details, strict=True)):
        layout.write(name, layout.left(j) + layout.width / 2, y - 0.4 * layout.text, ha="center")
        layout.show(detail, layout.left(j) + (layout.width - detail.shape[2]) // 2, y)
    x = layout.left(len(_DETAILS))
    if row.arrows is None:
        layout.write("no motion", x + layout.width / 2, y + layout.height / 2, ha="center")
        return
    text = f"motion x {row.arrows.enlargement:g}, up to {row.arrows.longest:.3g} px"
    layout.write(text, x + layout.width / 2, y - 0.4 * layout.text, ha="center")
    layout.show(0.3 * row.corrupted + 0.7, x, y)
    height, width = row.corrupted.shape[1:]
    axes = layout.figure.add_axes(layout.box(height, width, x, y))
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()
    draw_arrows(axes, row.arrows)
