"""Small operations on tensors that several packages share."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import lru_cache, wraps
from typing import Any, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract._validation import requires_grad
from torchrefract.types import Range

_F = TypeVar("_F", bound=Callable[..., Any])
_CACHED_VALUES = 1 << 17  # float32 values that fit into the cache of one core
_results: ContextVar[dict[Any, list[Any]] | None] = ContextVar("_results", default=None)


def as_device_tensor(values: Any, *, dtype: torch.dtype | None = None, device: torch.device) -> Tensor:
    """Create a tensor from numbers or nested lists without waiting for the device, as `torch.tensor` would."""
    return torch.tensor(values, dtype=dtype, device="cpu").to(device, non_blocking=True)


def assume_constant_result(function: _F) -> _F:
    """Mark a function as `torch.compiler.assume_constant_result` does, without importing the compiler.

    The import takes nearly as long as that of torch itself, and most processes never compile.
    """
    vars(function)["_dynamo_marked_constant"] = True
    return function


def cached_constant(*, maxsize: int) -> Callable[[_F], _F]:
    """Cache a function of hashable arguments whose result depends on nothing else, as that of a plan.

    A thread of its own computes it. What PyTorch keeps for each thread does not reach it: FakeTensorMode, the tracing
    of an export, a default device, inference mode.
    """

    def decorate(function: _F) -> _F:
        def compute(*args: Any, **kwargs: Any) -> Any:
            with ThreadPoolExecutor(max_workers=1) as pool:
                return pool.submit(function, *args, **kwargs).result()

        return cast(_F, wraps(function)(lru_cache(maxsize=maxsize)(compute)))

    return decorate


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Return a context without autocast. It does nothing where autocast is off, and so adds nothing to an export."""
    is_enabled = device.type != "meta" and torch.is_autocast_enabled(device.type)  # PyTorch raises for "meta"
    return torch.autocast(device.type, enabled=False) if is_enabled else nullcontext()


@contextmanager
def sharing_results() -> Iterator[None]:
    """Keep the results of `shareable` functions, in this thread, until the end of the block."""
    token = _results.set({})
    try:
        yield
    finally:
        _results.reset(token)


def shareable(function: _F) -> _F:
    """Compute a function once for arguments of equal values within `sharing_results`.

    The severities of a scene have the same random fields for a key. Results must not be written to, and have no
    gradient.
    """

    @wraps(function)
    def result(*args: Any, **kwargs: Any) -> Any:
        results = None if torch.compiler.is_compiling() else _results.get()
        if results is None:
            return function(*args, **kwargs)
        arguments, structure = pytree.tree_flatten((args, kwargs))
        if requires_grad(arguments):
            return function(*args, **kwargs)
        for others, other_structure, value in results.setdefault(function, []):
            if structure == other_structure and all(map(_is_equal, arguments, others)):
                return value
        results[function].append((arguments, structure, function(*args, **kwargs)))
        return results[function][-1][2]

    return cast(_F, result)


def _is_equal(value: Any, other: Any) -> bool:
    if isinstance(value, Tensor) and isinstance(other, Tensor):
        return value.dtype == other.dtype and value.device == other.device and torch.equal(value, other)
    return type(value) is type(other) and value == other


def in_ranges(values: Tensor, ranges: Sequence[Range]) -> Tensor:
    """Return (), bool: all values (B, n) lie in the n ranges, up to rounding."""
    low, high = as_device_tensor(ranges, dtype=values.dtype, device=values.device).unbind(1)
    margin = 1e-5 * torch.maximum(low.abs(), high.abs())
    return ((values >= low - margin) & (values <= high + margin)).all()


