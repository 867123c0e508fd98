"""Promises of every effect; a new effect is one more entry of EFFECTS."""

import copy
import itertools
import math
import random
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from domain import IGNORE_STRENGTH
from helpers import DTYPES, assert_close_maps, assert_equal_maps, assert_graph_agrees, maps_of, random_image
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils.data import DataLoader, Dataset

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.effects.warp_effect import WarpEffect

NO_RANGE = (0.0, 0.0)
MOTION = ("wind", "decorrelation", "frame")
HETEROGENEOUS_FOG = ("visibility", "deviation", "airlight", "weights", "contrast", *MOTION, "scale_height")
TWO_OCTAVES = {"scales": (12.0, 48.0), "weights": (0.4, 0.6)}  # each more takes a graph a second, by the same code
# Clear air, a field that only moves with the wind, and an even density.
MAY_BE_INFINITE = {"visibility", "decorrelation", "scale_height"}


class Case(NamedTuple):
    """An effect and arguments for it.

    make: creates the effect.
    strongest: arguments of a strong effect.
    identity: arguments of strength zero.
    gradient_field: the parameter with a gradient at strength zero; None if there is none.
    fields: all floating parameters.
    meters: True if the effect meters the frame, so that each pixel and channel changes all others a little.
    spreads: True if the light of each pixel reaches all others of its channel; an invalid pixel counts as black.
    """

    make: Callable[..., Effect]
    strongest: dict[str, Any]
    identity: dict[str, Any]
    gradient_field: str | None
    fields: tuple[str, ...]
    meters: bool = False
    spreads: bool = False

    def strong(self, **options: Any) -> Effect:
        return self.make(**self.strongest, **options)


