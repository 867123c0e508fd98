"""Where kernels of Triton can stand in for PyTorch's operations: on a GPU, in eager mode and in compiled graphs."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # pyright: ignore[reportMissingImports]  # of C++
from torch.autograd import forward_ad

from torchrefract._constants import assume_constant_result


def reads(*values: Tensor) -> bool:
    """Whether kernels can read the tensors."""
    if not all(value.device.type == "cuda" for value in values) or not _is_there():
        return False
    if torch.compiler.is_compiling():
        # What this flag says `is_exporting` says of every graph while it is traced.
        return not getattr(torch.compiler, "_is_exporting_flag", False)
    if torch.jit.is_tracing():
        return False
    return not any(
        forward_ad.unpack_dual(value).tangent is not None or is_functorch_wrapped_tensor(value) for value in values
    )


def launched(module: str, kernel: str) -> Any:
    """A kernel of one of the modules that Triton compiles, as operators of `torch.library.triton_op` launch it."""
    # By name: Triton may be missing, and takes its time.
    return torch.library.wrap_triton(getattr(import_module(f"torchrefract.{module}"), kernel))


@assume_constant_result
def _is_there() -> bool:
    return find_spec("triton") is not None
