import copy
import math
from typing import Any, cast

import pytest
import torch
from helpers import assert_close_maps, assert_equal_maps, assert_graph_agrees, maps_of, random_image
from torch import Tensor
from torch.testing import assert_close

from torchrefract import (
    Compose,
    DivergenceFree,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    OneOf,
    RollingShutter,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
    warp,
)
from torchrefract.effects.base import Effect
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.warping.grid import inside
from torchrefract.warping.lattice import pixel_lattice

LENS: dict[str, Any] = {"k1_range": (-0.3, -0.2), "k2_range": (0.1, 0.2)}
NONE, CLEAR = (0.0, 0.0), (math.inf, math.inf)
# Effects that change nothing, by their ranges or by their probability.
IDENTITIES: dict[str, Effect] = {
    "turbulence": Turbulence(amplitude_range=NONE),
    "thin plate": ThinPlateSpline(amplitude_range=NONE),
    "divergence-free": DivergenceFree(amplitude_range=NONE),
    "lens": LensDistortion(k1_range=NONE, k2_range=NONE, p1_range=NONE, p2_range=NONE),
    "fog": UniformFog(visibility_range=CLEAR),
    "heterogeneous fog": HeterogeneousFog(visibility_range=CLEAR),
    "flare": LensFlare(strength_range=NONE),
    "p of 0": LensDistortion(p=0.0),
    "one of": OneOf([UniformFog(visibility_range=CLEAR), LensFlare(p=0.0)]),
    "composition with p of 0": Compose([LensDistortion(), UniformFog()], p=0.0),
}


