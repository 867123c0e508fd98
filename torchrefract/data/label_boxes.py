"""Upright boxes of the objects in label files of pictures."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from torchrefract.data.label_files import Annotation, CocoAnnotations, CocoLabels, PictureLabels, YoloFile, yolo_rows
from torchrefract.labels.vehicles import LabeledBoxes


def boxes_of_yolo(data: bytes, labels: YoloFile, size: tuple[int, int]) -> tuple[np.ndarray, list[int]]:
    """Return the boxes (N, 4), x1, y1, x2, y2, px from the edge of the first pixel, and classes of a YOLO file.

    Args:
        data: content of the file.
        labels: name the file in messages.
        size: (H, W) of the picture.

    Raises:
        ValueError: an invalid line.
    """
    scale = np.array([size[1], size[0]])
    rows = [(int(name), np.reshape(numbers, (-1, 2)) * scale) for name, numbers in yolo_rows(data, labels.path)]
    # The center and size of a box, or the corners of a polygon.
    boxes = [
        [*(at[0] - at[1] / 2), *(at[0] + at[1] / 2)] if len(at) == 2 else [*at.min(axis=0), *at.max(axis=0)]
        for _, at in rows
    ]
    return np.reshape(boxes, (-1, 4)), [name for name, _ in rows]


def boxes_of_coco(annotations: Sequence[Annotation]) -> np.ndarray:
    """Return the boxes (N, 4), x1, y1, x2, y2, px from the edge of the first pixel, of annotations with a bbox."""
    corners = np.reshape([annotation["bbox"] for annotation in annotations], (-1, 4)).astype(float)
    return np.concatenate([corners[:, :2], corners[:, :2] + corners[:, 2:]], axis=1)


def category_names(labels: CocoLabels) -> dict[int, str]:
    """Return the names of the categories of a COCO JSON, by id."""
    categories = [entry for entry in labels.document.get("categories", ()) if isinstance(entry, dict)]
    return {entry["id"]: str(entry["name"]) for entry in categories if "id" in entry and "name" in entry}


def labeled_boxes(labels: PictureLabels | None, size: tuple[int, int], names: Mapping[int, str]) -> LabeledBoxes:
    """Return the boxes of a picture of `size` (H, W) with their classes: names of COCO, numbers of YOLO."""
    boxes, classes = np.zeros((0, 4)), list[int | str]()
    if isinstance(labels, YoloFile):
        boxes, numbers = boxes_of_yolo(labels.move(None, size).content, labels, size)
        classes += numbers
    elif isinstance(labels, CocoAnnotations):
        annotations = [annotation for annotation in labels.annotations if annotation.get("bbox")]
        boxes = boxes_of_coco(annotations)
        classes += [names.get(ids, ids) for ids in (annotation.get("category_id", -1) for annotation in annotations)]
    return LabeledBoxes(torch.from_numpy(boxes).float() - 0.5, classes)
