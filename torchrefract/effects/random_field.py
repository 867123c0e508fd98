"""What the effects of random fields share."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrefract import white_noise
from torchrefract._checks import check_all, read
from torchrefract.fields.gaussian import gaussian_random_field, spectrum, torus

# A covariance that is off by twice this is told.
_CLIPPED = 1e-3


def random_field(
    params: Any, *, kind: str, longest: float, widest: float | None = None, height: int, width: int
) -> Tensor:
    """Two independent fields (B, 2, H, W) of variance 1, from parameters with a `length`, a `key`, maybe an `aperture`.

    Args:
        params: a NamedTuple of tensors; its `amplitude` gives the type.
        kind: of the covariance.
        longest: px, the longest correlation length that may be drawn.
        widest: px, the widest aperture; None for parameters without one.
        height, width: px, of the frame.

    Warns:
        UserWarning: the field is too long for the largest torus, so that part of its spectrum is clipped (on the CPU).
    """
    dtype = params.amplitude.dtype
    size = torus(height, width, length=longest, kind=kind, aperture=widest or 0.0)
    aperture = None if widest is None else params.aperture
    shape, clipped = spectrum(size, params.length, kind=kind, aperture=aperture, dtype=dtype)
    share = max(read(lambda: torch.where(params.gate, clipped, 0)) or [0.0])
    if share > _CLIPPED:
        warnings.warn(
            f"length must be short enough for a torus of {size[0]} x {size[1]} px, the largest for this frame: "
            f"{share:.1%} of the spectrum is negative and clipped, the covariance off by up to twice that, got "
            f"{params.length.max().item():g} px",
            stacklevel=2,
        )
    noise = white_noise.noise(params.key, size[0] * size[1]).view(-1, 2, *size).to(dtype)
    return gaussian_random_field(noise, shape, height=height, width=width)


def check_field_params(params: Any, *, at_least_zero: Sequence[str]) -> None:
    """Raise for parameters of a random field with a `length` and a `key` that are none."""
    for name in (*at_least_zero, "length"):
        if getattr(params, name).ndim != 1:
            raise ValueError(f"params.{name} must have shape (B,), got {tuple(getattr(params, name).shape)}")
    if params.key.shape[1:] != (4,) or params.key.dtype is not torch.int64:
        raise ValueError(f"params.key must be (B, 4) of int64, got {tuple(params.key.shape)} of {params.key.dtype}")
    for name in at_least_zero:
        value = getattr(params, name)
        check_all(f"params.{name}", "be at least 0 and finite", value, lambda v: v.isfinite() & (v >= 0))
    check_all("params.length", "be above 0 and finite", params.length, lambda v: v.isfinite() & (v > 0))
