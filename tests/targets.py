"""Targets in the types of torchvision."""

from typing import Any

import torch
from torchvision import tv_tensors


def boxes_of(rows: Any, size: tuple[int, int]) -> tv_tensors.BoundingBoxes:
    """Return boxes (N, 4), x1, y1, x2, y2, of a frame of a size (height, width)."""
    options: dict[str, Any] = {"format": "XYXY", "canvas_size": size}
    return tv_tensors.BoundingBoxes(torch.as_tensor(rows), **options)


def keypoints_of(rows: Any, size: tuple[int, int]) -> tv_tensors.KeyPoints:
    """Return points (N, 2), x, y, of a frame of a size (height, width)."""
    options: dict[str, Any] = {"canvas_size": size}
    return tv_tensors.KeyPoints(torch.as_tensor(rows), **options)
