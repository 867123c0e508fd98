"""The lattices of Perlin's noise in the plane, which drift and turn from frame to frame."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import eager_bool, requires_grad
from torchrefract.random import lattice_noise

# Multiples of the golden ratio stay away from each other, modulo 1: octaves share no lines of nodes.
_GOLDEN = (5**0.5 - 1) / 2


class Octave(NamedTuple):
    """The nodes of a lattice that a frame takes, and where its pixels lie between them."""

    gradient: Tensor  # (N, 2, m, n), g_x and g_y at the nodes
    x: Tensor  # (N, W), float64, of each column of pixels, the number of the node before it and the part of the cell
    y: Tensor  # (N, H), float64, of each row; in [0, m - 1], and evenly spaced but for less than a cell


def octave(
    key: Tensor,
    index: int,
    *,
    period: float,
    height: int,
    width: int,
    frame: Tensor,
    wind: Tensor,
    decorrelation: Tensor,
    dtype: torch.dtype,
    stride: int = 1,
    start: int = 0,
) -> Octave:
    """One octave at one frame of a clip: unit gradients that turn, at nodes that go with the wind.

        g = (cos a, sin a),  a = 2 pi u1 + omega t,  omega = 2 erfinv(2 u2 - 1) / decorrelation
        x = (start + stride column + 1/2 - wind_x t) / period + phase_x,  y likewise
        phase = frac(key / 2^32 + (index + 1) (sqrt(5) - 1) / 2)

    u1 and u2 are uniform, a hash of the node's place in an endless lattice. omega is normal, so what goes with the wind
    is correlated with itself after t frames by E cos(omega t) = exp(-(t / decorrelation)^2), and its magnitude stays.
    Nodes that no pixel lies beside are left out where pixels are at least two cells apart.

    Args:
        key: (N, 4), int64, of `noise_key`.
        index: of the octave; octaves of different indices are independent.
        period: px, above 0, between two nodes.
        height, width: rows and columns, px of the frame or nodes of a lattice.
        frame: (N,), t.
        wind: (N, 2), px per frame, to the right and down.
        decorrelation: (N,), frames, above 0; inf for gradients that stay.
        dtype: of the gradients.
        stride, start: px, between rows or columns, and of the first of them.

    Source: Perlin and Neyret, "Flow noise", SIGGRAPH 2001, technical sketches, for the turning.
    """
    origin = origins(key, [index], [period], frame=frame, wind=wind, starts=[start])[:, 0]
    first = origin.detach().floor()
    places, nodes = [], [torch.full((len(key), 1), index, device=key.device)]
    for size, place, node in zip((width, height), (origin - first).unbind(1), first.long().unbind(1), strict=True):
        along, taken = _taken(place[:, None], size, stride / period)
        places.append(along)
        nodes.append(node[:, None] + taken)
    angle = 2 * math.pi * _turns(key, nodes, frame=frame, decorrelation=decorrelation, dtype=dtype)
    # In memory column by column, as `perlin_noise` looks them up.
    return Octave(torch.stack([angle.cos(), angle.sin()], dim=1).mT, *places)


def origins(
    key: Tensor,
    indices: Sequence[int],
    periods: Sequence[float],
    *,
    frame: Tensor,
    wind: Tensor,
    starts: Sequence[int],
) -> Tensor:
    """(N, octaves, 2), float64: x and y of the first column and row, in `octave`, of octaves with their periods."""
    known = [[_GOLDEN * (i + 1) for i in indices], list(periods), [start + 0.5 for start in starts]]
    turn, period, start = as_device_tensor(known, dtype=torch.float64, device=key.device)[..., None]
    phase = (2.0**-32 * key[:, None, :2].double() + turn).frac()
    return (start - (wind.double() * frame.double()[:, None])[:, None]) / period + phase


def _taken(start: Tensor, size: int, step: float) -> tuple[Tensor, Tensor]:
    """Where pixels lie among the nodes they take, (N, size), and the numbers of these nodes, (N or 1, n)."""
    pixel = torch.arange(size, dtype=start.dtype, device=start.device)
    along = start + step * pixel
    if step < 2:
        return along, torch.arange(math.ceil(size * step) + 2, device=start.device)[None]
    # Pixels so far apart share no node: each takes the two of its own.
    before = along.detach().floor()
    return along - before + 2 * pixel, torch.stack([before, before + 1], dim=2).long().flatten(1)


def _turns(key: Tensor, nodes: Sequence[Tensor], *, frame: Tensor, decorrelation: Tensor, dtype: torch.dtype) -> Tensor:
    """(N, n, m), the angles of the gradients over 2 pi."""
    if not requires_grad((frame, decorrelation)) and eager_bool((frame / decorrelation == 0).all, of=frame):
        return lattice_noise(key, nodes, 1)[:, 0, 0].to(dtype)
    start, speed = lattice_noise(key, nodes, 2)[:, :, 0].unbind(1)
    elapsed = (frame.double() / (math.pi * decorrelation.double()))[:, None, None]
    # Whole turns are dropped before the type gets narrow: after a long time they are many.
    return start.to(dtype) + ((2 * speed - 1).double().erfinv() * elapsed).frac().to(dtype)
