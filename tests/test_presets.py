"""Scenes: the effects in them, and the meaning of their severities."""

import inspect
import math
from collections.abc import Callable, Iterator
from itertools import pairwise, product
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

import torchrefract as tr
from torchrefract import presets
from torchrefract.cameras.brown_conrady import distort_with_jacobian
from torchrefract.cameras.camera import Camera
from torchrefract.effects.base import Effect
from torchrefract.fields.srgb import srgb_to_linear

SIZE = (54, 96)
SCENES: dict[str, Callable[..., Any]] = {
    name: function
    for name, function in inspect.getmembers(presets, inspect.isfunction)
    if not name.startswith("_") and function.__module__ == presets.__name__
}
EFFECTS = {
    "cheap_dashcam": {tr.LensDistortion},
    "cape_town_fog": {tr.HeterogeneousFog},
    "night_fog": {tr.HeterogeneousFog, tr.NightGlow},
    "limpopo_sun_glare": {tr.SunGlare},
    "highveld_heat_haze": {tr.RoadMirage, tr.Turbulence},
    "highveld_telephoto": {tr.PhysicalTurbulence, tr.TurbulenceBlur},
    "unpaved_road": {tr.HeterogeneousFog, tr.Turbulence, tr.RollingShutter},
    "paper_refractive": {tr.LensDistortion, tr.Turbulence, tr.ThinPlateSpline, tr.DivergenceFree},
    "paper_weather": {tr.UniformFog, tr.HeterogeneousFog, tr.LensFlare},
}

# Arguments of each effect of a scene that is not the paper's.
RARELY: dict[str, Any] = {"p": 0.25}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "cheap_dashcam": RARELY,
    "cape_town_fog": RARELY,
    "night_fog": {"glow": RARELY, **RARELY},
    "limpopo_sun_glare": RARELY,
    "highveld_heat_haze": {"mirage": RARELY, **RARELY},
    "highveld_telephoto": RARELY,
    "unpaved_road": {"dust": RARELY, "haze": RARELY, "shutter": RARELY},
}

_PINHOLE = {"width": 640, "height": 360, "fx": 500.0, "fy": 510.0, "cx": 326.5, "cy": 179.5}
PLACE: dict[str, Any] = {
    "camera": Camera(**_PINHOLE, coefficients=(0.0,) * 4, model="opencv"),
    "horizon": 0.4,
    "depth": tr.GroundPlaneDepth(),
    "width": 640,
}


@pytest.fixture(params=SCENES)
def scene(request) -> str:
    return request.param


def scene_for_size(name: str, severity: int = 3) -> Effect:
    """Create a scene for frames of SIZE."""
    takes_width = "width" in inspect.signature(SCENES[name]).parameters
    return SCENES[name](severity, **({"width": SIZE[1]} if takes_width else {}))


def leaves(effect: Effect) -> Iterator[Any]:
    if isinstance(effect, tr.Compose):
        for child in effect.effects:
            yield from leaves(child)  # pyright: ignore[reportArgumentType]  # effects hold effects
    else:
        yield effect


def strength(effect: Effect) -> float:
    """Add the mean displacement, the light lost and the light added of 6 samples."""
    d = effect.degrade(torch.full((6, 3, *SIZE), 0.5), seed=1)
    displacement = 0.0 if d.flow is None else (d.flow.norm(dim=1, keepdim=True) * d.valid).mean().item() / SIZE[1]
    lost = 0.0 if d.transmission is None else 1 - d.transmission.mean().item()
    added = 0.0 if d.intensity is None else d.intensity.mean().item()
    return 20 * displacement + lost + added


@pytest.mark.quick
def test_a_scene_has_its_effects_and_no_others(scene):
    assert {type(leaf) for leaf in leaves(scene_for_size(scene))} == EFFECTS[scene]
    assert EFFECTS.keys() == SCENES.keys()


