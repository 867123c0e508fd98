"""Work in bands that stay in a core's cache, or sample by sample."""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import torch
from torch import Tensor


def rows_at_once(device: torch.device, rows: int, *, each: int, cached: int, shared: bool = False) -> int:
    """How many rows at a time stay in the cache; all, on an accelerator and in a compiled graph.

    Args:
        device: they are computed on.
        rows: all of them.
        each: values in a row.
        cached: values that stay in that of one core.
        shared: all threads work on the rows together, each with a core's cache of its own.
    """
    if device.type != "cpu" or torch.compiler.is_compiling():
        return max(1, rows)
    return max(1, (torch.get_num_threads() if shared else 1) * cached // max(1, each))


def join(bands: Iterable[Tensor], *, dim: int, length: int) -> Tensor:
    """The bands one after the other along a dimension, of which they fill `length`.

    Without gradients each is copied to its place before the next is made, so that all of them use the same memory.

    Args:
        bands: at least one.
        dim: the dimension.
        length: of the result along it.
    """
    iterator = iter(bands)
    first = next(iterator)
    if first.shape[dim] == length:
        return first
    if first.requires_grad and torch.is_grad_enabled():
        return torch.cat([first, *iterator], dim=dim)
    shape = list(first.shape)
    shape[dim] = length
    whole, start = first.new_empty(shape), 0
    for band in chain([first], iterator):
        whole.narrow(dim, start, band.shape[dim]).copy_(band)
        start += band.shape[dim]
    return whole


def in_place(parts: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """(B, ...): rows (n, ...) in their places, (n,), which are all of 0 ... B - 1."""
    some = parts[0][1]
    whole = some.new_empty(sum(len(index) for index, _ in parts), *some.shape[1:])
    for index, rows in parts:
        whole.index_copy_(0, index, rows)
    return whole


def by_samples(values: Tensor, work: Callable[[Tensor], Tensor]) -> Tensor:
    """(B, ...): what products of matrices make of values (B, ...), to the same bits in any batch on the CPU."""
    if len(values) <= 1 or values.device.type != "cpu" or torch.compiler.is_compiling():
        return work(values)
    # How products of small matrices round depends on how many there are, and on where in memory they begin.
    return torch.cat([work(own.clone()) for own in values.split(1)])
