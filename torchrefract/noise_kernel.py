"""What numba compiles: the hash of white noise."""

import math

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import jit

_TURN = np.float32(math.pi * 2.0**-31)
_STEP = np.float32(2.0**-23)


@jit
def hashed(
    words: NDArray[np.uint32],
    places: NDArray[np.uint32],
    constants: tuple[int, int, int],
    start: int,
    stop: int,
    uniform: NDArray[np.float32],
    angle: NDArray[np.float32],
) -> None:
    """Uniform numbers in (0, 1) and angles, (B, n), of keys (B, 4) at places (n,), of which `start` ... `stop`."""
    for i in range(words.shape[0]):
        a, b, c, d = words[i]
        for k in range(start, stop):
            index = np.uint32(places[k] * np.uint32(constants[0]))
            radius, turn = hashed_word(index, a, b, constants), hashed_word(index, c, d, constants)
            uniform[i, k] = (np.float32(np.int32(radius >> np.uint32(9))) + np.float32(0.5)) * _STEP
            angle[i, k] = np.float32(np.int32(turn)) * _TURN


@jit
def hashed_word(index: np.uint32, a: np.uint32, b: np.uint32, constants: tuple[int, int, int]) -> np.uint32:
    """Two rounds of the hash, of an index times the first of the constants, under two words of a key."""
    x = np.uint32(index + a)
    x = np.uint32(x ^ (x >> np.uint32(16)))
    x = np.uint32(np.uint32(x * np.uint32(constants[1])) + b)
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * np.uint32(constants[2]))
    return np.uint32(x ^ (x >> np.uint32(16)))
