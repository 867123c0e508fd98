"""Effects inside other code: torchvision, kornia, nn.Sequential, a Dataset with workers, and torch.func."""

import copy
import importlib
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import EFFECTS, SIZE, maps_of, random_image, seeded
from targets import boxes_of
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader
from torchvision import tv_tensors
from torchvision.transforms import v2

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.planning.plan import TOLERANCE_PX


@pytest.fixture(params=EFFECTS)
def effect(request) -> Effect:
    return EFFECTS[request.param]()


def random_frames(*shape: int) -> Tensor:
    return random_image(*shape, *SIZE)


def test_an_effect_moves_the_target_between_transforms_of_torchvision_v2(effect):
    image = tv_tensors.Image((255 * random_frames(3)).byte())
    target = {
        "boxes": boxes_of([[9.0, 8.0, 30.0, 25.0]], SIZE),
        "masks": tv_tensors.Mask(random_frames(1) > 0.5),
        "labels": torch.tensor([4]),
    }
    before, after = v2.RandomHorizontalFlip(p=1.0), v2.ToDtype(torch.float32, scale=True)
    result, moved = seeded(v2.Compose([before, effect, after]), image, target)
    expected, boxes = seeded(lambda *sample: after(*effect(*before(*sample))), image, target)
    assert type(result) is tv_tensors.Image
    assert torch.equal(result, expected)
    assert moved.keys() == target.keys()
    for name, value in moved.items():
        assert type(value) is type(target[name])
        assert torch.equal(value, boxes[name]), name
    seeded(before, image, target)
    flow = effect.degrade(image.flip(-1)).flow
    mirrored = torch.tensor([[SIZE[1] - 30.0, 8.0, SIZE[1] - 9.0, 25.0]])
    if flow is not None:
        mirrored = tr.warp_boxes(mirrored - 0.5, flow)[0] + 0.5
    assert_close(moved["boxes"].as_subclass(Tensor), mirrored, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["ImageSequential", "AugmentationSequential"])
def test_an_effect_works_between_augmentations_of_kornia(effect, name):
    augmentation = pytest.importorskip("kornia.augmentation", reason="kornia is in the extra train")
    options = {} if name == "ImageSequential" else {"data_keys": ["input"]}
    flip, scale = augmentation.RandomHorizontalFlip(p=1.0), augmentation.Normalize(0.5, 0.5)
    pipeline = getattr(augmentation.container, name)(flip, effect, scale, **options)
    image = random_frames(3, 3)
    result, flipped = seeded(pipeline, image), seeded(flip, image)
    assert torch.equal(flipped, image.flip(-1))
    assert torch.equal(result, scale(effect(flipped)))


# A module in a folder of the path, since spawned workers import the class of a dataset.
SPAWNED = """
from torch.utils.data import Dataset

class Frames(Dataset):
    def __init__(self, effects, images):
        self.effects, self.images = effects, images

    def __len__(self):
        return len(self.effects) * len(self.images)

    def __getitem__(self, i):
        effect, k = self.effects[i // len(self.images)], i % len(self.images)
        return effect.degrade(self.images[k], seed=7, keys=[2**40 + k]), effect(self.images[0])
"""


def test_spawned_workers_give_the_samples_of_this_process(tmp_path: Path, monkeypatch):
    effects, images = {name: make() for name, make in EFFECTS.items()}, random_frames(3, 3)
    (tmp_path / "spawned_frames.py").write_text(SPAWNED)
    monkeypatch.syspath_prepend(tmp_path)
    frames = importlib.import_module("spawned_frames").Frames(list(effects.values()), images)
    samples = list(DataLoader(frames, batch_size=None, num_workers=2, multiprocessing_context="spawn"))
    for n, (name, effect) in enumerate(effects.items()):
        rows = samples[n * len(images) : (n + 1) * len(images)]
        together = effect.degrade(images, seed=7, keys=[2**40 + k for k in range(len(images))])
        for field, expected in maps_of(together).items():
            actual = torch.stack([getattr(degraded, field) for degraded, _ in rows])
            if expected.dtype is torch.bool:
                assert (actual != expected).sum() <= expected.numel() // 500, (name, field)
            else:
                assert_close(actual, expected, rtol=1e-5, atol=1e-4 if "flow" in field else 1e-5)
        # Without a seed all draws differ. A rectification draws nothing.
        drawn = torch.stack([image for _, image in rows]).flatten(1).unique(dim=0)
        assert len(drawn) == (1 if name == "rectification" else len(rows)), name


