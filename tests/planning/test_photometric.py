import math
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, GroundPlaneDepth, HeterogeneousFog, LensFlare, LinearDepth, UniformFog, random
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.fields.depth import DepthProvider
from torchrefract.fields.perlin import draw_octave, perlin_noise
from torchrefract.fields.random_field import Motion
from torchrefract.planning.photometric import (
    FogErrorModel,
    PhotometricPlan,
    PhotometricRequest,
    noise_mean_variance,
    plan_image_fog,
)

SIZE = (48, 72)
# Two strong octaves and a faint one, with periods of 20, 40 and 80 px.
FAINT_OCTAVE: dict[str, Any] = {"scales": (20, 40, 80), "weights": (1, 1, 1e-4), "reference_width": 72.0}
# Effects of which a tolerance of 1 level leaves a part out.
SIMPLIFIED: dict[str, Any] = {
    "octave": (HeterogeneousFog, {"visibility_range": (100.0, 300.0), **FAINT_OCTAVE}),
    "octaves": (HeterogeneousFog, {"visibility_range": (1.5e5, 1.6e5), "deviation_range": (0.0, 0.0)}),
    "linear light": (HeterogeneousFog, {"visibility_range": (2e3, 3e3), "linear_light": True, **FAINT_OCTAVE}),
    "ensemble": (HeterogeneousFog, {"visibility_range": (100.0, 300.0), "mean": "ensemble", **FAINT_OCTAVE}),
    "contrast": (HeterogeneousFog, {"mode": "ray", "contrast_range": (0.0, 1e-4)}),
    "thin fog": (UniformFog, {"visibility_range": (3e5, 1e6)}),
    "thin linear fog": (UniformFog, {"visibility_range": (3e6, 1e7), "linear_light": True}),
    "thin image fog": (HeterogeneousFog, {"visibility_range": (1e6, 1e7)}),
    "thin volumetric fog": (
        HeterogeneousFog,
        {"visibility_range": (1e6, math.inf), "mode": "ray", "contrast_range": (0.1, 0.1)},
    ),
    "faint flare": (LensFlare, {"strength_range": (1e-3, 3e-3)}),
    "far flare": (
        LensFlare,
        {"center_y_range": (-2.0, -1.5), "radius_range": (0.15, 0.2)},
    ),
}
every_effect = pytest.mark.parametrize("name", SIMPLIFIED)
every_kind = pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog, LensFlare])


def effect_with(name: str, tolerance: float | None, **options: Any) -> Any:
    kind, arguments = SIMPLIFIED[name]
    return kind(**arguments, tolerance=tolerance, **options)


def picture(batch: int = 2) -> Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def levels_apart(first: Tensor, second: Tensor) -> float:
    return 255 * (first.double() - second.double()).abs().max().item()


def strength_of(params: Any) -> str:
    return "strength" if "strength" in params._fields else "visibility"


@every_effect
def test_simplified_images_and_maps_are_within_the_error_of_the_plan(name):
    exact, simplified = effect_with(name, None), effect_with(name, 1.0)
    plan = simplified.plan(*SIZE, dtype=torch.float64)
    assert plan.dropped
    assert 0 < plan.error <= 1
    for seed in range(4):
        expected, result = (effect.degrade(picture(4), seed=seed) for effect in (exact, simplified))
        assert 0 < levels_apart(result.image, expected.image) <= plan.error
        for map_name in ("transmission", "intensity"):
            if getattr(expected, map_name) is not None:
                assert levels_apart(getattr(result, map_name), getattr(expected, map_name)) <= 1


@pytest.mark.quick
@every_effect
def test_an_effect_that_cannot_be_seen_returns_the_image_itself(name):
    effect, image = effect_with(name, 1.0), picture()
    plan = effect.plan(*SIZE)
    degraded = effect.degrade(image, seed=3)
    assert (degraded.image is image) == plan.is_identity
    assert plan.is_identity == ("thin" in name or "flare" in name)
    assert ("light          not computed" in str(plan)) == plan.is_identity
    if plan.is_identity:
        assert torch.equal(Compose([effect]).degrade(image, seed=3).image, image)
        exact = effect.exact().degrade(image, seed=3)
        for map_name in ("transmission", "extinction", "intensity"):
            if getattr(exact, map_name) is not None:
                assert torch.equal(getattr(degraded, map_name), getattr(exact, map_name))


