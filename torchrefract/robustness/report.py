"""The report of a robustness test: tables of numbers, and one HTML file that opens anywhere."""

import base64
import html
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from PIL import Image, ImageDraw
from torch import Tensor

from torchrefract._io import write_csv, write_file
from torchrefract.data.images import pixels_of
from torchrefract.robustness.corruption_error import BaseComparison
from torchrefract.robustness.evaluate import Robustness, Row

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; }
td, th { padding: .25rem .8rem; text-align: right; white-space: nowrap; }
tr:nth-child(odd) td { background: #f3f3f3; } .wide { overflow-x: auto; }
th { border-bottom: 1px solid #888; } td:first-child, th:first-child { text-align: left; }
figure { display: inline-block; margin: .5rem; vertical-align: top; } img { max-width: 100%; }
figcaption { font-size: 13px; max-width: 29rem; }
.class { display: inline-block; width: .8em; height: .8em; margin: 0 .2em 0 .6em; }
@media (max-width: 40rem) { td, th { padding: .25rem .4rem; font-size: 13px; } figure { margin: .5rem 0; } }
"""
_OF_RUN = ("metric", "seed", "torchrefract", "torch")  # columns that are the same in all lines
_SPACING = 0.08  # of the curves, severities
_OPACITY, _SEEN_SHARE = 0.5, 0.002  # of classes
# Neighbors of tab20 are pairs of a dark and a light color: the dark ones come first.
_PALETTE = [tuple(round(255 * value) for value in colormaps["tab20"](2 * (i % 10) + i // 10)[:3]) for i in range(20)]
_COLORS = {"labels": (40, 160, 60), "predictions": (220, 40, 30)}


class Classes(NamedTuple):
    """An image (3, H, W) and the class that is predicted at each pixel, (H, W), integers."""

    image: Tensor
    classes: Tensor


@dataclass(frozen=True)
class Example:
    """A degraded image with its labels and predictions: boxes (n, 4) in px, or None.

    caption: name, level and scores.
    clean, degraded: the predicted classes of the clean and of the degraded image, or None.
    """

    image: Tensor  # (3, H, W)
    caption: str
    labels: Tensor | None = None
    predictions: Tensor | None = None
    clean: Classes | None = None
    degraded: Classes | None = None


def write_tables(
    result: Robustness, out: Path, about: dict[str, Any], *, loss: float, comparison: BaseComparison | None = None
) -> None:
    """Write results.csv and results.json into a folder.

    Args:
        result: the scores.
        out: an existing folder.
        about: settings and versions, for results.json; its metric, seed and versions are columns of results.csv too.
        loss: share of the clean score that is tolerated, in (0, 1).
        comparison: the errors relative to those of a base, or None.
    """
    rows = [_flat(row) for row in result.rows()]
    write_csv(out / "results.csv", [row | {name: about[name] for name in _OF_RUN} for row in rows])
    summary = {
        "about": about,
        "clean": result.clean_estimate()._asdict(),
        "mean_performance": result.mean_performance(),
        "relative_performance": result.relative_performance(),
        "set_scores": {
            name: {
                "clean": value,
                "mean_performance": result.mean_performance(of=name),
                "relative_performance": result.relative_performance(of=name),
            }
            for name, value in result.set_scores[None].items()
        },
        "tolerated": {scene: result.tolerated(scene, loss=loss)._asdict() for scene in result.quantities},
        **({"worst_case": _worst_cases(result)} if result.worst_case else {}),
        **({"corruption_error": comparison._asdict()} if comparison else {}),
        "levels": rows,
        "failures": result.failures,
    }
    write_file(out / "results.json", json.dumps(_without_nan(summary), indent=1) + "\n")


def write_report(
    result: Robustness,
    examples: Sequence[Example],
    out: Path,
    *,
    title: str,
    loss: float,
    comparison: BaseComparison | None = None,
) -> None:
    """Write report.html into a folder: curves, tables, the tolerated values, and examples as pictures.

    Args:
        result: the scores.
        examples: such as the worst images.
        out: an existing folder.
        title: one line.
        loss, comparison: as for `write_tables`.
    """
    names, rows = list(result.set_scores[None]), result.rows()
    worst = ["worst case"] if result.worst_case else []
    together = f" For {' and '.join(names)}, all images count together." if names else ""
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{len(result.names)} images. The score is the mean over images, with its interval of 95 %.{together} mPC "
        "is the mean over scenes and severities, rPC its share of the clean score.</p>",
        _table(["", "clean", "95 % interval", "mPC", "rPC"], _summary_cells(result)),
        *(
            f'<img alt="{name} by severity" src="data:image/svg+xml;base64,{_encoded(_curves(result, rows, name))}">'
            for name in ["score", *names[:1]]
        ),
        f"<h2>What the model tolerates</h2><p>Values up to which the mean score falls by at most {loss:.0%}. An open "
        "end of an interval lies beyond what was tested.</p>",
        _table(["scene", "tolerated", "95 % interval", "quantity"], _tolerated_cells(result, loss)),
        "<h2>Scores</h2>",
        _table(
            ["scene", "severity", "score", "95 % interval", "drop", *worst, *names, "quantity"],
            map(_score_cells, rows),
        ),
    ]
    if worst:
        cells = [(name, *map(_number, of.values())) for name, of in _worst_cases(result).items()]
        parts.append(
            "<h2>Worst cases</h2><p>The worst case of an image is its lowest score of several random draws of the "
            "parameters of a scene, the usual draw among them. The numbers are means over images and severities.</p>"
        )
        parts.append(_table(["scene", "score", "worst case"], cells))
    if comparison:
        parts += _comparison(comparison)
    if result.failures:
        parts.append(f"<h2>Images left out</h2><p>The model failed for {len(result.failures)} images:</p>")
        parts.append(_table(["image", "reason"], result.failures.items()))
    if examples:
        parts.append("<h2>The worst images</h2>")
        if any(example.labels is not None for example in examples):
            parts.append("<p>Labels (or predictions for the clean image) are green, predictions red.</p>")
        if any(example.clean for example in examples):
            parts.append("<p>Colors are the predicted classes, for the clean image and for the degraded one.</p>")
        parts += map(_figure, examples)
    page = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
    page += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    write_file(out / "report.html", f"{page}<style>{_STYLE}</style>{''.join(parts)}</html>\n")


def format_tolerated(result: Robustness, scene: str, *, loss: float) -> str:
    """Describe what a model tolerates, as "loses at most 10% at visibility at least 142 m (95 % interval ...)"."""
    kind, value, interval = _tolerated(result, scene, loss)
    name, limit = result.quantities[scene].name, f"{loss:.0%}"
    text = {
        "none": f"loses more than {limit} even at the mildest tested value, {name} {value}",
        "all": f"loses at most {limit} even at the strongest tested value, {name} {value}",
    }.get(kind, f"loses at most {limit} at {name} {kind} {value}")
    return f"{text} (95 % interval {interval})"


def _tolerated(result: Robustness, scene: str, loss: float) -> tuple[str, str, str]:
    """Return "at least", "at most", "all" or "none", the tolerated value with its unit, and its interval."""
    estimate, quantity = result.tolerated(scene, loss=loss), result.quantities[scene]
    values = np.concatenate([values for level, values in result.values.items() if level.scene == scene])
    mildest, strongest = (values.min(), values.max()) if quantity.is_harm else (values.max(), values.min())
    kind = "at most" if quantity.is_harm else "at least"
    if estimate.value == strongest and result.relative_performance(scene) >= 1 - loss:
        kind = "all"
    elif estimate.value == mildest:
        kind = "none"
    low, high = ("open" if math.isinf(end) else f"{end:.3g}" for end in estimate[1:])
    interval = "open" if low == high == "open" else f"{low} to {high}"
    return kind, f"{estimate.value:.3g} {quantity.unit}".rstrip(), interval


def _flat(row: Row) -> dict[str, Any]:
    values = asdict(row) | {"score": row.score.value, "low": row.score.low, "high": row.score.high}
    values |= {"drop": row.drop.value, "drop_low": row.drop.low, "drop_high": row.drop.high}
    del values["set_scores"], values["worst_case"]
    if row.worst_case:
        worst = row.worst_case
        values |= {"worst_case": worst.value, "worst_case_low": worst.low, "worst_case_high": worst.high}
    return values | row.set_scores


def _worst_cases(result: Robustness) -> dict[str, dict[str, float]]:
    """Return the mean score and the mean worst case of each scene, and of all."""
    kinds = {"mean_performance": "score", "worst_case": "worst_case"}
    return {
        scene or "all scenes": {name: result.mean_performance(scene, of=of) for name, of in kinds.items()}
        for scene in [*result.scenes, None]
    }


def _without_nan(value: Any) -> Any:
    """Replace numbers that JSON cannot hold by null."""
    if isinstance(value, dict):
        return {name: _without_nan(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _curves(result: Robustness, rows: Sequence[Row], of: str) -> bytes:
    """Draw the score, with intervals, or one of all images together."""
    figure = Figure(figsize=(5, 4.6), layout="constrained")
    axes = figure.subplots()
    clean = float(result.clean.mean()) if of == "score" else result.set_scores[None][of]
    axes.axhline(clean, color="gray", linestyle="--", label="clean")
    for i, scene in enumerate(result.scenes):
        of_scene = [row for row in rows if row.scene == scene]
        shift = _SPACING * (i - (len(result.scenes) - 1) / 2)  # so that equal scores do not hide one another
        x = [row.severity + shift for row in of_scene]
        if of == "score":
            y = np.array([row.score for row in of_scene])
            axes.errorbar(x, y[:, 0], yerr=abs(y[:, 1:] - y[:, :1]).T, marker="o", capsize=3, label=scene)
        else:
            axes.plot(x, [row.set_scores[of] for row in of_scene], marker="o", label=scene)
    axes.set(xlabel="severity", ylabel=of, ylim=(0, 1.02), xticks=sorted({level.severity for level in result.scores}))
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=2)
    buffer = io.BytesIO()
    # Without a date and with fixed names, equal scores give equal bytes.
    with rc_context({"svg.hashsalt": "torchrefract"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _tolerated_cells(result: Robustness, loss: float) -> list[tuple[str, ...]]:
    cells = []
    for scene, quantity in result.quantities.items():
        kind, value, interval = _tolerated(result, scene, loss)
        texts = {"none": f"none tested, not even {value}", "all": f"all tested, even {value}"}
        text = texts.get(kind, f"{kind} {value}")
        cells.append((scene, text, interval, quantity.name))
    others = [scene for scene in result.scenes if scene not in result.quantities]
    return cells + [(scene, "", "", "none, see the scores by severity") for scene in others]


def _comparison(comparison: BaseComparison) -> list[str]:
    text = (
        "The error is 1 less the score. The corruption error of a scene is the sum of the errors over its severities, "
        f"divided by that of {comparison.model} (run {comparison.base}), on the {comparison.num_images} images of both "
        f"runs; {comparison.left_out} of this one and {comparison.left_out_of_base} of the base are left out. mCE is "
        "its mean over scenes. Without labels, each error is the disagreement of a model with its own clean "
        "predictions. A number is missing where the base makes no error."
    )
    cells = [(name, _number(error)) for name, error in (comparison.scenes | {"mCE": comparison.mean}).items()]
    return [f"<h2>Beside the base</h2><p>{html.escape(text)}</p>", _table(["scene", "corruption error"], cells)]


def _summary_cells(result: Robustness) -> list[tuple[str, ...]]:
    clean = result.clean_estimate()
    cells = []
    for name, value in ({"score": clean.value} | result.set_scores[None]).items():
        means = result.mean_performance(of=name), result.relative_performance(of=name)
        interval = f"{clean.low:.3f} to {clean.high:.3f}" if name == "score" else ""
        cells.append((name, _number(value), interval, *map(_number, means)))
    return cells


def _score_cells(row: Row) -> tuple[str, ...]:
    value = f"{row.quantity} {row.value:.3g} {row.unit}" if row.quantity else ""
    interval = f"{row.score.low:.3f} to {row.score.high:.3f}"
    worst = [row.worst_case.value] if row.worst_case else []
    numbers = (_number(value) for value in (row.drop.value, *worst, *row.set_scores.values()))
    return row.scene, str(row.severity), _number(row.score.value), interval, *numbers, value


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3f}"


def _table(head: Sequence[str], rows: Any) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    lines = line(head, "th") + "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table>{lines}</table></div>'


def _figure(example: Example) -> str:
    caption, legend = html.escape(example.caption), ""
    if example.clean and example.degraded:
        pictures = [_with_classes(of) for of in (example.clean, example.degraded)]
        legend = _legend(example.clean.classes, example.degraded.classes)
    else:
        pictures = [_with_boxes(example)]
    images = " ".join(f'<img alt="{caption}" src="data:image/jpeg;base64,{_jpeg(of)}">' for of in pictures)
    return f"<figure>{images}<figcaption>{caption}{legend}</figcaption></figure>"


def _with_boxes(example: Example) -> Image.Image:
    picture = Image.fromarray(pixels_of(example.image))
    draw = ImageDraw.Draw(picture)
    for name, boxes in (("labels", example.labels), ("predictions", example.predictions)):
        for box in [] if boxes is None else boxes.tolist():
            draw.rectangle(box, outline=_COLORS[name], width=max(2, picture.width // 320))
    return picture


def _with_classes(prediction: Classes) -> Image.Image:
    """Draw the classes of an image half-transparent over it."""
    colors = np.array(_PALETTE, np.uint8)[prediction.classes.long().cpu().numpy() % len(_PALETTE)]
    return Image.blend(Image.fromarray(pixels_of(prediction.image)), Image.fromarray(colors), _OPACITY)


def _legend(*predictions: Tensor) -> str:
    """Return the color of each class that covers a share of a picture which can be seen."""
    shares: dict[int, float] = {}
    for classes in predictions:
        for name, count in zip(*(of.tolist() for of in classes.long().unique(return_counts=True)), strict=True):
            shares[name] = max(shares.get(name, 0.0), count / classes.numel())
    parts = [
        f'<span class="class" style="background: rgb{_PALETTE[name % len(_PALETTE)]}"></span>{name}'
        for name, share in sorted(shares.items())
        if share >= _SEEN_SHARE
    ]
    return f"<br>classes {' '.join(parts)}"


def _jpeg(picture: Image.Image) -> str:
    picture.thumbnail((460, 460))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=85)
    return _encoded(buffer.getvalue())


def _encoded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
