"""Invalid arguments raise ValueError: `<argument> must <condition>, got <value>`."""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from domain import DOMAINS

import torchrefract as tr

GRAY = torch.full((1, 3, 8, 9), 0.5)
FOLDING: dict[str, Any] = {"k1_range": (-0.6, -0.6), "focal_range": (0.5, 0.5), "strict": True}


def apply_lens(**changed: Any) -> Any:
    effect = tr.LensDistortion()
    return effect.apply(GRAY, effect.sample(GRAY, seed=0)._replace(**changed))


def apply_spline(*points: tuple[float, float]) -> Any:
    effect, values = tr.ThinPlateSpline(), torch.tensor([points])
    return effect.apply(GRAY, effect.sample(GRAY, seed=0)._replace(points=values, displacement=values))


def camera(**changed: Any) -> tr.Camera:
    pinhole: dict[str, Any] = {"width": 201, "height": 201, "fx": 199.0, "fy": 199.0, "cx": 100.0, "cy": 100.0}
    arguments: dict[str, Any] = pinhole | {"coefficients": (0.0,) * 4} | changed
    return tr.Camera(**arguments)


def camera_with_pole() -> tr.Camera:
    """Create a camera whose denominator, 1 - 2 r^2, is 0 inside the frame."""
    return camera(coefficients=(0.0,) * 5 + (-2.0, 0.0, 0.0))


def fog(depth: torch.Tensor) -> Any:
    return tr.UniformFog().degrade(GRAY, seed=0, depth=depth)


def noise(*scales: float, **options: Any) -> Any:
    return tr.HeterogeneousFog(**{"scales": scales, "weights": [1.0] * len(scales)} | options)


# Calls; each name starts with the argument that the error names.
CALLS: dict[str, Callable[[], Any]] = {
    **{f"p of {name}": lambda domain=domain: domain.kind(p=1.5) for name, domain in DOMAINS.items()},
    # A lens out of bounds, or one that folds.
    "k1_range = -1e3": lambda: tr.LensDistortion(k1_range=(-1e3, 0.0)),
    "k1_range = 1e30": lambda: tr.LensDistortion(k1_range=(0.0, 1e30)),
    "focal_range = 0": lambda: tr.LensDistortion(focal_range=(0.0, 1.0)),
    "focal_range < 0": lambda: tr.LensDistortion(focal_range=(-1.0, 1.0)),
    "params.focal = 0": lambda: apply_lens(focal=torch.zeros(1, 2)),
    "params.coefficients = -1e3": lambda: apply_lens(coefficients=torch.full((1, 12), -1e3)),
    "params.coefficients = 1e30": lambda: apply_lens(coefficients=torch.full((1, 12), 1e30)),
    "fx of a camera": lambda: camera(fx=0.0),
    "coefficients of a camera": lambda: camera(coefficients=(-1e30, 0.0, 0.0, 0.0)),
    "coefficients of a strict lens": lambda: tr.LensDistortion(**FOLDING).degrade(torch.rand(1, 3, 18, 32), seed=0),
    # A denominator of 0 inside the frame.
    "camera to rectify": lambda: tr.Rectification(camera_with_pole()),
    "camera as a lens": lambda: tr.LensDistortion.from_camera(camera_with_pole()),
    "camera to cover a frame": lambda: camera_with_pole().check_covers(),
    # A length that is not positive.
    **{f"length_range of {low}": lambda low=low: tr.Turbulence(length_range=(low, 1.0)) for low in (0, -1, math.nan)},
    # Points that define no spline.
    "points of which two are equal": lambda: apply_spline((0.0, 0.0), (9.0, 0.0), (9.0, 0.0), (4.0, 4.0)),
    "points on a line": lambda: apply_spline((0.0, 0.0), (3.0, 1.0), (6.0, 2.0), (9.0, 3.0)),
    "points, two of them": lambda: apply_spline((0.0, 0.0), (9.0, 0.0)),
    "points at infinity": lambda: apply_spline((0.0, 0.0), (9.0, math.inf), (4.0, 4.0)),
    # An invalid depth.
    "depth < 0": lambda: fog(torch.full((1, 1, 8, 9), -1.0)),
    "depth NaN": lambda: fog(torch.full((1, 1, 8, 9), math.nan)),
    "depth of another shape": lambda: fog(torch.ones(1, 1, 9, 8)),
    "max_depth < 0": lambda: tr.LinearDepth(max_depth=-1.0),
    "max_depth = 1e308": lambda: tr.LinearDepth(max_depth=1e308),
    # Invalid scales and weights, and scales that need too many nodes.
    "scales = 0": lambda: noise(4.0, 0.0),
    "scales < 0": lambda: noise(-4.0),
    "scales empty": noise,
    "weights < 0": lambda: noise(4.0, weights=[-1.0]),
    "weights all 0": lambda: noise(4.0, weights=[0.0]),
    "scales of 1e-6": lambda: noise(1e-6).degrade(GRAY, seed=0),
    "scales of 1e-320": lambda: noise(1e-320).degrade(GRAY, seed=0),
    "scales of a million cells": lambda: noise(1e6, scale_unit="cells").degrade(GRAY, seed=0),
    "effects of an empty composition": lambda: tr.Compose([]),
}


@pytest.mark.quick
@pytest.mark.parametrize("name", CALLS)
def test_an_invalid_argument_raises(name):
    argument = re.escape(name.split()[0].strip(","))
    with pytest.raises(ValueError, match=rf"^{argument}\b.* must .+, got .+"):
        CALLS[name]()


def test_opencv_s_14_coefficients_as_a_polynomial_raise():
    with pytest.raises(ValueError, match=r"^params\.coefficients must .*polynomial.*, got "):
        apply_lens(coefficients=torch.zeros(1, 14))
    with pytest.raises(ValueError, match=r"^coefficients must .*polynomial12.*, got "):
        camera(coefficients=(0.0,) * 14, model="polynomial12")
