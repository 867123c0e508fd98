"""Invalid arguments raise ValueError: `<argument> must <condition>, got <value>`."""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

import torchrefract as tr

EFFECTS = {
    "lens": tr.LensDistortion,
    "turbulence": tr.Turbulence,
    "thin-plate spline": tr.ThinPlateSpline,
    "divergence-free": tr.DivergenceFree,
    "uniform fog": tr.UniformFog,
    "heterogeneous fog": tr.HeterogeneousFog,
    "flare": tr.LensFlare,
}
GRAY = torch.full((1, 3, 8, 9), 0.5)
Call = Callable[[], Any]


def check(call: Call, argument: str) -> None:
    """Raise AssertionError unless a call raises an error that names the argument, the rule and the value."""
    with pytest.raises(ValueError, match=rf"^{re.escape(argument)}\b.* must .+, got .+"):
        call()


def calls(cases: dict[str, Call]) -> Any:
    """Parametrize a test by calls; each name starts with the argument that the error names."""
    values = [pytest.param(call, name.split()[0], id=name) for name, call in cases.items()]
    return pytest.mark.parametrize(("call", "argument"), values)


def apply_lens(**changed: Any) -> Any:
    effect = tr.LensDistortion()
    return effect.apply(GRAY, effect.sample(GRAY, seed=0)._replace(**changed))


def apply_spline(points: list[list[float]]) -> Any:
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


def heterogeneous_fog(scale: float, **options: Any) -> Any:
    return tr.HeterogeneousFog(scales=[scale], weights=[1.0], **options).degrade(GRAY, seed=0)


@pytest.mark.quick
@pytest.mark.parametrize("name", EFFECTS)
def test_a_probability_outside_0_to_1_raises(name):
    check(lambda: EFFECTS[name](p=1.5), "p")


@calls(
    {
        "amplitude_range of turbulence": lambda: tr.Turbulence(amplitude_range=(-1.0, 0.0)),
        "amplitude_range of a thin-plate spline": lambda: tr.ThinPlateSpline(amplitude_range=(-1.0, 0.0)),
        "amplitude_range of divergence-free warps": lambda: tr.DivergenceFree(amplitude_range=(-1.0, 0.0)),
        "strength_range of flare": lambda: tr.LensFlare(strength_range=(-0.5, 0.5)),
        "contrast_range of fog": lambda: tr.HeterogeneousFog(contrast_range=(-0.1, 0.1)),
    }
)
def test_a_negative_strength_raises(call, argument):
    check(call, argument)


@calls(
    {
        "k1_range = -1e3": lambda: tr.LensDistortion(k1_range=(-1e3, 0.0)),
        "k1_range = 1e30": lambda: tr.LensDistortion(k1_range=(0.0, 1e30)),
        "focal_range = 0": lambda: tr.LensDistortion(focal_range=(0.0, 1.0)),
        "focal_range < 0": lambda: tr.LensDistortion(focal_range=(-1.0, 1.0)),
        "params.focal = 0": lambda: apply_lens(focal=torch.zeros(1, 2)),
        "params.coefficients = -1e3": lambda: apply_lens(coefficients=torch.full((1, 12), -1e3)),
        "params.coefficients = 1e30": lambda: apply_lens(coefficients=torch.full((1, 12), 1e30)),
        "fx of a camera": lambda: camera(fx=0.0),
        "coefficients of a camera": lambda: camera(coefficients=(-1e30, 0.0, 0.0, 0.0)),
    }
)
def test_a_lens_out_of_bounds_raises(call, argument):
    check(call, argument)


def test_a_strict_lens_that_folds_inside_the_frame_raises():
    options: dict[str, Any] = {"k1_range": (-0.6, -0.6), "focal_range": (0.5, 0.5), "strict": True}
    check(lambda: tr.LensDistortion(**options).degrade(torch.rand(1, 3, 18, 32), seed=0), "coefficients")


