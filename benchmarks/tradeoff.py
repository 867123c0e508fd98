"""Measure the error and the time of each accuracy setting on real frames, and plot the Pareto fronts.

python benchmarks/tradeoff.py [--frames ../shared/data/fullres] [--count 2] [--size 1080x1920] [--threads 2]
                              [--repeats 15] [--quick] [--out benchmarks/results]

Writes tradeoff.json and tradeoff.png and prints a Markdown table. `--frames synthetic` renders road scenes. `--quick`
uses one small frame.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import Bbox
from scipy.ndimage import map_coordinates
from timing import (
    GRID_SAMPLE,
    PHOTOMETRIC,
    RESULTS,
    ROUGH_TURBULENCE,
    TOLERANCE_PX,
    WARPS,
    Conditions,
    Spread,
    all_warps,
    count,
    markdown,
    measure,
    parser,
    references,
    write_json,
)
from torch import Tensor

from torchrefract.data.frames import evenly_spaced
from torchrefract.data.images import EXTENSIONS, fit, image_size, read_image
from torchrefract.data.road_scenes import render_road_scenes

WHAT = (
    "Each effect with each value of a setting, float32, compared with the same draw computed exactly in float64. px: "
    "error of the flow, largest over all pixels and frames. Levels: absolute error of the image in 1/255, mean and "
    "largest. For the setting 'interpolation' the reference samples the image by quintic splines, and pixels within 12 "
    "px of the border are ignored; otherwise it samples as the effect does, so that only the flow differs. For 'steps' "
    "the reference takes 16 steps, for 'linear_light' it blends in linear light. Times are those of "
    "effect.apply(frame, params) on the first frame in multiples of a bare F.grid_sample."
)
FRAMES = Path(__file__).parents[2] / "shared" / "data" / "fullres"
SYNTHETIC = "synthetic"
QUICK_SIZE = (96, 128)
SEED = 7
TOLERANCES_PX = (0.01, 0.02, 0.05, 0.1, 0.3, 1.0)
TOLERANCES_LEVELS = (0.1, 0.3, 1.0)
STEPS, REFERENCE_STEPS = (1, 2, 4, 8), 16
MIN_ERROR = 1e-5  # smaller errors are plotted here
_MIN_SPAN = 4.0  # ratio of the ends of a time axis
_COLORS = ("#1f77b4", "#d1495b", "#2e8b57", "#8a5fbf", "#c77f1a")
_BORDER_PX = 12
_MARKER_PX = 4  # half the width of a marker
_LABEL_PLACES = [(x, y) for y in (4, -11, 15, -22, 26, -33) for x in (4, -26)]  # points, from the marker


class Variant(NamedTuple):
    """An effect with one value of a setting."""

    setting: str
    value: str
    make: Callable[[], Any]
    reference: Callable[[], Any]  # computed in float64
    is_spline: bool = False  # the reference samples the image by quintic splines


@dataclass(frozen=True)
class Row:
    """Time and errors of one value of a setting."""

    effect: str
    setting: str
    value: str
    ratio: float  # to a bare grid_sample, median and quartiles
    ratio_lower: float
    ratio_upper: float
    largest_px: float | None  # None for effects without a flow
    mean_levels: float
    largest_levels: float
    is_pareto: bool  # no other value of the setting is as good in time and mean error and better in one of them


class Errors(NamedTuple):
    """Errors of one image, or over several."""

    largest_px: float | None
    mean_levels: float
    largest_levels: float


def main() -> None:
    """Measure, print, plot and save."""
    options = parser(__doc__, out=RESULTS)
    options.add_argument("--frames", default=str(FRAMES), help=f"folder of pictures, or {SYNTHETIC!r}")
    options.add_argument("--count", type=count(1), default=2, help="number of frames, 2")
    options.add_argument("--quick", action="store_true", help="one frame of {}x{} px".format(*QUICK_SIZE))
    args = options.parse_args()
    try:
        frames = read_frames(args.frames, QUICK_SIZE if args.quick else args.size, 1 if args.quick else args.count)
    except (ValueError, OSError) as error:
        options.error(str(error))
    conditions = Conditions.now(frames[0], threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    rows = []
    for name, variants in settings().items():
        print(f"{name} ...", flush=True)
        with torch.no_grad():
            rows += evaluate(name, variants, frames, repeats=args.repeats, threads=args.threads)
    print("", table(rows), "", sep="\n")
    content = {"what": WHAT, "conditions": asdict(conditions), "frames": len(frames), "rows": list(map(asdict, rows))}
    write_json(args.out / "tradeoff.json", content)
    plot(args.out / "tradeoff.png", rows)


def settings() -> dict[str, list[Variant]]:
    """Return the variants of each effect, by its name."""
    variants = {name: _tolerances_px(make) + _interpolations(make) for name, make in WARPS.items()}
    variants["divergence-free"] += _steps(WARPS["divergence-free"])
    variants |= {"rough turbulence": _tolerances_px(ROUGH_TURBULENCE), "all four warps": _tolerances_px(all_warps)}
    variants |= {name: _tolerances(make) for name, make in PHOTOMETRIC.items()}
    fog = PHOTOMETRIC["uniform fog"]
    linear = partial(fog, linear_light=True)
    variants["uniform fog"] += [
        Variant("linear_light", "False", fog, linear),
        Variant("linear_light", "True", linear, linear),
    ]
    return variants


def _tolerances_px(make: Callable[..., Any]) -> list[Variant]:
    exact = partial(make, tolerance_px=None)
    within = [Variant("tolerance_px", f"{px:g}", partial(make, tolerance_px=px), exact) for px in TOLERANCES_PX]
    return [Variant("tolerance_px", "None", exact, exact), *within]


def _interpolations(make: Callable[..., Any]) -> list[Variant]:
    exact, within = partial(make, tolerance_px=None), partial(make, tolerance_px=TOLERANCE_PX)
    modes = ("nearest", "bilinear", "bicubic")
    return [
        Variant("interpolation", mode, partial(within, interpolation=mode), exact, is_spline=True) for mode in modes
    ]


def _steps(make: Callable[..., Any]) -> list[Variant]:
    exact = partial(make, tolerance_px=None)
    reference = partial(exact, steps=REFERENCE_STEPS)
    return [Variant("steps", str(steps), partial(exact, steps=steps), reference) for steps in STEPS]


def _tolerances(make: Callable[..., Any]) -> list[Variant]:
    within = [Variant("tolerance", f"{level:g}", partial(make, tolerance=level), make) for level in TOLERANCES_LEVELS]
    return [Variant("tolerance", "None", make, make), *within]


def read_frames(folder: str, size: tuple[int, int], count: int) -> list[Tensor]:
    """Return frames (1, 3, H, W) of a size from a folder, or rendered ones.

    Raises:
        ValueError: if no picture of the folder is large enough.
    """
    if folder == SYNTHETIC:
        return list(render_road_scenes(torch.arange(count), *size, seed=SEED)[0].split(1))
    paths = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in EXTENSIONS)
    large = [path for path in paths if all(a >= b for a, b in zip(image_size(path), size, strict=True))]
    if not large:
        raise ValueError(
            f"frames must be {SYNTHETIC!r} or a folder with a picture of at least {size[0]}x{size[1]} px (height x "
            f"width), got {folder} with {len(paths)} pictures"
        )
    return [fit(read_image(large[i]), size)[None] for i in evenly_spaced(len(large), count)]


def evaluate(
    name: str, variants: Sequence[Variant], frames: Sequence[Tensor], *, repeats: int, threads: int
) -> list[Row]:
    """Return the rows of one effect over frames (1, 3, H, W)."""
    timed = references(frames[0])
    for i, variant in enumerate(variants):
        effect = variant.make()
        timed[str(i)] = partial(effect.apply, frames[0], draw(effect, frames[0], 0))
    timings = measure(timed, repeats=repeats, threads=threads)[-len(variants) :]
    ratios = [timing.ratios[GRID_SAMPLE] for timing in timings]
    errors = [
        merge(of) for of in zip(*(frame_errors(variants, frame, key) for key, frame in enumerate(frames)), strict=True)
    ]
    best = set()
    for setting in {variant.setting for variant in variants}:
        members = [i for i, variant in enumerate(variants) if variant.setting == setting]
        best |= {members[i] for i in pareto_front([(ratios[j].median, errors[j].mean_levels) for j in members])}
    return [
        Row(name, v.setting, v.value, ratio.median, ratio.lower, ratio.upper, *error, is_pareto=i in best)
        for i, (v, ratio, error) in enumerate(zip(variants, ratios, errors, strict=True))
    ]


def frame_errors(variants: Sequence[Variant], frame: Tensor, key: int) -> list[Errors]:
    """Return the errors of each variant on one frame (1, 3, H, W), with the parameters drawn for a key."""
    cache: dict[Any, tuple[Tensor, Tensor | None, Tensor]] = {}
    errors = []
    for variant in variants:
        group = variant.reference, variant.is_spline
        if group not in cache:
            cache = {group: _reference(variant, frame, key)}  # only the last one: images in float64 are large
        effect = variant.make()
        result = effect.apply(frame, draw(effect, frame, key))
        errors.append(compare(result.image, result.flow, *cache[group]))
    return errors


def draw(effect: Any, frame: Tensor, key: int) -> Any:
    """Draw the parameters of a key, the same for all variants of an effect."""
    return effect.sample(frame, seed=SEED, keys=[key])


def _reference(variant: Variant, frame: Tensor, key: int) -> tuple[Tensor, Tensor | None, Tensor]:
    """Return the image, the flow and the mask of the pixels to compare, in float64."""
    effect = variant.reference()
    result = effect.apply(frame.double(), draw(effect, frame, key).to(torch.float64))
    mask = torch.ones_like(result.valid)
    if not variant.is_spline:
        return result.image, result.flow, mask
    inner = torch.zeros_like(mask)
    inner[..., _BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    return sample_spline(frame, result.flow).clamp(0, 1), result.flow, inner & result.valid


def sample_spline(image: Tensor, flow: Tensor) -> Tensor:
    """Sample an image (1, C, H, W) along a flow (1, 2, H, W), px, by quintic splines; (1, C, H, W), float64."""
    rows, columns = np.indices(image.shape[2:])
    u, v = flow[0].double().numpy()
    sampled = [map_coordinates(c, (rows + v, columns + u), order=5, mode="nearest") for c in image[0].double().numpy()]
    return torch.from_numpy(np.stack(sampled))[None]


def compare(image: Tensor, flow: Tensor | None, expected: Tensor, expected_flow: Tensor | None, mask: Tensor) -> Errors:
    """Return the errors of an image (1, C, H, W) and its flow on the pixels of a mask; of the flow on all pixels."""
    levels = 255 * (image.clamp(0, 1).double() - expected)[mask.expand_as(image)].abs()
    px = None
    if flow is not None and expected_flow is not None:
        px = (flow.double() - expected_flow).norm(dim=1).max().item()
    return Errors(px, levels.mean().item(), levels.max().item())


def merge(errors: Sequence[Errors]) -> Errors:
    """Return the largest and the mean errors over frames of one size."""
    px = [error.largest_px for error in errors if error.largest_px is not None]
    return Errors(
        max(px) if px else None,
        fmean(error.mean_levels for error in errors),
        max(error.largest_levels for error in errors),
    )


def pareto_front(costs: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the costs that no other dominates: as small in both and smaller in one."""
    front, best = [], math.inf
    for i in sorted(range(len(costs)), key=lambda i: costs[i]):
        if costs[i][1] < best or (front and costs[i] == costs[front[-1]]):
            front.append(i)
            best = costs[i][1]
    return front


