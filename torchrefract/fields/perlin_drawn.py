"""Perlin's noise in the plane as frames of clips have it: drawn and summed by a kernel where one can, or in PyTorch."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._checks import learns, withheld
from torchrefract._compiled import SMALLEST, kernels, obstacle
from torchrefract._threads import share
from torchrefract.fields.perlin import Nodes, perlin_noise
from torchrefract.fields.perlin_lattice import octave, origins
from torchrefract.warping.lattice import along_rows, lagrange_weights
from torchrefract.white_noise import HASH


class Drawn(NamedTuple):
    """What the lattices of N frames are drawn from, as for `octave`."""

    key: Tensor  # (N, 4), int64
    frame: Tensor  # (N,)
    wind: Tensor  # (N, 2), px per frame
    decorrelation: Tensor  # (N,), frames


class Pixels(NamedTuple):
    """Rows and columns, every `stride` px from `start` on along each axis."""

    height: int
    width: int
    stride: int = 1
    start: int = 0


def drawn_noise(
    drawn: Drawn, periods: Sequence[tuple[int, float]], weights: Tensor, *, pixels: Pixels, nodes: Nodes | None = None
) -> Tensor:
    """(N, 1, H, W), what `perlin_noise` makes of octaves, each with its index and its period in px, at pixels.

    By a kernel it is as near to that of real numbers, and not the same in its last digits.

    Args:
        drawn, periods, pixels: of the octaves, as for `octave`.
        weights: (N, octaves), of the type of the noise.
        nodes: what else is added, as for `perlin_noise`.
    """
    learning = (*drawn, weights) if nodes is None else (*drawn, weights, nodes.value)
    learning = learns((*drawn, weights) if nodes is None else (*drawn, weights, nodes.value))
    if not (learning or obstacle(weights) or any(map(withheld, drawn))):
        return _by_kernel(drawn, periods, weights, pixels, nodes)
    motion: Any = {"frame": drawn.frame, "wind": drawn.wind, "decorrelation": drawn.decorrelation}
    motion |= pixels._asdict()
    octaves = [octave(drawn.key, i, period=period, **motion, dtype=weights.dtype) for i, period in periods]
    return perlin_noise(octaves, weights, nodes=nodes)


def _by_kernel(
    drawn: Drawn, periods: Sequence[tuple[int, float]], weights: Tensor, pixels: Pixels, nodes: Nodes | None
) -> Tensor:
    key, height, width = drawn.key, pixels.height, pixels.width
    elapsed = drawn.frame.double() / (math.pi * drawn.decorrelation.double())
    words = key.to(torch.int32).contiguous().numpy().view(np.uint32), tuple(word % 2**32 for word in HASH)
    values = weights, *_lines(weights, nodes)
    work = partial(
        kernels("fields.kernels.drifts").drifts,
        *words,
        elapsed.detach().contiguous().numpy(),
        _octaves(drawn, periods, pixels),
        *(value.detach().contiguous().numpy() for value in values),
    )
    out = weights.new_empty(len(key), 1, height, width)
    into = out[:, 0].numpy()
    share(lambda start, stop: work(start, stop, into), len(key) * height, least=SMALLEST // max(1, width) + 1)
    return out


def _octaves(drawn: Drawn, periods: Sequence[tuple[int, float]], pixels: Pixels) -> tuple[np.ndarray, ...]:
    """As `drifts` has them."""
    numbers, lengths = [i for i, _ in periods], [period for _, period in periods]
    steps = np.array([pixels.stride / period for period in lengths])
    origin = origins(drawn.key, numbers, lengths, frame=drawn.frame, wind=drawn.wind, start=pixels.start).detach()
    first = origin.floor()
    return np.array(numbers, np.uint32), steps, first.long().numpy(), (origin - first).numpy()


def _lines(like: Tensor, nodes: Nodes | None) -> tuple[Tensor, Tensor]:
    """Lines through all rows of nodes, (N, n, W), and the weights between these; none."""
    if nodes is None:
        return like.new_empty(0, 0, 0), like.new_empty(0, 0)
    stride = nodes.lattice.stride
    taps = lagrange_weights(stride, 4, dtype=like.dtype, device=like.device)
    return along_rows(nodes.value, nodes.lattice)[:, 0], taps
