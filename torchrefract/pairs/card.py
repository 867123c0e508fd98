"""The card of a set of pairs: what is in it, how its files are read, and whose the frames are."""

import io
import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrefract.cameras.distortion import POLYNOMIAL12
from torchrefract.data.pair_manifest import PairRow

HISTOGRAMS = "parameters.png"

_Values = Mapping[tuple[str, str], list["array[float]"]]

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
_UNSEEN = ("effect", "key", "frame", "wind", "drift", "decorrelation")  # no numbers, or none that a single frame shows
_READ = {
    "clean.png": "8 bits, RGB: the frame",
    "corrupted.png": "8 bits, RGB: what the effects made of it",
    "flow.png": "16 bits: u = (red - 32768) / 64, v = (green - 32768) / 64 px, blue 1 where valid; "
    "corrupted(p) = clean(p + flow(p))",
    "restore_flow.png": "the same, of the flow that undoes it: clean(p) = corrupted(p + restore_flow(p))",
    "transmission.png": "16 bits, gray: value / 65535 is the share of the clean light that arrives",
    "intensity.png": "16 bits, gray: value / 32768 is the light added",
    "valid.png": "255 where corrupted shows what clean holds",
    "restore_valid.png": "255 where restore_flow gives clean back",
    "maps.npz": "flow, restore_flow (px), transmission, intensity, valid, restore_valid, those that there are, as "
    "NumPy has them; corrupted(p) = clean(p + flow(p)), clean(p) = corrupted(p + restore_flow(p))",
}
_READ["maps.safetensors"] = _READ["maps.npz"].replace("NumPy has", "safetensors has")


class Contents(NamedTuple):
    """What the rows of a set come to."""

    splits: Counter[str]
    drives: dict[str, set[str]]  # of each split
    effects: Counter[str]
    sizes: Counter[str]
    sources: int
    skipped: list[str]
    beyond: Counter[str]  # pairs with pixels of a flow that a PNG cannot hold
    files: tuple[str, ...]  # of a pair
    bytes: int
    values: _Values  # of each effect's parameters, by component


def contents(rows: Iterable[PairRow]) -> Contents:
    """What rows come to."""
    splits, effects, sizes, beyond = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    drives, values = defaultdict[str, set[str]](set), defaultdict[tuple[str, str], list["array[float]"]](list)
    sources, skipped, files, total = set[tuple[str, int | None]](), [], (), 0
    for row in rows:
        if row.skipped:
            skipped.append(row.skipped)
            continue
        split = row.split or "neither"
        splits[split] += 1
        drives[split].add(row.drive)
        sizes[f"{row.width} x {row.height}"] += 1
        sources.add((row.source, row.frame))
        beyond.update(row.beyond.keys())
        files, total = tuple(row.files), total + sum(file.bytes for file in row.files.values())
        effects[" + ".join(str(effect["effect"]) for effect in row.effects) or "none"] += 1
        _collect(row.effects, values)
    return Contents(splits, drives, effects, sizes, len(sources), skipped, beyond, files, total, values)


def write_card(found: Contents, *, settings: Mapping[str, Any], license_of: str, pictured: bool) -> str:
    """The card, in Markdown.

    Args:
        found: in the set.
        settings: of the set.
        license_of: the source, as the user says.
        pictured: whether there is a picture of histograms.
    """
    scene, count = settings["scene"]["name"], found.splits.total()
    splits = [f"| {split} | {pairs} | {len(found.drives[split])} |" for split, pairs in sorted(found.splits.items())]
    effects = [f"| {name} | {pairs} |" for name, pairs in sorted(found.effects.items())]
    files = [f"- `{suffix}`: {_READ[suffix]}" for suffix in found.files]
    lines = [
        f"# {count} pairs of the scene {scene}",
        "",
        f"Clean frames, what `{settings['scene']['_target_']}` of torchrefract made of them, and the maps that undo "
        f"it: {found.bytes / 1e9:.3g} GB, of {found.sources} frames, {', '.join(sorted(found.sizes))} px (width x "
        "height).",
        "",
        "**License of the frames, as stated by who made this set:** " + license_of,
        "",
        *("| split | pairs | drives |", "| --- | --- | --- |", *splits, ""),
        *("| effect | pairs |", "| --- | --- |", *effects, ""),
        *_remarks(found),
        *(["## Parameters", "", f"![Histograms of the parameters]({HISTOGRAMS})", ""] if pictured else []),
        *("## Files", "", "Flows are in pixels, u to the right and v down; pixel centers are whole numbers.", ""),
        *(*files, ""),
        "`manifest.jsonl`, or several manifest-….jsonl that can be put together, has a line of JSON for each pair: its "
        "source, drive and split, all parameters, and its files with their checksums. `degrade(clean, seed=seed, "
        "keys=[key])` makes the pair again. `config.json` has the configuration.",
    ]
    return "\n".join(lines) + "\n"


def histograms(found: Contents) -> bytes | None:
    """A PNG with a histogram of each parameter that is not the same in all pairs, or None without one."""
    panels = list(_panels(found.values))
    if not panels:
        return None
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(3.2 * _COLUMNS, 2.3 * rows), dpi=100, layout="constrained")
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


def _collect(effects: Sequence[Mapping[str, Any]], values: dict[tuple[str, str], list["array[float]"]]) -> None:
    for effect in effects:
        for name, value in effect.items():
            if name not in _UNSEEN:
                numbers = np.array(value, dtype=np.float64).ravel()  # of a word too: "inf"
                columns = values[str(effect["effect"]), name]
                columns.extend(array("d") for _ in range(len(numbers) - len(columns)))
                for column, number in zip(columns, numbers, strict=False):
                    column.append(number)


def _panels(values: _Values) -> Iterable[tuple[str, str, np.ndarray]]:
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


def _remarks(found: Contents) -> list[str]:
    remarks = [
        f"{pairs} pairs have pixels whose {name} is longer than a PNG of 16 bits holds, 512 px; it marks them as not "
        "valid."
        for name, pairs in sorted(found.beyond.items())
    ]
    if found.skipped:
        remarks.append(f"{len(found.skipped)} frames could not be read and have no pair, such as: {found.skipped[0]}.")
    return [line for remark in remarks for line in (remark, "")]
