"""Scores of all images together: COCO's mAP of detections, and the mean IoU over all pixels of masks."""

import base64
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import warn
from torchrefract.labels.targets import convert_boxes, is_tv_tensor

Summary = tuple[str, Any]

IGNORED_CLASS = 255  # of pixels of a target that no score counts


def summarize(prediction: Any, target: Any) -> Summary | None:
    """Return what the score of all images needs of one image, as values that JSON holds.

    Args:
        prediction: as for `scores.detection_score` or `scores.segmentation_score`.
        target: of the same kind.

    Returns:
        ("boxes", [detections, labels]), rows of x1, y1, x2, y2, class and, of detections, score, as float32 in base64;
        ("pixels", rows of class, intersection and union, px); None for another prediction or target.
    """
    are_dicts = isinstance(prediction, dict) and isinstance(target, dict)
    if are_dicts and {"boxes", "labels", "scores"} <= set(prediction) and {"boxes", "labels"} <= set(target):
        detections = [prediction[name] for name in ("boxes", "labels", "scores")]
        return "boxes", [_encode(*detections), _encode(target["boxes"], target["labels"])]
    if isinstance(prediction, Tensor) and isinstance(target, Tensor) and prediction.ndim in (2, 3):
        is_whole = not prediction.is_floating_point() or bool((prediction == prediction.long()).all())
        has_classes = len(prediction) > 1 if prediction.ndim == 3 else is_whole  # not one logit or probability
        is_mask = not target.is_floating_point() and target.numel() == prediction.shape[-2:].numel()
        if has_classes and is_mask:
            return "pixels", [[name, *area] for name, area in class_areas(prediction, target).items()]
    return None


def set_scores(summaries: Sequence[Summary | None]) -> dict[str, float]:
    """Compute the scores of all images together.

    Args:
        summaries: of each image, by `summarize`.

    Returns:
        For detections "mAP", the AP of COCO, which is the mean over IoU thresholds of 0.5 to 0.95, and "mAP50", that at
        0.5, both with the best 100 detections of each class in an image; for masks "mIoU", the mean over classes of the
        sum of all intersections over that of all unions. NaN if no image has a label. Nothing for other predictions,
        and, with a warning, for detections without the packages torchmetrics and pycocotools.

    Source: Lin et al., "Microsoft COCO: common objects in context", ECCV 2014.
    """
    kinds = {summary and summary[0] for summary in summaries}
    contents = [summary[1] for summary in summaries if summary]
    if kinds == {"boxes"}:
        return _mean_average_precision(contents)
    return {"mIoU": _mean_iou(contents)} if kinds == {"pixels"} else {}


def class_areas(prediction: Tensor, target: Tensor) -> dict[int, tuple[int, int]]:
    """Return the intersection and the union, px, by class.

    Args:
        prediction, target: as for `scores.segmentation_score`.
    """
    classes = prediction.detach().cpu()
    classes = classes.argmax(dim=0) if classes.ndim == 3 else classes
    expected = torch.as_tensor(target).cpu().as_subclass(Tensor).reshape(classes.shape)
    # PyTorch compares no uint16.
    classes, expected = (of if of.is_floating_point() else of.long() for of in (classes, expected))
    counts = (expected >= 0) & (expected != IGNORED_CLASS)
    classes, expected = classes[counts], expected[counts]
    areas = {}
    for name in torch.cat([classes, expected]).unique().tolist():
        masks = classes == name, expected == name
        areas[int(name)] = ((masks[0] & masks[1]).sum().item(), (masks[0] | masks[1]).sum().item())
    return areas


def _mean_iou(contents: Iterable[Any]) -> float:
    sums: dict[int, np.ndarray] = defaultdict(lambda: np.zeros(2))
    for name, *area in (row for rows in contents for row in rows):
        sums[name] += area
    return float(np.mean([intersection / union for intersection, union in sums.values()] or [np.nan]))


def _mean_average_precision(contents: Sequence[Any]) -> dict[str, float]:
    try:
        from torchmetrics.detection import MeanAveragePrecision  # noqa: PLC0415 - slow to import

        metric = MeanAveragePrecision(backend="pycocotools")
    except ImportError as error:
        warn(f"mAP is left out: {error}; pip install 'torchrefract[train]'")
        return {}
    metric.warn_on_many_detections = False
    pairs = [(_decode(detections, 6), _decode(labels, 5)) for detections, labels in contents]
    classes = torch.cat([expected[:, 4] for _, expected in pairs]).unique()
    for predicted, expected in pairs:
        of_classes = predicted[torch.isin(predicted[:, 4], classes)]  # others do not count, but take time
        metric.update(
            [{"boxes": of_classes[:, :4], "labels": of_classes[:, 4].long(), "scores": of_classes[:, 5]}],
            [{"boxes": expected[:, :4], "labels": expected[:, 4].long()}],
        )
    result = metric.compute()
    values = {name: result[key].item() for name, key in (("mAP", "map"), ("mAP50", "map_50"))}
    # The metric returns -1 without labels.
    return {name: value if value >= 0 else float("nan") for name, value in values.items()}


def corners_of(boxes: Any) -> Tensor:
    """Return boxes as x1, y1, x2, y2, (n, 4), on the CPU: `BoundingBoxes` of torchvision by their format."""
    plain = torch.as_tensor(boxes).detach().cpu().as_subclass(Tensor)
    form = boxes.format.name if is_tv_tensor(boxes, "BoundingBoxes") else "XYXY"
    return (plain if form == "XYXY" else convert_boxes(plain, form, "XYXY")).reshape(-1, 4)


def _encode(boxes: Any, *columns: Any) -> str:
    """Encode boxes (n, 4) and columns (n,) as rows of float32."""
    parts = [torch.as_tensor(part).detach().cpu().as_subclass(Tensor).float()[:, None] for part in columns]
    rows = torch.cat([corners_of(boxes).float(), *parts], dim=1)
    return base64.b64encode(rows.numpy().astype("<f4").tobytes()).decode("ascii")


def _decode(rows: str, num_columns: int) -> Tensor:
    return torch.from_numpy(np.frombuffer(base64.b64decode(rows), "<f4").reshape(-1, num_columns).copy())