EFFECTS = {
    "lens": Case(
        tr.LensDistortion,
        strongest={
            **{"k1_range": (-0.3, -0.2), "k2_range": (0.1, 0.2), "k3_range": (0.0, 0.02)},
            **{f"k{i}_range": (0.0, 0.002) for i in (4, 5, 6)},
            **{f"{name}_range": (-0.004, 0.004) for name in ("p1", "p2", "s1", "s2", "s3", "s4")},
            "focal_range": (0.7, 0.9),
            "aspect_range": (0.9, 1.1),
            "center_x_range": (-0.03, 0.03),
            "center_y_range": (-0.03, 0.03),
        },
        identity={"k1_range": NO_RANGE, "k2_range": NO_RANGE, "p1_range": NO_RANGE, "p2_range": NO_RANGE},
        gradient_field="coefficients",
        fields=("coefficients", "focal", "center", "zoom", "shift"),
    ),
    "turbulence": Case(
        tr.Turbulence,
        strongest={"amplitude_range": (0.3, 0.5), "length_range": (9.0, 14.0), "aperture_range": (1.5, 2.0)},
        identity={"amplitude_range": NO_RANGE},
        gradient_field="amplitude",
        fields=("amplitude", "length", "aperture", *MOTION),
    ),
    "turbulence with depth": Case(
        partial(tr.Turbulence, depth=tr.GroundPlaneDepth(), reference_distance=20.0),
        strongest={"amplitude_range": (0.5, 0.9), "length_range": (9.0, 14.0), "aperture_range": (1.5, 2.0)},
        identity={"amplitude_range": NO_RANGE},
        gradient_field="amplitude",
        fields=("amplitude", "length", "aperture", *MOTION),
    ),
    "physical turbulence": Case(
        tr.PhysicalTurbulence,
        strongest={"cn2_range": (1e-8, 3e-8), "wind_x_range": (5.0, 9.0)},
        identity={"cn2_range": NO_RANGE},
        gradient_field="tilt",
        fields=("tilt", "wind", "frame"),
    ),
    "turbulence blur": Case(
        partial(tr.TurbulenceBlur, aperture=0.05, focal=20.0, height=None, tolerance=None),
        strongest={"cn2_range": (1e-10, 3e-10)},
        identity={"cn2_range": NO_RANGE},
        gradient_field=None,  # the blur grows with a power of D / r0 above 1
        fields=("ratio",),
        spreads=True,
    ),
    "road mirage": Case(
        partial(tr.RoadMirage, focal=30.0, horizon=0.3, half_width=math.inf),
        strongest={"difference_range": (20.0, 30.0), "shimmer_range": (0.1, 0.3)},
        identity={"difference_range": NO_RANGE},
        gradient_field=None,  # the critical angle is a root
        fields=("difference", "shimmer", "wave", "rate", "phase", "frame"),
    ),
    "thin-plate spline": Case(
        tr.ThinPlateSpline,
        strongest={"amplitude_range": (0.5, 1.0), "smoothing_range": (0.0, 0.1)},
        identity={"amplitude_range": NO_RANGE},
        gradient_field="displacement",
        fields=("displacement", "points", "smoothing"),
    ),
    "divergence-free": Case(
        tr.DivergenceFree,
        strongest={"amplitude_range": (0.5, 1.0), "length_range": (5.0, 9.0), "steps": 2},
        identity={"amplitude_range": NO_RANGE},
        gradient_field="amplitude",
        fields=("amplitude", "length", *MOTION),
    ),
    "rolling shutter": Case(
        tr.RollingShutter,
        strongest={
            "speed_range": (60.0, 100.0),
            "readout_range": (25.0, 33.0),
            "roll_range": (1.0, 2.0),
            "exposure_range": (1.0, 2.0),
            "num_exposures": 1,
        },
        identity={"speed_range": NO_RANGE, "pitch_range": NO_RANGE, "yaw_range": NO_RANGE, "roll_range": NO_RANGE},
        gradient_field="speed",
        fields=("speed", "readout", "exposure", "amplitude", "frequency", "phase", "frame"),
    ),
    "flare": Case(
        tr.LensFlare,
        strongest={"color": (0.9, 0.8, 0.5), "drift_y_range": (-0.01, 0.01), "strength_range": (0.2, 0.5)},
        identity={"strength_range": NO_RANGE},
        gradient_field="strength",
        fields=("center", "radius", "strength", "color", "drift", "frame"),
    ),
    "vignetting": Case(
        tr.Vignetting,
        strongest={"strength_range": (0.9, 1.0), "linear_light": False},
        identity={"strength_range": NO_RANGE},
        gradient_field="strength",
        fields=("strength",),
    ),
    "chromatic aberration": Case(
        tr.ChromaticAberration,
        strongest={"red_range": (0.05, 0.09), "blue_range": (-0.09, -0.05)},
        identity={"red_range": NO_RANGE, "blue_range": NO_RANGE},
        gradient_field="scale",
        fields=("scale",),
    ),
    "heterogeneous fog": Case(
        tr.HeterogeneousFog,
        strongest={
            **{"visibility_range": (20.0, 60.0), "deviation_range": (-0.5, 0.5), "airlight": (0.9, 0.7, 0.8)},
            **TWO_OCTAVES,
        },
        identity={"visibility_range": (math.inf, math.inf)},
        gradient_field=None,
        fields=HETEROGENEOUS_FOG,
    ),
    "volumetric fog": Case(
        partial(tr.HeterogeneousFog, mode="ray"),
        strongest={
            **{"visibility_range": (20.0, 60.0), "wind_z_range": (-1.0, 0.0), "airlight": (0.9, 0.7, 0.8)},
            **TWO_OCTAVES,
        },
        identity={"visibility_range": (math.inf, math.inf)},
        gradient_field=None,
        fields=HETEROGENEOUS_FOG,
    ),
    "sun glare": Case(
        tr.SunGlare,
        strongest={
            **{"center_x_range": (0.2, 0.8), "center_y_range": (0.1, 0.6), "luminance_range": (200.0, 900.0)},
            **{"scale_range": (3.0, 6.0), "ghost_radius_range": (5.0, 20.0), "ghost_share_range": (0.05, 0.1)},
            **{"color": (0.9, 0.8, 0.5), "drift_y_range": (-0.01, 0.01), "time_constant_range": (1.0, 3.0)},
        },
        identity={"luminance_range": NO_RANGE, "center_x_range": (0.2, 0.8), "center_y_range": (0.1, 0.6)},
        gradient_field="luminance",
        fields=(
            *("center", "luminance", "scatter", "scale", "shape", "color", "ghosts", "tints"),
            *("gamma", "time_constant", "drift", "frame"),
        ),
        meters=True,
    ),
    "night glow": Case(
        tr.NightGlow,
        strongest={"threshold": 0.8, "luminance_range": (20.0, 40.0)},
        identity={"luminance_range": NO_RANGE, "threshold": 0.2},
        gradient_field="luminance",
        fields=("optical_depth", "asymmetry", "luminance"),
    ),
    "exposure": Case(
        tr.Exposure,
        strongest={
            **{"target_range": (0.05, 0.15), "time_constant_range": (1.0, 3.0)},
            **{"shot_range": (0.001, 0.01), "read_range": (0.001, 0.002)},
        },
        identity={"gamma_range": NO_RANGE},
        gradient_field="gamma",
        fields=("target", "gamma", "time_constant", "shot", "read", "frame"),
        meters=True,
    ),
    "dust": Case(
        partial(
            tr.HeterogeneousFog,
            mode="ray",
            scale_height_range=(0.5, 3.0),
            sunlight_range=(0.1, 0.3),
            depth=tr.CorridorDepth().road,
        ),
        strongest={
            **{"visibility_range": (20.0, 60.0), "wind_z_range": (-1.0, 0.0), "airlight": (0.5, 0.4, 0.4)},
            **TWO_OCTAVES,
        },
        identity={"visibility_range": (math.inf, math.inf)},
        gradient_field=None,
        fields=(*HETEROGENEOUS_FOG, "sun"),
    ),
    "uniform fog": Case(
        tr.UniformFog,
        strongest={"visibility_range": (20.0, 60.0), "deviation_range": (-0.5, 0.5), "airlight": (0.9, 0.7, 0.8)},
        identity={"visibility_range": (math.inf, math.inf)},
        gradient_field=None,  # clear air is infinitely far from every fog
        fields=("visibility", "deviation", "airlight"),
    ),
}


