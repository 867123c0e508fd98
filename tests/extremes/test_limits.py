"""Results at the limits of sizes, types, flows and parameters: unchanged, clamped, or finite with a mask."""

import itertools
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from domain import IGNORE_STRENGTH
from helpers import (
    DTYPES,
    EFFECTS,
    assert_close_images,
    assert_close_maps,
    combinations,
    floating_leaves,
    is_in_range,
    maps_of,
    random_image,
)

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SIZES = [(1, 1), (1, 37), (31, 1), (23, 29), (40, 64)]
FULL = [(1080, 1920), (2160, 3840), (4320, 7680), (1, 40000), (40000, 1)]
# Warnings of default effects in frames of one row or column.
WARNINGS = {
    ("lens", (40000, 1)): "the lens must not fold back inside the frame",
    ("divergence-free", (1, 40000)): "length must fit into a periodic domain",
    ("divergence-free", (40000, 1)): "length must fit into a periodic domain",
}
ZERO = (0.0, 0.0)
# Of smooth turbulence, since the default one is computed at each pixel, in seconds a large frame.
SMOOTH = partial(tr.Compose, [tr.Turbulence(covariance="gaussian"), tr.LensDistortion(), tr.UniformFog()])
every_effect = pytest.mark.parametrize("name", [name for name in EFFECTS if name != "rectification"])  # of any size


def lenses(**ranges: Any) -> Callable[..., Effect]:
    """Make lenses with the given ranges, and zero for the other coefficients."""
    return partial(tr.LensDistortion, **({f"{name}_range": ZERO for name in ("k1", "k2", "p1", "p2")} | ranges))


def fields(kind: Any, amplitude: float, **arguments: Any) -> Callable[..., Effect]:
    """Make random flows of one amplitude with a length of 9 px."""
    return partial(kind, amplitude_range=(amplitude, amplitude), length_range=(9.0, 9.0), **arguments)


CLEAR: dict[str, Any] = {"visibility_range": (math.inf, math.inf)}
NEAR: dict[str, Any] = {"depth": tr.LinearDepth(max_depth=0.0)}
IDENTITIES: dict[str, Callable[..., Effect]] = {
    "lens, k = 0": lenses(),
    "thin-plate spline, amplitude 0": partial(tr.ThinPlateSpline, amplitude_range=ZERO),
    "divergence-free, amplitude 0": fields(tr.DivergenceFree, 0.0),
    "physical turbulence, Cn2 = 0": partial(tr.PhysicalTurbulence, cn2_range=ZERO),
    "turbulence blur, Cn2 = 0": partial(tr.TurbulenceBlur, cn2_range=ZERO, tolerance=None),
    "road mirage, dT = 0": partial(tr.RoadMirage, difference_range=ZERO),
    "uniform fog, V = inf": partial(tr.UniformFog, **CLEAR),
    "heterogeneous fog, V = inf": partial(tr.HeterogeneousFog, **CLEAR),
    "volumetric fog, V = inf": partial(tr.HeterogeneousFog, mode="ray", **CLEAR),
    "uniform fog, depth 0": partial(tr.UniformFog, **NEAR),
    "heterogeneous fog, depth 0": partial(tr.HeterogeneousFog, **NEAR),
    "uniform fog, depth 0 in linear light": partial(tr.UniformFog, linear_light=True, **NEAR),
    "rolling shutter, readout 0": partial(tr.RollingShutter, readout_range=ZERO),
    "vignetting, strength 0": partial(tr.Vignetting, strength_range=ZERO),
    "chromatic aberration, scale 0": partial(tr.ChromaticAberration, red_range=ZERO, blue_range=ZERO),
    "flare, radius 0": partial(tr.LensFlare, radius_range=ZERO),
    "flare, strength 0": partial(tr.LensFlare, strength_range=ZERO),
    "sun glare, luminance 0": partial(tr.SunGlare, luminance_range=ZERO),
    "exposure, gamma 0": partial(tr.Exposure, gamma_range=ZERO),
}
FOLDS: dict[str, Callable[..., Effect]] = {
    "lens, k1 = -0.6": lenses(k1_range=(-0.6, -0.6), focal_range=(0.5, 0.5)),
    "turbulence, 16 px": fields(tr.Turbulence, 16.0, aperture_range=ZERO),
}
STRONG: dict[str, Callable[..., Effect]] = {
    **FOLDS,
    **{f"lens, k1 = {k1:g}": lenses(k1_range=(k1, k1)) for k1 in (1.0, 3.0, 10.0)},
    "thin-plate spline, 1e4 px": partial(tr.ThinPlateSpline, amplitude_range=(1e4, 1e4)),
    **{
        f"divergence-free, 100 px, {name}": fields(tr.DivergenceFree, 100.0, normalize=name)
        for name in ("theory", "max")
    },
}
LENSES: dict[str, Callable[..., Effect]] = {
    "p1 = 2": lenses(p1_range=(2.0, 2.0)),
    "k1 = -0.6": lenses(k1_range=(-0.6, -0.6), focal_range=(0.5, 0.5)),
    "k6 = 100, f = 0.01": lenses(k6_range=(100.0, 100.0), focal_range=(0.01, 0.01), center_x_range=(10.0, 10.0)),
}


