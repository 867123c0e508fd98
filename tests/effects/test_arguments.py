"""Arguments and parameters of single effects that are out of range or of another type."""

import math
from inspect import signature
from itertools import product
from typing import Any

import pytest
import torch
from domain import DOMAINS
from helpers import random_image

import torchrefract as tr

KINDS = [domain.kind for domain in DOMAINS.values()]
ARGUMENTS: list[tuple[type, dict[str, Any], str]] = [
    (tr.ChromaticAberration, {"interpolation": "linear"}, "interpolation must be one of"),
    (tr.DivergenceFree, {"covariance": "spherical"}, "covariance must be one of"),
    (tr.DivergenceFree, {"normalize": "image"}, "normalize must be one of theory, max, none"),
    (tr.DivergenceFree, {"steps": 0}, "steps must be at least 1, got 0"),
    (tr.Exposure, {"max_gain": 8.0}, r"max_gain must be a number in \[1, 4\]"),
    (tr.Exposure, {"min_gain": 0.0}, r"min_gain must be a number in"),
    (tr.HeterogeneousFog, {"mode": "volume"}, "mode must be one of image, ray, got 'volume'"),
    (tr.HeterogeneousFog, {"weights": ()}, r"weights must be one number for each of 6 scales, got \(\)"),
    (tr.HeterogeneousFog, {"scales": (4.0,)}, "weights must be one number for each of 1 scales, got None; pass both"),
    (tr.HeterogeneousFog, {"scale_unit": "m"}, "scale_unit must be one of px, cells, got 'm'"),
    (tr.HeterogeneousFog, {"normalize": "max"}, "normalize must be one of theory, image"),
    (tr.HeterogeneousFog, {"mean": "time"}, "mean must be one of image, ensemble"),
    (tr.HeterogeneousFog, {"wind_z_range": (-1.0, 0.0)}, r"wind_z_range must be \(0, 0\) for mode='image'"),
    (tr.HeterogeneousFog, {"reach": 0.0}, "reach must be"),
    (tr.HeterogeneousFog, {"wake_density": -1.0}, "wake_density must"),
    (tr.HeterogeneousFog, {"wake_length": -1.0}, "wake_length must"),
    (tr.HeterogeneousFog, {"scale_height_range": (1.0, 2.0)}, "scale_height_range must be None for mode='image'"),
    (tr.HeterogeneousFog, {"mode": "ray", "scale_height_range": (0.0, 2.0)}, "scale_height_range must"),
    (tr.LensDistortion, {"padding": "wrap"}, "padding must be one of"),
    (tr.LensDistortion, {"interpolation": "lanczos"}, "interpolation must be one of"),
    (tr.LensFlare, {"color": (-0.1, 0.2, 0.3)}, "color must be a number in"),
    (tr.LensFlare, {"color": ()}, "color must have at least one number, got none"),
    (tr.LensFlare, {"blend": "multiply"}, "blend must be one of add, screen, got 'multiply'"),
    (tr.NightGlow, {"threshold": 1.0}, "threshold must"),
    (tr.PhysicalTurbulence, {"num_layers": 2}, "num_layers must be at least 3"),
    (tr.PhysicalTurbulence, {"num_layers": 9}, "num_layers must be at most 8"),
    (tr.PhysicalTurbulence, {"cn2_range": (-1e-12, 0.0)}, "cn2_range must be"),
    (tr.PhysicalTurbulence, {"aperture": 0.0}, "aperture must be"),
    (tr.PhysicalTurbulence, {"outer_scale": 0.001}, "outer_scale must be a number"),
    (tr.PhysicalTurbulence, {"height": 0.0}, "height must be"),
    (tr.PhysicalTurbulence, {"reach": 0.0}, "reach must be"),
    (tr.RoadMirage, {"half_width": 0.0}, "half_width must be above 0"),
    (tr.RoadMirage, {"num_waves": 0}, "num_waves must be at least 1"),
    (tr.RoadMirage, {"focal": 0.0}, "focal must be"),
    (tr.RollingShutter, {"num_frequencies": 0}, "num_frequencies must be at least 1"),
    (tr.RollingShutter, {"fps": 0.0}, "fps must"),
    (tr.SunGlare, {"center_x_range": (0.1, 0.2)}, "center_x_range and center_y_range must both be given"),
    (tr.SunGlare, {"center_x_range": (), "center_y_range": ()}, r"center_x_range must be \(low, high\), got \(\)"),
    (tr.SunGlare, {"outside": 1.5}, "outside must be a number in"),
    (tr.SunGlare, {"num_ghosts": -1}, "num_ghosts must be at least 0"),
    (tr.SunGlare, {"color": (1.0, 2000.0, 1.0)}, "color must be a number in"),
    (tr.ThinPlateSpline, {"lattice": (1, 4)}, "lattice must be at least 2, got 1"),
    (tr.ThinPlateSpline, {"lattice": 4}, r"lattice must be \(rows, columns\), got 4"),
    (tr.Turbulence, {"covariance": "spherical"}, "covariance must be one of exponential, gaussian, matern32, matern52"),
    (tr.Turbulence, {"normalize": "max"}, "normalize must be one of theory, image"),
    (tr.Turbulence, {"reference_distance": 0.0}, "reference_distance must be above 0"),
    (tr.UniformFog, {"airlight": ()}, "airlight must"),
    (tr.UniformFog, {"airlight": (0.5, math.nan, 0.5)}, "airlight must"),
    (tr.UniformFog, {"airlight": 1.1}, "airlight must"),
    (tr.UniformFog, {"airlight": "sky"}, "airlight must"),
    (tr.TurbulenceBlur, {"aperture": 0.0}, "aperture must be"),
    (tr.TurbulenceBlur, {"wavelength": 550.0}, "wavelength must be"),
    (tr.TurbulenceBlur, {"reach": 0.0}, "reach must be"),
    (tr.UniformFog, {"threshold": 0.0}, "threshold must"),
    (tr.UniformFog, {"threshold": 1.0}, "threshold must"),
]
TYPES: list[tuple[type, dict[str, Any], str]] = [
    (tr.HeterogeneousFog, {"depth": 100.0}, r"depth must be a provider such as LinearDepth\(\), or a function"),
    (tr.HeterogeneousFog, {"camera": "dashcam"}, "camera must be"),
    (tr.HeterogeneousFog, {"linear_light": 1}, "linear_light must be"),
    (tr.LensFlare, {"clip": 1}, "clip must be True or False, got 1"),
    (tr.NightGlow, {"camera": 3}, "camera must be a Camera"),
    (tr.RollingShutter, {"depth": 8.0}, "depth must be a provider"),
    (tr.RollingShutter, {"camera": (1400, 1400)}, "camera must be a Camera"),
    (tr.SunGlare, {"camera": 3}, "camera must be a Camera, got int"),
    (tr.ThinPlateSpline, {"lattice": (2.5, 4)}, "lattice must be a whole number"),
    (tr.Turbulence, {"depth": 3.0}, "depth must be a provider"),
    (tr.TurbulenceBlur, {"depth": 3.0}, "depth must be a provider"),
    (tr.Vignetting, {"camera": 1.0}, "camera must be a Camera"),
]
PARAMS: list[tuple[type, str, float, str]] = [
    (tr.Exposure, "target", 0.0, ""),
    (tr.Exposure, "gamma", -0.5, ""),
    (tr.Exposure, "time_constant", -1.0, ""),
    (tr.Exposure, "shot", 2.0, ""),
    (tr.HeterogeneousFog, "weights", -0.1, "be at least 0 and finite"),
    (tr.HeterogeneousFog, "contrast", -0.1, r"lie in \[0, 2\]"),
    (tr.HeterogeneousFog, "decorrelation", 0.0, "be above 0"),
    (tr.HeterogeneousFog, "visibility", 0.0, "be above 0"),
    (tr.LensFlare, "radius", -0.25, r"be at least 0 and finite, got -0\.25"),
    (tr.LensFlare, "strength", -0.25, r"be at least 0 and finite, got -0\.25"),
    (tr.LensFlare, "color", -0.25, r"be at least 0 and finite, got -0\.25"),
    (tr.PhysicalTurbulence, "tilt", -1.0, r"lie in \[0, 1e\+06\]"),
    (tr.RoadMirage, "difference", -1.0, r"lie in \[0, 300\]"),
    (tr.ThinPlateSpline, "smoothing", -1.0, "be at least 0"),
    (tr.Turbulence, "length", 0.0, r"lie in \[0.001, 1e\+06\]"),
    (tr.Turbulence, "length", 1e10, r"lie in \[0.001, 1e\+06\]"),
    (tr.Turbulence, "length", math.nan, "not be NaN"),
    (tr.Turbulence, "amplitude", -1.0, r"lie in \[0, 10000\]"),
    (tr.Turbulence, "aperture", math.inf, r"lie in \[0, 10000\]"),
    (tr.TurbulenceBlur, "ratio", -1.0, r"lie in \[0, 1e\+15\]"),
    (tr.UniformFog, "visibility", 0.0, "be above 0"),
    (tr.UniformFog, "deviation", -1.0, "be above -1"),
    (tr.UniformFog, "airlight", 1.01, r"lie in \[0, 1\]"),
]
SHAPES: list[tuple[type, dict[str, torch.Tensor], str]] = [
    (tr.HeterogeneousFog, {"weights": torch.zeros(2, 6)}, r"params\.weights must have a sum above 0, got 0"),
    (tr.PhysicalTurbulence, {"wind": torch.zeros(2, 3)}, r"params.wind must have shape \(B, 2\)"),
    (tr.RoadMirage, {"rate": torch.zeros(2, 3)}, r"params.rate must have shape \(B, 6\)"),
    (tr.ThinPlateSpline, {"displacement": torch.zeros(2, 3, 2)}, r"params\.displacement must have the shape of points"),
    (tr.ThinPlateSpline, {"points": torch.zeros(2, 16)}, r"params\.points must have shape \(B, N, 2\)"),
    (tr.TurbulenceBlur, {"ratio": torch.ones(2, 1)}, r"params\.ratio must have shape \(B,\)"),
    (tr.Turbulence, {"length": torch.ones(2, 1)}, r"params\.length must have shape \(B,\)"),
    (tr.Turbulence, {"key": torch.zeros(2, 3, dtype=torch.int64)}, r"params\.key must be \(B, 4\) of int64"),
]


