"""Checks of arguments. Messages have one form: `<argument> must <condition>, got <value>`."""

import math
import numbers
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract.types import Range

_LARGEST = sys.float_info.max
# The folders of torchrefract, and of PyTorch and of torchvision beside it.
_LIBRARIES = str(Path(__file__).parent) + os.sep, str(Path(torch.__file__).parent)
_SHOWN = 3  # examples in a message


class UsageError(Exception):
    """An error of a command that the user can fix; the message says how."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line that led here, outside of torchrefract and of PyTorch and torchvision, which call effects."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_LIBRARIES):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def check_number(name: str, value: float, *, low: float = -_LARGEST, high: float = _LARGEST) -> float:
    """Return `value` as a float in [low, high]. NaN is never accepted, infinity only as a bound."""
    value = _check_real(name, value)
    if not low <= value <= high:
        raise ValueError(f"{name} must be a number {_bounds(low, high)}, got {value}")
    return float(value)


def check_positive(name: str, value: float) -> float:
    """Return `value` as a finite float above 0."""
    if check_number(name, value) <= 0:
        raise ValueError(f"{name} must be above 0, got {value}")
    return float(value)


def check_range(name: str, value: Sequence[float], *, low: float = -_LARGEST, high: float = _LARGEST) -> Range:
    """Return `value` as (low, high) with both ends inside the bounds."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError(f"{name} must be (low, high), got {value!r}")
    first, last = (_check_real(name, end) for end in value)  # Hydra passes its own list type
    if not low <= first <= last <= high:
        raise ValueError(f"{name} must be (low, high), low <= high, each {_bounds(low, high)}, got {tuple(value)}")
    return float(first), float(last)


def check_flag(name: str, value: bool) -> bool:
    """Return `value` if it is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return value


def check_choice(name: str, value: str, choices: Sequence[str]) -> str:
    """Return `value` if it is one of the choices."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    return value


def check_count(name: str, value: int, *, low: int = 1) -> int:
    """Return `value` as an integer of at least `low`."""
    value = check_whole(name, value)
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")
    return value


def check_whole(name: str, value: int) -> int:
    """Return `value` as an int. NumPy integers are accepted, booleans are not."""
    # torch.compile knows int and does not trace numbers.Integral.
    if isinstance(value, bool) or not isinstance(value, int | numbers.Integral):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    return value if isinstance(value, int) else int(value)


def check_size(name: str, size: Sequence[int]) -> tuple[int, int]:
    """Return `size` as (height, width), two integers of at least 1."""
    if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
        raise ValueError(f"{name} must be (height, width), got {size!r}")
    return check_count(name, size[0]), check_count(name, size[1])


def check_color(name: str, color: float | Sequence[float], *, high: float) -> tuple[float, ...]:
    """Return a color of one number or several, each in [0, high]."""
    values = color if isinstance(color, Sequence) else [color]
    if not values:
        raise ValueError(f"{name} must have at least one number, got none")
    return tuple(check_number(name, value, low=0.0, high=high) for value in values)


