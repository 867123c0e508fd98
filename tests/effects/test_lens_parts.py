from dataclasses import replace
from typing import Any

import pytest
import torch

from torchrefract import Compose, DivergenceFree, LensDistortion, OneOf, Turbulence
from torchrefract.cameras import Camera
from torchrefract.effects.lens_parts import plan_of_lens
from torchrefract.effects.plan import Plan, PlanRequest
from torchrefract.fields.lens_bounds import lens_numbers
from torchrefract.presets import cheap_dashcam

SIZE = (256, 320)
TOLERANCE = 0.05
FOLDS = "barrel or pincushion"  # the strongest of its lenses do
FLEETS: dict[str, dict[str, Any]] = {
    "its own": {},
    "strong": {name: getattr(cheap_dashcam(4), name) for name in ("k1_range", "k2_range")},
    "near a fold": {name: getattr(cheap_dashcam(5), name) for name in ("k1_range", "k2_range")},
    FOLDS: {"k1_range": (-0.5, 0.5), "k2_range": (0.0, 0.0), "s1_range": (-0.01, 0.01)},
}
# Whether a draw holds a lens that folds is chance; that it is told has a test of its own below.
tells = pytest.mark.filterwarnings("ignore:the lens must not fold back:UserWarning")  # a fold is no failure here
every_fleet = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=tells) if name == FOLDS else name for name in FLEETS]
)
AIR: dict[str, Any] = {"covariance": "gaussian", "amplitude_range": (0.5, 1.0), "length_range": (30.0, 40.0)}


def fleet(name: str, tolerance: float | None = TOLERANCE, **more: Any) -> LensDistortion:
    return LensDistortion(**FLEETS[name], **more, tolerance_px=tolerance)


def image(batch: int) -> torch.Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def plans(effect: LensDistortion, batch: int, seed: int) -> list[Plan]:
    params = effect.sample(image(batch), seed=seed)
    found = effect.plans_of(params, effect.planned(*SIZE, torch.float32))
    assert found is not None
    return list(found)


@every_fleet
def test_every_lens_of_a_fleet_is_within_the_tolerance_and_most_are_on_lattices(name):
    effect, exact = fleet(name), fleet(name, None)
    whole, own = effect.planned(*SIZE, torch.float32), plans(effect, 24, seed=2)
    assert whole.parts
    assert whole.stride < 4
    assert sum(plan.stride >= 4 for plan in own) > 12
    found, expected = effect.degrade(image(24), seed=2), exact.degrade(image(24), seed=2)
    error = (found.flow - expected.flow).norm(dim=1).flatten(1).amax(dim=1)
    assert 1e-5 < error.max() <= TOLERANCE
    for off, plan in zip(error.tolist(), own, strict=True):
        assert off <= plan.error_px + 1e-3 <= whole.error_px + 1e-3
    assert torch.equal(found.restore_flow, expected.restore_flow)
    assert (found.valid != expected.valid).float().mean() < 1e-3


@every_fleet
def test_a_sample_is_bit_equal_alone_among_others_and_in_a_clip(name, on_threads):
    effect, keys = fleet(name, p=0.8), list(range(12))
    assert len(set(plans(effect, 12, seed=3))) > 1
    for threads in (1, 2):
        on_threads(threads)
        together = effect.degrade(image(12), seed=3, keys=keys)
        for key in keys:
            alone = effect.degrade(image(12)[key], seed=3, keys=[key])
            assert torch.equal(alone.image, together.image[key])
            assert torch.equal(alone.flow, together.flow[key])
            assert torch.equal(alone.valid, together.valid[key])
            assert torch.equal(alone.restore_valid, together.restore_valid[key])
    clips = torch.stack([image(12), image(12).flip(1)], dim=1)
    moving = effect.degrade(clips, seed=3, keys=keys)
    assert torch.equal(moving.image[:, 0], together.image)
    assert torch.equal(moving.flow[:, 1], together.flow)


@pytest.mark.parametrize("around", [Compose, OneOf])
@every_fleet
def test_so_it_is_in_a_composition(name, around):
    effects = [fleet(name, p=0.7), DivergenceFree(p=0.7), Turbulence(**AIR, p=0.7)]
    effect = around(effects, tolerance_px=TOLERANCE)
    together = effect.degrade(image(10), seed=5)
    for key in range(10):
        alone = effect.degrade(image(10)[key], seed=5, keys=[key])
        assert torch.equal(alone.image, together.image[key])
        assert torch.equal(alone.flow, together.flow[key])