def test_each_severity_is_stronger_than_the_one_before(scene):
    strengths = [strength(scene_for_size(scene, severity)) for severity in presets.SEVERITIES]
    assert all(later > 1.03 * earlier for earlier, later in pairwise(strengths))


@pytest.mark.quick
def test_the_default_severity_is_3_and_others_are_1_to_5(scene):
    assert repr(SCENES[scene]()) == repr(SCENES[scene](3)) != repr(SCENES[scene](4))
    assert repr(SCENES[scene](4.0)) == repr(SCENES[scene](4))
    for severity in (0, 6, 2.5, True, "3"):
        with pytest.raises(ValueError, match=f"severity must be one of 1, 2, 3, 4, 5, got {severity!r}"):
            SCENES[scene](severity)


def test_no_scene_folds_the_frame_at_its_largest_severity(scene):
    d = scene_for_size(scene, 5).degrade(torch.rand(12, 3, *SIZE), seed=1)  # warnings are errors
    if d.flow is not None:
        assert d.folding.fraction.max() < 0.002


@pytest.mark.quick
@pytest.mark.parametrize("severity", presets.SEVERITIES)
def test_no_lens_of_the_dashcam_is_so_near_a_fold_that_pixels_have_no_source(severity):
    effect = SCENES["cheap_dashcam"](severity)
    ends = product(effect.k1_range, effect.k2_range, effect.p1_range, effect.p2_range)
    k1, k2, p1, p2 = torch.tensor(list(ends), dtype=torch.float64).T
    zero = torch.zeros_like(k1)
    coefficients = torch.stack([k1, k2, zero, zero, zero, zero, p1, p2, zero, zero, zero, zero], dim=1)[..., None, None]
    r, angle = torch.linspace(0, 3, 601).double()[:, None], torch.linspace(0, 2 * torch.pi, 73).double()
    _, jacobian = distort_with_jacobian((r * angle.cos())[None], (r * angle.sin())[None], coefficients)
    assert jacobian.determinant.min() > 1 / 32


def test_severities_have_the_documented_values():
    image = torch.zeros(400, 3, *SIZE)
    for name, severity, field, low, high in (
        ("cape_town_fog", 1, "visibility", 500, 1000),
        ("cape_town_fog", 5, "visibility", 20, 40),
        ("limpopo_sun_glare", 5, "scatter", 0.2, 0.4),
        ("highveld_heat_haze", 5, "difference", 24, 36),
        ("unpaved_road", 5, "visibility", 20, 35),
    ):
        params = SCENES[name](severity).sample(image, seed=2)
        values = getattr(params.children[0] if hasattr(params, "children") else params, field)
        assert low <= values.min() < values.max() <= high
        assert values.mean().item() == pytest.approx((low + high) / 2, rel=0.03)
    for severity in presets.SEVERITIES:
        uniform, heterogeneous, flare = SCENES["paper_weather"](severity).effects
        assert uniform.visibility_range == heterogeneous.visibility_range == (300 / severity,) * 2
        assert sum(flare.strength_range) / 2 == pytest.approx(0.2 * severity)


@pytest.mark.quick
def test_a_camera_that_meters_fog_by_day_darkens_it_and_leaves_the_night():
    white, night = torch.full((1, 3, *SIZE), 0.75), torch.full((1, 3, *SIZE), 0.03)
    white[:, :, 40:] = 0.3
    night[:, :, 20:24, 40:44] = 0.6
    for frame, is_darker in ((white, True), (night, False)):
        scene: Any = presets.cape_town_fog(5, depth=tr.GroundPlaneDepth(), exposure=True)
        params = scene.sample(frame, seed=1)
        foggy = scene.effects[0].apply(frame, params.children[0]).image
        exposed = scene.apply(frame, params).image
        assert torch.allclose(exposed, foggy, atol=1e-3) is not is_darker
        assert exposed.mean() < 0.9 * foggy.mean() or not is_darker
    assert 0.15 < srgb_to_linear(presets.cape_town_fog(5, exposure=True).degrade(white, seed=1).image).mean() < 0.3


