import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers import random_image
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, GroundPlaneDepth, HeterogeneousFog, UniformFog, remove_fog
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.batch import select_params
from torchrefract.fields.airlight import forward_scattering
from torchrefract.fields.perlin import draw_octave, perlin_noise
from torchrefract.fields.random_field import Motion
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear

picture = partial(random_image, dtype=torch.float64)
SIZE = (36, 64)
NO_RANGE = (0.0, 0.0)
PAPER = {"scales": (4, 8, 16, 32, 64, 128), "weights": (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)}


def linear_depth_rows(height: int) -> Tensor:
    return torch.tensor([(1 - (y + 0.5) / height) * 160.0 for y in range(height)], dtype=torch.float64)[:, None]


def mean_extinction(params: Any) -> Tensor:
    return -math.log(0.05) / params.visibility * (1 + params.deviation)


# --- mode="image"


@pytest.mark.quick
@pytest.mark.parametrize(("unit", "width"), [("px", 1920.0), ("px", 64.0), ("cells", 1920.0)])
def test_image_and_maps_are_the_closed_form(unit, width):
    effect = HeterogeneousFog(scale_unit=unit, reference_width=width, visibility_range=(50.0, 150.0))
    image = picture(3, 3, *SIZE)
    d = effect.degrade(image, seed=4)
    periods = [SIZE[1] / s if unit == "cells" else s * SIZE[1] / width for s in PAPER["scales"]]
    still = Motion(torch.zeros(3), torch.zeros(3, 2), torch.full((3,), math.inf))
    q = torch.zeros(3, 1, *SIZE, dtype=torch.float64)
    for i, (period, weight) in enumerate(zip(periods, PAPER["weights"], strict=True)):
        options: dict[str, Any] = {"height": SIZE[0], "width": SIZE[1], "motion": still, "dtype": torch.float64}
        octave = draw_octave(d.params.key, i, period=period, **options)
        noise = perlin_noise([octave], torch.ones(3, 1, dtype=torch.float64))
        q += weight * (noise / math.sqrt(0.5) + 1) / 2
    q /= sum(PAPER["weights"])
    k = mean_extinction(d.params)[:, None, None, None] * q / q.mean(dim=(2, 3), keepdim=True)
    t = torch.exp(-k * linear_depth_rows(SIZE[0]))
    airlight = torch.tensor([220, 220, 235], dtype=torch.float64)[:, None, None] / 255
    assert_close(d.extinction, k, rtol=0, atol=1e-12)
    assert_close(d.transmission, t, rtol=0, atol=1e-12)
    assert_close(d.image, image * t + airlight * (1 - t), rtol=0, atol=1e-12)
    assert torch.equal(d.valid, d.transmission >= 1 / 255)
    single = effect.apply(image.float(), d.params.to(torch.float32))
    assert_close(single.image, d.image.float(), rtol=0, atol=1e-6)
    assert d.extinction.std() > 0.05 * d.extinction.mean()


@pytest.mark.parametrize("options", [{}, {"mode": "ray"}, {"normalize": "image"}])
def test_the_mean_extinction_is_that_of_the_visibility(options):
    effect = HeterogeneousFog(visibility_range=(40.0, 200.0), deviation_range=(-0.3, 0.3), **options)
    d = effect.degrade(picture(8, 3, *SIZE), seed=4)
    assert_close(d.extinction.mean(dim=(1, 2, 3)), mean_extinction(d.params), rtol=1e-9, atol=0)
    assert (d.extinction.std(dim=(2, 3)) > 0.02 * d.extinction.mean(dim=(2, 3))).all()


@pytest.mark.parametrize("options", [{}, {"mode": "ray"}])
def test_the_mean_over_many_fogs_is_that_of_the_visibility(options):
    octaves: dict[str, Any] = {"scales": (4.0, 32.0), "weights": (0.6, 0.4)}
    effect = HeterogeneousFog(mean="ensemble", deviation_range=(0.0, 0.0), **octaves, **options)
    k = effect.degrade(picture(150, 1, 4, 7, dtype=torch.float32), seed=4).extinction
    expected = -math.log(0.05) / 100
    assert (k.mean() / expected).item() == pytest.approx(1, abs=0.02)
    assert (k.mean(dim=(1, 2, 3)) - expected).abs().max() > 0.005 * expected


