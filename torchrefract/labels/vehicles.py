"""Boxes of vehicles among the labels of an image."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract.labels.plain_values import name_of
from torchrefract.labels.targets import ROTATED, convert_boxes, is_tv_tensor

# Names of classes, as data sets of roads write them.
VEHICLES = (
    *("car", "truck", "bus", "van", "motorcycle", "motorbike", "pickup", "tractor", "trailer", "caravan", "vehicle"),
    *("autorickshaw", "rickshaw", "lorry", "minibus", "suv", "jeep"),
)
_CLASS_NAMES = (
    *("labels", "label", "class", "classes", "categories", "category", "category_id", "category_ids", "names"),
    *("class_id", "class_ids", "class_labels", "cls", "gt_labels", "gt_classes"),
)


class LabeledBoxes(NamedTuple):
    """The boxes of an image and their classes."""

    boxes: Tensor  # (N, 4), x1, y1, x2, y2, px from the center of the first pixel, as for `warp_boxes`
    labels: Sequence[int | str] | None  # of each box; None if the boxes have no classes


def boxes_of_target(target: Any, *, size: Sequence[int]) -> LabeledBoxes:
    """Return the `BoundingBoxes` of torchvision in a nested target, with the classes that stand beside them.

    The classes of boxes are the entry "labels", "classes" or the like of the same dict, or the first entry of the same
    list or tuple with one whole number or text for each box.

    Raises:
        ValueError: boxes of another canvas than an image of this size, (H, W).
    """
    pairs, _ = pytree.tree_flatten_with_path(target, is_leaf=lambda node: _classes(node) is not None)
    boxes, labels, is_labeled = list[Tensor](), list[int | str](), True
    for path, leaf in pairs:
        if not is_tv_tensor(leaf, "BoundingBoxes") or leaf.numel() == 0:
            continue
        if tuple(leaf.canvas_size) != tuple(size):
            raise ValueError(
                f"BoundingBoxes must have the canvas size of the image, {tuple(size)}, got {tuple(leaf.canvas_size)}"
            )
        boxes.append(_corners(leaf))
        nearby = [(other, _classes(value)) for other, value in pairs if other[:-1] == path[:-1] and value is not leaf]
        if path and isinstance(path[-1], pytree.MappingKey):
            nearby = [(other, classes) for other, classes in nearby if name_of(other).lower() in _CLASS_NAMES]
        of_these = next((classes for _, classes in nearby if classes is not None and len(classes) == len(leaf)), None)
        is_labeled = is_labeled and (of_these is not None or len(leaf) == 0)
        labels += of_these or []
    all_boxes = torch.cat(boxes) if boxes else torch.zeros(0, 4, dtype=torch.float32, device="cpu")
    return LabeledBoxes(all_boxes, labels if is_labeled else None)


def select_vehicles(samples: Sequence[LabeledBoxes], labels: Collection[int | str], *, like: Tensor) -> Tensor:
    """Return the boxes of each image that are vehicles, (B, V, 4), with the type and on the device of `like`.

    Args:
        samples: the boxes of each image. Boxes without classes are all vehicles.
        labels: numbers or names of the classes of vehicles; names count in lower case.
        like: a floating tensor.

    Returns:
        As many boxes for each image as the largest number of vehicles; those that it lacks are 0 and have no area.
    """
    names = {*map(_lower, labels)}
    chosen = [
        boxes if classes is None else boxes[[i for i, label in enumerate(classes) if _lower(label) in names]]
        for boxes, classes in samples
    ]
    result = like.new_zeros(len(samples), max(map(len, chosen), default=0), 4)
    for row, boxes in zip(result, chosen, strict=True):
        row[: len(boxes)] = boxes
    return result


def _lower(label: int | str) -> int | str:
    return label.lower() if isinstance(label, str) else label


def check_vehicle_labels(labels: Sequence[int | str] | None) -> tuple[int | str, ...] | None:
    """Return numbers or names of classes as a tuple, or None; raise ValueError for other values."""
    if labels is None:
        return None
    if isinstance(labels, str) or not all(type(label) in (int, str) for label in labels):
        raise ValueError(f"vehicle_labels must be numbers or names of classes, got {labels!r}")
    return tuple(labels)


def _corners(boxes: Any) -> Tensor:
    """Return the smallest upright boxes, (N, 4), px from the center of the first pixel."""
    plain, form = boxes.as_subclass(Tensor), boxes.format.name
    plain = plain if plain.is_floating_point() else plain.to(torch.float32)
    if form not in ROTATED:
        return convert_boxes(plain, form, "XYXY") - 0.5
    points = convert_boxes(plain, form, "XYXYXYXY").unflatten(-1, (4, 2))
    return torch.cat([points.amin(dim=-2), points.amax(dim=-2)], dim=-1) - 0.5


def _classes(value: Any) -> list[int | str] | None:
    """Return the classes that a tensor, array or list holds, one for each box; None for other values."""
    if isinstance(value, Tensor | np.ndarray):
        is_whole = value.ndim == 1 and not any(word in str(value.dtype) for word in ("float", "complex", "bool"))
        return value.tolist() if is_whole and not is_tv_tensor(value, "BoundingBoxes") else None
    is_list = type(value) in (list, tuple) and all(type(part) in (int, str) for part in value)
    return list(value) if is_list else None
