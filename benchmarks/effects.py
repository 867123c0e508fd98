"""Time each effect as a multiple of one bare F.grid_sample, and count the Python calls of one effect.

python benchmarks/effects.py [--size 1080x1920] [--threads 2] [--repeats 15] [--backend auto torch] [--real PATH]
                             [--out benchmarks/results/effects.json]
python benchmarks/effects.py --calls [--verbose]
"""

import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from timing import (
    COPY,
    GRID_SAMPLE,
    PHOTOMETRIC,
    RESULTS,
    ROUGH_TURBULENCE,
    TOLERANCE_PX,
    WARPS,
    Bar,
    Candidate,
    Conditions,
    Timing,
    all_warps,
    frame_of,
    measure,
    parser,
    references,
    sampling_grid,
    save,
    table,
)
from torch import Tensor

import torchrefract as tr

WHAT = (
    "effect(image) without gradients, with a new draw in every call, through the public API. 'exact' is "
    "tolerance_px=None. 'torch' in a name is backend='torch', which a machine without numba uses; other rows use the "
    "default backend. 'default lenses' draws from the default ranges; 'rough turbulence' has an exponential covariance "
    "and an aperture of 4 to 6 px. 'bare grid_sample along' is F.grid_sample with a precomputed grid from a flow of "
    "that effect, since the time of the sampler depends on the flow. On the CPU the bare grid_sample keeps one thread "
    "busy for each sample; the effects use all threads."
)
PACKAGE = str(Path(tr.__file__).parent)
ALL = "all four warps"
ROLLING_SHUTTER = "rolling shutter"
OTHER_WARPS: dict[str, Callable[..., Any]] = {
    "default lenses": tr.LensDistortion,
    ROLLING_SHUTTER: tr.RollingShutter,
    "rough turbulence": ROUGH_TURBULENCE,
    "Gaussian turbulence with depth": partial(WARPS["Gaussian turbulence"], depth=tr.GroundPlaneDepth()),
    "physical turbulence": tr.PhysicalTurbulence,
    "road mirage": tr.RoadMirage,
}
# Largest multiples of the bare grid_sample for 1x3x1080x1920 float32 on two threads.
LIMITS = {
    "auto": {
        **dict(zip((*WARPS, ALL), (0.9, 0.9, 0.9, 1.0, 1.4), strict=True)),
        **{"physical turbulence": 4.0, "road mirage": 1.0, ROLLING_SHUTTER: 1.0},
    },
    "torch": dict(zip((*WARPS, ALL), (1.6, 1.6, 1.6, 1.6, 3.0), strict=True)),
}
PHOTOMETRIC_LIMITS = {
    **{"uniform fog": 0.3, "flare": 0.35, "heterogeneous fog": 1.6, "volumetric fog": 1.6},
    **{"sun glare": 1.5, "exposure": 0.3, "night glow": 2.0},
}
LENS, COMPOSITION = "lens", "composition of four warps and fog"
# Files, functions and calls of the package that one call may cross.
CALL_LIMITS = {LENS: (14, 60, 120), COMPOSITION: (24, 150, 500)}
CALL_SIZE = (256, 256)  # px; the counts hardly depend on it
NUM_FUNCTIONS = 25  # of each table of functions


def main() -> None:
    """Measure, print and save; a limit that does not hold is marked and is no failure of the command."""
    options = parser(__doc__, out=RESULTS / "effects.json", has_real=True)
    options.add_argument(
        "--backend", nargs="+", choices=["auto", "torch", "numba"], default=["auto", "torch"], help="auto torch"
    )
    options.add_argument("--calls", action="store_true", help="count Python calls instead")
    options.add_argument("--verbose", action="store_true", help="with --calls: list the functions with the most calls")
    args = options.parse_args()
    torch.manual_seed(0)
    if args.calls:
        print(*call_report(num_functions=NUM_FUNCTIONS if args.verbose else 0), sep="\n")
        return
    try:
        frame = frame_of(args.real, args.size)
    except (ValueError, RuntimeError, OSError) as error:
        options.error(str(error))
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    with torch.no_grad():
        timings = measure(
            candidates(frame, args.backend), references=(GRID_SAMPLE, COPY), repeats=args.repeats, threads=args.threads
        )
    bars = speed_bars(timings)
    print(table(timings, conditions), "", *bars, sep="\n")
    save(args.out, timings, conditions, what=WHAT, bars=bars)


