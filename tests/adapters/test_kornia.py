"""Effects inside containers of kornia."""

import importlib
import sys

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from torchrefract import LensDistortion, Turbulence, UniformFog, warp_boxes, warp_mask, warp_points

K = pytest.importorskip("kornia.augmentation", reason="kornia is in the extra train")
adapter = pytest.importorskip("torchrefract.adapters.kornia", reason="kornia is in the extra train")

SIZE = (64, 80)
KEYS = ["input", "mask", "keypoints", "bbox_xyxy", "mask", "label"]
BOXES = torch.tensor([[[10.0, 8, 30, 25], [40, 30, 70, 60]], [[20.0, 20, 50, 50], [0, 0, 80, 64]]])


def inputs() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, 5, 2, generator=generator) * 40 + 15
    soft, image = (torch.rand(2, channels, *SIZE, generator=generator) for channels in (1, 3))
    ids = torch.randint(0, 9, (2, *SIZE), generator=generator)
    return [image, soft, points, BOXES, ids, torch.tensor([4, 5])]


@pytest.mark.quick
@pytest.mark.parametrize("effect", [LensDistortion(k1_range=(-0.4, 0.3)), Turbulence(), UniformFog()])
def test_masks_boxes_and_keypoints_follow_the_image(effect):
    container = K.AugmentationSequential(adapter.KorniaEffect(effect), data_keys=KEYS)
    image, soft, points, boxes, ids, label = inputs()
    outputs = container(*inputs())
    params = container._params[0].data
    degraded = effect.degrade(image, seed=params["seed"], keys=params["keys"])
    assert_close(outputs[0], degraded.image)
    assert torch.equal(outputs[5], label)
    if degraded.flow is None:
        expected = [soft, points, boxes, ids[:, None]]
    else:
        edges = torch.tensor([-0.5, -0.5, 0.5, 0.5])  # of the first and last pixels, which kornia's boxes name
        moved = warp_boxes(boxes + edges, degraded.flow)[0] - edges
        expected = [warp_mask(soft, degraded.flow), warp_points(points, degraded.flow)[0], moved]
        expected.append(warp_mask(ids[:, None], degraded.flow))
    for output, value in zip((outputs[1], outputs[2], outputs[3], outputs[4]), expected, strict=True):
        # Flows of the same draw agree to 1e-4 px, which decides the nearest pixel halfway between two.
        assert ((output - value).abs() > 1e-3).float().mean() < 1e-3
    again = container(*inputs(), params=container._params)
    assert all(map(torch.equal, outputs, again))


def test_labels_follow_a_depth_that_is_computed_from_the_image():
    near_or_far = Turbulence(depth=lambda image: 20 + 800 * image.mean(dim=1, keepdim=True))
    container = K.AugmentationSequential(adapter.KorniaEffect(near_or_far), data_keys=["input", "keypoints"])
    image, _, points, *_ = inputs()
    _, moved = container(image, points)
    params = container._params[0].data
    flow = near_or_far.degrade(image, seed=params["seed"], keys=params["keys"]).flow
    assert_close(moved, warp_points(points, flow)[0], rtol=0, atol=1e-3)
    assert (moved - points).abs().max() > 0.1
    other = K.AugmentationSequential(adapter.KorniaEffect(near_or_far), data_keys=["input"])
    with pytest.raises(ValueError, match="labels must be passed in one call with their image"):
        other(points, params=container._params, data_keys=["keypoints"])


@pytest.mark.parametrize("same_on_batch", [False, True])
def test_a_list_with_a_mask_for_each_image_follows_the_flow_of_that_image(same_on_batch):
    near_or_far = Turbulence(depth=lambda image: 20 + 800 * image.mean(dim=1, keepdim=True))
    effect = adapter.KorniaEffect(near_or_far, same_on_batch=same_on_batch)
    container = K.AugmentationSequential(effect, data_keys=["input", "mask"])
    image, soft, *_ = inputs()
    _, listed = container(image, list(soft))
    _, together = container(image, soft, params=container._params)
    assert_close(torch.cat(listed), together)
    assert not torch.equal(together, soft)


def test_frames_of_a_clip_share_a_draw_that_their_labels_follow():
    effect = LensDistortion(k1_range=(-0.4, 0.3))
    clips = K.VideoSequential(adapter.KorniaEffect(effect), data_format="BTCHW", same_on_frame=True)
    container = K.AugmentationSequential(clips, data_keys=["input", "mask", "keypoints"])
    image, soft, points, *_ = inputs()
    frames, masks, moved = container(*(value[:, None].repeat_interleave(3, dim=1) for value in (image, soft, points)))
    params = container._params[0].data[0].data
    degraded = effect.degrade(image, seed=params["seed"][:1], keys=params["keys"][::3])
    assert not torch.equal(degraded.flow[0], degraded.flow[1])
    for t in range(3):
        assert_close(frames[:, t], degraded.image)
        assert ((masks[:, t] - warp_mask(soft, degraded.flow)).abs() > 1e-3).float().mean() < 1e-3
        expected, is_visible = warp_points(points, degraded.flow)
        assert is_visible.any(dim=1).all()
        assert_close(moved[:, t][is_visible], expected[is_visible], rtol=0, atol=1e-3)  # others have no one place


