"""Which pixels of a road frame show the sky, and whether the frame was taken at night."""

import torch
import torch.nn.functional as F
from torch import Tensor

_LUMA = (0.2126, 0.7152, 0.0722)  # Rec. 709
_NODES = 192  # of the lattice along the longer side: enough for poles, cheap at any resolution
_MAX_RANGE = 0.09  # of the luma within three nodes of smooth sky
_MIN_LUMA = 0.4  # of a bright sky: street light makes clouds at night about half as bright
_MIN_BLUE = 0.03  # excess of blue over red of a blue sky
_SWEEPS = 3


def sky_mask(image: Tensor) -> Tensor:
    """Return the pixels that show the sky: connected to the top row, smooth, and bright or blue.

    A node of a lattice of at most 192 nodes along the longer side is a candidate if the luma of its neighborhood of
    three by three nodes varies by less than 0.09, and if it is brighter than 0.4 and the median of the frame, or bluer
    than red by 0.03. Candidates that are connected to the top row are the sky, if it is brighter than the rest.

    Args:
        image: (N, C, H, W), stored values (sRGB) in [0, 1], or uint8; three channels are red, green and blue, any
            other number has no blue.

    Returns:
        (N, 1, H, W), bool, without a gradient. Each image is judged alone.
    """
    image = image.detach()
    height, width = image.shape[2:]
    stride = max(1, max(height, width) // _NODES)
    nodes = image[:, :, ::stride, ::stride]
    nodes = (nodes.float() / 255 if nodes.dtype is torch.uint8 else nodes.float()).nan_to_num(nan=0.0).clamp(0, 1)
    y = luma(nodes)
    blue = nodes[:, 2:] - nodes[:, :1] if image.shape[1] == 3 else torch.zeros_like(y)
    middle = y.flatten(1).median(dim=1).values.view(-1, 1, 1, 1)
    spread = F.max_pool2d(y, 3, 1, 1) + F.max_pool2d(-y, 3, 1, 1)
    candidate = (spread < _MAX_RANGE) & ((y > middle.clamp(min=_MIN_LUMA)) | (blue > _MIN_BLUE) & (y > _MIN_LUMA / 2))
    sky = _connected_to_top(candidate)
    return sky.repeat_interleave(stride, 2)[:, :, :height].repeat_interleave(stride, 3)[:, :, :, :width]


def luma(image: Tensor) -> Tensor:
    """Return the luma (N, 1, H, W) of images (N, C, H, W): Rec. 709 for three channels, otherwise their mean."""
    if image.shape[1] != 3:
        return image.mean(dim=1, keepdim=True)
    red, green, blue = image.unbind(1)
    return (_LUMA[0] * red + _LUMA[1] * green + _LUMA[2] * blue)[:, None]


def _connected_to_top(candidate: Tensor) -> Tensor:
    """Return the part of a mask (N, 1, H, W) that a few sweeps along rows and columns reach from its top row."""
    reached = candidate.clone()
    reached[:, :, 1:] = False
    for _ in range(_SWEEPS):
        for dim in (2, 3):
            reached = _sweep(reached, candidate, dim) | _sweep(reached.flip(dim), candidate.flip(dim), dim).flip(dim)
    return reached


def _sweep(reached: Tensor, candidate: Tensor, dim: int) -> Tensor:
    """Spread a mask along a dimension, from lower to higher indices, as far as candidates go without a gap."""
    index = torch.arange(1, candidate.shape[dim] + 1, device=candidate.device)
    index = index.view([-1 if i == dim else 1 for i in range(4)])
    latest_reached = (index * reached).cummax(dim).values
    latest_gap = (index * ~candidate).cummax(dim).values
    return latest_reached > latest_gap
