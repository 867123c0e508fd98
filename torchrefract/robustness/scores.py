"""Scores in [0, 1] of the prediction for one image, and predictions as labels."""

from typing import Any

import torch
from torch import Tensor
from torchvision import tv_tensors
from torchvision.ops import box_iou

from torchrefract.robustness.set_scores import class_areas, corners_of

_IOU = 0.5  # from which a box is found
_CONFIDENT = 0.5  # score from which a detection counts as a label


def detection_score(prediction: dict[str, Tensor], target: dict[str, Any]) -> float:
    """Compute the mean average precision at an IoU of 0.5 over the classes that one image holds.

    For an image that holds nothing, 1 without a detection of a score of at least 0.5, and 0 with one.

    Args:
        prediction: `boxes` (n, 4), x1 y1 x2 y2 in px, `labels` (n,) and `scores` (n,), as of torchvision's detectors.
        target: `boxes` (m, 4) and `labels` (m,). Boxes of torchvision may have any format that is not rotated.
    """
    labels, scores = (prediction[name].detach().cpu() for name in ("labels", "scores"))
    boxes, true_boxes = corners_of(prediction["boxes"]), corners_of(target["boxes"])
    true_labels = torch.as_tensor(target["labels"]).cpu()
    values = []
    for name in true_labels.unique().tolist():
        chosen = (labels == name).nonzero()[:, 0]
        chosen = chosen[scores[chosen].argsort(descending=True, stable=True)]
        values.append(_average_precision(boxes[chosen], true_boxes[true_labels == name]))
    return sum(values) / len(values) if values else float(not (scores >= _CONFIDENT).any())


def segmentation_score(prediction: Tensor, target: Tensor) -> float:
    """Compute the mean IoU over the classes that one image holds; negative and 255 classes of the target are ignored.

    Args:
        prediction: (K, H, W), a score of each class at each pixel, or (H, W), integers.
        target: (H, W) or (1, H, W), integers.
    """
    _check_classes(prediction)
    areas = class_areas(prediction, target).values()
    return sum(intersection / union for intersection, union in areas) / len(areas) if areas else 1.0


def classification_score(prediction: Tensor, target: Tensor | int) -> float:
    """Return 1.0 if the class with the highest of the scores (K,) is the target, else 0.0."""
    _check_classes(prediction)
    return float(prediction.detach().cpu().argmax().item() == int(target))


def as_labels(prediction: Any, size: tuple[int, int]) -> Any:
    """Turn the prediction for an image of a size (height, width) into labels that warps move, to score agreement.

    Detections with a score of at least 0.5 become boxes, scores of classes at each pixel become a mask, and those of
    an image its class.
    """
    check_prediction(prediction)
    if isinstance(prediction, dict):
        keep = prediction["scores"] >= _CONFIDENT
        boxes = corners_of(prediction["boxes"])[keep.cpu()].to(keep.device)
        if len(boxes) and ((boxes >= 0) & (boxes <= 1)).all():
            raise ValueError("boxes must be in px, got all in [0, 1]; multiply them by the size of the image")
        options: dict[str, Any] = {"format": "XYXY", "canvas_size": size}
        return {"boxes": tv_tensors.BoundingBoxes(boxes, **options), "labels": prediction["labels"][keep].detach()}
    if prediction.ndim == 1:
        return int(prediction.argmax())
    if tuple(prediction.shape[-2:]) != size:
        raise ValueError(
            f"predictions must have the size of the image, {size}, got {_described(prediction)}; resize the scores of "
            "classes to it"
        )
    # In a type that holds the class of pixels that are not scored.
    return tv_tensors.Mask((prediction.argmax(dim=0) if prediction.ndim == 3 else prediction).detach().long())


def check_prediction(prediction: Any, target: Any = None) -> None:
    """Raise ValueError if no score takes the prediction for an image, or none takes it with this target."""
    if isinstance(prediction, dict):
        parts = [prediction.get(name) for name in ("boxes", "labels", "scores")]
        shapes = [part.shape if isinstance(part, Tensor) else None for part in parts]
        is_valid = shapes[1] is not None and len(shapes[1]) == 1 and shapes == [(*shapes[1], 4), shapes[1], shapes[1]]
        fits = isinstance(target, dict) and {"boxes", "labels"} <= set(target)
    else:
        is_valid = isinstance(prediction, Tensor) and prediction.ndim in (1, 2, 3)
        size = prediction.shape[-2:] if is_valid and prediction.ndim > 1 else ()
        shape = () if isinstance(target, dict) else getattr(target, "shape", ())
        fits = not isinstance(target, dict) and shape in (size, (1, *size) if size else ())
    if not is_valid:
        raise ValueError(
            "predictions must be dicts of tensors: boxes (n, 4), labels (n,) and scores (n,), or tensors (K, H, W), "
            f"(H, W) or (K,), got {_described(prediction)}"
        )
    if target is not None and not fits:
        raise ValueError(
            "predictions must have the kind and the size of the labels: boxes for boxes, a class of each pixel for a "
            f"mask, got {_described(prediction)} for {_described(target)}"
        )


def _check_classes(prediction: Tensor) -> None:
    """Raise ValueError unless a prediction has a class: the highest of the scores of one class is always that class."""
    check_prediction(prediction)
    if prediction.is_floating_point() if prediction.ndim == 2 else len(prediction) == 1:
        raise ValueError(
            "predictions must be scores of at least two classes, (K, H, W) or (K,), or classes (H, W), integers, got "
            f"{_described(prediction)}; one logit x is the scores -x and x, one probability p is 1 - p and p"
        )


def _described(value: Any) -> str:
    if isinstance(value, dict):
        kinds = {
            name: tuple(part.shape) if isinstance(part, Tensor) else type(part).__name__ for name, part in value.items()
        }
        return "a dict of " + ", ".join(f"{name} {kind}" for name, kind in kinds.items())
    return f"a tensor {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__


def _average_precision(boxes: Tensor, expected: Tensor) -> float:
    """Compute the area below precision over recall of boxes (n, 4) in the order of their scores."""
    if len(boxes) == 0 or len(expected) == 0:
        return 0.0
    iou = box_iou(boxes, expected)
    is_free = torch.ones(len(expected), dtype=torch.bool)
    hits = torch.zeros(len(boxes))
    for i, row in enumerate(iou):
        best = torch.where(is_free, row, -1.0).argmax()
        if is_free[best] and row[best] >= _IOU:
            hits[i], is_free[best] = 1.0, False
    precision = hits.cumsum(0) / torch.arange(1, len(boxes) + 1)
    # The precision at each recall is the highest one at this recall or a higher one.
    envelope = precision.flip(0).cummax(0).values.flip(0)
    return ((envelope * hits).sum() / len(expected)).item()
