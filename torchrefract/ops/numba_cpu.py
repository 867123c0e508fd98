"""Sample images on the CPU with numba: bilinear, forward only, float32 and uint8, images of any strides.

Import this module only where numba is needed: the import takes a second. The first call of each kernel compiles it and
caches the machine code on disk.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar, cast

import numba
import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import is_channels_last
from torchrefract._validation import warn

_F = TypeVar("_F", bound=Callable[..., Any])
_SMALLEST_BAND = 1 << 14  # pixels that are worth a thread
_BANDS_PER_THREAD = 4  # several, so that a slow thread leaves bands to the others
_PADDINGS = {"zeros": 0, "border": 1, "reflection": 2}
_LARGEST_OFFSET = 2**31 - 1  # elements from the first to the last pixel of a channel, counted in int32

if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]  # numba sets it on import
    raise ImportError("NUMBA_DISABLE_JIT is set, and interpreted loops are slower than PyTorch")


def _jit(function: _F) -> _F:
    options: Any = {"nogil": True, "error_model": "numpy"}
    try:
        kernel: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder is writable, so the kernel is compiled once for each process
        return cast(_F, numba.njit(**options)(function))
    storage = kernel._cache
    storage.load_overload = _optional(storage.load_overload, storage)
    storage.save_overload = _optional(storage.save_overload, storage)
    return cast(_F, kernel)


def _optional(access: Callable[..., Any], storage: Any) -> Callable[..., Any]:
    """Return an access to numba's cache that returns None if it fails, as on a full disk or for a torn file."""

    def run(*arguments: Any) -> Any:
        try:
            return access(*arguments)
        except Exception:  # pickle and LLVM raise many types for a torn file
            _warn_of_cache(storage.cache_path)
            with suppress(Exception):
                storage.flush()  # an index that is torn would fail for ever
            return None

    return run


@cache
def _warn_of_cache(folder: str) -> None:
    warn(
        f"numba cannot use its cache in {folder}, so each process compiles kernels again; free disk space, remove the "
        "folder, or set NUMBA_CACHE_DIR",
        RuntimeWarning,
    )


def why_unsupported(image: Tensor, flow: Tensor) -> str | None:
    """Say why the kernels cannot sample an image (N, C, H, W); None if they can."""
    if flow.shape[0] not in (1, image.shape[0]):  # the kernel would read memory that is not the flow's
        return f"{flow.shape[0]} flows for {image.shape[0]} images"
    _, _, row_stride, column_stride = image.stride()
    if (image.shape[2] - 1) * row_stride + (image.shape[3] - 1) * column_stride > _LARGEST_OFFSET:
        return "an image of more than 2^31 elements"
    return None


