"""The description of a complete pair set: a README.md with content, formats and license, and a table of its pairs."""

import io
import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.filesize import decimal

from torchrefract._io import replace_file, write_file
from torchrefract.cameras.brown_conrady import POLYNOMIAL12
from torchrefract.data.pairs.manifest import PairRow

HISTOGRAMS, TABLE = "parameters.png", "pairs.parquet"
_BATCH = 10_000  # rows of the table that are Python objects at a time

_NOT_SHOWN = {"effect", "key", "frame", "wind", "drift", "decorrelation"}  # not numbers, or without effect on a frame
_FORMATS = {
    "clean.png": "8 bits, RGB: the clean frame",
    "corrupted.png": "8 bits, RGB: the degraded frame",
    "flow.png": "16 bits: u = (red - 32768) / 64, v = (green - 32768) / 64 px, blue 1 where valid; "
    "corrupted(p) = clean(p + flow(p))",
    "restore_flow.png": "16 bits, in the same format: the flow that restores the clean frame, clean(p) = corrupted(p + "
    "restore_flow(p))",
    "transmission.png": "16 bits, gray: value / 65535 is the fraction of the clean light that reaches the camera",
    "intensity.png": "16 bits, gray: value / 32768 is the light that flare adds",
    "depth.png": "16 bits, gray: value / 256 is the depth of the clean frame in m, 65535 is infinite",
    "valid.png": "255 where corrupted shows content of clean",
    "restore_valid.png": "255 where restore_flow restores clean",
    "maps.npz": "NumPy arrays: flow, restore_flow (px), transmission, intensity, depth (m) and masks, as far "
    "as the scene has them; corrupted(p) = clean(p + flow(p)), clean(p) = corrupted(p + restore_flow(p))",
}
_FORMATS["maps.safetensors"] = _FORMATS["maps.npz"].replace("NumPy arrays", "tensors")
_COLUMNS, _MAX_BINS = 4, 30
_AXES = ("x", "y", "z")
_COLORS = ("red", "green", "blue")
# By the name of a parameter, or by that of its effect and its own.
_COMPONENTS: dict[str | tuple[str, str], Sequence[str]] = {
    "airlight": _COLORS,
    "color": _COLORS,
    "frequency": ("1", "2", "3"),
    ("RollingShutter", "amplitude"): ("pitch", "yaw", "roll"),
    ("ChromaticAberration", "scale"): ("red", "blue"),
}
_UNITS: dict[str | tuple[str, str], str] = dict.fromkeys(("amplitude", "length", "aperture", "displacement"), "px")
_UNITS |= {"focal": "image widths", "radius": "image diagonals", "visibility": "m", "scale_height": "m"}
_UNITS |= {"speed": "km/h", "readout": "ms", "exposure": "ms", "frequency": "Hz", "rate": "Hz", "phase": "rad"}
_UNITS |= {("RollingShutter", "amplitude"): "degrees", ("SunGlare", "scale"): "degrees", "difference": "K"}
_UNITS |= {"wave": "cycles per image width", "tilt": "microradians"}


class Summary(NamedTuple):
    """Counts over the rows of a set."""

    splits: Counter[str]
    drives: dict[str, set[str]]  # of each split
    effects: Counter[str]
    sizes: Counter[str]
    num_sources: int
    skipped: list[str]  # reasons
    beyond: Counter[str]  # pairs with pixels that the PNG of a flow cannot hold, by flow
    files: tuple[str, ...]  # suffixes of the files of a pair
    num_bytes: int
    parameters: Mapping[tuple[str, str], list["array[float]"]]  # by effect and name, for each component
    table: "PairTable"


