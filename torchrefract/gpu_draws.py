"""The keyed random numbers on a GPU: operators that compilers see into, each of them a kernel of Triton."""

# Triton has a language of its own, which only looks like Python, so types are checked but for these two rules:
# pyright: reportGeneralTypeIssues=false, reportArgumentType=false

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from torchrefract.threefry import Words, empty_words

_BLOCK = 128  # numbers that one program makes


@triton.jit
def words_of(seed, keys, start, high, low, count, given: tl.constexpr, block: tl.constexpr):
    """The two words of each of `count` keys under a seed: of those that are `given`, or counted from `start`."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    inside = i < count
    value = tl.load(seed)
    key = tl.load(keys + i, inside, 0) if given else start + i.to(tl.int64)
    x, y = _rounds(_upper(value), value.to(tl.uint32), _upper(key), key.to(tl.uint32))
    tl.store(high + i, x.to(tl.int64), inside)
    tl.store(low + i, y.to(tl.int64), inside)


@triton.jit
def words_under(key_high, key_low, first, second, high, low, count, block: tl.constexpr):
    """The two words of one counter, `first` and `second`, under each of `count` keys."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    inside = i < count
    key0, key1 = tl.load(key_high + i, inside, 0).to(tl.uint32), tl.load(key_low + i, inside, 0).to(tl.uint32)
    zero = tl.zeros((block,), tl.int64)
    x, y = _rounds(key0, key1, (zero + first).to(tl.uint32), (zero + second).to(tl.uint32))
    tl.store(high + i, x.to(tl.int64), inside)
    tl.store(low + i, y.to(tl.int64), inside)


@triton.jit
def uniforms(high, low, lane, out, total, count, block: tl.constexpr):
    """Uniform numbers in (0, 1), `count` under each key: of the first words of all counters, then of the second."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    inside = i < total
    key, number = i // count, i % count
    blocks = (count + 1) // 2
    later = number >= blocks
    counter = tl.where(later, number - blocks, number)
    key0, key1 = tl.load(high + key, inside, 0).to(tl.uint32), tl.load(low + key, inside, 0).to(tl.uint32)
    x, y = _rounds(key0, key1, counter.to(tl.uint32), (tl.zeros((block,), tl.int64) + lane).to(tl.uint32))
    word = tl.where(later, y, x) >> 9
    tl.store(out + i, (word.to(tl.int32).to(tl.float32) + 0.5) * 1.1920928955078125e-07, inside)  # 2^-23


@triton.jit
def _upper(value):
    return (value >> 32).to(tl.uint32)


@triton.jit
def _rounds(key0, key1, counter0, counter1):
    """As `threefry.rounds`, in words that overflow."""
    key2 = key0 ^ key1 ^ 0x1BD11BDA
    x, y = counter0 + key0, counter1 + key1
    x, y = _mixed(x, y, 13, 15, 26, 6)
    x, y = _mixed(x + key1, y + key2 + 1, 17, 29, 16, 24)
    x, y = _mixed(x + key2, y + key0 + 2, 13, 15, 26, 6)
    x, y = _mixed(x + key0, y + key1 + 3, 17, 29, 16, 24)
    x, y = _mixed(x + key1, y + key2 + 4, 13, 15, 26, 6)
    return x + key2, y + key0 + 5


@triton.jit
def _mixed(x, y, a: tl.constexpr, b: tl.constexpr, c: tl.constexpr, d: tl.constexpr):
    """Four rounds between two additions of the key."""
    x, y = _round(x, y, a)
    x, y = _round(x, y, b)
    x, y = _round(x, y, c)
    return _round(x, y, d)


@triton.jit
def _round(x, y, rotation: tl.constexpr):
    x = x + y
    return x, ((y << rotation) | (y >> (32 - rotation))) ^ x


@triton_op("torchrefract::gpu_words_of_range", mutates_args={})
def _gpu_words_of_range(seed: Tensor, start: int, stop: int) -> Words:
    return _gpu_words(seed, seed, start, stop - start, given=False)


@triton_op("torchrefract::gpu_words_of_keys", mutates_args={})
def _gpu_words_of_keys(seed: Tensor, keys: Tensor) -> Words:
    return _gpu_words(seed, keys, 0, len(keys), given=True)


@triton_op("torchrefract::gpu_words_under", mutates_args={})
def _gpu_words_under(high: Tensor, low: Tensor, first: int, second: int) -> Words:
    found = empty_words(high, len(high))
    # As signed words: PyTorch 2.11 compiles no larger numbers.
    signed = ((word + 2**31) % 2**32 - 2**31 for word in (first, second))
    kernel = wrap_triton(words_under)
    kernel[(-(-len(high) // _BLOCK),)](high, low, *signed, *found, len(high), block=_BLOCK)
    return found


@triton_op("torchrefract::gpu_uniforms", mutates_args={})
def _gpu_uniforms(high: Tensor, low: Tensor, lane: int, count: int) -> Tensor:
    out = high.new_empty((len(high), count), dtype=torch.float32)
    total = len(high) * count
    wrap_triton(uniforms)[(-(-total // _BLOCK),)](high, low, lane, out, total, count, block=_BLOCK)
    return out


def _gpu_words(seed: Tensor, keys: Tensor, start: int, count: int, *, given: bool) -> Words:
    found = empty_words(seed, count)
    kernel = wrap_triton(words_of)
    kernel[(-(-count // _BLOCK),)](seed, keys, start, *found, count, given=given, block=_BLOCK)
    return found
