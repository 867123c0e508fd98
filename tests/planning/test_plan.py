"""Plans of single warps: the flow stays within the tolerance, and the plan says how."""

import math
from copy import copy
from dataclasses import replace
from typing import Any

import pytest
import tolerance
import torch
from helpers import floating_leaves
from torch.testing import assert_close

from torchrefract import (
    Camera,
    Compose,
    DivergenceFree,
    LensDistortion,
    OneOf,
    Rectification,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
)
from torchrefract.effects.warp_effect import WarpEffect

SIZE = (96, 144)
CAMERA = Camera(width=144, height=96, fx=130.0, fy=130.0, cx=70.0, cy=48.0, coefficients=(-0.25, 0.1, 1e-3, -1e-3))
WARPS: dict[str, tuple[type[WarpEffect], dict[str, Any]]] = {
    "lens": (LensDistortion, {"k2_range": (0.09, 0.12), "focal_range": (0.9, 1.1)}),
    "rectification": (Rectification, {"camera": CAMERA}),
    "thin plate": (ThinPlateSpline, {"amplitude_range": (0.5, 1.0)}),
    "turbulence": (Turbulence, {"covariance": "gaussian"}),
    "rough turbulence": (Turbulence, {"length_range": (10.0, 20.0), "aperture_range": (3.0, 4.0)}),
    "divergence-free": (DivergenceFree, {"amplitude_range": (1.0, 2.0)}),
}
NONE = (0.0, 0.0)
# Warps that move pixels by less than 0.1 px.
INVISIBLE: list[WarpEffect] = [
    LensDistortion(k1_range=(-1e-6, 1e-6), k2_range=NONE, p1_range=NONE, p2_range=NONE, tolerance_px=0.1),
    ThinPlateSpline(amplitude_range=(0.0, 1e-4), tolerance_px=0.1),
    Turbulence(covariance="gaussian", amplitude_range=(0.0, 1e-3), tolerance_px=0.1),
    DivergenceFree(amplitude_range=(0.0, 1e-3), tolerance_px=0.1),
]
every_warp = pytest.mark.parametrize("name", WARPS)


def effect_with(name: str, tolerance_px: float | None, **options: Any) -> WarpEffect:
    kind, arguments = WARPS[name]
    return kind(**arguments, tolerance_px=tolerance_px, **options)


def picture(batch: int = 2) -> torch.Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("name", tolerance.CONFIGURATIONS)
def test_random_configurations_stay_within_their_tolerance(name):
    for seed in range(1000, 1004 if name == "Compose" else 1008):
        trial = tolerance.attempt(name, seed, (160, 240))
        assert 0 <= trial.share <= 1, trial
        assert 0 <= trial.restore_share <= 1, trial


@pytest.mark.quick
@every_warp
def test_a_larger_tolerance_gives_a_coarser_lattice_and_is_used(name):
    plans = [effect_with(name, px).plan(*SIZE) for px in (0.01, 0.1, 1.0)]
    strides = [plan.stride for plan in plans]
    assert strides == sorted(strides)
    assert strides[-1] > max(strides[0], 1)
    exact, coarse = (effect_with(name, px).degrade(picture(), seed=1).flow for px in (None, 1.0))
    assert 0.003 < (exact - coarse).norm(dim=1).amax() <= plans[-1].error_px <= 1


