"""White noise by the million: numbers that are a hash of where they stand, under the key of a sample."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels
from torchrefract._tensor import cat_bands
from torchrefract._threads import share
from torchrefract._validation import why_not_eager

_WORD = 0xFFFFFFFF
# Odd constants of the hash, as int32: 2^32 over the golden ratio, and the two of lowbias32.
HASH = (0x9E3779B1 - 2**32, 0x7FEB352D, 0x846CA68B - 2**32)
_CONSTANTS = tuple(word % 2**32 for word in HASH)
_FEW = 1 << 11  # below so many a kernel's call costs more than it brings
_CACHED = 1 << 17  # numbers that stay in a core's cache


def noise(key: Tensor, count: int) -> Tensor:
    """(B, 2, count), float32, white noise, standard normal, up to 5.8 in magnitude.

    For millions of numbers: the i-th pair of a sample is a hash of i under its key, two rounds of multiply and
    xor-shift on 32 bits, and Box and Muller's transform of it.

    Args:
        key: (B, 4), int64, of `noise_key`.
        count: pairs to a sample.

    Source: Wellons, "Prospecting for hash functions" (2018), for the constants; Box and Muller 1958.
    """
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.noise(key, count)
    return _noise(key, count)


def noise_at(key: Tensor, places: Tensor) -> Tensor:
    """(B, 2, n), float32: the pairs of `noise` at (n,) places, int64, counted from 0."""
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.noise_at(key, places)
    return _noise_at(key, places)


def lattice(key: Tensor, axes: Sequence[Tensor], count: int) -> Tensor:
    """(B, count, n1, ..., nd), float32, uniform in (0, 1): `count` numbers for each node of a lattice.

    A node's numbers are a hash of its whole coordinates, so that a window of an endless lattice is any part of it.

    Args:
        key: (B, 4), int64, of `noise_key`.
        axes: d of them, (B, ni), int64, the coordinates along each axis; their lowest 32 bits count.
        count: numbers to a node.

    Source: as for `noise`.
    """
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.lattice(key, list(axes), count)
    return _lattice(key, axes, count)


def _lattice(key: Tensor, axes: Sequence[Tensor], count: int) -> Tensor:
    each = torch.arange(count, device=key.device).expand(len(key), -1)
    a, b, c, d = key.to(torch.int32).view(-1, 4, *[1] * (len(axes) + 1)).unbind(1)
    node = torch.zeros_like(a)
    for i, axis in enumerate((*axes, each), start=2):
        shape = [1] * (len(axes) + 2)
        shape[0], shape[i if i < len(shape) else 1] = len(key), axis.shape[1]
        # Each axis in a round of its own, under both halves of the key in turn.
        node = _hash(node + axis.to(torch.int32).view(shape) * HASH[0], *((a, b) if i % 2 else (c, d)))
    return ((node >> 9) & 0x7FFFFF).float().add_(0.5).mul_(2.0**-23)


def _lattice_list(key: Tensor, axes: list[Tensor], count: int) -> Tensor:
    return _lattice(key, axes, count)


def _noise(key: Tensor, count: int) -> Tensor:
    words = key.to(torch.int32)
    at_once = max(1, _CACHED // max(1, len(key)) if key.device.type == "cpu" else count)
    bands = (_noise_between(words, start, min(start + at_once, count)) for start in range(0, max(1, count), at_once))
    return cat_bands(bands, dim=2, length=count)


def _noise_between(words: Tensor, start: int, end: int) -> Tensor:
    return _pairs(words, torch.arange(start, end, dtype=torch.int32, device=words.device))


def _noise_at(key: Tensor, places: Tensor) -> Tensor:
    return _pairs(key.to(torch.int32), places.to(torch.int32))


def _pairs(words: Tensor, places: Tensor) -> Tensor:
    uniform, angle = _hashed(words, places)
    radius = uniform.log_().mul_(-2).sqrt_()
    return torch.stack([angle.cos().mul_(radius), angle.sin_().mul_(radius)], dim=1)


def _hashed(words: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """(B, n), uniform in (0, 1), and (B, n), angles, of keys of four words, (B, 4), at places, (n,), all int32."""
    if len(places) < _FEW or why_not_eager(places) or why_not_eager(words) or kernels("_jit") is None:
        (a, b, c, d), index = words[:, :, None].unbind(1), places * HASH[0]
        uniform = (_hash(index, a, b) >> 9).bitwise_and_(0x7FFFFF).float().add_(0.5).mul_(2.0**-23)
        return uniform, _hash(index, c, d).float().mul_(math.pi * 2.0**-31)
    uniform, angle = (torch.empty(len(words), len(places)) for _ in range(2))
    keys, numbers = (own.contiguous().numpy().view(np.uint32) for own in (words, places))
    work = partial(kernels("noise_kernel").hashed, keys, numbers, _CONSTANTS)
    share(lambda start, stop: work(start, stop, uniform.numpy(), angle.numpy()), len(places), least=SMALLEST)
    return uniform, angle


def _hash(index: Tensor, a: Tensor, b: Tensor) -> Tensor:
    x = index + a
    x ^= (x >> 16).bitwise_and_(0xFFFF)
    x = x.mul_(HASH[1]).add_(b)
    x ^= (x >> 15).bitwise_and_(0x1FFFF)
    x.mul_(HASH[2])
    x ^= (x >> 16).bitwise_and_(0xFFFF)
    return x


_noise_op = torch.library.custom_op("torchrefract::noise", _noise, mutates_args=())


@_noise_op.register_fake
def _(key: Tensor, count: int) -> Tensor:
    return key.new_empty((key.shape[0], 2, count), dtype=torch.float32)


_noise_at_op = torch.library.custom_op("torchrefract::noise_at", _noise_at, mutates_args=())


@_noise_at_op.register_fake
def _(key: Tensor, places: Tensor) -> Tensor:
    return key.new_empty((key.shape[0], 2, places.shape[0]), dtype=torch.float32)


_lattice_op = torch.library.custom_op("torchrefract::lattice", _lattice_list, mutates_args=())


@_lattice_op.register_fake
def _(key: Tensor, axes: list[Tensor], count: int) -> Tensor:
    return key.new_empty((key.shape[0], count, *(axis.shape[1] for axis in axes)), dtype=torch.float32)