def test_a_sun_that_drifts_into_the_frame_is_planned_for_the_frame_that_is_asked_for():
    exact, effect = (effect_with("far flare", value, drift_y_range=(0.01, 0.01)) for value in (None, 1.0))
    image = picture(1)
    params = effect.sample(image, seed=3)
    for frame, is_seen in ((0, False), (10, False), (-100, True), (100, True)):
        result, expected = (each.apply(image, params, frame=frame) for each in (effect, exact))
        assert (result.image is not image) == is_seen
        assert levels_apart(result.image, expected.image) <= 1
    clip, expected = (
        each.apply(image[:, None].expand(-1, 200, -1, -1, -1), params, frame=0) for each in (effect, exact)
    )
    assert levels_apart(clip.image, expected.image) <= 1

    def shine(image: Tensor, params: Any) -> Tensor:
        return effect.apply(image, params, frame=100).image

    compiled = torch.compile(shine, fullgraph=True, backend="eager")
    assert levels_apart(compiled(image, params), exact.apply(image, params, frame=100).image) < 0.1


def test_the_plan_names_dropped_octaves():
    plan = effect_with("octave", 1.0).plan(*SIZE)
    assert plan.kept == ("octave of 20 px", "octave of 40 px")
    assert [name for name, _ in plan.dropped] == ["octave of 80 px"]
    assert "term dropped   octave of 80 px, which changes up to" in str(plan)
    assert "terms kept     octave of 20 px, octave of 40 px" in str(plan)


def test_heterogeneous_fog_without_octaves_is_uniform_fog():
    effect = effect_with("contrast", 1.0)
    assert effect.plan(*SIZE).octaves == ()
    params = effect.sample(picture(), seed=2)
    uniform = UniformFog().apply(picture(), UniformFog.params_type(*params[:4]))
    assert torch.equal(effect.apply(picture(), params).image, uniform.image)


class DimmingParams(NamedTuple):
    applied: Tensor
    share: Tensor
    is_identity = property(lambda self: self.share == 1)


class Dimming(PhotometricEffect):
    params_type, maps = DimmingParams, ("transmission",)

    def sample_params(self, stream: random.Stream, image: Tensor) -> DimmingParams:
        applied, values = self.draw_in_ranges(stream, [(0.4, 0.6)], image)
        return DimmingParams(applied, values[:, 0])

    def validate(self, params: Any, image: Tensor) -> None:
        pass

    def render(self, image: Tensor, params: Any, depth: Tensor | None) -> Rendered:
        t = params.share.view(-1, 1, 1, 1)
        return Rendered(image * t, lambda: t > 0, transmission=t)


def test_an_effect_without_error_bounds_is_computed_in_full():
    effect = Dimming(tolerance=1.0, p=0.5)
    plan = effect.plan(*SIZE)
    assert "no error bound is known for this effect" in str(plan)
    assert (plan.error, plan.is_identity) == (0, False)
    degraded = effect.degrade(picture(8), seed=1)
    params = degraded.params
    expected = torch.where(params.applied, params.share, 1).view(-1, 1, 1, 1)
    assert 0 < params.applied.sum() < 8
    assert torch.equal(degraded.image, picture(8) * expected)
    assert torch.equal(degraded.transmission, expected.expand(-1, 1, *SIZE))


@pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog])
def test_thin_fog_is_computed_for_a_depth_that_is_passed_in(kind):
    effect, depth = kind(visibility_range=(1e6, 1e6), tolerance=1.0), torch.full((2, 1, *SIZE), 1e6)
    assert effect.plan(*SIZE).is_identity
    result = effect.degrade(picture(), seed=3, depth=depth).image
    assert torch.equal(result, effect.exact().degrade(picture(), seed=3, depth=depth).image)
    assert not torch.equal(result, picture())


@every_effect
def test_parameters_outside_the_ranges_are_computed_exactly(name):
    effect, exact = effect_with(name, 1.0), effect_with(name, None)
    drawn = effect.degrade(picture(), seed=2)
    assert torch.equal(effect.apply(picture(), drawn.params).image, drawn.image)
    field = strength_of(drawn.params)
    outside = drawn.params._replace(**{field: torch.full_like(getattr(drawn.params, field), 50.0)})
    assert torch.equal(effect.apply(picture(), outside).image, exact.apply(picture(), outside).image)


@every_effect
def test_gradients_of_parameters_are_exact(name):
    params = effect_with(name, 1.0).sample(picture(), seed=2)
    field, gradients = strength_of(params), []
    for effect in (effect_with(name, 1.0), effect_with(name, None)):
        leaf = getattr(params, field).clamp(max=1e12).requires_grad_()
        image = effect.apply(picture(), params._replace(**{field: leaf})).image
        gradients.append(torch.autograd.grad(image.sum(), leaf)[0])
    assert gradients[1].any()
    assert torch.equal(*gradients)


