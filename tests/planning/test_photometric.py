import math
from copy import copy
from typing import Any

import light_tolerance
import numpy as np
import pytest
import tolerance
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, Compose, GroundPlaneDepth, HeterogeneousFog, LensFlare, LinearDepth, UniformFog
from torchrefract.effects.depth import DepthProvider
from torchrefract.effects.planned_light import PlannedLight
from torchrefract.fields.perlin import perlin_noise
from torchrefract.fields.perlin_bounds import VARIANCE, error_between, mean_variance
from torchrefract.fields.perlin_drawn import Coarse, Drawn, drawn_noise
from torchrefract.fields.perlin_lattice import octave
from torchrefract.planning.photometric import LightPlan
from torchrefract.warping.lattice import Lattice, between_nodes

SIZE = (96, 144)
CAMERA = Camera(width=144, height=96, fx=110.0, fy=110.0, cx=70.0, cy=50.0, coefficients=(0.0,) * 4)
# So many octaves that those on a lattice are worth its step.
LONG: dict[str, Any] = {"scales": (12, *range(50, 140, 10)), "weights": (1,) * 10, "reference_width": 144.0}
ARGUMENTS: dict[str, tuple[type[PlannedLight], dict[str, Any]]] = {
    "camera": (UniformFog, {"camera": CAMERA}),
    "dense": (UniformFog, {"visibility_range": (20.0, 25.0)}),
    "linear": (UniformFog, {"visibility_range": (20.0, 25.0), "linear_light": True, "camera": CAMERA}),
    "drifts": (HeterogeneousFog, {"visibility_range": (100.0, 300.0), **LONG}),
    "faint": (HeterogeneousFog, {"mode": "ray", "contrast_range": (0.0, 1e-5)}),
    "sun": (
        LensFlare,
        {"radius_range": (0.05, 0.06), "blend": "screen", "center_y_range": (0.1, 0.2), "drift_x_range": (0.0, 0.0)},
    ),
}
every_light = pytest.mark.parametrize("name", list(ARGUMENTS))


def made(name: str, levels: float | None, **more: Any) -> Any:
    kind, arguments = ARGUMENTS[name]
    return kind(**arguments, tolerance=levels, **more)


def image(batch: int = 2) -> Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(3))


def levels_apart(one: Tensor, other: Tensor) -> float:
    return 255 * (one.double() - other.double()).abs().max().item()


@pytest.mark.parametrize("name", list(light_tolerance.CONFIGURATIONS))
@pytest.mark.parametrize("seed", range(1000, 1012))
def test_no_image_is_farther_from_the_exact_one_than_its_tolerance(name, seed, monkeypatch):
    monkeypatch.setattr(tolerance, "LARGEST", (480, 640))
    trial = light_tolerance.attempt(name, seed)
    assert trial.error <= trial.tolerance
    # Exact fog in float32 is off by rounding, more in linear light.
    assert trial.error <= max(trial.bound, 5e-3)
    assert trial.bound <= trial.tolerance


@every_light
def test_a_tolerance_is_used(name):
    effect, exact = made(name, 1.0), made(name, None)
    off = levels_apart(effect.degrade(image(), seed=1).image, exact.degrade(image(), seed=1).image)
    bound = effect.planned(*SIZE, torch.float32).error
    assert 0 < off <= bound <= 1
    assert bound > 1e-3


@every_light
def test_a_sample_is_bit_equal_in_any_batch_and_on_any_threads(name, on_threads):
    alone = made(name, 0.3).degrade(image(3)[1:2], seed=5, keys=[11]).image
    for threads in (1, 2, 3):
        on_threads(threads)
        among = made(name, 0.3).degrade(image(3), seed=5, keys=[4, 11, 7]).image[1:2]
        assert torch.equal(alone, among)


@every_light
def test_closed_gates_leave_the_image_alone(name):
    degraded = made(name, 1.0, p=0.5).degrade(image(12), seed=2)
    off = ~degraded.params.applied
    assert 0 < off.sum() < 12
    assert torch.equal(degraded.image[off], image(12)[off])
    assert degraded.valid[off].all()


