"""Perlin's noise in the plane as frames of clips have it: drawn and summed by a kernel where one can, or in PyTorch."""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels, obstacle
from torchrefract._threads import share
from torchrefract._validation import requires_grad, why_not_eager
from torchrefract.fields.perlin import Nodes, perlin_noise
from torchrefract.fields.perlin_lattice import Octave, octave, origins
from torchrefract.random import _HASH as HASH
from torchrefract.warping.lattice import Lattice, lagrange_weights


class Drawn(NamedTuple):
    """What the lattices of N frames are drawn from, as for `octave`."""

    key: Tensor  # (N, 4), int64
    frame: Tensor  # (N,)
    wind: Tensor  # (N, 2), px per frame
    decorrelation: Tensor  # (N,), frames


class Coarse(NamedTuple):
    """Octaves that are known at the nodes of a lattice, and cubics between these."""

    periods: Sequence[tuple[int, float]]  # each with its index, px
    weights: Tensor  # (N, octaves)
    lattice: Lattice


def drawn_noise(
    drawn: Drawn,
    periods: Sequence[tuple[int, float]],
    weights: Tensor,
    *,
    height: int,
    width: int,
    coarse: Coarse | None = None,
) -> Tensor:
    """(N, 1, H, W), what `perlin_noise` makes of octaves, each with its index and its period in px.

    By a kernel it is as near to that of real numbers, and not the same in its last digits.

    Args:
        drawn: what the octaves are drawn from.
        periods: at least one, or none where there are coarse ones.
        weights: (N, octaves), of the type of the noise.
        height, width: px.
        coarse: what else is added.
    """
    values = (*drawn, weights) if coarse is None else (*drawn, weights, coarse.weights)
    if not (requires_grad(values) or obstacle(weights) or any(map(why_not_eager, values))):
        return _by_kernel(drawn, periods, weights, height, width, coarse)
    motion: Any = {"frame": drawn.frame, "wind": drawn.wind, "decorrelation": drawn.decorrelation}
    motion["dtype"] = weights.dtype

    def made(periods: Sequence[tuple[int, float]], height: int, width: int, **lattice: int) -> list[Octave]:
        place: Any = {"height": height, "width": width, **lattice}
        return [octave(drawn.key, i, period=period, **place, **motion) for i, period in periods]

    nodes = None
    if coarse is not None:
        rows, columns = coarse.lattice.axes()
        known = made(coarse.periods, len(rows), len(columns), stride=rows.step, start=rows.start)
        nodes = Nodes(perlin_noise(known, coarse.weights), coarse.lattice)
    return perlin_noise(made(periods, height, width), weights, nodes=nodes)


def _by_kernel(
    drawn: Drawn,
    periods: Sequence[tuple[int, float]],
    weights: Tensor,
    height: int,
    width: int,
    coarse: Coarse | None,
) -> Tensor:
    key, taps = drawn.key, _taps(0 if coarse is None else coarse.lattice.stride)
    elapsed = drawn.frame.double() / (math.pi * drawn.decorrelation.double())
    words = key.to(torch.int32).contiguous().numpy().view(np.uint32), tuple(word % 2**32 for word in HASH)
    levels = _levels(drawn, periods, weights, coarse)
    drifts = partial(kernels("fields.kernels.drifts").drifts, *words, _numbers(elapsed), *levels, taps)
    out = weights.new_empty(len(key), 1, height, width)
    into = out[:, 0].numpy()
    share(lambda start, stop: drifts(start, stop, into), len(key) * height, least=SMALLEST // max(1, width) + 1)
    return out


@lru_cache(maxsize=64)
def _taps(stride: int) -> np.ndarray:
    """(4, stride), of cubics between nodes; nobody writes to it."""
    weights = lagrange_weights(stride, 4, dtype=torch.float32, device=torch.device("cpu"))
    return np.ascontiguousarray(weights.numpy().reshape(stride, 4).T)


def _levels(
    drawn: Drawn, periods: Sequence[tuple[int, float]], weights: Tensor, coarse: Coarse | None
) -> Iterator[tuple[np.ndarray, ...]]:
    """Octaves at all pixels, and those at the nodes of a lattice, as `drifts` has them."""
    known = [] if coarse is None else coarse.periods
    stride, start = (1, 0) if coarse is None else (coarse.lattice.stride, coarse.lattice.axes()[0].start)
    numbers, lengths, count = [i for i, _ in (*periods, *known)], [each for _, each in (*periods, *known)], len(periods)
    starts, strides = ([one] * count + [other] * len(known) for one, other in ((0, start), (1, stride)))
    origin = _numbers(origins(drawn.key, numbers, lengths, frame=drawn.frame, wind=drawn.wind, starts=starts))
    first = np.floor(origin)
    steps = np.array(strides, np.float64) / np.array(lengths)
    parts = np.array(numbers, np.uint32), steps, first.astype(np.int64), origin - first
    own = weights if coarse is None else coarse.weights
    for weight, level in ((weights, slice(count)), (own, slice(count, None))):
        rows = (np.ascontiguousarray(part[:, level] if part.ndim > 1 else part[level]) for part in parts)
        yield *rows, _numbers(weight)


def _numbers(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()