def first_names(names: Sequence[str]) -> str:
    """Join the first names and the number of the others, for a message."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def type_name(value: object) -> str:
    """Return the name of a value's type, for a message; "the class X" for a class in the place of an instance."""
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def check_tensor(name: str, value: Tensor) -> Tensor:
    """Return `value` if it is a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    return value


def check_rgb(name: str, image: Tensor) -> Tensor:
    """Return `image` if it is a floating tensor (B, 3, H, W)."""
    if check_tensor(name, image).ndim != 4 or image.shape[1] != 3:
        raise ValueError(f"{name} must have shape (B, 3, H, W), got {tuple(image.shape)}")
    if not image.is_floating_point():
        raise TypeError(f"{name} must be floating in [0, 1], got {image.dtype}; use images.float() / 255 for uint8")
    return image


def check_flow(name: str, flow: Tensor) -> Tensor:
    """Return `flow` if it is a floating tensor (B, 2, H, W)."""
    return check_map(name, flow, channels=2)


def check_map(name: str, value: Tensor, *, channels: int) -> Tensor:
    """Return `value` if it is a floating tensor (B, channels, H, W)."""
    if check_tensor(name, value).ndim != 4 or value.shape[1] != channels:
        raise ValueError(f"{name} must have shape (B, {channels}, H, W), got {tuple(value.shape)}")
    if not value.is_floating_point():
        raise TypeError(f"{name} must be of a floating type, got {value.dtype}")
    return value


def check_values(name: str, condition: str, value: Tensor, test: Callable[[Tensor], Tensor]) -> None:
    """Raise ValueError if `test` fails for an element of `value` that can be read without waiting for a device.

    On an accelerator, under `torch.compile` and inside `torch.vmap` nothing is read; the effects mask the result there.
    """
    if eager_values(lambda: test(value).all(), of=value) is False:
        wrong = value.detach()[~test(value.detach())].flatten()
        raise ValueError(f"{name} must {condition}, got {wrong[0].item():g}")


def check_within(name: str, value: Tensor, low: float, high: float) -> None:
    """Raise ValueError unless all elements lie in [low, high], up to rounding; see `check_values`."""
    margin = 1e-5
    lowest, highest = low - margin * abs(low), high + margin * abs(high)
    check_values(name, f"lie in [{low:g}, {high:g}]", value, lambda v: (v >= lowest) & (v <= highest))


def is_whole(value: Tensor) -> bool:
    """Return True if the tensor has an integer type; bool does not count."""
    return not (value.is_floating_point() or value.is_complex() or value.dtype is torch.bool)


def eager_values(tensor: Callable[[], Tensor], *, of: Tensor | None = None) -> Any:
    """Return the value of a tensor, a bool, a number or nested lists, or None if reading it would wait for a device.

    Args:
        tensor: computes the tensor.
        of: a tensor that the result depends on; if it is on an accelerator, `tensor` is not called.
    """
    if torch.compiler.is_compiling() or (of is not None and of.device.type != "cpu"):
        return None
    value = tensor()
    if value.device.type != "cpu":
        return None
    try:
        return value.tolist()
    except RuntimeError:  # inside torch.vmap a sample has no values of its own
        return None


def finite_or(value: Tensor, default: float) -> Tensor:
    """Replace NaN and infinite elements, for tensors whose values cannot be checked."""
    return value.nan_to_num(nan=default, posinf=default, neginf=default)


def bounded(value: Tensor, low: float, high: float) -> Tensor:
    """Clamp values to a range, and replace NaN and infinity by 0, for tensors whose values cannot be checked.

    The clamp leaves a margin, since at the very end of the range it would have no gradient.
    """
    return finite_or(value, 0.0).clamp(low - 1e-3 * abs(low) - 1e-6, high + 1e-3 * abs(high))


def requires_grad(values: Iterable[Any]) -> bool:
    """Return True if a derivative with respect to one of the tensors may be asked for, in reverse or forward mode.

    Inside torch.func it is always True, since a tensor does not show the transforms outside of the innermost one.
    """
    if torch._C._are_functorch_transforms_active():
        return True
    is_enabled = torch.is_grad_enabled()
    for value in values:
        if isinstance(value, tuple):
            if requires_grad(value):
                return True
        elif isinstance(value, Tensor) and (
            (is_enabled and value.requires_grad) or forward_ad.unpack_dual(value).tangent is not None
        ):
            return True
    return False


def why_not_eager(value: Tensor) -> str | None:
    """Say why the memory of a tensor cannot be read outside of PyTorch; None if it can."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return "under torch.compile" if torch.compiler.is_compiling() else "under torch.jit.trace"
    if value.device.type != "cpu":
        return f"on {value.device.type}"
    is_in_func = torch._C._are_functorch_transforms_active()
    if not is_in_func and forward_ad.unpack_dual(value).tangent is not None:
        return "with forward-mode gradients"
    if not _has_memory(value):
        return "without memory of its own, as a FakeTensor"
    return "inside torch.func" if is_in_func else None


def _has_memory(value: Tensor) -> bool:
    if type(value).__torch_dispatch__ is not Tensor.__torch_dispatch__:  # pyright: ignore[reportAttributeAccessIssue]  # torch names it so
        return False
    try:
        value.detach().data_ptr()
    except RuntimeError:
        return False
    return True


def _check_real(name: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | numbers.Real):
        raise TypeError(f"{name} must be a real number, got {value!r}")
    # math.isnan breaks a graph in which torch.compile makes symbols of numbers that differ from an earlier effect's.
    if not -math.inf <= value <= math.inf:
        raise ValueError(f"{name} must not be NaN, got {value}")
    # Small NumPy types cannot be compared with large bounds.
    return value if isinstance(value, int | float) else float(value)


def _bounds(low: float, high: float) -> str:
    if high == _LARGEST:
        return "that is finite" if low == -_LARGEST else f"of at least {low:g}"
    return f"of at most {high:g}" if low == -_LARGEST else f"in [{low:g}, {high:g}]"