def table(rows: Sequence[Row]) -> str:
    """Format the rows as Markdown."""
    head = ("effect", "setting", "value", "x bare grid_sample", "px, largest", "levels, mean (largest)")
    lines = []
    for row in rows:
        ratio = Spread(row.ratio, row.ratio_lower, row.ratio_upper)
        px = "" if row.largest_px is None else f"{row.largest_px:.2g}"
        levels = f"{row.mean_levels:.2g} ({row.largest_levels:.2g})"
        lines.append((row.effect, row.setting, row.value, str(ratio), px, levels))
    return markdown(head, lines)


def plot(path: Path, rows: Sequence[Row]) -> None:
    """Plot time against error, one panel for each effect, with the Pareto front of each setting as a line."""
    panels: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        panels[row.effect][row.setting].append(row)
    figure = Figure(figsize=(10.4, 3.1 * math.ceil(len(panels) / 2)), dpi=110, layout="constrained")
    all_axes = list(figure.subplots(math.ceil(len(panels) / 2), 2, squeeze=False, sharey=True).flat)
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    labels: list[Annotation] = []
    for axes, (name, series) in zip(all_axes, panels.items(), strict=False):
        for color, (setting, members) in zip(_COLORS, series.items(), strict=False):
            front = sorted(_position(row) for row in members if row.is_pareto)
            axes.plot(*zip(*front, strict=True), color=color, linewidth=1.2)
            axes.plot(*zip(*map(_position, members), strict=True), "o", color=color, markersize=5, label=setting)
            labels += [
                axes.annotate(
                    row.value, _position(row), _LABEL_PLACES[0], textcoords="offset points", fontsize=8, color=color
                )
                for row in members
            ]
        axes.set(xscale="log", yscale="log", title=name, ylim=(MIN_ERROR / 30, 1000))
        axes.margins(x=0.2)
        low, high = axes.get_xlim()
        widening = max(1.0, math.sqrt(_MIN_SPAN * low / high))  # equal times must not look different
        axes.set_xlim(low / widening, high * widening)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(color="#e4e4e4", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="upper right", frameon=False, fontsize=8)
    figure.supxlabel("time, multiples of a bare grid_sample", fontsize=11)
    figure.supylabel("mean error of the image, 1/255", fontsize=11)
    separate_labels(figure, labels)
    figure.savefig(path)


def separate_labels(figure: Figure, labels: Sequence[Annotation]) -> None:
    """Move each label to the first of several places without a marker or a label; hide it if there is none."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # lays out the panels
    markers = [cast(Axes, label.axes).transData.transform(label.xy) for label in labels]
    placed = [Bbox([marker - _MARKER_PX, marker + _MARKER_PX]) for marker in markers]
    for label in labels:
        for place in _LABEL_PLACES:
            label.xyann = place
            box = label.get_window_extent(canvas.get_renderer())
            if not box.count_overlaps(placed):
                placed.append(box)
                break
        else:
            label.set_visible(False)


def _position(row: Row) -> tuple[float, float]:
    return row.ratio, max(row.mean_levels, MIN_ERROR)


if __name__ == "__main__":
    main()
