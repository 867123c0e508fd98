"""Fog, drifts of fog and flares, here and at the peers, on one frame."""

import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from timing import Candidate
from torch import Tensor

from torchrefract import HeterogeneousFog, LensFlare, UniformFog


def candidates(frame: Tensor, peers: Mapping[str, ModuleType]) -> dict[str, Candidate]:
    """Weather on a frame (1, 3, H, W), by job and name."""
    found = _ours(frame)
    if "kornia" in peers:
        plasma = importlib.import_module("kornia.augmentation").RandomPlasmaBrightness(p=1.0)
        found["drifts: kornia RandomPlasmaBrightness"] = lambda: plasma(frame)
    return found


def _ours(frame: Tensor) -> dict[str, Candidate]:
    effects = {
        "fog: ours UniformFog": UniformFog(),
        "drifts: ours HeterogeneousFog": HeterogeneousFog(),
        "drifts: ours HeterogeneousFog, in space": HeterogeneousFog(mode="ray"),
        "flare: ours LensFlare": LensFlare(),
    }
    return {name: lambda effect=effect: effect(frame) for name, effect in effects.items()}


def albumentations(package: Any) -> dict[str, Any]:
    """The transforms, by job and name."""
    return {
        "fog: albumentations RandomFog": package.RandomFog(p=1.0),
        "drifts: albumentations PlasmaBrightnessContrast": package.PlasmaBrightnessContrast(p=1.0),
        "flare: albumentations RandomSunFlare": package.RandomSunFlare(p=1.0),
    }
