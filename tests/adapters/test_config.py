"""Effects as plain values."""

import inspect
import json
from typing import Any

import pytest
import torch

import torchrefract as tr
from torchrefract import presets
from torchrefract.adapters.config import effect_from_config, effect_to_config
from torchrefract.effects.base import Effect

CAMERA = tr.Camera(width=80, height=64, fx=70, fy=70, cx=39.5, cy=31.5, coefficients=(-0.1, 0.01, 0, 0))
CLASSES = [kind for name in tr.__all__ if inspect.isclass(kind := getattr(tr, name)) and issubclass(kind, Effect)]
ARGUMENTS: dict[Any, tuple[Any, ...]] = {
    **{tr.Compose: ([],), tr.OneOf: ([],), tr.Rectification: (CAMERA,)},
    tr.BlurredTurbulence: (tr.PhysicalTurbulence(p=0.5),),
}


@pytest.mark.quick
@pytest.mark.parametrize("kind", CLASSES)
def test_every_effect_comes_back_from_json(kind):
    arguments = (
        ([tr.UniformFog(p=0.5), tr.LensDistortion()],) if kind in (tr.Compose, tr.OneOf) else ARGUMENTS.get(kind, ())
    )
    effect = kind(*arguments, p=0.7)
    config = json.loads(json.dumps(effect_to_config(effect)))
    assert config["_target_"] == f"torchrefract.{kind.__name__}"
    assert repr(effect_from_config(config)) == repr(effect)


@pytest.mark.parametrize("name", ["highveld_telephoto", "unpaved_road", "cape_town_fog", "paper_weather"])
@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test is of others
def test_a_scene_from_its_config_draws_the_same(name):
    scene = getattr(presets, name)(4)
    again = effect_from_config(effect_to_config(scene))
    image = torch.rand(2, 3, 54, 96)
    assert torch.equal(again.degrade(image, seed=1).image, scene.degrade(image, seed=1).image)


def test_hydra_creates_the_same_effect():
    hydra = pytest.importorskip("hydra.utils", reason="hydra is in the extra train")
    scene = presets.highveld_heat_haze(2)
    assert repr(hydra.instantiate(effect_to_config(scene))) == repr(scene)


def test_what_text_cannot_describe_raises():
    covariance = torch.eye(8, dtype=torch.float64) * 1e-6
    lens = tr.LensDistortion.from_camera(CAMERA, covariance=covariance)
    with pytest.raises(TypeError, match=r"effect must be given by its arguments .* got LensDistortion with more"):
        effect_to_config(lens)
    for config in ({"_target_": "os.system"}, {"_target_": "torchrefract.warp"}, {}):
        with pytest.raises(ValueError, match="_target_ must name an effect"):
            effect_from_config(config)
    with pytest.raises(TypeError, match="effect must be an effect or its config, got CorridorDepth"):
        effect_from_config({"_target_": "torchrefract.CorridorDepth"})
