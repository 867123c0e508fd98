"""How much accuracy each knob gives up, on real frames, and how much time it saves.

python benchmarks/tradeoff.py [--frames ../shared/data/fullres] [--count 2] [--size 1080x1920] [--threads 2]
                              [--repeats 15] [--quick] [--out benchmarks/results]

Writes tradeoff.csv, tradeoff.json and tradeoff.png to the folder, and prints a table for a README. `--frames synthetic`
renders road scenes. `--quick` is a size for tests.
"""

import argparse
import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from accuracy import SEED, decibels, draw_params, frame_errors, together
from arguments import count, size
from pareto import Point, draw, front
from slow_timing import timed
from sweeps import DENSE, ITSELF, SWEEPS, Variant
from timing import FEWEST_REPEATS, GRID_SAMPLE, Candidate, Conditions, Spread, references
from torch import Tensor

from torchrefract._io import replace_file
from torchrefract.data.images import EXTENSIONS, fit, image_size, read_image
from torchrefract.data.road_scenes import render_road_scenes

WHAT = (
    "Each effect with each value of its knobs, float32, on whole frames, with the parameters of one draw a frame, held "
    "against the same draw computed densely in float64. px: how far the flow is off, largest over all pixels and "
    "frames, and mean. Levels: |error| of the image in 255ths, largest and mean. dB: PSNR over all frames. For the "
    "knob 'interpolation' the true image is that of the float64 flow, read by quintic splines, on the pixels 12 px and "
    "more inside; for all other knobs it is read as the effect reads, so that the flow alone is judged. Steps are held "
    "against 16 of them, few scales of noise against all, stored values against linear light. Kinds of fields and of "
    "blends are different effects, each held against itself. Times are of effect.apply(frame, params) on the first "
    "frame, without the draw, in multiples of a bare F.grid_sample, which keeps one thread busy."
)
FRAMES = Path(__file__).parents[2] / "shared" / "data" / "fullres"
SYNTHETIC = "synthetic"
QUICK = (96, 128)


@dataclass(frozen=True)
class Row:
    """One value of a knob."""

    effect: str
    knob: str
    value: str
    against: str
    ratio: float  # to a bare grid_sample: median and quartiles, or least and most of a slow one
    ratio_lower: float
    ratio_upper: float
    largest_px: float | None  # None for light, which moves nothing
    mean_px: float | None
    largest_levels: float
    mean_levels: float
    psnr_db: float  # inf for an image without any error
    front: bool  # none with the same knob and truth is as good in time and mean error and better in one of them