def test_one_graph_takes_the_plan_as_a_constant():
    effect = effect_with("octave", 1.0)
    compiled = torch.compile(effect.degrade, fullgraph=True, backend="eager")
    expected = effect.degrade(picture(), seed=4).image
    assert_close(compiled(picture(), seed=torch.tensor(4)).image, expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("period", [7.0, 30.0, 200.0])
def test_the_mean_of_noise_over_a_frame_has_the_variance_of_its_bound(period):
    count = 400
    key = torch.randint(1 << 32, (count, 4), generator=torch.Generator().manual_seed(1))
    still = Motion(torch.zeros(count), torch.zeros(count, 2), torch.full((count,), math.inf))
    octave = draw_octave(key, 0, period=period, height=60, width=90, motion=still, dtype=torch.float64)
    variance = perlin_noise([octave], torch.ones(count, 1).double()).mean(dim=(1, 2, 3)).var().item()
    # The bound is that of the worst phase; the sampled variance of 400 has a deviation of 7 %.
    assert 0.1 * noise_mean_variance(period, 60, 90) <= variance <= 1.2 * noise_mean_variance(period, 60, 90)


def test_a_coarse_octave_is_kept_without_which_no_mean_has_a_bound():
    options: dict[str, Any] = {"scales": (3,), "weights": (1,), "scale_unit": "cells"}
    for visibility in (5.0, 30.0, 100.0):
        fog = HeterogeneousFog(visibility_range=(visibility, visibility), tolerance=0.5, **options)
        assert fog.plan(90, 160).octaves == (0,)


def test_octaves_are_kept_if_the_mean_over_the_frame_may_vanish():
    request = PhotometricRequest(*SIZE, 1.0, False)
    model = FogErrorModel(5.0, (0.8,), False, True, periods=(300.0, 400.0), weights=(1 - 1e-9, 1e-9))
    assert plan_image_fog(model, request).octaves == (0, 1)
    of_field = FogErrorModel(5.0, (0.8,), False, False, periods=(300.0, 400.0), weights=(1 - 1e-9, 1e-9))
    assert plan_image_fog(of_field, request).octaves == (0,)


@pytest.mark.parametrize(
    "effect",
    [UniformFog(visibility_range=(math.inf, math.inf)), LensFlare(strength_range=(0.0, 0.0))],
    ids=["fog", "flare"],
)
def test_ranges_without_any_effect_are_planned_as_identity(effect):
    assert effect.plan(*SIZE).is_identity
    assert "its strength is 0" in str(effect.plan(*SIZE))


@every_kind
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_an_invalid_tolerance_raises(kind, value):
    with pytest.raises(ValueError, match="tolerance must"):
        kind(tolerance=value)


@every_kind
def test_a_tolerance_below_rounding_raises(kind):
    rule = r"tolerance must be at least 0.00049 levels of 1/255 for images in float32 \(None is exact\), got 1e-05"
    with pytest.raises(ValueError, match=rule):
        kind(tolerance=1e-5).plan(*SIZE)
    with pytest.raises(ValueError, match=rule):
        kind(tolerance=1e-5)(picture().float())
    assert isinstance(kind(tolerance=1e-5).plan(*SIZE, dtype=torch.float64), PhotometricPlan)


def test_the_smallest_tolerance_is_larger_in_linear_light():
    with pytest.raises(ValueError, match=r"tolerance must be at least 0.0063 levels .* in linear light"):
        UniformFog(tolerance=1e-3, linear_light=True).plan(*SIZE)


@pytest.mark.parametrize("depth", [GroundPlaneDepth(far=math.inf), LinearDepth(max_depth=0.0)])
@pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog])
def test_infinite_and_zero_depth_have_a_plan(kind, depth):
    effect = kind(depth=depth, tolerance=0.5)
    result, exact = (one.degrade(picture(), seed=1).image for one in (effect, effect.exact()))
    assert levels_apart(result, exact) <= 0.5


def test_a_depth_provider_without_a_hash_has_a_plan():
    class Wall(DepthProvider):
        __hash__ = None  # pyright: ignore[reportAssignmentType]  # as for a class that only defines __eq__

        def __eq__(self, other: object) -> bool:
            return self is other

        def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
            return torch.full((1, 1, height, width), 2e3, dtype=dtype, device=device)

    assert not UniformFog(depth=Wall(), tolerance=1.0).plan(*SIZE).is_identity
