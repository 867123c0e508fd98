"""Keyed random numbers: what a sample draws depends on (seed, key, place) and on nothing else.

So they are the same for every batch size, order, worker, thread count and device, inside torch.compile too.
"""

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from torchrefract.draw_operators import (
    between_of,
    blocks,
    folded,
    halves,
    noise_key_of,
    normal_from,
    normal_of,
    uniform_few,
    uniform_of,
    within,
    words_of_keys,
    words_of_range,
)
from torchrefract.threefry import WORD, Words, rounds
from torchrefract.types import Range

LARGEST_NORMAL = 5.8  # in magnitude
_FEW = 32  # up to so many, Python computes faster than numpy


class Stream:
    """Where the random numbers of each sample come from: two words of 32 bits a sample.

    Args:
        words: (B, 2), as whole numbers, or as two tensors (B,), int64; numbers are computed where these are.
        lane: numbers of different lanes are independent.
        device: that numbers are brought to; None is that of the words.
    """

    def __init__(
        self,
        words: Sequence[tuple[int, int]] | Words,
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
            return cast(Words, self._words)[which]
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
        return Stream([rounds(*halves(start), *halves(number)) for number in numbers], device=device)
    if not isinstance(seed, Tensor):
        seed = torch.full((), seed, dtype=torch.int64, device=None if isinstance(keys, range) else keys.device)
    if torch.compiler.is_compiling() and device is not None and device.type == "cuda":
        # A graph that works on the CPU in between waits for it, and could not be replayed as a whole.
        seed = seed.to(device, non_blocking=True)
    if isinstance(keys, range):
        return Stream(words_of_range(seed, keys.start, keys.stop), device=device)
    if seed.device.type != "cpu":
        keys = keys.to(seed.device, non_blocking=True)
    return Stream(words_of_keys(seed.long(), keys.long()), device=device)


def fold(parent: Stream) -> Stream:
    """Streams of their own for what is nested in a lane."""
    if parent.few is not None:
        return Stream([rounds(high, low, WORD, parent.lane) for high, low in parent.few], device=parent.device)
    return Stream(folded(parent.high, parent.low, parent.lane), device=parent.device)


def uniform(source: Stream, count: int) -> Tensor:
    """(B, count), float32, uniform in the open interval (0, 1), on a lattice of 2^23 values."""
    if (few := _few_uniform(source, count)) is not None:
        return _brought(torch.from_numpy(few), source)
    return _brought(uniform_of(source.high, source.low, source.lane, count), source)


def between(source: Stream, ranges: Sequence[Range], *, dtype: torch.dtype) -> Tensor:
    """(B, n), low + (high - low) u of each range, u as by `uniform`.

    Args:
        source: of the numbers.
        ranges: n of them.
        dtype: float32 or float64.
    """
    ends, double = [float(end) for span in ranges for end in span], dtype is torch.float64
    if (few := _few_uniform(source, len(ranges))) is not None:
        return _brought(torch.from_numpy(within(ends, few, double=double)), source)
    return _brought(between_of(source.high, source.low, source.lane, ends, double), source)


def normal(source: Stream, count: int) -> Tensor:
    """(B, count), float32, standard normal (Box and Muller 1958), below `LARGEST_NORMAL` in magnitude."""
    if (few := _few_uniform(source, 2 * blocks(count))) is not None:
        return _brought(normal_from(torch.from_numpy(few), count), source)
    return _brought(normal_of(source.high, source.low, source.lane, count), source)


def noise_key(source: Stream) -> Tensor:
    """(B, 4), int64, in [0, 2^32): what the white noise of each sample comes from."""
    child = fold(source)
    if child.few is not None:
        key = torch.tensor([(*words, *rounds(*words, 0, 0)) for words in child.few], dtype=torch.int64)
    else:
        key = noise_key_of(child.high, child.low)
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


def _few_uniform(source: Stream, count: int) -> np.ndarray | None:
    """The numbers of `uniform`, None where they are so many that tensors are faster."""
    if source.few is None or blocks(count) * len(source.few) > _FEW:
        return None
    return uniform_few(source.few, source.lane, count)


def _brought(value: Tensor, source: Stream) -> Tensor:
    """The value on the device of a stream; a copy from the CPU waits for nothing."""
    if source.device is None or source.device == value.device:
        return value
    return value.to(source.device, non_blocking=value.device.type == "cpu")


def _new_seed() -> Tensor:
    return torch.randint(-(2**63), 2**63 - 1, (), dtype=torch.int64)


@torch.library.custom_op("torchrefract::call_seed", mutates_args=(), tags=(torch.Tag.nondeterministic_seeded,))
def _call_seed() -> Tensor:
    # An operator of its own: the compiler neither folds it to a constant nor swaps in its own random numbers.
    return _new_seed()


@_call_seed.register_fake
def _() -> Tensor:
    return torch.empty((), dtype=torch.int64)