def summarize(rows: Iterable[PairRow], *, settings: Mapping[str, Any]) -> Summary:
    """Count what the rows of a set hold, whose settings are those in config.json."""
    table = PairTable(settings["scene"].get("severity"))
    splits, effects, sizes, beyond = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    drives, parameters = defaultdict[str, set[str]](set), defaultdict[tuple[str, str], list["array[float]"]](list)
    sources, skipped, files, num_bytes = set[tuple[str, int | None]](), [], (), 0
    for row in rows:
        if row.skipped:
            skipped.append(_as_unicode(row.skipped))
            continue
        table.add(row)
        split = row.split or "neither"
        splits[split] += 1
        drives[split].add(row.drive)
        sizes[f"{row.width} x {row.height}"] += 1
        sources.add((row.source, row.frame))
        beyond.update(row.beyond.keys())
        files, num_bytes = tuple(row.files), num_bytes + sum(file.bytes for file in row.files.values())
        effects[" + ".join(str(effect["effect"]) for effect in row.effects) or "none"] += 1
        for effect in row.effects:
            for name in effect.keys() - _NOT_SHOWN:
                numbers = np.array(effect[name], dtype=np.float64).ravel()  # parses the word "inf", too
                columns = parameters[str(effect["effect"]), name]
                columns.extend(array("d") for _ in range(len(numbers) - len(columns)))
                for column, number in zip(columns, numbers, strict=False):
                    column.append(number)
    return Summary(splits, drives, effects, sizes, len(sources), skipped, beyond, files, num_bytes, parameters, table)


def write_card(out: Path, summary: Summary, *, settings: Mapping[str, Any], license_text: str) -> None:
    """Write the card, its figure and the table into the folder of a set; several shards may do so at the same time."""
    summary.table.write(out)
    if (figure := draw_histograms(summary)) is not None:
        write_file(out / HISTOGRAMS, figure)
    card = format_card(summary, settings=settings, license_text=license_text, has_histograms=figure is not None)
    write_file(out / "README.md", card.encode())


def format_card(summary: Summary, *, settings: Mapping[str, Any], license_text: str, has_histograms: bool) -> str:
    """Format the card in Markdown, from the settings in config.json and the license of the frames."""
    scene, count = settings["scene"]["name"], summary.splits.total()
    splits = [f"| {name} | {pairs} | {len(summary.drives[name])} |" for name, pairs in sorted(summary.splits.items())]
    effects = [f"| {name} | {pairs} |" for name, pairs in sorted(summary.effects.items())]
    sizes = ", ".join(sorted(summary.sizes))
    remarks = [
        f"{pairs} pairs have pixels whose {name} exceeds the range of a 16-bit PNG, 512 px; they are marked as invalid."
        for name, pairs in sorted(summary.beyond.items())
    ]
    if summary.skipped:
        remarks.append(f"{len(summary.skipped)} frames are unreadable and have no pair, such as: {summary.skipped[0]}.")
    lines = [
        f"# {count} pairs of the scene {scene}",
        "",
        f"Clean frames, the same frames degraded by `{settings['scene']['_target_']}` of torchrefract, and the maps "
        f"between them: {decimal(summary.num_bytes)}, from {summary.num_sources} frames, {sizes} px (width x "
        "height).",
        "",
        f"**License of the frames, as stated by the creator of this set:** {license_text}",
        "",
        f"Pairs were computed on the device {settings.get('device', 'cpu')}.",
        "",
        *("| split | pairs | drives |", "| --- | --- | --- |", *splits, ""),
        *("| effect | pairs |", "| --- | --- |", *effects, ""),
        *(line for remark in remarks for line in (remark, "")),
        *(["## Parameters", "", f"![Histograms of the parameters]({HISTOGRAMS})", ""] if has_histograms else []),
        *("## Files", "", "Flows are in pixels, u to the right and v down. Pixel centers are integers.", ""),
        *(f"- `{suffix}`: {_FORMATS[suffix]}" for suffix in summary.files),
        "",
        "`manifest.jsonl` has a line of JSON for each pair: source, drive, split, all parameters, and files with "
        "checksums. Several files `manifest-*.jsonl` can be concatenated. `degrade(clean, seed=seed, keys=[key])` "
        "makes a pair again. `pairs.parquet` is a table of the pairs with a column for each parameter. `config.json` "
        "holds the configuration.",
    ]
    return "\n".join(lines) + "\n"


