"""How the time of effects grows with pixels, batch, composed effects and clip length.

python benchmarks/scaling.py [--threads 2] [--repeats 15] [--memory GIB] [--out benchmarks/results/scaling.json]
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from looks import timed
from memory import peak_bytes
from timing import GRID_SAMPLE, MIN_REPEATS, TOLERANCE_PX, WARPS, Conditions, count, effects, references

from torchrefract import Compose
from torchrefract._io import replace_file
from torchrefract.effects.base import Effect

WHAT = (
    "effect(image) with a new draw in every call, without gradients, float32; warps within 0.05 px, or exact where it "
    "says so. Pixels: one frame; batch: frames of 256x256; effects: so many warps composed, one frame of 1920x1080; "
    "frames: one clip of 256x256. The slope is that of the line of least squares through log time over log size: 1 is "
    "in proportion, below 1 a fixed share that size spreads, above 1 more for each pixel of a larger frame; for "
    "effects 0 is as dear as one, 1 as dear as one after the other. What takes 0.1 s or more has three rounds. Times "
    "are medians. A candidate is skipped where, by its peak at the size before, it would not fit into memory."
)
SIZES = ((64, 64), (256, 256), (1080, 1920), (2160, 3840), (4320, 7680))
BATCHES = (1, 4, 16, 64)
COUNTS = (1, 2, 3, 4)
FRAMES = (1, 2, 4, 8, 16)
SIDE = 256  # px, of the frames of batches and clips
COMPOSED = (1080, 1920)
SLOW_S = 0.1
_SHARE = 0.7  # of the memory that is free


class Step(NamedTuple):
    """One size along an axis."""

    at: int
    shape: tuple[int, ...]  # of the image or the clip
    effects: Mapping[str, Effect]


@dataclass
class Growth:
    """What became of one effect along one axis."""

    along: str
    effect: str
    at: list[int] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)  # to a bare grid_sample of as many frames and pixels
    skipped: list[str] = field(default_factory=list)

    @property
    def slope(self) -> float | None:
        """Of log time over log size; None for one size."""
        return slope(self.at, self.milliseconds)


def main() -> None:
    """Measure, print and save."""
    args = _parser().parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    limit = args.memory * 2**30 if args.memory else free_bytes() * _SHARE
    conditions = Conditions.now(torch.empty(1, 3, *COMPOSED), threads=args.threads, repeats=args.repeats)
    print(WHAT, f"At most {limit / 2**30:.1f} GiB.", end="\n\n", flush=True)
    found = []
    for along, steps in AXES.items():
        found += grow(along, steps(), limit=limit, repeats=args.repeats, threads=args.threads)
        print(*table([growth for growth in found if growth.along == along]), "", sep="\n", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as path:
        rows = [asdict(growth) | {"slope": growth.slope} for growth in found]
        content = {"what": WHAT, "conditions": asdict(conditions), "growth": rows}
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


def slope(at: Sequence[float], values: Sequence[float]) -> float | None:
    """That of the line of least squares through the logarithms; None for one size."""
    return float(np.polyfit(np.log(at), np.log(values), 1)[0]) if len(at) > 1 else None


def grow(along: str, steps: Sequence[Step], *, limit: float, repeats: int, threads: int) -> list[Growth]:
    """Each effect at each size that fits into so many bytes."""
    found: dict[str, Growth] = {}
    needs: dict[str, float] = {}  # bytes for each unit of size, at the last one
    for step in steps:
        image = torch.rand(step.shape)
        chosen = references(image.view(-1, *step.shape[-3:]))
        for name, effect in step.effects.items():
            growth = found.setdefault(name, Growth(along, name))
            need = needs.get(name, 0.0) * step.at
            if need > limit:
                growth.skipped.append(f"{step.at}: needs about {need / 2**30:.1f} GiB")
                continue
            chosen[name] = partial(effect, image)
        timings, _ = timed(chosen, repeats=repeats, threads=threads, slow_s=SLOW_S)
        for timing in timings:
            if timing.name not in found:
                continue
            found[timing.name].at.append(step.at)
            found[timing.name].milliseconds.append(timing.milliseconds.median)
            found[timing.name].ratios.append(timing.ratios[GRID_SAMPLE].median)
            if step is not steps[-1]:
                needs[timing.name] = peak_bytes(chosen[timing.name]) / step.at
    return list(found.values())


def free_bytes() -> float:
    """Of memory, as Linux tells; elsewhere 8 GiB."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 8.0 * 2**30
    return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))


def by_pixels() -> list[Step]:
    """One frame of each size, through all effects, the warps exact too."""
    exact = {f"{name}, exact": make(tolerance_px=None) for name, make in WARPS.items()}
    return [Step(h * w, (1, 3, h, w), {**effects(), **exact}) for h, w in SIZES]


def by_batch() -> list[Step]:
    """Frames of one size."""
    return [Step(batch, (batch, 3, SIDE, SIDE), effects()) for batch in BATCHES]


def by_effects() -> list[Step]:
    """More and more warps in one look-up."""
    within = f"warps within {TOLERANCE_PX} px"
    return [
        Step(
            n,
            (1, 3, *COMPOSED),
            {within: _first_warps(n, TOLERANCE_PX), "warps, exact": _first_warps(n, None)},
        )
        for n in COUNTS
    ]


def by_frames() -> list[Step]:
    """Clips of one size."""
    return [Step(frames, (1, frames, 3, SIDE, SIDE), effects()) for frames in FRAMES]


AXES: Mapping[str, Callable[[], list[Step]]] = {
    "pixels": by_pixels,
    "batch": by_batch,
    "effects": by_effects,
    "frames": by_frames,
}


def table(found: Sequence[Growth]) -> list[str]:
    """The effects along one axis: ms at each size, and the slope."""
    sizes = sorted({at for growth in found for at in growth.at})
    lines = [f"{'ms by ' + found[0].along:32}" + "".join(f"{at:>12}" for at in sizes) + "       slope"]
    for growth in found:
        ms = dict(zip(growth.at, growth.milliseconds, strict=True))
        cells = "".join(f"{ms[at]:12.3g}" if at in ms else f"{'-':>12}" for at in sizes)
        lines.append(f"{growth.effect:32}{cells}{'' if growth.slope is None else f'{growth.slope:12.2f}'}")
    return lines + [f"{growth.effect} skipped at {reason}" for growth in found for reason in growth.skipped]


def _first_warps(count: int, tolerance_px: float | None) -> Compose:
    warps = [make(tolerance_px=tolerance_px) for make in list(WARPS.values())[:count]]
    return Compose(warps, tolerance_px=tolerance_px)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--threads", type=count(1), default=2, help="threads of torch on the CPU, 2")
    parser.add_argument("--repeats", type=count(MIN_REPEATS), default=MIN_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--memory", type=float, help="GiB that an effect may take, 70 %% of what is free")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "scaling.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
