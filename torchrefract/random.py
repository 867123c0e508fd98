"""Counter-based random numbers: a draw depends on (seed, key, lane) and on nothing else.

The numbers are the same for every batch size, order, worker, thread count and device, under torch.compile too.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011, for Threefry-2x32 with 20
rounds; Wellons, "Prospecting for hash functions" (2018), for the hash of the white noise; Box and Muller (1958).
"""

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor, in_bands, rows_at_once
from torchrefract._validation import why_not_eager
from torchrefract.types import Range

LARGEST_NORMAL = 5.8  # bound of the magnitude of normal numbers
_WORD = 0xFFFFFFFF
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
# Odd constants of the hash, as int32: 2^32 over the golden ratio, and the two of lowbias32.
_HASH = (0x9E3779B1 - 2**32, 0x7FEB352D, 0x846CA68B - 2**32)
_BAND = 1 << 17  # numbers whose intermediate results stay in a processor's cache


class Stream(NamedTuple):
    """Source of the random numbers of each sample: a key of two 32-bit words, and a lane.

    words: (2, B), int64, in [0, 2^32).
    lane: numbers of different lanes are independent.
    device: device of the drawn numbers; None is that of the words.
    substitute: returns the uniform numbers (B, n) to use instead of those that were drawn, for a search over draws.
    """

    words: Tensor
    lane: int = 0
    device: torch.device | None = None
    substitute: Callable[["Stream", Tensor], Tensor] | None = None

    def at(self, lane: int) -> "Stream":
        """Return the streams of the same samples in another lane."""
        return self._replace(lane=lane)

    def to(self, device: torch.device | None) -> "Stream":
        """Return the same streams, whose numbers are moved to a device."""
        return self._replace(device=device)


def key_of(name: str | PurePath) -> int:
    """Hash the name of a sample to its key, the same on every machine and in any listing.

    Two names share a key with a probability of 2^-63. A name that is not valid Unicode is hashed by its bytes.

    Args:
        name: mostly the path of a file relative to its data set; a string has forward slashes, as "drive/0001.jpg".

    Returns:
        An integer in [0, 2^63): the highest 63 bits of the BLAKE2b digest of 8 bytes.

    Raises:
        TypeError: a name that is neither a text nor a path, as the number of a sample, which is a key already.

    Source: Saarinen and Aumasson, "The BLAKE2 cryptographic hash and message authentication code", RFC 7693 (2015).
    """
    if not isinstance(name, str | bytes | os.PathLike):
        raise TypeError(f"name must be a text or a path, got {type(name).__name__}; an integer is a key already")
    text = name.as_posix() if isinstance(name, PurePath) else name
    return int.from_bytes(hashlib.blake2b(os.fsencode(text), digest_size=8).digest(), "big") >> 1


def stream(seed: int | Tensor, keys: Tensor | range, *, device: torch.device | None = None) -> Stream:
    """Create the stream of each sample.

    The numbers are computed on the CPU unless the seed or the keys are on another device: an accelerator would start
    more than a hundred small operations for each draw, which takes longer than a copy.

    Args:
        seed: integer or a tensor of one, int64; the lowest 64 bits of a larger integer count.
        keys: (B,), int64, or a range of B integers.
        device: device of the drawn numbers; None is that of the seed or the keys.
    """
    if not isinstance(seed, Tensor):
        seed = (seed + 2**63) % 2**64 - 2**63  # two's complement, so that every Python integer has its 64 bits
        seed = torch.full((), seed, dtype=torch.int64, device="cpu" if isinstance(keys, range) else keys.device)
    if torch.compiler.is_compiling() and device is not None and device.type == "cuda":
        # A graph with operations on the CPU waits for them and cannot be recorded as one CUDA graph.
        seed = seed.to(device, non_blocking=True)
    if isinstance(keys, range):
        keys = torch.arange(keys.start, keys.stop, device=seed.device)
    elif seed.device.type != "cpu":
        keys = keys.to(seed.device, non_blocking=True)
    else:
        seed = seed.to(keys.device, non_blocking=True)
    return Stream(_threefry(_halves(seed.long()[None]), _halves(keys.long()))[:, 0], device=device)


def fold(parent: Stream) -> Stream:
    """Return streams for nested draws, independent of those of the parent in any lane."""
    return parent._replace(words=_block(parent, _WORD)[:, :, 0], lane=0)


