"""Systems of linear equations whose solutions have the same bits in any batch and on any number of PyTorch's threads.

Those of `torch.linalg.solve` depend on where a matrix lies in memory, on the processor and on the threads.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import requires_grad, why_not_eager


def solve(system: Tensor, right: Tensor) -> Tensor:
    """x with A x = b, (B, n, m), of A (B, n, n) and b (B, n, m); NaN where A is singular.

    By NumPy on the CPU; elsewhere and under compilers, which have no such promise to keep, by PyTorch.
    """
    if system.device.type != "cpu" or torch.compiler.is_compiling():
        # solve_ex raises nothing, and so waits for no device.
        return torch.linalg.solve_ex(system, right)[0]
    if not (requires_grad((system, right)) or why_not_eager(system) or why_not_eager(right)):
        return torch.from_numpy(_solved(system.numpy(), right.numpy()))
    return _Solve.apply(system, right)


class _Solve(torch.autograd.Function):
    """For a gradient g of x, that of b is A^-T g, and that of A is minus this times x^T."""

    @staticmethod
    def forward(system: Tensor, right: Tensor) -> Tensor:
        return torch.from_numpy(_solved(system.numpy(), right.numpy()))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, Tensor]:
        system, solution = ctx.saved_tensors
        by_right = _Solve.apply(system.mT, slopes[0])
        return -(by_right.unsqueeze(-2) * solution.unsqueeze(-3)).sum(dim=-1), by_right

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, int | None], *values: Tensor) -> tuple[Tensor, int]:
        mapped = (
            value.expand(info.batch_size, *value.shape) if dim is None else value.movedim(dim, 0)
            for value, dim in zip(values, in_dims, strict=True)
        )
        return _Solve.apply(*mapped), 0


def _solved(system: np.ndarray, right: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.solve(system, right)
    except np.linalg.LinAlgError:  # of all, if one is singular
        if system.ndim == 2:
            return np.full_like(right, np.nan)
        return np.stack([_solved(*one) for one in zip(system, right, strict=True)])
