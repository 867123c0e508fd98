from typing import Any

import pytest
import torch
from torchvision import tv_tensors
from torchvision.transforms.v2.functional import convert_bounding_box_format

from torchrefract.robustness.scores import (
    as_labels,
    check_prediction,
    classification_score,
    detection_score,
    segmentation_score,
)
from torchrefract.robustness.set_scores import set_scores, summarize

pytestmark = pytest.mark.quick


def test_the_average_precision_of_one_image_is_the_area_below_its_curve():
    target: dict[str, Any] = {
        "boxes": torch.tensor([[0.0, 0, 10, 10], [20, 20, 30, 30]]),
        "labels": torch.tensor([1, 1]),
    }
    # Hit, miss, hit: precision 1 up to a recall of 1/2, then 2/3.
    boxes = torch.tensor([[1.0, 0, 10, 10], [50, 50, 60, 60], [20, 20, 30, 31]])
    prediction = {"boxes": boxes, "labels": torch.tensor([1, 1, 1]), "scores": torch.tensor([0.9, 0.8, 0.7])}
    assert detection_score(prediction, target) == pytest.approx(0.5 + 0.5 * 2 / 3)
    # Classes that the image does not hold do not count, as in COCO's metric.
    assert detection_score(prediction | {"labels": torch.tensor([1, 2, 1])}, target) == 1
    nothing = {name: value[:0] for name, value in prediction.items()}
    assert detection_score(nothing, target) == 0
    empty = {"boxes": torch.zeros(0, 4), "labels": torch.zeros(0).long()}
    assert [detection_score(given, empty) for given in (nothing, prediction)] == [1, 0]
    assert detection_score({name: value[2:] * 0.5 for name, value in prediction.items()}, empty) == 1  # not confident


def test_a_detection_twice_is_a_miss_and_the_larger_overlap_counts():
    target = {"boxes": torch.tensor([[0.0, 0, 10, 10]]), "labels": torch.tensor([1])}
    prediction = {
        "boxes": torch.tensor([[0.0, 0, 10, 10]] * 2),
        "labels": torch.tensor([1, 1]),
        "scores": torch.ones(2),
    }
    assert detection_score(prediction, target) == 1
    prediction["boxes"] = torch.tensor([[0.0, 0, 10, 4.9], [0, 0, 10, 9]])
    prediction["scores"] = torch.tensor([0.9, 0.8])
    assert detection_score(prediction, target) == pytest.approx(0.5)


def test_segmentation_and_classification():
    target = torch.tensor([[0, 0, 1], [1, 1, 255]])
    logits = torch.nn.functional.one_hot(torch.tensor([[0, 1, 1], [1, 1, 0]]), 2).movedim(-1, 0).float()
    assert segmentation_score(logits, target) == pytest.approx((1 / 2 + 3 / 4) / 2)
    assert segmentation_score(torch.tensor([[0, 1, 1], [1, 1, 0]]), target[None]) == pytest.approx((1 / 2 + 3 / 4) / 2)
    assert classification_score(torch.tensor([0.1, 0.9]), 1) == 1
    assert classification_score(torch.tensor([0.1, 0.9]), 0) == 0


def test_confident_detections_become_labels():
    prediction = {
        "boxes": torch.tensor([[0.0, 0, 5, 5], [1, 1, 3, 3]]),
        "labels": torch.tensor([3, 4]),
        "scores": torch.tensor([0.9, 0.2]),
    }
    target = as_labels(prediction, (20, 30))
    assert target["labels"].tolist() == [3]
    assert tuple(target["boxes"].canvas_size) == (20, 30)
    assert detection_score(prediction, target) > 0
    assert as_labels(torch.tensor([0.1, 0.9]), (2, 2)) == 1
    assert as_labels(torch.tensor([[[0.0]], [[1.0]]]), (1, 1)).tolist() == [[1]]
    with pytest.raises(ValueError, match="predictions must be dicts of tensors: boxes"):
        as_labels("a car", (2, 2))


BOXES: dict[str, Any] = {"boxes": torch.zeros(2, 4), "labels": torch.zeros(2), "scores": torch.zeros(2)}


