"""Parameters of random fields that move and change over a clip, for turbulence, divergence-free warps and fog."""

from typing import Any

import torch
from torch import Tensor

from torchrefract._validation import check_range, check_values, check_within, eager_bool, finite_or, requires_grad
from torchrefract.effects.batch import LATEST_FRAME
from torchrefract.types import Range

_FASTEST = 1e6  # px or m per frame
_SHORTEST = 1e-3  # frames


def check_wind(name: str, value: Range) -> Range:
    """Check the range of one component of a wind."""
    return check_range(name, value, low=-_FASTEST, high=_FASTEST)


def check_decorrelation(value: Range) -> Range:
    """Check the range of a decorrelation time; inf is a field that the wind moves without changing it."""
    return check_range("decorrelation_range", value, low=_SHORTEST, high=torch.inf)


def motion_ranges(*winds: Range, decorrelation: Range) -> list[Range]:
    """Return the ranges of the uniform numbers that `drawn_motion` takes: the wind, and 1 / decorrelation."""
    # An infinite end has no uniform draw, its inverse has.
    return [*winds, (1 / decorrelation[1], 1 / decorrelation[0])]


def drawn_motion(values: Tensor) -> dict[str, Tensor]:
    """Return `wind`, (B, axes), `decorrelation`, (B,), and `frame`, (B, 1), 0, from (B, axes + 1) uniform numbers."""
    wind, rate = values[:, :-1], values[:, -1]
    return {"wind": wind, "decorrelation": 1 / rate, "frame": torch.zeros_like(values[:, :1])}


def check_motion(params: Any, *, axes: int) -> None:
    """Raise ValueError unless `wind` is (B, axes), `decorrelation` (B,) and `frame` (B, T), with values in range."""
    if params.wind.shape[1:] != (axes,):
        raise ValueError(f"params.wind must have shape (B, {axes}), got {tuple(params.wind.shape)}")
    if params.decorrelation.ndim != 1:
        raise ValueError(f"params.decorrelation must have shape (B,), got {tuple(params.decorrelation.shape)}")
    check_frame(params)
    check_within("params.wind", params.wind, -_FASTEST, _FASTEST)
    check_values("params.decorrelation", "be above 0", params.decorrelation, lambda v: v > 0)


def check_frame(params: Any) -> None:
    """Raise ValueError unless `frame` is (B, T), with numbers that clips may have."""
    if params.frame.ndim != 2:
        raise ValueError(f"params.frame must have shape (B, T), got {tuple(params.frame.shape)}")
    check_within("params.frame", params.frame, -LATEST_FRAME, LATEST_FRAME)


def check_key(params: Any) -> None:
    """Raise ValueError unless `key` is (B, 4), int64."""
    if params.key.shape[1:] != (4,) or params.key.dtype is not torch.int64:
        raise ValueError(f"params.key must be (B, 4) of int64, got {tuple(params.key.shape)} of {params.key.dtype}")


def clamp_motion(frame: Tensor, wind: Tensor, decorrelation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Clamp the three to their bounds, and replace NaN by values that do not move, where nothing can be checked."""
    frame, wind = (
        finite_or(frame, 0.0).clamp(-LATEST_FRAME, LATEST_FRAME),
        finite_or(wind, 0.0).clamp(-_FASTEST, _FASTEST),
    )
    return frame, wind, torch.where(decorrelation > 0, decorrelation.clamp(min=_SHORTEST), torch.inf)


def is_still(params: Any) -> bool:
    """Return True if all samples are at frame 0 and no gradient of time is needed, as far as values can be read."""
    moving = (params.frame, params.wind, params.decorrelation)
    if params.frame.shape[1] > 1 or requires_grad(moving):
        return False
    return eager_bool((params.frame == 0).all, of=params.frame) is True
