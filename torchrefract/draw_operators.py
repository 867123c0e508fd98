"""Random numbers of two words a sample, high and low, (B,), int64: each function is one operator for compilers.

Its hundreds of steps would take these a minute. On the CPU it is computed by a kernel of numba, where that is, and on a
GPU by one of Triton, that compilers see into.
"""

import math
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import kernels
from torchrefract._tensor import as_device_tensor
from torchrefract._triton import reads
from torchrefract._validation import why_not_eager
from torchrefract.threefry import WORD, Words, empty_words, rounds, threefry

_F = TypeVar("_F", bound=Callable[..., Any])


def blocks(count: int) -> int:
    """How many counters so many numbers take: each gives two."""
    return (count + 1) // 2


def halves(value: Any) -> tuple[Any, Any]:
    """The two words of a whole number, or of each in a tensor."""
    return (value >> 32) & WORD, value & WORD


def _operator(schema: str, result: Callable[..., Any]) -> Callable[[_F], _F]:
    """Makes a function one operator for compilers.

    Args:
        schema: its arguments and results, as PyTorch writes them.
        result: gives what has the results' shapes, types and devices, of the same arguments.
    """

    def made(function: _F) -> _F:
        name = function.__name__
        operator = torch.library.custom_op(f"torchrefract::{name}", function, mutates_args=(), schema=schema)
        operator.register_fake(result)

        @wraps(function)
        def chosen(*args: Any) -> Any:
            if torch.compiler.is_compiling() and not reads("gpu_draws", args[0]):
                # Calling it loads what compilers need, a second of work that eager mode does without.
                return getattr(torch.ops.torchrefract, name)(*args)
            return function(*args)

        return cast(_F, chosen)

    return made


@_operator(
    "(Tensor seed, int start, int stop) -> (Tensor, Tensor)", lambda seed, start, stop: empty_words(seed, stop - start)
)
def words_of_range(seed: Tensor, start: int, stop: int) -> Words:
    """The words of the keys from start to stop."""
    if reads("gpu_draws", seed):
        return torch.ops.torchrefract.gpu_words_of_range(seed.long(), start, stop)
    return words_of_keys(seed.long(), torch.arange(start, stop, device=seed.device))


@_operator("(Tensor seed, Tensor keys) -> (Tensor, Tensor)", lambda seed, keys: empty_words(keys, len(keys)))
def words_of_keys(seed: Tensor, keys: Tensor) -> Words:
    """The words of keys, (B,), int64."""
    if reads("gpu_draws", seed, keys):
        return torch.ops.torchrefract.gpu_words_of_keys(seed, keys.contiguous())
    if (kernel := _kernels(keys)) is None or _kernels(seed) is None:
        return threefry(halves(seed), halves(keys))
    out = np.empty((2, len(keys)), np.int64)
    kernel.words_of(int(seed), np.ascontiguousarray(keys.numpy()), out)
    return torch.from_numpy(out[0]), torch.from_numpy(out[1])


@_operator(
    "(Tensor high, Tensor low, int lane) -> (Tensor, Tensor)", lambda high, low, lane: empty_words(low, len(low))
)
def folded(high: Tensor, low: Tensor, lane: int) -> Words:
    """The words of what is nested in a lane."""
    return _under(high, low, (WORD, lane))


@_operator(
    "(Tensor high, Tensor low, int lane, int count) -> Tensor",
    lambda high, low, lane, count: high.new_empty((len(high), count), dtype=torch.float32),
)
def uniform_of(high: Tensor, low: Tensor, lane: int, count: int) -> Tensor:
    """(B, count), float32, as by `draws.uniform`."""
    if reads("gpu_draws", high, low):
        return torch.ops.torchrefract.gpu_uniforms(high, low, lane, count)
    if (kernel := _kernels(low)) is not None:
        out = torch.empty(len(high), count)
        kernel.uniforms(np.stack([high.numpy(), low.numpy()]), lane, out.numpy())
        return out
    counter = torch.arange(blocks(count), dtype=torch.int64, device=low.device)
    words = threefry((high[:, None], low[:, None]), (counter, torch.full_like(counter, lane)))
    return (torch.cat(words, dim=1)[:, :count] >> 9).float().add(0.5).mul(2.0**-23)


