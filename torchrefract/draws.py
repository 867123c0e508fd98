"""Keyed random numbers: what a sample draws depends on (seed, key, place) and on nothing else.

So they are the same for every batch size, order, worker, thread count and device, inside torch.compile too.
"""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from torchrefract.threefry import WORD, rounds, threefry
from torchrefract.types import Range

LARGEST_NORMAL = 5.8  # in magnitude
_FEW = 32  # up to so many, Python computes faster than numpy
_F = TypeVar("_F", bound=Callable[..., Any])
_Words = tuple[Tensor, Tensor]


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
        return Stream([rounds(*_halves(start), *_halves(number)) for number in numbers], device=device)
    if not isinstance(seed, Tensor):
        seed = torch.full((), seed, dtype=torch.int64, device=None if isinstance(keys, range) else keys.device)
    if isinstance(keys, range):
        return Stream(_of_range(seed, keys.start, keys.stop), device=device)
    if seed.device.type != "cpu":
        keys = keys.to(seed.device, non_blocking=True)
    return Stream(_of_keys(seed.long(), keys.long()), device=device)


def fold(parent: Stream) -> Stream:
    """Streams of their own for what is nested in a lane."""
    if parent.few is not None:
        return Stream([rounds(high, low, WORD, parent.lane) for high, low in parent.few], device=parent.device)
    return Stream(_folded(parent.high, parent.low, parent.lane), device=parent.device)


def uniform(source: Stream, count: int) -> Tensor:
    """(B, count), float32, uniform in the open interval (0, 1), on a lattice of 2^23 values."""
    if _is_few(source, count):
        return _brought(torch.from_numpy(_uniform_few(source, count)), source)
    return _brought(_uniform(source.high, source.low, source.lane, count), source)


def between(source: Stream, ranges: Sequence[Range], *, dtype: torch.dtype) -> Tensor:
    """(B, n), low + (high - low) u of each range, u as by `uniform`.

    Args:
        source: of the numbers.
        ranges: n of them.
        dtype: float32 or float64.
    """
    if _is_few(source, len(ranges)):
        # A handful of numbers: numpy's operations start several times as fast, and round alike.
        kind = np.float64 if dtype is torch.float64 else np.float32
        low, high = np.array(ranges, dtype=kind).T
        values = torch.from_numpy(low + (high - low) * _uniform_few(source, len(ranges)).astype(kind))
        return _brought(values, source)
    ends = [float(end) for span in ranges for end in span]
    return _brought(_between(source.high, source.low, source.lane, ends, dtype is torch.float64), source)


def normal(source: Stream, count: int) -> Tensor:
    """(B, count), float32, standard normal (Box and Muller 1958), below `LARGEST_NORMAL` in magnitude."""
    if _is_few(source, 2 * _blocks(count)):
        return _brought(_normal_of(torch.from_numpy(_uniform_few(source, 2 * _blocks(count))), count), source)
    return _brought(_normal(source.high, source.low, source.lane, count), source)


def noise_key(source: Stream) -> Tensor:
    """(B, 4), int64, in [0, 2^32): what the white noise of each sample comes from."""
    child = fold(source)
    if child.few is not None:
        key = torch.tensor([(*words, *rounds(*words, 0, 0)) for words in child.few], dtype=torch.int64)
    else:
        key = _noise_key(child.high, child.low)
    return _brought(key, source)


def call_seed() -> Tensor:
    """(), int64: a fresh seed from torch's global generator, in eager mode and under torch.compile alike."""
    # Calling the operator loads what compilers need, a second of work that eager mode does without.
    return torch.ops.torchrefract.call_seed.default() if torch.compiler.is_compiling() else _new_seed()


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


def _is_few(source: Stream, count: int) -> bool:
    """Whether so many numbers of each sample are faster in Python."""
    return source.few is not None and _blocks(count) * len(source.few) <= _FEW


def _uniform_few(source: Stream, count: int) -> np.ndarray:
    rows = []
    for high, low in cast(Sequence[tuple[int, int]], source.few):
        blocks = (rounds(high, low, i, source.lane) for i in range(_blocks(count)))
        first, second = zip(*blocks, strict=True)
        rows.append([((word >> 9) + 0.5) * 2.0**-23 for word in (*first, *second)[:count]])
    return np.array(rows, dtype=np.float32)


def _blocks(count: int) -> int:
    """Each gives two numbers."""
    return (count + 1) // 2


def _brought(value: Tensor, source: Stream) -> Tensor:
    """The value on the device of a stream; a copy from the CPU waits for nothing."""
    if source.device is None or source.device == value.device:
        return value
    return value.to(source.device, non_blocking=value.device.type == "cpu")