def candidates(frame: Tensor, backends: Sequence[str]) -> dict[str, Candidate]:
    """Return what is timed on a frame (B, C, H, W), by name; the references come first."""
    chosen: dict[str, Any] = {}
    for backend in backends:
        for name, make in {**WARPS, **OTHER_WARPS, ALL: all_warps}.items():
            for tolerance_px in (TOLERANCE_PX, None):
                chosen[row(name, tolerance_px, backend)] = make(tolerance_px=tolerance_px, backend=backend)
    chosen |= {name: make() for name, make in PHOTOMETRIC.items()}
    timed = references(frame)
    for name in (*WARPS, ALL):
        flow = {**WARPS, ALL: all_warps}[name](tolerance_px=TOLERANCE_PX).degrade(frame, seed=0).flow
        timed[f"{GRID_SAMPLE} along {name}"] = partial(
            F.grid_sample, frame, sampling_grid(flow), mode="bilinear", align_corners=False
        )
    return timed | {name: partial(effect, frame) for name, effect in chosen.items()}


def row(name: str, tolerance_px: float | None, backend: str) -> str:
    """Return the name of a warp's row."""
    within = "exact" if tolerance_px is None else f"within {tolerance_px} px"
    return f"{name}, {within}" + ("" if backend == "auto" else f", {backend}")


def speed_bars(timings: Sequence[Timing]) -> list[Bar]:
    """Return the limits of the rows that were timed."""
    ratios = {timing.name: timing.ratios[GRID_SAMPLE].median for timing in timings}
    limits = {row(n, TOLERANCE_PX, b): limit for b, named in LIMITS.items() for n, limit in named.items()}
    limits |= PHOTOMETRIC_LIMITS
    return [Bar(n, ratios[n], "<=", limit, f"x {GRID_SAMPLE}") for n, limit in limits.items() if n in ratios]


@dataclass(frozen=True)
class Calls:
    """The number of calls of each function of the package, by file and qualified name."""

    entered: Mapping[tuple[str, str], int]

    @property
    def files(self) -> int:
        """Return the number of files whose code ran."""
        return len({file for file, _ in self.entered})

    @property
    def functions(self) -> int:
        """Return the number of functions that ran."""
        return len(self.entered)

    @property
    def calls(self) -> int:
        """Return how often functions were entered."""
        return sum(self.entered.values())

    def most_called(self, count: int) -> list[str]:
        """Format the functions with the most calls, one a line."""
        ranked = sorted(self.entered.items(), key=lambda item: (-item[1], item[0]))
        return [f"{number:6}  {file}: {function}" for (file, function), number in ranked[:count]]


def count_calls(call: Candidate) -> Calls:
    """Count the calls inside torchrefract during one call, by sys.setprofile.

    Lambdas, comprehensions and generators count as functions, and each resumption of a generator as a call.
    """
    entered: dict[tuple[str, str], int] = {}

    def profile(frame: Any, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE):
            key = str(Path(code.co_filename).relative_to(PACKAGE)), code.co_qualname
            entered[key] = entered.get(key, 0) + 1

    previous = sys.getprofile()
    sys.setprofile(profile)
    threading.setprofile(profile)  # new plans are computed in a thread of their own
    try:
        call()
    finally:
        sys.setprofile(previous)
        threading.setprofile(None)
    return Calls(entered)


def call_report(*, num_functions: int = 0) -> list[Bar | str]:
    """Count the calls of a lens and of a composition, warm and on the first call of a new range.

    Args:
        num_functions: how many of the functions with the most calls to list.
    """
    image = torch.rand(1, 3, *CALL_SIZE)
    lines: list[Bar | str] = []
    for name, make in ((LENS, _lens), (COMPOSITION, _composition)):
        warm, cold = make(0.0), make(1e-3)
        for _ in range(3):
            warm(image)
        counts = sorted((count_calls(partial(warm, image)) for _ in range(5)), key=lambda counted: counted.calls)
        first = count_calls(partial(cold, image))
        for state, counted in (("warm", counts[len(counts) // 2]), ("first call of a new range", first)):
            for unit, limit in zip(("files", "functions", "calls"), CALL_LIMITS[name], strict=True):
                lines.append(Bar(f"{name}, {state}", getattr(counted, unit), "<=", limit, unit))
            lines += counted.most_called(num_functions)
    return lines


def _lens(offset: float) -> Any:
    return WARPS["mild lens"](center_x_range=(-0.01 - offset, 0.01), tolerance_px=TOLERANCE_PX)


def _composition(offset: float) -> Any:
    lens = tr.LensDistortion(center_x_range=(-0.01 - offset, 0.01))
    return tr.Compose([lens, tr.ThinPlateSpline(), tr.Turbulence(), tr.DivergenceFree(), tr.UniformFog()])


if __name__ == "__main__":
    main()