@every_light
def test_given_parameters_do_as_drawn_ones_and_others_are_exact(name):
    effect = made(name, 1.0)
    degraded = effect.degrade(image(), seed=2)
    assert torch.equal(effect.apply(image(), degraded.params).image, degraded.image)
    other = "strength" if name == "sun" else "visibility"
    outside = degraded.params._replace(**{other: 1.5 * getattr(degraded.params, other).clone() + 300 * (name != "sun")})
    assert torch.equal(effect.apply(image(), outside).image, made(name, None).apply(image(), outside).image)


@every_light
def test_gradients_of_parameters_are_those_of_the_exact_effect(name):
    params = made(name, 1.0).sample(image(), seed=2)
    slopes = []
    for effect in (made(name, 1.0), made(name, None)):
        leaf = (params.strength if name == "sun" else params.visibility).clone().requires_grad_()
        own = params._replace(**{"strength" if name == "sun" else "visibility": leaf})
        slopes.append(torch.autograd.grad(effect.apply(image(), own).image.sum(), leaf)[0])
    assert slopes[1].abs().min() > 0
    assert torch.equal(*slopes)


@every_light
def test_the_gradient_of_the_image_is_that_of_the_exact_effect_within_the_tolerance(name):
    slopes = []
    for effect in (made(name, 1.0), made(name, None)):
        leaf = image().double().requires_grad_()
        slopes.append(torch.autograd.grad(effect.degrade(leaf, seed=2).image.sum(), leaf)[0])
    # In the dark linear light is steep; a rectangle's border meets clipped pixels.
    assert (slopes[0] - slopes[1]).abs().median() < 0.01


@every_light
def test_clips_move_and_one_frame_alone_is_that_of_the_clip(name):
    clip = torch.rand(2, 3, 3, *SIZE)
    whole = made(name, 1.0).degrade(clip, seed=2)
    assert torch.equal(whole.image[:, 2], made(name, 1.0).degrade(clip[:, 2], seed=2, frame=2).image)
    assert levels_apart(whole.image, made(name, None).degrade(clip, seed=2).image) <= 1


@every_light
def test_one_graph_gives_the_same(name):
    effect = made(name, 1.0)
    compiled = torch.compile(effect.degrade, fullgraph=True, backend="aot_eager")
    found, expected = compiled(image(), seed=torch.tensor(4)).image, effect.degrade(image(), seed=4).image
    assert_close(found, expected, rtol=0, atol=2e-4)


@every_light
def test_the_maps_are_within_the_tolerance(name):
    found, exact = (made(name, levels).degrade(image(), seed=4) for levels in (1.0, None))
    for which in ("transmission", "intensity"):
        if getattr(exact, which) is not None:
            assert levels_apart(getattr(found, which), getattr(exact, which)) <= 1
    assert (found.valid == exact.valid).float().mean() > 0.99


@pytest.mark.parametrize(
    "effect",
    [
        UniformFog(visibility_range=(1e6, 1e7), tolerance=1.0),
        HeterogeneousFog(visibility_range=(1e6, 1e7), tolerance=1.0),
        HeterogeneousFog(visibility_range=(1e6, math.inf), mode="ray", contrast_range=(0.1, 0.1), tolerance=1.0),
        LensFlare(strength_range=(0.0, 1e-3), tolerance=1.0),
    ],
    ids=["fog", "drifts", "space", "flare"],
)
def test_what_nobody_sees_is_not_computed(effect, capsys):
    plan = effect.plan(*SIZE)
    assert not plan.acts
    assert capsys.readouterr().out.strip() == str(plan)
    assert "light          not computed" in str(plan)
    frame = image()
    degraded = effect.degrade(frame, seed=3)
    assert degraded.image is frame
    assert torch.equal(Compose([effect]).degrade(frame, seed=3).image, frame)
    exact = effect.exact().degrade(frame, seed=3)
    for name in ("transmission", "extinction", "intensity"):
        if getattr(exact, name) is not None:
            assert torch.equal(getattr(degraded, name), getattr(exact, name))
    assert not torch.equal(exact.image, frame)


def test_a_thickness_of_which_a_part_is_no_number_is_not_computed():
    camera = Camera(width=4, height=3, fx=9.0, fy=9.0, cx=2.0, cy=1.0, coefficients=(0.0,) * 4)
    thin = {"visibility_range": (3.3e302, 3.3e302), "depth": LinearDepth(max_depth=1e-17)}
    effect, frame = UniformFog(**thin, camera=camera, tolerance=0.5), torch.rand(2, 3, 3, 4)
    assert not effect.plan(3, 4).acts
    assert effect(frame) is frame


