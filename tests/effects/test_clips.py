"""Clips: one draw for all frames, fields that move, and every frame computable alone."""

import math
from typing import Any

import pytest
import torch
from helpers import assert_close_maps, maps_of, random_image, seeded
from torch import Tensor
from torch.testing import assert_close
from torchvision import tv_tensors

import torchrefract as tr
from torchrefract.effects.base import Effect

FIELD: dict[str, Any] = {"amplitude_range": (0.5, 1.0), "length_range": (6.0, 9.0)}
FAST: dict[str, Any] = {"wind_x_range": (-2.0, 2.0), "wind_y_range": (-2.0, 2.0), "decorrelation_range": (2.0, 4.0)}
SINGLE: dict[str, Effect] = {
    "lens": tr.LensDistortion(),
    "turbulence": tr.Turbulence(**FIELD, **FAST),
    "thin plate": tr.ThinPlateSpline(amplitude_range=(1.0, 2.0)),
    "divergence-free": tr.DivergenceFree(**FIELD, **FAST, steps=2),
    "rolling shutter": tr.RollingShutter(),
    "vignetting": tr.Vignetting(),
    "chromatic aberration": tr.ChromaticAberration(red_range=(0.02, 0.05)),
    "flare": tr.LensFlare(drift_x_range=(0.01, 0.02)),
    "sun glare": tr.SunGlare(drift_x_range=(0.01, 0.02)),
    "exposure": tr.Exposure(gamma_range=(0.5, 1.0)),
    "fog": tr.UniformFog(),
    "heterogeneous fog": tr.HeterogeneousFog(wind_x_range=(5.0, 9.0), decorrelation_range=(2.0, 4.0)),
    "volumetric fog": tr.HeterogeneousFog(mode="ray", wind_z_range=(-2.0, -1.0), decorrelation_range=(2.0, 4.0)),
}
COMPOSED: dict[str, Effect] = {
    "compose": tr.Compose(list(SINGLE.values())),
    "one of": tr.OneOf(list(SINGLE.values())),
    "blurred turbulence": tr.BlurredTurbulence(tr.PhysicalTurbulence(cn2_range=(1e-11, 3e-11), focal=40.0)),
    "with p of 0.5": tr.Compose(
        [tr.LensDistortion(p=0.5), tr.Turbulence(**FIELD, **FAST, p=0.5), tr.UniformFog(p=0.5)]
    ),
}
EFFECTS = SINGLE | COMPOSED


@pytest.fixture(params=EFFECTS)
def effect(request) -> Effect:
    return EFFECTS[request.param]


def test_a_frame_alone_equals_that_of_its_clip(effect):
    clip, keys, depth = random_image(3, 4, 3, 20, 30), [5, 2**40, -3], 100 * random_image(3, 4, 1, 20, 30)
    together = maps_of(effect.degrade(clip, seed=7, keys=keys, depth=depth))
    for t in (0, 3):
        alone = maps_of(effect.degrade(clip[:, t], seed=7, keys=keys, depth=depth[:, t], frame=t))
        assert_close_maps(alone, {name: value[:, t] for name, value in together.items()})
    single = maps_of(effect.degrade(clip[1, 2], seed=7, keys=keys[1:2], depth=depth[1, 2], frame=2))
    assert_close_maps(single, {name: value[1, 2] for name, value in together.items()})


def test_a_clip_in_pieces_equals_the_clip(effect):
    clip = random_image(2, 4, 3, 20, 30)
    together = maps_of(effect.degrade(clip, seed=7))
    pieces = [maps_of(effect.degrade(clip[:, i : i + 2], seed=7, frame=i)) for i in (0, 2)]
    assert_close_maps({name: torch.cat([piece[name] for piece in pieces], dim=1) for name in together}, together)
    starts = torch.tensor([2.0, 1.0])
    shifted = effect.degrade(torch.stack([clip[0, 2:4], clip[1, 1:3]]), seed=7, frame=starts).image
    expected = torch.stack([together["image"][0, 2:4], together["image"][1, 1:3]])
    assert_close(shifted, expected, rtol=0, atol=1e-5)


def test_a_clip_of_one_frame_equals_the_image(effect):
    image = random_image(2, 3, 20, 30)
    clip = maps_of(effect.degrade(image[:, None], seed=7))
    assert_close_maps({name: value[:, 0] for name, value in clip.items()}, maps_of(effect.degrade(image, seed=7)))


