"""The radial part of a lens, and how far out it can be inverted."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_NODES = 2048
_FARTHEST = 1e3  # on the plane z = 1
_DOUBLINGS = 12  # of the radius after distortion, in search of the radius before it


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

    def sample_image(self, r_d: Tensor) -> Tensor:
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
        radius, folds = first_fall(lambda r: _falls(r, k), reach)
        shape = (-1,) + (1,) * (coefficients.ndim - 2)
        return _tabulated(radius, folds, image_reach, lambda r: r * radial(r * r, k, 6), shape)


def first_fall(falls: Callable[[Tensor], Tensor], reach: Tensor) -> tuple[Tensor, Tensor]:
    """How far from the center a radial part grows, within a reach: on a lattice that is refined twice.

    Args:
        falls: from radii (B, n) to (B, n), bool: it does not grow there.
        reach: (B,), up to which a fall is looked for.

    Returns:
        radius: (B,), before the first fall; the reach where there is none.
        found: (B,), bool: there is one.
    """
    found = falls(reach[:, None] * _steps(reach)).any(dim=1)
    radius, width = torch.zeros_like(reach), reach
    for _ in range(3):
        first = falls(radius[:, None] + width[:, None] * _steps(reach)).long().argmax(dim=1)
        width = width / _NODES
        radius = torch.where(found, radius + (first - 1).clamp(min=0) * width, reach)
    return radius, found


def limit_of_curve(radius: Tensor, image_reach: Tensor, curve: Callable[[Tensor], Tensor]) -> RadialLimit:
    """The limit of any radial part that grows up to a radius that is known.

    Args:
        radius: (B,), up to which it grows; inf where it always does.
        image_reach: (B,), the radius after distortion up to which the inverse is asked for.
        curve: from radii (B, n) before distortion to those after it.

    Returns:
        The limit, each tensor of it with one dimension behind B.
    """
    with torch.no_grad():
        powers = torch.arange(_DOUBLINGS + 1, dtype=radius.dtype, device=radius.device).exp2()
        radii = torch.minimum(image_reach[:, None] * powers, radius[:, None])
        first = (curve(radii) < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_DOUBLINGS)
        reach = radii.gather(1, first)[:, 0]
        limit = _tabulated(reach, reach == radius, image_reach, curve, (-1, 1))
        return limit._replace(radius=radius[:, None])


def reach_of(r_d: Tensor) -> Tensor:
    """(B,), how far a table must reach for radii (B, N) after distortion."""
    none = r_d.new_zeros(r_d.shape[0], 1)
    # What is farther than a lens shows anything must not make the table coarse.
    return 1.1 * torch.cat([none, r_d], dim=1).clamp(max=_FARTHEST).amax(dim=1).clamp(min=1e-3)


def _tabulated(
    radius: Tensor, folds: Tensor, image_reach: Tensor, curve: Callable[[Tensor], Tensor], shape: tuple[int, ...]
) -> RadialLimit:
    r = radius[:, None] * _steps(radius)
    # Only what is asked for goes into the table, which is finer so.
    last = (curve(r) < image_reach[:, None]).sum(dim=1, keepdim=True).clamp(max=_NODES)
    r = r.gather(1, last) * _steps(radius)
    r_d = curve(r)
    image_radius = r_d[:, -1]
    return RadialLimit(radius.view(shape), image_radius.view(shape), folds, _inverse_table(r, r_d))


def _falls(r: Tensor, k: tuple[Tensor, ...]) -> Tensor:
    return radial(r * r, k, 6) + 2 * r * r * radial_slope(r * r, k, 6) <= 0


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
    """The derivative of `radial` with respect to r^2: sum i k_i r^(2i - 2)."""
    if order == 0:
        return torch.zeros_like(r2)
    value = order * k[order - 1]
    for i in reversed(range(order - 1)):
        value = (i + 1) * k[i] + r2 * value
    return value
