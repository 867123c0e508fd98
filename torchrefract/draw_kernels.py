"""What numba compiles of the keyed random numbers: the generator, for each sample and each number of it."""

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import inlined, jit

_Words = NDArray[np.int64]  # (2, n)
_STEP = np.float32(2.0**-23)
_PARITY = np.uint32(0x1BD11BDA)


@jit
def words_of(seed: int, keys: NDArray[np.int64], out: _Words) -> None:
    """The two words, (2, n), of each key, (n,), under a seed."""
    for i in range(len(keys)):
        out[0, i], out[1, i] = _rounds(*_halves(seed), *_halves(keys[i]))


@jit
def words_under(keys: _Words, counter: tuple[int, int], out: _Words) -> None:
    """The two words, (2, n), of one counter under each key, (2, n)."""
    first, second = np.uint32(counter[0]), np.uint32(counter[1])
    for i in range(keys.shape[1]):
        out[0, i], out[1, i] = _rounds(np.uint32(keys[0, i]), np.uint32(keys[1, i]), first, second)


@jit
def uniforms(keys: _Words, lane: int, out: NDArray[np.float32]) -> None:
    """Uniform numbers in (0, 1), (B, n), under keys, (2, B): of the first words of all counters, then of the second."""
    count = out.shape[1]
    blocks = (count + 1) // 2
    for b in range(keys.shape[1]):
        for i in range(blocks):
            x, y = _rounds(np.uint32(keys[0, b]), np.uint32(keys[1, b]), np.uint32(i), np.uint32(lane))
            out[b, i] = _uniform(x)
            if blocks + i < count:
                out[b, blocks + i] = _uniform(y)


@inlined
def _halves(value: int) -> tuple[np.uint32, np.uint32]:
    return np.uint32((value >> 32) & 0xFFFFFFFF), np.uint32(value & 0xFFFFFFFF)


@inlined
def _uniform(word: np.uint32) -> np.float32:
    return (np.float32(np.int32(word >> np.uint32(9))) + np.float32(0.5)) * _STEP


@jit
def _rounds(key0: np.uint32, key1: np.uint32, counter0: np.uint32, counter1: np.uint32) -> tuple[np.uint32, np.uint32]:
    """As `threefry.rounds`."""
    key2 = np.uint32(key0 ^ key1 ^ _PARITY)
    x, y = np.uint32(counter0 + key0), np.uint32(counter1 + key1)
    for group in range(5):
        first = group % 2 == 0
        for k in range(4):
            turn = np.uint32(((13, 15, 26, 6) if first else (17, 29, 16, 24))[k])
            x = np.uint32(x + y)
            y = np.uint32(np.uint32(y << turn) | (y >> (np.uint32(32) - turn))) ^ x
        own = (group + 1) % 3
        following = (group + 2) % 3
        x = np.uint32(x + (key0 if own == 0 else key1 if own == 1 else key2))
        y = np.uint32(
            np.uint32(y + (key0 if following == 0 else key1 if following == 1 else key2)) + np.uint32(group + 1)
        )
    return x, y
