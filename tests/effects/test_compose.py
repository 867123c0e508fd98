import copy
import math
import pickle
from functools import reduce
from typing import Any, cast

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from torchrefract.effects.refraction import WarpEffect

from torchrefract import (
    Compose,
    Degraded,
    DivergenceFree,
    LensDistortion,
    OneOf,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
    compose_flows,
    warp,
)
from torchrefract.effects.base import Effect

MAPS = ("image", "flow", "valid", "restore_flow", "restore_valid", "restore_residual", "transmission", "intensity")
LENS: dict[str, Any] = {"k1_range": (-0.3, -0.2), "k2_range": (0.1, 0.2)}


def picture(*shape: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Smooth, so that looking it up twice blurs little."""
    coarse = torch.rand(*shape[:-2], 6, 8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    fine = torch.nn.functional.interpolate(coarse.view(-1, 1, 6, 8), shape[-2:], mode="bicubic").clamp(0, 1)
    return fine.view(shape).to(dtype)


def warps() -> list[WarpEffect]:
    return [
        Turbulence(amplitude_range=(0.4, 0.8), length_range=(30.0, 40.0), covariance="gaussian"),
        ThinPlateSpline(amplitude_range=(1.0, 2.0)),
        DivergenceFree(amplitude_range=(0.5, 1.0), length_range=(30.0, 40.0)),
        LensDistortion(**LENS),
    ]


def maps(degraded: Degraded) -> dict[str, Tensor]:
    return {name: getattr(degraded, name) for name in MAPS if getattr(degraded, name) is not None}


def interior(value: Tensor, margin: int) -> Tensor:
    return value[..., margin:-margin, margin:-margin]


def test_one_look_up_shows_what_many_show():
    image = picture(2, 3, 96, 128, dtype=torch.float64)
    one_way: dict[str, Any] = {"padding": "border", "interpolation": "bicubic"}
    effect = Compose(warps(), **one_way)
    params = effect.sample(image, seed=3)
    together, step = effect.apply(image, params), image
    for child, own in zip(effect.effects, params.children, strict=True):
        step = Compose([cast(Effect, child)], **one_way).apply(step, params._replace(children=(own,))).image
    valid = together.valid.expand_as(image)
    assert valid.double().mean() > 0.6
    error = (together.image - step)[valid]
    # A bicubic look-up is off by a thousandth here and there, four of them by a little more.
    assert error.square().mean().sqrt() < 3e-3
    assert error.abs().max() < 3e-2


def test_the_flow_is_the_composite_of_the_flows():
    image, effects = picture(2, 3, 48, 64), warps()
    effect = Compose(effects, tolerance_px=None)
    params = effect.sample(image, seed=3)
    flows = [child.flow(own, height=48, width=64)[0] for child, own in zip(effects, params.children, strict=True)]
    # From the last to the first, so that each flow is read once.
    flow = reduce(lambda then, first: compose_flows(first, then), reversed(flows))
    found = effect.apply(image, params)
    assert torch.equal(found.flow, flow)
    assert torch.equal(found.image, warp(image, flow)[0])


def test_analytic_flows_compose_to_2_thousandths_of_a_pixel():
    lens = [
        LensDistortion(k1_range=(k, k), k2_range=(0.1, 0.1), p1_range=(0, 0), p2_range=(0, 0)) for k in (-0.2, -0.1)
    ]
    image = torch.zeros(1, 1, 540, 960, dtype=torch.float64)
    effect = Compose(lens, tolerance_px=None)
    params = effect.sample(image, seed=0)
    first, then = params.children
    # The second lens looks up at q, and the first lens looks up from there, both by their own exact inverse.
    y, x = torch.meshgrid(torch.arange(540.0).double(), torch.arange(960.0).double(), indexing="ij")
    expected = _undistorted(*_undistorted(x, y, then), first)
    found = effect.apply(image, params)
    inside = interior(found.valid, 2)[0, 0]
    error = torch.stack([x + found.flow[0, 0] - expected[0], y + found.flow[0, 1] - expected[1]]).norm(dim=0)
    assert inside.double().mean() > 0.5
    assert interior(error, 2)[inside].max() < 2e-3


def _undistorted(x: Tensor, y: Tensor, params) -> tuple[Tensor, Tensor]:
    """Where a radial lens looks a pixel up, by bisection in the radius."""
    fx, fy = (params.focal[0] * 960).tolist()
    cx, cy = (479.5 + params.center[0, 0].item() * 960, 269.5 + params.center[0, 1].item() * 960)
    k1, k2 = params.coefficients[0, :2].tolist()
    u, v = (x - cx) / fx, (y - cy) / fy
    r_d = (u * u + v * v).sqrt()
    low, high = torch.zeros_like(r_d), torch.full_like(r_d, 4.0)
    for _ in range(60):
        r = (low + high) / 2
        below = r * (1 + k1 * r**2 + k2 * r**4) < r_d
        low, high = torch.where(below, r, low), torch.where(below, high, r)
    scale = torch.where(r_d > 0, low / r_d.clamp(min=1e-12), 1)
    return cx + fx * u * scale, cy + fy * v * scale


def test_the_flow_back_brings_the_image_back():
    image = picture(2, 3, 96, 128, dtype=torch.float64)
    found = Compose(warps(), interpolation="bicubic").degrade(image, seed=3)
    restored, _ = warp(found.image, found.restore_flow, interpolation="bicubic")
    valid = found.restore_valid
    assert valid.double().mean() > 0.8
    assert found.restore_residual[valid].max() < 0.05
    error = (restored - image).square()[valid.expand_as(image)].mean()
    assert -10 * math.log10(error) > 45
    negated, _ = warp(found.image, -found.flow, interpolation="bicubic")
    assert (negated - image).square()[valid.expand_as(image)].mean() > 4 * error


def test_fog_between_warps_keeps_its_place_and_its_map_moves_along():
    image, depth = picture(1, 3, 48, 64, dtype=torch.float64), 20 + 100 * picture(1, 1, 48, 64, dtype=torch.float64)
    before, fog, after = LensDistortion(**LENS), UniformFog(visibility_range=(90, 90)), ThinPlateSpline()
    effect = Compose([before, fog, after], padding="border", tolerance_px=None)
    params = effect.sample(image, seed=3)
    found = effect.apply(image, params, depth=depth)
    flows = [child.flow(params.children[i], height=48, width=64)[0] for i, child in ((0, before), (2, after))]
    bent, _ = warp(image, flows[0], padding="border")
    near, _ = warp(depth, flows[0], padding="border", interpolation="nearest")
    misty = fog.apply(bent, params.children[1], depth=near)
    assert_close(found.image, warp(misty.image, flows[1], padding="border")[0], rtol=0, atol=1e-12)
    assert_close(found.transmission, warp(misty.transmission, flows[1], padding="border")[0], rtol=0, atol=1e-12)
    assert_close(found.flow, compose_flows(*flows), rtol=0, atol=1e-12)


def test_two_fogs_let_through_the_product_and_are_not_valid_where_either_is_not():
    image = picture(1, 3, 32, 40, dtype=torch.float64)
    fogs = [UniformFog(visibility_range=(v, v), deviation_range=(0, 0)) for v in (60.0, 100.0)]
    found = Compose(fogs).degrade(image, seed=1)
    alone = [fog.degrade(image, seed=1) for fog in fogs]
    assert_close(found.transmission, alone[0].transmission * alone[1].transmission)
    assert torch.equal(found.valid, alone[0].valid & alone[1].valid)
    assert found.flow is None
    assert found.restore_flow is None


def test_a_composition_of_one_is_that_effect():
    image = picture(2, 3, 33, 47)
    for effect in (*warps(), UniformFog()):
        alone = Compose([effect])
        params = alone.sample(image, seed=5)
        found, expected = maps(alone.apply(image, params)), maps(effect.apply(image, params.children[0]))
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert torch.equal(found[name], value), name


def test_nested_compositions_are_flat_to_the_image():
    image = picture(2, 3, 33, 47)
    a, b, c = ThinPlateSpline(), UniformFog(), LensDistortion(**LENS)
    nested, flat = Compose([a, Compose([b, c])]), Compose([a, b, c])
    params = nested.sample(image, seed=5)
    own = flat.sample(image, seed=5)._replace(children=(params.children[0], *params.children[1].children))
    found, expected = maps(nested.apply(image, params)), maps(flat.apply(image, own))
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


def test_equal_effects_in_a_row_have_draws_of_their_own():
    lens = LensDistortion()
    nested = Compose([lens, lens, Compose([lens, lens])])
    params = nested.sample(picture(4, 3, 8, 9), seed=5)
    first, second, inner = params.children
    rows = torch.cat([p.coefficients for p in (first, second, *inner.children)])
    assert rows.unique(dim=0).shape[0] == 16


@pytest.mark.parametrize("p", [0.0, 0.5])
def test_samples_that_are_left_alone_come_back_bit_for_bit(p):
    image = picture(16, 3, 21, 27)
    effect = Compose([LensDistortion(p=0.5), UniformFog(p=0.5), ThinPlateSpline(p=0.5)], p=p)
    params = effect.sample(image, seed=7)
    drawn = torch.stack([child.applied for child in params.children]).any(dim=0)
    assert not (drawn & ~params.applied).any()
    assert drawn.any() == (p > 0)
    found = effect.apply(image, params)
    assert torch.equal(found.image[~drawn], image[~drawn])
    assert not found.flow[~drawn].any()
    assert found.valid[~drawn].all()
    assert (found.image != image).flatten(1).any(dim=1).tolist() == drawn.tolist()


def test_a_sample_does_not_depend_on_the_batch_around_it():
    image, keys = picture(8, 3, 33, 47), torch.arange(8) * 2**33
    effect = Compose([*warps(), UniformFog(p=0.5), OneOf(warps(), p=0.7)], p=0.8)
    together = maps(effect.degrade(image, seed=7, keys=keys))
    for rows in ([3], [6, 1]):
        some = maps(effect.degrade(image[rows], seed=7, keys=keys[rows]))
        for name, value in together.items():
            assert torch.equal(some[name], value[rows]), name


def several() -> list[Compose]:
    """Compositions whose effects pad in different ways and are drawn for some samples only."""
    return [
        Compose([ThinPlateSpline(p=0.5), UniformFog(p=0.5), Turbulence(p=0.5), LensDistortion(p=0.5)]),
        OneOf([LensDistortion(), UniformFog(), ThinPlateSpline(), DivergenceFree(interpolation="bicubic")]),
        Compose([OneOf([LensDistortion(), Turbulence()], p=0.7), ThinPlateSpline(p=0.5)], p=0.8),
    ]


SEVERAL = ["Compose", "OneOf", "OneOf inside"]


@pytest.mark.parametrize("which", range(3), ids=SEVERAL)
def test_a_sample_does_not_depend_on_what_others_draw(which):
    effect, image, keys = several()[which], picture(12, 3, 33, 47), torch.arange(12) * 2**33
    together = maps(effect.degrade(image, seed=7, keys=keys))
    for i in range(12):
        alone = maps(effect.degrade(image[i], seed=7, keys=keys[[i]]))
        for name, value in together.items():
            assert torch.equal(alone[name], value[i]), (i, name)


class Counted(ThinPlateSpline):
    """Counts the samples that a flow, and a flow back, is computed for."""

    rows: list[int]

    def flow(self, params, *, height, width):
        self.rows.append(len(params.applied))
        return super().flow(params, height=height, width=width)

    def undo(self, params, flow):
        self.rows.append(len(flow))
        return super().undo(params, flow)


class Fog(UniformFog):
    """Counts the rows that are put into fog."""

    rows: list[int]

    def shade(self, image, params, depth):
        self.rows.append(len(image))
        return super().shade(image, params, depth)


@pytest.mark.parametrize("frames", [1, 3])
def test_nothing_is_computed_for_samples_that_an_effect_leaves_alone(frames):
    plate, fog = Counted(tolerance_px=None), Fog(depth=None)
    plate.rows, fog.rows = [], []
    image = picture(8, 3 * frames, 20, 30).view(8, frames, 3, 20, 30)
    depth = torch.rand(8, frames, 1, 20, 30) * 50
    effect = OneOf([plate, fog, DivergenceFree()])
    found = effect.degrade(image, seed=1, depth=depth)
    moved, foggy, _ = (int(child.applied.sum()) for child in found.params.children)
    assert 0 < moved < 8
    assert 0 < foggy < 8
    assert found.restore_flow.shape == (8, frames, 2, 20, 30)
    assert plate.rows[0] == moved
    assert plate.rows[1] in (moved, moved * frames)
    assert fog.rows == [foggy * frames]


def test_a_gradient_of_parameters_is_the_same_for_samples_that_are_left_alone():
    image = picture(6, 3, 20, 30).double()
    effect = OneOf([ThinPlateSpline(), DivergenceFree()], tolerance_px=None)
    params = effect.sample(image, seed=3)
    learned = params.children[0].displacement.clone().requires_grad_()
    with_gradient = params._replace(children=(params.children[0]._replace(displacement=learned), params.children[1]))
    found = effect.apply(image, with_gradient).image
    torch.testing.assert_close(found, effect.apply(image, params).image, rtol=0, atol=1e-12)
    (slope,) = torch.autograd.grad(found.square().sum(), learned)
    assert (slope != 0).flatten(1).any(dim=1).tolist() == params.children[0].applied.tolist()


@pytest.mark.parametrize("which", range(3), ids=SEVERAL)
def test_a_sample_does_not_depend_on_the_number_of_threads(which, on_threads):
    effect, image = several()[which], picture(2, 3, 129, 131)
    results = []
    for threads in (1, 3):
        on_threads(threads)
        results.append(maps(effect.degrade(image, seed=7)))
    for result in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(result[name], value), name


def test_one_of_shows_each_sample_as_the_effect_chosen_for_it_does():
    effect, image = several()[1], picture(12, 3, 33, 47)
    drawn = effect.degrade(image, seed=7)
    for child, params in zip(effect.effects, drawn.params.children, strict=True):
        alone = cast(Effect, child).apply(image, params)
        assert params.applied.any()
        assert torch.equal(drawn.image[params.applied], alone.image[params.applied]), type(child).__name__


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last", "strided", "unbatched"])
def test_shape_type_and_layout_are_kept(dtype, layout):
    effect = Compose([*warps(), UniformFog()])
    image, scale = picture(2, 3, 20, 30), 255 if dtype is torch.uint8 else 1
    image = (255 * image).round().to(dtype) if dtype is torch.uint8 else image.to(dtype)
    wide = image if dtype is torch.float64 else image.float()
    expected = effect.degrade(wide / scale, seed=7).image * scale
    expected = expected.round().to(dtype) if dtype is torch.uint8 else expected.to(dtype)
    if layout == "channels_last":
        image = image.contiguous(memory_format=torch.channels_last)
    elif layout == "strided":
        image = torch.stack([image, image], dim=-1)[..., 0]
    elif layout == "unbatched":
        image, expected = image[0], expected[0]
    result = effect.degrade(image, seed=7).image
    assert torch.equal(result, expected)
    assert result.is_contiguous(memory_format=torch.channels_last) == (layout == "channels_last")


@pytest.mark.parametrize("shape", [(0, 3, 8, 9), (2, 1, 1, 13), (2, 4, 13, 1), (1, 12, 31, 37)])
def test_frames_of_any_shape_are_no_special_case(shape):
    image = picture(*shape) if shape[0] else torch.zeros(shape)
    degraded = Compose([*warps(), UniformFog()]).degrade(image, seed=7)
    for name, value in maps(degraded).items():
        assert (value.shape[0], *value.shape[2:]) == (shape[0], *shape[2:]), name
        assert value.isfinite().all(), name
    pixel = torch.rand(2, 3, 1, 1)
    assert torch.equal(Compose(warps()).degrade(pixel, seed=7).image, pixel)


def test_one_of_chooses_one_by_weight():
    effect = OneOf([LensDistortion(), UniformFog(), ThinPlateSpline()], weights=[1, 2, 5], p=0.8)
    params = effect.sample(torch.zeros(8000, 3, 1, 1), seed=2)
    gates = torch.stack([child.applied for child in params.children])
    assert torch.equal(gates.sum(dim=0), params.applied.long())
    share = gates.double().mean(dim=1)
    assert_close(share, 0.8 * torch.tensor([1, 2, 5]).double() / 8, rtol=0, atol=4 * 0.5 / 8000**0.5)


def test_gradients_reach_every_effect_and_the_image():
    image = picture(1, 2, 5, 7, dtype=torch.float64, seed=4)
    effect = Compose([ThinPlateSpline(amplitude_range=(0.3, 0.3)), UniformFog(airlight=0.7), LensDistortion()])
    params = effect.sample(image, seed=5)
    plate, fog, lens = params.children

    def degrade(image: Tensor, displacement: Tensor, visibility: Tensor, coefficients: Tensor) -> Tensor:
        children = (
            plate._replace(displacement=displacement),
            fog._replace(visibility=visibility),
            lens._replace(coefficients=coefficients),
        )
        return effect.apply(image, params._replace(children=children)).image

    inputs = (image, plate.displacement, fog.visibility, lens.coefficients)
    assert torch.autograd.gradcheck(degrade, [value.clone().requires_grad_() for value in inputs])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_compositions_params_and_results_are_copied_whole(copied):
    image = picture(2, 3, 20, 30)
    effect = Compose([*warps(), UniformFog()])
    drawn = effect.degrade(image, seed=7)
    again = copied(effect).apply(image, copied(drawn.params))
    duplicate = maps(copied(copied(drawn)))
    for name, value in maps(drawn).items():
        assert torch.equal(getattr(again, name), value), name
        assert torch.equal(duplicate[name], value), name


def test_one_graph_gives_the_same_as_eager_mode():
    image = picture(2, 3, 24, 32)
    effect = Compose([ThinPlateSpline(), UniformFog(), LensDistortion()])
    params = effect.sample(image, seed=7)
    compiled = torch.compile(
        lambda image, params: effect.apply(image, params).image, fullgraph=True, backend="aot_eager"
    )
    assert_close(compiled(image, params), effect.apply(image, params).image, rtol=0, atol=2e-4)


@pytest.mark.parametrize("kind", [Compose, OneOf])
def test_one_graph_draws_and_shows_the_same_as_eager_mode(kind):
    effects = [ThinPlateSpline(padding="border", p=0.7), UniformFog(p=0.7), Turbulence(p=0.7), DivergenceFree(p=0.7)]
    effect, image = kind(effects), picture(4, 3, 24, 32)
    torch.manual_seed(3)
    expected = [effect(image) for _ in range(2)]
    assert not torch.equal(*expected)
    # The contract compiles each effect to machine code; here one graph must hold them all.
    compiled = torch.compile(effect, fullgraph=True, backend="aot_eager")
    torch.manual_seed(3)
    assert_close([compiled(image) for _ in range(2)], expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    ("effects", "error", "message"),
    [
        ([], ValueError, "effects must be at least one effect, got none"),
        ([torch.nn.Identity()], TypeError, "effects must be effects of torchrefract, got Identity"),
    ],
)
def test_what_is_no_list_of_effects_raises(effects, error, message):
    with pytest.raises(error, match=message):
        Compose(effects)


def test_params_that_do_not_fit_raise():
    image, effect = picture(2, 3, 8, 9), Compose([LensDistortion(), UniformFog()])
    params = effect.sample(image, seed=1)
    with pytest.raises(TypeError, match="params must be ComposeParams, got LensParams"):
        effect.apply(image, params.children[0])
    with pytest.raises(ValueError, match=r"params\.children must be those of 2 effects, got 1"):
        effect.apply(image, params._replace(children=params.children[:1]))
    with pytest.raises(ValueError, match=r"params\.gate must have one row for each of the 3 images"):
        effect.apply(picture(3, 3, 8, 9), params)
    fog = params.children[1]._replace(visibility=torch.zeros(2))
    with pytest.raises(ValueError, match=r"params\.visibility must be above 0"):
        effect.apply(image, params._replace(children=(params.children[0], fog)))


@pytest.mark.parametrize(
    ("weights", "message"), [([1.0], "weights must be one number for each of 2"), ([1.0, -1.0], "weights must be")]
)
def test_weights_that_do_not_fit_raise(weights, message):
    with pytest.raises(ValueError, match=message):
        OneOf([LensDistortion(), UniformFog()], weights=weights)


def test_nested_compositions_say_how_their_own_effects_are_looked_up():
    image = picture(2, 3, 24, 32)
    shift = ThinPlateSpline(amplitude_range=(4.0, 6.0), padding="zeros", interpolation="bicubic")
    idle = LensDistortion(p=0)

    def shown(effect: Effect) -> Tensor:
        return effect.degrade(image, seed=4).image

    def with_options(effect: WarpEffect, **options: Any) -> WarpEffect:
        other = copy.copy(effect)
        vars(other).update(options)
        return other

    own: dict[str, Any] = {"padding": "border", "interpolation": "nearest", "backend": "torch"}
    expected = shown(Compose([idle, Compose([with_options(shift, **own)])]))
    assert not torch.equal(expected, shown(Compose([idle, Compose([shift])])))
    assert torch.equal(shown(Compose([idle, Compose([shift], **own)])), expected)
    # The outermost that says how has the word; what it leaves open the next one says.
    half = {name: own[name] for name in ("padding", "backend")}
    inner = Compose([shift], interpolation="nearest", padding="reflection")
    expected = shown(Compose([idle, Compose([Compose([with_options(shift, **own)])])]))
    assert torch.equal(shown(Compose([idle, Compose([inner], **half)])), expected)
    assert torch.equal(shown(Compose([idle, Compose([inner])], **half)), expected)


def test_one_of_looks_its_own_effects_up_as_it_says_inside_of_a_composition():
    image = picture(8, 3, 24, 32)
    a, b = LensDistortion(**LENS), ThinPlateSpline(amplitude_range=(4.0, 6.0))
    choice = OneOf([a, b], padding="border")
    nested = Compose([choice])
    params = nested.sample(image, seed=2)
    assert params.children[0].children[0].applied.any()
    assert params.children[0].children[1].applied.any()
    expected = choice.apply(image, params.children[0])
    assert torch.equal(nested.apply(image, params).image, expected.image)
    unlike = OneOf([a, b]).apply(image, params.children[0]).image
    assert not torch.equal(expected.image, unlike)