def draw_histograms(summary: Summary) -> bytes | None:
    """Draw a histogram of each parameter that varies; return a PNG, or None if none varies."""
    from matplotlib.figure import Figure  # noqa: PLC0415  # workers import this module and draw nothing

    panels = list(histogram_panels(summary))
    if not panels:
        return None
    columns = min(len(panels), _COLUMNS)
    rows = -(-len(panels) // columns)
    width, height = 3.2 * columns, 2.3 * rows
    figure = Figure(figsize=(width, height), dpi=100)
    # Margins in inches keep all panels of the same size.
    figure.subplots_adjust(0.6 / width, 0.5 / height, 1 - 0.15 / width, 1 - 0.3 / height, wspace=0.25, hspace=0.55)
    for i, (title, label, values) in enumerate(panels):
        axes = figure.add_subplot(rows, columns, i + 1)
        axes.hist(values, bins=min(_MAX_BINS, math.isqrt(len(values)) + 1), color="tab:blue", edgecolor="white")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(label, fontsize=8)
        axes.set_ylabel("count" if i % columns == 0 else "", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.locator_params(axis="x", nbins=4)
        axes.locator_params(axis="y", nbins=4, integer=True)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def histogram_panels(summary: Summary) -> Iterable[tuple[str, str, np.ndarray]]:
    """Yield title, label and values of each parameter that varies; many components share one panel."""
    for (effect, name), columns in sorted(summary.parameters.items()):
        arrays = [np.frombuffer(column) for column in columns]
        varied = {i: column for i, column in enumerate(arrays) if np.isfinite(column).all() and np.ptp(column) > 0}
        unit = _UNITS.get((effect, name), _UNITS.get(name))
        unit = "" if unit is None else f", {unit}"
        components = _COMPONENTS.get((effect, name), _COMPONENTS.get(name, _AXES))
        if name == "coefficients" and len(arrays) == len(POLYNOMIAL12):
            yield from ((effect, POLYNOMIAL12[i], column) for i, column in varied.items())
        elif len(arrays) > len(_AXES) and varied:
            yield effect, f"{name}{unit}, all components", np.concatenate(list(varied.values()))
        else:
            for i, column in varied.items():
                yield effect, f"{name}{f' {components[i]}' if len(arrays) > 1 else ''}{unit}", column


class PairTable:
    """A table of the pairs of a set: a row for each, with a column for each quantity that an effect draws.

    pandas, DuckDB and the like query it.

    Args:
        severity: of the scene; None if it has none.
    """

    def __init__(self, severity: int | None):
        self._severity = severity
        self._rows, self._tables = list[dict[str, Any]](), list[pa.Table]()

    def add(self, row: PairRow) -> None:
        """Add a row of the manifest that has a pair."""
        self._rows.append(self._columns(row))
        if len(self._rows) == _BATCH:
            self._flush()

    def write(self, out: Path) -> None:
        """Write the table into the folder of the set, sorted by number."""
        self._flush()
        table = pa.concat_tables(self._tables, promote_options="permissive").sort_by("number")
        drawn = sorted(name for name in table.column_names if "." in name)
        table = table.select([name for name in table.column_names if "." not in name] + drawn)
        # PyArrow would take a relative path with a colon for an address.
        with replace_file(out / TABLE) as temporary, temporary.open("wb") as stream:
            pq.write_table(table, stream, row_group_size=_BATCH)

    def _flush(self) -> None:
        if self._rows:
            names = dict.fromkeys(name for row in self._rows for name in row)
            self._tables.append(pa.table({name: [row.get(name) for row in self._rows] for name in names}))
            self._rows = []

    def _columns(self, row: PairRow) -> dict[str, Any]:
        path = next(iter(row.files.values())).path
        values = {
            "number": row.number,
            "name": row.name,
            "key": row.key,
            "seed": row.seed,
            "source": _as_unicode(row.source),
            "frame": row.frame,
            "drive": _as_unicode(row.drive),
            "split": row.split,
            "scene": row.scene,
            "severity": self._severity,
            "height": row.height,
            "width": row.width,
            "effects": [str(effect["effect"]) for effect in row.effects],
            "path": path if path.endswith(".tar") else path.partition(".")[0],
            "bytes": sum(file.bytes for file in row.files.values()),
        }
        seen = Counter[str]()
        for effect in row.effects:
            name = str(effect["effect"])
            seen[name] += 1
            prefix = name if seen[name] == 1 else f"{name}{seen[name]}"
            values |= {f"{prefix}.{key}": _number(value) for key, value in effect.items() if key != "effect"}
        return values


def _as_unicode(text: str) -> str:
    """Escape the bytes of names of files that are no Unicode, which neither Parquet nor a terminal takes."""
    return text.encode(errors="backslashreplace").decode()


def _number(value: Any) -> Any:
    """Return the numbers of a parameter; a manifest has words for infinite ones, because JSON has none."""
    if isinstance(value, list):
        return [_number(item) for item in value]
    return float(value) if isinstance(value, str) else value