@pytest.mark.quick
def test_lamps_shine_through_fog_at_night_in_a_glow():
    frame = torch.full((1, 3, 90, 160), 0.05)
    frame[:, :, 30:33, 80:83] = 1.0
    frame[:, :, 30:33, 20:23] = 0.6  # a lit wall
    depth = torch.full((1, 1, 90, 160), 30.0)
    plain = presets.cape_town_fog(4).degrade(frame, seed=1, depth=depth).image
    foggy = presets.night_fog(4, glow={"optical_depth_range": (2.0, 2.0)}).degrade(frame, seed=1, depth=depth).image
    assert (plain[..., 31, 81] < 0.5).all()
    assert (foggy[..., 31, 81] > 0.95).all()
    assert (foggy[..., 31, 21] < 0.5).all()
    assert (foggy[..., 31, 86] > 1.5 * foggy[..., 80, 86]).all()  # around the lamp
    far = presets.night_fog(4).degrade(frame, seed=1, depth=4 * depth)  # a lamp is seen farther away than the road
    assert 2 * far.params.children[0].visibility < 120
    assert (far.image[..., 31, 81] > 0.95).all()
    assert (far.image[..., 31, 21] < 0.3).all()
    day = torch.full((1, 3, 90, 160), 0.7)
    day[:, :, 60:] = 0.3
    day[:, :, 70:73, 80:83] = 1.0
    road = torch.full((1, 3, 90, 160), 0.45)  # by day, seen from above, with its paint
    road[:, :, 70:73, 80:83] = 1.0
    for frame, distance in ((day, depth), (road, depth / 6)):
        bright = presets.night_fog(4).degrade(frame, seed=1, depth=distance)
        assert bright.intensity.max() == 0
        assert (bright.image[..., 71, 81] < 0.95).all()


def test_severities_of_heat_haze_have_the_documented_cn2():
    for severity, cn2 in zip(presets.SEVERITIES, (7.6e-11, 3e-10, 6.8e-10, 1.5e-9, 2.7e-9), strict=True):
        (haze,) = (e for e in SCENES["highveld_heat_haze"](severity).effects if isinstance(e, tr.Turbulence))
        low, high = (math.sqrt(value) for value in haze.equivalent_cn2(width=1920, distance=200.0))
        assert ((low + high) / 2) ** 2 == pytest.approx(cn2, rel=0.03)


