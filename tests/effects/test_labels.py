"""Labels move with the image."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchrefract import Compose, LensDistortion, ThinPlateSpline, Turbulence, UniformFog, warp_points
from torchrefract.effects.base import Effect

tv_tensors = pytest.importorskip("torchvision.tv_tensors", reason="torchvision is in the extra test")

EFFECTS = [LensDistortion(), Turbulence(), ThinPlateSpline(), Compose([Turbulence(), UniformFog(), LensDistortion()])]


def sample() -> tuple[Tensor, dict]:
    """Return an image with boxes, masks and points of two objects."""
    size = height, width = 64, 96
    mask = torch.zeros(2, height, width, dtype=torch.uint8)
    mask[0, 20:40, 30:50] = 1
    mask[1, 5:15, 60:80] = 1
    boxes = torch.tensor([[30.0, 20.0, 50.0, 40.0], [60.0, 5.0, 80.0, 15.0]])
    target = {
        "boxes": tv_tensors.BoundingBoxes(boxes, format="XYXY", canvas_size=size),  # pyright: ignore[reportCallIssue]  # torchvision's overloads
        "masks": tv_tensors.Mask(mask),
        "points": tv_tensors.KeyPoints(torch.tensor([[40.0, 30.0], [70.0, 10.0]]), canvas_size=size),  # pyright: ignore[reportCallIssue]  # as above
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
    torch.manual_seed(4)
    expected = effect.degrade(image)
    torch.manual_seed(4)
    result, moved = effect(image, target)
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
    outside = tv_tensors.BoundingBoxes(
        torch.tensor([[-5.0, -5, 20, 20], [60, 5, 70, 9]]), format="XYXY", canvas_size=(40, 56)
    )  # pyright: ignore[reportCallIssue]  # torchvision's overloads
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
        "boxes": tv_tensors.BoundingBoxes(torch.tensor([[-5.0, -5, 20, 20], [80, 5, 90, 9]]), format="XYXY", **size),
        "labels": torch.arange(2),
        "points": tv_tensors.KeyPoints(points, **size),
        "visible": torch.ones(2),
    }
    torch.manual_seed(seed)
    _, (moved, stayed) = effect(images, [sample, sample])
    assert moved["labels"].tolist() == [0]
    assert moved["visible"].tolist() == [0, 1]
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
    with pytest.raises(TypeError, match="target must be a single argument of any nesting, got 2"):
        LensDistortion()(image, target, target)
