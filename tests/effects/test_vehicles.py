"""Boxes of vehicles in targets, behind which dust is thicker."""

from typing import Any

import pytest
import torch
from targets import boxes_of
from torch.testing import assert_close
from torchvision import tv_tensors

from torchrefract import Compose, GroundPlaneDepth, HeterogeneousFog, Turbulence, presets
from torchrefract.labels.vehicles import VEHICLES, boxes_of_target

DUST: dict[str, Any] = {"mode": "ray", "depth": GroundPlaneDepth()}
CAR, PERSON = [20.0, 14.0, 31.0, 23.0], [40.0, 14.0, 44.0, 30.0]


def boxes(*rows: list[float]) -> tv_tensors.BoundingBoxes:
    return boxes_of(rows, (40, 60))


def degraded(effect: Any, *target: Any, image: torch.Tensor | None = None) -> torch.Tensor:
    torch.manual_seed(5)
    result = effect(torch.full((3, 40, 60), 0.2) if image is None else image, *target)
    return result[0] if target else result


def thicker(effect: Any, *target: Any) -> list[bool]:
    """Return True for the car, and for the person, if there is more dust on the road below the box."""
    more = (degraded(effect, *target) - degraded(effect)).mean(dim=0)
    return [bool(more[y, x] > 0.01) for y, x in ((25, 25), (32, 42))]


@pytest.mark.quick
def test_dust_is_thicker_behind_the_vehicles_of_a_target():
    both, numbers = boxes(CAR, PERSON), torch.tensor([3, 1])
    for labels, target, expected in (
        (None, {"boxes": both, "labels": numbers}, [False, False]),
        ((3,), {"boxes": both, "labels": numbers}, [True, False]),
        ((3,), (both, numbers), [True, False]),
        (("Car",), {"labels": ["car", "person"], "boxes": both}, [True, False]),
        ((3, 1), {"area": torch.tensor([3, 3]), "boxes": both, "labels": numbers}, [True, True]),
        ((3,), {"boxes": both}, [True, True]),  # without classes, each box is a vehicle
        ((3,), {"boxes": both, "area": torch.tensor([9.5, 8.5])}, [True, True]),
        (("car",), {"boxes": both, "labels": numbers}, [False, False]),  # numbers have no names
        ((3,), {"boxes": boxes(CAR)[:0], "labels": numbers[:0]}, [False, False]),
    ):
        effect = HeterogeneousFog(**DUST, vehicle_labels=labels)
        assert thicker(effect, target) == expected, (labels, target)
        if isinstance(target, dict):
            torch.manual_seed(5)
            sample = effect({"image": tv_tensors.Image(torch.full((3, 40, 60), 0.2)), **target})
            assert torch.equal(sample["image"].as_subclass(torch.Tensor), degraded(effect, target))
        assert torch.equal(degraded(effect, {"boxes": None}), degraded(effect))


@pytest.mark.quick
def test_boxes_of_another_canvas_than_the_image_raise():
    effect = HeterogeneousFog(**DUST, vehicle_labels=(3,))
    rule = r"BoundingBoxes must have the canvas size of the image, \(80, 120\), got \(40, 60\)"
    with pytest.raises(ValueError, match=rule):
        effect(torch.full((3, 80, 120), 0.2), {"boxes": boxes(CAR), "labels": [3]})


@pytest.mark.quick
@pytest.mark.parametrize("name", ["class_id", "class_ids", "category_ids", "class_labels", "cls", "gt_classes"])
def test_classes_have_the_names_of_other_data_sets_too(name):
    effect = HeterogeneousFog(**DUST, vehicle_labels=(3,))
    assert thicker(effect, {"boxes": boxes(CAR, PERSON), name: torch.tensor([3, 1])}) == [True, False]


@pytest.mark.quick
def test_boxes_of_a_target_are_those_of_params():
    image, effect = torch.rand(2, 3, 40, 60), HeterogeneousFog(**DUST, vehicle_labels=(3,))
    targets = [{"boxes": boxes(CAR), "labels": [3]}, {"boxes": boxes(PERSON, CAR, CAR), "labels": [1, 3, 3]}]
    result = degraded(effect, targets, image=image)
    torch.manual_seed(5)
    params = effect.sample(image)
    row = torch.tensor(CAR) - 0.5
    given = params._replace(vehicles=torch.stack([torch.stack([row, 0 * row]), torch.stack([row, row])]))
    assert_close(result, effect.apply(image, given).image, rtol=0, atol=1e-6)


@pytest.mark.quick
def test_a_batch_whose_boxes_are_not_in_a_list_of_samples_raises():
    image, effect = torch.full((2, 3, 40, 60), 0.2), HeterogeneousFog(**DUST, vehicle_labels=(3,))
    for target in ({"boxes": [boxes(CAR), boxes(PERSON)]}, [{"boxes": boxes(CAR)}]):
        with pytest.raises(ValueError, match="target must be a list of 2 samples, one for each image, if it holds"):
            effect(image, target)
    assert effect(image, {"boxes": None})[1] == {"boxes": None}


def test_dust_in_a_composition_takes_the_boxes_and_the_labels_move_along():
    scene = Compose([HeterogeneousFog(**DUST, vehicle_labels=(3,)), Turbulence()])
    target = {"boxes": boxes(CAR, PERSON), "labels": torch.tensor([3, 1])}
    torch.manual_seed(5)
    image, moved = scene(torch.full((3, 40, 60), 0.2), target)
    assert (image - degraded(scene))[:, 25, 25].mean() > 0.01
    assert moved["boxes"].shape == (2, 4)
    assert not torch.equal(moved["boxes"], target["boxes"])


@pytest.mark.quick
def test_boxes_of_every_format_are_upright_boxes_from_the_center_of_the_first_pixel():
    for form, row in (("XYWH", [20.0, 14.0, 11.0, 9.0]), ("XYXYXYXY", [20.0, 14, 31, 14, 31, 23, 20, 23])):
        options: dict[str, Any] = {"format": form, "canvas_size": (40, 60)}
        target = tv_tensors.BoundingBoxes(torch.tensor([row]), **options)
        assert_close(boxes_of_target([target], size=(40, 60)).boxes, torch.tensor([CAR]) - 0.5, rtol=0, atol=1e-5)


@pytest.mark.quick
def test_the_dust_of_the_gravel_road_is_raised_by_vehicles():
    assert presets.unpaved_road().effects[0].vehicle_labels == VEHICLES
    assert presets.unpaved_road(vehicle_labels=(2, 7)).effects[0].vehicle_labels == (2, 7)
    wrong: list[Any] = ["car", [1.5], [True]]
    for labels in wrong:
        with pytest.raises(ValueError, match="vehicle_labels must be numbers or names of classes, got"):
            HeterogeneousFog(vehicle_labels=labels)
