"""Positions of pixels and of lattice nodes, and where a flow leads."""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchrefract.warping.lattice import Lattice

# Px: float32 coordinates are rounded, so positions this far outside of the border pixels count as inside.
_ROUNDING_PX = 1e-3


class Points(NamedTuple):
    """Hold positions at which a flow is evaluated, px: the nodes of a lattice, displaced or not.

    x, y: (N or 1, 1, h, w); of undisplaced points (1, 1, 1, w) and (1, 1, h, 1).
    lattice: the lattice of the undisplaced points.
    is_displaced: True if a flow was added.
    """

    x: Tensor
    y: Tensor
    lattice: "Lattice"
    is_displaced: bool = False

    def displaced(self, flow: Tensor) -> "Points":
        """Add a flow (N, 2, h, w), px, at the same points."""
        u, v = flow.split(1, dim=1)
        return Points(self.x + u, self.y + v, self.lattice, is_displaced=True)


def field_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the type of flows for an image of `dtype`: float64 for float64, int32 and int64, otherwise float32."""
    return torch.float64 if dtype in (torch.float64, torch.int32, torch.int64) else torch.float32


def pixel_axes(height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the pixel centers, px: x, (1, 1, 1, W), and y, (1, 1, H, 1), integers in a floating type."""
    x = torch.arange(width, dtype=dtype, device=device).view(1, 1, 1, width)
    return x, torch.arange(height, dtype=dtype, device=device).view(1, 1, height, 1)


def inside(flow: Tensor) -> Tensor:
    """Return True where p + flow(p) lies inside of the frame, up to 1/1000 px; NaN does not.

    Args:
        flow: (B, 2, H, W), px.

    Returns:
        (B, 1, H, W), bool.
    """
    height, width = flow.shape[2:]
    x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    u, v = flow.detach().split(1, dim=1)
    # One comparison of the distance from the center is faster than two of the position.
    half_x, half_y = (width - 1) / 2, (height - 1) / 2
    is_inside_x = (u + (x - half_x)).abs_() <= half_x + _ROUNDING_PX
    is_inside_y = (v + (y - half_y)).abs_() <= half_y + _ROUNDING_PX
    return is_inside_x.logical_and_(is_inside_y)


def length(flow: Tensor) -> Tensor:
    """Return sqrt(u^2 + v^2), px, of a flow (B, 2, H, W), as (B, 1, H, W) without gradient."""
    return torch.hypot(*flow.detach().split(1, dim=1))  # squares of invalid flows overflow
