"""How the fields of air and fog move and change over a clip: the same words for all effects."""

from typing import Any

import torch
from torch import Tensor

from torchrefract._validation import check_range, check_values, check_within, eager_bool, finite_or, requires_grad
from torchrefract.types import Range

_FASTEST = 1e6  # of the wind
_SHORTEST = 1e-3  # frames
LATEST_FRAME = 1e9  # either way: with the fastest wind, places that float64 still tells apart


def check_wind(name: str, value: Range) -> Range:
    """The range of one component of a wind."""
    return check_range(name, value, low=-_FASTEST, high=_FASTEST)


def check_decorrelation(value: Range) -> Range:
    """The range of a decorrelation time; inf is a field that only drifts."""
    return check_range("decorrelation_range", value, low=_SHORTEST, high=torch.inf)


def motion_ranges(*winds: Range, decorrelation: Range) -> list[Range]:
    """What `drawn_motion` wants uniform numbers of: the components of the wind, and one over the decorrelation."""
    # An infinite end has no uniform draw, its inverse has.
    return [*winds, (1 / decorrelation[1], 1 / decorrelation[0])]


def drawn_motion(values: Tensor) -> dict[str, Tensor]:
    """`wind`, (B, axes), `decorrelation`, (B,), and `frame`, (B, 1), 0, from (B, axes + 1) of `motion_ranges`."""
    wind, rate = values[:, :-1], values[:, -1]
    return {"wind": wind, "decorrelation": 1 / rate, "frame": torch.zeros_like(values[:, :1])}


def check_motion(params: Any, *, axes: int) -> None:
    """Raise unless `wind`, (B, axes), `decorrelation`, (B,), and `frame`, (B, T), say how a field moves."""
    if params.wind.shape[1:] != (axes,):
        raise ValueError(f"params.wind must have shape (B, {axes}), got {tuple(params.wind.shape)}")
    if params.decorrelation.ndim != 1:
        raise ValueError(f"params.decorrelation must have shape (B,), got {tuple(params.decorrelation.shape)}")
    check_frame(params)
    check_within("params.wind", params.wind, -_FASTEST, _FASTEST)
    check_values("params.decorrelation", "be above 0", params.decorrelation, lambda v: v > 0)


def tame(frame: Tensor, wind: Tensor, decorrelation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The three as they are; still, where they are no numbers and nothing may be read, or lead beyond float64."""
    frame, wind = (
        finite_or(frame, 0.0).clamp(-LATEST_FRAME, LATEST_FRAME),
        finite_or(wind, 0.0).clamp(-_FASTEST, _FASTEST),
    )
    return frame, wind, torch.where(decorrelation > 0, decorrelation.clamp(min=_SHORTEST), torch.inf)


def check_frame(params: Any) -> None:
    """Raise unless `frame`, (B, T), numbers frames that clips may have."""
    if params.frame.ndim != 2:
        raise ValueError(f"params.frame must have shape (B, T), got {tuple(params.frame.shape)}")
    check_within("params.frame", params.frame, -LATEST_FRAME, LATEST_FRAME)


def is_still(params: Any) -> bool:
    """Whether only the first frame is asked for, as far as that can be known, and no gradient of time."""
    moving = (params.frame, params.wind, params.decorrelation)
    if params.frame.shape[1] > 1 or requires_grad(moving):
        return False
    return eager_bool((params.frame == 0).all, of=params.frame) is True