@pytest.fixture(params=EFFECTS)
def case(request) -> Case:
    return EFFECTS[request.param]


class DegradedFrames(Dataset):
    """Frames that each worker degrades by all effects, one after the other."""

    def __init__(self, effects: list[Effect], images: Tensor, keys: Tensor):
        self.effects, self.images, self.keys = effects, images, keys

    def __len__(self) -> int:
        return len(self.effects) * len(self.images)

    def __getitem__(self, i: int) -> dict[str, Tensor]:
        effect, i = self.effects[i // len(self.images)], i % len(self.images)
        return maps_of(effect.degrade(self.images[i], seed=7, keys=self.keys[i : i + 1]))


def tensors_in(params: Any) -> dict[str, Tensor]:
    """Return the fields of params that are not None."""
    return {name: value for name, value in params._asdict().items() if value is not None}


@pytest.mark.quick
def test_every_public_effect_is_tested():
    kinds = {kind for kind in vars(tr).values() if isinstance(kind, type) and issubclass(kind, Effect)}
    # Compositions and rectifications have other tests.
    others = {tr.BlurredTurbulence, tr.Compose, tr.OneOf, tr.Rectification}
    assert kinds - others == {getattr(case.make, "func", case.make) for case in EFFECTS.values()}


@pytest.mark.quick
def test_a_sample_does_not_depend_on_its_batch(case):
    effect, images, keys = case.strong(p=0.8), random_image(8, 3, 33, 47), torch.arange(100, 108) * 2**33
    batch = effect.degrade(images, seed=7, keys=keys)
    for rows in ([0], [7], [5, 0, 3, 6, 2]):
        part = effect.degrade(images[rows], seed=7, keys=keys[rows])
        assert_equal_maps(tensors_in(part.params), {name: v[rows] for name, v in tensors_in(batch.params).items()})
        assert_close_maps(maps_of(part), {name: value[rows] for name, value in maps_of(batch).items()})


@pytest.mark.parametrize("batch", [1, 2])
def test_a_sample_does_not_depend_on_the_number_of_threads(case, batch, on_threads):
    effect, images = case.strong(), random_image(batch, 3, 151, 127)
    results = []
    for threads in (1, 3):
        on_threads(threads)
        results.append(maps_of(effect.degrade(images, seed=7, keys=range(5, 5 + batch))))
    assert_close_maps(*results)


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_sample_does_not_depend_on_the_worker(workers):
    images, keys = random_image(6, 3, 20, 30), torch.tensor([4, -1, 7, 2**40, 0, 3])
    effects = [case.strong(p=0.8) for case in EFFECTS.values()]
    frames, context = DegradedFrames(effects, images, keys), "fork" if workers else None
    # Batches of 3, so that each holds maps of one effect.
    batches = list(DataLoader(frames, batch_size=3, num_workers=workers, multiprocessing_context=context))
    for effect, first, second in zip(effects, batches[::2], batches[1::2], strict=True):
        expected = maps_of(effect.degrade(images, seed=7, keys=keys))
        assert_close_maps({name: torch.cat([first[name], second[name]]) for name in expected}, expected)


@pytest.mark.quick
def test_seed_key_and_place_each_change_the_parameters(case):
    effect, image = case.strong(), random_image(2, 3, 9, 11)
    draws = [
        effect.sample(image, seed=7, keys=[1, 2]),
        effect.sample(image, seed=8, keys=[1, 2]),
        effect.sample(image, seed=7, keys=[3, 4]),
        effect.sample(image, seed=7, keys=[1, 2], place=1),
    ]
    name = case.fields[0]
    rows = torch.cat([getattr(params, name).view(2, -1) for params in draws])
    assert rows.unique(dim=0).shape[0] == 8


def test_a_seed_leaves_the_global_generators_unchanged(case):
    before = torch.get_rng_state(), random.getstate(), repr(np.random.get_state())
    case.strong().degrade(random_image(2, 3, 9, 11), seed=7)
    after = torch.get_rng_state(), random.getstate(), repr(np.random.get_state())
    assert torch.equal(before[0], after[0])
    assert before[1:] == after[1:]


def test_forward_stores_nothing_on_the_module(case):
    effect = case.strong()
    before = copy.deepcopy(vars(effect))
    effect(random_image(2, 3, 9, 11))
    effect(random_image(3, 9, 11, dtype=torch.uint8))
    assert vars(effect) == before
    assert not list(effect.buffers())
    assert not list(effect.parameters())


@pytest.mark.parametrize("reason", ["p = 0", "strength zero", "not applied"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_an_effect_that_is_off_returns_the_image_bit_for_bit(case, dtype, reason):
    image = random_image(3, 3, 21, 17, dtype=dtype)
    if reason == "not applied":
        effect = case.strong()
        params = effect.sample(image, seed=7)._replace(applied=torch.zeros(3, dtype=torch.bool))
        degraded = effect.apply(image, params)
    else:
        effect = case.strong(p=0.0) if reason == "p = 0" else case.make(**case.identity)
        degraded = effect.degrade(image, seed=7)
    assert degraded.image.dtype == dtype
    assert torch.equal(degraded.image, image)
    expected = {"valid": 1, "restore_valid": 1, "transmission": 1}
    for name, value in maps_of(degraded).items():
        if name != "image":
            assert (value == expected.get(name, 0)).all(), name


@pytest.mark.quick
@pytest.mark.parametrize("dtype", DTYPES)
def test_only_the_applied_samples_of_a_batch_change(case, dtype):
    image = random_image(16, 3, 21, 17, dtype=dtype)
    degraded = case.strong(p=0.5).degrade(image, seed=7)
    applied = degraded.params.applied
    assert 0 < applied.sum() < 16
    assert torch.equal(degraded.image[~applied], image[~applied])
    assert (degraded.image != image).flatten(1).any(dim=1).tolist() == applied.tolist()


def test_the_share_of_applied_samples_is_p():
    count, p = 4000, 0.3  # all effects draw `applied` by the same method
    applied = tr.UniformFog(p=p).sample(torch.zeros(count, 3, 1, 1), seed=7).applied
    assert abs(applied.double().mean().item() - p) < 4 * math.sqrt(p * (1 - p) / count)


def test_the_gradient_at_strength_zero_is_the_limit_of_small_strengths(case, pixels):
    x, y = pixels(9, 12)
    # On a ramp bilinear sampling has a derivative on whole pixels too; the border, where padding begins, is left out.
    image = torch.stack([x, y, x - 2 * y + 20])[None].expand(2, -1, -1, -1) / 50
    weights = torch.zeros_like(image)
    weights[..., 1:-1, 1:-1] = random_image(2, 3, 7, 10, dtype=torch.float64)
    effect = case.make(**case.identity)
    params = effect.sample(image, seed=7)
    assert torch.equal(effect.apply(image, params).image, image)
    if case.gradient_field is None:
        return
    gradients = []
    for step in (0.0, 1e-7):
        strength = (getattr(params, case.gradient_field) + step).requires_grad_()
        degraded = effect.apply(image, params._replace(**{case.gradient_field: strength}))
        assert torch.equal(degraded.image, image) == (step == 0)
        gradients += torch.autograd.grad((degraded.image * weights).sum(), strength)
    assert gradients[0].all()
    assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("dtype", "layout"),
    [
        *((dtype, torch.contiguous_format) for dtype in (torch.uint8, torch.bfloat16, torch.float32)),
        *((dtype, torch.channels_last) for dtype in (torch.uint8, torch.float16, torch.float32, torch.float64)),
    ],
)
def test_shape_type_and_layout_stay_and_the_result_is_that_of_float32(case, dtype, layout):
    effect, scale = case.strong(), 255 if dtype is torch.uint8 else 1
    image = random_image(2, 3, 20, 30, dtype=dtype).contiguous(memory_format=layout)
    expected = scale * effect.degrade(image.float() / scale, seed=7).image
    result = effect.degrade(image, seed=7).image
    assert (result.shape, result.dtype) == (image.shape, dtype)
    assert result.is_contiguous(memory_format=layout)
    if dtype is torch.float64:
        assert_close(result, expected.double(), rtol=0, atol=2e-4)
    else:
        assert torch.equal(result, expected.round().to(dtype) if dtype is torch.uint8 else expected.to(dtype))


def test_channels_are_degraded_independently(case):
    if case.meters:
        channels_change_each_other_by_the_gain_alone(case)
        return
    options = case.strongest | {name: 0.7 for name in ("airlight", "color") if name in case.strongest}
    effect, image = case.make(**options), random_image(2, 4, 20, 30)
    if isinstance(effect, tr.ChromaticAberration):  # whose channels differ
        return
    result = effect.degrade(image, seed=7).image
    for channel in range(4):
        single = effect.degrade(image[:, [channel]], seed=7).image
        # Vector instructions round the last few pixels of a row otherwise, and which these are depends on the size.
        # A pixel whose light comes from many others has the rounding of several.
        atol = (4 if case.spreads else 1) * torch.finfo(torch.float32).eps
        assert_close(single[:, 0], result[:, channel], rtol=0, atol=atol)


def channels_change_each_other_by_the_gain_alone(case: Case) -> None:
    """Check that without a gain a channel does not depend on the others."""
    options = case.strongest | {"gamma_range": NO_RANGE} | {name: 0.7 for name in ("color",) if name in case.strongest}
    effect = case.make(**options)
    image = random_image(2, 4, 20, 30)
    params = effect.sample(image, seed=7)
    changed = image.clone()
    changed[:, 1:] = random_image(2, 3, 20, 30, seed=1)
    assert torch.equal(effect.apply(changed, params).image[:, 0], effect.apply(image, params).image[:, 0])


@pytest.mark.parametrize("size", [(1, 13), (31, 37)])
def test_narrow_and_prime_frames_follow_the_equations(case, size):
    effect, image = case.strong(), random_image(2, 3, *size)
    degraded = effect.degrade(image, seed=7)
    for name, value in maps_of(degraded).items():
        assert value.shape[2:] == size, name
        assert value.isfinite().all(), name
    if degraded.flow is not None:
        expected = tr.warp(image, degraded.flow, padding=effect.padding, interpolation=effect.interpolation)[0]
        assert torch.equal(degraded.image, expected)
    if degraded.transmission is not None:
        t, airlight = degraded.transmission, getattr(degraded.params, "airlight", torch.zeros(1, 3))[..., None, None]
        if isinstance(effect, tr.HeterogeneousFog):
            airlight = effect.airlight_map(degraded.params, *size)
        assert_close(degraded.image, t * image + (1 - t) * airlight, rtol=0, atol=1e-6)


def test_a_frame_of_one_pixel_does_not_move():
    image, effects = random_image(2, 3, 1, 1), [case.strong() for case in EFFECTS.values()]
    for effect in (*effects, tr.Compose([effect for effect in effects if isinstance(effect, WarpEffect)])):
        degraded = effect.degrade(image, seed=7)
        assert degraded.image.isfinite().all()
        if degraded.flow is not None:
            assert torch.equal(degraded.image, image)


@pytest.mark.quick
def test_an_empty_batch_stays_empty(case):
    degraded = case.strong().degrade(torch.zeros(0, 3, 8, 9), seed=7)
    for name, value in maps_of(degraded).items():
        assert (value.shape[0], *value.shape[2:]) == (0, 8, 9), name


def test_an_empty_batch_stays_empty_also_where_gradients_are_needed(case):
    effect, image = case.strong(), torch.zeros(0, 3, 8, 9, requires_grad=True)
    params = effect.sample(image, seed=7)
    field = getattr(params, case.fields[0]).clone().requires_grad_()
    for name, value in maps_of(effect.apply(image, params._replace(**{case.fields[0]: field}))).items():
        assert (value.shape[0], *value.shape[2:]) == (0, 8, 9), name


@pytest.mark.parametrize(
    ("value", "interpolation"), [(math.nan, "bilinear"), (math.inf, "bicubic"), (-math.inf, "bilinear")]
)
def test_an_invalid_pixel_does_not_change_the_gradients_of_others(case, value, interpolation):
    effect = case.strong(**{"gamma_range": NO_RANGE} if case.meters else {})  # a gain has another test
    if isinstance(effect, WarpEffect):
        effect = case.strong(interpolation=interpolation)
    params = effect.sample(random_image(2, 3, 24, 32), seed=7)
    gradients = []
    for pixel in (0.0 if case.spreads else 0.5, value):
        image = (0.25 + random_image(2, 3, 24, 32) / 2).index_put(
            tuple(torch.tensor([0, 1, 11, 13])), torch.tensor(pixel)
        )
        field = getattr(params, case.fields[0]).clone().requires_grad_()
        degraded = effect.apply(image.requires_grad_(), params._replace(**{case.fields[0]: field}))
        gradients.append(torch.autograd.grad(degraded.image.sum(), [image, field]))
    (expected, expected_field), (actual, actual_field) = gradients
    far = torch.ones(2, 3, 24, 32, dtype=torch.bool)
    far[0, 1, 7:16, 9:18] = False
    assert torch.equal(actual[far], expected[far])
    assert actual.isfinite().all()
    assert torch.equal(actual_field[1], expected_field[1])  # of the other sample


@pytest.mark.quick
def test_params_repeat_the_result_bit_for_bit(case):
    effect, image, other = case.strong(p=0.8), random_image(3, 3, 20, 30), random_image(3, 3, 20, 30, seed=1)
    drawn = effect.degrade(image, seed=7)
    assert_equal_maps(maps_of(effect.apply(image, drawn.params)), maps_of(drawn))
    assert_equal_maps(maps_of(effect.apply(other, drawn.params)), maps_of(effect.degrade(other, seed=7)))


@pytest.mark.quick
def test_a_result_says_which_maps_it_has(case):
    degraded = case.strong().degrade(random_image(1, 3, 8, 9), seed=7)
    for name in ("valid", "flow", "restore_flow", "restore_valid", "restore_residual", "folding", "intensity"):
        assert degraded.has(name) == (getattr(degraded, name) is not None), name


def test_params_convert_their_floating_fields(case):
    params = case.strong(p=0.5).sample(random_image(3, 3, 8, 9, dtype=torch.float64), seed=7)
    single = params.to(torch.float32)
    assert type(single) is type(params)
    for name, value in tensors_in(single).items():
        exact = getattr(params, name)
        if exact.is_floating_point():
            assert value.dtype is torch.float32, name
            assert_close(value.double(), exact, rtol=1e-6, atol=0)
        else:
            assert torch.equal(value, exact), name
    assert {value.device.type for value in tensors_in(params.to("meta")).values()} == {"meta"}


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_params_of_a_smaller_type_than_the_flow_are_converted(case, dtype):
    image = random_image(3, 3, 20, 30, dtype=torch.float64 if dtype is torch.float32 else torch.float32)
    effect = tr.Compose([case.strong(p=0.7)])
    rounded = effect.sample(image, seed=7).to(dtype)
    result, expected = effect.apply(image, rounded), effect.apply(image, rounded.to(image.dtype))
    assert_equal_maps(maps_of(result), maps_of(expected))
    assert {value.dtype for value in maps_of(result).values() if value.is_floating_point()} == {image.dtype}


@IGNORE_STRENGTH
def test_extreme_params_raise_or_give_finite_maps(case):
    effect, image = case.strong(), random_image(2, 3, 24, 32)
    params = effect.sample(image, seed=1)
    for name, value in [
        (name, x) for name in case.fields for x in (1e5, -1e5, 1e10, -1e10, 1e20, 3e38, -3e38, 1e-10, 1e-38)
    ]:
        try:
            result = effect.apply(image, params._replace(**{name: torch.full_like(getattr(params, name), value)}))
        except ValueError as error:
            if name not in str(error):
                raise
        else:
            assert all(shown.isfinite().all() for shown in maps_of(result).values()), (name, value)


def test_gradients_of_params_and_image_match_finite_differences(case):
    effect, image = case.strong(), random_image(2, 3, 3, 4, dtype=torch.float64)
    params = effect.sample(image, seed=5)
    names = {name for name, value in tensors_in(params).items() if value.is_floating_point()}
    # Fogs without sunlight take zeros alone, and drawn params have no boxes.
    assert names - {"sun", "vehicles"} == {*case.fields} - {"sun"}

    def degrade(image: Tensor, *values: Tensor) -> Tensor:
        return effect.apply(image, params._replace(**dict(zip(case.fields, values, strict=True)))).image

    inputs = [image, *(getattr(params, name) for name in case.fields)]
    assert torch.autograd.gradcheck(degrade, [value.clone().requires_grad_() for value in inputs], fast_mode=True)


def test_a_sample_that_is_not_applied_has_a_gradient_of_the_image_only(case):
    effect, image = case.strong(), random_image(2, 3, 8, 9).requires_grad_()
    params = effect.sample(image, seed=7)._replace(applied=torch.tensor([False, True]))
    field = getattr(params, case.fields[0]).clone().requires_grad_()
    degraded = effect.apply(image, params._replace(**{case.fields[0]: field}))
    of_image, of_field = torch.autograd.grad(degraded.image.sum(), [image, field])
    assert torch.equal(of_image[0], torch.ones_like(of_image[0]))
    assert not of_field[0].any()
    assert of_field[1].any()


# Other tests compile turbulence (of a clip), the rolling shutter (all maps of a composition) and heterogeneous fog (its
# plan); dust is volumetric fog.
ELSEWHERE = {"turbulence", "turbulence with depth", "rolling shutter", "heterogeneous fog", "volumetric fog"}


@pytest.mark.parametrize("name", [name for name in EFFECTS if name not in ELSEWHERE])
def test_one_graph_gives_the_same_as_eager_mode(name):
    options = {"frame": "pad"} if name == "lens" else {}  # lenses of a table fill the frame in a graph
    effect, image = EFFECTS[name].strong(p=0.8, **options), random_image(3, 3, 24, 32)
    # To lower a graph takes as long as to trace it and tests PyTorch: one warp and one photometric effect are lowered.
    backend = "inductor" if name in ("thin-plate spline", "uniform fog") else "eager"
    assert_graph_agrees(effect, image, backend=backend)


def test_nan_or_infinity_in_a_field_of_the_params_raises(case):
    effect, image = case.strong(), random_image(2, 3, 8, 9)
    params = effect.sample(image, seed=7)
    for name, value in [(name, x) for name in case.fields for x in (math.nan, math.inf, -math.inf)]:
        if name in MAY_BE_INFINITE and value == math.inf:
            continue
        wrong = getattr(params, name).clone()
        wrong.view(-1)[-1] = value
        with pytest.raises(ValueError, match=rf"params\.{name} must{'' if math.isnan(value) else '|points must'}"):
            effect.apply(image, params._replace(**{name: wrong}))


def test_a_range_with_nan_or_infinity_raises(case):
    ranges = {k: v for k, v in vars(case.strong()).items() if k.endswith("_range") and isinstance(v, tuple)}
    assert ranges
    for (name, (low, high)), value in itertools.product(ranges.items(), (math.nan, math.inf, -math.inf)):
        for wrong in ((value, high), (low, value)):
            if wrong == (low, math.inf) and name.removesuffix("_range") in MAY_BE_INFINITE:
                continue
            with pytest.raises(ValueError, match=f"{name} must"):
                case.make(**{name: wrong})


@pytest.mark.quick
def test_params_of_another_batch_raise(case):
    effect, image = case.strong(), random_image(2, 3, 8, 9)
    params = effect.sample(random_image(3, 3, 8, 9), seed=7)
    with pytest.raises(ValueError, match=r"params\.applied must have one row for each of the 2 images, got \(3,\)"):
        effect.apply(image, params)


def test_other_types_than_params_raise(case):
    image, effect = random_image(2, 3, 8, 9), case.strong()
    for params in (None, {"applied": torch.ones(2)}, (1.0, 2.0)):
        with pytest.raises(TypeError, match=r"params must be \w+Params, got"):
            effect.apply(image, params)
    params = effect.sample(image, seed=7)
    for other in (other.strong().sample(image, seed=7) for other in EFFECTS.values()):
        # Two cases of one effect may have the same parameters, or lack those that may be None.
        shapes, expected = ({k: v.shape for k, v in tensors_in(drawn).items()} for drawn in (other, params))
        if type(other) is not type(params) or any(shapes[k] != expected[k] for k in shapes.keys() & expected.keys()):
            with pytest.raises((TypeError, ValueError), match="params"):
                effect.apply(image, other)


def test_unknown_arguments_raise(case):
    with pytest.raises(TypeError, match="k7_range"):
        case.make(k7_range=(0.0, 1.0))
    with pytest.raises(TypeError, match="positional"):
        case.make((0.0, 1.0))


def test_an_image_of_another_shape_raises(case):
    rule = r"image must have shape \(B, C, H, W\), \(C, H, W\) or, for clips, \(B, T, C, H, W\)"
    for shape in ((8, 9), (1, 1, 2, 3, 8, 9), (3, 0, 9), (2, 0, 8, 9)):
        with pytest.raises(ValueError, match=rule):
            case.strong()(torch.zeros(shape))


def test_an_image_of_another_type_raises(case):
    for image in (torch.zeros(3, 8, 9, dtype=torch.int32), np.zeros((3, 8, 9)), None):
        with pytest.raises(TypeError, match="image must be"):
            case.strong()(image)


def test_wrong_seeds_keys_and_depths_raise(case):
    wrong: list[tuple[dict[str, Any], type[Exception], str]] = [
        ({"keys": [1, 2, 3]}, ValueError, "keys must have one key for each of the 2 images"),
        ({"keys": torch.zeros(2)}, TypeError, "keys must be whole numbers"),
        ({"keys": ["a.jpg", "b.jpg"]}, TypeError, r"keys must be a list of whole numbers .* got \['a.jpg'.*key_of"),
        ({"keys": [2**63, 0]}, TypeError, r"keys must be a list of whole numbers in \[-2\^63, 2\^63\)"),
        ({"keys": 3}, TypeError, "keys must be a list of whole numbers .* one for each of the 2 images, got 3"),
        ({"keys": torch.zeros(2, 1, dtype=torch.int64)}, ValueError, "keys must have one key for each"),
        ({"seed": 1.5}, TypeError, "seed must be a whole number"),
        ({"seed": True}, TypeError, "seed must be a whole number"),
        ({"seed": torch.tensor(1.5)}, TypeError, "seed must be a whole number, got torch.float32"),
        ({"seed": torch.tensor(True)}, TypeError, "seed must be a whole number, got torch.bool"),
        ({"seed": torch.tensor([1, 2])}, ValueError, r"seed must be one number, got shape \(2,\)"),
        ({"depth": torch.zeros(2, 1, 9, 8)}, ValueError, "depth must have one channel and the size of the image"),
        ({"depth": [1.0]}, TypeError, "depth must be a floating tensor"),
        ({"depth": np.ones((2, 1, 8, 9), np.float32)}, TypeError, "depth must be a floating tensor, got ndarray"),
    ]
    for options, error, rule in wrong:
        with pytest.raises(error, match=rule):
            case.strong().degrade(random_image(2, 3, 8, 9), **options)


def test_an_effect_is_a_module_among_modules(case):
    torch.manual_seed(0)  # a convolution whose results are all below 0, which is clamped, has no gradient
    seen: list[nn.Module] = []
    effect = case.strong()
    model = nn.Sequential(nn.Conv2d(3, 3, 1), effect)
    assert model.apply(seen.append) is model
    assert effect in seen
    assert effect.apply(seen.append) is effect
    model.half().float().eval().to("cpu")
    assert model(random_image(2, 3, 8, 9)).shape == (2, 3, 8, 9)
    model(random_image(2, 3, 8, 9)).sum().backward()
    weight = next(model.parameters())
    assert weight.grad is not None
    assert weight.grad.any()


@pytest.mark.quick
def test_an_effect_shows_its_arguments(case):
    text = repr(case.strong(p=0.25))
    assert text.startswith(f"{type(case.strong()).__name__}(")
    for name in (*case.strongest, "p=0.25"):
        assert name in text
