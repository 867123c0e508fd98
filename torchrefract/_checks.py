"""Argument checks, in one form: `<argument> must <condition>, got <value>`."""

import math
import numbers
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract.types import Range

_LARGEST = sys.float_info.max


def check_number(name: str, value: float, *, low: float = -_LARGEST, high: float = _LARGEST) -> float:
    """`value` as a float in [low, high]; NaN never is, and infinity only where a bound is."""
    value = _check_real(name, value)
    if not low <= value <= high:
        raise ValueError(f"{name} must be a number {_bounds(low, high)}, got {value}")
    return float(value)


def check_positive(name: str, value: float) -> float:
    """`value` as a finite float above 0."""
    if check_number(name, value) <= 0:
        raise ValueError(f"{name} must be above 0, got {value}")
    return float(value)


def check_range(name: str, value: Sequence[float], *, low: float = -_LARGEST, high: float = _LARGEST) -> Range:
    """`value` as (low, high), both ends inside the bounds."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError(f"{name} must be (low, high), got {value!r}")
    first, last = (_check_real(name, end) for end in value)  # Hydra hands over its own list type
    if not low <= first <= last <= high:
        raise ValueError(f"{name} must be (low, high), low <= high, each {_bounds(low, high)}, got {tuple(value)}")
    return float(first), float(last)


def check_flag(name: str, value: bool) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return value


def check_choice(name: str, value: str, choices: Sequence[str]) -> str:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    return value


def check_count(name: str, value: int, *, low: int = 1) -> int:
    value = check_whole(name, value)
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")
    return value


def check_whole(name: str, value: int) -> int:
    """`value` as an int; numbers of numpy are numbers, flags are none."""
    # Compilers know int, and ask no further.
    if isinstance(value, bool) or not isinstance(value, int | numbers.Integral):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    return value if isinstance(value, int) else int(value)


def check_size(name: str, size: Sequence[int]) -> tuple[int, int]:
    """`size` as (height, width), two whole numbers of at least 1."""
    if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
        raise ValueError(f"{name} must be (height, width), got {size!r}")
    return check_count(name, size[0]), check_count(name, size[1])


def check_tensor(name: str, value: Tensor) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    return value


def check_flow(name: str, flow: Tensor) -> Tensor:
    """`flow` if it is (B, 2, H, W) of floats."""
    check_tensor(name, flow)
    if flow.ndim != 4 or flow.shape[1] != 2:
        raise ValueError(f"{name} must have shape (B, 2, H, W), got {tuple(flow.shape)}")
    if not flow.is_floating_point():
        raise TypeError(f"{name} must be of a floating type, got {flow.dtype}")
    return flow


def check_all(name: str, condition: str, value: Tensor, test: Callable[[Tensor], Tensor]) -> None:
    """Raise if `test` fails somewhere in `value`, where looking costs no wait for a device.

    On an accelerator, under torch.compile and inside torch.vmap nothing is read: there the result is masked instead.
    """
    if is_true(lambda: test(value).all(), of=value) is False:
        wrong = value.detach()[~test(value.detach())].flatten()
        raise ValueError(f"{name} must {condition}, got {wrong[0].item():g}")


def check_within(name: str, value: Tensor, low: float, high: float) -> None:
    """Raise unless all of `value` lies in [low, high], but for rounding, where looking costs no wait for a device."""
    room = 1e-5
    ends = low - room * abs(low), high + room * abs(high)
    check_all(name, f"lie in [{low:g}, {high:g}]", value, lambda v: (v >= ends[0]) & (v <= ends[1]))


def is_whole(value: Tensor) -> bool:
    """Whether a tensor is of a type of whole numbers; flags are none."""
    return not (value.is_floating_point() or value.is_complex() or value.dtype is torch.bool)


def is_true(predicate: Callable[[], Tensor], *, of: Tensor | None = None) -> bool | None:
    """The truth of a one-element tensor, or None where reading it would wait for a device or break a graph.

    `of`: as for `read`.
    """
    values = read(predicate, of=of)
    return None if values is None else bool(values)


def or_else(value: Tensor, otherwise: float) -> Tensor:
    """The value, and another one where it is not finite: what may not be read cannot be refused."""
    return value.nan_to_num(nan=otherwise, posinf=otherwise, neginf=otherwise)


def learns(values: Iterable[Any]) -> bool:
    """Whether a gradient of one of the values is asked for: tensors, or what has a `requires_grad` as they do."""
    return torch.is_grad_enabled() and any(value.requires_grad for value in values)


def read(tensor: Callable[[], Tensor], *, of: Tensor | None = None) -> Any:
    """The values of a tensor as a number or nested lists, or None where reading them would wait for a device.

    `of`: what it is computed from, so that on a device it is not even computed.
    """
    if torch.compiler.is_compiling() or (of is not None and of.device.type != "cpu"):
        return None
    value = tensor()
    if value.device.type != "cpu":
        return None
    try:
        return value.tolist()
    except RuntimeError:  # inside torch.vmap no sample has values of its own
        return None


def withheld(value: Tensor) -> str | None:
    """Why the numbers of a tensor are not there for what is not of PyTorch, None where they are."""
    if torch.compiler.is_compiling():
        return "under torch.compile"
    if torch.jit.is_tracing():
        return "under torch.jit.trace"
    if value.device.type != "cpu":
        return f"on {value.device.type}"
    if forward_ad.unpack_dual(value).tangent is not None:
        return "where a forward gradient is asked for"
    try:
        value.detach().numpy()
    except RuntimeError:
        return "inside torch.func"
    return None


def _check_real(name: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | numbers.Real):
        raise TypeError(f"{name} must be a real number, got {value!r}")
    if math.isnan(value):
        raise ValueError(f"{name} must not be NaN, got {value}")
    # Small types of numpy cannot be compared with large bounds.
    return value if isinstance(value, int | float) else float(value)


def _bounds(low: float, high: float) -> str:
    """`in [low, high]`, without those that are no bounds at all."""
    if high == _LARGEST:
        return "that is finite" if low == -_LARGEST else f"of at least {low:g}"
    return f"of at most {high:g}" if low == -_LARGEST else f"in [{low:g}, {high:g}]"
