"""What effects cost on a GPU, eager and compiled, and whether they do there what they do on the CPU.

python benchmarks/gpu.py [--shape 16x3x1080x1920] [--only fog "mild lens"] [--eager] [--repeats 15]
    [--device cuda] [--out benchmarks/results/gpu.json]

Without the device this is one line on standard error and exit code 1: a run that measured nothing is no success.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from arguments import count, shape
from subjects import SMOOTH, TOLERANCE_PX, effects
from timing import COPY, FEWEST_REPEATS, GRID_SAMPLE, Bar, Candidate, Conditions, Timing, measure, references, table
from torch import Tensor

from torchrefract._io import replace_file
from torchrefract.effects.base import Effect
from torchrefract.warping.grid import length

WHAT = (
    "effect(image) with a new draw in every call, without gradients, in multiples of a bare F.grid_sample of the same "
    "batch; 'compiled' is torch.compile(effect, fullgraph=True). Bytes per second count what no effect can avoid, the "
    "image read once and written once, beside those of a copy of it, which is the ceiling. Agreement: the largest "
    "difference between the device and the CPU for one frame and the same draw, of the flow in px, of the image of an "
    "effect of light in 8-bit levels."
)
SHAPE = (16, 3, 1080, 1920)
AGREE_PX = 1e-3
AGREE_LEVELS = 0.05
SEED = 7


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    args = _parser().parse_args()
    if args.device.type == "cuda" and not torch.cuda.is_available():
        print(f"error: {args.device} must be a device of this machine, and torch sees no GPU here", file=sys.stderr)
        raise SystemExit(1)
    torch.manual_seed(0)
    frames = torch.rand(args.shape).to(args.device)
    chosen = {name: effect for name, effect in subjects().items() if not args.only or name in args.only}
    conditions = Conditions.now(frames, threads=torch.get_num_threads(), repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    bars = agreement(chosen, frames[:1])
    # Effects share the code of their `forward`, of which a process compiles few kinds by default.
    with torch._dynamo.config.patch(recompile_limit=64):
        found, failed = working(candidates(chosen, frames, backend=args.backend, compiled=not args.eager))
        timings = measure(found, references=(GRID_SAMPLE, COPY), repeats=args.repeats, threads=torch.get_num_threads())
    speeds = bytes_per_second(timings, frames)
    print(table(timings, conditions), *failed, "", *traffic(speeds), "", *bars, sep="\n")
    save(args.out, timings, conditions, bars=bars, speeds=speeds)
    print(f"written to {args.out}")


def subjects() -> dict[str, Effect]:
    """The effects, the warps within a tolerance and exact."""
    return {**effects(TOLERANCE_PX), **{f"{name}, exact": make() for name, make in SMOOTH.items()}}


def candidates(
    chosen: Mapping[str, Effect], frames: Tensor, *, backend: str = "inductor", compiled: bool = True
) -> dict[str, Candidate]:
    """Each effect on a batch (B, C, H, W), eager and, if wanted, compiled; the references come first."""
    found = references(frames)
    for name, effect in chosen.items():
        found[name] = lambda effect=effect: effect(frames)
        if compiled:
            graph: Any = torch.compile(effect, fullgraph=True, backend=backend)
            found[f"{name}, compiled"] = lambda graph=graph: graph(frames)
    return found


def working(found: Mapping[str, Candidate]) -> tuple[dict[str, Candidate], list[str]]:
    """The candidates that can be called, and a line about each that cannot: one failure must not cost the others.

    How long a first call takes is printed; a compiler is at work in it.
    """
    kept, failed = {}, []
    for name, call in found.items():
        start = time.perf_counter()
        try:
            call()
            kept[name] = call
            print(f"{name}: first call {time.perf_counter() - start:.1f} s", flush=True)
        except Exception as error:  # a compiler raises whatever it likes; which, is told beside the others' times
            failed.append(f"{name} is left out: {type(error).__name__}: {str(error).splitlines()[0]}")
    return kept, failed


def agreement(chosen: Mapping[str, Effect], frame: Tensor) -> list[Bar]:
    """How far each effect on the device of a frame (1, C, H, W) is from itself on the CPU.

    And how far where a training has told PyTorch to round the factors of products.
    """
    return [bar for name, effect in chosen.items() for bar in _agreement(name, effect, frame)]


def _agreement(name: str, effect: Effect, frame: Tensor) -> Iterator[Bar]:
    params = effect.sample(frame.cpu(), seed=SEED)
    here, before = effect.apply(frame.cpu(), params), torch.get_float32_matmul_precision()
    flow = here.flow
    for precision in ("highest", "high"):
        torch.set_float32_matmul_precision(precision)
        try:
            there = effect.apply(frame, params.to(frame.device))
            what = f"{name} as on the CPU" + (", TF32 allowed" if precision == "high" else "")
            if flow is not None:
                yield Bar(what, length(cast(Tensor, there.flow).cpu() - flow).max().item(), "<=", AGREE_PX, "px")
            else:
                off = 255 * (there.image.cpu() - here.image).abs().max().item()
                yield Bar(what, off, "<=", AGREE_LEVELS, "levels")
        finally:
            torch.set_float32_matmul_precision(before)


def bytes_per_second(timings: Sequence[Timing], frames: Tensor) -> dict[str, float]:
    """Of each candidate: the batch read and written, over its median time."""
    return {t.name: 2 * frames.nbytes / (1e-3 * t.milliseconds.median) for t in timings}


def traffic(speeds: Mapping[str, float]) -> list[str]:
    """The speeds for a person to read."""
    ceiling = speeds[COPY]
    return [f"{name:40} {speed / 1e9:8.1f} GB/s, {speed / ceiling:.2f} of a copy" for name, speed in speeds.items()]


def save(
    path: Path,
    timings: Sequence[Timing],
    conditions: Conditions,
    *,
    bars: Sequence[Bar],
    speeds: Mapping[str, float],
) -> None:
    """A run as JSON, the file there whole or not at all."""
    content = {
        "what": WHAT,
        "conditions": asdict(conditions),
        "timings": [asdict(timing) | {"bytes_per_second": speeds[timing.name]} for timing in timings],
        "bars": [asdict(bar) | {"holds": bar.holds} for bar in bars],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--shape", type=shape, default=SHAPE, help="batch x channels x height x width, 16x3x1080x1920")
    parser.add_argument("--only", nargs="+", choices=list(subjects()), help="some effects, by name; all")
    parser.add_argument("--eager", action="store_true", help="leave out the compiled ones, which take minutes to make")
    parser.add_argument("--repeats", type=count(FEWEST_REPEATS), default=FEWEST_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"), help="cuda")
    parser.add_argument("--backend", default="inductor", help="of torch.compile, inductor")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "gpu.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
