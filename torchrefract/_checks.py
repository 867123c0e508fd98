"""Argument checks, in one form: `<argument> must <condition>, got <value>`."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrefract.types import Range


def check_number(name: str, value: float, *, low: float = -math.inf, high: float = math.inf) -> float:
    """`value` as a float in [low, high]; NaN never is, and infinity only where a bound says so."""
    _check_real(name, value)
    if not low <= value <= high or (math.isinf(value) and value not in (low, high)):
        raise ValueError(f"{name} must be a number in [{low:g}, {high:g}], got {value}")
    return float(value)


def check_range(name: str, value: Sequence[float], *, low: float = -math.inf, high: float = math.inf) -> Range:
    """`value` as (low, high) with both ends finite and inside the bounds."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError(f"{name} must be (low, high), got {value!r}")
    for end in value:
        _check_real(name, end)
    if not low <= value[0] <= value[1] <= high or any(math.isinf(end) and end not in (low, high) for end in value):
        raise ValueError(f"{name} must be (low, high) with {low:g} <= low <= high <= {high:g}, got {tuple(value)}")
    return float(value[0]), float(value[1])  # Hydra hands over its own list type


def check_choice(name: str, value: str, choices: Sequence[str]) -> str:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    return value


def check_count(name: str, value: int, *, low: int = 1) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")
    return value


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
    if is_true(lambda: test(value).all()) is False:
        wrong = value.detach()[~test(value.detach())].flatten()
        raise ValueError(f"{name} must {condition}, got {wrong[0].item():g}")


def is_true(predicate: Callable[[], Tensor]) -> bool | None:
    """The truth of a one-element tensor, or None where reading it would wait for a device or break a graph."""
    if torch.compiler.is_compiling():
        return None
    value = predicate()
    if value.device.type != "cpu":
        return None
    try:
        return bool(value)
    except RuntimeError:  # torch.vmap has no single truth to tell
        return None


def _check_real(name: str, value: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a real number, got {value!r}")
    if math.isnan(value):
        raise ValueError(f"{name} must not be NaN, got {value}")