@pytest.mark.parametrize("valid", [(BOXES, BOXES), (torch.zeros(3, 4, 5), torch.zeros(4, 5)), (torch.zeros(7), 3)])
@pytest.mark.parametrize(
    ("prediction", "message"),
    [
        (0.5, "predictions must be dicts .*, got float"),
        (
            BOXES | {"labels": torch.zeros(1)},
            r"predictions must be dicts .*, got a dict of boxes \(2, 4\), labels \(1,\)",
        ),
        ({"labels": torch.zeros(1)}, r"predictions must be dicts .*, got a dict of labels \(1,\)"),
        (
            {name: value.numpy() for name, value in BOXES.items()},
            r"predictions must be dicts of tensors: .*, got a dict of boxes ndarray, labels ndarray, scores ndarray",
        ),
        (
            torch.zeros(3, 2, 5),
            r"predictions must have the kind and the size of the labels: .*, got a tensor \(3, 2, 5\)",
        ),
        (torch.zeros(2, 5), "predictions must have the kind and the size of the labels"),
    ],
)
def test_a_prediction_that_does_not_fit_its_labels_raises(valid, prediction, message):
    check_prediction(*valid)
    with pytest.raises(ValueError, match=message):
        check_prediction(prediction, valid[1])


@pytest.mark.parametrize(
    ("prediction", "target"),
    [(torch.zeros(3, 4, 5), torch.zeros(2, 4, 5)), (BOXES, {"boxes": torch.zeros(2, 4)})],
    ids=["classes", "boxes"],
)
def test_labels_with_a_channel_for_each_class_and_boxes_without_classes_raise(prediction, target):
    with pytest.raises(ValueError, match="predictions must have the kind and the size of the labels"):
        check_prediction(prediction, target)


@pytest.mark.parametrize(
    ("score", "prediction", "target"),
    [
        (segmentation_score, torch.rand(1, 4, 5), torch.zeros(4, 5).long()),
        (segmentation_score, torch.ones(1, 4, 5).long(), torch.zeros(4, 5).long()),
        (segmentation_score, torch.rand(4, 5), torch.zeros(4, 5).long()),
        (classification_score, torch.rand(1), 0),
    ],
)
def test_one_score_of_two_classes_raises_as_its_highest_class_never_changes(score, prediction, target):
    with pytest.raises(
        ValueError, match=r"at least two classes, .*, got a tensor .*; one logit x is the scores -x and x"
    ):
        score(prediction, target)


@pytest.mark.parametrize(
    ("prediction", "message"),
    [
        (torch.rand(2, 2, 3), r"size of the image, \(4, 5\), got a tensor \(2, 2, 3\); resize the scores of classes"),
        (BOXES | {"boxes": torch.tensor([[0.1, 0.2, 0.5, 0.9]] * 2), "scores": torch.ones(2)}, "boxes must be in px"),
    ],
)
def test_predictions_in_other_units_than_the_px_of_the_image_are_no_labels(prediction, message):
    with pytest.raises(ValueError, match=message):
        as_labels(prediction, (4, 5))


@pytest.mark.parametrize("form", ["XYXY", "XYWH", "CXCYWH"])
def test_boxes_of_torchvision_are_scored_by_their_format(form):
    options: dict[str, Any] = {"format": "XYXY", "canvas_size": (40, 80)}
    boxes = tv_tensors.BoundingBoxes(torch.tensor([[40.0, 20, 60, 30], [2, 4, 12, 24]]), **options)
    converted = convert_bounding_box_format(boxes, new_format=form)
    labels, scores = torch.tensor([1, 2]), torch.tensor([0.9, 0.8])
    for predicted, expected in ((boxes.as_subclass(torch.Tensor), converted), (converted, boxes)):
        prediction = {"boxes": predicted, "labels": labels, "scores": scores}
        assert detection_score(prediction, {"boxes": expected, "labels": labels}) == 1
        assert set_scores([summarize(prediction, {"boxes": expected, "labels": labels})])["mAP"] == pytest.approx(1)
        assert torch.equal(as_labels(prediction, (40, 80))["boxes"], boxes)