@pytest.mark.quick
def test_what_is_no_effect_raises():
    with pytest.raises(TypeError, match=r"effect must be an effect of torchrefract, got Identity$"):
        adapter.KorniaEffect(nn.Identity())  # pyright: ignore[reportArgumentType]  # the test is of this


def test_without_kornia_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "kornia.constants", None)
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(ImportError, match="needs kornia: pip install kornia"):
        importlib.import_module(adapter.__name__)


def test_a_kornia_that_leaves_labels_behind_is_refused(monkeypatch):
    monkeypatch.setattr("kornia.__version__", "0.8.3")
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(ImportError, match=r"needs kornia 0\.9, .* got 0\.8\.3: pip install -U kornia"):
        importlib.import_module(adapter.__name__)


def test_extra_args_of_the_container_interpolate_masks():
    keys = {"data_keys": ["input", "mask"], "extra_args": {K.container.augment.DataKey.MASK: {"resample": "bilinear"}}}
    effect = LensDistortion(padding="border")
    image = torch.rand(2, 3, *SIZE)
    degraded, mask = K.AugmentationSequential(adapter.KorniaEffect(effect), **keys)(image, image)
    inner = (slice(None), slice(None), slice(20, 40), slice(20, 40))
    assert_close(mask[inner], degraded[inner], rtol=0, atol=1e-4)


def test_an_adapter_in_a_module_that_kornia_does_not_know_raises_beside_labels():
    image = torch.rand(2, 3, *SIZE)
    for effect in (LensDistortion(), UniformFog()):
        module = nn.Sequential(adapter.KorniaEffect(effect))
        container = K.AugmentationSequential(module, data_keys=["input", "mask"])
        if isinstance(effect, UniformFog):
            assert torch.equal(container(image, image)[1], image)
        else:
            with pytest.raises(TypeError, match=r"got .'mask'. too.* pass KorniaEffect to the container itself"):
                container(image, image)
        assert not torch.equal(module(image), image)
    in_sequence = K.AugmentationSequential(
        K.ImageSequential(adapter.KorniaEffect(LensDistortion())), data_keys=["input", "mask"]
    )
    assert not torch.equal(in_sequence(image, image)[1], image)


def test_samples_of_a_batch_share_a_draw_on_request():
    image = torch.rand(1, 3, *SIZE).expand(2, -1, -1, -1).contiguous()
    shared, other = (
        K.AugmentationSequential(adapter.KorniaEffect(LensDistortion(), same_on_batch=same), data_keys=["input"])(image)
        for same in (True, False)
    )
    assert torch.equal(shared[0], shared[1])
    assert not torch.equal(other[0], other[1])


def test_boxes_that_leave_the_frame_have_no_area_and_keypoints_are_minus_one():
    effect = LensDistortion(k1_range=(0.4, 0.4), k2_range=(0, 0), focal_range=(0.7, 0.7))
    container = K.AugmentationSequential(adapter.KorniaEffect(effect), data_keys=["input", "bbox_xyxy", "keypoints"])
    corner, far = torch.tensor([[[0.0, 0, 3, 3], [30, 30, 50, 50]]]), torch.tensor([[[1.0, 1.0], [40.0, 30.0]]])
    _, boxes, points = container(torch.rand(1, 3, *SIZE), corner, far)
    area = (boxes[..., 2:] - boxes[..., :2]).prod(dim=-1)
    assert area[0, 0] == 0
    assert area[0, 1] > 100
    assert points[0, 0].tolist() == [-1, -1]
    assert points[0, 1].min() > 0


@pytest.mark.parametrize("wrapped", [lambda e: e, nn.Sequential, K.ImageSequential])
def test_an_effect_that_would_leave_labels_behind_raises(wrapped):
    image = torch.rand(2, 3, *SIZE)
    with pytest.raises(TypeError, match=r"data_keys must be \['input'\] .* got \['mask'\] too.*KorniaEffect"):
        K.AugmentationSequential(wrapped(LensDistortion()), data_keys=["input", "mask"])(image, image)
    assert K.AugmentationSequential(wrapped(LensDistortion()), data_keys=["input", "label"])(image, image)
    fog = K.AugmentationSequential(wrapped(UniformFog()), data_keys=["input", "mask"])
    assert torch.equal(fog(image, image)[1], image)
