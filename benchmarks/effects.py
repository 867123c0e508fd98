"""What a whole effect costs, as a multiple of one bare F.grid_sample on the same frame.

python benchmarks/effects.py [--size 1080x1920] [--batch 1] [--threads 2] [--repeats 15] [--real PATH]
                             [--device cpu] [--out benchmarks/results/effects.json]
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from arguments import count, frame_of, size
from subjects import ROUGH, SMOOTH, TOLERANCE_PX, all_warps
from timing import (
    COPY,
    FEWEST_REPEATS,
    GRID_SAMPLE,
    Bar,
    Candidate,
    Conditions,
    Timing,
    measure,
    references,
    save,
    table,
)
from torch import Tensor

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
from torchrefract.fields.perlin import perlin_noise
from torchrefract.fields.perlin_lattice import octave
from torchrefract.random import noise_key, stream
from torchrefract.warping.grid import sampler_grid

WHAT = (
    "Whole effects through the public API, exact, with a new draw in every call: effect(image) without gradients; 'all"
    " maps' is degrade() with flow, valid, restore_flow and restore_valid; 'to params' asks for the gradient of every "
    "drawn number (of a lens all 12 coefficients, so that none is skipped as zero), forward alone or forward and "
    "backward. 'radial' is a lens without decentring, which needs no Newton steps in the plane. On the CPU the bare "
    "grid_sample threads over the batch alone; the effects use all threads on one frame too. Within 0.05 px the flow "
    "is computed on lattices: one mild lens, the lenses of the default ranges, each by its part of them, fields of 40 "
    "px and longer, and rough air that an aperture smooths; the image asks for its gradient, forward alone. How long "
    "the sampler takes depends on the flow, so bare grid_samples along flows of theirs, ready made, stand beside them, "
    "and they are told as multiples of these, too."
)
LENS, RADIAL, FOG, FLARE = "LensDistortion", "LensDistortion radial", "UniformFog", "LensFlare"
PERLIN, DRIFTS, SPACE = "Perlin noise, 6 octaves", "HeterogeneousFog", "HeterogeneousFog in space"
TURBULENCE, SPLINE, SWIRL = "Turbulence, length 20 px", "ThinPlateSpline, 16 points", "DivergenceFree, length 20 px"
FLEET = f"LensDistortion within {TOLERANCE_PX} px"
MILD, PLATE, AIR, STREAM, ALL_FOUR = (f"{name} within {TOLERANCE_PX} px" for name in (*SMOOTH, "all four warps"))
# Multiples of the bare grid_sample.
LIMITS = {LENS: 20.0, TURBULENCE: 10.0, SPLINE: 20.0, SWIRL: 10.0, FOG: 0.15, FLARE: 0.25, DRIFTS: 1.8, PERLIN: 1.5}
LIMITS |= {MILD: 0.8, PLATE: 0.85, AIR: 0.9, STREAM: 0.9, ALL_FOUR: 1.4}
WARPS = (MILD, PLATE, AIR, STREAM, ALL_FOUR)
BARS = "bars, set for 1x3x1080x1920 float32 on 2 threads:"


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    parser = _parser()
    args = parser.parse_args()
    torch.manual_seed(0)
    try:
        frame = frame_of(args.real, args.size).expand(args.batch, -1, -1, -1).contiguous().to(args.device)
    except (ValueError, RuntimeError) as error:
        parser.error(str(error))
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    found = tolerant(frame) if args.within else candidates(frame)
    timings = measure(found, references=(GRID_SAMPLE, COPY), repeats=args.repeats, threads=args.threads)
    held = bars(timings)
    print(table(timings, conditions), "", BARS, *held, sep="\n")
    save(args.out, timings, conditions, what=WHAT, bars=held)
    print(f"written to {args.out}")


def candidates(frame: Tensor) -> dict[str, Candidate]:
    """What is compared on a frame (B, C, H, W), by name; the references come first."""
    lens, fog = LensDistortion(tolerance_px=None), UniformFog()
    radial = LensDistortion(p1_range=(0.0, 0.0), p2_range=(0.0, 0.0), tolerance_px=None)
    found = references(frame)
    others = {
        TURBULENCE: Turbulence(length_range=(20.0, 20.0), tolerance_px=None),
        SPLINE: ThinPlateSpline(tolerance_px=None),
        SWIRL: DivergenceFree(length_range=(20.0, 20.0), tolerance_px=None),
        FLARE: LensFlare(),
        DRIFTS: HeterogeneousFog(),
        SPACE: HeterogeneousFog(mode="ray", depth=GroundPlaneDepth()),
    }
    for name, effect in {LENS: lens, RADIAL: radial, FOG: fog, **others}.items():
        found[name] = lambda effect=effect: effect(frame)
    found |= tolerant(frame)
    depth = torch.linspace(1, 200, frame.shape[3], device=frame.device).expand(len(frame), 1, frame.shape[2], -1)
    for name, effect in ((FOG, fog), (DRIFTS, others[DRIFTS]), (SPACE, others[SPACE])):
        found[f"{name}, with a depth map"] = lambda effect=effect: effect.degrade(frame, depth=depth)
    found[PERLIN] = lambda: _perlin(frame)
    found[f"{LENS}, all maps"] = lambda: _all_maps(lens, frame)
    for name, effect in ((LENS, lens), (RADIAL, radial), (FOG, fog)):
        found[f"{name}, to params, forward"] = lambda effect=effect: _forward(effect, frame)
        found[f"{name}, to params, forward + backward"] = _forward_and_backward(effect, frame)
    return found


def tolerant(frame: Tensor) -> dict[str, Candidate]:
    """The warps under a tolerance; the references come first."""
    makers = {**SMOOTH, **ROUGH}
    warps = {f"{name} within {TOLERANCE_PX} px": make(tolerance_px=TOLERANCE_PX) for name, make in makers.items()}
    found, learning = references(frame), frame.clone().requires_grad_()
    warps[FLEET] = LensDistortion(tolerance_px=TOLERANCE_PX)
    for name, effect in {**warps, ALL_FOUR: all_warps(tolerance_px=TOLERANCE_PX)}.items():
        grid = sampler_grid(effect.degrade(frame, seed=0).flow).contiguous()
        found[along(name)] = lambda grid=grid: F.grid_sample(frame, grid, mode="bilinear", align_corners=False)
        found[name] = lambda effect=effect: effect(learning)
    return found


def along(name: str) -> str:
    """The bare grid_sample along a flow of a warp."""
    return f"bare grid_sample along {name.removesuffix(f' within {TOLERANCE_PX} px')}"


def bars(timings: Sequence[Timing]) -> list[Bar]:
    """The limits, beside what was measured; of smooth warps also beside the sampler along such flows."""
    ratios = {timing.name: timing.ratios[GRID_SAMPLE].median for timing in timings}
    limits = [(name, limit) for name, limit in LIMITS.items() if name in ratios]
    found = [Bar(name, ratios[name], "<=", limit, f"x {GRID_SAMPLE}") for name, limit in limits]
    return found + [
        Bar(name, ratios[name] / ratios[along(name)], "<=", LIMITS[name], f"x {along(name)}") for name in WARPS
    ]


def _perlin(frame: Tensor) -> Tensor:
    """The noise of the paper's fog, lattices and all."""
    batch, _, height, width = frame.shape
    key, fog = noise_key(stream(0, range(batch))).to(frame.device), HeterogeneousFog()
    zero = frame.new_zeros(batch)
    octaves = [
        octave(
            key,
            i,
            period=scale * width / fog.reference_width,
            height=height,
            width=width,
            frame=zero,
            wind=torch.stack([zero, zero], dim=1),
            decorrelation=zero + 1,
            dtype=frame.dtype,
        )
        for i, scale in enumerate(fog.scales)
    ]
    return perlin_noise(octaves, frame.new_tensor(fog.weights).expand(batch, -1))


