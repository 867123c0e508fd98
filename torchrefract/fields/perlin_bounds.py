"""How far Perlin noise in the plane can be from what is computed of it.

Whatever is linear in the noise, such as its value at a pixel, what cubics between the nodes of a lattice leave of it
and its mean over a frame, is a sum of products g . c over the nodes of Perlin's lattice, of independent unit gradients
g and vectors c that are known. Its variance is sum |c|^2 / 2, and as E exp(x cos a) = I_0(x) <= exp(x^2 / 4) for a
uniform angle a, it is beyond k deviations with a chance of at most 2 exp(-k^2 / 2), whatever the vectors. It is never
beyond sum |c|, sqrt(2 n) deviations for n vectors of one length. Noise is a sum of products of functions of x and y,

    n = sum over nodes of g_x a(x) h(y) + g_y h(x) a(y),  a(p) = h(p) p

so vectors and variances are products of what belongs to one axis. Phases are drawn: the worst of some counts. What
cubics leave is largest by far around a node of Perlin's lattice, where the third derivative jumps: half of the phases
have one among the nodes that the cubics take.
"""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from torchrefract.warping.lattice import lagrange_weights

# Of the noise in the middle of a cell, where it is largest: 4 nodes, h^2 = 1/16, |p|^2 = 1/2.
VARIANCE = 1 / 16
_PHASES = 12
_PLACES = 6  # at most, between two nodes of the lattice


class Error(NamedTuple):
    """What is left of noise of height 1 where it is computed in another way: found - noise."""

    variance: float  # at the worst pixel
    covariance: float  # of error and noise, at the worst pixel, its size
    mean: float  # variance of the error of the mean over the frame
    nodes: float  # so many vectors of one length have this variance and the largest sum |c| of any pixel


class _Products(NamedTuple):
    """Sums along one axis, over the nodes, for each phase."""

    h: np.ndarray  # h h
    a: np.ndarray  # a a

    def of_frame(self, other: "_Products") -> np.ndarray:
        """(x, y): sum |c|^2 / 2 of the products of every phase of this along y with every one of another along x."""
        return (other.a[:, None] * self.h + other.h[:, None] * self.a) / 2


def largest_sum(variances: Sequence[float], nodes: Sequence[float], sigmas: float) -> float:
    """What a sum of independent terms, linear in noises, exceeds with a chance of exp(-sigmas^2 / 2) at most.

        min over y of (sigmas^2 / 2 + sum of n ln I_0(y sqrt(2 variance / n))) / y

    It is at most sigmas deviations, and at most sum sqrt(2 n variance), which no term can exceed.

    Args:
        variances: of the terms.
        nodes: n of each, so that its vectors c have sum |c|^2 / 2 <= variance and sum |c| <= sqrt(2 n variance).

    Source: Chernoff's bound; ln I_0(c) / c is concave, and so below a line that meets it where all vectors are equally
    long: these are the worst that keep both sums.
    """
    scale = np.sqrt(2 * np.array(variances) / np.array(nodes))
    most = float((np.array(nodes) * scale).sum())
    if most == 0:
        return 0.0
    # Beyond 600 the function I_0 has no number.
    y = np.geomspace(1e-3, 1, 200)[:, None] * (600 / scale.max())
    logarithm = (np.array(nodes) * np.log(np.i0(y * scale))).sum(axis=1)
    return min(float(((sigmas**2 / 2 + logarithm) / y[:, 0]).min()), most)


@lru_cache(maxsize=4096)
def error_between(period: float, stride: int, height: int, width: int) -> Error:
    """Of cubics between nodes every `stride` px, for noise of a period in px."""
    own, found = _between(period, stride)
    i, j = np.triu_indices(own.shape[1])  # of x and y: of y and x it is the same
    # Vectors of all nodes of the noise, and what is left of it.
    vector, other = (np.stack([a[i, :, None] * h[j, None], h[i, :, None] * a[j, None]]) for h, a in (own, found))
    left = other - vector
    variance = (left * left).sum(axis=(0, 2, 3)).max() / 2
    covariance = abs((left * vector).sum(axis=(0, 2, 3))).max() / 2
    most = np.sqrt((left * left).sum(axis=0)).sum(axis=(1, 2)).max()
    y, x = (_means(period, size, stride) for size in (height, width))
    mean = (y[0].of_frame(x[0]) + y[1].of_frame(x[1]) - 2 * y[2].of_frame(x[2])).max()
    nodes = most * most / (2 * variance) if variance > 0 else 1.0
    return Error(float(variance), float(covariance), max(float(mean), 0.0), float(nodes))