def test_params_repeat_a_clip_and_each_of_its_frames(effect):
    clip = random_image(2, 3, 3, 20, 30)
    degraded = effect.degrade(clip, seed=7)
    again = effect.apply(clip, degraded.params)
    assert torch.equal(again.image, degraded.image)
    assert_close(effect.apply(clip[:, 2], degraded.params, frame=2).image, degraded.image[:, 2], rtol=0, atol=1e-5)


def test_a_video_of_torchvision_is_one_clip():
    effect, clip = EFFECTS["compose"], random_image(4, 3, 20, 30, dtype=torch.uint8)
    video = tv_tensors.Video(clip)
    expected = maps_of(effect.degrade(clip[None], seed=7))
    assert_close_maps(
        maps_of(effect.degrade(video, seed=7, keys=[0])), {name: value[0] for name, value in expected.items()}
    )
    result = seeded(effect, video)
    assert type(result) is tv_tensors.Video
    assert torch.equal(result.as_subclass(Tensor), seeded(effect, clip[None])[0])


def test_masks_of_a_video_move_frame_by_frame():
    effect, clip = EFFECTS["turbulence"], random_image(4, 3, 20, 30)
    mask = (random_image(4, 20, 30) > 0.5).long()
    _, target = seeded(effect, tv_tensors.Video(clip), {"masks": tv_tensors.Mask(mask)})
    flow = seeded(effect.degrade, clip[None]).flow[0]
    assert torch.equal(target["masks"].as_subclass(Tensor), tr.warp_mask(mask[:, None], flow)[:, 0])
    assert not torch.equal(target["masks"].as_subclass(Tensor), mask)


@pytest.mark.quick
def test_a_target_of_several_clips_raises_whether_they_move_or_not():
    for effect in (EFFECTS["turbulence"], tr.Turbulence(p=0)):
        with pytest.raises(TypeError, match="target must be None for a batch of clips"):
            effect(random_image(2, 3, 3, 20, 30), {"id": 1})
    _, target = EFFECTS["fog"](random_image(2, 3, 3, 20, 30), {"id": 1})
    assert target == {"id": 1}


@pytest.mark.quick
def test_only_effects_that_move_change_over_a_clip():
    clip = random_image(1, 1, 3, 20, 30).expand(2, 4, -1, -1, -1)
    for name, effect in SINGLE.items():
        frames = effect.degrade(clip, seed=7, keys=[3, 4]).image
        moves = (frames != frames[:, :1]).flatten(2).any(dim=2)[:, 1:]
        is_still = name in ("lens", "thin plate", "vignetting", "chromatic aberration", "fog", "exposure")
        assert not moves.any() if is_still else moves.all(), name


def test_one_graph_degrades_a_clip_as_eager_mode():
    effect = tr.Compose([tr.Turbulence(**FIELD, **FAST, depth=tr.GroundPlaneDepth())])
    clip = random_image(2, 3, 3, 16, 20)
    compiled = torch.compile(lambda clip: effect.degrade(clip, seed=7, frame=5).image, fullgraph=True, backend="eager")
    assert_close(compiled(clip), effect.degrade(clip, seed=7, frame=5).image, rtol=0, atol=2e-4)


def flows_at_frames(effect: Effect, frames: Tensor, *, size: tuple[int, int], keys: int) -> Tensor:
    """Return (keys, T, H, W), px, the horizontal flow of many draws at some frames."""
    return effect.degrade(torch.zeros(keys, len(frames), 1, *size), seed=1, frame=frames[0]).flow[:, :, 0]


def test_fields_and_fog_decorrelate_in_their_decorrelation_time(oracle):
    still: dict[str, Any] = {
        "decorrelation_range": (12.0, 12.0),
        "wind_x_range": (0.0, 0.0),
        "wind_y_range": (0.0, 0.0),
    }
    ranges: dict[str, Any] = {"amplitude_range": (0.1, 0.1), "length_range": (4.0, 4.0), **still}
    noise: dict[str, Any] = {"scales": (4.0, 8.0), "weights": (1.0, 1.0), "reference_width": 64.0, "mean": "ensemble"}
    fog = tr.HeterogeneousFog(deviation_range=(0.0, 0.0), **noise, **still)
    values = {
        kind.__name__: flows_at_frames(kind(**ranges), torch.arange(40), size=(96, 96), keys=8)
        for kind in (tr.Turbulence, tr.DivergenceFree)
    }
    values["fog"] = fog.degrade(torch.zeros(8, 60, 1, 48, 64), seed=1).extinction[:, :, 0] + math.log(0.05) / 100
    for name, value in values.items():
        power = value.square().mean()
        for lag in (6, 12):  # the correlation is exp(-(lag / 12 frames)^2)
            time = lag / (-((value[:, :-lag] * value[:, lag:]).mean() / power).log()).sqrt()
            oracle(f"decorrelation time of {name}, frames", time, torch.tensor(12.0), 1.2, unit="")
        assert abs((value[:, :-30] * value[:, 30:]).mean() / power) < 0.03