def expand_batch(value: Tensor, batch: int) -> Tensor:
    """Repeat each row of (B, ...) for the T frames of its clip, so that `batch` = B T rows result.

    A single row is expanded, not copied.
    """
    if value.shape[0] in (batch, 0):
        return value
    if value.shape[0] == 1:
        return value.expand(batch, *value.shape[1:])
    return value.repeat_interleave(batch // value.shape[0], dim=0)


def in_bands(compute: Callable[[int, int], Tensor], *, length: int, band: int, dim: int) -> Tensor:
    """Compute a tensor of a length along a dimension in bands, each from one index to another.

    Without gradients each band is copied before the next one is made, so that all bands use the same memory.
    """
    first = compute(0, min(band, length))
    if band >= length:
        return first
    starts = range(band, length, band)
    if torch._C._are_functorch_transforms_active() or (first.requires_grad and torch.is_grad_enabled()):
        return torch.cat([first, *(compute(start, min(start + band, length)) for start in starts)], dim=dim)
    shape = list(first.shape)
    shape[dim] = length
    result = first.new_empty(shape)
    result.narrow(dim, 0, band).copy_(first)
    for start in starts:
        size = min(band, length - start)
        result.narrow(dim, start, size).copy_(compute(start, start + size))
    return result


def rows_at_once(device: torch.device, rows: int, *, each: int, cached: int, shared: bool = False) -> int:
    """Return how many rows fit into the cache; all of them on an accelerator and in a compiled graph.

    Args:
        device: where the rows are computed.
        rows: the total number of rows.
        each: values in a row.
        cached: values that fit into the cache of one core.
        shared: True if all threads work on the rows together.
    """
    if device.type != "cpu" or torch.compiler.is_compiling():
        return max(1, rows)
    return max(1, (torch.get_num_threads() if shared else 1) * cached // max(1, each))


def highest_nearby(value: Tensor, reach: int = 1) -> Tensor:
    """Return the highest of the values (N, C, H, W) at a pixel and up to `reach` rows and columns around it."""
    # max_pool2d, which finds the indices too, takes ten times as long.
    for dim in (2, 3) * reach:
        size = value.shape[dim]
        before = torch.cat([value.narrow(dim, 0, 1), value.narrow(dim, 0, size - 1)], dim=dim)
        after = torch.cat([value.narrow(dim, 1, size - 1), value.narrow(dim, size - 1, 1)], dim=dim)
        value = torch.maximum(value, torch.maximum(before, after))
    return value


def interpolate_channels(nodes: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolate (N, C, h, w) bilinearly to a size, (N, C, H, W)."""
    # PyTorch copies three channels to channels_last and back, which takes longer than to interpolate them.
    images = F.interpolate(nodes.flatten(0, 1)[:, None], size, mode="bilinear", align_corners=False)
    return images.view(*nodes.shape[:2], *size)


def pad_to_multiple(maps: Tensor, multiple: int) -> Tensor:
    """Repeat the last row and column of (B, C, H, W) until both sides are multiples of a number."""
    height, width = maps.shape[2:]
    return F.pad(maps, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def is_channels_last(image: Tensor) -> bool:
    """Return True if the image (B, C, H, W) has the channels_last memory format and is not contiguous as well."""
    return (
        not image.is_contiguous()
        and has_memory_format(image)
        and image.is_contiguous(memory_format=torch.channels_last)
    )


def has_memory_format(image: Tensor) -> bool:
    """Return False inside of torch.func, where samples and tangents of a batch have no memory format."""
    if torch._C._are_functorch_transforms_active():
        return False
    try:
        image.is_contiguous(memory_format=torch.channels_last)
    except RuntimeError:
        return False
    return True


def to_float(image: Tensor) -> Tensor:
    """Convert integers, as uint8 or uint16, to float32 in [0, 1] and keep the memory format."""
    return image.float().div_(torch.iinfo(image.dtype).max)


def to_uint8(image: Tensor) -> Tensor:
    """Convert (N, C, H, W) in [0, 1] to uint8: clamp, multiply by 255 and round; keep the memory format."""
    image = image.detach()
    result = torch.empty_like(image, dtype=torch.uint8)
    batch, channels, height, width = image.shape
    rows = rows_at_once(image.device, height, each=batch * channels * width, cached=_CACHED_VALUES, shared=True)
    for target, band in zip(result.split(rows, dim=2), image.split(rows, dim=2), strict=True):
        target.copy_(round_to_dtype(band * 255, torch.uint8))
    return result


def round_to_dtype(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Round to the nearest value that an integer type can hold, and keep the type of `values`."""
    low, high = (0, 1) if dtype is torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    return values.clamp(low, high).round_()


def exact_matmul(left: Tensor, right: Tensor) -> Tensor:
    """Multiply (..., n, k) by (..., k, m) at the full precision of the type.

    `torch.set_float32_matmul_precision("high")` rounds factors to 10 bits, which moves a position by up to 1/1000 of
    a frame. With such a setting, float32 is multiplied in float64.
    """
    if left.dtype is torch.float32 and _rounds_factors(left.device.type):
        return torch.matmul(left.double(), right.double()).float()
    return torch.matmul(left, right)


@assume_constant_result
def _rounds_factors(device: str) -> bool:
    backends: Any = torch.backends
    precision = (backends.mkldnn if device == "cpu" else backends.cuda).matmul.fp32_precision
    return (backends.fp32_precision if precision == "none" else precision) not in ("none", "ieee")
