"""Annotations of a COCO JSON: what is wrong with them, and masks of their run-length codes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrefract._validation import UsageError
from torchrefract.labels.plain_values import names_positions

Annotation = dict[str, Any]

_GEOMETRY = ("bbox", "segmentation", "keypoints")  # entries of an annotation that move
_XYWH = 1  # `bbox_mode` of Detectron2


def problem_of(annotation: Annotation) -> str:
    """Return what is wrong with an annotation; empty if it can be moved."""
    box, keypoints = annotation.get("bbox"), annotation.get("keypoints")
    if box and not (_are_numbers(box) and len(box) == 4 and min(box[2:]) >= 0):
        return "has a bbox that is not x, y, width, height"
    if box and annotation.get("bbox_mode", _XYWH) != _XYWH:
        return f"has a bbox of bbox_mode {annotation['bbox_mode']}, which is not x, y, width, height in px"
    if keypoints and not (_are_numbers(keypoints) and len(keypoints) % 3 == 0):
        return "has keypoints that are not x, y, visibility of each"
    if keypoints and not {*keypoints[2::3]} <= {0, 1, 2}:
        return "has keypoints whose visibility is not 0, 1 or 2"
    return _problem_of_segmentation(annotation.get("segmentation")) or _problem_of_others(annotation)


def _problem_of_segmentation(parts: Any) -> str:
    if not parts:
        return ""
    if not isinstance(parts, dict):
        are_polygons = isinstance(parts, list) and all(
            _are_numbers(part) and len(part) > 5 and len(part) % 2 == 0 for part in parts
        )
        return "" if are_polygons else "has a segmentation that is not lists of x, y of three or more corners"
    if not parts.keys() >= {"counts", "size"}:
        return "has a run-length code without counts and size"
    if isinstance(parts["counts"], list):
        is_mask = _is_mask_code(parts["counts"], parts["size"])
        return "" if is_mask else "has a run-length code whose counts do not add up to the pixels of its size"
    return "" if decompressed(parts) is not None else "has a run-length code with counts that cannot be decoded"


def _problem_of_others(annotation: Annotation) -> str:
    for name, value in annotation.items():
        if name not in _GEOMETRY and isinstance(value, list | dict) and value and names_positions(name):
            return f"has {name}, positions that would stay where they are; remove them, or state them as bbox"
    attributes = annotation.get("attributes")
    if isinstance(attributes, dict) and (angle := attributes.get("rotation")):
        return f"has a box that is turned by {angle} degrees; state its corners as segmentation"
    return "has segments_info of panoptic labels, which cannot be moved" if "segments_info" in annotation else ""


def _are_numbers(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(v, int | float) and math.isfinite(v) for v in values)


def _is_mask_code(counts: Sequence[Any], size: Any) -> bool:
    """Return True if the runs of a code are those of a mask of its size."""
    are_counts = all(isinstance(count, int) and count >= 0 for count in counts)
    return are_counts and _are_numbers(size) and len(size) == 2 and sum(counts) == math.prod(size)


def decompressed(code: Mapping[str, Any]) -> np.ndarray | None:
    """Decode a compressed run-length code into a mask (H, W), uint8; return None for an invalid one."""
    try:
        from pycocotools import mask  # noqa: PLC0415 - only these codes need it
    except ImportError as error:
        raise UsageError(
            "labels must have uncompressed run-length codes (counts as a list) unless pycocotools is installed: pip "
            "install pycocotools"
        ) from error
    decode: Any = mask.decode  # its types know compressed codes as bytes only
    try:
        return decode(code)
    except (ValueError, TypeError, LookupError):
        return None
