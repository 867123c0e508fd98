"""Pixels and the sampler's coordinates: the one place that knows both."""

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import eager_bool, eager_values

if TYPE_CHECKING:
    from torchrefract.warping.lattice import Lattice

# F.grid_sample spans [-1, 1]; four of these lie well outside whatever the padding, and keep every product finite.
FAR = 4.0
# Positions this near to the border pixels count as inside: rounding of fp32 coordinates, 1/1000 px.
_TOLERANCE = 1e-3
_HALF = torch.tensor(-0.5, dtype=torch.float32, device="cpu")


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


class Positions(NamedTuple):
    """Where F.grid_sample(align_corners=False) looks, finite."""

    grid: Tensor  # (B, H, W, 2)

    @property
    def dtype(self) -> torch.dtype:
        """Of the grid."""
        return self.grid.dtype

    @property
    def requires_grad(self) -> bool:
        """Whether the grid has a gradient."""
        return self.grid.requires_grad

    def detach(self) -> "Positions":
        """The same without its gradient."""
        return Positions(self.grid.detach())


def field_dtype(dtype: torch.dtype) -> torch.dtype:
    """The type that coordinates have beside an image of `dtype`: float32, or float64 where float32 loses digits."""
    return torch.float64 if dtype in (torch.float64, torch.int32, torch.int64) else torch.float32


