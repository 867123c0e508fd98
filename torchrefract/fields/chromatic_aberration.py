"""Lateral chromatic aberration: a lens shows each color at a size of its own."""

from typing import Any

import torch
from torch import Tensor

from torchrefract.warping.lattice import Lattice, LatticeFlow
from torchrefract.warping.warp import sample_image

_STRIDE = 64  # px; cubics between nodes are exact for a flow that is linear


def scale_about(scale: Tensor, center: tuple[float, float], *, height: int, width: int) -> LatticeFlow:
    """Return the flow of an image that is enlarged about a center: flow(p) = -s / (1 + s) (p - c).

    Args:
        scale: (N,), s, relative, above -1; the image is enlarged by 1 + s.
        center: px, c.
        height, width: px.
    """
    lattice = Lattice(height, width, _STRIDE)
    points = lattice.points(dtype=scale.dtype, device=scale.device)
    share = (-scale / (1 + scale)).view(-1, 1, 1, 1)
    u, v = share * (points.x - center[0]), share * (points.y - center[1])
    return LatticeFlow(torch.cat(torch.broadcast_tensors(u, v), dim=1), lattice)


def shift_colors(image: Tensor, first: LatticeFlow, last: LatticeFlow, *, interpolation: str) -> Tensor:
    """Sample the first channel of images along one flow and the last one along another; the others stay.

    Args:
        image: (N, C, H, W).
        first, last: of N rows.
        interpolation: as for `warp`. Outside the frame its border pixels count.

    Returns:
        (N, C, H, W); an image of one channel as it is.
    """
    if image.shape[1] == 1:
        return image
    options: dict[str, Any] = {"padding": "border", "interpolation": interpolation}
    red, blue = (
        sample_image(image[:, k : k + 1], flow, **options) for k, flow in ((0, first), (image.shape[1] - 1, last))
    )
    return torch.cat([red, image[:, 1:-1], blue], dim=1)