@calls(
    {
        "camera to rectify": lambda: tr.Rectification(camera_with_pole()),
        "camera as a lens": lambda: tr.LensDistortion.from_camera(camera_with_pole()),
        "camera to cover a frame": lambda: camera_with_pole().check_covers(),
    }
)
def test_a_camera_with_a_pole_inside_the_frame_raises(call, argument):
    check(call, argument)


@calls(
    {
        "params.coefficients of 14": lambda: apply_lens(coefficients=torch.zeros(1, 14)),
        "coefficients of 14": lambda: camera(coefficients=(0.0,) * 14, model="polynomial12"),
    }
)
def test_opencv_s_14_coefficients_as_a_polynomial_raise(call, argument):
    check(call, argument)


@pytest.mark.parametrize("low", [0.0, -1.0, math.nan])
def test_a_length_that_is_not_positive_raises(low):
    check(lambda: tr.Turbulence(length_range=(low, 1.0)), "length_range")


@pytest.mark.parametrize(
    "points",
    [
        pytest.param([[0.0, 0.0], [9.0, 0.0], [9.0, 0.0], [4.0, 4.0]], id="two equal points"),
        pytest.param([[0.0, 0.0], [3.0, 1.0], [6.0, 2.0], [9.0, 3.0]], id="points on a line"),
        pytest.param([[0.0, 0.0], [9.0, 0.0]], id="two points"),
        pytest.param([[0.0, 0.0], [9.0, math.inf], [4.0, 4.0]], id="a point at infinity"),
    ],
)
def test_control_points_that_define_no_spline_raise(points):
    check(lambda: apply_spline(points), "points")


@calls(
    {
        "visibility_range = 0": lambda: tr.UniformFog(visibility_range=(0.0, 9.0)),
        "visibility_range < 0": lambda: tr.HeterogeneousFog(visibility_range=(-1.0, 9.0)),
    }
)
def test_a_visibility_that_is_not_positive_raises(call, argument):
    check(call, argument)


@calls(
    {
        "depth < 0": lambda: fog(torch.full((1, 1, 8, 9), -1.0)),
        "depth NaN": lambda: fog(torch.full((1, 1, 8, 9), math.nan)),
        "depth of another shape": lambda: fog(torch.ones(1, 1, 9, 8)),
        "max_depth < 0": lambda: tr.LinearDepth(max_depth=-1.0),
        "max_depth = 1e308": lambda: tr.LinearDepth(max_depth=1e308),
    }
)
def test_an_invalid_depth_raises(call, argument):
    check(call, argument)


@calls(
    {
        "scales = 0": lambda: tr.HeterogeneousFog(scales=[0.0], weights=[1.0]),
        "scales < 0": lambda: tr.HeterogeneousFog(scales=[-4.0], weights=[1.0]),
        "scales empty": lambda: tr.HeterogeneousFog(scales=[], weights=[]),
        "weights < 0": lambda: tr.HeterogeneousFog(scales=[4.0], weights=[-1.0]),
        "weights all 0": lambda: tr.HeterogeneousFog(scales=[4.0], weights=[0.0]),
    }
)
def test_invalid_scales_and_weights_raise(call, argument):
    check(call, argument)


@calls(
    {
        "scales of 1e-6": lambda: heterogeneous_fog(1e-6),
        "scales of 1e-320": lambda: heterogeneous_fog(1e-320),
        "scales of a million cells": lambda: heterogeneous_fog(1e6, scale_unit="cells"),
    }
)
def test_scales_that_need_too_many_nodes_raise(call, argument):
    check(call, argument)


@calls(
    {
        "radius_range < 0": lambda: tr.LensFlare(radius_range=(-0.1, 0.2)),
        "strength_range < 0": lambda: tr.LensFlare(strength_range=(-0.1, 0.2)),
    }
)
def test_a_negative_flare_raises(call, argument):
    check(call, argument)


def test_a_composition_without_effects_raises():
    check(lambda: tr.Compose([]), "effects")
