"""Numbers that the code knows, on the device that needs them."""

from typing import Any

import torch
from torch import Tensor


def constant(values: Any, *, dtype: torch.dtype | None = None, device: torch.device) -> Tensor:
    """A tensor of numbers or nested lists of them; no device is waited for, as it is by `torch.tensor`."""
    return torch.tensor(values, dtype=dtype).to(device, non_blocking=True)
