"""An image, and a flow, of one size of a frame for another size of it."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, exact_matmul
from torchrefract._validation import check_count, check_flow, check_tensor

_GHOSTS = 2  # nodes beyond each border that a cubic may take


def resize_image(image: Tensor, size: Sequence[int]) -> Tensor:
    """An image of the same frame in another size.

    Along an axis that becomes shorter, each pixel is the mean of those that it covers, those at its border by the share
    covered; along the other, Keys' cubics with a = -1/2 lie between pixels, clamped to the range of the image's values.

    Args:
        image: (B, C, H, W), floating.
        size: (H', W'), px.

    Returns:
        (B, C, H', W').
    """
    if check_tensor("image", image).ndim != 4 or not image.is_floating_point():
        raise ValueError(f"image must be (B, C, H, W) of floats, got {tuple(image.shape)} of {image.dtype}")
    new = [check_count("size", side) for side in size]
    down, across = (
        _cover(old, side, like=image) if side <= old else _weights(old, side, like=image)
        for old, side in zip(image.shape[2:], new, strict=True)
    )
    resized = exact_matmul(down, exact_matmul(image, across.mT))
    return resized.clamp(image.amin(dim=(2, 3), keepdim=True), image.amax(dim=(2, 3), keepdim=True))


def resize_flow(flow: Tensor, size: Sequence[int]) -> Tensor:
    """A flow for the same frame in another size.

        out(x', y') = (u W'/W, v H'/H)(x, y),  x = (x' + 1/2) W/W' - 1/2,  y likewise with H

    Between pixels by Keys' cubics with a = -1/2, with lines beyond the borders: what is linear in x and y comes out as
    it is.

    Args:
        flow: (B, 2, H, W), px, u and v.
        size: (H', W'), px.

    Returns:
        (B, 2, H', W'), px of that size.

    Source: Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 29 (1981).
    """
    check_flow("flow", flow)
    height, width = (check_count("size", side) for side in size)
    H, W = flow.shape[2:]
    down, across = (_weights(old, new, like=flow) for old, new in ((H, height), (W, width)))
    scale = as_device_tensor([width / W, height / H], dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)
    return exact_matmul(down, exact_matmul(flow, across.mT)) * scale


def _cover(old: int, new: int, *, like: Tensor) -> Tensor:
    """(new, old): the share of each of `new` pixels along an axis that each of `old` ones covers."""
    edges = torch.arange(new + 1, dtype=torch.float64, device=like.device)[:, None] * (old / new)
    reach = (edges - torch.arange(old, dtype=torch.float64, device=like.device)).clamp(0, 1)
    return ((reach[1:] - reach[:-1]) * (new / old)).to(like.dtype)


def _weights(old: int, new: int, *, like: Tensor) -> Tensor:
    """(new, old): what each of `old` pixels adds to each of `new` ones along an axis."""
    places = (torch.arange(new, dtype=torch.float64, device=like.device) + 0.5) * (old / new) - 0.5
    nodes = torch.arange(-_GHOSTS, old + _GHOSTS, dtype=torch.float64, device=like.device)
    weight = _keys(places[:, None] - nodes)
    own = weight[:, _GHOSTS:-_GHOSTS].clone()
    for k in range(1, _GHOSTS + 1):
        # The ghost k px beyond the border pixel f_0 is f_0 + k (f_0 - f_1), so on the line through both.
        slope = k if old > 1 else 0
        for ghost, edge, inner in ((_GHOSTS - k, 0, min(1, old - 1)), (-_GHOSTS - 1 + k, old - 1, max(0, old - 2))):
            own[:, edge] += (1 + slope) * weight[:, ghost]
            own[:, inner] -= slope * weight[:, ghost]
    return own.to(like.dtype)


def _keys(t: Tensor) -> Tensor:
    """Keys' cubic, a = -1/2, at distances in px."""
    t = t.abs()
    near, far = (1.5 * t - 2.5) * t * t + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return torch.where(t < 1, near, F.relu(2 - t).sign() * far)
