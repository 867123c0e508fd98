"""Check that effects keep their tolerance: random configurations against the exact effect in float64.

python benchmarks/tolerance.py [--count 200] [--seed 0] [--only LensDistortion ...]
                               [--out benchmarks/results/tolerance.json]

Ranges, frame sizes and tolerances are random. Each trial draws the parameters of two samples once and applies them
with the tolerance in float32, and exactly in float64. The error of a warp is the largest distance between the two
flows, px, and that of its restore flow the largest where both are valid; a quarter of the lenses fold inside the frame.
The error of fog and flare is the largest difference of images and transmissions, levels of 1/255. A trial
above its tolerance ends the command with exit code 1.
"""

import argparse
import math
import random
import statistics
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from timing import RESULTS, count, size, write_json
from torch import Tensor

import torchrefract as tr
from torchrefract.cameras.brown_conrady import POLYNOMIAL12

TOLERANCES = (1.0, 0.3, 0.1, 0.03, 0.01)  # px, or levels
SMALLEST, LARGEST = (64, 64), (1080, 1920)

# Takes a random generator and the size of the frame; returns a function that makes the effect, whose argument is the
# tolerance (None is exact).
Configuration = Callable[[random.Random, int, int], Callable[[float | None], Any]]


@dataclass(frozen=True)
class Trial:
    """One random configuration, its error and that of the restore flow of a warp, px or levels."""

    effect: str
    height: int
    width: int
    tolerance: float
    error: float
    restore_error: float = 0.0

    @property
    def share(self) -> float:
        """Return the error as a share of the tolerance."""
        return self.error / self.tolerance

    @property
    def restore_share(self) -> float:
        """Return the error of the restore flow as a share of the tolerance."""
        return self.restore_error / self.tolerance