def uniform(source: Stream, count: int) -> Tensor:
    """Draw (B, count) numbers, float32, uniform in the open interval (0, 1), on a lattice of 2^23 values."""
    return _drawn(_uniform(source, count), source)


def uniform_in_ranges(source: Stream, ranges: Sequence[Range], *, dtype: torch.dtype) -> Tensor:
    """Draw (B, n) numbers low + (high - low) u, one for each range, with u from `uniform`.

    Args:
        source: stream to draw from.
        ranges: n of them.
        dtype: float32 or float64.
    """
    u = _uniform(source, len(ranges)).to(dtype)
    low, high = as_device_tensor(ranges, dtype=dtype, device=u.device).view(-1, 2).unbind(1)
    return _drawn(low + (high - low) * u, source)


def normal(source: Stream, count: int) -> Tensor:
    """Draw (B, count) standard normal numbers, float32, below `LARGEST_NORMAL` in magnitude.

    sqrt(-2 ln u1) cos(2 pi u2) for all pairs, then sqrt(-2 ln u1) sin(2 pi u2)
    """
    radius, angle = _uniform(source, count + count % 2).chunk(2, dim=1)
    radius, angle = (-2 * radius.log()).sqrt(), 2 * math.pi * angle
    return _drawn(torch.cat([radius * angle.cos(), radius * angle.sin()], dim=1)[:, :count].contiguous(), source)


def noise_key(source: Stream) -> Tensor:
    """Draw (B, 4), int64, in [0, 2^32): the key of each sample's white noise."""
    child = fold(source)
    return _drawn(torch.cat([child.words, _block(child, 0)[:, :, 0]]).T.contiguous(), source)


def white_noise(key: Tensor, count: int, *, start: int = 0) -> Tensor:
    """Compute (B, 2, count) standard normal numbers, float32, below `LARGEST_NORMAL` in magnitude.

    Made for millions of numbers: pair i of a sample is the Box-Muller transform of a hash of i under the sample's key,
    two rounds of multiply and xor-shift on 32 bits.

    Args:
        key: (B, 4), int64, from `noise_key`.
        count: number of pairs of a sample.
        start: number of the first pair.
    """
    band = rows_at_once(key.device, count, each=len(key), cached=_BAND)

    def pairs(first: int, last: int) -> Tensor:
        return white_noise_at(key, torch.arange(start + first, start + last, device=key.device))

    return in_bands(pairs, length=count, band=band, dim=2)


def white_noise_at(key: Tensor, indices: Tensor) -> Tensor:
    """Compute the pairs (B, 2, n) of `white_noise` at (n,) indices, int64, counted from 0."""
    a, b, c, d = key.to(torch.int32)[:, :, None].unbind(1)
    index = indices.to(torch.int32) * _HASH[0]
    radius = _to_uniform(_hash(index, a, b)).log_().mul_(-2).sqrt_()
    angle = _hash(index, c, d).float().mul_(math.pi * 2.0**-31)
    return torch.stack([angle.cos().mul_(radius), angle.sin_().mul_(radius)], dim=1)


def lattice_noise(key: Tensor, axes: Sequence[Tensor], count: int) -> Tensor:
    """Compute (B, count, n1, ..., nd) numbers, float32, uniform in (0, 1): `count` for each node of a lattice.

    The numbers of a node are a hash of its integer coordinates, so any window of an endless lattice can be computed.

    Args:
        key: (B, 4), int64, from `noise_key`.
        axes: d of them, (B, ni), int64, coordinates along each axis; their lowest 32 bits count.
        count: numbers of a node.
    """
    index = torch.arange(count, device=key.device).expand(len(key), -1)
    a, b, c, d = key.to(torch.int32).view(-1, 4, *[1] * (len(axes) + 1)).unbind(1)
    node = torch.zeros_like(a)
    for i, axis in enumerate((*axes, index), start=2):
        shape = [1] * (len(axes) + 2)
        shape[0], shape[i if i < len(shape) else 1] = len(key), axis.shape[1]
        # Each axis has one round of the hash, under the two halves of the key in turn.
        node = _hash(node + axis.to(torch.int32).view(shape) * _HASH[0], *((a, b) if i % 2 else (c, d)))
    return _to_uniform(node)


