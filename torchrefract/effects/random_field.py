"""Code that the effects of random fields share: checks, and the lattice on which a field is computed."""

import warnings
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import expand_batch
from torchrefract._validation import check_range, check_within, eager_values
from torchrefract.effects.motion import check_key, check_motion, is_still
from torchrefract.fields.random_field import FieldParams, Motion
from torchrefract.types import Range

_MAX_CLIPPED = 1e-3  # of the spectrum; the covariance is off by up to twice as much
FIELD_BOUNDS: dict[str, Range] = {"amplitude": (0.0, 1e4), "length": (1e-3, 1e6), "aperture": (0.0, 1e4)}  # px


def check_field_range(name: str, value: Range) -> Range:
    """Check the range of one of `FIELD_BOUNDS`."""
    low, high = FIELD_BOUNDS[name]
    return check_range(f"{name}_range", value, low=low, high=high)


def check_field_params(params: Any) -> None:
    """Raise ValueError for an invalid `amplitude`, `length`, `aperture`, `key` or motion."""
    bounds = {name: ends for name, ends in FIELD_BOUNDS.items() if name in params._fields}
    for name in bounds:
        if getattr(params, name).ndim != 1:
            raise ValueError(f"params.{name} must have shape (B,), got {tuple(getattr(params, name).shape)}")
    check_key(params)
    check_motion(params, axes=2)
    for name, ends in bounds.items():
        check_within(f"params.{name}", getattr(params, name), *ends)


def field_params(params: Any) -> FieldParams:
    """Return sizes, noise and motion of each frame, N = B T rows."""
    rows = params.frame.numel()
    motion = None
    if not is_still(params):
        wind, decorrelation = (expand_batch(value, rows) for value in (params.wind, params.decorrelation))
        motion = Motion(params.frame.reshape(-1), wind, decorrelation)
    aperture = expand_batch(params.aperture, rows) if "aperture" in params._fields else None
    return FieldParams(expand_batch(params.length, rows), aperture, expand_batch(params.key, rows), motion)


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
        warnings.warn(
            f"length must fit into a periodic domain of {size[0]} x {size[1]} px, the largest for this frame, got "
            f"{params.length.max().item():g} px: {share:.1%} of the spectrum is negative and was set to 0, and the "
            "covariance is off by up to twice that. Lower length_range.",
            stacklevel=2,
        )
