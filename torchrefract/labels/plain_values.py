"""Plain values that hold positions in the image: they would stay behind if the image moved, so they raise."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

_LARGEST_MATRIX = 8  # rows; a tensor of the size of a smaller frame may be a matrix of a camera
_TYPES = {
    **dict.fromkeys(("box", "boxes", "bbox", "bboxes", "bounding_box", "bounding_boxes"), "BoundingBoxes"),
    **dict.fromkeys(("mask", "masks", "segmentation", "segmentations"), "Mask"),
    **dict.fromkeys(("keypoint", "keypoints"), "KeyPoints"),
}
# Last words of longer names, as in "gt_bboxes"; their values have at least two dimensions.
_TYPES_BY_WORD = {
    **_TYPES,
    **dict.fromkeys(("bndbox", "obb", "fbox", "hbox", "vbox"), "BoundingBoxes"),
    **dict.fromkeys(("poly", "polygon", "polygons", "contour", "contours"), "Mask"),
    **dict.fromkeys(("kpt", "kpts", "landmark", "landmarks", "lane", "lanes", "polyline", "polylines"), "KeyPoints"),
}
# Words after the name: "d" of "box2d", "proj" of Omni3D's "bbox2D_proj".
_FORMATS = ("xyxy", "xywh", "cxcywh", "xyxyn", "xywhn", "d", "proj", "trunc", "tight")
_OF_SPACE = re.compile(r"3_?d$")  # boxes in meters do not move with the image
_COUNTS = ("num", "n", "count")  # first words of names of counts
_COORDINATES = re.compile(r"[xy]|[xy][1-4]|c[xy]|[xy]_?(min|max)|w|h|width|height|left|top|right|bottom")


def names_of(path: Any) -> list[str]:
    """Return the keys and field names of a path in lower case."""
    names = [getattr(key, "key", getattr(key, "name", None)) for key in path]
    return [str(name).lower() for name in names if name is not None]


def name_of(path: Any) -> str:
    """Return the last key or field name of a path; "" if it has neither."""
    return next(reversed(names_of(path)), "")


def check_moves(path: Any, leaf: Any, siblings: Mapping[str, Any], size: tuple[int, int]) -> None:
    """Raise TypeError for a plain value that holds positions in the image, by its name or by its size.

    Args:
        path: of the leaf in its sample.
        leaf: a value of the sample, of any type.
        siblings: the entries of its dict, by their names in lower case.
        size: (H, W) of the frame.
    """
    shape = None
    if isinstance(leaf, Tensor | np.ndarray):
        shape = tuple(leaf.shape)
        if not shape or type(leaf) not in (Tensor, torch.nn.Parameter, np.ndarray):
            return
    elif not _may_hold_positions(leaf):
        return
    place, got = f"target{pytree.keystr(path)}", f"a plain {type(leaf).__name__}"
    if kind := _kind(path, leaf, siblings):
        options = {"BoundingBoxes": f", format=..., canvas_size={size}", "KeyPoints": f", canvas_size={size}"}
        remedy = f"tv_tensors.{kind}(...{options.get(kind, '')})"
        raise TypeError(f"{place} must be a {kind} of torchvision to move with the image, got {got}; pass {remedy}")
    if shape is not None and min(size) > _LARGEST_MATRIX and size in (shape[-2:], shape[:2]):
        remedy = "tv_tensors.Mask(...), or Image(...) for values to interpolate"
        raise TypeError(
            f"{place} must be of a torchvision type to move with the image, got {got} {shape}; pass {remedy}"
        )


def names_positions(name: str) -> bool:
    """Return True if data sets store positions in the image under a name, as "lanes" or "gt_bboxes"."""
    return _kind_by_word(name.lower()) is not None


def _may_hold_positions(leaf: Any) -> bool:
    is_scalar = isinstance(leaf, int | float | str | bytes | np.generic) and not isinstance(leaf, bool)
    return is_scalar or (isinstance(leaf, list | tuple) and len(leaf) > 0)


def _kind(path: Any, leaf: Any, siblings: Mapping[str, Any]) -> str | None:
    """Return the torchvision type that a plain value should have; None if its name tells nothing."""
    names = names_of(path)
    name, parent = names[-1] if names else "", names[-2] if len(names) > 1 else ""
    is_scalar = not isinstance(leaf, list | tuple | Tensor | np.ndarray)
    # COCO's masks are a dict of run lengths and a size.
    if ("segmentation" in names[:-1] and not is_scalar) or (name == "counts" and "size" in siblings):
        return "Mask"
    if is_scalar:
        # A box as a dict, such as {"xmin": ...} of Pascal VOC and {"x1": ...} of BDD.
        return _kind_by_word(parent) if _COORDINATES.fullmatch(name) else None
    if name in _TYPES:
        return _TYPES[name]
    return _kind_by_word(name) if _num_dimensions(leaf) > 1 else None


def _kind_by_word(name: str) -> str | None:
    words = re.findall(r"[a-z]+", name)
    while words and words[-1] in _FORMATS:
        words.pop()
    if not words or words[0] in _COUNTS or _OF_SPACE.search(name):
        return None
    return _TYPES_BY_WORD.get(words[-1])


def _num_dimensions(value: Sequence[Any] | Tensor | np.ndarray) -> int:
    if isinstance(value, Tensor | np.ndarray):
        return value.ndim
    return 1 + max(
        (_num_dimensions(part) for part in value if isinstance(part, list | tuple | Tensor | np.ndarray)), default=0
    )
