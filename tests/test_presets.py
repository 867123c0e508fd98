"""Scenes: what is in them, and what a severity means."""

import inspect
import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrefract import (
    Compose,
    DivergenceFree,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    OneOf,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
    presets,
)
from torchrefract.effects.base import Effect
from torchrefract.warping.grid import length

SIZE = (54, 96)
SCENES: dict[str, Callable[..., Any]] = {
    name: scene
    for name, scene in inspect.getmembers(presets, inspect.isfunction)
    if not name.startswith("_") and scene.__module__ == presets.__name__
}
PHENOMENA = {
    "cheap_dashcam": {LensDistortion},
    "cape_town_fog": {HeterogeneousFog},
    "limpopo_sun_glare": {LensFlare},
    "highveld_heat_haze": {Turbulence},
    "unpaved_road": {HeterogeneousFog, Turbulence},
    "paper_refractive": {LensDistortion, Turbulence, ThinPlateSpline, DivergenceFree},
    "paper_weather": {UniformFog, HeterogeneousFog, LensFlare},
}


@pytest.fixture(params=SCENES)
def scene(request) -> str:
    return request.param


def made(name: str, severity: int = 3) -> Effect:
    """The scene for frames of SIZE, where it counts in px."""
    takes_width = "width" in inspect.signature(SCENES[name]).parameters
    return SCENES[name](severity, **({"width": SIZE[1]} if takes_width else {}))


def leaves(effect: Effect) -> Iterator[Any]:
    if isinstance(effect, Compose):
        for child in effect.effects:
            yield from leaves(child)  # pyright: ignore[reportArgumentType]  # effects hold effects
    else:
        yield effect


def damage(effect: Effect) -> float:
    """How far the frames of 24 drives are from what they were: px moved, or light lost and added."""
    d = effect.degrade(torch.full((24, 3, *SIZE), 0.5), seed=1)
    moved = 0.0 if d.flow is None else (length(d.flow) * d.valid).mean().item() / SIZE[1]
    lost = 0.0 if d.transmission is None else 1 - d.transmission.mean().item()
    added = 0.0 if d.intensity is None else d.intensity.mean().item()
    return 20 * moved + lost + added


def test_a_scene_lists_the_phenomena_that_it_has_and_no_others(scene):
    assert {type(leaf) for leaf in leaves(made(scene))} == PHENOMENA[scene]
    assert PHENOMENA.keys() == SCENES.keys()


def test_each_severity_is_worse_than_the_one_before(scene):
    found = [damage(made(scene, severity)) for severity in presets.SEVERITIES]
    assert found == sorted(found)
    assert all(later > 1.03 * earlier for earlier, later in pairwise(found))


def test_without_a_severity_it_is_3(scene):
    assert SCENES[scene]().extra_repr() == SCENES[scene](3).extra_repr()
    assert repr(SCENES[scene]()) == repr(SCENES[scene](3)) != repr(SCENES[scene](4))


@pytest.mark.parametrize("severity", [0, 6, 2.5, True, "3"])
def test_a_severity_that_is_none_raises(scene, severity):
    with pytest.raises(ValueError, match=f"severity must be one of 1, 2, 3, 4, 5, got {severity}"):
        SCENES[scene](severity)


@pytest.mark.parametrize("severity", presets.SEVERITIES)
def test_no_scene_folds_the_frame(scene, severity):
    effect = made(scene, severity)
    d = effect.degrade(torch.rand(12, 3, *SIZE), seed=1)  # warnings are errors
    if d.flow is not None:
        assert d.folding.fraction.max() < 0.002


@pytest.mark.parametrize("severity", presets.SEVERITIES)
def test_the_lens_of_the_dashcam_folds_nowhere(severity):
    effect = SCENES["cheap_dashcam"](severity)
    r = torch.linspace(0, 20, 20_001, dtype=torch.float64)
    for k1 in effect.k1_range:
        for k2 in effect.k2_range:
            assert (1 + 3 * k1 * r**2 + 5 * k2 * r**4 > 0).all()


def test_severities_mean_what_they_say():
    image = torch.zeros(400, 3, *SIZE)

    def drawn(name: str, severity: int, field: str) -> Tensor:
        return getattr(SCENES[name](severity).sample(image, seed=2), field)

    assert drawn("cape_town_fog", 1, "visibility").min() >= 500
    assert drawn("cape_town_fog", 5, "visibility").max() <= 40
    assert drawn("limpopo_sun_glare", 5, "strength").mean().item() == pytest.approx(1.0, abs=0.01)
    assert drawn("highveld_heat_haze", 5, "amplitude").mean().item() == pytest.approx(3.0, rel=0.02)
    for severity in presets.SEVERITIES:
        uniform, drifts, flare = SCENES["paper_weather"](severity).effects
        assert uniform.visibility_range == drifts.visibility_range == (300 / severity,) * 2
        assert sum(flare.strength_range) / 2 == pytest.approx(0.2 * severity)


def test_the_paper_s_weather_has_the_paper_s_numbers():
    uniform, drifts, flare = SCENES["paper_weather"]().effects
    assert -math.log(uniform.air.threshold) / uniform.visibility_range[0] == pytest.approx(0.029957, abs=1e-6)
    assert drifts.scales == (4, 8, 16, 32, 64, 128)
    assert drifts.weights == (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
    assert flare.strength_range == pytest.approx((0.55, 0.65))
    assert flare.radius_range == (0.25, 0.35)


@pytest.mark.parametrize("name", ["highveld_heat_haze", "unpaved_road", "paper_refractive"])
def test_a_scene_in_px_scales_with_the_width(name):
    wide, narrow = (SCENES[name](3, width=width) for width in (1920, 480))
    for first, second in zip(leaves(wide), leaves(narrow), strict=True):
        for option in ("amplitude_range", "length_range", "aperture_range"):
            if hasattr(first, option) and not isinstance(first, HeterogeneousFog):
                assert getattr(first, option) == pytest.approx([4 * value for value in getattr(second, option)])
    with pytest.raises(ValueError, match="width must be above 0, got 0"):
        SCENES[name](3, width=0)


def test_one_of_the_paper_s_effects_is_chosen_for_each_frame():
    for name in ("paper_refractive", "paper_weather"):
        effect = made(name)
        assert isinstance(effect, OneOf)
        params = effect.sample(torch.zeros(200, 3, *SIZE), seed=1)
        gates = torch.stack([child.applied for child in params.children])
        assert (gates.sum(dim=0) == 1).all()
        assert (gates.sum(dim=1) > 30).all()