def test_thin_fog_before_a_depth_that_is_passed_in_is_computed():
    effect, depth = UniformFog(visibility_range=(1e6, 1e6), tolerance=1.0), torch.full((2, 1, *SIZE), 1e6)
    found = effect.degrade(image(), seed=3, depth=depth).image
    assert torch.equal(found, effect.exact().degrade(image(), seed=3, depth=depth).image)
    assert not torch.equal(found, image())


def test_drifts_before_a_depth_that_is_passed_in_keep_the_tolerance():
    effect = made("drifts", 1.0)
    depth = torch.linspace(1, 3000, SIZE[1]).expand(2, 1, *SIZE).clone()
    depth[:, :, :10] = math.inf
    found, exact = (one.degrade(image(), seed=3, depth=depth).image for one in (effect, effect.exact()))
    assert levels_apart(found, exact) <= 1


def test_rows_that_are_all_fog_are_filled_with_the_airlight():
    effect = made("dense", 1.0)
    kinds = {kind: (start, stop) for kind, start, stop in effect.planned(*SIZE, torch.float32).bands}
    start, stop = kinds["filled"]
    assert start == 0 < stop < SIZE[0]
    filled = effect.degrade(image(), seed=1).image[:, :, start:stop]
    color = torch.tensor([220.0, 220.0, 235.0])[:, None, None] / 255
    assert torch.equal(filled, color.expand_as(filled))
    # The last of them lets at most so much through, and the next one more, in the thinnest fog of the ranges.
    k = 0.95 * -math.log(0.05) / 25
    through = [math.exp(-k * (1 - (row + 0.5) / SIZE[0]) * 160) * 235 for row in (stop - 1, stop)]
    assert through[0] <= 1.01
    assert through[1] > 0.99


def test_octaves_of_no_weight_are_dropped_and_named():
    effect = HeterogeneousFog(
        scales=(20, 40, 80), weights=(1, 1, 1e-4), reference_width=144.0, visibility_range=(500, 500), tolerance=0.3
    )
    plan = effect.planned(*SIZE, torch.float32)
    assert plan.kept == ("octave of 20 px", "octave of 40 px")
    assert [name for name, _ in plan.dropped] == ["octave of 80 px", "the fog where 1 - t < 0.0011"]
    assert 0 < plan.dropped[0][1] < 0.3
    assert "term dropped   octave of 80 px, which moves up to" in str(plan)


def test_drifts_that_nobody_sees_are_uniform_fog():
    effect = HeterogeneousFog(visibility_range=(3e5, 3e5), tolerance=0.55, deviation_range=(0.0, 0.0))
    plan = effect.planned(*SIZE, torch.float32)
    assert plan.acts
    assert plan.is_uniform
    names = [name for name, _ in plan.dropped]
    assert len(names) == 7
    assert names[-1].startswith("the fog where 1 - t < ")
    exact = UniformFog(visibility_range=(3e5, 3e5), deviation_range=(0.0, 0.0)).degrade(image(), seed=1)
    found, left = effect.degrade(image(), seed=1).image, exact.transmission > plan.ends.clear
    assert 0.1 < left.float().mean() < 0.9
    assert torch.equal(found, torch.where(left, image(), exact.image))


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize(
    "effect",
    [UniformFog(), HeterogeneousFog(), HeterogeneousFog(mode="ray"), HeterogeneousFog(normalize="image")],
    ids=["fog", "drifts", "space", "stretched"],
)
def test_where_no_scene_is_seen_is_the_airlight_and_where_no_fog_is_the_image(effect, linear):
    exact = type(effect)(
        visibility_range=(30.0, 40.0),
        linear_light=linear,
        **({} if isinstance(effect, UniformFog) else {"mode": effect.mode, "normalize": effect.normalize}),
    )
    within = copy(exact)
    within.tolerance = 1.0
    plan = within.planned(*SIZE, torch.float32, any_depth=True)
    depth = torch.logspace(-4, 4, SIZE[0])[:, None].expand(2, 1, *SIZE)
    expected, found = (one.degrade(image(), seed=1, depth=depth) for one in (exact, within))
    # Octaves that are left out move t a little.
    room = 0.02 if isinstance(effect, HeterogeneousFog) else 1e-5
    opaque = expected.transmission < (1 - room) * plan.ends.opaque
    clear = 1 - expected.transmission < (1 - room) * (1 - plan.ends.clear)
    assert opaque.float().mean() > 0.2
    assert clear.float().mean() > 0.2
    for where, what in ((opaque, expected.params.airlight[:, :, None, None]), (clear, image())):
        chosen = where.expand_as(found.image)
        assert torch.equal(found.image[chosen], what.expand_as(found.image)[chosen])
    assert levels_apart(found.image, expected.image) <= 1
    assert levels_apart(found.image, expected.image) > 0.1
    words = str(plan)
    assert f"term dropped   the scene where t < {plan.ends.opaque:.2g}, which moves up to" in words
    assert f"term dropped   the fog where 1 - t < {1 - plan.ends.clear:.2g}, which moves up to" in words


