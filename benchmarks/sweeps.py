"""The knobs of each effect, and what each of their values is held against.

A new knob is one more line of `SWEEPS`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from subjects import (
    AIR,
    DRIFTS,
    FLARE,
    FOG,
    HOT_AIR,
    LENS,
    PLATE,
    ROUGH,
    SMOOTH,
    SPACE,
    SWIRLS,
    TOLERANCE_PX,
    WEATHER,
    all_warps,
)

from torchrefract.effects.base import Effect

TOLERANCES_PX = (0.01, 0.02, 0.05, 0.1, 0.3, 1.0)
TOLERANCES_LEVELS = (0.1, 0.3, 1.0)
LOOK_UPS = ("nearest", "bilinear", "bicubic")
DENSE, ITSELF = "float64", "itself in float64"
FEW_STEPS, MANY_STEPS = (1, 2, 4, 8), 16
# From coarse to fine, so that the first few of them are the same noise whether the others are there or not.
_OCTAVES = {
    DRIFTS: ((128.0, 64.0, 32.0, 16.0, 8.0, 4.0), (0.07, 0.08, 0.11, 0.15, 0.22, 0.30)),
    SPACE: ((96.0, 48.0, 24.0, 12.0), (0.2, 0.3, 0.3, 0.2)),
}


class Variant(NamedTuple):
    """An effect with one value of a knob."""

    knob: str
    value: str
    make: Callable[[], Effect]
    truth: Callable[[], Effect]  # computed in float64
    against: str = DENSE  # the truth in words
    sharp: bool = False  # the true image is looked up by quintic splines


def _tolerances(make: Callable[..., Effect]) -> list[Variant]:
    """Tolerances of the flow."""
    within = (Variant("tolerance_px", f"{px:g}", partial(make, tolerance_px=px), make) for px in TOLERANCES_PX)
    return [Variant("tolerance_px", "None", make, make), *within]


def _look_ups(make: Callable[..., Effect]) -> list[Variant]:
    """Ways to read between pixels, the flow within a tolerance."""
    within = partial(make, tolerance_px=TOLERANCE_PX)
    return [
        Variant("interpolation", mode, partial(within, interpolation=mode), make, "quintic splines", sharp=True)
        for mode in LOOK_UPS
    ]


def _warp(name: str) -> list[Variant]:
    return _tolerances(SMOOTH[name]) + _look_ups(SMOOTH[name])


def _levels(make: Callable[..., Effect]) -> list[Variant]:
    """Tolerances of the image."""
    within = (Variant("tolerance", f"{level:g}", partial(make, tolerance=level), make) for level in TOLERANCES_LEVELS)
    return [Variant("tolerance", "None", make, make), *within]


def _kinds(make: Callable[..., Effect], knob: str, *kinds: str) -> list[Variant]:
    """Effects that differ, each held against itself."""
    return [Variant(knob, kind, one := partial(make, **{knob: kind}), one, ITSELF) for kind in kinds]


def _steps(make: Callable[..., Effect]) -> list[Variant]:
    """Parts that a displacement is followed in."""
    truth = partial(make, steps=MANY_STEPS)
    words = f"{MANY_STEPS} steps"
    return [Variant("steps", str(steps), partial(make, steps=steps), truth, words) for steps in FEW_STEPS]


def _octaves(name: str) -> list[Variant]:
    """Noises that are added up, the finest left out first."""
    scales, weights = _OCTAVES[name]

    def make(count: int) -> Callable[[], Effect]:
        # The effect divides the weights by their sum: of fewer, each weighs more.
        return partial(WEATHER[name], scales=scales[:count], weights=weights[:count])

    every = make(len(scales))
    words = f"all {len(scales)}"
    return [Variant("scales", str(n), make(n), every, words) for n in range(len(scales), 0, -1)]


def _lights(make: Callable[..., Effect]) -> list[Variant]:
    """Blends of stored values and of radiance."""
    truth = partial(make, linear_light=True)
    return [
        Variant("linear_light", str(linear), partial(make, linear_light=linear), truth, "linear light")
        for linear in (False, True)
    ]


SWEEPS: Mapping[str, list[Variant]] = {
    LENS: _warp(LENS),
    PLATE: _warp(PLATE),
    AIR: _warp(AIR) + _kinds(SMOOTH[AIR], "covariance", "matern52", "matern32", "exponential"),
    HOT_AIR: _tolerances(ROUGH[HOT_AIR]),
    SWIRLS: _warp(SWIRLS) + _steps(SMOOTH[SWIRLS]),
    "all four warps": _tolerances(all_warps),
    FOG: [*_levels(WEATHER[FOG]), *_lights(WEATHER[FOG])],
    DRIFTS: [*_levels(WEATHER[DRIFTS]), *_octaves(DRIFTS), *_kinds(WEATHER[DRIFTS], "normalize", "image")],
    SPACE: [*_levels(WEATHER[SPACE]), *_octaves(SPACE)],
    FLARE: [*_levels(WEATHER[FLARE]), *_kinds(WEATHER[FLARE], "blend", "screen")],
}