def test_normalization_by_the_image_stretches_noise_to_its_extremes():
    effect = HeterogeneousFog(normalize="image", scales=(400.0,), weights=(3.0,), mean="ensemble")
    k = effect.degrade(picture(4, 1, *SIZE), seed=1)
    q = k.extinction / mean_extinction(k.params)[:, None, None, None]
    assert_close(q.amin(dim=(1, 2, 3)), torch.zeros(4, dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(q.amax(dim=(1, 2, 3)), torch.full((4,), 2.0, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.37, 1e6, 7.31])
def test_odd_scales_are_finite_and_keep_the_mean(scale):
    effect = HeterogeneousFog(scales=(scale,), weights=(1.0,), reference_width=SIZE[1])
    for normalize in ("theory", "image"):
        effect.normalize = normalize
        d = effect.degrade(picture(2, 3, *SIZE), seed=1)
        assert d.image.isfinite().all()
        assert (d.extinction >= 0).all()
        assert_close(d.extinction.mean(dim=(1, 2, 3)), mean_extinction(d.params), rtol=1e-9, atol=0)


@pytest.mark.parametrize("options", [{}, {"mode": "ray"}, {"normalize": "image"}])
def test_a_frame_of_one_pixel_has_the_mean_extinction(options):
    d = HeterogeneousFog(**options).degrade(picture(3, 3, 1, 1), seed=1)
    assert_close(d.extinction[:, 0, 0, 0], mean_extinction(d.params), rtol=1e-9, atol=0)


# --- mode="ray"


@pytest.mark.parametrize("kind", ["rows", "map", "plane", "camera"])
def test_volumetric_fog_without_contrast_is_uniform_fog(kind):
    image, depth = picture(2, 3, *SIZE), 300 * picture(2, 1, *SIZE)
    depth[0, 0, :10] = math.inf
    depth[1, 0, 4, 5:9] = 0
    passed = {"depth": depth} if kind in ("map", "camera") else {}
    options: dict[str, Any] = {"depth": GroundPlaneDepth()} if kind == "plane" else {}
    if kind == "camera":
        options["camera"] = Camera(width=1280, height=720, fx=900, fy=950, cx=600, cy=380, coefficients=(0,) * 4)
    d = HeterogeneousFog(mode="ray", contrast_range=(0.0, 0.0), **options).degrade(image, seed=1, **passed)
    uniform = UniformFog(**options).apply(image, UniformFog.params_type(*d.params[:4]), **passed)
    assert_close(d.image, uniform.image, rtol=0, atol=1e-6)
    assert_close(d.transmission, uniform.transmission, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", ["image", "ray"])
def test_near_objects_stay_visible_and_far_ones_vanish(mode):
    image, depth = render_road_scenes(torch.arange(4), 54, 96)
    d = HeterogeneousFog(mode=mode).degrade(image, seed=1, depth=depth)
    expected = torch.exp(-d.extinction * depth)
    assert_close(d.transmission, expected, rtol=1e-5, atol=1e-7)
    assert_close(d.transmission, expected, rtol=0, atol=1e-6)
    change = (d.image - image).abs().mean(dim=1, keepdim=True)
    assert change[depth < 6].mean() < 0.1
    assert (d.image - d.params.airlight[..., None, None]).abs().amax(dim=1, keepdim=True)[depth > 250].max() < 0.02
    assert d.valid[depth < 50].all()
    assert not d.valid[depth.isinf()].any()


@pytest.mark.parametrize("mode", ["image", "ray"])
def test_the_gradient_of_depth_matches_finite_differences(mode):
    image, depth = picture(2, 3, 3, 4), 10 + 80 * picture(2, 1, 3, 4)
    effect = HeterogeneousFog(mode=mode)
    params = effect.sample(image, seed=3, frame=2.5)
    assert torch.autograd.gradcheck(
        lambda depth: effect.apply(image, params, depth=depth).image, depth.requires_grad_(), fast_mode=True
    )


# --- ends of the domain, invalid arguments


@pytest.mark.parametrize("mode", ["image", "ray"])
def test_clear_air_keeps_the_image_and_opaque_fog_shows_its_color(mode):
    image = picture(2, 3, *SIZE)
    effect = HeterogeneousFog(mode=mode)
    params = effect.sample(image, seed=1)
    clear = effect.apply(image, params._replace(visibility=torch.full((2,), math.inf, dtype=torch.float64)))
    assert torch.equal(clear.image, image)
    assert (clear.transmission == 1).all()
    visibility = torch.full((2,), 1e-3, dtype=torch.float64, requires_grad=True)
    opaque = effect.apply(image, params._replace(visibility=visibility))
    assert torch.equal(opaque.image, params.airlight[..., None, None].expand_as(image))
    assert torch.autograd.grad(opaque.image.sum(), visibility)[0].isfinite().all()
    depth = torch.full((2, 1, *SIZE), 1e-30, dtype=torch.float64)  # a map of zeros is refused
    assert torch.equal(effect.apply(image, params, depth=depth).image, image)
    assert not effect.apply(image, params, depth=depth + math.inf).transmission.any()


def test_a_normalized_depth_raises():
    with pytest.raises(ValueError, match="depth must be in m, not normalized"):
        HeterogeneousFog().degrade(picture(1, 3, 8, 9), depth=picture(1, 1, 8, 9))


def test_fog_without_a_scale_height_is_even_up_to_the_sky_beside_dust():
    image, depth = random_image(2, 3, 24, 32), torch.full((2, 1, 24, 32), torch.inf)
    fog = HeterogeneousFog(mode="ray", scale_height_range=(2.0, 2.0))
    dust = fog.sample(image, seed=7)
    even = dust._replace(scale_height=torch.full((2,), torch.inf))
    mixed = dust._replace(scale_height=torch.tensor([torch.inf, 2.0]))
    expected = fog.apply(image, even, depth=depth).extinction[0], fog.apply(image, dust, depth=depth).extinction[1]
    assert_close(fog.apply(image, mixed, depth=depth).extinction, torch.stack(expected))


def test_a_scale_height_that_does_not_fit_raises():
    image = torch.zeros(1, 3, 8, 9)
    plume = HeterogeneousFog(mode="ray", scale_height_range=(1.0, 2.0)).sample(image, seed=7)
    with pytest.raises(ValueError, match=r"params\.scale_height must be inf for mode='image'"):
        HeterogeneousFog().apply(
            image, HeterogeneousFog().sample(image, seed=7)._replace(scale_height=plume.scale_height)
        )
    with pytest.raises(ValueError, match=r"params\.scale_height must lie in \[0\.05, 1e\+06\] m, or be inf"):
        HeterogeneousFog(mode="ray").apply(image, plume._replace(scale_height=torch.tensor([0.01])))


def test_the_parameters_alone_decide_whether_the_density_is_even():
    image = torch.zeros(1, 3, 8, 9)
    even, dust = HeterogeneousFog(mode="ray"), HeterogeneousFog(mode="ray", scale_height_range=(1.0, 2.0))
    plume = dust.sample(image, seed=7)
    assert torch.equal(even.apply(image, plume).transmission, dust.apply(image, plume).transmission)
    thick = even.sample(image, seed=7)
    assert torch.equal(dust.apply(image, thick).transmission, even.apply(image, thick).transmission)
    assert torch.equal(even.apply(image, thick).image, even.apply(image, thick._replace(scale_height=None)).image)


# An even fog of one visibility before a level camera, which ends after 30 m.
EVEN: dict[str, Any] = {"visibility_range": (50.0, 50.0), "deviation_range": NO_RANGE, "contrast_range": NO_RANGE}
EVEN |= {"camera": Camera(width=60, height=40, fx=50.0, fy=50.0, cx=29.5, cy=19.5, coefficients=(0.0,) * 4)}
EVEN |= {"mode": "ray", "horizon": 0.5}
BLACK, AT_30_M = torch.zeros(1, 3, 40, 60).double(), torch.full((1, 1, 40, 60), 30.0).double()


def ray_of(row: int, column: int) -> Tensor:
    return torch.tensor([(column - 29.5) / 50, (row - 19.5) / 50, 1.0], dtype=torch.float64)


def test_the_transmission_of_dust_is_that_of_its_optical_depth():
    effect = HeterogeneousFog(**EVEN, scale_height_range=(1.5, 1.5))
    t = effect.degrade(BLACK, seed=7, depth=AT_30_M).transmission[0, 0]
    for row, column in ((3, 7), (19, 30), (20, 50)):
        ray = ray_of(row, column)
        share = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
        height = 1.3 - 30 * ray[1] * share
        expected = torch.exp(math.log(0.05) / 50 * 30 * ray.norm() * torch.exp(-height / 1.5).mean())
        assert_close(t[row, column], expected, rtol=1e-6, atol=0)


BOXES = torch.tensor([[[10.0, 16.0, 22.0, 26.0]], [[30.0, 17.0, 40.0, 23.0]]])


@pytest.mark.parametrize("mode", ["image", "ray"])
def test_dust_is_thicker_behind_the_vehicles_of_each_sample(mode):
    image, depth = picture(2, 3, 40, 60), torch.full((2, 1, 40, 60), 80.0)
    effect = HeterogeneousFog(mode=mode, tolerance=0.5)
    params = effect.sample(image, seed=7)
    plain, dusty = (effect.apply(image, params._replace(vehicles=v), depth=depth) for v in (None, BOXES))
    thicker = dusty.extinction / plain.extinction
    assert torch.equal(plain.image, effect.degrade(image, seed=7, depth=depth).image)
    assert (thicker[[0, 1], 0, [24, 22], [16, 35]] > 1.15).all()
    assert (thicker[[0, 1], 0, [24, 22], [45, 10]] < 1.01).all()
    assert thicker[0, 0, 24, 16] > thicker[0, 0, 10, 16] >= 1  # dust stays near the road
    alone = effect.apply(image[1:], select_params(params._replace(vehicles=BOXES), torch.tensor([1])), depth=depth[1:])
    assert_close(alone.image, dusty.image[1:], rtol=0, atol=1e-5)
    some = params._replace(vehicles=torch.cat([BOXES, torch.zeros(2, 2, 4)], dim=1))
    assert_close(effect.apply(image, some, depth=depth).image, dusty.image, rtol=0, atol=1e-6)


def test_the_dust_behind_vehicles_follows_their_boxes_over_a_clip():
    clip, effect = picture(1, 3, 3, 40, 60), HeterogeneousFog(mode="ray", depth=GroundPlaneDepth())
    params = effect.sample(clip, seed=7)
    boxes = BOXES[:1, None] + torch.tensor([0.0, 5.0, 10.0]).view(1, 3, 1, 1)
    moving = effect.apply(clip, params._replace(vehicles=boxes)).image
    standing = effect.apply(clip, params._replace(vehicles=boxes[:, 2])).image
    assert_close(moving[:, 2], standing[:, 2], rtol=0, atol=1e-5)
    assert (moving[:, 0] - standing[:, 0]).abs().max() > 0.01
    boxes.requires_grad_()
    effect.apply(clip, params._replace(vehicles=boxes)).image.sum().backward()
    assert boxes.grad is not None
    assert boxes.grad.isfinite().all()
    assert boxes.grad.abs().amin(dim=3).min() > 0


def test_the_optical_depth_behind_a_vehicle_is_that_along_its_rays():
    effect = HeterogeneousFog(**EVEN, wake_density=6.0, wake_length=4.0)
    params = effect.sample(BLACK, seed=7)._replace(vehicles=torch.tensor([[[22.0, 14.0, 34.0, 22.0]]]))
    t = effect.apply(BLACK, params, depth=AT_30_M).transmission[0, 0]
    place, high = 1.3 * 50 / 2.5, 1.3 * 8 / 2.5  # m: the lower edge lies 2.5 px below the horizon
    for row, column in ((5, 28), (19, 20), (21, 30)):
        ray = ray_of(row, column)
        z = 30 * (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
        wake = torch.exp(-(1.3 - z * ray[1]) / high - (place - z) / 4) * (z <= place)
        wake = 6 * math.exp(-2 * ((column - 28) / 12) ** 2) * wake
        expected = torch.exp(math.log(0.05) / 50 * 30 * ray.norm() * (1 + wake).mean())
        assert_close(t[row, column], expected, rtol=2e-4, atol=0)


def test_invalid_vehicles_raise():
    image = torch.zeros(2, 3, 8, 9)
    params = HeterogeneousFog().sample(image, seed=7)
    for boxes, problem in (
        (torch.zeros(2, 4), r"params\.vehicles must have shape \(B, V, 4\)"),
        (torch.zeros(2, 3, 5), r"params\.vehicles must have shape"),
        (torch.zeros(2, 3, 1, 4), r"or \(B, 1, V, 4\)"),
        (torch.zeros(1, 3, 4), r"params\.vehicles must have one row for each of the 2 images"),
        (torch.full((2, 1, 4), math.inf), r"params\.vehicles must be finite"),
        (torch.full((2, 1, 4), math.nan), r"params\.vehicles must not be NaN"),
    ):
        with pytest.raises(ValueError, match=problem):
            HeterogeneousFog().apply(image, params._replace(vehicles=boxes))


def test_fog_is_brighter_on_the_side_of_the_sun_by_henyey_and_greensteins_phase_function():
    camera = Camera(width=60, height=40, fx=50.0, fy=45.0, cx=31.0, cy=18.0, coefficients=(0.0,) * 4)
    sun: dict[str, Any] = {"sun_azimuth_range": (35.0, 35.0), "sun_elevation_range": (12.0, 12.0), "asymmetry": 0.6}
    sun |= {"sunlight_range": (0.2, 0.2), "airlight": (0.5, 0.4, 0.3)}
    degraded = HeterogeneousFog(camera=camera, horizon=0.6, **sun).degrade(
        BLACK, seed=3, depth=torch.full_like(AT_30_M, math.inf)
    )
    # In coordinates of the road: x to the right, y down, z ahead; the camera looks up, for its horizon is low.
    pitch = Rotation.from_euler("x", math.atan((0.6 * 40 - 0.5 - 18) / 45)).as_matrix()
    to_sun = Rotation.from_euler("xy", [12.0, 35.0], degrees=True).as_matrix() @ [0, 0, 1]
    for row, column in ((0, 0), (5, 50), (39, 30), (20, 59)):
        ray = pitch @ [(column - 31) / 50, (row - 18) / 45, 1]
        cosine = ray @ to_sun / np.linalg.norm(ray)
        factor = 0.8 + 0.2 * 0.64 / (1.36 - 1.2 * cosine) ** 1.5
        color = linear_to_srgb(srgb_to_linear(torch.tensor([0.5, 0.4, 0.3], dtype=torch.float64)) * factor)
        assert_close(degraded.image[0, :, row, column], color, rtol=0, atol=1e-6)
    right, left = degraded.image[..., 40:].mean(), degraded.image[..., :20].mean()
    assert right > left + 0.05


def test_all_directions_together_receive_the_light_that_falls_on_a_particle():
    cosine = torch.linspace(-1, 1, 20001, dtype=torch.float64)
    for asymmetry in (0.0, 0.6, 0.9):
        assert torch.trapezoid(forward_scattering(cosine, asymmetry), cosine).item() == pytest.approx(2, rel=1e-4)


def test_fog_lit_by_the_sun_is_removed_with_the_map_of_its_airlight():
    image = picture(2, 3, *SIZE)
    effect = HeterogeneousFog(sunlight_range=(0.1, 0.3), airlight=0.5)
    degraded = effect.degrade(image, seed=3)
    assert degraded.params.sun is not None
    airlight = effect.airlight_map(degraded.params, *SIZE)
    clean, valid = remove_fog(degraded.image, degraded.transmission, airlight)
    assert valid.any()
    assert_close(torch.where(valid, clean, image), image, rtol=0, atol=1e-9)
    without = effect.apply(image, degraded.params._replace(sun=None))
    assert_close(without.image, HeterogeneousFog(airlight=0.5).apply(image, degraded.params._replace(sun=None)).image)
    assert (without.image - degraded.image).abs().max() > 0.02
    with pytest.raises(ValueError, match=r"params\.sun\[:, 2\] must"):
        effect.apply(image, degraded.params._replace(sun=degraded.params.sun + 1))


def test_lamps_in_dark_fog_are_never_brighter_than_in_clear_air_and_have_gradients():
    image = picture(1, 3, 6, 8).double()
    image[..., 2, 3], image[..., 4, 5] = 0.97, 1.0
    depth = torch.linspace(1.0, 60.0, 48, dtype=torch.float64).view(1, 1, 6, 8)
    options: dict[str, Any] = {"mode": "ray", "visibility_range": (80.0, 80.0), "airlight": 0.1, "linear_light": True}
    plain, lamps = (HeterogeneousFog(**options, lamp_luminance=value) for value in (1.0, 20.0))
    params = lamps.sample(image, seed=2)
    foggy, lit = (effect.apply(image, params, depth=depth).image for effect in (plain, lamps))
    assert (lit >= foggy - 1e-12).all()
    assert (lit <= torch.maximum(image, torch.tensor(0.1).double()) + 1e-12).all()
    assert (lit[..., 4, 5] == 1).all()
    assert (foggy[..., 4, 5] < 0.6).all()
    is_lamp = (image.amax(dim=1, keepdim=True) >= 0.85).expand_as(image)
    assert torch.equal(lit[~is_lamp], foggy[~is_lamp])
    clear = params._replace(visibility=torch.full_like(params.visibility, 1e9))
    assert_close(lamps.apply(image, clear, depth=depth).image, image, rtol=0, atol=1e-6)
    by_day = params._replace(airlight=torch.full_like(params.airlight, 0.8))
    plain_day, lamps_day = (effect.apply(image, by_day, depth=depth).image for effect in (plain, lamps))
    assert_close(lamps_day, plain_day, rtol=0, atol=1e-6)
    image.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: lamps.apply(x, params, depth=depth).image, image, atol=1e-5, fast_mode=True
    )
