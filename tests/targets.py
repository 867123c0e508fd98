"""Targets in the types of torchvision."""

from typing import Any

import torch
from torchvision import tv_tensors


def boxes_of(rows: Any, size: tuple[int, int]) -> tv_tensors.BoundingBoxes:
    """Return boxes (N, 4), x1, y1, x2, y2, of a frame of a size (height, width)."""
    return tv_tensors.BoundingBoxes(torch.as_tensor(rows), format="XYXY", canvas_size=size)  # pyright: ignore[reportCallIssue]  # torchvision's overloads
