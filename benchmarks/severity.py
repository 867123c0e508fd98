"""How much each scene takes from a frame at each severity, by one score for all of them.

    python benchmarks/severity.py --root FRAMES                   # a table of real frames; FRAMES is a folder
    python benchmarks/severity.py --figure examples/severity.png  # a picture of rendered roads

An edge (Canny) or a corner (ORB) of the clean frame is kept if the degraded one shows it within 2 px of its true place,
which the flow of the scene knows. The score is what a scene takes: 1 less the mean of both shares.
"""

import argparse
import inspect
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract import presets
from torchrefract.data.images import read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.types import Degraded

NEAR_PX = 2.0
SCENES: dict[str, Callable[..., Any]] = {
    name: function
    for name, function in inspect.getmembers(presets, inspect.isfunction)
    if not name.startswith("_") and function.__module__ == presets.__name__
}


class Score(NamedTuple):
    """What a degraded frame keeps, in [0, 1]; NaN if the clean frame has none."""

    edges: float
    corners: float

    @property
    def taken(self) -> float:
        """Return 1 less the mean of both shares."""
        return 1 - (self.edges + self.corners) / 2


def score(clean: Tensor, degraded: Tensor, flow: Tensor | None = None) -> Score:
    """Return the shares of edges and of corners that a degraded frame shows at their true places.

    Args:
        clean, degraded: (3, H, W), in [0, 1].
        flow: (2, H, W), px, backward: pixel p of the degraded frame shows p + flow(p) of the clean one. None moves
            nothing.
    """
    before, after = (gray_levels(image) for image in (clean, degraded))
    height, width = before.shape
    edges = cv2.Canny(before, 100, 200) > 0
    rows, columns = np.nonzero(cv2.Canny(after, 100, 200))
    x, y = _places(columns, rows, flow)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    shown = np.ones((height, width), np.uint8)
    shown[y[inside].round().astype(int).clip(max=height - 1), x[inside].round().astype(int).clip(max=width - 1)] = 0
    is_near = cv2.distanceTransform(shown, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= NEAR_PX
    return Score(float(is_near[edges].mean()) if edges.any() else np.nan, _kept_corners(before, after, flow))


def _kept_corners(before: np.ndarray, after: np.ndarray, flow: Tensor | None) -> float:
    orb = cv2.ORB_create(1000)
    (points, codes), (others, other_codes) = (orb.detectAndCompute(image, None) for image in (before, after))
    if codes is None or other_codes is None:
        return np.nan if codes is None else 0.0
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(codes, other_codes)
    p = np.array([points[match.queryIdx].pt for match in matches])
    q = np.array([others[match.trainIdx].pt for match in matches])
    x, y = _places(q[:, 0], q[:, 1], flow)
    return float((np.hypot(x - p[:, 0], y - p[:, 1]) <= NEAR_PX).sum() / len(points))


def _places(x: np.ndarray, y: np.ndarray, flow: Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    """Return what the flow says that points of the degraded frame show, px in the clean one."""
    if flow is None:
        return x, y
    at = flow[:, y.round().astype(int), x.round().astype(int)].double().numpy()
    return x + at[0], y + at[1]


def gray_levels(image: Tensor) -> np.ndarray:
    """Return the luma of an image (3, H, W) in [0, 1] as (H, W), uint8."""
    pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