@_operator(
    "(Tensor high, Tensor low, int lane, float[] ends, bool double) -> Tensor",
    lambda high, low, lane, ends, double: high.new_empty(
        (len(high), len(ends) // 2), dtype=torch.float64 if double else torch.float32
    ),
)
def between_of(high: Tensor, low: Tensor, lane: int, ends: Sequence[float], double: bool) -> Tensor:
    """(B, n), as by `draws.between`, of the ends of n ranges, one after the other."""
    if _kernels(low) is not None:
        return torch.from_numpy(within(ends, uniform_of(high, low, lane, len(ends) // 2).numpy(), double=double))
    dtype = torch.float64 if double else torch.float32
    least, most = as_device_tensor(ends, dtype=dtype, device=low.device).unflatten(0, (-1, 2)).unbind(1)
    return least + (most - least) * uniform_of(high, low, lane, len(ends) // 2).to(dtype)


@_operator(
    "(Tensor high, Tensor low, int lane, int count) -> Tensor",
    lambda high, low, lane, count: high.new_empty((len(high), count), dtype=torch.float32),
)
def normal_of(high: Tensor, low: Tensor, lane: int, count: int) -> Tensor:
    """(B, count), float32, as by `draws.normal`."""
    return normal_from(uniform_of(high, low, lane, 2 * blocks(count)), count)


@_operator("(Tensor high, Tensor low) -> Tensor", lambda high, low: high.new_empty((len(high), 4)))
def noise_key_of(high: Tensor, low: Tensor) -> Tensor:
    """(B, 4), int64: the words, and those of the counter 0 under them."""
    return torch.stack([high, low, *_under(high, low, (0, 0))], dim=1)


def within(ends: Sequence[float], uniform: np.ndarray, *, double: bool) -> np.ndarray:
    """(B, n): low + (high - low) u of each range; numpy's operations start several times as fast, and round alike."""
    kind = np.float64 if double else np.float32
    low, high = np.array(ends, kind).reshape(-1, 2).T
    return low + (high - low) * uniform.astype(kind, copy=False)


def normal_from(uniform: Tensor, count: int) -> Tensor:
    """(B, count), standard normal, from uniform numbers: the radii of pairs, and then their angles."""
    radius, angle = uniform.chunk(2, dim=1)
    radius, angle = (-2 * radius.log()).sqrt(), 2 * math.pi * angle
    return torch.cat([radius * angle.cos(), radius * angle.sin()], dim=1)[:, :count].contiguous()


def uniform_few(words: Sequence[tuple[int, int]], lane: int, count: int) -> np.ndarray:
    """`uniform_of` of words as whole numbers; for so few numba is not loaded, but asked where it is at work already."""
    if "torchrefract._jit" in sys.modules and (kernel := kernels("draw_kernels")):
        out = np.empty((len(words), count), np.float32)
        kernel.uniforms(np.array(words, np.int64).T.copy(), lane, out)
        return out
    rows = []
    for high, low in words:
        first, second = zip(*(rounds(high, low, i, lane) for i in range(blocks(count))), strict=True)
        rows.append([((word >> 9) + 0.5) * 2.0**-23 for word in (*first, *second)[:count]])
    return np.array(rows, dtype=np.float32)


def _under(high: Tensor, low: Tensor, counter: tuple[int, int]) -> Words:
    """Two words of one counter under each key, (B,)."""
    if reads("gpu_draws", high, low):
        return torch.ops.torchrefract.gpu_words_under(high, low, *counter)
    if (kernel := _kernels(low)) is None:
        return threefry((high, low), (torch.full_like(low, counter[0]), torch.full_like(low, counter[1])))
    out = np.empty((2, len(low)), np.int64)
    kernel.words_under(np.stack([high.numpy(), low.numpy()]), counter, out)
    return torch.from_numpy(out[0]), torch.from_numpy(out[1])


def _kernels(value: Tensor) -> Any:
    """Those of numba, where they can read a tensor, else None."""
    return None if why_not_eager(value) or kernels("_jit") is None else kernels("draw_kernels")