def test_long_octaves_are_on_a_lattice_that_a_tolerance_makes_coarse():
    plans = [made("drifts", levels).planned(*SIZE, torch.float32) for levels in (0.1, 1.0)]
    assert set(plans[1].coarse) >= {1, 2, 3}
    assert plans[1].stride > plans[0].stride
    assert f"every {plans[1].stride} px" in str(plans[1])


@pytest.mark.parametrize(("period", "stride"), [(20.0, 3), (37.5, 8), (64.0, 12)])
def test_the_error_between_nodes_deviates_as_its_bound_says(period, stride):
    """Sampled: the variance over many noises at each pixel, the worst of which the bound is for."""
    count, size = 3000, 32
    key = torch.randint(1 << 32, (count, 4), generator=torch.Generator().manual_seed(1))
    # One phase for all, so that each pixel has a variance of its own.
    key[:, :2] = key[0, :2]
    options: dict[str, Any] = {
        "period": period,
        "frame": torch.zeros(count),
        "wind": torch.zeros(count, 2),
        "decorrelation": torch.full((count,), math.inf),
        "dtype": torch.float64,
    }
    noise = perlin_noise([octave(key, 0, height=1, width=size, **options)], torch.ones(count, 1))
    assert noise.var(dim=0).max() <= 1.2 * VARIANCE
    found = error_between(period, stride, 1080, 1920)
    assert found.variance < 0.1 * VARIANCE
    assert found.covariance <= math.sqrt(found.variance * VARIANCE) * (1 + 1e-9)
    exact = perlin_noise([octave(key, 0, height=size, width=size, **options)], torch.ones(count, 1))
    lattice = Lattice(size, size, stride)
    rows, columns = lattice.axes()
    place = {"stride": stride, "start": rows.start}
    known = perlin_noise(
        [octave(key, 0, height=len(rows), width=len(columns), **place, **options)], torch.ones(count, 1)
    )
    off = between_nodes(known, lattice) - exact
    sampled = off.var(dim=0).max().item()
    assert 0.2 * found.variance <= sampled <= 1.25 * found.variance
    # Of vectors that are known no sum is longer than all of them together.
    assert off.abs().max() <= math.sqrt(2 * found.nodes * found.variance)


@pytest.mark.parametrize(("period", "stride"), [(12.0, 4), (50.0, 4), (100.0, 4), (100.0, 2), (110.0, 16)])
def test_the_error_around_nodes_of_the_noise_keeps_its_bound(period, stride):
    """There the third derivative jumps: of a long period nearly all of the error is there."""
    key = torch.randint(1 << 32, (300, 4), generator=torch.Generator().manual_seed(1))
    still = torch.zeros(300), torch.zeros(300, 2), torch.full((300,), math.inf)
    weights, lattice = torch.ones(300, 1).double(), Lattice(120, 120, stride)
    drawn = Drawn(key, *still)
    size: Any = {"height": 120, "width": 120}
    coarse = Coarse([(0, period)], weights, lattice)
    off = drawn_noise(drawn, [], weights[:, :0], **size, coarse=coarse) - drawn_noise(
        drawn, [(0, period)], weights, **size
    )
    found = error_between(period, stride, 120, 120)
    assert 4 <= found.nodes < 9
    assert 0.7 <= off.abs().max() / math.sqrt(2 * found.nodes * found.variance) <= 1.02


