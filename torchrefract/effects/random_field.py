"""Code that random fields share: checks and draws of parameters that move and change over a clip."""

from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import expand_batch
from torchrefract._validation import (
    bounded,
    check_range,
    check_values,
    check_within,
    eager_values,
    requires_grad,
    warn,
)
from torchrefract.effects.batch import LATEST_FRAME, check_shapes
from torchrefract.fields.random_field import FieldParams, Motion
from torchrefract.types import Range

_MAX_CLIPPED = 1e-3  # of the spectrum; the covariance is off by up to twice as much
_FASTEST = 1e6  # px or m per frame
_SHORTEST = 1e-3  # frames
FIELD_BOUNDS: dict[str, Range] = {"amplitude": (0.0, 1e4), "length": (1e-3, 1e6), "aperture": (0.0, 1e4)}  # px


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
    """Raise ValueError for an invalid `key`, (B, 4), `wind`, (B, axes), `decorrelation`, (B,), or `frame`, (B, T)."""
    if params.key.shape[1:] != (4,) or params.key.dtype is not torch.int64:
        raise ValueError(f"params.key must be (B, 4) of int64, got {tuple(params.key.shape)} of {params.key.dtype}")
    check_shapes(params, {"wind": (axes,), "decorrelation": ()})
    check_frame(params)
    check_within("params.wind", params.wind, -_FASTEST, _FASTEST)
    check_values("params.decorrelation", "be above 0", params.decorrelation, lambda v: v > 0)


def check_frame(params: Any) -> None:
    """Raise ValueError unless `frame` is (B, T), with numbers that clips may have."""
    if params.frame.ndim != 2:
        raise ValueError(f"params.frame must have shape (B, T), got {tuple(params.frame.shape)}")
    check_within("params.frame", params.frame, -LATEST_FRAME, LATEST_FRAME)


def frames_of(params: Any) -> Tensor:
    """Return (B T,), the numbers of the frames, within the bounds of `check_frame`; a NaN counts as frame 0."""
    return bounded(params.frame.reshape(-1), -LATEST_FRAME, LATEST_FRAME)


def check_field_range(name: str, value: Range) -> Range:
    """Check the range of one of `FIELD_BOUNDS`."""
    low, high = FIELD_BOUNDS[name]
    return check_range(f"{name}_range", value, low=low, high=high)


def check_field_params(params: Any) -> None:
    """Raise ValueError for an invalid `amplitude`, `length`, `aperture`, `key` or motion."""
    bounds = {name: ends for name, ends in FIELD_BOUNDS.items() if name in params._fields}
    check_shapes(params, dict.fromkeys(bounds, ()))
    check_motion(params, axes=2)
    for name, ends in bounds.items():
        check_within(f"params.{name}", getattr(params, name), *ends)


def motion_of(params: Any) -> Motion:
    """Return the motion of each frame, N = B T rows, within its bounds; values that are not finite move nothing."""
    rows = params.frame.numel()
    wind, decorrelation = (expand_batch(value, rows) for value in (params.wind, params.decorrelation))
    return Motion(
        frames_of(params),
        bounded(wind, -_FASTEST, _FASTEST),
        torch.where(decorrelation > 0, decorrelation.clamp(min=_SHORTEST), torch.inf),
    )


def field_params(params: Any) -> FieldParams:
    """Return sizes, noise and motion of each frame, N = B T rows."""
    rows = params.frame.numel()
    aperture = expand_batch(params.aperture, rows) if "aperture" in params._fields else None
    motion = None if is_still(params.frame, params.wind, params.decorrelation) else motion_of(params)
    return FieldParams(expand_batch(params.length, rows), aperture, expand_batch(params.key, rows), motion)


def is_still(frame: Tensor, *motion: Tensor) -> bool:
    """Return True if all samples are at frame 0 and no gradient of time is needed, as far as values can be read."""
    if frame.shape[1] > 1 or requires_grad((frame, *motion)):
        return False
    return eager_values((frame == 0).all, of=frame) is True


def warn_if_clipped(clipped: Tensor, params: Any, size: tuple[int, int]) -> None:
    """Warn if a field is too long for the largest domain, as far as values can be read.

    Args:
        clipped: (N,), negative share of the spectrum.
        params: with `applied` and `length`.
        size: px, of the domain.
    """
    applied = expand_batch(params.applied, len(clipped))
    share = max(eager_values(lambda: torch.where(applied, clipped, 0), of=clipped) or [0.0])
    if share > _MAX_CLIPPED:
        warn(
            f"length must fit into a periodic domain of {size[0]} x {size[1]} px, the largest for this frame, got "
            f"{params.length.max().item():g} px: {share:.1%} of the spectrum is negative and was set to 0, and the "
            "covariance is off by up to twice that. Lower length_range."
        )
