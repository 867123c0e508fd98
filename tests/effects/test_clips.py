"""Clips: one draw for all frames, fields that move on, and every frame computable alone."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.types import Degraded

MAPS = ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission", "extinction", "intensity")
AIR: dict[str, Any] = {"amplitude_range": (0.5, 1.0), "length_range": (6.0, 9.0)}
FAST: dict[str, Any] = {"wind_x_range": (-2.0, 2.0), "wind_y_range": (-2.0, 2.0), "decorrelation_range": (2.0, 4.0)}
EFFECTS: dict[str, Effect] = {
    "lens": tr.LensDistortion(),
    "turbulence": tr.Turbulence(**AIR, **FAST),
    "thin plate": tr.ThinPlateSpline(amplitude_range=(1.0, 2.0)),
    "divergence-free": tr.DivergenceFree(**AIR, **FAST, steps=2),
    "flare": tr.LensFlare(drift_x_range=(0.01, 0.02)),
    "fog": tr.UniformFog(),
    "drifts": tr.HeterogeneousFog(wind_x_range=(5.0, 9.0), decorrelation_range=(2.0, 4.0)),
    "drifts in space": tr.HeterogeneousFog(mode="ray", wind_z_range=(-2.0, -1.0), decorrelation_range=(2.0, 4.0)),
}
EFFECTS["compose"] = tr.Compose(list(EFFECTS.values()))
EFFECTS["one of"] = tr.OneOf(list(EFFECTS.values()))
EFFECTS["sometimes"] = tr.Compose([tr.LensDistortion(p=0.5), tr.Turbulence(**AIR, **FAST, p=0.5), tr.UniformFog(p=0.5)])


@pytest.fixture(params=EFFECTS)
def effect(request) -> Effect:
    return EFFECTS[request.param]


def clips(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (255 * image).round().to(dtype) if dtype is torch.uint8 else image.to(dtype)


def maps(degraded: Degraded) -> dict[str, Tensor]:
    return {name: getattr(degraded, name) for name in MAPS if getattr(degraded, name) is not None}


def assert_same(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
def test_a_frame_alone_is_that_of_its_clip(effect, dtype):
    clip, keys = clips(3, 4, 3, 20, 30, dtype=dtype), [5, 2**40, -3]
    depth = 100 * clips(3, 4, 1, 20, 30)
    whole = maps(effect.degrade(clip, seed=7, keys=keys, depth=depth))
    assert whole["image"].dtype == dtype
    for t in range(4):
        alone = maps(effect.degrade(clip[:, t], seed=7, keys=keys, depth=depth[:, t], frame=t))
        assert_same(alone, {name: value[:, t] for name, value in whole.items()})
    one = maps(effect.degrade(clip[1, 2], seed=7, keys=keys[1:2], depth=depth[1, 2], frame=2))
    assert_same(one, {name: value[1, 2] for name, value in whole.items()})


def test_frame_37_of_60_alone_is_that_of_the_clip(effect):
    clip = clips(1, 60, 3, 24, 32)
    whole = effect.degrade(clip, seed=7)
    alone = effect.degrade(clip[:, 37], seed=7, frame=37)
    assert torch.equal(alone.image, whole.image[:, 37])


def test_a_clip_in_pieces_is_the_clip(effect):
    clip = clips(2, 6, 3, 20, 30)
    whole = maps(effect.degrade(clip, seed=7))
    pieces = [maps(effect.degrade(clip[:, i : i + 2], seed=7, frame=i)) for i in (0, 2, 4)]
    assert_same({name: torch.cat([piece[name] for piece in pieces], dim=1) for name in whole}, whole)
    starts = torch.tensor([4.0, 1.0])
    shifted = effect.degrade(torch.stack([clip[0, 4:6], clip[1, 1:3]]), seed=7, frame=starts).image
    assert torch.equal(shifted[0], whole["image"][0, 4:6])
    assert torch.equal(shifted[1], whole["image"][1, 1:3])


def test_a_clip_of_one_frame_is_the_image(effect):
    image = clips(2, 3, 20, 30)
    clip = maps(effect.degrade(image[:, None], seed=7))
    assert_same({name: value[:, 0] for name, value in clip.items()}, maps(effect.degrade(image, seed=7)))


def test_params_replay_a_clip_and_each_of_its_frames(effect):
    clip = clips(2, 3, 3, 20, 30)
    whole = effect.degrade(clip, seed=7)
    assert_same(maps(effect.apply(clip, whole.params)), maps(whole))
    for t in range(3):
        assert torch.equal(effect.apply(clip[:, t], whole.params, frame=t).image, whole.image[:, t])


def test_a_video_of_torchvision_is_one_clip(effect):
    tv_tensors = pytest.importorskip("torchvision.tv_tensors", reason="torchvision is in the extra test")
    clip = clips(4, 3, 20, 30, dtype=torch.uint8)
    video = tv_tensors.Video(clip)
    expected = maps(effect.degrade(clip[None], seed=7))
    found = maps(effect.degrade(video, seed=7, keys=[0]))
    assert_same(found, {name: value[0] for name, value in expected.items()})
    torch.manual_seed(3)
    shown = effect(video)
    torch.manual_seed(3)
    assert type(shown) is tv_tensors.Video
    assert torch.equal(shown.as_subclass(Tensor), effect(clip[None])[0])


def test_masks_of_a_video_move_frame_by_frame():
    tv_tensors = pytest.importorskip("torchvision.tv_tensors", reason="torchvision is in the extra test")
    effect, clip = EFFECTS["turbulence"], clips(4, 3, 20, 30)
    mask = (clips(4, 20, 30) > 0.5).long()
    torch.manual_seed(3)
    _, target = effect(tv_tensors.Video(clip), {"masks": tv_tensors.Mask(mask)})
    torch.manual_seed(3)
    flow = effect.degrade(clip[None]).flow[0]
    assert torch.equal(target["masks"].as_subclass(Tensor), tr.warp_mask(mask[:, None], flow)[:, 0])
    assert not torch.equal(target["masks"].as_subclass(Tensor), mask)


def test_a_target_beside_several_clips_raises_whether_they_move_or_not():
    for effect in (EFFECTS["turbulence"], tr.Turbulence(p=0)):
        with pytest.raises(TypeError, match="target must be None beside several clips"):
            effect(clips(2, 3, 3, 20, 30), {"id": 1})
    _, target = EFFECTS["fog"](clips(2, 3, 3, 20, 30), {"id": 1})
    assert target == {"id": 1}


def test_what_does_not_change_is_computed_once_a_clip(monkeypatch):
    seen: list[int] = []
    for kind in (tr.LensDistortion, tr.ThinPlateSpline):
        for name in ("flow", "undo"):
            original = getattr(kind, name)

            def counted(self: Any, params: Any, *args: Any, original: Any = original, **options: Any) -> Any:
                seen.append(len(params.applied))
                return original(self, params, *args, **options)

            monkeypatch.setattr(kind, name, counted)
    effect = tr.Compose([tr.ThinPlateSpline(), tr.Turbulence(**AIR), tr.LensDistortion()])
    made = effect.degrade(clips(2, 5, 3, 20, 30), seed=7)
    assert made.restore_flow.shape == (2, 5, 2, 20, 30)
    assert seen == [2, 2, 2, 2]


def test_static_effects_stand_still_and_fields_move():
    clip = clips(1, 1, 3, 20, 30).expand(2, 5, -1, -1, -1)
    for name, effect in EFFECTS.items():
        frames = effect.degrade(clip, seed=7, keys=[3, 4]).image
        moves = (frames != frames[:, :1]).flatten(2).any(dim=2)[:, 1:]
        if name in ("lens", "thin plate", "fog"):
            assert not moves.any(), name
        elif name not in ("one of", "sometimes"):
            assert moves.all(), name


def test_gradients_reach_what_moves_a_field():
    effect = tr.Turbulence(**AIR)
    clip = clips(1, 2, 1, 5, 7, dtype=torch.float64)
    params = effect.sample(clip, seed=7, frame=3.5)
    names = ("amplitude", "length", "aperture", "wind", "decorrelation", "frame")

    def degrade(image: Tensor, *values: Tensor) -> Tensor:
        return effect.apply(image, params._replace(**dict(zip(names, values, strict=True)))).image

    inputs = [clip, *(getattr(params, name).clone() for name in names)]
    assert torch.autograd.gradcheck(degrade, [value.requires_grad_() for value in inputs])


def test_one_graph_gives_the_same_clip():
    effect = tr.Compose([tr.UniformFog(), tr.Turbulence(**AIR, **FAST), tr.LensDistortion()])
    clip = clips(2, 3, 3, 16, 20)
    compiled = torch.compile(lambda clip: effect.degrade(clip, seed=7, frame=5).image, fullgraph=True)
    assert_close(compiled(clip), effect.degrade(clip, seed=7, frame=5).image, rtol=0, atol=2e-4)


# --- how fields move on


def fields(effect: Effect, frames: Tensor, *, size: tuple[int, int], keys: int) -> Tensor:
    """(keys, T, H, W): the horizontal flow at some frames, of many draws."""
    images = torch.zeros(keys, 1, *size)
    return torch.stack([effect.degrade(images, seed=1, frame=float(t)).flow[:, 0] for t in frames], dim=1)


STILL: dict[str, Any] = {"decorrelation_range": (12.0, 12.0), "wind_x_range": (0.0, 0.0), "wind_y_range": (0.0, 0.0)}


def assert_forgets_itself(what: str, found: Tensor, oracle) -> None:
    """Of (keys, 60, values), deviations from a mean: 12 frames, from the correlations over 3 to 15 of them."""
    power = found.square().mean()
    for lag in (3, 6, 9, 12, 15):
        correlation = ((found[:, :-lag] * found[:, lag:]).mean() / power).item()
        time = torch.tensor(lag / math.sqrt(-math.log(correlation)))
        oracle(f"decorrelation time of {what}, frames", time, torch.tensor(12.0), 1.2, unit="")
    assert abs((found[:, :-30] * found[:, 30:]).mean() / power) < 0.03


@pytest.mark.parametrize("kind", [tr.Turbulence, tr.DivergenceFree])
def test_a_field_forgets_itself_in_its_decorrelation_time(kind, oracle):
    effect = kind(amplitude_range=(0.1, 0.1), length_range=(4.0, 4.0), **STILL)
    found = fields(effect, torch.arange(60), size=(128, 128), keys=6).flatten(2)
    assert_forgets_itself(kind.__name__, found, oracle)


def test_drifts_in_the_image_forget_themselves_in_their_decorrelation_time(oracle):
    drifts: dict[str, Any] = {"scales": (4.0, 8.0), "weights": (1.0, 1.0), "reference_width": 64.0, "mean": "ensemble"}
    effect = tr.HeterogeneousFog(deviation_range=(0.0, 0.0), **drifts, **STILL)
    found = effect.degrade(torch.zeros(8, 60, 1, 48, 64), seed=1).extinction.double().flatten(2)
    assert_forgets_itself("drifts in the image", found + math.log(0.05) / 100, oracle)


@pytest.mark.parametrize("kind", [tr.Turbulence, tr.DivergenceFree])
def test_a_field_neither_pulses_nor_jumps(kind, oracle):
    effect = kind(amplitude_range=(0.1, 0.1), length_range=(4.0, 4.0), decorrelation_range=(12.0, 12.0))
    found = 10 * fields(effect, torch.arange(60), size=(96, 128), keys=2).double()
    strength = found.square().mean(dim=(2, 3)).sqrt()
    oracle(
        f"pulse of {kind.__name__}, of its strength",
        strength,
        strength.mean(dim=1, keepdim=True).expand(-1, 60),
        0.15,
        unit="",
    )
    assert strength.std(dim=1).max() < 0.05
    steps = found.diff(dim=1).square().mean(dim=(2, 3)).sqrt()
    largest = steps.amax(dim=1) / steps.mean(dim=1)
    oracle(f"largest step of {kind.__name__}, of the mean", largest, torch.ones_like(largest), 0.15, unit="")
    # Nor is there a seam in the frame: no column differs from its neighbor more than others do.
    across = found.diff(dim=3).square().mean(dim=(1, 2))
    assert (across.amax(dim=1) / across.mean(dim=1)).max() < 2


def test_the_wind_carries_a_field_that_does_not_change():
    wind: dict[str, Any] = {
        "wind_x_range": (3.0, 3.0),
        "wind_y_range": (-2.0, -2.0),
        "decorrelation_range": (math.inf, math.inf),
    }
    effect = tr.Turbulence(amplitude_range=(1.0, 1.0), length_range=(5.0, 5.0), **wind)
    found = fields(effect, torch.tensor([0.0, 4.0, 1e5, 1e5 + 4]), size=(40, 60), keys=1)[0]
    for first, second in (found[:2], found[2:]):
        assert_close(second[:-8, 12:], first[8:, :-12], rtol=0, atol=2e-5)


# --- bad input


def test_a_clip_without_frames_raises(effect):
    with pytest.raises(ValueError, match=r"image must have at least one frame in a clip, got \(2, 0, 3, 8, 9\)"):
        effect.degrade(torch.zeros(2, 0, 3, 8, 9))


def test_a_batch_without_clips_stays_one(effect):
    for name, value in maps(effect.degrade(torch.zeros(0, 4, 3, 8, 9), seed=7)).items():
        assert value.shape[:2] == (0, 4), name


def test_a_tensor_of_another_rank_raises(effect):
    with pytest.raises(ValueError, match=r"image must have shape .* \(B, T, C, H, W\), got \(1, 1, 2, 3, 8, 9\)"):
        effect.degrade(torch.zeros(1, 1, 2, 3, 8, 9))


def test_a_depth_of_one_frame_for_a_clip_is_static_by_its_shape_or_raises():
    clip, depth = clips(2, 4, 3, 8, 9), 100 * clips(2, 1, 8, 9)
    for effect in (EFFECTS["fog"], EFFECTS["compose"]):
        static = effect.degrade(clip, seed=7, depth=depth[:, None]).image
        repeated = effect.degrade(clip, seed=7, depth=depth[:, None].expand(-1, 4, -1, -1, -1)).image
        assert torch.equal(static, repeated)
        rule = r"depth must .* \(2, 4, 1, 8, 9\), or \(2, 1, 1, 8, 9\) where it is the same .* got \(2, 1, 8, 9\)"
        with pytest.raises(ValueError, match=rule):
            effect.degrade(clip, seed=7, depth=depth)


@pytest.mark.parametrize(
    ("frame", "rule"),
    [
        (math.nan, "not be NaN, got nan"),
        (math.inf, r"be a number in \[-1e\+09, 1e\+09\], got inf"),
        (torch.tensor([1.0, math.nan]), r"lie in \[-1e\+09, 1e\+09\], got nan"),
        (torch.tensor([1.0, 3e38]), r"lie in \[-1e\+09, 1e\+09\], got 3e\+38"),
        (-3e38, r"be a number in \[-1e\+09, 1e\+09\], got -3e\+38"),
    ],
)
def test_a_frame_that_is_no_number_raises(frame, rule):
    with pytest.raises(ValueError, match=f"frame must {rule}"):
        EFFECTS["turbulence"].degrade(clips(2, 3, 8, 9), seed=7, frame=frame)


def test_frames_that_do_not_fit_raise():
    effect, clip = EFFECTS["compose"], clips(2, 4, 3, 8, 9)
    with pytest.raises(ValueError, match=r"frame must be a number, or one for each of 2 samples, got \(3,\)"):
        effect.degrade(clip, seed=7, frame=torch.zeros(3))
    params = effect.sample(clip, seed=7)
    with pytest.raises(ValueError, match=r"params\.frame must have shape \(2, 1\), a number for each frame"):
        effect.apply(clip[:, 0], params)