def call_seed() -> Tensor:
    """Draw a seed, (), int64, from torch's global generator, in eager mode and under torch.compile alike."""
    # Calling the operator in eager mode would import the compiler, which takes a second.
    return torch.ops.torchrefract.call_seed.default() if torch.compiler.is_compiling() else _new_seed()


def _threefry(keys: Tensor, counters: Tensor) -> Tensor:
    """Compute the two words (2, B, n) of n counters (2, n) under each of B keys (2, B), all int64 in [0, 2^32)."""
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.threefry(keys, counters)
    if why_not_eager(counters) is None:
        # NumPy starts each of the hundred operations several times as fast as PyTorch.
        return torch.from_numpy(np.stack(_rounds(*keys.numpy()[:, :, None], *counters.numpy())))
    return torch.stack(_rounds(*keys[:, :, None], *counters))


@torch.library.custom_op("torchrefract::threefry", mutates_args=())
def _threefry_operator(keys: Tensor, counters: Tensor) -> Tensor:
    # A custom operator, since the compiler takes a minute for the hundreds of operations of a few draws.
    return torch.stack(_rounds(*keys[:, :, None], *counters))


@_threefry_operator.register_fake
def _(keys: Tensor, counters: Tensor) -> Tensor:
    return keys.new_empty(2, keys.shape[1], counters.shape[1])


def _rounds(key0: Any, key1: Any, counter0: Any, counter1: Any) -> tuple[Any, Any]:
    """Compute Threefry-2x32 with 20 rounds, on integers, arrays or tensors of 64 bits, which never overflow."""
    keys = (key0, key1, key0 ^ key1 ^ _PARITY)
    x, y = counter0 + key0, counter1 + key1
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            # Only what is shifted right must be free of carries; they never reach bit 63.
            y = y & _WORD
            x = x + y
            y = (y << rotation | y >> (32 - rotation)) ^ x
        x = (x + keys[(group + 1) % 3]) & _WORD
        y = y + keys[(group + 2) % 3] + group + 1
    return x, y & _WORD


def _halves(values: Tensor) -> Tensor:
    """Split (B,) integers of 64 bits into words (2, B), the high ones first."""
    return torch.stack([(values >> 32) & _WORD, values & _WORD])


def _block(source: Stream, first: int, count: int = 1) -> Tensor:
    """Compute the words (2, B, count) of consecutive counters in the lane of a stream."""
    index = torch.arange(first, first + count, device=source.words.device)
    return _threefry(source.words, torch.stack([index, torch.full_like(index, source.lane)]))


def _uniform(source: Stream, count: int) -> Tensor:
    """Compute `uniform` numbers from the first words of all counters, and then their second words."""
    if source.substitute is not None:
        return source.substitute(source, _uniform(source._replace(substitute=None), count))
    words = torch.cat(_block(source, 0, (count + 1) // 2).unbind(), dim=1)[:, :count]
    return (words >> 9).float().add(0.5).mul(2.0**-23)  # exact, since the numbers have 24 bits


def _drawn(values: Tensor, source: Stream) -> Tensor:
    """Return the values on the device of a stream; a copy from the CPU waits for nothing."""
    if source.device is None or source.device == values.device:
        return values
    return values.to(source.device, non_blocking=values.device.type == "cpu")


def _hash(index: Tensor, a: Tensor, b: Tensor) -> Tensor:
    x = index + a
    x ^= (x >> 16).bitwise_and_(0xFFFF)
    x = x.mul_(_HASH[1]).add_(b)
    x ^= (x >> 15).bitwise_and_(0x1FFFF)
    x.mul_(_HASH[2])
    x ^= (x >> 16).bitwise_and_(0xFFFF)
    return x


def _to_uniform(word: Tensor) -> Tensor:
    return ((word >> 9) & 0x7FFFFF).float().add_(0.5).mul_(2.0**-23)


def _new_seed() -> Tensor:
    return torch.randint(-(2**63), 2**63 - 1, (), dtype=torch.int64, device="cpu")


@torch.library.custom_op("torchrefract::call_seed", mutates_args=(), tags=(torch.Tag.nondeterministic_seeded,))
def _call_seed() -> Tensor:
    # A custom operator, since the compiler would replace torch.randint by its own random numbers.
    return _new_seed()


@_call_seed.register_fake
def _() -> Tensor:
    return torch.empty((), dtype=torch.int64, device="cpu")
