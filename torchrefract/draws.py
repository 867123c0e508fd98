"""Keyed random numbers: what a sample draws depends on (seed, key, place) and on nothing else.

The generator is Threefry-2x32 with 20 rounds, written in integer tensor operations that never overflow. So the same
words come out for every batch size, order, worker, thread count and device, inside torch.compile too.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from torchrefract.types import Range

_WORD = 0xFFFFFFFF
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
LARGEST_NORMAL = 5.8  # in magnitude
_FEW = 8  # up to so many, Python computes faster than numpy


class Stream:
    """Where the random numbers of each sample come from: two words of 32 bits a sample.

    Args:
        words: (B, 2), as whole numbers, or as two tensors (B,), int64; numbers are computed where these are.
        lane: numbers of different lanes are independent.
        device: that numbers are brought to; None is that of the words.
    """

    def __init__(
        self,
        words: Sequence[tuple[int, int]] | tuple[Tensor, Tensor],
        lane: int = 0,
        device: torch.device | None = None,
    ):
        self._words = words
        self.lane = lane
        self.device = device

    @property
    def few(self) -> Sequence[tuple[int, int]] | None:
        """The words as whole numbers, where that is what they are."""
        return None if self._tensors else cast(Sequence[tuple[int, int]], self._words)

    @property
    def high(self) -> Tensor:
        """(B,), int64."""
        return self._word(0)

    @property
    def low(self) -> Tensor:
        """(B,), int64."""
        return self._word(1)

    def at(self, lane: int) -> "Stream":
        """The same samples, in another lane."""
        return Stream(self._words, lane, self.device)

    def to(self, device: torch.device | None) -> "Stream":
        """The same numbers, brought to a device."""
        return Stream(self._words, self.lane, device)

    @property
    def _tensors(self) -> bool:
        return len(self._words) > 0 and isinstance(self._words[0], Tensor)

    def _word(self, which: int) -> Tensor:
        if self._tensors:
            return cast(tuple[Tensor, Tensor], self._words)[which]
        return torch.tensor([pair[which] for pair in cast(Sequence[tuple[int, int]], self._words)], dtype=torch.int64)


def stream(seed: int | Tensor, keys: Tensor | range, *, device: torch.device | None = None) -> Stream:
    """The stream of each sample, computed on the CPU unless the seed or the keys are elsewhere.

    An accelerator would start hundreds of operations on a few numbers, each of which takes longer than all of them do
    on the CPU.

    Args:
        seed: a whole number or a tensor of one, int64; of larger numbers the lowest 64 bits count.
        keys: (B,), int64, or a range of so many whole numbers.
        device: that numbers are brought to; None is that of the seed or the keys.
    """
    if not isinstance(seed, Tensor):
        # Two's complement, so that every Python integer has its 64 bits.
        seed = (seed + 2**63) % 2**64 - 2**63
    if (few := _few(seed, keys)) is not None:
        start, numbers = few
        return Stream([_rounds(*_words(start), *_words(number)) for number in numbers], device=device)
    if isinstance(keys, range):
        keys = torch.arange(keys.start, keys.stop)
    if isinstance(seed, Tensor) and seed.device.type != "cpu":
        keys = keys.to(seed.device, non_blocking=True)
    start = seed.long() if isinstance(seed, Tensor) else torch.full((), seed, dtype=torch.int64, device=keys.device)
    return Stream(threefry(_words(start), _words(keys.long())), device=device)


def fold(parent: Stream) -> Stream:
    """Streams of their own for what is nested in a lane."""
    if parent.few is not None:
        return Stream([_rounds(high, low, _WORD, parent.lane) for high, low in parent.few], device=parent.device)
    zero = torch.zeros_like(parent.low)
    return Stream(threefry((parent.high, parent.low), (zero + _WORD, zero + parent.lane)), device=parent.device)


def uniform(source: Stream, count: int) -> Tensor:
    """(B, count), float32, uniform in the open interval (0, 1), on a lattice of 2^23 values."""
    return _brought(_uniform(source, count), source)


def between(source: Stream, ranges: Sequence[Range], *, dtype: torch.dtype) -> Tensor:
    """(B, n), low + (high - low) u of each range, u as by `uniform`.

    Args:
        source: of the numbers.
        ranges: n of them.
        dtype: float32 or float64.
    """
    if (few := source.few) is not None and _blocks(len(ranges)) * len(few) <= _FEW:
        # A handful of numbers: numpy's operations start several times as fast, and round alike.
        kind = np.float64 if dtype is torch.float64 else np.float32
        low, high = np.array(ranges, dtype=kind).T
        values = torch.from_numpy(low + (high - low) * _uniform_few(few, len(ranges), source.lane).astype(kind))
        return _brought(values, source)
    low, high = torch.tensor(ranges, dtype=dtype, device=source.low.device).unbind(1)
    return _brought(low + (high - low) * _uniform(source, len(ranges)).to(dtype), source)


def normal(source: Stream, count: int) -> Tensor:
    """(B, count), float32, standard normal (Box and Muller 1958), below `LARGEST_NORMAL` in magnitude."""
    radius, angle = _uniform(source, 2 * _blocks(count)).chunk(2, dim=1)
    radius, angle = (-2 * radius.log()).sqrt(), 2 * math.pi * angle
    return _brought(torch.cat([radius * angle.cos(), radius * angle.sin()], dim=1)[:, :count], source)


def noise_key(source: Stream) -> Tensor:
    """(B, 4), int64, in [0, 2^32): what the white noise of each sample comes from."""
    child = fold(source)
    if child.few is not None:
        key = torch.tensor([(*words, *_rounds(*words, 0, 0)) for words in child.few], dtype=torch.int64)
    else:
        zero = torch.zeros_like(child.low)
        key = torch.stack([child.high, child.low, *threefry((child.high, child.low), (zero, zero))], dim=1)
    return _brought(key, source)


def call_seed() -> Tensor:
    """(), int64: a fresh seed from torch's global generator, in eager mode and under torch.compile alike."""
    # Calling the operator loads what compilers need, a second of work that eager mode does without.
    return torch.ops.torchrefract.call_seed.default() if torch.compiler.is_compiling() else _new_seed()


