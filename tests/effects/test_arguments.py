"""Arguments and parameters of single effects that are out of range or of another type."""

import math
from inspect import signature
from itertools import product
from typing import Any

import pytest
import torch
from helpers import random_image

from torchrefract import (
    ChromaticAberration,
    DivergenceFree,
    Exposure,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    NightGlow,
    PhysicalTurbulence,
    RoadMirage,
    RollingShutter,
    SunGlare,
    ThinPlateSpline,
    Turbulence,
    TurbulenceBlur,
    UniformFog,
    Vignetting,
)

KINDS = (
    *(ChromaticAberration, DivergenceFree, Exposure, HeterogeneousFog, LensDistortion, LensFlare, NightGlow),
    *(PhysicalTurbulence, RoadMirage, RollingShutter, SunGlare, ThinPlateSpline, Turbulence, UniformFog, Vignetting),
    TurbulenceBlur,
)
ARGUMENTS: list[tuple[type, dict[str, Any], str]] = [
    (ChromaticAberration, {"red_range": (0.0, 0.2)}, "red_range must"),
    (ChromaticAberration, {"interpolation": "linear"}, "interpolation must be one of"),
    (DivergenceFree, {"length_range": (0.0, 1.0)}, "length_range must be"),
    (DivergenceFree, {"covariance": "spherical"}, "covariance must be one of"),
    (DivergenceFree, {"normalize": "image"}, "normalize must be one of theory, max, none"),
    (DivergenceFree, {"steps": 0}, "steps must be at least 1, got 0"),
    (Exposure, {"max_gain": 8.0}, r"max_gain must be a number in \[1, 4\]"),
    (Exposure, {"min_gain": 0.0}, r"min_gain must be a number in"),
    (Exposure, {"shot_range": (0.0, 2.0)}, "shot_range must"),
    (Exposure, {"time_constant_range": (-1.0, 2.0)}, "time_constant_range must"),
    (HeterogeneousFog, {"mode": "volume"}, "mode must be one of image, ray, got 'volume'"),
    (HeterogeneousFog, {"weights": ()}, r"weights must be one number for each of 6 scales, got \(\)"),
    (HeterogeneousFog, {"scales": (4.0,)}, "weights must be one number for each of 1 scales, got None"),
    (HeterogeneousFog, {"scale_unit": "m"}, "scale_unit must be one of px, cells, got 'm'"),
    (HeterogeneousFog, {"normalize": "max"}, "normalize must be one of theory, image"),
    (HeterogeneousFog, {"mean": "time"}, "mean must be one of image, ensemble"),
    (HeterogeneousFog, {"wind_z_range": (-1.0, 0.0)}, r"wind_z_range must be \(0, 0\) for mode='image', which has no"),
    (HeterogeneousFog, {"decorrelation_range": (0.0, 1.0)}, "decorrelation_range must be"),
    (HeterogeneousFog, {"reach": 0.0}, "reach must be"),
    (HeterogeneousFog, {"wake_density": -1.0}, "wake_density must"),
    (HeterogeneousFog, {"wake_length": -1.0}, "wake_length must"),
    (HeterogeneousFog, {"scale_height_range": (1.0, 2.0)}, "scale_height_range must be None for mode='image'"),
    (HeterogeneousFog, {"mode": "ray", "scale_height_range": (0.0, 2.0)}, "scale_height_range must"),
    (LensDistortion, {"padding": "wrap"}, "padding must be one of"),
    (LensDistortion, {"interpolation": "lanczos"}, "interpolation must be one of"),
    (LensFlare, {"color": (-0.1, 0.2, 0.3)}, "color must be a number in"),
    (LensFlare, {"color": ()}, "color must have at least one number, got none"),
    (LensFlare, {"blend": "multiply"}, "blend must be one of add, screen, got 'multiply'"),
    (NightGlow, {"optical_depth_range": (-1.0, 0.0)}, "optical_depth_range must"),
    (NightGlow, {"asymmetry_range": (0.0, 0.5)}, "asymmetry_range must"),
    (NightGlow, {"luminance_range": (2.0, 1.0)}, "luminance_range must"),
    (NightGlow, {"threshold": 1.0}, "threshold must"),
    (PhysicalTurbulence, {"num_layers": 2}, "num_layers must be at least 3"),
    (PhysicalTurbulence, {"num_layers": 9}, "num_layers must be at most 8"),
    (PhysicalTurbulence, {"cn2_range": (-1e-12, 0.0)}, "cn2_range must be"),
    (PhysicalTurbulence, {"aperture": 0.0}, "aperture must be"),
    (PhysicalTurbulence, {"outer_scale": 0.001}, "outer_scale must be a number"),
    (PhysicalTurbulence, {"height": 0.0}, "height must be"),
    (PhysicalTurbulence, {"reach": 0.0}, "reach must be"),
    (RoadMirage, {"difference_range": (-1.0, 5.0)}, "difference_range must be"),
    (RoadMirage, {"shimmer_range": (0.0, 1.5)}, "shimmer_range must be"),
    (RoadMirage, {"half_width": 0.0}, "half_width must be above 0"),
    (RoadMirage, {"num_waves": 0}, "num_waves must be at least 1"),
    (RoadMirage, {"focal": 0.0}, "focal must be"),
    (RollingShutter, {"speed_range": (0.0, 2000.0)}, "speed_range must"),
    (RollingShutter, {"exposure_range": (-1.0, 0.0)}, "exposure_range must"),
    (RollingShutter, {"pitch_range": (0.0, 6.0)}, "pitch_range must"),
    (RollingShutter, {"num_frequencies": 0}, "num_frequencies must be at least 1"),
    (RollingShutter, {"fps": 0.0}, "fps must"),
    (SunGlare, {"center_x_range": (0.1, 0.2)}, "center_x_range and center_y_range must both be given"),
    (SunGlare, {"center_x_range": (), "center_y_range": ()}, r"center_x_range must be \(low, high\), got \(\)"),
    (SunGlare, {"outside": 1.5}, "outside must be a number in"),
    (SunGlare, {"scatter_range": (0.0, 1.5)}, "scatter_range must"),
    (SunGlare, {"scale_range": (0.0, 1.0)}, "scale_range must"),
    (SunGlare, {"num_ghosts": -1}, "num_ghosts must be at least 0"),
    (SunGlare, {"color": (1.0, 2000.0, 1.0)}, "color must be a number in"),
    (ThinPlateSpline, {"smoothing_range": (-1.0, 1.0)}, "smoothing_range must be"),
    (ThinPlateSpline, {"lattice": (1, 4)}, "lattice must be at least 2, got 1"),
    (Turbulence, {"aperture_range": (-1.0, 1.0)}, "aperture_range must be"),
    (Turbulence, {"covariance": "spherical"}, "covariance must be one of exponential, gaussian, matern32, matern52"),
    (Turbulence, {"normalize": "max"}, "normalize must be one of theory, image"),
    (Turbulence, {"reference_distance": 0.0}, "reference_distance must be above 0"),
    (UniformFog, {"airlight": ()}, "airlight must"),
    (UniformFog, {"airlight": (0.5, math.nan, 0.5)}, "airlight must"),
    (UniformFog, {"airlight": 1.1}, "airlight must"),
    (UniformFog, {"airlight": "sky"}, "airlight must"),
    (TurbulenceBlur, {"aperture": 0.0}, "aperture must be"),
    (TurbulenceBlur, {"wavelength": 550.0}, "wavelength must be"),
    (TurbulenceBlur, {"reach": 0.0}, "reach must be"),
    (UniformFog, {"deviation_range": (-1.0, 0.0)}, "deviation_range must"),
    (UniformFog, {"deviation_range": (0.0, 1.0)}, "deviation_range must"),
    (UniformFog, {"threshold": 0.0}, "threshold must"),
    (UniformFog, {"threshold": 1.0}, "threshold must"),
    (Vignetting, {"strength_range": (0.0, 1.5)}, "strength_range must"),
]
TYPES: list[tuple[type, dict[str, Any], str]] = [
    (HeterogeneousFog, {"depth": 100.0}, "depth must be"),
    (HeterogeneousFog, {"camera": "dashcam"}, "camera must be"),
    (HeterogeneousFog, {"linear_light": 1}, "linear_light must be"),
    (LensFlare, {"clip": 1}, "clip must be True or False, got 1"),
    (NightGlow, {"camera": 3}, "camera must be a Camera"),
    (RollingShutter, {"depth": 8.0}, "depth must be a provider"),
    (RollingShutter, {"camera": (1400, 1400)}, "camera must be a Camera"),
    (SunGlare, {"camera": 3}, "camera must be a Camera, got int"),
    (ThinPlateSpline, {"lattice": (2.5, 4)}, "lattice must be a whole number"),
    (Turbulence, {"depth": 3.0}, "depth must be a provider"),
    (TurbulenceBlur, {"depth": 3.0}, "depth must be a provider"),
    (Vignetting, {"camera": 1.0}, "camera must be a Camera"),
]
PARAMS: list[tuple[type, str, float, str]] = [
    (Exposure, "target", 0.0, ""),
    (Exposure, "gamma", -0.5, ""),
    (Exposure, "time_constant", -1.0, ""),
    (Exposure, "shot", 2.0, ""),
    (HeterogeneousFog, "weights", -0.1, "be at least 0 and finite"),
    (HeterogeneousFog, "contrast", -0.1, r"lie in \[0, 2\]"),
    (HeterogeneousFog, "decorrelation", 0.0, "be above 0"),
    (HeterogeneousFog, "visibility", 0.0, "be above 0"),
    (LensFlare, "radius", -0.25, r"be at least 0 and finite, got -0\.25"),
    (LensFlare, "strength", -0.25, r"be at least 0 and finite, got -0\.25"),
    (LensFlare, "color", -0.25, r"be at least 0 and finite, got -0\.25"),
    (PhysicalTurbulence, "tilt", -1.0, r"lie in \[0, 1e\+06\]"),
    (RoadMirage, "difference", -1.0, r"lie in \[0, 300\]"),
    (ThinPlateSpline, "smoothing", -1.0, "be at least 0"),
    (Turbulence, "length", 0.0, r"lie in \[0.001, 1e\+06\]"),
    (Turbulence, "length", 1e10, r"lie in \[0.001, 1e\+06\]"),
    (Turbulence, "length", math.nan, "not be NaN"),
    (Turbulence, "amplitude", -1.0, r"lie in \[0, 10000\]"),
    (Turbulence, "aperture", math.inf, r"lie in \[0, 10000\]"),
    (TurbulenceBlur, "ratio", -1.0, r"lie in \[0, 1e\+15\]"),
    (UniformFog, "visibility", 0.0, "be above 0"),
    (UniformFog, "deviation", -1.0, "be above -1"),
    (UniformFog, "airlight", 1.01, r"lie in \[0, 1\]"),
]
SHAPES: list[tuple[type, dict[str, torch.Tensor], str]] = [
    (HeterogeneousFog, {"weights": torch.zeros(2, 6)}, r"params\.weights must have a sum above 0, got 0"),
    (PhysicalTurbulence, {"wind": torch.zeros(2, 3)}, r"params.wind must have shape \(B, 2\)"),
    (RoadMirage, {"rate": torch.zeros(2, 3)}, r"params.rate must have shape \(B, 6\)"),
    (ThinPlateSpline, {"displacement": torch.zeros(2, 3, 2)}, r"params\.displacement must have the shape of points"),
    (ThinPlateSpline, {"points": torch.zeros(2, 16)}, r"params\.points must have shape \(B, N, 2\)"),
    (TurbulenceBlur, {"ratio": torch.ones(2, 1)}, r"params\.ratio must have shape \(B,\)"),
    (Turbulence, {"length": torch.ones(2, 1)}, r"params\.length must have shape \(B,\)"),
    (Turbulence, {"key": torch.zeros(2, 3, dtype=torch.int64)}, r"params\.key must be \(B, 4\) of int64"),
]


@pytest.mark.parametrize(("kind", "options", "rule"), ARGUMENTS)
def test_an_argument_out_of_range_raises(kind, options, rule):
    with pytest.raises(ValueError, match=rule):
        kind(**options)


@pytest.mark.parametrize("kind", KINDS)
def test_every_range_out_of_bounds_raises(kind):
    names = [name for name in signature(kind).parameters if name.endswith("_range")]
    assert names
    for name, value in product(names, ((-1e300, 0.0), (0.0, 1e300), (2.0, 1.0), (1.0,), "ab", 5.0)):
        others = {other: (0.0, 1.0) for other in names if other.startswith("center")}  # a sun has none or both
        options: dict[str, Any] = others | ({"mode": "ray"} if kind is HeterogeneousFog else {}) | {name: value}
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
