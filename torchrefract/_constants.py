"""Numbers that the code knows, on the device that needs them, and functions whose results compilers may keep."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

_F = TypeVar("_F", bound=Callable[..., Any])


def constant(values: Any, *, dtype: torch.dtype | None = None, device: torch.device) -> Tensor:
    """A tensor of numbers or nested lists of them; no device is waited for, as it is by `torch.tensor`."""
    return torch.tensor(values, dtype=dtype).to(device, non_blocking=True)


def assume_constant_result(function: _F) -> _F:
    """What `torch.compiler.assume_constant_result` does, without importing the compiler.

    By `python -X importtime` that takes nearly as long as torch itself, and most processes never compile.
    """
    vars(function)["_dynamo_marked_constant"] = True
    return function
