"""Labels move with the image."""

from copy import copy
from typing import Any

import pytest
import torch
from helpers import seeded
from targets import boxes_of, keypoints_of
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from torchvision import tv_tensors
from torchvision.transforms import v2

from torchrefract import Compose, LensDistortion, ThinPlateSpline, Turbulence, UniformFog, warp_points
from torchrefract.effects.base import Effect
from torchrefract.warping.lattice import LatticeFlow

EFFECTS = [LensDistortion(), Turbulence(), ThinPlateSpline(), Compose([Turbulence(), UniformFog(), LensDistortion()])]


def sample() -> tuple[Tensor, dict]:
    """Return an image with boxes, masks and points of two objects."""
    size = height, width = 64, 96
    mask = torch.zeros(2, height, width, dtype=torch.uint8)
    mask[0, 20:40, 30:50] = 1
    mask[1, 5:15, 60:80] = 1
    boxes = torch.tensor([[30.0, 20.0, 50.0, 40.0], [60.0, 5.0, 80.0, 15.0]])
    target = {
        "boxes": boxes_of(boxes, size),
        "masks": tv_tensors.Mask(mask),
        "points": keypoints_of([[40.0, 30.0], [70.0, 10.0]], size),
        "labels": torch.tensor([3, 7]),
        "name": "frame 1",
    }
    return torch.rand(3, height, width), target


def moved_samples(effect: Effect, images: Tensor, seed: int) -> list[bool]:
    """Return for each sample whether the draw of a global seed moves it."""
    torch.manual_seed(seed)
    return (effect.degrade(images).flow != 0).flatten(1).any(dim=1).tolist()


@pytest.mark.quick
@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: type(effect).__name__)
def test_labels_move_with_the_image(effect: Effect):
    image, target = sample()
    expected = seeded(effect.degrade, image)
    result, moved = seeded(effect, image, target)
    assert torch.equal(result, expected.image)
    points, _ = warp_points(target["points"].as_subclass(Tensor), expected.flow)
    assert torch.allclose(moved["points"].as_subclass(Tensor), points, atol=1e-4)
    assert not torch.equal(moved["points"], target["points"])
    for row, box in zip(moved["masks"], moved["boxes"].as_subclass(Tensor), strict=True):
        y, x = row.nonzero().unbind(1)
        expected_box = torch.stack([x.min(), y.min(), x.max() + 1, y.max() + 1])
        assert (expected_box - box).abs().max() < 1.0
    assert moved["labels"].tolist() == [3, 7]
    assert moved["name"] == "frame 1"


def test_labels_of_an_image_that_does_not_move_are_not_clipped():
    image = torch.rand(3, 40, 56)
    outside = boxes_of([[-5.0, -5, 20, 20], [60, 5, 70, 9]], (40, 56))
    second = tv_tensors.Image(torch.rand(3, 40, 56))
    target = {"boxes": outside, "labels": torch.arange(2), "second": second}
    _, unmoved = LensDistortion(p=0.0)(image, target)
    assert torch.equal(unmoved["boxes"], outside)
    assert torch.equal(unmoved["second"], second)
    _, moved = LensDistortion()(image, target)
    assert moved["labels"].tolist() == [0]
    assert not torch.equal(moved["second"], second)


def test_labels_of_a_sample_that_does_not_move_are_not_clipped_in_a_mixed_batch():
    effect, images = ThinPlateSpline(amplitude_range=(6.0, 9.0), p=0.5), torch.rand(2, 3, 40, 56)
    seed = next(seed for seed in range(99) if moved_samples(effect, images, seed) == [True, False])
    size: dict[str, Any] = {"canvas_size": (40, 56)}
    points = torch.tensor([[-3.0, -2.0], [20.0, 10.0]])
    sample = {
        "boxes": boxes_of([[-5.0, -5, 20, 20], [80, 5, 90, 9]], (40, 56)),
        "labels": torch.arange(2),
        "points": tv_tensors.KeyPoints(points, **size),
        "visible": torch.ones(2),
    }
    torch.manual_seed(seed)
    _, (moved, stayed) = effect(images, [sample, sample])
    assert moved["labels"].tolist() == [0]
    assert moved["visible"].tolist() == [0]
    for name, value in sample.items():
        assert torch.equal(stayed[name], value), name
    batch = {
        "points": tv_tensors.KeyPoints(torch.stack([points, points]), **size),
        "visible": torch.ones(2, 2),
        "second": tv_tensors.Image(torch.rand(2, 3, 40, 56)),
    }
    torch.manual_seed(seed)
    _, both = effect(images, batch)
    assert both["visible"].tolist() == [[0, 1], [1, 1]]
    for name in ("points", "second"):
        assert torch.equal(both[name][1], batch[name][1]), name
        assert not torch.equal(both[name][0], batch[name][0]), name
        assert type(both[name]) is type(batch[name])


def test_photometric_effects_move_no_label():
    image, target = sample()
    result, moved = UniformFog()(image, target)
    assert moved is target
    assert not torch.equal(result, image)


def test_an_unknown_type_of_label_raises():
    image, target = sample()
    with pytest.raises(TypeError, match="target must hold tv_tensors of torchvision or plain values, got"):
        LensDistortion()(image, target | {"camera": nn.Identity()})


def border_sample() -> dict[str, Any]:
    """Return a sample of two boxes, of which the one in the corner leaves the frame under PINCUSHION."""
    size: dict[str, Any] = {"canvas_size": (64, 80)}
    return {
        "image": tv_tensors.Image(torch.rand(3, 64, 80)),
        "boxes": boxes_of([[0.0, 0, 3, 3], [30, 30, 50, 50]], (64, 80)),
        "labels": torch.tensor([1, 2]),
        "keypoints": tv_tensors.KeyPoints(torch.rand(2, 17, 2) * 20 + 30, **size),
    }


