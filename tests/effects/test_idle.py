"""Effects that never act: a composition neither draws nor plans nor computes them, and still tells what was drawn."""

import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

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
)
from torchrefract.effects.base import Effect

STILL, CLEAR = (0.0, 0.0), (math.inf, math.inf)
IDLE: dict[str, Callable[[], Effect]] = {
    "turbulence": lambda: Turbulence(amplitude_range=STILL),
    "plate": lambda: ThinPlateSpline(amplitude_range=STILL),
    "swirls": lambda: DivergenceFree(amplitude_range=STILL),
    "pinhole": lambda: LensDistortion(k1_range=STILL, k2_range=STILL, p1_range=STILL, p2_range=STILL),
    "fog": lambda: UniformFog(visibility_range=CLEAR),
    "drifts": lambda: HeterogeneousFog(visibility_range=CLEAR),
    "weak flare": lambda: LensFlare(strength_range=STILL),
    "small flare": lambda: LensFlare(radius_range=STILL),
    "p of 0": lambda: LensDistortion(p=0.0),
    "composition": lambda: OneOf([UniformFog(visibility_range=CLEAR), LensFlare(p=0.0)]),
    "composition of p 0": lambda: Compose([LensDistortion(), UniformFog()], p=0.0),
}
ACTING: dict[str, Callable[[], Effect]] = {
    "turbulence": Turbulence,
    "plate": lambda: ThinPlateSpline(amplitude_range=(0.0, 1.0)),
    "swirls": DivergenceFree,
    "lens": lambda: LensDistortion(k1_range=STILL, k2_range=STILL),  # decentring is left
    "fog": lambda: UniformFog(visibility_range=(100.0, math.inf)),
    "flare": lambda: LensFlare(strength_range=(0.0, 1.0)),
    "composition": lambda: Compose([LensDistortion(p=0.0), UniformFog()]),
}


def tensors(params: Any) -> list[Tensor]:
    """All that was drawn."""
    return [params] if isinstance(params, Tensor) else [each for value in params for each in tensors(value)]


def scene(more: Effect) -> Compose:
    """One that acts, around one more."""
    return Compose([LensDistortion(), more, Compose([UniformFog()])])


@pytest.mark.parametrize("name", IDLE)
def test_it_is_idle_and_changes_nothing(name):
    effect, frame = IDLE[name](), torch.rand(2, 3, 24, 32)
    assert effect.idle
    assert torch.equal(effect(frame), frame)


@pytest.mark.parametrize("name", ACTING)
def test_what_may_act_is_not_idle(name):
    assert not ACTING[name]().idle


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("name", IDLE)
def test_what_was_drawn_is_what_sample_draws(name, clip):
    effect, frame = scene(IDLE[name]()), torch.rand(2, 3, 3, 24, 32) if clip else torch.rand(2, 3, 24, 32)
    made = effect.degrade(frame, seed=3, keys=[5, 9], frame=2)
    expected = effect.sample(frame, seed=3, keys=[5, 9], frame=2)
    assert all(map(torch.equal, tensors(made.params), tensors(expected)))
    assert type(made.params.children[1]) is type(expected.children[1])
    assert torch.equal(effect.apply(frame, made.params).image, made.image)
    for found in (pickle.loads(pickle.dumps(effect.degrade(frame, seed=3, keys=[5, 9], frame=2))), made):
        assert all(map(torch.equal, tensors(found.params), tensors(expected)))


@pytest.mark.parametrize("name", IDLE)
def test_the_scene_is_that_without_it(name):
    frame = torch.rand(2, 3, 24, 32)
    found = scene(IDLE[name]()).degrade(frame, seed=1)
    without = scene(LensFlare(p=0.0)).degrade(frame, seed=1)
    for of in ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission"):
        assert torch.equal(getattr(found, of), getattr(without, of)), of


