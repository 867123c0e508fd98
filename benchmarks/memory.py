"""How much memory an effect takes beside its image, at its peak, in multiples of the image.

python benchmarks/memory.py [--size 1080x1920] [--real PATH] [--out benchmarks/results/memory.json]
"""

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from timing import Bar, Conditions, frame_of, size
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from torchrefract import (
    DivergenceFree,
    GroundPlaneDepth,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
)
from torchrefract._io import replace_file

WHAT = (
    "The most memory that torch holds at any moment of effect(image), the result included, the image not, without "
    "gradients, as torch's profiler sees every allocation; in multiples of the image, float32 on the CPU."
)
LIMIT = 3.0  # of weather


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width of the frame, 1080x1920")
    parser.add_argument("--real", type=Path, help="a picture to use as the frame, instead of noise")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "memory.json", help="the JSON")
    args = parser.parse_args()
    torch.manual_seed(0)
    try:
        frame = frame_of(args.real, args.size).contiguous()
    except (ValueError, RuntimeError) as error:
        parser.error(str(error))
    conditions = Conditions.now(frame, threads=torch.get_num_threads(), repeats=1)
    measured = {name: peak_bytes(call) / frame.nbytes for name, call in candidates(frame).items()}
    bars = [Bar(name, measured[name], "<=", LIMIT, "x the image") for name in weather(measured)]
    print(WHAT, "", *(f"{name:46} {value:6.3g} x" for name, value in measured.items()), "", *bars, sep="\n")
    content = {"what": WHAT, "conditions": asdict(conditions), "peak": measured}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as path:
        kept = content | {"bars": [asdict(bar) | {"holds": bar.holds} for bar in bars]}
        path.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


def candidates(frame: Tensor) -> dict[str, Callable[[], object]]:
    """The effects on a frame (1, 3, H, W), by name; those of light are called weather."""
    depth = torch.linspace(1, 200, frame.shape[3]).expand(1, 1, frame.shape[2], -1).contiguous()
    fogs = {
        "UniformFog": UniformFog(),
        "HeterogeneousFog": HeterogeneousFog(),
        "HeterogeneousFog in space": HeterogeneousFog(mode="ray", depth=GroundPlaneDepth()),
    }
    found: dict[str, Callable[[], object]] = {}
    for name, fog in fogs.items():
        found[f"weather: {name}"] = lambda fog=fog: fog(frame)
        found[f"weather: {name}, with a depth map"] = lambda fog=fog: fog.degrade(frame, depth=depth)
    effects = (LensFlare(), LensDistortion(), Turbulence(), ThinPlateSpline(), DivergenceFree())
    for effect in effects:
        light = "weather: " if isinstance(effect, LensFlare) else ""
        found[f"{light}{type(effect).__name__}"] = lambda effect=effect: effect(frame)
    return found


def weather(names: Sequence[str] | dict[str, float]) -> list[str]:
    """The candidates that the limit is for."""
    return [name for name in names if name.startswith("weather: ")]


def peak_bytes(call: Callable[[], object]) -> int:
    """The most that a call holds at once; what it returns is among it."""
    os.environ.setdefault("KINETO_LOG_LEVEL", "9")  # the profiler talks about itself
    call()  # what is kept for later calls is none of this one's
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        made = call()
    held = peak = 0
    kineto: Any = run.profiler.kineto_results if run.profiler else None
    changes = [event for event in kineto.events() if event.name() == "[memory]"]
    for event in sorted(changes, key=lambda event: event.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    del made
    return peak


if __name__ == "__main__":
    main()