@pytest.mark.parametrize("kind", [tr.Turbulence, tr.DivergenceFree])
def test_a_field_changes_with_constant_strength_and_speed_and_without_a_seam(kind, oracle):
    effect = kind(amplitude_range=(0.1, 0.1), length_range=(4.0, 4.0), decorrelation_range=(12.0, 12.0))
    flows = 10 * flows_at_frames(effect, torch.arange(60), size=(96, 128), keys=2).double()
    strength = flows.square().mean(dim=(2, 3)).sqrt()
    mean = strength.mean(dim=1, keepdim=True).expand(-1, 60)
    oracle(f"change of the strength of {kind.__name__}, of its mean", strength, mean, 0.15, unit="")
    assert strength.std(dim=1).max() < 0.05
    steps = flows.diff(dim=1).square().mean(dim=(2, 3)).sqrt()
    largest = steps.amax(dim=1) / steps.mean(dim=1)
    oracle(f"largest step of {kind.__name__}, of the mean", largest, torch.ones_like(largest), 0.15, unit="")
    across = flows.diff(dim=3).square().mean(dim=(1, 2))
    assert (across.amax(dim=1) / across.mean(dim=1)).max() < 2


@pytest.mark.quick
def test_a_clip_without_frames_raises(effect):
    with pytest.raises(ValueError, match=r"image must have at least one frame in a clip, got \(2, 0, 3, 8, 9\)"):
        effect.degrade(torch.zeros(2, 0, 3, 8, 9))


@pytest.mark.quick
def test_a_batch_without_clips_has_empty_maps(effect):
    for name, value in maps_of(effect.degrade(torch.zeros(0, 4, 3, 8, 9), seed=7)).items():
        assert value.shape[:2] == (0, 4), name


@pytest.mark.quick
@pytest.mark.parametrize("name", ["fog", "compose"])
def test_one_depth_for_all_frames_needs_a_time_dimension_of_one(name):
    clip, depth, effect = random_image(2, 4, 3, 8, 9), 100 * random_image(2, 1, 8, 9), EFFECTS[name]
    static = effect.degrade(clip, seed=7, depth=depth[:, None]).image
    repeated = effect.degrade(clip, seed=7, depth=depth[:, None].expand(-1, 4, -1, -1, -1)).image
    assert_close(static, repeated, rtol=0, atol=1e-5)
    rule = r"depth must .* \(2, 4, 1, 8, 9\), or \(2, 1, 1, 8, 9\) if it is the same .* got \(2, 1, 8, 9\)"
    with pytest.raises(ValueError, match=rule):
        effect.degrade(clip, seed=7, depth=depth)


@pytest.mark.quick
@pytest.mark.parametrize("value", [math.nan, math.inf, torch.tensor([1.0, math.nan]), torch.tensor([1.0, 3e38]), -3e38])
def test_an_invalid_frame_number_raises(value):
    with pytest.raises(ValueError, match=r"frame must (not be NaN|lie in \[-1e\+09, 1e\+09\])"):
        EFFECTS["turbulence"].degrade(random_image(2, 3, 8, 9), seed=7, frame=value)


@pytest.mark.quick
def test_frame_numbers_of_another_batch_or_clip_raise():
    effect, clip = EFFECTS["compose"], random_image(2, 4, 3, 8, 9)
    with pytest.raises(ValueError, match=r"frame must be a number, or one for each of 2 samples, got \(3,\)"):
        effect.degrade(clip, seed=7, frame=torch.zeros(3))
    params = effect.sample(clip, seed=7)
    with pytest.raises(ValueError, match=r"params\.frame must have shape \(2, 1\), a number for each frame"):
        effect.apply(clip[:, 0], params)