def main() -> None:
    """Run all trials, print a summary of each effect and save the trials."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=count(1), default=200, help="configurations of each effect, 200")
    parser.add_argument("--seed", type=count(0), default=0, help="seed of the configurations, 0")
    parser.add_argument("--largest", type=size, default=LARGEST, help="HEIGHTxWIDTH of the largest frames, 1080x1920")
    parser.add_argument("--only", nargs="+", choices=list(CONFIGURATIONS), default=list(CONFIGURATIONS), help="all")
    parser.add_argument("--out", type=Path, default=RESULTS / "tolerance.json", help="JSON file to write")
    args = parser.parse_args()
    trials: list[Trial] = []
    for name in args.only:
        of_effect = [attempt(name, args.seed + i, args.largest) for i in range(args.count)]
        print(summary(name, of_effect), flush=True)
        trials += of_effect
    write_json(args.out, [asdict(trial) for trial in trials])
    if any(max(trial.share, trial.restore_share) > 1 for trial in trials):
        raise SystemExit(1)


def attempt(name: str, seed: int, largest: tuple[int, int] = LARGEST) -> Trial:
    """Try one random configuration of an effect, in a frame between 64x64 and the largest size."""
    dice = random.Random(f"{name} {seed}")
    height, width = (round(log_uniform(dice, low, high)) for low, high in zip(SMALLEST, largest, strict=True))
    tolerance = dice.choice(TOLERANCES)
    make = CONFIGURATIONS[name](dice, height, width)
    image = torch.rand(2, 1, height, width, generator=torch.Generator().manual_seed(seed))
    image[..., ::7], image[..., 3::7, :] = 0.0, 1.0  # columns and rows at both ends of the range
    effect, exact = make(tolerance), make(None)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # folding does not matter for the distance of flows
        params = effect.sample(image, seed=seed)
        result, expected = effect.apply(image, params), exact.apply(image.double(), params.to(torch.float64))
        error, restore_error = _levels(result.image, expected.image), 0.0
        if result.flow is not None:
            error = _largest_distance(result.flow, expected.flow, result.valid & expected.valid)
            valid = result.restore_valid & expected.restore_valid
            restore_error = _largest_distance(result.restore_flow, expected.restore_flow, valid)
        elif expected.transmission is not None:
            error = max(error, _levels(result.transmission, expected.transmission))
    return Trial(name, height, width, tolerance, error, restore_error)


def summary(name: str, trials: Sequence[Trial]) -> str:
    """Describe the trials of one effect."""
    forward, restore = ([getattr(trial, name) for trial in trials] for name in ("share", "restore_share"))
    exceeded = sum(max(pair) > 1 for pair in zip(forward, restore, strict=True))
    verdict = f"EXCEEDED by {exceeded}" if exceeded else "kept"
    return (
        f"{name}: {len(trials)} configurations, tolerance {verdict}; error / tolerance: largest {max(forward):.2f}, "
        f"median {statistics.median(forward):.3f}; restore flow: largest {max(restore):.2f}, "
        f"median {statistics.median(restore):.3f}"
    )


def _largest_distance(flow: Tensor, expected: Tensor, valid: Tensor) -> float:
    """Return the largest distance of two flows where they are valid, px."""
    distance = torch.linalg.vector_norm(flow.double() - expected.double(), dim=1, keepdim=True)
    return torch.where(valid, distance, 0).amax().item()


def _levels(value: Tensor, expected: Tensor) -> float:
    return 255 * (value.double() - expected).abs().max().item()


def _warp(kind: Callable[..., Any], ranges: dict[str, Any]) -> Callable[[float | None], Any]:
    return lambda tolerance: kind(**ranges, tolerance_px=tolerance)


def _light(kind: Callable[..., Any], arguments: dict[str, Any]) -> Callable[[float | None], Any]:
    return lambda tolerance: kind(**arguments, tolerance=tolerance)


def _lens(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    ranges = {f"{name}_range": (0.0, 0.0) for name in POLYNOMIAL12}
    for i in range(dice.randint(1, 3)):
        ranges[f"k{i + 1}_range"] = _signed_range(dice, 1e-4, 0.5)
    for name in POLYNOMIAL12[6:]:
        if dice.random() < 0.3:
            ranges[f"{name}_range"] = _signed_range(dice, 1e-5, 0.03)
    for axis in "xy":
        ranges[f"center_{axis}_range"] = _signed_range(dice, 1e-3, 0.1)
    ranges |= {"focal_range": _range(dice, 0.4, 4.0), "aspect_range": _range(dice, 0.8, 1.25)}
    if dice.random() < 0.25:
        # r (1 + k1 r^2) folds at r_d = 2 / 3 / sqrt(-3 k1), here between the middle and the corner of the frame.
        reach = 0.5 / ranges["focal_range"][1] * dice.uniform(0.7, 1.0)
        start = -4 / 27 / reach**2
        ranges["k1_range"] = (start * dice.uniform(1, 1.2), start)
    return _warp(tr.LensDistortion, ranges)


def _rectification(dice: random.Random, height: int, width: int) -> Callable[[float | None], Any]:
    def coefficient(low: float, high: float) -> float:
        return dice.choice((-1, 1)) * log_uniform(dice, low, high)

    model = dice.choice(("opencv", "fisheye"))
    if model == "opencv":
        k1, k2, p1, p2, k3 = (coefficient(1e-4, high) for high in (0.4, 0.1, 0.01, 0.01, 0.02))
        coefficients = (k1, k2, p1, p2, k3)
    else:
        coefficients = tuple(coefficient(1e-4, high) for high in (0.1, 0.03, 0.01, 0.003))
    fx = width * log_uniform(dice, 0.4, 4.0)
    camera = tr.Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fx * dice.uniform(0.9, 1.1),
        cx=width * dice.uniform(0.4, 0.6),
        cy=height * dice.uniform(0.4, 0.6),
        coefficients=coefficients,
        model=model,
    )
    return lambda tolerance: tr.Rectification(camera, tolerance_px=tolerance)


def _thin_plate(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    smoothing = (0.0, 0.0) if dice.random() < 0.5 else _range(dice, 1e-6, 1.0)
    ranges: dict[str, Any] = {"lattice": (dice.randint(2, 8), dice.randint(2, 8)), "smoothing_range": smoothing}
    return _warp(tr.ThinPlateSpline, ranges | {"amplitude_range": _range(dice, 0.01, 30.0)})


def _turbulence_ranges(dice: random.Random) -> dict[str, Any]:
    return {
        "amplitude_range": _range(dice, 0.01, 30.0),
        "length_range": _range(dice, 1.0, 300.0),
        "aperture_range": _range(dice, 0.01, 10.0),
        "covariance": "gaussian",
    }


def _turbulence(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    return _warp(tr.Turbulence, _turbulence_ranges(dice))


def _rough_turbulence(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    """Configure rough covariances, which an aperture of 1.8 px or more smooths."""
    covariance = dice.choice(("exponential", "matern32", "matern52"))
    rough = {"covariance": covariance, "aperture_range": _range(dice, 1.5, 15)}
    return _warp(tr.Turbulence, _turbulence_ranges(dice) | rough)


def _divergence_free(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    ranges = {"amplitude_range": _range(dice, 0.01, 30.0), "length_range": _range(dice, 2.0, 300.0)}
    return _warp(tr.DivergenceFree, ranges)


def _composition(dice: random.Random, *size: int) -> Callable[[float | None], Any]:
    """Configure two to four warps."""
    kinds = (_lens, _thin_plate, _turbulence, _divergence_free)
    makers = [dice.choice(kinds)(dice, *size) for _ in range(dice.randint(2, 4))]
    # Each warp has the default tolerance, so that the composition alone decides.
    return lambda tolerance: tr.Compose([make(0.02) for make in makers], tolerance_px=tolerance)


def _fog_arguments(dice: random.Random, height: int, width: int) -> dict[str, Any]:
    thin = dice.choice((0.0, dice.random() * 0.2))
    focal, offset = width * log_uniform(dice, 0.4, 2), dice.uniform(-0.1, 0.1)
    cx, cy = width * (0.5 + offset), height * (0.5 - offset)
    camera = tr.Camera(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, coefficients=(0.0,) * 4)
    road = tr.GroundPlaneDepth(
        camera_height=log_uniform(dice, 0.5, 3),
        horizon=dice.uniform(0.2, 0.7),
        spread=dice.choice((0.0, 0.1)),
        far=dice.choice((200.0, 1000.0, math.inf)),
    )
    return {
        "visibility_range": _narrow_range(dice, 1.0, 1e5),
        "deviation_range": (-thin, thin),
        "airlight": dice.choice((None, dice.random(), 1.0)),
        "threshold": dice.choice((0.05, 0.02)),
        "depth": dice.choice((tr.LinearDepth(max_depth=log_uniform(dice, 10, 1000)), road)),
        "camera": camera if dice.random() < 0.5 else None,
        "linear_light": dice.random() < 0.5,
    }


def _uniform_fog(dice: random.Random, height: int, width: int) -> Callable[[float | None], Any]:
    return _light(tr.UniformFog, _fog_arguments(dice, height, width))


def _heterogeneous_fog(dice: random.Random, height: int, width: int) -> Callable[[float | None], Any]:
    scales = [log_uniform(dice, 8, 300) for _ in range(dice.randint(4, 8))]
    noise = {"reference_width": width, "scales": scales, "weights": [dice.random() for _ in scales]}
    mean = {"mean": dice.choice(("image", "ensemble"))}
    return _light(tr.HeterogeneousFog, _fog_arguments(dice, height, width) | noise | mean)


def _volumetric_fog(dice: random.Random, height: int, width: int) -> Callable[[float | None], Any]:
    contrast = {"contrast_range": _narrow_range(dice, 1e-6, 1.6), "mean": dice.choice(("image", "ensemble"))}
    return _light(tr.HeterogeneousFog, _fog_arguments(dice, height, width) | contrast | {"mode": "ray"})


def _flare(dice: random.Random, *_: int) -> Callable[[float | None], Any]:
    is_fixed = dice.random() < 0.5

    def center(low: float, high: float) -> tuple[float, float]:
        start = dice.uniform(low, high)
        return start, start if is_fixed else start + dice.uniform(0, 0.1)

    radius, strength = _narrow_range(dice, 0.01, 0.15), _narrow_range(dice, 0.01, 10.0)
    arguments = {
        "center_x_range": center(-0.1, 1.0),
        "center_y_range": center(-0.1, 1.0),
        "radius_range": radius[:1] * 2 if is_fixed else radius,
        "strength_range": strength[:1] * 2 if is_fixed else strength,
        "blend": dice.choice(("add", "screen")),
        "drift_x_range": dice.choice(((0.0, 0.0), (-0.002, 0.002))),
    }
    return _light(tr.LensFlare, arguments)


CONFIGURATIONS: dict[str, Configuration] = {
    "LensDistortion": _lens,
    "Rectification": _rectification,
    "ThinPlateSpline": _thin_plate,
    "Turbulence": _turbulence,
    "rough Turbulence": _rough_turbulence,
    "DivergenceFree": _divergence_free,
    "Compose": _composition,
    "UniformFog": _uniform_fog,
    "HeterogeneousFog": _heterogeneous_fog,
    "volumetric HeterogeneousFog": _volumetric_fog,
    "LensFlare": _flare,
}


def log_uniform(dice: random.Random, low: float, high: float) -> float:
    """Draw a positive number with a uniform logarithm."""
    return math.exp(dice.uniform(math.log(low), math.log(high)))


def _range(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """Draw a range of positive numbers that ends at up to twice its start, or holds one number."""
    start = log_uniform(dice, low, high)
    return (start, start) if dice.random() < 0.3 else (start, min(high, start * dice.uniform(1, 2)))


def _narrow_range(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """Draw a range of positive numbers that ends at up to 1.25 times its start."""
    start = log_uniform(dice, low, high)
    return start, start * dice.choice((1.0, dice.uniform(1, 1.25)))


def _signed_range(dice: random.Random, low: float, high: float) -> tuple[float, float]:
    """Draw a range of positive numbers, of negative numbers, or around zero."""
    start, end = _range(dice, low, high)
    return dice.choice(((start, end), (-end, -start), (-end, end)))


if __name__ == "__main__":
    main()
