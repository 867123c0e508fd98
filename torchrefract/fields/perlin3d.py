"""Perlin noise in space, where the rays of a camera cross planes ahead of it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor, exact_matmul

# Of the noise below, over all gradients and all places in a cell: each of the 8 nodes adds a third of the mean of
# (h(p) h(q) h(r))^2 (p^2 + q^2 + r^2); the mean of h^2 is 181 / 462, that of (h p)^2 is 535 / 18018.
VARIANCE = 8 * (181 / 462) ** 2 * (535 / 18018)
# 1 / r, 1 / r^2 and 1 / r^3, r^4 = r + 1: no two multiples of them come near to each other, modulo 1, before many
# others have.
PHASES = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
# Two numbers are made of one of 23 bits: the upper 11, and the others.
_UPPER = 2048
# Nodes are numbered modulo 2^32, so many to a line: what returns so far away is out of sight. Octaves are far apart,
# by the golden section of the planes.
LINE = 2048
OCTAVE = 633


class Rays(NamedTuple):
    """The rays from the camera through the points (left + j step_x, top + i step_y) of the plane z = 1."""

    left: float
    step_x: float
    columns: int
    top: float
    step_y: float
    rows: int

    def slopes(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """x / z, (columns,), and y / z, (rows,), float64."""
        j = torch.arange(self.columns, dtype=torch.float64, device=device)
        i = torch.arange(self.rows, dtype=torch.float64, device=device)
        return self.left + self.step_x * j, self.top + self.step_y * i

    def box(self, depth: float) -> list[tuple[float, float]]:
        """(low, high) in x, y and z of what the rays cross from the camera up to a depth."""
        right, bottom = self.left + self.step_x * (self.columns - 1), self.top + self.step_y * (self.rows - 1)
        ends = ((self.left, right), (self.top, bottom), (0.0, 1.0))
        return [(depth * min(0.0, low), depth * max(0.0, high)) for low, high in ends]


def noise_on_planes(
    key: Tensor,
    rays: Rays,
    depths: Sequence[float],
    *,
    periods: Sequence[float],
    planes: Sequence[int],
    amplitude: Tensor,
    moved: Tensor,
    turns: Tensor,
) -> Tensor:
    """The sum of octaves of Perlin's gradient noise, each times its amplitude, where rays cross planes.

        noise = sum over the 8 nodes around (x, y, z) of h(p) h(q) h(r) (g_x p + g_y q + g_z r),
        (p, q, r) = (x, y, z) - node,  h(p) = 1 - fade(|p|),  fade(s) = 6 s^5 - 15 s^4 + 10 s^3,
        (x, y, z) = ((X, Y, Z) - moved) / period + phase

    Gradients have length 1, and phases are uniform. Each gradient turns on a great circle of its own, at a normal rate:
    the noise stays what it is, and is correlated with that of turns = 0 by exp(-turns^2).

    Args:
        key: (N, 4), int64, of `noise_key`.
        rays: in rows and columns.
        depths: K of them, m, of the planes, from near to far.
        periods: m, above 0, between two nodes, of each octave.
        planes: of each octave, at least 1: only so many, the nearest, have it.
        amplitude: (N, octaves, K), gives the type.
        moved: (N, 3), m, how far the noise has gone.
        turns: (N,), time over the time of decorrelation.

    Returns:
        (N, K, rows, columns); an octave has the standard deviation amplitude sqrt(VARIANCE).

    Source: Perlin, "Improving noise", SIGGRAPH 2002; Perlin and Neyret, "Flow noise", SIGGRAPH 2001 technical sketches,
    for the turning.
    """
    device = key.device
    boxes = [rays.box(depths[count - 1] / period) for count, period in zip(planes, periods, strict=True)]
    nodes = [[math.ceil(high - low) + 2 for low, high in box] for box in boxes]
    low = as_device_tensor([[end[0] for end in box] for box in boxes], dtype=torch.float64, device=device)
    period = as_device_tensor(periods, dtype=torch.float64, device=device)[:, None]
    step = torch.arange(1, len(periods) + 1, device=device)[:, None] * as_device_tensor(
        PHASES, dtype=low.dtype, device=device
    )
    origin = (key[:, None, :3].double() * 2.0**-32 + step).frac() - moved.double()[:, None] / period
    # The whole coordinates of the first node; float32 suffices for places from there on, wherever the wind has gone.
    first = (origin.detach() + low).floor()
    axes = _axes(
        rays, as_device_tensor(depths, dtype=low.dtype, device=device) / period, origin - first, nodes, amplitude
    )
    gradients = _gradients(key, first.long(), nodes, turns, dtype=amplitude.dtype)

    def octave(i: int) -> Tensor:
        matrices = [axis.matrices(i, planes[i], n) for axis, n in zip(axes, nodes[i], strict=True)]
        return _octave(matrices, gradients[i], planes[i])

    # The fewest planes first, so that the sum grows.
    start, *others = sorted(range(len(planes)), key=lambda i: planes[i])
    total = octave(start)
    for i in others:
        total = _grown(total, planes[i]) + octave(i)
    return _grown(total, len(depths))


def deviation_of_mean(length: Tensor) -> Tensor:
    """The standard deviation of the mean of the noise over a length along an axis, over that of the noise.

        (1 + (length / 0.851)^2)^(-1/4),  within 2.5 %; 0.851 is twice the integral of the correlation

    Args:
        length: periods, of any shape.
    """
    return (1 + (length / 0.851).square()).pow(-0.25)


class _Beside(NamedTuple):
    """The two nodes beside each place along an axis."""

    node: Tensor  # (N, octaves, K or 1, 2, places)
    hat: Tensor  # likewise, h
    ramp: Tensor  # likewise, h p

    def matrices(self, octave: int, planes: int, nodes: int) -> tuple[Tensor, Tensor]:
        """h and h p from each node to each place, (N, planes or 1, nodes, places)."""
        node, hat, ramp = (value[:, octave, :planes] for value in self)
        none = hat.new_zeros(1, 1, 1, 1).expand(*node.shape[:2], nodes, node.shape[3])
        return none.scatter(2, node, hat), none.scatter(2, node, ramp)


def _axes(
    rays: Rays, depth: Tensor, origin: Tensor, nodes: Sequence[Sequence[int]], amplitude: Tensor
) -> tuple[_Beside, _Beside, _Beside]:
    """x and y, with places on each plane, and z, whose places are the planes; the amplitude is in y."""
    columns, rows = rays.slopes(depth.device)
    x, y, z = origin[..., None, None].unbind(2)
    places = (x + depth[..., None] * columns, y + depth[..., None] * rows, z + depth[:, None])
    last = as_device_tensor(nodes, dtype=depth.dtype, device=depth.device)[..., None, None] - 2
    x, y, z = (_beside(place, last[:, i], amplitude.dtype) for i, place in enumerate(places))
    factor = amplitude[..., None, None]
    return x, y._replace(hat=y.hat * factor, ramp=y.ramp * factor), z


def _beside(place: Tensor, last: Tensor, dtype: torch.dtype) -> _Beside:
    # Planes that do not have an octave lie beyond its nodes.
    first = torch.minimum(place.detach().floor().clamp(min=0), last)
    p, node = (place - first).to(dtype), first.long()
    fade = p * p * p * (p * (6 * p - 15) + 10)
    hat = 1 - fade
    pairs = ((node, node + 1), (hat, fade), (hat * p, fade * (p - 1)))
    return _Beside(*(torch.stack(pair, dim=3) for pair in pairs))


def _octave(axes: Sequence[tuple[Tensor, Tensor]], gradients: Sequence[Tensor], planes: int) -> Tensor:
    """(N, planes, rows, columns): from nodes to places by one axis after the other, as h h h is a product."""
    (hat_x, ramp_x), (hat_y, ramp_y), z = axes
    hat_z, ramp_z = (matrix[:, 0, :, :planes].mT for matrix in z)
    size = (-1, planes, *gradients[0].shape[2:])
    gx, gy, gz = (
        exact_matmul(z, g.flatten(2)).view(size) for z, g in zip((hat_z, hat_z, ramp_z), gradients, strict=True)
    )
    along = exact_matmul(gx, ramp_x) + exact_matmul(gz, hat_x)
    return exact_matmul(hat_y.mT, along) + exact_matmul(ramp_y.mT, exact_matmul(gy, hat_x))


def _grown(field: Tensor, planes: int) -> Tensor:
    more = planes - field.shape[1]
    return F.pad(field, (0, 0, 0, 0, 0, more)) if more else field


def _gradients(
    key: Tensor, first: Tensor, nodes: Sequence[Sequence[int]], turns: Tensor, *, dtype: torch.dtype
) -> list[list[Tensor]]:
    """Of each octave the three components for a box of nodes, (N, nodes along z, along y, along x)."""
    numbered = []
    for i, counts in enumerate(nodes):
        x, y, z = (first[:, i, axis, None] + torch.arange(n, device=key.device) for axis, n in enumerate(counts))
        plane = z[:, :, None, None] + i * OCTAVE
        numbered.append((x[:, None, None] + LINE * (y[:, None, :, None] + LINE * plane)).flatten(1))
    scaled = _UPPER * random.lattice_noise(key, [torch.cat(numbered, dim=1)], 2)
    upper = scaled.floor()
    lower = scaled - upper
    # Whole turns are taken out in float64: later frames are as exact as the first.
    rate = (2 * lower[:, 1].double() - 1).erfinv()
    turn = upper[:, 1].double() / _UPPER + (rate * (turns.double() / math.pi)[:, None]).frac()
    # The axis of the great circle, and two directions square to it: (cos cos, cos sin, -sin) and (-sin, cos, 0).
    cos_axis, around = (2 * upper[:, 0].to(dtype) + 1) / _UPPER - 1, 2 * math.pi * lower[:, 0].to(dtype)
    angle, sin_axis = 2 * math.pi * turn.to(dtype), (1 - cos_axis * cos_axis).sqrt()
    cos, sin, cos_around, sin_around = angle.cos(), angle.sin(), around.cos(), around.sin()
    tilted = cos * cos_axis
    components = tilted * cos_around - sin * sin_around, tilted * sin_around + sin * cos_around, -cos * sin_axis
    sizes = [math.prod(counts) for counts in nodes]
    parts = zip(*(component.split(sizes, dim=1) for component in components), strict=True)
    return [[part.view(-1, *counts[::-1]) for part in three] for three, counts in zip(parts, nodes, strict=True)]