def threefry(key: tuple[Tensor, Tensor], counter: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Two words for each counter under each key, all of them int64 tensors in [0, 2^32) that broadcast."""
    # For a compiler this is one operator: its hundreds of steps would take it a minute.
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.threefry(*key, *counter)
    try:
        arrays = [value.numpy() for value in (*key, *counter)]
    except (TypeError, RuntimeError):  # on an accelerator, or inside torch.vmap
        return _rounds(*key, *counter)
    # Hundreds of operations on not so many numbers: those of numpy start several times as fast.
    x, y = _rounds(*arrays)
    return torch.from_numpy(np.asarray(x)), torch.from_numpy(np.asarray(y))


def _threefry(key0: Tensor, key1: Tensor, counter0: Tensor, counter1: Tensor) -> tuple[Tensor, Tensor]:
    return _rounds(key0, key1, counter0, counter1)


def _rounds(key0: Any, key1: Any, counter0: Any, counter1: Any) -> tuple[Any, Any]:
    """The generator, on tensors, arrays or whole numbers alike."""
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


def _few(seed: int | Tensor, keys: Tensor | range) -> tuple[int, Sequence[int]] | None:
    """Seed and keys as whole numbers where so few draws are faster in Python than to start on tensors."""
    on_cpu = all(not isinstance(value, Tensor) or value.device.type == "cpu" for value in (seed, keys))
    if not 0 < len(keys) <= _FEW or torch.compiler.is_compiling() or not on_cpu:
        return None
    try:
        start = int(seed) if isinstance(seed, Tensor) else seed
        return start, keys if isinstance(keys, range) else [int(key) for key in keys.tolist()]
    except RuntimeError:  # inside torch.vmap no sample has values of its own
        return None


def _blocks(count: int) -> int:
    """Each gives two numbers."""
    return (count + 1) // 2


def _uniform(source: Stream, count: int) -> Tensor:
    """`uniform`, where the words are."""
    if (few := source.few) is not None and _blocks(count) * len(few) <= _FEW:
        return torch.from_numpy(_uniform_few(few, count, source.lane))
    counter = torch.arange(_blocks(count), dtype=torch.int64, device=source.low.device)
    lane = torch.full_like(counter, source.lane)
    words = threefry((source.high[:, None], source.low[:, None]), (counter, lane))
    return (torch.cat(words, dim=1)[:, :count] >> 9).float().add(0.5).mul(2.0**-23)


def _brought(value: Tensor, source: Stream) -> Tensor:
    """The value on the device of a stream; a copy from the CPU waits for nothing."""
    if source.device is None or source.device == value.device:
        return value
    return value.to(source.device, non_blocking=value.device.type == "cpu")


def _uniform_few(words: Sequence[tuple[int, int]], count: int, lane: int) -> np.ndarray:
    rows = []
    for high, low in words:
        blocks = (_rounds(high, low, i, lane) for i in range(_blocks(count)))
        first, second = zip(*blocks, strict=True)
        rows.append([((word >> 9) + 0.5) * 2.0**-23 for word in (*first, *second)[:count]])
    return np.array(rows, dtype=np.float32)


def _new_seed() -> Tensor:
    return torch.randint(-(2**63), 2**63 - 1, (), dtype=torch.int64)


def _words(value: Any) -> tuple[Any, Any]:
    return (value >> 32) & _WORD, value & _WORD


@torch.library.custom_op("torchrefract::call_seed", mutates_args=(), tags=(torch.Tag.nondeterministic_seeded,))
def _call_seed() -> Tensor:
    # An operator of its own: the compiler neither folds it to a constant nor swaps in its own random numbers.
    return _new_seed()


@_call_seed.register_fake
def _() -> Tensor:
    return torch.empty((), dtype=torch.int64)


_threefry_op = torch.library.custom_op("torchrefract::threefry", _threefry, mutates_args=())


@_threefry_op.register_fake
def _(key0: Tensor, key1: Tensor, counter0: Tensor, counter1: Tensor) -> tuple[Tensor, Tensor]:
    shape = torch.broadcast_shapes(key0.shape, key1.shape, counter0.shape, counter1.shape)
    return counter0.new_empty(shape), counter0.new_empty(shape)
