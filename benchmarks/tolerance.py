"""Whether flows keep their tolerance: random configurations of each warp, against the exact flow of the same draw.

python benchmarks/tolerance.py [--count 200] [--seed 0] [--out benchmarks/results/tolerance.json]

Ranges, sizes and tolerances are drawn; the error is the largest distance of the two flows over all pixels of two
samples. Covariances other than the Gaussian one are not among them: they are computed exactly.
"""

import argparse
import json
import math
import random
import statistics
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from arguments import count

from torchrefract import Compose, DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence
from torchrefract._io import replace_file
from torchrefract.cameras.distortion import POLYNOMIAL12
from torchrefract.effects.compose_plan import ComposePlan
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.plan import Plan

TOLERANCES = (1.0, 0.3, 0.1, 0.03, 0.01)
RESULTS = Path(__file__).parent / "results"
SMALLEST, LARGEST = (64, 64), (1080, 1920)
# Of what is allowed: the median error must be no smaller, or a coarser plan would have done.
LEAST_SHARE = 0.05


@dataclass(frozen=True)
class Trial:
    """One configuration and what came of it."""

    effect: str
    height: int
    width: int
    tolerance_px: float
    stride: int  # of the plan, the largest of a composition; 1 is exact, 0 no flow
    bound_px: float  # that the plan states
    error_px: float

    @property
    def share(self) -> float:
        """Of the tolerance that the error takes."""
        return self.error_px / self.tolerance_px


def main() -> None:
    """Try, print and save; a tolerance that is not kept ends the command with 1."""
    try_all(__doc__, CONFIGURATIONS, attempt, summary, out=RESULTS / "tolerance.json")


