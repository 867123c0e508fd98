"""The generator Threefry-2x32 with 20 rounds, in integer operations that never overflow.

So the same words come out for every batch size, order, worker, thread count and device.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

Words = tuple[Tensor, Tensor]
WORD = 0xFFFFFFFF
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def threefry(key: Words, counter: Words) -> Words:
    """Two words for each counter under each key, all of them int64 tensors in [0, 2^32) that broadcast."""
    try:
        arrays = [value.numpy() for value in (*key, *counter)]
    except (TypeError, RuntimeError):  # on an accelerator, or inside torch.vmap
        return rounds(*key, *counter)
    # Hundreds of operations on not so many numbers: those of numpy start several times as fast.
    x, y = rounds(*arrays)
    return torch.from_numpy(np.asarray(x)), torch.from_numpy(np.asarray(y))


def rounds(key0: Any, key1: Any, counter0: Any, counter1: Any) -> tuple[Any, Any]:
    """The generator, on tensors, arrays or whole numbers alike."""
    keys = (key0, key1, key0 ^ key1 ^ _PARITY)
    x, y = counter0 + key0, counter1 + key1
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            # Only what is shifted right must be free of carries; they never reach bit 63.
            y = y & WORD
            x = x + y
            y = (y << rotation | y >> (32 - rotation)) ^ x
        x = (x + keys[(group + 1) % 3]) & WORD
        y = y + keys[(group + 2) % 3] + group + 1
    return x, y & WORD


def empty_words(like: Tensor, count: int) -> Words:
    """Room for the two words of each sample, (count,), int64, where a tensor is."""
    return like.new_empty(count, dtype=torch.int64), like.new_empty(count, dtype=torch.int64)