def sampling_options(make: Callable[..., Effect]) -> list[dict[str, str]]:
    """Return all paddings and interpolations for a warp, and a single empty set of options for other effects."""
    if not isinstance(make(), WarpEffect):
        return [{}]
    pairs = itertools.product(PADDINGS, INTERPOLATIONS)
    return [{"padding": padding, "interpolation": interpolation} for padding, interpolation in pairs]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", IDENTITIES)
def test_an_effect_of_strength_zero_keeps_every_bit(name, device, full_extremes):
    make = IDENTITIES[name]
    for options, dtype, size in combinations(sampling_options(make), DTYPES, SIZES, full=full_extremes):
        image = random_image(2, 3, *size, dtype=dtype, device=device)
        degraded = make(**options).degrade(image, seed=7)
        assert torch.equal(degraded.image, image), (options, dtype, size)
        assert degraded.valid.all(), (options, dtype, size)
        assert degraded.flow is None or not degraded.flow.any(), (options, dtype, size)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES[1:])
@pytest.mark.parametrize("name", STRONG)
@IGNORE_STRENGTH
def test_strong_warps_are_finite_and_mask_pixels_without_inverse(name, size, device, full_extremes):
    make = STRONG[name]
    for options, dtype in combinations(sampling_options(make), DTYPES, full=full_extremes):
        image = random_image(2, 3, *size, dtype=dtype, device=device)
        degraded = make(**options).degrade(image, seed=7)
        assert degraded.image.dtype is dtype
        assert is_in_range(degraded.image), (options, dtype)
        for field, value in maps_of(degraded).items():
            assert value.isfinite().all(), (options, dtype, field)
        residual = degraded.restore_residual[degraded.restore_valid]
        assert not residual.isnan().any(), (options, dtype)
        # A lens has an inverse in closed form; its residual is that of bilinear sampling of the flow.
        limit = max(size) if name.startswith("lens") else 0.05 + 1e-5 * degraded.flow.abs().max()
        assert (residual <= limit).all(), (options, dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", LENSES)
@IGNORE_STRENGTH
def test_lens_gradients_are_finite_where_pixels_have_no_preimage(name, dtype, device):
    effect = LENSES[name]()
    for size in SIZES[1:]:
        image = random_image(2, 3, *size, dtype=dtype, device=device)
        params = effect.sample(image, seed=7)
        leaves = floating_leaves(params)
        degraded = effect.apply(image, params._replace(**leaves))
        for value in (degraded.image, degraded.flow, degraded.restore_flow):
            for gradient in torch.autograd.grad(value.double().sum(), list(leaves.values()), retain_graph=True):
                assert gradient.isfinite().all(), size


@pytest.mark.parametrize("name", FOLDS)
def test_a_fold_warns_once(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        effect = FOLDS[name]()
        for _ in range(3):
            assert not effect.degrade(random_image(1, 3, 40, 64), seed=7).restore_valid.all()
    assert [warning.category for warning in caught] == [UserWarning]
    assert "fold" in str(caught[0].message)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [1e6, -1e6, 3e38, math.inf, -math.inf, math.nan])
def test_invalid_flow_values_are_masked(value, dtype, device, full_extremes):
    pairs = list(itertools.product(PADDINGS, INTERPOLATIONS))
    for (padding, interpolation), size in combinations(pairs, SIZES, full=full_extremes):
        image = random_image(2, 3, *size, dtype=dtype, device=device)
        flow = torch.zeros(2, 2, *size, dtype=torch.float64 if dtype is torch.float64 else torch.float32, device=device)
        flow[1, :, size[0] // 2, size[1] // 2] = value
        image.requires_grad_(image.is_floating_point())
        warped, valid = tr.warp(image, flow.requires_grad_(), padding=padding, interpolation=interpolation)
        assert warped.isfinite().all()
        assert is_in_range(warped.detach())
        assert valid[0].all()
        assert (~valid[1]).sum() == 1
        if image.is_floating_point():
            for gradient in torch.autograd.grad(warped.double().sum(), [image, flow]):
                assert gradient.isfinite().all(), (padding, interpolation, size)
        inverse, solved, residual = tr.invert_flow(flow.detach())
        assert inverse.isfinite().all()
        assert residual.isfinite().all()
        assert solved[0].all()
        assert not inverse[0].any()
        assert not solved[1, 0, size[0] // 2, size[1] // 2]


@pytest.mark.quick
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", PADDINGS)
def test_bicubic_sampling_stays_in_the_range_of_the_image(padding, dtype, device):
    for size in SIZES:
        flow = 3 * random_image(2, 2, *size, seed=1) - 1.5
        scale, offset = (200, 20) if dtype is torch.uint8 else (0.5, 0.25)
        # Zeros outside the frame belong to the range.
        low, high = (0 if padding == "zeros" else offset), offset + scale
        image = (scale * random_image(2, 3, *size).round() + offset).to(device, dtype)
        warped, _ = tr.warp(image, flow.to(device), padding=padding, interpolation="bicubic")
        assert (warped >= low).all(), size
        assert (warped <= high).all(), size


@pytest.mark.parametrize("device", DEVICES)
@every_effect
def test_shape_layout_and_channels_do_not_change_the_result(name, device, full_extremes):
    effect = EFFECTS[name]()
    for dtype, channels, size in combinations(DTYPES, [1, 3, 4, 12], SIZES, full=full_extremes):
        image = random_image(2, channels, *size, dtype=dtype, device=device)
        expected = effect.degrade(image, seed=7).image
        layouts = {
            "channels_last": image.contiguous(memory_format=torch.channels_last),
            "strided": torch.stack([image, image], dim=-1)[..., 0],
            "transposed": image.mT.contiguous().mT,
        }
        for layout, other in layouts.items():
            degraded = effect.degrade(other, seed=7).image
            # The numba backend rounds interleaved uint8 in another order.
            near = dtype is torch.uint8 and layout == "channels_last"
            off = (degraded.double() - expected.double()).abs().max()
            assert off <= (1 if near else 0), (layout, dtype, channels, size)
        assert_close_images(effect.degrade(image[0], seed=7, keys=[0]).image, expected[0])


@pytest.mark.usefixtures("small_domains")  # since a line of 40,000 px would take a random field of 2^24 px
@pytest.mark.parametrize("device", DEVICES)
@every_effect
@IGNORE_STRENGTH
def test_half_types_are_computed_in_single_precision(name, device, full_extremes):
    effect = EFFECTS[name]()
    for size in [(1, 40000), *([(1080, 1920), (2160, 3840)] if full_extremes else [(20, 1920)])]:
        # Levels that both half types hold exactly, so that one frame in single precision serves for both.
        image = (255 * random_image(1, 1, *size, device=device)).floor() / 256
        params = effect.sample(image, seed=7)
        single = effect.apply(image, params)
        for dtype in (torch.float16, torch.bfloat16):
            degraded = effect.apply(image.to(dtype), params)
            assert torch.equal(degraded.image, single.image.to(dtype))
            assert degraded.flow is None or torch.equal(degraded.flow, single.flow)


@pytest.mark.parametrize("device", DEVICES)
@every_effect
def test_large_frames_are_finite_and_independent_of_the_batch(name, device, full_extremes):
    effect, keys = (SMOOTH if name == "compose" else EFFECTS[name])(), torch.tensor([5, 2**40])
    for size in FULL if full_extremes else FULL[:1]:
        image = random_image(2, 1, *size, device=device)
        if (name, size) == ("heterogeneous fog", (40000, 1)):
            with pytest.raises(ValueError, match="scales must have periods of at least"):
                effect.degrade(image, seed=7, keys=keys)
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            both = effect.degrade(image, seed=7, keys=keys)
            assert is_in_range(both.image)
            single = effect.degrade(image[1:], seed=7, keys=keys[1:])
            for field in ("image", "flow", "valid", "transmission"):
                value = getattr(single, field)
                assert value is None or value.isfinite().all(), field
            names = [
                field for field in ("flow", "valid", "image", "transmission") if getattr(single, field) is not None
            ]
            assert_close_maps(
                {field: getattr(single, field) for field in names}, {field: getattr(both, field)[1:] for field in names}
            )
        if device == "cpu":  # values on other devices are not read for warnings
            expected = WARNINGS.get((name, size), "")
            assert bool(caught) == bool(expected)
            assert all(expected in str(warning.message) for warning in caught)


def test_a_huge_visibility_is_clear_air():
    image = random_image(4, 3, 8, 9)
    for visibility in (1e31, 1e39, 1e308):
        effect = tr.UniformFog(visibility_range=(visibility, visibility))
        assert torch.equal(effect.degrade(image, seed=7).image, image)
    drawn = tr.UniformFog(visibility_range=(50.0, 1e308)).sample(torch.zeros(1000, 3, 1, 1), seed=7).visibility
    # 1/V is uniform between the ends, as it is up to inf.
    assert (1 / drawn).mean().item() == pytest.approx(0.01, rel=0.1)


@pytest.mark.quick
def test_an_empty_list_of_keys_fits_an_empty_batch():
    degraded = tr.LensDistortion().degrade(torch.zeros(0, 3, 8, 9), seed=7, keys=[])
    assert degraded.image.shape == (0, 3, 8, 9)
    with pytest.raises(ValueError, match="keys must have one key for each of the 2 images, got shape"):
        tr.LensDistortion().degrade(torch.zeros(2, 3, 8, 9), seed=7, keys=[])


@pytest.mark.parametrize("covariance", ["exponential", "gaussian"])
@pytest.mark.parametrize("size", [(2, 3), (7, 5), (11, 11)])
def test_a_field_normalized_by_its_frame_does_not_depend_on_the_batch(covariance, size):
    effect = tr.Turbulence(normalize="image", covariance=covariance, amplitude_range=(0.1, 0.1))
    image, keys = random_image(3, 1, *size), [0, 5, 2**40]
    batch = effect.degrade(image, seed=7, keys=keys).flow
    for i, key in enumerate(keys):
        single = effect.degrade(image[i : i + 1], seed=7, keys=[key]).flow
        torch.testing.assert_close(single[0], batch[i], rtol=0, atol=1e-4)