@pytest.mark.parametrize("order", ["first", "last", "between"])
@every_fleet
def test_a_composite_with_a_fleet_is_within_the_tolerance(name, order):
    others = {"first": (), "between": (Turbulence(**AIR),), "last": (Turbulence(**AIR), DivergenceFree())}[order]
    rest = {"first": (Turbulence(**AIR), DivergenceFree()), "between": (DivergenceFree(),), "last": ()}[order]
    effects = [*others, fleet(name), *rest]
    effect, exact = Compose(effects, tolerance_px=TOLERANCE), Compose(effects, tolerance_px=None)
    plan = effect.planned(*SIZE, torch.float32)
    assert plan.error_px <= TOLERANCE
    found, expected = effect.degrade(image(8), seed=7), exact.degrade(image(8), seed=7)
    both = found.valid & expected.valid  # elsewhere a flow may lead to where a lens shows nothing
    off = (found.flow - expected.flow).norm(dim=1, keepdim=True)[both]
    assert 1e-5 < off.max() <= plan.error_px + 1e-3


def test_a_lens_of_a_fleet_that_folds_is_told():
    with pytest.warns(UserWarning, match="the lens must not fold back inside the frame"):
        found = fleet(FOLDS).degrade(image(24), seed=2)
    assert not found.valid.flatten(1).all(dim=1).all()
    with pytest.raises(ValueError, match="the lens must not fold back inside the frame"):
        fleet(FOLDS, strict=True).degrade(image(24), seed=2)


def test_gradients_of_the_lens_are_those_of_the_plan_for_all():
    effect, exact = fleet("its own"), fleet("its own", None)
    params = effect.sample(image(4), seed=2)
    slopes = []
    for one in (effect, exact):
        leaf = params.coefficients.clone().requires_grad_()
        one.apply(image(4), params._replace(coefficients=leaf)).flow.square().mean().backward()
        assert leaf.grad is not None
        slopes.append(leaf.grad)
    assert torch.allclose(*slopes, rtol=1e-3, atol=1e-3 * slopes[1].abs().max().item())


def test_where_nothing_is_read_the_plan_for_all_holds():
    effect = fleet("its own")
    params = effect.sample(image(3), seed=4)
    compiled = torch.compile(lambda image: effect.apply(image, params).flow, fullgraph=True, backend="aot_eager")
    exact = fleet("its own", None).apply(image(3), params).flow
    assert (compiled(image(3)) - exact).norm(dim=1).max() <= TOLERANCE


def test_a_plan_says_that_it_has_parts(capsys):
    effect = fleet("its own")
    plan = effect.plan(*SIZE)
    assert plan.parts
    assert plan.error_px == TOLERANCE
    assert "coarser where what is drawn allows it" in capsys.readouterr().out
    assert not effect.planned(96, 128, torch.float32).parts  # soon done
    assert not fleet("its own", None).planned(*SIZE, torch.float32).parts
    assert not LensDistortion(k1_range=(-0.1, -0.1), k2_range=(0.0, 0.0)).planned(*SIZE, torch.float32).parts


def test_the_plan_of_a_lens_is_that_of_its_part_of_the_ranges():
    effect = fleet("its own")
    ask = PlanRequest(*SIZE, TOLERANCE, double=False)
    params = effect.sample(image(200), seed=1)
    numbers = lens_numbers(params.coefficients, params.focal, params.center)
    strides = torch.tensor([plan_of_lens((effect._ranges(),), lens, ask).stride for lens in numbers.tolist()])
    mild = (params.coefficients[:, 0] > -0.2) & (params.focal[:, 0] > 1.0)
    strong = (params.coefficients[:, 0] < -0.3) & (params.focal[:, 0] < 0.75)
    assert mild.any()
    assert strong.any()
    assert strides[mild].min() > strides[strong].max()
    assert len(set(strides.tolist())) < 10  # plans are few


def test_each_lens_of_a_table_goes_by_itself():
    frame: dict[str, Any] = {"width": 320, "height": 256, "cx": 160.0, "cy": 128.0}
    mild = Camera(model="opencv", **frame, fx=300.0, fy=300.0, coefficients=(-0.1, 0.01, 0.0, 0.0))
    strong = replace(mild, fx=180.0, fy=180.0, coefficients=(-0.38, 0.08, 0.0, 0.0))
    effect, alone = (LensDistortion.from_lenses(table, tolerance_px=TOLERANCE) for table in ([mild, strong], [mild]))
    assert effect.planned(*SIZE, torch.float32).parts
    assert alone.planned(*SIZE, torch.float32).stride in {plan.stride for plan in plans(effect, 12, seed=0)}
    exact = LensDistortion.from_lenses([mild, strong], tolerance_px=None)
    off = effect.degrade(image(12), seed=0).flow - exact.degrade(image(12), seed=0).flow
    assert 1e-6 < off.norm(dim=1).max() <= TOLERANCE