@pytest.mark.parametrize("period", [7.0, 30.0, 200.0])
def test_the_mean_over_a_frame_deviates_as_its_bound_says(period):
    count = 400
    key = torch.randint(1 << 32, (count, 4), generator=torch.Generator().manual_seed(1))
    noise = perlin_noise(
        [
            octave(
                key,
                0,
                period=period,
                height=60,
                width=90,
                frame=torch.zeros(count),
                wind=torch.zeros(count, 2),
                decorrelation=torch.full((count,), math.inf),
                dtype=torch.float64,
            )
        ],
        torch.ones(count, 1),
    )
    sampled = noise.mean(dim=(1, 2, 3)).var().item()
    assert 0.1 * mean_variance(period, 60, 90) <= sampled <= 1.2 * mean_variance(period, 60, 90)


@pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog, LensFlare])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_a_tolerance_that_is_none_raises(kind, value):
    with pytest.raises(ValueError, match="tolerance must"):
        kind(tolerance=value)


@pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog, LensFlare])
def test_a_tolerance_below_rounding_raises_and_says_what_can_be_kept(kind):
    rule = r"tolerance must be at least 0.00049 levels of 1/255 for images in float32 \(None is exact\), got 1e-05"
    with pytest.raises(ValueError, match=rule):
        kind(tolerance=1e-5).plan(*SIZE)
    with pytest.raises(ValueError, match=rule):
        kind(tolerance=1e-5)(image())
    assert isinstance(kind(tolerance=1e-5).plan(*SIZE, dtype=torch.float64), LightPlan)


def test_in_linear_light_less_can_be_kept():
    with pytest.raises(ValueError, match=r"tolerance must be at least 0.0063 levels .* in linear light"):
        UniformFog(tolerance=1e-3, linear_light=True).plan(*SIZE)


@pytest.mark.parametrize("kind", [UniformFog, HeterogeneousFog, LensFlare])
@pytest.mark.parametrize(("height", "width"), [(0, 10), (10, 0), (-1, 10)])
def test_a_plan_of_no_frame_raises(kind, height, width):
    with pytest.raises(ValueError, match="must be at least 1"):
        kind(tolerance=0.1).plan(height, width)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 50), (40, 1), (7, 11)])
@every_light
def test_small_frames_keep_the_tolerance(name, height, width):
    if "camera" in ARGUMENTS[name][1]:
        kind: Any
        kind, arguments = ARGUMENTS[name]
        camera = Camera(width=width, height=height, fx=9.0, fy=9.0, cx=3.0, cy=2.0, coefficients=(0.0,) * 4)
        exact, found = (kind(**arguments | {"camera": camera}, tolerance=levels) for levels in (None, 1.0))
    else:
        exact, found = (made(name, levels) for levels in (None, 1.0))
    frame = torch.rand(2, 1, height, width)
    one, other = (effect.degrade(frame, seed=3).image for effect in (exact, found))
    assert levels_apart(one, other) <= 1


@pytest.mark.parametrize("depth", [GroundPlaneDepth(far=math.inf), LinearDepth(max_depth=0.0)])
def test_roads_without_an_end_and_without_a_length_have_a_plan(depth):
    for kind in (UniformFog, HeterogeneousFog):
        effect = kind(depth=depth, tolerance=0.5)
        found, exact = (one.degrade(image(), seed=1).image for one in (effect, effect.exact()))
        assert levels_apart(found, exact) <= 0.5


def test_a_flare_leaves_what_it_does_not_reach():
    effect = made("sun", 0.5)
    top, bottom, left, right = effect.planned(*SIZE, torch.float32).part
    found = effect.degrade(image(), seed=1).image
    seen = (found != image()).any(dim=1).any(dim=0).numpy()
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    assert top <= rows[0]
    assert rows[-1] < bottom < SIZE[0]
    assert 0 < left <= columns[0]
    assert columns[-1] < right < SIZE[1]


def test_a_depth_provider_without_a_hash_has_a_plan():
    class Wall(DepthProvider):
        __hash__ = None  # pyright: ignore[reportAssignmentType]  # as a class that only says what it equals

        def __eq__(self, other: object) -> bool:
            return self is other

        def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
            return torch.full((1, 1, height, width), 2e3, dtype=dtype, device=device)

    plan = UniformFog(depth=Wall(), tolerance=1.0).planned(*SIZE, torch.float32)
    assert plan.bands == (("filled", 0, SIZE[0]),)
    assert "that of the air alone" in str(plan)
