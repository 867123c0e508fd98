"""Where kernels of Triton can stand in for PyTorch's operations: on a GPU, in eager mode and in compiled graphs."""

from importlib import import_module

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # pyright: ignore[reportMissingImports]  # it is of C++, without stubs
from torch.autograd import forward_ad

from torchrefract._tensor import assume_constant_result


def reads(module: str, *values: Tensor) -> bool:
    """Whether the operators of a module, each of them a kernel, can read the tensors."""
    if not all(value.device.type == "cuda" for value in values) or not _is_there(module):
        return False
    if torch.compiler.is_compiling():
        # What this flag says `is_exporting` says of every graph while it is traced.
        return not getattr(torch.compiler, "_is_exporting_flag", False)
    if torch.jit.is_tracing():
        return False
    return not any(
        forward_ad.unpack_dual(value).tangent is not None or is_functorch_wrapped_tensor(value) for value in values
    )


@assume_constant_result
def _is_there(module: str) -> bool:
    # By name: Triton may be missing, and to define operators takes its time.
    try:
        import_module(f"torchrefract.{module}")
    except ImportError:
        return False
    return True
