"""Looking an image up on a GPU along a flow on a lattice: positions and look-up in one pass, by a kernel of Triton."""

from typing import Any

import torch
from torch import Tensor

from torchrefract._triton import reads
from torchrefract.warping.grid_sample import PADDINGS
from torchrefract.warping.lattice import LatticeFlow

_LARGEST_PLANE = 2**31 - 1  # elements that the kernel counts within a channel
_MOST_PROGRAMS = 65535  # along the batch, and along the rows


def serves(image: Tensor, flow: Any, dtype: torch.dtype) -> bool:
    """Whether the kernel can look an image (B, C, H, W) up along a flow, bilinear, at positions of a type."""
    if image.device.type != "cuda" or not isinstance(flow, LatticeFlow) or dtype is not torch.float32:
        return False
    batch, height = image.shape[0], image.shape[2]
    # A channel of any layout lies within so many elements.
    if image[:1].numel() > _LARGEST_PLANE or max(batch, height) > _MOST_PROGRAMS:
        return False
    return flow.dtype is torch.float32 and reads("warping.gpu_look_up", image, flow.nodes)


def looked_up(source: Tensor, flow: LatticeFlow, *, padding: str, active: Tensor | None = None) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W), bilinear, where the kernel `serves`.

    active: (B,), bool: the other samples come back as they are; None is all.
    """
    shared = len(flow.nodes) > 1 and flow.nodes.stride(0) == 0  # as those of the frames of a clip
    nodes = (flow.nodes[:1] if shared else flow.nodes).to(source.dtype).contiguous()
    across, down = (weight.contiguous() for weight in flow.weights())
    gates = None if active is None else active.to(torch.uint8)
    return torch.ops.torchrefract.look_up_lattice(source, nodes, across, down, gates, PADDINGS.index(padding))