def test_vmap_over_samples_or_params_equals_the_batch(effect):
    images = random_frames(3, 3)
    params = effect.sample(images, seed=7)

    def degrade(image: Tensor, params: Any) -> Tensor:
        return effect.apply(image[None], pytree.tree_map(lambda value: value[None], params)).image[0]

    for in_dims, image in ((0, images), (None, images[0])):
        expected = effect.apply(image.expand_as(images), params).image
        assert_close(torch.vmap(degrade, in_dims=(in_dims, 0))(image, params), expected, rtol=0, atol=2e-4)


def test_vmap_computes_each_pixel_of_a_composition_that_is_else_measured():
    effect = tr.Compose([tr.Turbulence(covariance="gaussian"), tr.LensDistortion()])
    images = random_frames(3, 3)
    params = effect.sample(images, seed=7)
    expected = effect.apply(images, params)

    def flow(image: Tensor, params: Any) -> Tensor:
        return effect.apply(image[None], pytree.tree_map(lambda value: value[None], params)).flow[0]

    difference = (torch.vmap(flow)(images, params) - expected.flow).norm(dim=1)
    assert 1e-4 < difference.max() < TOLERANCE_PX


def test_vmap_over_one_parameter_or_over_images_of_a_composition_equals_each():
    image, effect = random_frames(1, 3), tr.Compose([tr.Turbulence(depth=tr.CorridorDepth()), tr.LensDistortion()])
    params = effect.sample(image, seed=7)

    def flow_of(amplitude: Tensor) -> Tensor:
        turbulence = params.children[0]._replace(amplitude=amplitude)
        return effect.apply(image, params._replace(children=(turbulence, params.children[1]))).flow

    amplitudes = torch.tensor([[0.5], [1.4]])
    expected = torch.stack([flow_of(amplitude) for amplitude in amplitudes])
    assert_close(torch.vmap(flow_of)(amplitudes), expected, rtol=0, atol=2 * TOLERANCE_PX)
    images = random_frames(2, 3)
    expected = torch.stack([effect.apply(each[None], params).image for each in images])
    assert_close(torch.vmap(lambda each: effect.apply(each[None], params).image)(images), expected, rtol=0, atol=0.01)


def test_autocast_changes_nothing(effect):
    image = random_frames(3, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = effect.degrade(image, seed=7).image
    assert result.dtype == torch.float32
    assert_close(result, effect.degrade(image, seed=7).image, rtol=0, atol=2e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_maps_that_are_read_inside_autocast_are_those_outside(dtype):
    image, effect = random_image(1, 3, 90, 160), tr.Compose([tr.Turbulence(), tr.LensDistortion()])
    expected = effect.degrade(image, seed=7)
    with torch.autocast("cpu", dtype=dtype):
        result = effect.degrade(image, seed=7)
        maps = result.flow, result.restore_flow, result.restore_residual
    assert_close(maps, (expected.flow, expected.restore_flow, expected.restore_residual), rtol=0, atol=1e-4)
    assert torch.equal(result.restore_valid, expected.restore_valid)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_a_copy_of_a_model_degrades_like_the_model(effect, copied):
    model, image = nn.Sequential(nn.Conv2d(3, 3, 1), effect), random_frames(3, 3)
    expected = seeded(model, image)
    assert torch.equal(seeded(copied(model), image), expected)


def test_an_effect_adds_nothing_to_the_state_of_a_model(effect):
    model = nn.Sequential(nn.Conv2d(3, 3, 1), effect)
    assert list(model.state_dict()) == ["0.weight", "0.bias"]
    other = nn.Sequential(nn.Conv2d(3, 3, 1), copy.deepcopy(effect))
    other.load_state_dict(model.state_dict(), strict=True)
    image = random_frames(3, 3)
    assert torch.equal(seeded(other, image), seeded(model, image))