def test_nobody_draws_it_until_its_parameters_are_read(monkeypatch):
    drawn = []

    def draw(self: Turbulence, source: Any, image: Tensor) -> Any:
        drawn.append(tuple(image.shape))
        return original(self, source, image)

    original = Turbulence.draw
    monkeypatch.setattr(Turbulence, "draw", draw)
    made = Compose([LensDistortion(), Turbulence(amplitude_range=STILL), Turbulence(p=0.0)]).degrade(
        torch.rand(2, 3, 24, 32)
    )
    assert not drawn
    made.map(torch.clone)  # a copy leaves it so
    assert not drawn
    assert made.params is made.params
    assert drawn == [(2, 3, 24, 32)] * 2


def test_what_is_read_late_was_drawn_from_the_ranges_of_the_call():
    still = Turbulence(amplitude_range=STILL)
    effect, frame = Compose([LensDistortion(), still]), torch.rand(1, 3, 24, 32)
    made = effect.degrade(frame, seed=0)
    still.amplitude_range = (0.5, 0.5)
    assert made.params.children[1].amplitude.item() == 0
    assert effect.degrade(frame, seed=0).params.children[1].amplitude.item() == 0.5


def test_maps_say_that_nothing_was_changed():
    frame = torch.rand(2, 3, 24, 32)
    made = Compose([make() for make in IDLE.values()]).degrade(frame)
    assert made.image is frame
    for of, value in {"flow": 0, "restore_flow": 0, "valid": 1, "restore_valid": 1, "transmission": 1}.items():
        found = getattr(made, of)
        assert found.shape == (2, 2 if "flow" in of else 1, 24, 32), of
        assert bool((found == value).all()), of
    assert bool((made.intensity == 0).all())
    assert bool((made.extinction == 0).all())


def test_parameters_that_are_given_act_all_the_same():
    frame = torch.rand(1, 3, 24, 32)
    params = Compose([Turbulence()]).sample(frame, seed=0)
    exact: dict[str, Any] = {"tolerance_px": None}
    for idle in (Turbulence(amplitude_range=STILL, **exact), Turbulence(p=0.0, **exact)):
        found = Compose([idle]).apply(frame, params).image
        assert_close(found, Turbulence(tolerance_px=None).apply(frame, params.children[0]).image)
        assert not torch.equal(found, frame)


def test_what_was_drawn_gives_the_same_bits_again():
    # The tolerance is shared by those that act, so that plans differ with those that do not.
    effect = Compose([LensDistortion(p=0.0), Turbulence(covariance="gaussian"), ThinPlateSpline()])
    frame = torch.rand(2, 3, 72, 96)
    made = effect.degrade(frame, seed=1)
    for params in (made.params, effect.sample(frame, seed=1)):
        again = effect.apply(frame, params)
        assert torch.equal(again.flow, made.flow)
        assert torch.equal(again.image, made.image)


def test_descent_starts_from_what_is_drawn_at_strength_zero():
    frame = torch.rand(1, 3, 24, 32)
    effect = Compose([Turbulence(amplitude_range=STILL)])
    params = effect.degrade(frame, seed=0).params
    amplitude = params.children[0].amplitude.requires_grad_()
    effect.apply(frame, params).image.square().sum().backward()
    assert amplitude.grad is not None
    assert amplitude.grad.abs().item() > 0


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_the_plan_names_it(tolerance):
    more = [make() for make in IDLE.values() if not isinstance(make(), Compose)]
    scene = Compose([LensDistortion(), UniformFog()], tolerance_px=tolerance).planned(72, 96, torch.float32)
    plan = Compose([LensDistortion(), *more, UniformFog()], tolerance_px=tolerance).planned(72, 96, torch.float32)
    assert (plan.plans[0], plan.plans[-1]) == scene.plans
    assert (plan.error_px, plan.resamples) == (scene.error_px, scene.resamples)
    told = [each.summary() for each in plan.plans[1:-1]]
    assert told == ["not computed (its strength is 0)"] * (len(more) - 1) + ["not computed (its p is 0)"]
