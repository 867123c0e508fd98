"""The scales of fog in drifts, and its noise at some of them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract._validation import check_number, check_positive, check_values, finite_or

# The paper's table of scales, with the weights that go with them.
_PAPER_SCALES = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_PAPER_WEIGHTS = (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
# Drifts of fog over a road: most of the variance in those as long as a few cars.
_ROAD_SCALES = (12.0, 24.0, 48.0, 96.0)
_ROAD_WEIGHTS = (0.2, 0.3, 0.3, 0.2)
# More would cost gigabytes.
_MOST_NODES = 1 << 24


def check_scales(
    scales: Sequence[float] | None, weights: Sequence[float] | None, *, mode: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Scales and as many weights; None are those of the paper in the image, and of a road in space."""
    paper = mode == "image"
    if scales is None:
        scales = _PAPER_SCALES if paper else _ROAD_SCALES
        weights = (_PAPER_WEIGHTS if paper else _ROAD_WEIGHTS) if weights is None else weights
    scales = tuple(check_positive("scales", scale) for scale in scales)
    if not scales:
        raise ValueError("scales must be at least one number above 0, got none")
    if weights is None or len(weights) != len(scales):
        raise ValueError(f"weights must be one number for each of {len(scales)} scales, got {weights}")
    weights = tuple(check_number("weights", weight, low=0.0) for weight in weights)
    if sum(weights) <= 0:
        raise ValueError(f"weights must have a sum above 0, got {weights}")
    return scales, weights


def periods(
    scales: Sequence[float], *, unit: str, reference_width: float, height: int, width: int
) -> tuple[float, ...]:
    """Of the noises in a frame, px.

    Args:
        scales, unit, reference_width: as for `HeterogeneousFog`.
        height, width: px, of the frame.

    Raises:
        ValueError: periods so short that the frame has more than 2^24 nodes, and more than four for each pixel.
    """
    found = tuple(width / scale if unit == "cells" else scale * width / reference_width for scale in scales)
    most, shortest = max(_MOST_NODES, 4 * height * width), min(found)
    if height * width > most * shortest * shortest:
        raise ValueError(
            f"scales must have periods of at least {(height * width / most) ** 0.5:.2g} px in a frame of "
            f"{height} x {width} px, got {shortest:.2g} px"
        )
    return found


def chosen(share: Tensor, octaves: Sequence[int]) -> Tensor:
    """(N, octaves) of (N, K)."""
    # A list as an index would make a device wait.
    return torch.stack([share[:, i] for i in octaves], dim=1) if octaves else share[:, :0]


def stretched(noise: Tensor) -> Tensor:
    """(N, 1, H, W), a noise from its smallest value in the frame, at 0, to its largest, at 1."""
    low, high = noise.detach().amin(dim=(2, 3), keepdim=True), noise.detach().amax(dim=(2, 3), keepdim=True)
    return torch.where(high > low, (noise - low) / torch.where(high > low, high - low, 1), 0.5)


def check_weights(weights: Tensor, count: int) -> None:
    """Raise unless these are `params.weights`, (B, count), of noises."""
    if weights.shape[1:] != (count,):
        raise ValueError(f"params.weights must be (B, {count}), got {tuple(weights.shape)}")
    check_values("params.weights", "be at least 0 and finite", weights, lambda v: v.isfinite() & (v >= 0))
    sums = weights.sum(dim=1)
    check_values("params.weights", "have a sum above 0", sums, lambda v: v > 0)
    check_values("params.weights", "have a finite sum", sums, torch.isfinite)


def shares(weights: Tensor) -> Tensor:
    """(N, K), weights over their sum; what is no weight, and may not be read, counts as none, and none as all alike."""
    weights = finite_or(weights, 0.0).clamp(min=0)
    total = weights.sum(dim=1, keepdim=True)
    return torch.where(total > 0, weights, 1.0) / torch.where(total > 0, total, weights.shape[1])
