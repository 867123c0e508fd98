"""What the effects of random fields share."""

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_range, check_within, eager_values
from torchrefract.effects.motion import check_motion, is_still
from torchrefract.effects.rows import expand_batch
from torchrefract.fields.evolution import evolved, turn_rates
from torchrefract.fields.gaussian import gaussian_random_field, spectrum
from torchrefract.fields.low_modes import low_amplitude, low_field
from torchrefract.fields.modes import Modes, evolved_modes, mode_amplitude, mode_field, mode_noise, mode_turn_rates
from torchrefract.fields.torus import torus
from torchrefract.types import Range

# A covariance that is off by twice this is told.
_CLIPPED = 1e-3
# px
FIELD_BOUNDS: dict[str, Range] = {"amplitude": (0.0, 1e4), "length": (1e-3, 1e6), "aperture": (0.0, 1e4)}


def random_field(
    params: Any, *, kind: str, longest: float, widest: float | None = None, height: int, width: int
) -> Tensor:
    """Two independent fields (B T, 2, H, W) of variance 1, from parameters that `check_field_params` takes.

    Args:
        params: a NamedTuple of tensors with a `length`, a `key`, a `frame` and more, maybe an `aperture`; its
            `amplitude` gives the type.
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
    share = max(eager_values(lambda: torch.where(params.applied, clipped, 0), of=clipped) or [0.0])
    if share > _CLIPPED:
        warnings.warn(
            f"length must be short enough for a torus of {size[0]} x {size[1]} px, the largest for this frame: "
            f"{share:.1%} of the spectrum is negative and clipped, the covariance off by up to twice that, got "
            f"{params.length.max().item():g} px",
            stacklevel=2,
        )
    fields = [gaussian_random_field(*one, height=height, width=width) for one in _noises(params, shape, size)]
    return fields[0] if len(fields) == 1 else torch.cat(fields)


def _noises(params: Any, shape: Tensor, size: tuple[int, int]) -> Iterator[tuple[Tensor, Tensor]]:
    """The noise of the torus and the spectrum it is shaped by, for one frame after the other where there are several.

    All samples at once, if no clip asks for so much memory.
    """
    dtype, frames = params.amplitude.dtype, params.frame.shape[1]
    noise = random.white_noise(params.key, size[0] * size[1]).view(-1, 2, *size).to(dtype)
    if is_still(params):
        yield noise, shape
        return
    rates = turn_rates(params.key, size, dtype=dtype)
    if frames == 1 or torch.compiler.is_compiling():
        rows = noise.shape[0] * frames
        options = {name: expand_batch(getattr(params, name), rows) for name in ("wind", "decorrelation")}
        moved = evolved(expand_batch(noise, rows), expand_batch(rates, rows), frame=params.frame.reshape(-1), **options)
        yield moved, expand_batch(shape, rows)
        return
    for i in range(noise.shape[0]):
        own = {name: getattr(params, name)[i : i + 1] for name in ("wind", "decorrelation")}
        for frame in params.frame[i].split(1):
            yield evolved(noise[i : i + 1], rates[i : i + 1], frame=frame, **own), shape[i : i + 1]


def field_of_modes(
    params: Any,
    modes: Modes,
    at: tuple[Sequence[int], Sequence[int]],
    *,
    kind: str,
    lengths: Range,
    nodes: int | None,
    aperture: bool,
    fields: int = 2,
) -> Tensor:
    """The fields of `random_field`, (B T, 2, n, m), of a few frequencies.

    Args:
        params: as for `random_field`.
        modes: the frequencies to keep.
        at: px, rows and columns.
        kind: of the covariance.
        lengths: px, the range of correlation lengths.
        nodes: as for `low_eigenvalues`.
        aperture: whether the parameters have one.
        fields: 2, or 1 for the first of them alone, (B T, 1, n, m).
    """
    dtype, rows = params.amplitude.dtype, params.frame.numel()
    noise = mode_noise(params.key, modes, dtype=dtype)
    if not is_still(params):
        rates = expand_batch(mode_turn_rates(params.key, modes, dtype=dtype), rows)
        options = {name: expand_batch(getattr(params, name), rows) for name in ("wind", "decorrelation")}
        noise = evolved_modes(expand_batch(noise, rows), rates, modes, frame=params.frame.reshape(-1), **options)
    shape: Any = {"aperture": params.aperture if aperture else None, "dtype": dtype}
    if kind == "gaussian":
        amplitude = mode_amplitude(modes, params.length, **shape, shortest=lengths[0])
        down, across = (expand_batch(values, noise.shape[0]) for values in amplitude)
        return mode_field(noise, (down, across), modes, *at, fields=fields)
    amplitude = low_amplitude(modes, params.length, kind=kind, lengths=lengths, nodes=nodes, **shape)
    return low_field(noise, expand_batch(amplitude, noise.shape[0]), modes, *at)[:, :fields]


def check_field_range(name: str, value: Range) -> Range:
    """The range of one of `FIELD_BOUNDS`."""
    low, high = FIELD_BOUNDS[name]
    return check_range(f"{name}_range", value, low=low, high=high)


def check_field_params(params: Any) -> None:
    """Raise for parameters of a random field, some of `FIELD_BOUNDS`, a `key` and what moves them, that are none."""
    bounds = {name: ends for name, ends in FIELD_BOUNDS.items() if name in params._fields}
    for name in bounds:
        if getattr(params, name).ndim != 1:
            raise ValueError(f"params.{name} must have shape (B,), got {tuple(getattr(params, name).shape)}")
    check_key(params)
    check_motion(params, axes=2)
    for name, ends in bounds.items():
        check_within(f"params.{name}", getattr(params, name), *ends)


def check_key(params: Any) -> None:
    """Raise unless there is a `key` of a hash."""
    if params.key.shape[1:] != (4,) or params.key.dtype is not torch.int64:
        raise ValueError(f"params.key must be (B, 4) of int64, got {tuple(params.key.shape)} of {params.key.dtype}")