def sample_lattice(
    image: Tensor,
    nodes: Tensor,
    weights: Tensor | None,
    *,
    margin: int,
    padding: str,
    limit: float,
    active: Tensor | None = None,
) -> Tensor:
    """Sample an image along a flow at the nodes of a lattice, with cubics between them, or at every pixel.

    Args:
        image: (N, C, H, W), float32 or uint8, of any strides.
        nodes: (N or 1, 2, h, w), px, float32, every `stride` px; the pixels if there are no weights.
        weights: (stride, 4), of the nodes around a pixel by its position in its cell; None for a flow at every pixel.
        margin: nodes before the first pixel, at least 1, or 0 without weights.
        padding: "zeros", "border" or "reflection".
        limit: the largest position, in the coordinates of F.grid_sample; NaN counts as that position.
        active: (N,), bool, samples to warp; the others are copied. None for all.

    Returns:
        (N, C, H, W), of the type of the image, channels_last if the image is.
    """
    batch, channels, height, width = image.shape
    # Not `empty_like`, which gives an image of one pixel other strides.
    layout = torch.channels_last if is_channels_last(image) else torch.contiguous_format
    out = torch.empty(image.shape, dtype=image.dtype, device="cpu", memory_format=layout)
    stride = 0 if weights is None else len(weights)
    table = nodes.new_zeros(4, 1) if weights is None else weights.to(nodes.dtype).mT.contiguous()
    mask = torch.ones(batch, dtype=torch.bool, device="cpu") if active is None else active.expand(batch).contiguous()
    arguments = (
        _elements(image),
        (channels, height, width),
        image.stride(),
        nodes.detach().contiguous().numpy(),
        (stride, margin),
        table.numpy(),
        mask.numpy(),
        _PADDINGS[padding],
        np.float32(limit),
        np.float32(0.5 if image.dtype is torch.uint8 else 0),  # rounds to the nearest integer when uint8 truncates
        _elements(out),
        out.stride(),
    )
    _run_bands(lambda start, stop: _sample_rows(*arguments, start, stop), batch * height, _SMALLEST_BAND // width + 1)
    return out


def _elements(image: Tensor) -> np.ndarray:
    """Return the memory of an image, from its first element to its last one."""
    count = 1 + int((np.array(image.shape) - 1) @ np.array(image.stride()))
    return image.detach().as_strided((count,), (1,)).numpy()


def _run_bands(work: Callable[[int, int], None], rows: int, smallest: int) -> None:
    """Call work(start, stop) for bands of rows on as many threads as PyTorch uses."""
    threads = min(torch.get_num_threads(), rows // smallest)
    if threads < 2:
        work(0, rows)
        return
    bands = min(_BANDS_PER_THREAD * threads, rows // smallest)
    remaining = iter(list(pairwise(rows * i // bands for i in range(bands + 1))))

    def take() -> None:
        for start, stop in remaining:
            work(start, stop)

    others = [_pool().submit(take) for _ in range(threads - 1)]
    take()
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="torchrefract")


if hasattr(os, "register_at_fork"):  # a forked process has no threads of the pool
    os.register_at_fork(after_in_child=_pool.cache_clear)


@_jit
def _sample_rows(
    source, size, strides, flow, lattice, table, active, padding, limit, rounding, out, out_strides, start, stop
):  # pragma: no cover - compiled
    """Sample rows start ... stop of N * H, row by row: positions, then offsets and weights, then each channel."""
    channels, height, width = size
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    offset, weight = np.empty(width, np.int32), np.empty((4, width), np.float32)
    line = np.empty((2, flow.shape[3]), np.float32)
    right = strides[3] if width > 1 else 0
    below = strides[2] if height > 1 else 0
    for row in range(start, stop):
        sample, i = row // height, row % height
        sample_flow = flow[sample if flow.shape[0] > 1 else 0]
        if not active[sample] or (lattice[0] == 0 and _is_still(sample_flow, i)):
            for channel in range(channels):
                first = sample * strides[0] + channel * strides[1] + i * strides[2]
                target = sample * out_strides[0] + channel * out_strides[1] + i * out_strides[2]
                _copy(source[first:], strides[3], out[target:], out_strides[3], width)
            continue
        if lattice[0] > 0:
            _lattice_positions(sample_flow, i, lattice, table, line, x, y)
        else:
            for j in range(width):
                x[j] = np.float32(j) + sample_flow[0, i, j]
                y[j] = np.float32(i) + sample_flow[1, i, j]
        _pad(x, width, padding, limit)
        _pad(y, height, padding, limit)
        _set_taps(x, y, height, width, strides[2], strides[3], offset, weight)
        for channel in range(channels):
            first = sample * strides[0] + channel * strides[1]
            target = sample * out_strides[0] + channel * out_strides[1] + i * out_strides[2]
            _gather(source[first:], offset, weight, right, below, rounding, out[target:], out_strides[3])


@_jit
def _copy(source, source_step, out, out_step, count):
    """Copy a row."""
    source_step, out_step = np.uintp(source_step), np.uintp(out_step)
    for j in range(count):
        out[np.uintp(j) * out_step] = source[np.uintp(j) * source_step]


@_jit
def _is_still(flow, i):
    """Return True if row i of a dense flow moves no pixel."""
    moves = False
    for j in range(flow.shape[2]):
        moves |= flow[0, i, j] != 0 or flow[1, i, j] != 0
    return not moves


@_jit
def _lattice_positions(nodes, i, lattice, table, line, x, y):
    """Interpolate the flow along row i, first between rows of nodes, then along the row, and add the pixels."""
    stride, margin = lattice
    width = x.shape[0]
    first, phase = i // stride + margin - 1, i % stride
    a, b, c, d = table[0, phase], table[1, phase], table[2, phase], table[3, phase]
    for axis in range(2):
        for j in range(line.shape[1]):
            line[axis, j] = (
                a * nodes[axis, first, j]
                + b * nodes[axis, first + 1, j]
                + c * nodes[axis, first + 2, j]
                + d * nodes[axis, first + 3, j]
            )
    for cell in range((width + stride - 1) // stride):
        start, node = cell * stride, cell + margin - 1
        count = min(stride, width - start)
        for axis in range(2):
            a, b, c, d = line[axis, node], line[axis, node + 1], line[axis, node + 2], line[axis, node + 3]
            target = (x if axis == 0 else y)[start : start + count]
            for t in range(count):
                target[t] = a * table[0, t] + b * table[1, t] + c * table[2, t] + d * table[3, t]
    for j in range(width):
        x[j] += np.float32(j)
        y[j] += np.float32(i)


@_jit
def _pad(position, size, padding, limit):
    """Bring positions along an axis to [-1, size], or to [0, size - 1] by the padding; NaN counts as `limit`."""
    half, length = np.float32(0.5), np.float32(size)
    low, high = (1 - limit) * length * half - half, (1 + limit) * length * half - half
    if padding == 2:
        for j in range(position.shape[0]):
            p = position[j]
            p = p if p < high else high
            p = p if p > low else low
            p = np.abs(p + half)
            p -= np.floor(p / (2 * length)) * (2 * length)
            p = (p if p < length else 2 * length - p) - half
            position[j] = p
    low, high = (np.float32(-1), length) if padding == 0 else (np.float32(0), length - 1)
    for j in range(position.shape[0]):
        p = position[j]
        p = p if p < high else high
        position[j] = p if p > low else low


@_jit
def _set_taps(x, y, height, width, row_stride, column_stride, offset, weight):
    """Set the offset of the upper left pixel of each 2 x 2 on the frame, and the bilinear weights of all four.

    A pixel at distance d from a position weighs max(0, 1 - |d|) along an axis, so pixels outside weigh nothing.
    """
    zero, one = np.float32(0), np.float32(1)
    last_x, last_y = np.float32(max(width - 2, 0)), np.float32(max(height - 2, 0))
    has_right, has_below = np.float32(width > 1), np.float32(height > 1)
    row_step, column_step = np.int32(row_stride), np.int32(column_stride)
    for j in range(x.shape[0]):
        column, row = np.floor(x[j]), np.floor(y[j])
        column = column if column < last_x else last_x
        column = column if column > zero else zero
        row = row if row < last_y else last_y
        row = row if row > zero else zero
        offset[j] = np.int32(row) * row_step + np.int32(column) * column_step
        dx, dy = x[j] - column, y[j] - row
        left, upper = one - np.abs(dx), one - np.abs(dy)
        right, lower = (one - np.abs(dx - one)) * has_right, (one - np.abs(dy - one)) * has_below
        left = left if left > zero else zero
        right = right if right > zero else zero
        upper = upper if upper > zero else zero
        lower = lower if lower > zero else zero
        weight[0, j], weight[1, j] = upper * left, upper * right
        weight[2, j], weight[3, j] = lower * left, lower * right


@_jit
def _gather(source, offset, weight, right, below, rounding, out, step):
    """Sum the four weighted pixels at each offset."""
    # Unsigned indices: a signed one may count from the end, and the test for that prevents vectorization.
    to_right, to_below, step = np.uintp(right), np.uintp(below), np.uintp(step)
    for j in range(offset.shape[0]):
        k = np.uintp(offset[j])
        value = (
            weight[0, j] * source[k]
            + weight[1, j] * source[k + to_right]
            + weight[2, j] * source[k + to_below]
            + weight[3, j] * source[k + to_below + to_right]
        )
        out[np.uintp(j) * step] = value + rounding