def main() -> None:
    """Measure, print and save."""
    parser = _parser()
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    try:
        frames = read_frames(args.frames, QUICK if args.quick else args.size, 1 if args.quick else args.count)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    conditions = Conditions.now(frames[0], threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    rows = []
    for effect, variants in SWEEPS.items():
        print(f"{effect} ...", flush=True)
        rows += sweep(effect, variants, frames, repeats=args.repeats, threads=args.threads)
    print("", *table(rows), "", sep="\n")
    save(args.out, rows, conditions, frames=len(frames))
    print(f"written to {args.out}")


def read_frames(folder: str, size: tuple[int, int], count: int) -> list[Tensor]:
    """So many frames (1, 3, H, W) of a size: spread over those of a folder that are as large, or rendered.

    Raises:
        ValueError: a folder without a frame as large.
    """
    if folder == SYNTHETIC:
        return list(render_road_scenes(torch.arange(count), *size, seed=SEED)[0].split(1))
    found = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in EXTENSIONS)
    large = [path for path in found if all(own >= side for own, side in zip(image_size(path), size, strict=True))]
    if not large:
        raise ValueError(
            f"frames must be a folder with a picture of at least {size[0]}x{size[1]} px (height x width), or the word "
            f"{SYNTHETIC!r}, got {folder} with {len(found)} pictures"
        )
    return [fit(read_image(path), size)[None] for path in large[:: max(1, len(large) // count)][:count]]


def sweep(name: str, variants: Sequence[Variant], frames: Sequence[Tensor], *, repeats: int, threads: int) -> list[Row]:
    """The rows of one effect over frames (1, 3, H, W)."""
    ratios = times(variants, frames[0], repeats=repeats, threads=threads)
    by_frame = [frame_errors(variants, frame, key) for key, frame in enumerate(frames)]
    errors = [together(found) for found in zip(*by_frame, strict=True)]
    best = set()
    for group in {(v.knob, v.truth) for v in variants}:
        own = [i for i, v in enumerate(variants) if (v.knob, v.truth) == group]
        best |= {own[i] for i in front([(ratios[j].median, errors[j].mean_levels) for j in own])}
    return [
        Row(
            name,
            *(v.knob, v.value, v.against),
            *(ratio.median, ratio.lower, ratio.upper),
            *error[:-1],
            psnr_db=decibels(error.square),
            front=i in best,
        )
        for i, (v, ratio, error) in enumerate(zip(variants, ratios, errors, strict=True))
    ]


def times(variants: Sequence[Variant], frame: Tensor, *, repeats: int, threads: int) -> list[Spread]:
    """What each variant takes on a frame, as multiples of a bare grid_sample."""
    found: dict[str, Candidate] = references(frame)
    before = len(found)
    for i, variant in enumerate(variants):
        effect = variant.make()
        params = draw_params(effect, frame, 0)
        found[f"{i}"] = lambda effect=effect, params=params: effect.apply(frame, params).image
    timings, _ = timed(found, repeats=repeats, threads=threads)
    return [timing.ratios[GRID_SAMPLE] for timing in timings[before:]]


def table(rows: Sequence[Row]) -> list[str]:
    """The rows for a README."""
    head = "| effect | knob | value | x bare grid_sample | px, largest | levels, mean (largest) | PSNR, dB |"
    lines = [head, "| --- | --- | --- | --- | --- | --- | --- |"]
    for row in rows:
        ratio = Spread(row.ratio, row.ratio_lower, row.ratio_upper)
        px = "" if row.largest_px is None else f"{row.largest_px:.2g}"
        levels = f"{row.mean_levels:.2g} ({row.largest_levels:.2g})"
        lines.append(f"| {row.effect} | {row.knob} | {row.value} | {ratio} | {px} | {levels} | {row.psnr_db:.1f} |")
    return lines


def point(row: Row) -> Point:
    """The row in its panel; an effect that is held against itself is a series of its own, told by the legend alone."""
    if row.against == ITSELF:
        return Point("", f"{row.knob} {row.value}", row.ratio, row.mean_levels, row.front)
    series = row.knob if row.against == DENSE else f"{row.knob}, against {row.against}"
    return Point(row.value, series, row.ratio, row.mean_levels, row.front)


def save(folder: Path, rows: Sequence[Row], conditions: Conditions, *, frames: int) -> None:
    """The rows as CSV and JSON, and their picture; `frames` is how many the errors are over."""
    folder.mkdir(parents=True, exist_ok=True)
    with replace_file(folder / "tradeoff.csv") as path, path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    with replace_file(folder / "tradeoff.json") as path:
        kept = [asdict(row) | {"psnr_db": None if math.isinf(row.psnr_db) else row.psnr_db} for row in rows]
        content = {"what": WHAT, "conditions": asdict(conditions), "frames": frames, "rows": kept}
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    panels: dict[str, list[Point]] = {}
    for row in rows:
        panels.setdefault(row.effect, []).append(point(row))
    draw(
        folder / "tradeoff.png",
        panels,
        x="time, multiples of a bare grid_sample",
        y="mean error, 8-bit levels (in all panels 0.00001 is the foot)",
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", default=str(FRAMES), help=f"a folder of pictures, or the word {SYNTHETIC}")
    parser.add_argument("--count", type=count(1), default=2, help="so many of them, 2")
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width they are cut to, 1080x1920")
    parser.add_argument("--threads", type=count(1), default=2, help="threads of torch on the CPU, 2")
    parser.add_argument("--repeats", type=count(FEWEST_REPEATS), default=FEWEST_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--quick", action="store_true", help=f"one frame of {QUICK[0]}x{QUICK[1]}, to see that it runs")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="the folder to write to")
    return parser


if __name__ == "__main__":
    main()
