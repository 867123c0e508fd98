"""Fixed point or Newton: which of the two finds the flow that undoes a flow, and at what cost.

python benchmarks/inverses.py FOLDER [--frames 2] [--threads 2] [--repeats 15] [--out benchmarks/results/inverses.json]

FOLDER holds frames, such as ../shared/data/fullres, whose sizes the flows take.
"""

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from roundtrip import EFFECTS
from timing import FEWEST_REPEATS, GRID_SAMPLE, Candidate, Conditions, Timing, measure, references
from torch import Tensor

from torchrefract import ThinPlateParams, invert_flow
from torchrefract._io import replace_file
from torchrefract.data.images import EXTENSIONS, image_size
from torchrefract.fields.spline import evaluate_spline, fit_spline
from torchrefract.warping.grid import inside, length, pixel_axes
from torchrefract.warping.resample import sample_image

WHAT = (
    "Flows of every warp, at its defaults and strong, inverted by the fixed point v <- -flow(p + v) from -flow and by "
    "Newton as in invert_flow, both reading the flow bilinearly, both judged by the same certificate: a residual "
    "|v + flow(p + v)| up to 0.05 px, a positive determinant of I + grad flow there, and a look-up inside the frame. "
    "'largest' and '99.9 %' are the residual in px on the pixels that either method certifies with the most steps; "
    "'valid' is the share of all pixels that is certified after so many steps; 'bend' is the rms of the second "
    "differences of the inverse, px, on the first set; 'to the spline' is, of a thin plate, the largest distance by "
    "which the spline itself, not its bilinear reading, is missed. Residuals and shares are the worst of the draws, "
    "bends their rms. Times are of one inverse with its certificate, Newton's of the first draw, the fixed point's of "
    "any, as multiples of a bare bilinear F.grid_sample of 3 channels, which keeps one thread busy."
)
FIXED_POINT, NEWTON = "fixed point", "Newton"
STEPS = {FIXED_POINT: (1, 2, 3, 5, 8, 12, 20, 30), NEWTON: (1, 2, 3, 4, 6, 8, 12)}
TOLERANCE_PX = 0.05
GOALS_PX = (0.05, 1e-3)
SEED = 7


class Solved(NamedTuple):
    """A flow that undoes another, after some steps of a method."""

    method: str
    steps: int
    inverse: Tensor  # (1, 2, H, W), px
    valid: Tensor  # (1, 1, H, W), bool, by the certificate
    residual: Tensor  # (1, 1, H, W), px


@dataclass(frozen=True)
class Row:
    """What a method reaches after some steps, and what that costs."""

    method: str
    steps: int
    largest_px: float
    most_px: float  # the 99.9th percentile
    valid: float
    bend_px: float
    spline_px: float | None  # None for what is no thin plate
    ratio: float | None = None  # to a bare grid_sample

    def __str__(self) -> str:
        spline = "" if self.spline_px is None else f"{self.spline_px:.1e}"
        ratio = "" if self.ratio is None else f"{self.ratio:.3g}"
        return (
            f"{self.method:11}  {self.steps:5}  {self.largest_px:8.1e}  {self.most_px:8.1e}  {self.valid:7.4f}"
            f"  {self.bend_px:8.5f}  {spline:>13}  {ratio:>6}"
        )


HEAD = f"{'method':11}  steps  {'largest':8}  {'99.9 %':8}  {'valid':7}  {'bend':8}  to the spline  x bare"


def main() -> None:
    """Measure, print and save."""
    args, sizes = _arguments()
    torch.set_num_threads(args.threads)
    frame = torch.rand(1, 3, *sizes[0])
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    tables, timings = dict[str, list[Row]](), dict[str, list[Timing]]()
    options = {"references": (GRID_SAMPLE,), "repeats": args.repeats, "threads": args.threads}
    timings[FIXED_POINT] = measure(candidates(frame, FIXED_POINT, next(iter(EFFECTS))), **options)
    for name in EFFECTS:
        timings[name] = measure(candidates(frame, NEWTON, name), **options)
        both = timings[FIXED_POINT] + timings[name]
        tables[name] = rows(name, sizes, {timing.name: timing.ratios[GRID_SAMPLE].median for timing in both})
        print(f"{name}: {len(sizes)} draws", HEAD, *tables[name], *needed(tables[name]), "", sep="\n", flush=True)
    _save(args.out, tables=tables, timings=timings, conditions=conditions)
    print(f"written to {args.out}")