def _all_maps(lens: LensDistortion, frame: Tensor) -> tuple[Tensor | None, ...]:
    made = lens.degrade(frame)
    return made.image, made.flow, made.valid, made.restore_flow, made.restore_valid


def _forward(effect: LensDistortion | UniformFog, frame: Tensor) -> tuple[Tensor, list[Tensor]]:
    params = effect.sample(frame)
    leaves = [value.detach().requires_grad_() if value.is_floating_point() else value for value in params]
    made: Any = effect.apply(frame, type(params)(*leaves))
    return made.image, [value for value in leaves if value.requires_grad]


def _forward_and_backward(effect: LensDistortion | UniformFog, frame: Tensor) -> Callable[[], tuple[Tensor, ...]]:
    upstream = torch.rand_like(frame)

    def call() -> tuple[Tensor, ...]:
        image, leaves = _forward(effect, frame)
        return torch.autograd.grad(image, leaves, upstream)

    return call


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width of the frame, 1080x1920")
    parser.add_argument("--batch", type=count(1), default=1, help="frames at once, 1")
    parser.add_argument("--threads", type=count(1), default=2, help="threads of torch on the CPU, 2")
    parser.add_argument("--repeats", type=count(FEWEST_REPEATS), default=FEWEST_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--real", type=Path, help="a picture to use as the frame, instead of noise")
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="cpu, or cuda")
    parser.add_argument("--within", action="store_true", help=f"the warps within {TOLERANCE_PX} px alone")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "effects.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