def _new_seed() -> Tensor:
    return torch.randint(-(2**63), 2**63 - 1, (), dtype=torch.int64)


def _halves(value: Any) -> tuple[Any, Any]:
    return (value >> 32) & WORD, value & WORD


def _operator(schema: str, result: Callable[..., Any]) -> Callable[[_F], _F]:
    """Makes a function one operator for compilers: its hundreds of steps would take them a minute.

    Args:
        schema: its arguments and results, as PyTorch writes them.
        result: gives what has the results' shapes, types and devices, of the same arguments.
    """

    def made(function: _F) -> _F:
        name = function.__name__.removeprefix("_")
        operator = torch.library.custom_op(f"torchrefract::{name}", function, mutates_args=(), schema=schema)
        operator.register_fake(result)

        @wraps(function)
        def chosen(*args: Any) -> Any:
            if torch.compiler.is_compiling():
                return getattr(torch.ops.torchrefract, name)(*args)
            return function(*args)

        return cast(_F, chosen)

    return made


@_operator(
    "(Tensor seed, int start, int stop) -> (Tensor, Tensor)", lambda seed, start, stop: _pair(seed, stop - start)
)
def _of_range(seed: Tensor, start: int, stop: int) -> _Words:
    """The words of each key."""
    return threefry(_halves(seed.long()), _halves(torch.arange(start, stop, device=seed.device)))


@_operator("(Tensor seed, Tensor keys) -> (Tensor, Tensor)", lambda seed, keys: _pair(keys, len(keys)))
def _of_keys(seed: Tensor, keys: Tensor) -> _Words:
    return threefry(_halves(seed), _halves(keys))


@_operator("(Tensor high, Tensor low, int lane) -> (Tensor, Tensor)", lambda high, low, lane: _pair(low, len(low)))
def _folded(high: Tensor, low: Tensor, lane: int) -> _Words:
    zero = torch.zeros_like(low)
    return threefry((high, low), (zero + WORD, zero + lane))


@_operator(
    "(Tensor high, Tensor low, int lane, int count) -> Tensor",
    lambda high, low, lane, count: high.new_empty((len(high), count), dtype=torch.float32),
)
def _uniform(high: Tensor, low: Tensor, lane: int, count: int) -> Tensor:
    counter = torch.arange(_blocks(count), dtype=torch.int64, device=low.device)
    words = threefry((high[:, None], low[:, None]), (counter, torch.full_like(counter, lane)))
    return (torch.cat(words, dim=1)[:, :count] >> 9).float().add(0.5).mul(2.0**-23)


@_operator(
    "(Tensor high, Tensor low, int lane, float[] ends, bool double) -> Tensor",
    lambda high, low, lane, ends, double: high.new_empty(
        (len(high), len(ends) // 2), dtype=torch.float64 if double else torch.float32
    ),
)
def _between(high: Tensor, low: Tensor, lane: int, ends: Sequence[float], double: bool) -> Tensor:
    dtype = torch.float64 if double else torch.float32
    least, most = torch.tensor(ends, dtype=dtype, device=low.device).view(-1, 2).unbind(1)
    return least + (most - least) * _uniform(high, low, lane, len(ends) // 2).to(dtype)


@_operator(
    "(Tensor high, Tensor low, int lane, int count) -> Tensor",
    lambda high, low, lane, count: high.new_empty((len(high), count), dtype=torch.float32),
)
def _normal(high: Tensor, low: Tensor, lane: int, count: int) -> Tensor:
    return _normal_of(_uniform(high, low, lane, 2 * _blocks(count)), count)


def _normal_of(values: Tensor, count: int) -> Tensor:
    radius, angle = values.chunk(2, dim=1)
    radius, angle = (-2 * radius.log()).sqrt(), 2 * math.pi * angle
    return torch.cat([radius * angle.cos(), radius * angle.sin()], dim=1)[:, :count].contiguous()


@_operator("(Tensor high, Tensor low) -> Tensor", lambda high, low: high.new_empty((len(high), 4)))
def _noise_key(high: Tensor, low: Tensor) -> Tensor:
    zero = torch.zeros_like(low)
    return torch.stack([high, low, *threefry((high, low), (zero, zero))], dim=1)


def _pair(like: Tensor, count: int) -> _Words:
    return like.new_empty(count, dtype=torch.int64), like.new_empty(count, dtype=torch.int64)


@torch.library.custom_op("torchrefract::call_seed", mutates_args=(), tags=(torch.Tag.nondeterministic_seeded,))
def _call_seed() -> Tensor:
    # An operator of its own: the compiler neither folds it to a constant nor swaps in its own random numbers.
    return _new_seed()


@_call_seed.register_fake
def _() -> Tensor:
    return torch.empty((), dtype=torch.int64)