def picture(*shape: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Return smooth images, which two samplings blur little."""
    coarse = torch.rand(*shape[:-2], 6, 8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    fine = torch.nn.functional.interpolate(coarse.view(-1, 1, 6, 8), shape[-2:], mode="bicubic").clamp(0, 1)
    return fine.view(shape).to(dtype)


def four_warps() -> list[WarpEffect]:
    return [
        Turbulence(amplitude_range=(0.4, 0.8), length_range=(30.0, 40.0), covariance="gaussian"),
        ThinPlateSpline(amplitude_range=(1.0, 2.0)),
        DivergenceFree(amplitude_range=(0.5, 1.0), length_range=(30.0, 40.0)),
        LensDistortion(**LENS, frame="pad"),
    ]


@pytest.mark.quick
def test_the_flow_is_the_composition_of_the_pure_flows_at_displaced_points():
    image = picture(2, 3, 48, 64, dtype=torch.float64)
    effect = Compose(four_warps(), tolerance_px=None)
    degraded = effect.degrade(image, seed=3)
    points = pixel_lattice(48, 64).points(dtype=torch.float64, device=image.device)
    # d_n = f_n(p), d_i = d_(i+1) + f_i(p + d_(i+1))
    flow = torch.zeros(2, 2, 48, 64, dtype=torch.float64)
    for child, params in zip(reversed(four_warps()), reversed(degraded.params.children), strict=True):
        plan = child.exact().plan(48, 64, dtype=torch.float64)
        flow = flow + child.warp_flow(params, plan).at(points.displaced(flow))[0]
    assert_close(degraded.flow, flow, rtol=0, atol=1e-9)
    assert_close(degraded.image, warp(image, flow)[0], rtol=0, atol=1e-9)


def undistort(x: Tensor, y: Tensor, params: Any) -> tuple[Tensor, Tensor]:
    """Return the point that a radial lens shows at a pixel, by bisection of the radius."""
    fx, fy = (params.focal[0] * 480).tolist()
    cx, cy = (239.5 + params.center[0, 0].item() * 480, 134.5 + params.center[0, 1].item() * 480)
    k1, k2 = params.coefficients[0, :2].tolist()
    u, v = (x - cx) / fx, (y - cy) / fy
    distorted = (u * u + v * v).sqrt()
    low, high = torch.zeros_like(distorted), torch.full_like(distorted, 4.0)
    for _ in range(60):
        r = (low + high) / 2
        is_below = r * (1 + k1 * r**2 + k2 * r**4) < distorted
        low, high = torch.where(is_below, r, low), torch.where(is_below, high, r)
    scale = torch.where(distorted > 0, low / distorted.clamp(min=1e-12), 1)
    return cx + fx * u * scale, cy + fy * v * scale


def test_the_composed_flow_of_two_radial_lenses_is_the_one_found_by_bisection():
    options = {"k2_range": (0.1, 0.1), "p1_range": NONE, "p2_range": NONE, "frame": "pad"}
    lenses = [LensDistortion(k1_range=(k, k), **options) for k in (-0.2, -0.1)]
    degraded = Compose(lenses, tolerance_px=None).degrade(torch.zeros(1, 1, 270, 480, dtype=torch.float64), seed=0)
    first, second = degraded.params.children
    y, x = torch.meshgrid(torch.arange(270.0).double(), torch.arange(480.0).double(), indexing="ij")
    expected = torch.stack(undistort(*undistort(x, y, second), first)) - torch.stack([x, y])
    assert degraded.flow.abs().max() > 10
    assert_close(degraded.flow[0], expected, rtol=0, atol=1e-6)


def test_the_restore_flow_restores_the_image_and_the_negative_flow_does_not():
    image = picture(2, 3, 96, 128, dtype=torch.float64)
    degraded = Compose(four_warps(), interpolation="bicubic").degrade(image, seed=3)
    valid = degraded.restore_valid
    assert valid.double().mean() > 0.8
    assert degraded.restore_residual[valid].max() < 0.05
    errors = []
    for flow in (degraded.restore_flow, -degraded.flow):
        restored, _ = warp(degraded.image, flow, interpolation="bicubic")
        errors.append((restored - image).square()[valid.expand_as(image)].mean().item())
    assert -10 * math.log10(errors[0]) > 45
    assert errors[1] > 4 * errors[0]


def test_fog_between_warps_keeps_its_place_and_its_map_moves_along():
    image, depth = picture(1, 3, 48, 64, dtype=torch.float64), 20 + 100 * picture(1, 1, 48, 64, dtype=torch.float64)
    lens, fog = LensDistortion(**LENS, padding="border"), UniformFog(visibility_range=(90, 90))
    spline = ThinPlateSpline(padding="border")
    effect = Compose([lens, fog, spline], tolerance_px=None)
    params = effect.sample(image, seed=3)
    degraded = effect.apply(image, params, depth=depth)
    bent = lens.exact().apply(image, params.children[0])
    near, _ = warp(depth, bent.flow, padding="border", interpolation="nearest")
    foggy = fog.apply(bent.image, params.children[1], depth=near)
    moved = spline.exact().apply(foggy.image, params.children[2])
    assert_close(degraded.image, moved.image, rtol=0, atol=1e-12)
    transmission, _ = warp(foggy.transmission, moved.flow, padding="border")
    assert_close(degraded.transmission, transmission, rtol=0, atol=1e-12)


@pytest.mark.quick
def test_transmissions_of_two_fogs_multiply_and_valid_needs_both():
    image = picture(1, 3, 32, 40, dtype=torch.float64)
    fogs = [UniformFog(visibility_range=(v, v), deviation_range=NONE) for v in (60.0, 100.0)]
    degraded = Compose(fogs).degrade(image, seed=1)
    alone = [fog.degrade(image, seed=1) for fog in fogs]
    assert_close(degraded.transmission, alone[0].transmission * alone[1].transmission)
    assert torch.equal(degraded.valid, alone[0].valid & alone[1].valid)
    assert degraded.flow is None
    assert degraded.restore_flow is None


@pytest.mark.quick
def test_a_composition_of_one_effect_equals_that_effect():
    image = picture(2, 3, 33, 47)
    for effect in (*four_warps(), UniformFog()):
        alone = Compose([effect])
        params = alone.sample(image, seed=5)
        together, single = alone.apply(image, params), effect.apply(image, params.children[0])
        assert_equal_maps(maps_of(together), maps_of(single))


@pytest.mark.quick
def test_nested_compositions_equal_the_flat_one():
    image = picture(2, 3, 33, 47)
    a, b, c = ThinPlateSpline(), UniformFog(), LensDistortion(**LENS)
    nested, flat = Compose([a, Compose([b, c])]), Compose([a, b, c])
    params = nested.sample(image, seed=5)
    flat_params = flat.sample(image, seed=5)._replace(children=(params.children[0], *params.children[1].children))
    result, expected = nested.apply(image, params), flat.apply(image, flat_params)
    assert_equal_maps(maps_of(result), maps_of(expected))


@pytest.mark.quick
def test_equal_effects_in_a_row_draw_different_parameters():
    lens = LensDistortion()
    nested = Compose([lens, lens, Compose([lens, lens])])
    first, second, inner = nested.sample(picture(4, 3, 8, 9), seed=5).children
    rows = torch.cat([params.coefficients for params in (first, second, *inner.children)])
    assert rows.unique(dim=0).shape[0] == 16


@pytest.mark.parametrize("p", [0.0, 0.5])
def test_samples_that_no_effect_is_applied_to_come_back_bit_for_bit(p):
    image = picture(16, 3, 21, 27)
    effect = Compose([LensDistortion(p=0.5), UniformFog(p=0.5), ThinPlateSpline(p=0.5)], p=p)
    params = effect.sample(image, seed=7)
    applied = torch.stack([child.applied for child in params.children]).any(dim=0)
    assert not (applied & ~params.applied).any()
    assert applied.any() == (p > 0)
    degraded = effect.apply(image, params)
    assert torch.equal(degraded.image[~applied], image[~applied])
    assert not degraded.flow[~applied].any()
    assert degraded.valid[~applied].all()
    assert (degraded.image != image).flatten(1).any(dim=1).tolist() == applied.tolist()


# Compositions whose effects pad in different ways and are drawn for a part of the samples only.
MIXED: dict[str, Compose] = {
    "Compose": Compose([ThinPlateSpline(p=0.5), UniformFog(p=0.5), Turbulence(p=0.5), LensDistortion(p=0.5)]),
    "OneOf": OneOf([LensDistortion(), UniformFog(), ThinPlateSpline(), DivergenceFree(interpolation="bicubic")]),
    "OneOf inside": Compose([OneOf([LensDistortion(), Turbulence()], p=0.7), ThinPlateSpline(p=0.5)], p=0.8),
}


@pytest.mark.parametrize("name", MIXED)
def test_a_sample_does_not_depend_on_batch_order_or_threads(name, on_threads):
    effect, image, keys = MIXED[name], picture(8, 3, 33, 47), torch.arange(8) * 2**33
    together = maps_of(effect.degrade(image, seed=7, keys=keys))
    for threads, rows in ((1, [3]), (3, [6, 1]), (2, [0])):
        on_threads(threads)
        part = maps_of(effect.degrade(image[rows], seed=7, keys=keys[rows]))
        assert_close_maps(part, {map_name: value[rows] for map_name, value in together.items()})


class CountingSpline(ThinPlateSpline):
    """Count the samples that a flow and its inverse are computed for."""

    rows: list[int]

    def flow(self, params, points, plan):
        self.rows.append(len(params.applied))
        return super().flow(params, points, plan)

    def inverse_flow(self, params, flow):
        self.rows.append(-len(flow))
        return super().inverse_flow(params, flow)


@pytest.mark.parametrize("frames", [1, 3])
def test_a_warp_is_computed_only_for_the_samples_that_it_moves(frames):
    spline = CountingSpline(tolerance_px=None)
    spline.rows = []
    image = picture(8, 3 * frames, 20, 30).view(8, frames, 3, 20, 30)
    degraded = OneOf([UniformFog(), LensDistortion(), spline, DivergenceFree()]).degrade(image, seed=1)
    num_applied = int(degraded.params.children[2].applied.sum())
    assert 0 < num_applied < 8
    assert spline.rows == [num_applied * frames]


@pytest.mark.quick
def test_maps_are_computed_once_when_they_are_read():
    spline = CountingSpline()
    spline.rows = []
    for effect in (spline, Compose([LensDistortion(), spline])):
        degraded = effect.degrade(picture(2, 3, 20, 30), seed=0)
        assert degraded.valid.any()
        assert min(spline.rows) > 0
        for _ in range(2):
            assert degraded.restore_flow.any()
            assert degraded.restore_valid.any()
        assert spline.rows.count(-2) == 1
        spline.rows.clear()


def test_a_gradient_of_parameters_leaves_the_other_samples_as_they_are():
    image = picture(6, 3, 20, 30).double()
    effect = OneOf([ThinPlateSpline(), DivergenceFree()], tolerance_px=None)
    params = effect.sample(image, seed=3)
    leaf = params.children[0].displacement.clone().requires_grad_()
    with_gradient = params._replace(children=(params.children[0]._replace(displacement=leaf), params.children[1]))
    degraded = effect.apply(image, with_gradient).image
    assert_close(degraded, effect.apply(image, params).image, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(degraded.square().sum(), leaf)
    assert (gradient != 0).flatten(1).any(dim=1).tolist() == params.children[0].applied.tolist()


def test_one_of_degrades_each_sample_by_the_effect_that_is_chosen_for_it():
    effect, image = MIXED["OneOf"], picture(12, 3, 33, 47)
    degraded = effect.degrade(image, seed=7)
    for child, params in zip(effect.effects, degraded.params.children, strict=True):
        alone = cast(Effect, child).apply(image, params)
        assert params.applied.any()
        assert_close(degraded.image[params.applied], alone.image[params.applied], rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.bfloat16])
def test_type_and_layout_are_kept(dtype):
    effect, scale = Compose([*four_warps(), UniformFog()]), 255 if dtype is torch.uint8 else 1
    image = random_image(2, 3, 20, 30, dtype=dtype).contiguous(memory_format=torch.channels_last)
    expected = effect.degrade(image.float() / scale, seed=7).image * scale
    result = effect.degrade(image, seed=7).image
    assert result.dtype == dtype
    step = 1.0 if dtype is torch.uint8 else max(torch.finfo(dtype).eps, 1e-5)
    assert_close(result.float(), expected, rtol=0, atol=step)
    assert result.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.quick
def test_one_of_chooses_one_effect_by_its_weight():
    effect = OneOf([LensDistortion(frame="pad"), UniformFog(), ThinPlateSpline()], weights=[1, 2, 5], p=0.8)
    params = effect.sample(torch.zeros(8000, 3, 1, 1), seed=2)
    applied = torch.stack([child.applied for child in params.children])
    assert torch.equal(applied.sum(dim=0), params.applied.long())
    share = applied.double().mean(dim=1)
    assert_close(share, 0.8 * torch.tensor([1, 2, 5]).double() / 8, rtol=0, atol=4 * 0.5 / 8000**0.5)


def test_gradients_reach_every_effect_and_the_image():
    image = picture(1, 2, 5, 7, dtype=torch.float64, seed=4)
    effect = Compose([ThinPlateSpline(amplitude_range=(0.3, 0.3)), UniformFog(airlight=0.7), LensDistortion()])
    params = effect.sample(image, seed=5)
    spline, fog, lens = params.children

    def degrade(image: Tensor, displacement: Tensor, visibility: Tensor, coefficients: Tensor) -> Tensor:
        children = (
            spline._replace(displacement=displacement),
            fog._replace(visibility=visibility),
            lens._replace(coefficients=coefficients),
        )
        return effect.apply(image, params._replace(children=children)).image

    inputs = (image, spline.displacement, fog.visibility, lens.coefficients)
    assert torch.autograd.gradcheck(degrade, [value.clone().requires_grad_() for value in inputs], fast_mode=True)


def test_valid_pixels_of_a_composition_lead_into_the_frame():
    effect = Compose([RollingShutter(speed_range=(150, 150), readout_range=(30, 30)), LensDistortion()])
    near = random_image(1, 1, 24, 32, seed=8) < 0.3  # the cubics between pixels overshoot at edges of depth
    degraded = effect.degrade(random_image(1, 3, 24, 32), seed=8, depth=torch.where(near, 3.0, 100.0))
    assert degraded.valid.double().mean() > 0.8
    assert (degraded.valid <= inside(degraded.flow)).all()


def test_an_empty_batch_stays_empty_also_where_gradients_are_needed():
    effect, image = Compose([Turbulence(), LensDistortion(**LENS)]), torch.zeros(0, 3, 8, 9)
    params = effect.sample(image, seed=7)
    first, second = params.children
    first = first._replace(amplitude=first.amplitude.clone().requires_grad_())
    second = second._replace(coefficients=second.coefficients.clone().requires_grad_())
    for name, value in maps_of(effect.apply(image, params._replace(children=(first, second)))).items():
        assert (value.shape[0], *value.shape[2:]) == (0, 8, 9), name


def test_one_graph_draws_and_degrades_as_eager_mode():
    choice = OneOf([LensFlare(p=0.7), ThinPlateSpline()])
    effect = Compose([ThinPlateSpline(padding="border", p=0.7), UniformFog(p=0.7), choice])
    assert_graph_agrees(effect, picture(4, 3, 24, 32))


def test_all_maps_can_be_read_in_one_graph():
    # The inverse of the one is in closed form, that of the other by Newton's method.
    effect, image = Compose([RollingShutter(), ThinPlateSpline()]), torch.rand(2, 3, 40, 56)

    def read(image: Tensor) -> list[Tensor]:
        degraded = effect.degrade(image, seed=3)
        flows = [degraded.image, degraded.flow, degraded.valid, degraded.restore_flow, degraded.restore_valid]
        return [*flows, degraded.restore_residual, *degraded.folding]

    compiled = torch.compile(read, fullgraph=True, backend="eager")
    for result, expected in zip(compiled(image), read(image), strict=True):
        # In a graph Newton's method cannot stop early.
        assert ((result.float() - expected.float()).abs() > 2e-3).float().mean() <= 0.005


@pytest.mark.quick
def test_effects_may_come_from_an_iterator():
    image, effects = picture(1, 3, 8, 9), [LensDistortion(), UniformFog()]
    assert len(Compose(iter(effects)).effects) == len(OneOf(iter(effects)).effects) == 2
    assert torch.equal(
        Compose(iter(effects)).degrade(image, seed=1).image, Compose(effects).degrade(image, seed=1).image
    )
    with pytest.raises(ValueError, match="effects must be at least one effect, got none"):
        Compose(iter([]))


@pytest.mark.quick
def test_invalid_effects_and_weights_raise():
    with pytest.raises(TypeError, match="effects must be a list of effects, got UniformFog"):
        Compose(UniformFog())  # pyright: ignore[reportArgumentType]  # the invalid argument
    with pytest.raises(TypeError, match="effects must be effects of torchrefract, got Identity"):
        Compose([torch.nn.Identity()])  # pyright: ignore[reportArgumentType]  # the invalid argument
    with pytest.raises(TypeError, match="effects must be effects of torchrefract, got the class UniformFog"):
        Compose([UniformFog])  # pyright: ignore[reportArgumentType]  # the invalid argument
    for weights, rule in (([1.0], "weights must be one number for each of 2"), ([1.0, -1.0], "weights must be")):
        with pytest.raises(ValueError, match=rule):
            OneOf([LensDistortion(), UniformFog()], weights=weights)


@pytest.mark.quick
def test_params_of_other_effects_or_batches_raise():
    image, effect = picture(2, 3, 8, 9), Compose([LensDistortion(), UniformFog()])
    params = effect.sample(image, seed=1)
    with pytest.raises(TypeError, match="params must be ComposeParams, got LensParams"):
        effect.apply(image, params.children[0])
    with pytest.raises(ValueError, match=r"params\.children must be those of 2 effects, got 1"):
        effect.apply(image, params._replace(children=params.children[:1]))
    with pytest.raises(ValueError, match=r"params\.applied must have .* be bool of shape \(B,\), got torch\.float32"):
        effect.apply(image, params._replace(applied=torch.ones(2)))
    with pytest.raises(ValueError, match=r"params\.applied must have one row for each of the 3 images"):
        effect.apply(picture(3, 3, 8, 9), params)
    fog = params.children[1]._replace(visibility=torch.zeros(2))
    with pytest.raises(ValueError, match=r"params\.visibility must be above 0"):
        effect.apply(image, params._replace(children=(params.children[0], fog)))


def test_the_outermost_composition_that_has_an_option_decides_it():
    image = picture(2, 3, 24, 32)
    spline = ThinPlateSpline(amplitude_range=(4.0, 6.0), padding="zeros", interpolation="bicubic")
    identity = LensDistortion(p=0)

    def degrade(effect: Effect) -> Tensor:
        return effect.degrade(image, seed=4).image

    options: dict[str, Any] = {"padding": "border", "interpolation": "nearest", "backend": "torch"}
    decided = copy.copy(spline)
    vars(decided).update(options)
    expected = degrade(Compose([identity, Compose([decided])]))
    assert not torch.equal(expected, degrade(Compose([identity, Compose([spline])])))
    assert torch.equal(degrade(Compose([identity, Compose([spline], **options)])), expected)
    # The outermost composition leaves the interpolation to the inner one.
    outer = {name: options[name] for name in ("padding", "backend")}
    inner = Compose([spline], interpolation="nearest", padding="reflection")
    expected = degrade(Compose([identity, Compose([Compose([decided])])]))
    assert torch.equal(degrade(Compose([identity, Compose([inner], **outer)])), expected)
    assert torch.equal(degrade(Compose([identity, Compose([inner])], **outer)), expected)


def test_options_of_one_of_hold_inside_a_composition():
    image = picture(8, 3, 24, 32)
    effects = [LensDistortion(**LENS), ThinPlateSpline(amplitude_range=(4.0, 6.0))]
    choice = OneOf(effects, padding="border")
    nested = Compose([choice])
    params = nested.sample(image, seed=2)
    assert all(child.applied.any() for child in params.children[0].children)
    expected = choice.apply(image, params.children[0])
    assert torch.equal(nested.apply(image, params).image, expected.image)
    assert not torch.equal(expected.image, OneOf(effects).apply(image, params.children[0]).image)


@pytest.mark.quick
@pytest.mark.parametrize("name", IDENTITIES)
def test_an_identity_in_a_composition_changes_no_map(name):
    image = torch.rand(2, 3, 24, 32)
    effect = IDENTITIES[name]
    assert torch.equal(effect(image), image)
    around = Compose([LensDistortion(), effect, Compose([UniformFog()])])
    degraded = around.degrade(image, seed=1, keys=[5, 9])
    flare = LensFlare(p=0.0)  # draws for the same position
    without = Compose([LensDistortion(), flare, Compose([UniformFog()])]).degrade(image, seed=1, keys=[5, 9])
    assert torch.equal(degraded.image, without.image)
    shared = maps_of(degraded).keys() & maps_of(without).keys()
    assert shared >= {"flow", "valid", "restore_flow", "restore_valid", "transmission"}
    assert_close_maps(*({key: maps_of(result)[key] for key in shared} for result in (degraded, without)))


@pytest.mark.quick
def test_a_composition_of_identities_returns_the_image_itself():
    image = torch.rand(2, 3, 24, 32)
    degraded = Compose(list(IDENTITIES.values())).degrade(image, seed=2)
    assert degraded.image is image
    for name, value in {"flow": 0, "restore_flow": 0, "valid": 1, "restore_valid": 1, "transmission": 1}.items():
        result = getattr(degraded, name)
        assert result.shape == (2, 2 if "flow" in name else 1, 24, 32), name
        assert (result == value).all(), name
    assert (degraded.intensity == 0).all()
    assert (degraded.extinction == 0).all()


@pytest.mark.quick
@pytest.mark.parametrize("effect", [Turbulence(amplitude_range=NONE), Turbulence(p=0.0)])
def test_given_parameters_are_applied_whatever_the_ranges(effect):
    image = torch.rand(1, 3, 24, 32)
    params = Compose([Turbulence()]).sample(image, seed=0)
    degraded = Compose([effect], tolerance_px=None).apply(image, params).image
    assert_close(degraded, Turbulence(tolerance_px=None).apply(image, params.children[0]).image)
    assert not torch.equal(degraded, image)


@pytest.mark.quick
def test_an_optimizer_can_start_at_strength_zero():
    image = torch.rand(1, 3, 24, 32)
    effect = Compose([Turbulence(amplitude_range=NONE)])
    params = effect.degrade(image, seed=0).params
    amplitude = params.children[0].amplitude.requires_grad_()
    effect.apply(image, params).image.square().sum().backward()
    assert amplitude.grad is not None
    assert amplitude.grad.abs().item() > 0


def test_effects_that_share_a_function_see_the_frame_before_the_fog_once_and_its_depth_moves_along():
    seen: list[Tensor] = []

    def depth(image: Tensor) -> Tensor:
        seen.append(image.clone())
        return 5 + 100 * image.mean(dim=1, keepdim=True)

    fog = UniformFog(visibility_range=(20.0, 20.0), depth=depth)
    effect, image = Compose([fog, Turbulence(depth=depth), RollingShutter(depth=depth)]), random_image(2, 3, 40, 60)
    effect.degrade(image, seed=1)
    assert len(seen) == 1
    assert torch.equal(seen[0], image)
    warp = Turbulence(depth=depth)
    for effects in ([fog, warp], [fog, warp, fog], [warp, fog, warp, fog]):
        effect = Compose(effects)
        given = effect.degrade(image, seed=1, depth=depth(image))
        seen.clear()
        degraded = effect.degrade(image, seed=1)
        assert len(seen) == 1
        assert_close(degraded.image, given.image)
        assert_close(degraded.flow, given.flow)