@pytest.mark.parametrize(("kind", "options", "rule"), ARGUMENTS)
def test_an_argument_out_of_range_raises(kind, options, rule):
    with pytest.raises(ValueError, match=rule):
        kind(**options)


@pytest.mark.parametrize("name", DOMAINS)
def test_every_range_ends_at_its_bounds(name):
    domain = DOMAINS[name]
    for argument, (low, high) in domain.ranges.items():
        below, above = (low - max(1e-3 * abs(low), 1e-6), high), (low, high + max(1e-3 * abs(high), 1e-6))
        # Stronger physical turbulence is allowed, but too slow for other tests.
        is_exact = name != "physical turbulence" and math.isfinite(high)
        for wrong in (below, above) if is_exact else (below,) * (not argument.startswith("wind")):
            options: dict[str, Any] = {argument: wrong}
            with pytest.raises(ValueError, match=f"^{argument} must"):
                domain.kind(**options)


@pytest.mark.parametrize("kind", KINDS)
def test_every_range_out_of_bounds_raises(kind):
    names = [name for name in signature(kind).parameters if name.endswith("_range")]
    assert names
    for name, value in product(names, ((-1e300, 0.0), (0.0, 1e300), (2.0, 1.0), (1.0,), "ab", 5.0)):
        others = {other: (0.0, 1.0) for other in names if other.startswith("center")}  # a sun has none or both
        options: dict[str, Any] = others | ({"mode": "ray"} if kind is tr.HeterogeneousFog else {}) | {name: value}
        with pytest.raises(ValueError, match=f"^{name} must"):
            kind(**options)