PINCUSHION = LensDistortion(k1_range=(0.4, 0.4), k2_range=(0, 0), focal_range=(0.7, 0.7))


def test_samples_have_the_forms_of_torchvision_s_transforms():
    sample = border_sample()
    image, boxes, labels, keypoints = sample.values()
    torch.manual_seed(2)
    expected_image, expected = PINCUSHION(image, sample | {"image": None})
    assert expected["labels"].tolist() == [2]
    transform = v2.Compose([v2.Identity(), PINCUSHION])
    for inputs in ((image, boxes, labels, keypoints), (sample,), ((image, {"a": boxes, "b": (labels, [keypoints])}),)):
        torch.manual_seed(2)
        outputs = transform(*inputs)
        leaves = pytree.tree_leaves(outputs)
        assert pytree.tree_structure(outputs) == pytree.tree_structure(inputs if len(inputs) > 1 else inputs[0])
        for leaf, value in zip(leaves, (expected_image, *list(expected.values())[1:]), strict=True):
            assert type(leaf) is type(value)
            assert torch.equal(leaf, value)
    torch.manual_seed(2)
    plain = PINCUSHION({"name": "a", "picture": image.as_subclass(Tensor), "boxes": boxes, "labels": labels})
    assert torch.equal(plain["picture"], expected_image)
    assert plain["labels"].tolist() == [2]


def test_a_batch_takes_a_list_for_each_kind_of_label():
    sample = border_sample()
    images = torch.rand(2, 3, 64, 80)
    _, boxes, labels = PINCUSHION(images, [sample["boxes"]] * 2, [sample["labels"]] * 2)
    assert [len(one) for one in boxes] == [1, 1]
    assert [one.tolist() for one in labels] == [[2], [2]]
    with pytest.raises(TypeError, match="target must be lists of 2 entries, one for each image, got Tensor"):
        PINCUSHION(images, [sample["boxes"]] * 2, sample["labels"])


def test_the_labels_getter_of_an_effect_takes_its_arguments():
    sample, effect = border_sample(), copy(PINCUSHION)
    target = {key: sample[key] for key in ("boxes", "labels")} | {"ids": torch.arange(2)}
    effect.labels_getter = lambda inputs: inputs[1]["labels"]
    _, moved = effect(sample["image"], target)
    assert (moved["labels"].tolist(), moved["ids"].tolist()) == ([2], [0, 1])
    effect.labels_getter = lambda inputs: inputs["labels"]
    assert effect(sample | {"ids": torch.arange(2)})["ids"].tolist() == [0, 1]
    effect.labels_getter = "ids"
    with pytest.raises(ValueError, match="labels_getter must be 'default', a function or None, got 'ids'"):
        effect(sample["image"], target)


def test_a_sample_without_one_image_raises():
    sample = border_sample()
    with pytest.raises(ValueError, match="image must be the only Image or Video of a sample, got 2"):
        PINCUSHION(sample | {"right": sample["image"]})
    with pytest.raises(TypeError, match="image must be a tensor, or a sample with an Image of torchvision in it"):
        PINCUSHION({"boxes": sample["boxes"]})
    with pytest.raises(TypeError, match=r"image must be a tensor, got numpy\.ndarray; convert it by"):
        PINCUSHION({"image": sample["image"].numpy(), "labels": sample["labels"]})


@pytest.mark.parametrize("effect", [PINCUSHION, UniformFog()], ids=["lens", "fog"])
def test_a_tensor_before_the_one_that_a_sample_names_as_its_image_is_not_taken_for_it(effect):
    image = torch.rand(3, 64, 80)
    for first in (torch.eye(3)[None], torch.rand(1, 64, 80)):
        with pytest.raises(ValueError, match=r"must be the first tensor of a sample, .*, got 'matrix' before 'image'"):
            effect({"matrix": first, "image": image})
    assert not torch.equal(effect({"matrix": torch.eye(3)[None], "image": tv_tensors.Image(image)})["image"], image)
    assert not torch.equal(effect({"image": image, "matrix": torch.eye(3)[None]})["image"], image)


@pytest.mark.parametrize("effect", [PINCUSHION, UniformFog()], ids=["lens", "fog"])
def test_a_list_of_images_raises_instead_of_degrading_the_first_alone(effect):
    first, second = torch.rand(3, 64, 80), torch.rand(3, 48, 72)
    for sample in ([first, second], (first, second), {"images": [first, second], "labels": torch.tensor([1, 2])}):
        with pytest.raises(ValueError, match=r"image must be the only image of a sample, got 2 tensors .* \(3, 64"):
            effect(sample)
    degraded, other = effect(first, second)
    assert not torch.equal(degraded, first)
    assert other is second


def test_plain_positions_raise_even_if_the_effect_does_not_apply():
    with pytest.raises(TypeError, match=r"target\['boxes'\] must be a BoundingBoxes of torchvision to move with the"):
        LensDistortion(p=0.0)(torch.rand(3, 40, 56), {"boxes": torch.zeros(2, 4)})


@pytest.mark.quick
def test_an_image_without_labels_computes_no_flow_at_every_pixel(monkeypatch):
    def dense(flow: LatticeFlow) -> Tensor:
        raise AssertionError("computed at every pixel")

    monkeypatch.setattr(LatticeFlow, "dense", dense)
    effect = LensDistortion(k1_range=(-0.2, -0.2), k2_range=(0.05, 0.05))
    image = torch.rand(1, 3, 128, 160)
    assert not torch.equal(effect(image), image)
    with pytest.raises(AssertionError, match="every pixel"):
        effect(image, {"masks": tv_tensors.Mask(torch.ones(1, 1, 128, 160, dtype=torch.uint8))})