@lru_cache(maxsize=4096)
def error_without(period: float, height: int, width: int) -> Error:
    """Of no noise at all."""
    return Error(VARIANCE, VARIANCE, mean_variance(period, height, width), 4)


@lru_cache(maxsize=4096)
def mean_variance(period: float, height: int, width: int) -> float:
    """Of the mean of the noise over a frame."""
    y, x = (_means(period, size, 1)[0] for size in (height, width))
    return float(y.of_frame(x).max())


def _between(period: float, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """(2, phases and places, nodes), h and a of noise, and of cubics between nodes."""
    places = np.unique(np.linspace(0, stride - 1, min(stride, _PLACES)).round().astype(int))
    cubic = lagrange_weights(stride, 4, dtype=torch.float64, device=torch.device("cpu")).numpy()[places]
    # Four nodes around the pixel and the pixel itself, in periods from a node of Perlin's lattice.
    around = np.broadcast_to(stride * np.arange(-1.0, 3.0), (len(places), 4))
    at = (np.concatenate([around, places[:, None]], axis=1) + stride) / period
    at = at + _phases(3 * stride / period)[:, None, None]
    node = np.arange(math.ceil(3 * stride / period) + 2)
    values = np.stack(_hat(at[..., None] - node))
    own, between = values[:, :, :, 4], np.einsum("tj,kptjn->kptn", cubic, values[:, :, :, :4])
    return own.reshape(2, -1, len(node)), between.reshape(2, -1, len(node))


def _phases(reach: float) -> np.ndarray:
    """Some of all, and as many that have a node of Perlin's lattice in reach, cells."""
    each = np.arange(_PHASES) / _PHASES
    return np.concatenate([each, 1 - min(reach, 1.0) * each])


def _means(period: float, size: int, stride: int) -> tuple[_Products, _Products, _Products]:
    """As `_between`, of means over an axis of a frame."""
    pixels = np.arange(size)
    cells = -(-size // stride)
    cubic = lagrange_weights(stride, 4, dtype=torch.float64, device=torch.device("cpu")).numpy()
    weight = np.zeros(cells + 3)
    np.add.at(weight, pixels[:, None] // stride + np.arange(4), cubic[pixels % stride])
    nodes = (np.arange(cells + 3) - 1) * stride
    phases = _phases(size / period)
    reach = math.ceil(nodes[-1] / period)
    own = _mean(pixels, np.ones(size), period, phases, reach) / size
    between = own if stride == 1 else _mean(nodes, weight, period, phases, reach) / size
    return _products(own, own), _products(between, between), _products(own, between)


def _mean(at: np.ndarray, weight: np.ndarray, period: float, phases: np.ndarray, reach: int) -> np.ndarray:
    """(2, phases, nodes), of h and a, the weighted sum over places in px, up to `reach` periods to either side."""
    found = []
    for phase in phases:
        place = at / period + phase + reach  # none below 0
        node = np.floor(place).astype(int)
        (h0, a0), (h1, a1) = _hat(place - node), _hat(place - node - 1)
        count = 2 * reach + 3
        sums = [
            np.bincount(node, weight * first, count) + np.bincount(node + 1, weight * second, count)
            for first, second in ((h0, h1), (a0, a1))
        ]
        found.append(np.stack(sums))
    return np.stack(found, axis=1)


def _products(one: Iterable[np.ndarray], other: Iterable[np.ndarray]) -> _Products:
    return _Products(*((p * q).sum(axis=-1).ravel() for p, q in zip(one, other, strict=True)))


def _hat(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """h and a."""
    s = np.minimum(np.abs(p), 1)
    h = 1 - s**3 * (s * (6 * s - 15) + 10)
    return h, h * p