def pixel_axes(height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """x, (1, 1, 1, W), and y, (1, 1, H, 1), px: the pixel centers, whole numbers."""
    x = torch.arange(width, dtype=dtype, device=device).view(1, 1, 1, width)
    return x, torch.arange(height, dtype=dtype, device=device).view(1, 1, height, 1)


def inside(flow: Tensor) -> Tensor:
    """(B, 1, H, W), bool: where p + flow(p) lies on the frame; NaN does not."""
    height, width = flow.shape[2:]
    x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    u, v = flow.detach().split(1, dim=1)
    # Distances from the middle, since comparisons are slow.
    half_x, half_y = (width - 1) / 2, (height - 1) / 2
    x, y = x - half_x, y - half_y

    def at(rows: slice, columns: slice) -> Tensor:
        on_x = (x[..., columns] + u[..., rows, columns]).abs() <= half_x + _TOLERANCE
        return on_x & ((y[..., rows, :] + v[..., rows, columns]).abs() <= half_y + _TOLERANCE)

    return near_border(flow, 1, at)


def near_border(flow: Tensor, depth: int, at: Callable[[slice, slice], Tensor]) -> Tensor:
    """(B, 1, H, W), bool: `at` where flow leads to the border, and true where it does not.

    Args:
        flow: (B, 2, H, W), px.
        depth: px, how far from the border p + flow(p) is for `at` to be true.
        at: from rows and columns of the frame to (B, 1, n, m), bool.
    """
    (height, width), everywhere = flow.shape[2:], slice(None)
    farthest = (
        eager_values(lambda: torch.stack(flow.detach().aminmax()).abs().amax(), of=flow) if flow.numel() else None
    )
    if farthest is None or not farthest < min(height, width):  # nor is NaN
        return at(everywhere, everywhere)
    depth += math.ceil(farthest)
    # Narrow strips take longer than they are large.
    if 6 * depth >= min(height, width):
        return at(everywhere, everywhere)
    found = torch.ones_like(flow[:, :1], dtype=torch.bool)
    top, middle, bottom = slice(0, depth), slice(depth, height - depth), slice(height - depth, height)
    sides = slice(0, depth), slice(width - depth, width)
    for rows, columns in ((top, everywhere), (bottom, everywhere), (middle, sides[0]), (middle, sides[1])):
        found[..., rows, columns] = at(rows, columns)
    return found


def length(flow: Tensor) -> Tensor:
    """(B, 1, H, W), px: sqrt(u^2 + v^2), without gradient, and to the same bits in any batch, as `norm` is not."""
    return squared_length(*flow.detach().split(1, dim=1)).sqrt()


def squared_length(u: Tensor, v: Tensor) -> Tensor:
    """(B, 1, H, W), px^2: u^2 + v^2."""
    return torch.addcmul(u * u, v, v)


def sampler_grid(flow: Tensor) -> Tensor:
    """(B, H, W, 2): the positions p + flow(p) as F.grid_sample(align_corners=False) wants them, finite in any case.

    Those of `sampler_positions`, within [-4, 4].
    """
    return next(sampler_grids(flow, rows=flow.shape[2]))


def sampler_grids(flow: Tensor, *, rows: int) -> Iterator[Tensor]:
    """The grid of `sampler_grid`, in bands of so many rows."""
    height, width = flow.shape[2:]
    x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    for band, middle in zip(flow.split(max(1, rows), dim=2), y.split(max(1, rows), dim=2), strict=True):
        yield sampler_grid_at(band, x, middle, height=height, width=width)


def sampler_grid_at(flow: Tensor, x: Tensor, y: Tensor, *, height: int, width: int) -> Tensor:
    """(B, n, m, 2): the grid of `sampler_grid` for part of a frame; arguments as for `sampler_positions`."""
    return finite(sampler_positions(flow, x, y, height=height, width=width), FAR).movedim(1, -1)


def sampler_positions(flow: Tensor, x: Tensor, y: Tensor, *, height: int, width: int) -> Tensor:
    """(B, 2, n, m): the positions p + flow(p) in the coordinates of F.grid_sample.

        x' = (2 x + 1) / W - 1 + 2 u / W,  y' likewise with v and H

    Args:
        flow: (B, 2, n, m), px.
        x, y: (1, 1, 1, m) and (1, 1, n, 1), px, where the flow is.
        height, width: px, of the frame.
    """
    x, y = sampler_axes(x, y, height=height, width=width)
    u, v = flow.split(1, dim=1)
    return torch.cat([x + u * (2 / width), y + v * (2 / height)], dim=1)


def sampler_axes(x: Tensor, y: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Positions in px in the coordinates of F.grid_sample; arguments as for `sampler_positions`."""
    # A pixel center sits at (i + 1/2) / n of the width, so an image of one pixel is no special case.
    return (2 * x + 1) / width - 1, (2 * y + 1) / height - 1


def pixel_positions(grid: Tensor, *, height: int, width: int, out: Tensor) -> Tensor:
    """(2, n, m), px: x and y where F.grid_sample looks on the CPU, float32, by its own steps and so to its bits.

        x = (x' + 1) W / 2 - 1/2, rounded after x' + 1 and at the end,  y likewise with H

    Args:
        grid: (n, m, 2), as of `sampler_grid`.
        height, width: px, of the frame.
        out: (2, n, m), where they are written.
    """
    for place, into, size in zip(grid.unbind(-1), out, (width, height), strict=True):
        # Product and difference are one fused operation in the sampler, and with `alpha` they are one here.
        torch.add(_HALF, torch.add(place, 1, out=into), alpha=size / 2, out=into)
    return out


def mirror(place: np.ndarray, size: int) -> None:
    """Reflect positions, px, float32, about the borders of so many pixels, in place, to the bits of F.grid_sample."""
    # In numpy, whose operations wake no threads that would stand in the way of those of the look-up.
    half, length, period = np.float32(0.5), np.float32(size), np.float32(2 * size)
    place += half  # where nothing is reflected this rounds, too
    np.abs(place, out=place)
    if not (farthest := place.max(initial=0)) <= length:
        if not farthest < period:
            place -= np.trunc(place / period) * period
        np.minimum(place, period - place, out=place)
    place -= half


def finite(positions: Tensor, limit: float) -> Tensor:
    """The positions within a limit; what is no number lies there."""
    # One NaN in a grid with border padding ends the process in the sampler's backward.
    if positions.numel() == 0 or eager_bool(
        lambda: torch.stack(positions.aminmax()).abs().amax() <= limit, of=positions
    ):
        return positions
    return positions.nan_to_num(nan=limit, posinf=limit, neginf=-limit).clamp(-limit, limit)
