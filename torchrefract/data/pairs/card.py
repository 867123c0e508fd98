"""The card of a set of pairs: what is in it, how its files are read, and whose the frames are."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchrefract.data.pairs.manifest import PairRow

HISTOGRAMS = "parameters.png"

Values = Mapping[tuple[str, str], list["array[float]"]]

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
    values: Values  # of each effect's parameters, by component


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


def _collect(effects: Sequence[Mapping[str, Any]], values: dict[tuple[str, str], list["array[float]"]]) -> None:
    for effect in effects:
        for name, value in effect.items():
            if name not in _UNSEEN:
                numbers = np.array(value, dtype=np.float64).ravel()  # of a word too: "inf"
                columns = values[str(effect["effect"]), name]
                columns.extend(array("d") for _ in range(len(numbers) - len(columns)))
                for column, number in zip(columns, numbers, strict=False):
                    column.append(number)


def _remarks(found: Contents) -> list[str]:
    remarks = [
        f"{pairs} pairs have pixels whose {name} is longer than a PNG of 16 bits holds, 512 px; it marks them as not "
        "valid."
        for name, pairs in sorted(found.beyond.items())
    ]
    if found.skipped:
        remarks.append(f"{len(found.skipped)} frames could not be read and have no pair, such as: {found.skipped[0]}.")
    return [line for remark in remarks for line in (remark, "")]
