"""What Triton compiles of the keyed random numbers: the generator, for each sample and each number of it."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportOptionalMemberAccess=false
# Triton has a language of its own, which only looks like Python.

import triton
import triton.language as tl


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
