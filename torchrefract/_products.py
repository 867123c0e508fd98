"""Products of matrices in all digits of their type."""

from typing import Any

import torch
from torch import Tensor

from torchrefract._constants import assume_constant_result


def product(left: Tensor, right: Tensor) -> Tensor:
    """left @ right, (..., n, m) of (..., n, k) and (..., k, m), as exact as its type.

    Trainings tell PyTorch to round factors to 10 bits or fewer (`torch.set_float32_matmul_precision`), which moves a
    position by up to 1/1000 of a frame. Where that is told, float32 goes through float64.
    """
    if left.dtype is torch.float32 and _rounds_factors(left.device.type):
        return torch.matmul(left.double(), right.double()).float()
    return torch.matmul(left, right)


@assume_constant_result
def _rounds_factors(device: str) -> bool:
    backends: Any = torch.backends
    told = getattr(
        getattr(backends.mkldnn if device == "cpu" else backends.cuda, "matmul", None), "fp32_precision", None
    )
    if told is None:  # before PyTorch 2.9
        return torch.get_float32_matmul_precision() != "highest"
    return (backends.fp32_precision if told == "none" else told) not in ("none", "ieee")
