"""Whether fog and flare keep their tolerance: random configurations of each, against the exact effect of the same draw.

python benchmarks/light_tolerance.py [--count 200] [--seed 0] [--out benchmarks/results/light_tolerance.json]

Ranges, sizes and tolerances are drawn; the error, in levels of 1/255, is the largest over all pixels of two samples, of
images and of transmissions, where the exact effect computes in float64. Images are noise over all of [0, 1], and black
and white.
"""

import math
import random
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import tolerance as warps
import torch
from tolerance import LEAST_SHARE, RESULTS, SMALLEST, TOLERANCES, log_uniform

from torchrefract import Camera, GroundPlaneDepth, HeterogeneousFog, LensFlare, LinearDepth, UniformFog
from torchrefract.effects.planned_light import PlannedLight

_Made = tuple[type[PlannedLight], dict[str, Any]]


@dataclass(frozen=True)
class Trial:
    """One configuration and what came of it."""

    effect: str
    height: int
    width: int
    tolerance: float
    why: str  # that the plan states
    bound: float  # likewise, levels; 0 is exact
    error: float  # levels

    @property
    def share(self) -> float:
        """Of the tolerance that the error takes."""
        return self.error / self.tolerance


def main() -> None:
    """Try, print and save; a tolerance that is not kept ends the command with 1."""
    warps.try_all(__doc__, CONFIGURATIONS, attempt, summary, out=RESULTS / "light_tolerance.json")


def attempt(name: str, seed: int) -> Trial:
    """One random configuration of an effect."""
    dice = random.Random(f"{name} {seed}")
    height, width = (round(log_uniform(dice, low, high)) for low, high in zip(SMALLEST, warps.LARGEST, strict=True))
    tolerance = dice.choice(TOLERANCES)
    make, arguments = CONFIGURATIONS[name](dice, height, width)
    effect, exact = make(tolerance=tolerance, **arguments), make(**arguments)
    plan = effect.planned(height, width, torch.float32)
    image = torch.rand(2, 1, height, width, generator=torch.Generator().manual_seed(seed))
    # Some rows and columns are as dark and as bright as can be.
    image[..., ::7], image[..., 3::7, :] = 0.0, 1.0
    params = effect.sample(image, seed=seed)
    found, expected = effect.apply(image, params), exact.apply(image.double(), params.to(torch.float64))
    error = 255 * (found.image - expected.image).abs().max().item()
    if found.transmission is not None:
        error = max(error, 255 * (found.transmission - expected.transmission).abs().max().item())
    return Trial(name, height, width, tolerance, plan.why, plan.error, error)


def summary(name: str, trials: list[Trial]) -> str:
    """The trials of one effect, in words."""
    worst, middle = max(trials, key=lambda trial: trial.share), statistics.median(trial.share for trial in trials)
    bounded = [trial for trial in trials if trial.bound > 0]
    verdict = "kept" if worst.share <= 1 else f"NOT KEPT by {sum(trial.share > 1 for trial in trials)}"
    of_those = statistics.median(trial.share for trial in bounded) if bounded else 0.0
    return (
        f"{name}: {len(trials)} configurations, {len(trials) - len(bounded)} exact; tolerance {verdict}, largest error "
        f"{worst.share:.2f} x, median {middle:.3f} x (bar >= {LEAST_SHARE}: "
        f"{'holds' if middle >= LEAST_SHARE else 'DOES NOT HOLD'}), of those that are not exact {of_those:.3f} x"
    )


def _air(dice: random.Random, height: int, width: int) -> dict[str, Any]:
    """What all fogs take."""
    thin = dice.choice((0.0, dice.random() * 0.2))
    return {
        "visibility_range": _near(dice, 1.0, 1e5),
        "deviation_range": (-thin, thin),
        "airlight": dice.choice((None, dice.random(), 1.0)),
        "threshold": dice.choice((0.05, 0.02)),
        "depth": dice.choice((LinearDepth(max_depth=log_uniform(dice, 10, 1000)), _road(dice))),
        "camera": _camera(dice, height, width) if dice.random() < 0.5 else None,
        "linear_light": dice.random() < 0.5,
    }


def _near(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """A range of positive numbers: one of them, or up to a quarter larger at its end."""
    start = log_uniform(dice, low, high)
    return (start, start * dice.choice((1.0, dice.uniform(1, 1.25))))


def _road(dice: random.Random) -> GroundPlaneDepth:
    return GroundPlaneDepth(
        camera_height=log_uniform(dice, 0.5, 3),
        horizon=dice.uniform(0.2, 0.7),
        spread=dice.choice((0.0, 0.1)),
        far=dice.choice((200.0, 1000.0, math.inf)),
    )


def _camera(dice: random.Random, height: int, width: int) -> Camera:
    focal, off = width * log_uniform(dice, 0.4, 2), dice.uniform(-0.1, 0.1)
    cx, cy = width * (0.5 + off), height * (0.5 - off)
    return Camera(width=width, height=height, fx=focal, fy=focal, coefficients=(0.0, 0.0, 0.0, 0.0), cx=cx, cy=cy)


def _fog(dice: random.Random, height: int, width: int) -> _Made:
    return UniformFog, _air(dice, height, width)


def _drifts(dice: random.Random, height: int, width: int) -> _Made:
    scales = [log_uniform(dice, 8, 300) for _ in range(dice.randint(4, 8))]
    made = {"reference_width": width, "scales": scales, "weights": [dice.random() for _ in scales]}
    return HeterogeneousFog, _air(dice, height, width) | made | {"mean": dice.choice(("image", "ensemble"))}


def _space(dice: random.Random, height: int, width: int) -> _Made:
    contrast = {"contrast_range": _near(dice, 1e-6, 1.6), "mean": dice.choice(("image", "ensemble"))}
    return HeterogeneousFog, _air(dice, height, width) | contrast | {"mode": "ray"}


def _flare(dice: random.Random, height: int, width: int) -> _Made:
    one = dice.random() < 0.5  # one flare, not a range of them

    def between(low: float, high: float) -> tuple[float, float]:
        start = dice.uniform(low, high)
        return (start, start) if one else (start, start + dice.uniform(0, 0.1))

    radius, strength = _near(dice, 0.01, 0.15), _near(dice, 0.01, 10.0)
    return LensFlare, {
        "center_x_range": between(-0.1, 1.0),
        "center_y_range": between(-0.1, 1.0),
        "radius_range": radius[:1] * 2 if one else radius,
        "strength_range": strength[:1] * 2 if one else strength,
        "blend": dice.choice(("add", "screen")),
        "drift_x_range": dice.choice(((0.0, 0.0), (-0.002, 0.002))),
    }


CONFIGURATIONS: dict[str, Callable[[random.Random, int, int], _Made]] = {
    "UniformFog": _fog,
    "HeterogeneousFog in the image": _drifts,
    "HeterogeneousFog in space": _space,
    "LensFlare": _flare,
}


if __name__ == "__main__":
    main()