def candidates(frame: Tensor, method: str, effect: str) -> dict[str, Candidate]:
    """What is timed of a method on a frame (1, C, H, W), by its steps; the reference comes first."""
    height, width = frame.shape[2:]
    flow = draw(effect, (height, width), key=0)[0]
    solve = {FIXED_POINT: fixed_point, NEWTON: invert_flow}[method]
    timed = {f"{method} {steps}": lambda steps=steps: solve(flow, steps=steps) for steps in STEPS[method]}
    return references(frame) | timed


def draw(name: str, size: tuple[int, int], *, key: int) -> tuple[Tensor, Any]:
    """The flow (1, 2, H, W) in px of an effect on a frame of (H, W) px, and its parameters."""
    effect = EFFECTS[name]("bilinear")
    params = effect.sample(torch.empty(1, 3, *size), seed=SEED, keys=[key])
    return effect.flow(params, height=size[0], width=size[1])[0], params


def fixed_point(flow: Tensor, *, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """The flow that undoes a warp, by fixed-point iteration.

        inverse <- -flow(p + inverse),  from -flow, the flow read bilinearly

    Args:
        flow: (B, 2, H, W), px.
        steps: at least 1.

    Returns:
        inverse: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool, as `certify` has it.
        residual: (B, 1, H, W), px.

    Source: Chen, Lu, Chen, Ruchala, Olivera, "A simple fixed-point approach to invert a deformation field", Medical
    Physics 35 (2008).
    """
    inverse = -flow
    for _ in range(steps):
        inverse = -read(flow, inverse)
    return inverse, *certify(flow, inverse)


def read(field: Tensor, flow: Tensor) -> Tensor:
    """A field (B, C, H, W) at p + flow(p), bilinearly, outside the frame as at its border."""
    return sample_image(field, flow, padding="border", interpolation="bilinear")


def certify(flow: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Where an inverse is one, (B, 1, H, W), bool, and by how much it misses, (B, 1, H, W), px; in one reading."""
    u_x, v_x, u_y, v_y = torch.cat([torch.gradient(flow, dim=dim)[0] for dim in (-1, -2)], dim=1).split(1, dim=1)
    determinant = (1 + u_x) * (1 + v_y) - u_y * v_x
    found = read(torch.cat([flow, determinant], dim=1), inverse)
    residual = length(inverse + found[:, :2])
    return (residual <= TOLERANCE_PX) & (found[:, 2:] > 0) & inside(inverse), residual


def solve(flow: Tensor) -> Iterator[Solved]:
    """What both methods find for a flow (1, 2, H, W), after each number of steps in STEPS."""
    inverse = -flow
    for step in range(1, STEPS[FIXED_POINT][-1] + 1):
        inverse = -read(flow, inverse)
        if step in STEPS[FIXED_POINT]:
            yield Solved(FIXED_POINT, step, inverse, *certify(flow, inverse))
    for steps in STEPS[NEWTON]:
        inverse = invert_flow(flow, steps=steps)[0]
        yield Solved(NEWTON, steps, inverse, *certify(flow, inverse))


def rows(name: str, sizes: Sequence[tuple[int, int]], ratios: Mapping[str, float]) -> list[Row]:
    """The figures of an effect over one draw for each size."""
    found = [_rows_of_draw(*draw(name, size, key=key)) for key, size in enumerate(sizes)]
    return [_over_draws(same, ratios.get(f"{same[0].method} {same[0].steps}")) for same in zip(*found, strict=True)]


def bend(inverse: Tensor, good: Tensor) -> float:
    """px: the rms of the second differences of a flow (1, 2, H, W) along x and y, where all three pixels are good."""
    squares = []
    for dim in (-1, -2):
        count = good.shape[dim] - 2
        three = [good.narrow(dim, start, count) for start in range(3)]
        known = (three[0] & three[1] & three[2]).expand(-1, 2, -1, -1)
        squares.append(inverse.double().diff(n=2, dim=dim).square()[known])
    return torch.cat(squares).mean().sqrt().item()


def spline_residual(inverse: Tensor, params: ThinPlateParams) -> Tensor:
    """(1, 1, H, W), px: |inverse(p) + spline(p + inverse(p))|, in float64."""
    x, y = pixel_axes(*inverse.shape[2:], dtype=torch.float64, device=inverse.device)
    at = torch.cat([x + inverse[:, :1], y + inverse[:, 1:]], dim=1)
    spline = fit_spline(params.points, params.displacement, params.smoothing)
    return length(inverse + evaluate_spline(spline, at.flatten(2).mT).mT.reshape(at.shape))


def needed(table: Sequence[Row]) -> list[str]:
    """For each goal, the fewest steps by which a method comes under it on 99.9 % of the pixels, and their cost."""
    lines = []
    for goal in GOALS_PX:
        reached = []
        for method in STEPS:
            first = next((row for row in table if row.method == method and row.most_px <= goal), None)
            cost = "" if first is None or first.ratio is None else f", {first.ratio:.3g} x"
            reached.append(f"{method} never" if first is None else f"{method} {first.steps} steps{cost}")
        lines.append(f"99.9 % within {goal:g} px: {'; '.join(reached)}")
    return lines


def _rows_of_draw(flow: Tensor, params: Any) -> list[Row]:
    solved = list(solve(flow))
    # The last of each method has had the most steps.
    good = torch.stack([last.valid for last in {s.method: s for s in solved}.values()]).any(dim=0)
    return [_row(one, good, params) for one in solved]


def _row(solved: Solved, good: Tensor, params: Any) -> Row:
    residual = solved.residual[good].double()
    place = max(1, math.ceil(0.999 * residual.numel()))  # torch.quantile takes no more than 2^24 numbers
    spline = None
    if isinstance(params, ThinPlateParams):
        spline = spline_residual(solved.inverse, params)[good].max().item()
    return Row(
        solved.method,
        solved.steps,
        residual.max().item(),
        residual.kthvalue(place).values.item(),
        solved.valid.double().mean().item(),
        bend(solved.inverse, good),
        spline,
    )


def _over_draws(same: Sequence[Row], ratio: float | None) -> Row:
    splines = [row.spline_px for row in same if row.spline_px is not None]
    return Row(
        same[0].method,
        same[0].steps,
        max(row.largest_px for row in same),
        max(row.most_px for row in same),
        min(row.valid for row in same),
        math.sqrt(sum(row.bend_px**2 for row in same) / len(same)),
        max(splines) if splines else None,
        ratio,
    )


def _save(
    path: Path, *, tables: Mapping[str, Sequence[Row]], timings: Mapping[str, Sequence[Timing]], conditions: Conditions
) -> None:
    content = {
        "what": WHAT,
        "conditions": asdict(conditions),
        "timings": {name: [asdict(timing) for timing in own] for name, own in timings.items()},
        "effects": {name: [asdict(row) for row in table] for name, table in tables.items()},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _arguments() -> tuple[argparse.Namespace, list[tuple[int, int]]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="frames, of any size")
    parser.add_argument("--frames", type=int, default=2, help="so many of them, spread over the folder, 2")
    parser.add_argument("--threads", type=int, default=2, help="threads of torch on the CPU, 2")
    parser.add_argument("--repeats", type=int, default=FEWEST_REPEATS, help="rounds of the timing, 15 or more")
    out = Path(__file__).parent / "results" / "inverses.json"
    parser.add_argument("--out", type=Path, default=out, help="the JSON")
    args = parser.parse_args()
    if args.frames < 1 or args.threads < 1 or args.repeats < FEWEST_REPEATS:
        parser.error(f"frames and threads must be at least 1, and repeats {FEWEST_REPEATS}")
    paths = sorted(path for path in args.folder.rglob("*") if path.suffix.lower() in EXTENSIONS)
    if not paths:
        parser.error(f"folder must hold frames, got {args.folder}")
    paths = paths[:: max(1, len(paths) // args.frames)][: args.frames]
    return args, [image_size(path) for path in paths]


if __name__ == "__main__":
    main()
