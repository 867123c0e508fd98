"""Time effects on a GPU, eager and compiled, and compare them with the CPU.

python benchmarks/gpu.py [--shape 16x3x1080x1920] [--only "mild lens" flare] [--eager] [--repeats 15]
    [--device cuda] [--out benchmarks/results/gpu.json]

Without the device the command prints one line on standard error and ends with exit code 1.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from timing import (
    COPY,
    GRID_SAMPLE,
    MIN_REPEATS,
    RESULTS,
    WARPS,
    Bar,
    Candidate,
    Conditions,
    Timing,
    count,
    effects,
    measure,
    references,
    save,
    shape,
    table,
)
from torch import Tensor

WHAT = (
    "effect(image) with a new draw in every call, without gradients, in multiples of a bare F.grid_sample of the same"
    " batch; 'compiled' is torch.compile(effect, fullgraph=True). Bytes per second count the image read once and "
    "written once, beside those of a copy of it, which is the upper limit. Agreement: the largest difference between "
    "the device and the CPU for one frame and the same draw, of the flow in px, and of the image of fog and flare in "
    "levels of 1/255, with TF32 forbidden and allowed."
)
SHAPE = (16, 3, 1080, 1920)
AGREE_PX = 1e-3
AGREE_LEVELS = 0.05
SEED = 7


def main() -> None:
    """Measure, print and save; a limit that does not hold is marked and is no failure of the command."""
    args = _parser().parse_args()
    if args.device.type == "cuda" and not torch.cuda.is_available():
        print(f"error: {args.device} must be a device of this machine, but torch finds no GPU", file=sys.stderr)
        raise SystemExit(1)
    torch.manual_seed(0)
    frames = torch.rand(args.shape).to(args.device)
    chosen = {name: effect for name, effect in all_effects().items() if not args.only or name in args.only}
    threads = torch.get_num_threads()
    conditions = Conditions.now(frames, threads=threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    bars = [bar for name, effect in chosen.items() for bar in agreement(name, effect, frames[:1])]
    # All effects share the code of one `forward`; by default a process compiles few variants of it.
    with torch._dynamo.config.patch(recompile_limit=64), torch.no_grad():
        compiled = None if args.eager else args.backend
        named, failures = working(candidates(chosen, frames, backend=compiled))
        timings = measure(named, references=(GRID_SAMPLE, COPY), repeats=args.repeats, threads=threads)
    speeds = bytes_per_second(timings, frames)
    shares = [
        f"{name:40} {speed / 1e9:8.1f} GB/s, {speed / speeds[COPY]:.2f} of a copy" for name, speed in speeds.items()
    ]
    print(table(timings, conditions), *failures, "", *shares, "", *bars, sep="\n")
    save(args.out, timings, conditions, what=WHAT, bars=bars, bytes_per_second=speeds)


def all_effects() -> dict[str, Any]:
    """Return the effects by name; warps within a tolerance and exact."""
    return effects() | {f"{name}, exact": make(tolerance_px=None) for name, make in WARPS.items()}


def candidates(chosen: Mapping[str, Any], frames: Tensor, *, backend: str | None) -> dict[str, Candidate]:
    """Return each effect on a batch (B, C, H, W), eager and compiled; the references come first.

    Args:
        chosen: effects by name.
        frames: the batch.
        backend: of torch.compile; None for eager candidates only.
    """
    named = references(frames)
    for name, effect in chosen.items():
        named[name] = partial(effect, frames)
        if backend is not None:
            graph: Any = torch.compile(effect, fullgraph=True, backend=backend)
            named[f"{name}, compiled"] = partial(graph, frames)
    return named


def working(named: Mapping[str, Candidate]) -> tuple[dict[str, Candidate], list[str]]:
    """Call each candidate once; return those that work, and a line about each that fails.

    Prints the time of the first call, which includes compilation.
    """
    good, failures = {}, []
    for name, call in named.items():
        start = time.perf_counter()
        try:
            call()
            good[name] = call
            print(f"{name}: first call {time.perf_counter() - start:.1f} s", flush=True)
        except Exception as error:  # compilers raise many types, and one failure must not cost the other timings
            failures.append(f"{name} is skipped: {type(error).__name__}: {str(error).splitlines()[0]}")
    return good, failures


def agreement(name: str, effect: Any, frame: Tensor) -> list[Bar]:
    """Compare an effect on the device of a frame (1, C, H, W) with the CPU, with TF32 forbidden and allowed."""
    params = effect.sample(frame.cpu(), seed=SEED)
    expected, precision = effect.apply(frame.cpu(), params), torch.get_float32_matmul_precision()
    flow, bars = expected.flow, []
    for setting, words in (("highest", ""), ("high", ", TF32 allowed")):
        torch.set_float32_matmul_precision(setting)
        try:
            result = effect.apply(frame, params.to(frame.device))
            if flow is not None:
                error, limit, unit = (result.flow.cpu() - flow).norm(dim=1).max().item(), AGREE_PX, "px"
            else:
                error, limit = 255 * (result.image.cpu() - expected.image).abs().max().item(), AGREE_LEVELS
                unit = "levels"
            bars.append(Bar(f"{name}, device and CPU{words}", error, "<=", limit, unit))
        finally:
            torch.set_float32_matmul_precision(precision)
    return bars


def bytes_per_second(timings: Sequence[Timing], frames: Tensor) -> dict[str, float]:
    """Return, for each candidate, the bytes of the batch read and written, over its median time."""
    return {t.name: 2 * frames.nbytes / (1e-3 * t.milliseconds.median) for t in timings}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--shape", type=shape, default=SHAPE, help="batch x channels x height x width, 16x3x1080x1920")
    parser.add_argument("--only", nargs="+", choices=list(all_effects()), help="names of effects; all")
    parser.add_argument("--eager", action="store_true", help="skip compiled effects, which take minutes to compile")
    parser.add_argument("--repeats", type=count(MIN_REPEATS), default=MIN_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"), help="cuda")
    parser.add_argument("--backend", default="inductor", help="of torch.compile, inductor")
    parser.add_argument("--out", type=Path, default=RESULTS / "gpu.json", help="JSON file to write")
    return parser


if __name__ == "__main__":
    main()
