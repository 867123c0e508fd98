"""Whether effects at strength zero cost a scene anything.

python benchmarks/zero_strength.py [--size 1080x1920] [--threads 2] [--repeats 201]
                                   [--out benchmarks/results/zero_strength.json]
"""

import argparse
from pathlib import Path

import torch
from arguments import count, size
from subjects import FOG, LENS, SMOOTH, TOLERANCE_PX, WEATHER
from timing import FEWEST_REPEATS, Bar, Candidate, Conditions, Timing, measure, save, table
from torch import Tensor

from torchrefract import Compose, DivergenceFree, HeterogeneousFog, LensFlare, ThinPlateSpline, Turbulence, UniformFog
from torchrefract.effects.base import Effect

WHAT = (
    "A scene of a mild lens within 0.05 px and fog, and the same scene with three more effects whose strength is zero "
    "in every draw: warps of an amplitude of 0 px, or clear air and a sun without light. A new draw in every call, no "
    "gradients; ratios are taken within each round."
)
SCENE = "scene"
LIMIT = 0.03
_ROUNDS = 201  # of 31 the median alone is off by 2 % where single rounds differ by 8
_STILL, _CLEAR = (0.0, 0.0), (torch.inf, torch.inf)


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    args = _parser().parse_args()
    torch.manual_seed(0)
    frame = torch.rand(1, 3, *args.size)
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    timings = measure(candidates(frame), references=(SCENE,), repeats=args.repeats, threads=args.threads)
    held = bars(timings)
    print(table(timings, conditions), "", *held, sep="\n")
    save(args.out, timings, conditions, what=WHAT, bars=held)
    print(f"written to {args.out}")


def zeros() -> dict[str, list[Effect]]:
    """Threes of effects that change nothing."""
    return {
        "warps": [
            Turbulence(amplitude_range=_STILL),
            ThinPlateSpline(amplitude_range=_STILL),
            DivergenceFree(amplitude_range=_STILL),
        ],
        "weather": [
            UniformFog(visibility_range=_CLEAR),
            HeterogeneousFog(visibility_range=_CLEAR),
            LensFlare(strength_range=_STILL),
        ],
    }


def candidates(frame: Tensor) -> dict[str, Candidate]:
    """The scene on a frame (B, C, H, W), alone and with more that changes nothing."""
    scene: list[Effect] = [WEATHER[FOG](), SMOOTH[LENS](tolerance_px=TOLERANCE_PX)]
    scenes = {SCENE: Compose(scene)}
    for name, more in zeros().items():
        scenes[f"{SCENE} and three {name} at strength zero"] = Compose([*scene, *more])
    return {name: lambda whole=whole: whole(frame) for name, whole in scenes.items()}


def bars(timings: list[Timing]) -> list[Bar]:
    """What the issue asks for, beside what was measured: how far the ratio is from 1."""
    return [
        Bar(timing.name, abs(timing.ratios[SCENE].median - 1), "<=", LIMIT, "of the scene's time, more or less")
        for timing in timings
        if timing.name != SCENE
    ]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width of the frame, 1080x1920")
    parser.add_argument("--threads", type=count(1), default=2, help="threads of torch on the CPU, 2")
    parser.add_argument("--repeats", type=count(FEWEST_REPEATS), default=_ROUNDS, help="rounds, 201")
    out = Path(__file__).parent / "results" / "zero_strength.json"
    parser.add_argument("--out", type=Path, default=out, help="the JSON")
    return parser


if __name__ == "__main__":
    main()