@pytest.mark.parametrize(("kind", "options", "rule"), TYPES)
def test_an_argument_of_another_type_raises(kind, options, rule):
    with pytest.raises(TypeError, match=rule):
        kind(**options)


@pytest.mark.parametrize(("kind", "field", "value", "rule"), PARAMS)
def test_a_parameter_out_of_range_raises(kind, field, value, rule):
    image, effect = random_image(2, 3, 8, 9), kind()
    params = effect.sample(image, seed=1)
    wrong = getattr(params, field).clone()
    wrong.view(-1)[-1] = value
    with pytest.raises(ValueError, match=rf"params\.{field} must {rule}"):
        effect.apply(image, params._replace(**{field: wrong}))


@pytest.mark.parametrize(("kind", "values", "rule"), SHAPES)
def test_parameters_that_do_not_fit_raise(kind, values, rule):
    image, effect = random_image(2, 3, 8, 9), kind()
    with pytest.raises(ValueError, match=rule):
        effect.apply(image, effect.sample(image, seed=1)._replace(**values))


@pytest.mark.parametrize("kind", KINDS)
def test_a_parameter_of_another_shape_or_kind_raises(kind):
    image, effect = random_image(2, 3, 8, 9), kind()
    params = effect.sample(image, seed=1)
    fields = {field: value for field, value in params._asdict().items() if value is not None}
    for field, value in fields.items():
        wider = value[:, None] if value.ndim == 1 else torch.cat([value, value[..., -1:]], dim=-1)
        # Several fields of one count may be blamed for it.
        with pytest.raises(ValueError, match=r"^params\.\w+ must"):
            effect.apply(image, params._replace(**{field: wider}))
    with pytest.raises(
        ValueError, match=r"params\.applied must have .* and be bool of shape \(B,\), got torch\.float32"
    ):
        effect.apply(image, params._replace(applied=torch.ones(2)))
