"""Fog whose density varies over the image: an extinction k q / <q> with q a mix of Perlin noises."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract._validation import finite_or
from torchrefract.fields.perlin import draw_octave, perlin_noise
from torchrefract.fields.random_field import Motion

_MAX_NODES = 1 << 24  # more nodes would take gigabytes


def image_noise(
    key: Tensor,
    weights: Tensor,
    *,
    octaves: Sequence[int],
    periods: Sequence[float],
    height: int,
    width: int,
    motion: Motion,
    stretch: bool,
) -> Tensor:
    """Mix Perlin noises in the image plane, each mapped to [0, 1].

        q = sum of w_i s_i,  s_i = (n_i / sqrt(1/2) + 1) / 2,  or (n_i - min n_i) / (max n_i - min n_i) if `stretch`

    Octaves that are left out count as their mean, s_i = 1/2; `stretch` needs all of them.

    Args:
        key: (N, 4), int64, of `noise_key`.
        weights: (N, K), w_i, of sum 1, gives the type.
        octaves: the indices of the octaves that are computed, at least one.
        periods: px, K of them.
        height, width: px, of the frame.
        motion: of the N fogs, with a wind in px per frame.
        stretch: map the extremes of each noise in the frame to 0 and 1, without gradients of these.

    Returns:
        (N, 1, H, W), q.
    """
    frame = {"height": height, "width": width, "motion": motion, "dtype": weights.dtype}
    drawn = [draw_octave(key, i, period=periods[i], **frame) for i in octaves]
    # A list as an index would make a device wait.
    chosen = torch.stack([weights[:, i] for i in octaves], dim=1)
    if not stretch:
        return perlin_noise(drawn, chosen * 0.5**0.5).add_(0.5)
    one = torch.ones_like(chosen[:, :1])
    stretched = [stretch_to_unit(perlin_noise([octave], one)) for octave in drawn]
    return (chosen[..., None, None] * torch.cat(stretched, dim=1)).sum(dim=1, keepdim=True)


def stretch_to_unit(noise: Tensor) -> Tensor:
    """Map the smallest value of each frame (N, 1, H, W) to 0 and the largest to 1; constant frames become 1/2."""
    low, high = noise.detach().amin(dim=(2, 3), keepdim=True), noise.detach().amax(dim=(2, 3), keepdim=True)
    return torch.where(high > low, (noise - low) / torch.where(high > low, high - low, 1), 0.5)


def normalize_weights(weights: Tensor) -> Tensor:
    """Divide weights (N, K) by their sum; invalid weights count as 0, and rows without any weight as all equal."""
    weights = finite_or(weights, 0.0).clamp(min=0)
    total = weights.sum(dim=1, keepdim=True)
    return torch.where(total > 0, weights, 1.0) / torch.where(total > 0, total, weights.shape[1])


def periods_in_frame(
    scales: Sequence[float], *, unit: str, reference_width: float, height: int, width: int
) -> tuple[float, ...]:
    """Return the periods of the noises in px.

    Args:
        scales: px in a frame `reference_width` px wide (unit "px"), or periods across the frame (unit "cells").
        unit: "px" or "cells".
        reference_width: px.
        height, width: px, of the frame.

    Raises:
        ValueError: a period is so short that the frame has more than 2^24 nodes and more than four for each pixel.
    """
    periods = tuple(width / scale if unit == "cells" else scale * width / reference_width for scale in scales)
    max_nodes, shortest = max(_MAX_NODES, 4 * height * width), min(periods)
    if height * width > max_nodes * shortest * shortest:
        raise ValueError(
            f"scales must have periods of at least {(height * width / max_nodes) ** 0.5:.2g} px in a frame of "
            f"{width} x {height} px, got {shortest:.2g} px"
        )
    return periods
