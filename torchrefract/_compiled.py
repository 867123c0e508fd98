"""Where numba's kernels stand in for PyTorch's operations: on the CPU, in float32, once a frame is worth their call."""

import importlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import why_not_eager

# Below so many pixels a call costs more than it brings.
SMALLEST = 1 << 14


def obstacle(*values: Tensor) -> str | None:
    """Why no kernel can read the tensors, None where one can."""
    for value in values:
        if value.dtype is not torch.float32:
            return f"for numbers that are {value.dtype}"
        if why := why_not_eager(value):
            return why
    return None if kernels("_jit") else "without numba (pip install 'torchrefract[fast]')"


def of_batch(values: Tensor) -> tuple[Tensor, np.ndarray]:
    """Those of values (B, ...) that differ, and which of them each row of the batch has."""
    rows = np.arange(len(values))
    if len(values) > 1 and values.stride(0) == 0:  # one for all, as that of the frames of a clip
        return values[:1].contiguous(), np.zeros_like(rows)
    return values.contiguous(), rows


@cache
def kernels(name: str) -> Any:
    """One of the modules that numba compiles, None where it is missing or does not fit what else is installed."""
    # By name: numba may be missing, and takes its time.
    try:
        return importlib.import_module(f"torchrefract.{name}")
    except ImportError:
        return None


def with_gradients(kernel: Callable[..., Tensor], plain: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """kernel(*inputs), with the gradients that plain(*inputs), the same in PyTorch's operations, has."""
    return _ByKernel.apply(kernel, plain, *inputs)


class _ByKernel(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernel: Callable[..., Tensor], plain: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
        ctx.plain = plain
        ctx.save_for_backward(*inputs)
        return kernel(*(value.detach() for value in inputs))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return None, None, *gradients_of(ctx.plain, ctx.saved_tensors, ctx.needs_input_grad[2:], gradients[0])


def gradients_of(plain: Callable[..., Tensor], inputs: Any, needed: Any, gradient: Tensor) -> list[Tensor | None]:
    """Those of the inputs of plain(*inputs) that are needed, differentiable where a backward pass is to be."""
    again = torch.is_grad_enabled()
    with torch.enable_grad():
        # One input may come of another: each counts by itself, and what comes before them is not gone through.
        inputs = [value.view_as(value) if asked else value for value, asked in zip(inputs, needed, strict=True)]
        wanted = [value for value, asked in zip(inputs, needed, strict=True) if asked]
        found = iter(torch.autograd.grad(plain(*inputs), wanted, gradient, create_graph=again))
    return [next(found) if asked else None for asked in needed]