OUTSIDE: dict[str, WarpEffect] = {
    "lens": LensDistortion(k1_range=(-0.4, -0.38), k2_range=(0.1, 0.1)),
    "thin plate": ThinPlateSpline(lattice=(3, 3)),
    "turbulence": Turbulence(covariance="gaussian", length_range=(8.0, 8.0)),
    "rough turbulence": Turbulence(length_range=(30.0, 30.0), aperture_range=(3.0, 4.0)),
    "divergence-free": DivergenceFree(length_range=(15.0, 15.0)),
    "rectification": Rectification(replace(CAMERA, coefficients=(-0.25, 0.1, 1e-3, 1e-3))),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_parameters_outside_the_ranges_are_computed_exactly(name):
    params = OUTSIDE[name].sample(picture(), seed=2)
    flow = effect_with(name, 0.1).apply(picture(), params).flow
    assert torch.equal(flow, effect_with(name, None).apply(picture(), params).flow)


@every_warp
def test_gradients_agree_with_those_of_the_exact_flow_within_the_tolerance(name):
    image = picture().double()
    params = effect_with(name, 0.1).sample(image, seed=2)
    leaves = {field: value for field, value in floating_leaves(params).items() if field != "frame"}
    weight = torch.rand(2, 2, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gradients = []
    for effect in (effect_with(name, 0.1), effect_with(name, None)):
        flow = effect.apply(image, params._replace(**leaves)).flow
        gradients.append(torch.autograd.grad((weight * flow).mean(), list(leaves.values()), materialize_grads=True))
    for coarse, exact in zip(*gradients, strict=True):
        assert coarse.isfinite().all()
        assert_close(coarse, exact, rtol=0, atol=0.05 * exact.abs().max().item() + 1e-9)


@every_warp
def test_clips_stay_within_the_tolerance(name):
    clip = picture(6).view(2, 3, 3, *SIZE)
    exact, coarse = (effect_with(name, px).degrade(clip, seed=2).flow for px in (None, 0.1))
    assert (coarse - exact).norm(dim=2).amax() <= 0.1


def test_graphs_of_one_kind_of_effect_have_plans_of_their_own():
    image, flows = picture().double(), []
    for effect in (effect_with("thin plate", 1.0), effect_with("thin plate", None)):
        compiled = torch.compile(effect.degrade, fullgraph=True, backend="eager")
        flows.append(compiled(image, seed=torch.tensor(3)).image)
        assert_close(flows[-1], effect.degrade(image, seed=3).image, rtol=0, atol=1e-5)
    assert not torch.equal(*flows)


@pytest.mark.quick
def test_the_plan_names_kept_and_dropped_terms():
    effect = LensDistortion(
        k1_range=(-0.2, -0.2), k2_range=(0.05, 0.05), k3_range=(0.0, 1e-6), s1_range=(-1e-7, 1e-7), tolerance_px=0.1
    )
    plan = effect.plan(*SIZE)
    # Terms are dropped from the last to the first: thin prism, decentering, then the highest powers of the radius.
    assert plan.kept == ("k1", "k2", "k3", "p1", "p2")
    assert [name for name, _ in plan.dropped] == ["s1"]
    assert all(0 < moved < 0.1 for _, moved in plan.dropped)
    assert "term dropped   s1, which moves up to" in str(plan)
    assert f"every {plan.stride} px" in str(plan)


@pytest.mark.quick
@pytest.mark.parametrize("effect", INVISIBLE, ids=lambda effect: type(effect).__name__)
def test_a_warp_below_the_tolerance_returns_the_image_itself(effect):
    image = picture()
    plan = effect.plan(*SIZE)
    assert plan.is_identity
    assert "it moves less than the tolerance" in str(plan)
    degraded = effect.degrade(image, seed=3)
    assert degraded.image is image
    assert not degraded.flow.any()
    assert torch.equal(Compose([effect]).degrade(image, seed=3).image, image)
    exact = effect.exact().degrade(image.double(), seed=3)
    assert 0 < exact.flow.norm(dim=1).max() <= plan.error_px


@pytest.mark.quick
@pytest.mark.parametrize("kind", [LensDistortion, Compose, OneOf])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_an_invalid_tolerance_raises(kind, value):
    arguments = () if kind is LensDistortion else ([LensDistortion()],)
    with pytest.raises(ValueError, match="tolerance_px must"):
        kind(*arguments, tolerance_px=value)


@pytest.mark.quick
@pytest.mark.parametrize("effect", [LensDistortion(tolerance_px=1e-5), Compose([DivergenceFree()], tolerance_px=1e-5)])
def test_a_tolerance_below_rounding_raises_and_names_the_smallest_one(effect):
    rule = r"tolerance_px must be at least 0.00\d+ px for float32 positions in a frame of 1920 x 1080 px .* got 1e-05"
    with pytest.raises(ValueError, match=rule):
        effect.plan(1080, 1920)
    with pytest.raises(ValueError, match=rule):
        effect(torch.zeros(1, 1, 1080, 1920))
    assert effect.plan(1080, 1920, dtype=torch.float64).error_px <= 1e-5


@pytest.mark.quick
@pytest.mark.parametrize("kind", [LensDistortion, ThinPlateSpline, Turbulence, DivergenceFree, Compose])
def test_the_default_tolerance_is_exact_in_frames_whose_rounding_exceeds_it(kind):
    effect = kind([DivergenceFree()]) if kind is Compose else kind()
    assert effect.tolerance_px == 0.02
    exact = copy(effect)
    exact.tolerance_px = None
    width = math.ceil(0.01 / (getattr(effect, "rounding_ulps", 4) * 2.0**-24)) + 1  # rounding is half of the tolerance
    large = effect.plan(2, width)
    assert large.error_px == 0
    assert str(large).splitlines()[2:] == str(exact.plan(2, width)).splitlines()[2:]
    assert effect.plan(2, width - 3).tolerance_px == 0.02


@pytest.mark.quick
@pytest.mark.parametrize("effect", [LensDistortion(), Compose([LensDistortion()]), UniformFog()])
@pytest.mark.parametrize(("height", "width"), [(0, 10), (10, 0), (-1, 10)])
def test_a_plan_for_an_empty_frame_raises(effect, height, width):
    with pytest.raises(ValueError, match="must be at least 1"):
        effect.plan(height, width)


@pytest.mark.filterwarnings("ignore:.*length must fit")
@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 50), (40, 1), (7, 11)])
@pytest.mark.parametrize("name", [name for name in WARPS if name != "rectification"])
def test_small_frames_keep_the_tolerance(name, height, width):
    image = torch.rand(2, 1, height, width)
    exact, coarse = (effect_with(name, px).degrade(image, seed=3).flow for px in (None, 0.1))
    assert (exact - coarse).norm(dim=1).amax() <= 0.1
