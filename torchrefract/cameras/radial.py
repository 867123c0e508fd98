"""The radial part of a lens, and how far out it can be inverted."""

from typing import NamedTuple

import torch
from torch import Tensor

_NODES = 2048


class RadialLimit(NamedTuple):
    """How far out the radial part of a lens can be inverted, and a table of its inverse.

    radius: (B, 1, ...), the largest radius before distortion, on the plane z = 1.
    image_radius: (B, 1, ...), the largest radius after distortion that the table covers.
    folds: (B,), bool: the radial part stops growing there; otherwise it was only followed so far.
    table: (B, 2049), the radius before distortion at r_d = image_radius (1 - (1 - i / 2048)^2): where the map folds,
        the inverse grows as a square root, and on these nodes it is smooth.
    """

    radius: Tensor
    image_radius: Tensor
    folds: Tensor
    table: Tensor

    def look_up(self, r_d: Tensor) -> Tensor:
        """The radius (B, ...) that the radial part maps to r_d, from the table; `radius` where there is none."""
        place = _NODES * (1 - (1 - r_d / self.image_radius).clamp(min=0).sqrt())
        node = place.long().clamp(0, _NODES - 1)
        flat = node.flatten(1)
        low = self.table.gather(1, flat).view(node.shape)
        high = self.table.gather(1, flat + 1).view(node.shape)
        return torch.lerp(low, high, place - node)


def radial_limit(coefficients: Tensor, reach: Tensor, image_reach: Tensor) -> RadialLimit:
    """The limit of the radial part of (B, 12, ...) coefficients.

    The limit is the first root of d/dr [r (1 + sum k_i r^2i)], found on a lattice that is refined twice.

    Args:
        coefficients: (B, 12, ...).
        reach: (B,), the radius up to which a root is looked for, on the plane z = 1.
        image_reach: (B,), the radius after distortion up to which the inverse is asked for.
    """
    with torch.no_grad():
        k = coefficients.flatten(1)[:, :6, None].unbind(1)
        folds = _falls(reach[:, None] * _steps(reach), k).any(dim=1)
        radius, width = torch.zeros_like(reach), reach
        for _ in range(3):
            first = _falls(radius[:, None] + width[:, None] * _steps(reach), k).long().argmax(dim=1)
            width = width / _NODES
            radius = torch.where(folds, radius + (first - 1).clamp(min=0) * width, reach)
        r, r_d = _lattice(radius, k)
        # Only what is asked for goes into the table, which is finer so.
        last = (r_d < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_NODES)
        r, r_d = _lattice(r.gather(1, last)[:, 0], k)
        image_radius = r_d[:, -1]
        table = _inverse_table(r, r_d)
        shape = (-1,) + (1,) * (coefficients.ndim - 2)
        return RadialLimit(radius.view(shape), image_radius.view(shape), folds, table)


def _falls(r: Tensor, k: tuple[Tensor, ...]) -> Tensor:
    return radial(r * r, k, 6) + 2 * r * r * radial_slope(r * r, k, 6) <= 0


def _lattice(radius: Tensor, k: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    r = radius[:, None] * _steps(radius)
    return r, r * radial(r * r, k, 6)


def _inverse_table(r: Tensor, r_d: Tensor) -> Tensor:
    nodes = r_d[:, -1:] * (1 - (1 - _steps(r[:, 0])).square())
    node = torch.searchsorted(r_d.contiguous(), nodes.contiguous()).clamp(1, _NODES)
    low, high = r_d.gather(1, node - 1), r_d.gather(1, node)
    share = ((nodes - low) / (high - low).clamp(min=torch.finfo(r.dtype).tiny)).clamp(0, 1)
    return torch.lerp(r.gather(1, node - 1), r.gather(1, node), share)


def _steps(like: Tensor) -> Tensor:
    return torch.arange(_NODES + 1, dtype=like.dtype, device=like.device) / _NODES


def radial(r2: Tensor, k: tuple[Tensor, ...], order: int) -> Tensor:
    """1 + sum k_i r^2i."""
    if order == 0:
        return torch.ones_like(r2)
    value = k[order - 1] * r2
    for i in reversed(range(order - 1)):
        value = (k[i] + value) * r2
    return 1 + value


def radial_slope(r2: Tensor, k: tuple[Tensor, ...], order: int) -> Tensor:
    """The derivative of `_radial` with respect to r^2: sum i k_i r^(2i - 2)."""
    if order == 0:
        return torch.zeros_like(r2)
    value = order * k[order - 1]
    for i in reversed(range(order - 1)):
        value = (i + 1) * k[i] + r2 * value
    return value