@pytest.mark.quick
def test_the_paper_s_weather_has_the_paper_s_numbers():
    uniform, heterogeneous, flare = SCENES["paper_weather"]().effects
    d = uniform.degrade(torch.zeros(1, 3, *SIZE), seed=0)
    k = d.extinction / (1 + d.params.deviation)
    assert k.mean().item() == pytest.approx(-math.log(0.05) / 100, abs=1e-6)  # 0.029957 / m in the paper
    assert heterogeneous.scales == (4, 8, 16, 32, 64, 128)
    assert heterogeneous.weights == (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
    assert flare.strength_range == pytest.approx((0.55, 0.65))
    assert flare.radius_range == (0.25, 0.35)


@pytest.mark.quick
@pytest.mark.parametrize("name", ["highveld_heat_haze", "unpaved_road", "paper_refractive"])
def test_displacements_scale_with_the_width(name):
    wide, narrow = (SCENES[name](3, width=width) for width in (1920, 480))
    for first, second in zip(leaves(wide), leaves(narrow), strict=True):
        for option in ("amplitude_range", "length_range", "aperture_range"):
            if hasattr(first, option) and not isinstance(first, tr.HeterogeneousFog):
                assert getattr(first, option) == pytest.approx([4 * value for value in getattr(second, option)])
    with pytest.raises(ValueError, match="width must be above 0, got 0"):
        SCENES[name](3, width=0)


@pytest.mark.parametrize("name", ["paper_refractive", "paper_weather"])
def test_one_of_the_paper_s_effects_is_applied_to_each_sample(name):
    effect = scene_for_size(name)
    assert isinstance(effect, tr.OneOf)
    params = effect.sample(torch.zeros(200, 3, *SIZE), seed=1)
    applied = torch.stack([child.applied for child in params.children])
    assert (applied.sum(dim=0) == 1).all()
    assert (applied.sum(dim=1) > 30).all()


@pytest.mark.quick
@pytest.mark.parametrize("name", ARGUMENTS)
def test_camera_horizon_depth_width_and_other_arguments_reach_each_effect(name):
    def depth(image: torch.Tensor) -> torch.Tensor:
        return torch.full_like(image[:, :1], 50.0)

    camera = PLACE["camera"]
    scene = SCENES[name](camera=camera, horizon=0.4, depth=depth, width=640, **ARGUMENTS[name])
    for leaf in leaves(scene):
        assert leaf.p == 0.25
        view = getattr(leaf, "medium", leaf)
        assert getattr(view, "camera", camera) == camera
        assert view.depth is (None if isinstance(leaf, tr.LensDistortion | tr.SunGlare | tr.NightGlow) else depth)
        assert getattr(leaf, "horizon", 0.4) == 0.4
        assert getattr(leaf, "focal", 500 / 640) == 500 / 640
    with pytest.raises(TypeError, match="mistyped"):
        SCENES[name](mistyped=1)


@pytest.mark.quick
def test_arguments_of_one_effect_may_come_from_a_configuration():
    given = OmegaConf.create({"vehicle_labels": None, "dust": {"wake_length": 7.0}, "haze": {"length_range": [9, 9]}})
    scene = instantiate({"_target_": "torchrefract.presets.unpaved_road", **given})
    assert scene.effects[0].wake_length == 7.0
    assert scene.effects[1].length_range == (9.0, 9.0)
    glow = instantiate({"_target_": "torchrefract.presets.night_fog", "glow": {"threshold": 0.5}}).effects[1]
    assert glow.threshold == 0.5


@pytest.mark.quick
def test_each_scene_takes_camera_horizon_depth_and_width_and_the_page_says_which_it_uses(scene):
    lines = [line.split(maxsplit=1) for line in str(presets.__doc__).splitlines() if line.startswith("    ")]
    used = {name for name in PLACE if name in dict(line for line in lines if len(line) == 2)[scene]}
    assert used == {
        name for name, value in PLACE.items() if repr(SCENES[scene](**{name: value})) != repr(SCENES[scene]())
    }
    SCENES[scene](**PLACE)
    with pytest.raises(TypeError, match="camera must be a Camera, got int"):
        SCENES[scene](camera=1)


@pytest.mark.quick
@pytest.mark.parametrize("size", [(54, 96), (72, 96), (96, 54), (1, 1)])
def test_the_telephoto_haze_takes_frames_of_any_shape_and_has_a_focal_length_of_four_widths(size):
    height, width = size
    options = {"width": width, "height": height, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    camera = Camera(**options, fx=4.0 * width, fy=4.0 * width, coefficients=(0.0,) * 4, model="opencv")
    image, depth = torch.rand(1, 3, height, width), torch.full((1, 1, height, width), 800.0)
    unknown, known = (
        SCENES["highveld_telephoto"](5, tolerance_px=None, **given).degrade(image, seed=3, depth=depth)
        for given in ({}, {"camera": camera})
    )
    assert torch.equal(unknown.flow, known.flow)
    assert unknown.flow.any() or size == (1, 1)


@pytest.mark.quick
def test_a_gray_frame_is_degraded_by_each_scene_with_the_luminance_of_its_colors(scene):
    effect = scene_for_size(scene)
    gray = effect.degrade(torch.rand(2, 1, *SIZE), seed=1)
    assert gray.image.shape == (2, 1, *SIZE)
    if scene == "limpopo_sun_glare":
        luminance = 0.2126 + 0.7152 * 0.94 + 0.0722 * 0.82
        assert gray.params.color.flatten().tolist() == pytest.approx([luminance] * 2)
