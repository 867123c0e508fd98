"""What effects cost in one worker of a DataLoader, which has one thread, beside albumentations.

python benchmarks/workers.py [--size 1080x1920] [--repeats 15] [--seconds 5] [--out benchmarks/results/workers.json]
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from looks import timed
from peers import albumentations, find_packages
from timing import GRID_SAMPLE, MIN_REPEATS, WARPS, Bar, Conditions, Timing, count, effects, references, size, table
from torch import Tensor
from torch.utils import benchmark
from torch.utils.data import DataLoader, Dataset

from torchrefract._io import replace_file
from torchrefract._tensor import to_uint8
from torchrefract.effects.base import Effect

WHAT = (
    "Multiples: measured inside the worker, on a frame 1x3xHxW float32, with a new draw in every call and no "
    "gradients, the warps within 0.05 px, or exact where it says so. Frames per second: what comes out of a DataLoader "
    "with one worker whose dataset holds one frame as uint8, 3xHxW for ours and HxWx3 for albumentations, and degrades "
    "it anew each time; the frame that comes back travels between the processes, and that is part of it."
)
LIMIT = 1.25
_FEWEST = 3  # frames


class Frames(Dataset[Tensor]):
    """One frame (3, H, W) uint8, degraded again and again."""

    def __init__(self, effect: Effect, frame: Tensor):
        self.effect, self.frame = effect, frame

    def __len__(self) -> int:
        return 1 << 20

    def __getitem__(self, index: int) -> Tensor:
        return self.effect(self.frame)


class Pixels(Dataset[Any]):
    """The same (H, W, 3), by a transform of albumentations."""

    def __init__(self, transform: Any, pixels: Any):
        self.transform, self.pixels = transform, pixels

    def __len__(self) -> int:
        return 1 << 20

    def __getitem__(self, index: int) -> Any:
        return self.transform(image=self.pixels)["image"]


class Measured(Dataset[Any]):
    """What effects take where this dataset is read: timings, notes on slow ones, conditions."""

    def __init__(self, chosen: Mapping[str, Effect], frame: Tensor, repeats: int):
        self.chosen, self.frame, self.repeats = chosen, frame, repeats

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> tuple[list[Timing], list[str], Conditions]:
        found = references(self.frame)
        for name, effect in self.chosen.items():
            found[name] = lambda effect=effect: effect(self.frame)
        threads = torch.get_num_threads()
        conditions = Conditions.now(self.frame, threads=threads, repeats=self.repeats)
        return *timed(found, repeats=self.repeats, threads=threads), conditions


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    args = _parser().parse_args()
    torch.manual_seed(0)
    frame = torch.rand(1, 3, *args.size)
    within = effects()
    chosen = {**within, **{f"{name}, exact": make(tolerance_px=None) for name, make in WARPS.items()}}
    peers, missing = find_packages()
    print(WHAT, *(line for line in missing if "albumentations" in line), "", sep="\n", flush=True)
    ((timings, notes, conditions),) = loader(Measured(chosen, frame, args.repeats))
    held = bars(timings, list(within))
    print(table(timings, conditions), *notes, "", *held, "", sep="\n", flush=True)
    pixels = to_uint8(frame)[0]
    rates = {}
    transforms = albumentations(peers["albumentations"], args.size[1]) if "albumentations" in peers else {}
    for name, frames in datasets(chosen, transforms, pixels).items():
        rates[name] = rate(frames, seconds=args.seconds)
        print(f"{name:56} {rates[name]:8.1f} frames/s", flush=True)
    _save(args.out, timings, conditions, bars=held, rates=rates)
    print(f"written to {args.out}")


def loader(frames: Dataset[Any]) -> DataLoader[Any]:
    """One worker; what it makes comes one by one."""
    return DataLoader(frames, batch_size=None, num_workers=1)


def datasets(chosen: Mapping[str, Effect], theirs: Mapping[str, Any], pixels: Tensor) -> dict[str, Dataset[Any]]:
    """Ours and theirs, of a frame (3, H, W) uint8."""
    found: dict[str, Dataset[Any]] = {f"ours: {name}": Frames(effect, pixels) for name, effect in chosen.items()}
    across = pixels.movedim(0, -1).contiguous().numpy()
    return found | {name: Pixels(transform, across) for name, transform in theirs.items()}


def rate(frames: Dataset[Any], *, seconds: float) -> float:
    """Frames per second out of a loader, counted from its first frame for so long, and for three frames at least."""
    coming = iter(loader(frames))
    next(coming)
    start, found = benchmark.timer(), 0
    while found < _FEWEST or benchmark.timer() - start < seconds:
        next(coming)
        found += 1
    return found / (benchmark.timer() - start)


def bars(timings: Sequence[Timing], names: Sequence[str]) -> list[Bar]:
    """What the issue asks for, beside what was measured."""
    ratios = {timing.name: timing.ratios[GRID_SAMPLE].median for timing in timings}
    return [Bar(name, ratios[name], "<=", LIMIT, f"x {GRID_SAMPLE}") for name in names]


def _save(
    path: Path,
    timings: Sequence[Timing],
    conditions: Conditions,
    *,
    bars: Sequence[Bar],
    rates: Mapping[str, float],
) -> None:
    content = {
        "what": WHAT,
        "conditions": asdict(conditions),
        "timings": [asdict(timing) for timing in timings],
        "bars": [asdict(bar) | {"holds": bar.holds} for bar in bars],
        "frames_per_second": rates,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width of the frame, 1080x1920")
    parser.add_argument("--repeats", type=count(MIN_REPEATS), default=MIN_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--seconds", type=float, default=5.0, help="that frames are counted for, 5")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "workers.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