def try_all(
    words: str | None,
    names: Iterable[str],
    attempt: Callable[[str, int], Any],
    summary: Callable[[str, list[Any]], str],
    *,
    out: Path,
) -> None:
    """The command: so many trials of each name, told and saved; one whose `share` is above 1 ends it with 1.

    Args:
        words: that open with what the command does.
        names: of what is tried.
        attempt: a trial, a dataclass with a `share`, of a name and a seed.
        summary: the trials of a name, in words.
        out: where the JSON goes by default.
    """
    parser = argparse.ArgumentParser(description=(words or "").splitlines()[0])
    parser.add_argument("--count", type=count(1), default=200, help="configurations of each effect, 200")
    parser.add_argument("--seed", type=count(0), default=0, help="of the configurations, 0")
    parser.add_argument("--out", type=Path, default=out, help="the JSON")
    args = parser.parse_args()
    trials: dict[str, list[Any]] = {}
    for name in names:
        trials[name] = [attempt(name, args.seed + i) for i in range(args.count)]
        print(summary(name, trials[name]), flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as path:
        rows = {name: [asdict(trial) for trial in found] for name, found in trials.items()}
        path.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")
    if any(trial.share > 1 for found in trials.values() for trial in found):
        raise SystemExit(1)


def attempt(name: str, seed: int) -> Trial:
    """One random configuration of an effect."""
    dice = random.Random(f"{name} {seed}")
    height, width = (round(log_uniform(dice, low, high)) for low, high in zip(SMALLEST, LARGEST, strict=True))
    tolerance = dice.choice(TOLERANCES)
    make, arguments = CONFIGURATIONS[name](dice)
    effect, exact = make(tolerance_px=tolerance, **arguments), make(tolerance_px=None, **arguments)
    plan = effect.planned(height, width, torch.float32)
    image = torch.zeros(2, 1, height, width)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # folds are no matter here
        off = effect.degrade(image, seed=seed).flow - exact.degrade(image, seed=seed).flow
    error = off.square().sum(dim=1).amax().sqrt().item()
    return Trial(name, height, width, tolerance, _stride(plan), plan.error_px, error)


def _stride(plan: Plan | ComposePlan) -> int:
    if isinstance(plan, Plan):
        return plan.stride
    return max(part.stride for part in plan.plans if isinstance(part, Plan))


def summary(name: str, trials: list[Trial]) -> str:
    """The trials of one effect, in words."""
    worst, middle = max(trials, key=lambda trial: trial.share), statistics.median(trial.share for trial in trials)
    coarse = sum(trial.stride > 1 for trial in trials)
    still = sum(trial.stride == 0 for trial in trials)
    verdict = "kept" if worst.share <= 1 else f"NOT KEPT by {sum(trial.share > 1 for trial in trials)}"
    return (
        f"{name}: {len(trials)} configurations, {coarse} on a lattice, {still} without a flow, "
        f"{len(trials) - coarse - still} exact; tolerance {verdict}, largest error {worst.share:.2f} x, median "
        f"{middle:.3f} x (bar >= {LEAST_SHARE}: {'holds' if middle >= LEAST_SHARE else 'DOES NOT HOLD'})"
    )


def _lens(dice: random.Random) -> tuple[type[LatticeWarp], dict[str, Any]]:
    ranges = {f"{name}_range": (0.0, 0.0) for name in POLYNOMIAL12}
    for i in range(dice.randint(1, 3)):
        ranges[f"k{i + 1}_range"] = _signed(dice, 1e-4, 0.5)
    for name in POLYNOMIAL12[6:]:
        if dice.random() < 0.3:
            ranges[f"{name}_range"] = _signed(dice, 1e-5, 0.03)
    for axis in "xy":
        ranges[f"center_{axis}_range"] = _signed(dice, 1e-3, 0.1)
    return LensDistortion, ranges | {"focal_range": span(dice, 0.4, 4.0), "aspect_range": span(dice, 0.8, 1.25)}


def _plate(dice: random.Random) -> tuple[type[LatticeWarp], dict[str, Any]]:
    smoothing = (0.0, 0.0) if dice.random() < 0.5 else span(dice, 1e-6, 1.0)
    lattice = (dice.randint(2, 8), dice.randint(2, 8))
    return ThinPlateSpline, {
        "amplitude_range": span(dice, 0.01, 30.0),
        "lattice": lattice,
        "smoothing_range": smoothing,
    }


def _turbulence(dice: random.Random) -> tuple[type[LatticeWarp], dict[str, Any]]:
    return Turbulence, {
        "amplitude_range": span(dice, 0.01, 30.0),
        "length_range": span(dice, 1.0, 300.0),
        "aperture_range": span(dice, 0.01, 10.0),
        "covariance": "gaussian",
    }


def _rough_air(dice: random.Random) -> tuple[type[LatticeWarp], dict[str, Any]]:
    """Of covariances that are rough but for an aperture; with one below 1.8 px all are exact."""
    kind, ranges = _turbulence(dice)
    rough = {"covariance": dice.choice(("exponential", "matern32", "matern52")), "aperture_range": span(dice, 1.5, 15)}
    return kind, ranges | rough


def _swirl(dice: random.Random) -> tuple[type[LatticeWarp], dict[str, Any]]:
    return DivergenceFree, {
        "amplitude_range": span(dice, 0.01, 30.0),
        "length_range": span(dice, 2.0, 300.0),
    }


def _composition(dice: random.Random) -> tuple[Callable[..., Compose], dict[str, Any]]:
    """Two to four warps."""
    chosen = [dice.choice((_lens, _plate, _turbulence, _swirl))(dice) for _ in range(dice.randint(2, 4))]

    def make(tolerance_px: float | None) -> Compose:
        return Compose([kind(**ranges) for kind, ranges in chosen], tolerance_px=tolerance_px)

    return make, {}


CONFIGURATIONS: dict[str, Callable[[random.Random], tuple[Callable[..., LatticeWarp | Compose], dict[str, Any]]]] = {
    "LensDistortion": _lens,
    "ThinPlateSpline": _plate,
    "Turbulence": _turbulence,
    "Turbulence, not Gaussian": _rough_air,
    "DivergenceFree": _swirl,
    "Compose": _composition,
}


def log_uniform(dice: random.Random, low: float, high: float) -> float:
    """A positive number, of uniform logarithm."""
    return math.exp(dice.uniform(math.log(low), math.log(high)))


def span(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """A range of positive numbers: one of them, or up to twice as large at its end."""
    start = log_uniform(dice, low, high)
    return (start, start) if dice.random() < 0.3 else (start, min(high, start * dice.uniform(1, 2)))


def _signed(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """A range on either side of zero, or round it."""
    start, end = span(dice, low, high)
    return dice.choice(((start, end), (-end, -start), (-end, end)))


if __name__ == "__main__":
    main()
