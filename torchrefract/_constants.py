"""Numbers that the code knows, on the device that needs them, and functions whose results are kept."""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, TypeVar, cast

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


def kept(function: _F) -> _F:
    """The function, whose latest results on the CPU are kept: tensors that nobody writes to, of arguments with a hash.

    Its last argument is the device.
    """

    @lru_cache(maxsize=16)
    def once(*args: Any) -> Any:
        # Tensors made in inference mode could not be used outside of it.
        with torch.inference_mode(False), torch.no_grad():
            return function(*args)

    @wraps(function)
    def result(*args: Any) -> Any:
        return (function if torch.compiler.is_compiling() or args[-1].type != "cpu" else once)(*args)

    return cast(_F, result)
