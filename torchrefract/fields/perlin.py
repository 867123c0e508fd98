"""Perlin's gradient noise in the image plane: gradients that are drawn on lattices, and the noise at every pixel.

An octave is a lattice with one node every `period` px. With the wind its nodes move, and over time its gradients turn.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import exact_matmul, without_autocast
from torchrefract._validation import eager_values, requires_grad
from torchrefract.fields.random_field import Motion
from torchrefract.random import lattice_noise

# Multiples of the golden ratio stay apart modulo 1, so that octaves share no lines of nodes.
_GOLDEN_RATIO = (5**0.5 - 1) / 2
_BLOCK = 32  # px; the pixels of a block are interpolated from the same nodes by one product of matrices


class Octave(NamedTuple):
    """One octave of a frame: the gradients at its nodes and the positions of the pixels between them.

    gradient: (N, 2, m, n), (g_x, g_y) at the nodes that pixels lie between.
    x: (N, W), float64, of each column of pixels, in cells; 0 is the first column of nodes.
    y: (N, H), float64, of each row of pixels, likewise.
    step: cells between two pixels, up to less than a cell.
    """

    gradient: Tensor
    x: Tensor
    y: Tensor
    step: float


def draw_octave(
    key: Tensor,
    index: int,
    *,
    period: float,
    height: int,
    width: int,
    motion: Motion,
    dtype: torch.dtype,
) -> Octave:
    """Draw one octave for one frame of each clip.

        g = (cos a, sin a),  a = 2 pi u1 + omega t,  omega = 2 erfinv(2 u2 - 1) / decorrelation
        x = (column + 1/2 - wind_x t) / period + phase_x,  y likewise
        phase = frac(key / 2^32 + (index + 1) (sqrt(5) - 1) / 2)

    u1 and u2 are uniform: a hash of the coordinates of the node. omega is normal, so that the noise in the wind has the
    correlation E cos(omega t) = exp(-(t / decorrelation)^2) with itself, and a constant variance.

    Args:
        key: (N, 4), int64, of `noise_key`.
        index: of the octave; octaves of different indices are independent.
        period: px between two nodes, above 0.
        height, width: px, of the frame.
        motion: time t, wind in px per frame and decorrelation; inf for gradients that do not turn.
        dtype: of the gradients.

    Source: Perlin and Neyret, "Flow noise", SIGGRAPH 2001 technical sketches, for the turning gradients.
    """
    phase = (2.0**-32 * key[:, :2].double() + _GOLDEN_RATIO * (index + 1)).frac()
    start = (0.5 - motion.wind.double() * motion.frame.double()[:, None]) / period + phase
    first = start.detach().floor()
    step = 1 / period
    axes, nodes = [], [torch.full((len(key), 1), index, dtype=torch.int64, device=key.device)]
    for size, offset, node in zip((width, height), (start - first).unbind(1), first.long().unbind(1), strict=True):
        pixel = torch.arange(size, dtype=torch.float64, device=key.device)
        position = offset[:, None] + step * pixel
        if step < 2:
            nodes.append(node[:, None] + torch.arange(math.ceil(size * step) + 2, device=key.device))
        else:
            # Pixels this far apart share no nodes; only the two nodes beside each are drawn.
            before = position.detach().floor()
            nodes.append(node[:, None] + torch.stack([before, before + 1], dim=2).long().flatten(1))
            position = position - before + 2 * pixel
        axes.append(position)
    angle = 2 * math.pi * _turns(key, nodes, motion, dtype).mT
    return Octave(torch.stack([angle.cos(), angle.sin()], dim=1), axes[0], axes[1], min(step, 2.0))


def perlin_noise(octaves: Sequence[Octave], weights: Tensor) -> Tensor:
    """Sum the octaves of one frame, each times its weight.

        noise = sum over the 4 nodes around (x, y) of h(p) h(q) (g_x p + g_y q),  (p, q) = (x, y) - node
        h(p) = 1 - fade(|p|),  fade(s) = 6 s^5 - 15 s^4 + 10 s^3

    The noise is 0 at the nodes, has the gradient g there and two continuous derivatives, and is at most sqrt(1/2). As
    h(p) h(q) is a product, each octave is interpolated along the rows of nodes first and then across them.

    Args:
        octaves: at least one.
        weights: (N, octaves), gives the type of the noise.

    Returns:
        (N, 1, H, W).

    Source: Perlin, "Improving noise", SIGGRAPH 2002.
    """
    (batch, height), width = octaves[0].y.shape, octaves[0].x.shape[1]
    tables: list[Tensor] = []
    indices: list[Tensor] = []
    factors: list[Tensor] = []
    row = 0
    with without_autocast(weights.device):  # it would round the products of matrices
        for octave, weight in zip(octaves, weights.unbind(1), strict=True):
            nodes = octave.gradient.shape[2]
            tables.append(_interpolate_rows(octave, weights.dtype).flatten(1, 2))
            first, distance = _blocks(octave.y, nodes, octave.step, weights.dtype)
            hat = weight[:, None, None, None] * fade_out(distance)
            node = row + first[:, :, None] + torch.arange(distance.shape[2], device=first.device)
            indices += [node, node + nodes]
            factors += [hat, hat * distance]
            row += 2 * nodes
        index = torch.cat(indices, dim=2) + row * torch.arange(batch, device=weights.device)[:, None, None]
        lines = torch.cat(tables, dim=1).flatten(0, 1).index_select(0, index.flatten()).view(*index.shape, width)
        noise = exact_matmul(torch.cat(factors, dim=2).mT, lines).flatten(1, 2)
    return noise[:, None, :height]


def fade_out(distance: Tensor) -> Tensor:
    """Return h(p) = 1 - 6 s^5 + 15 s^4 - 10 s^3, s = min(|p|, 1), the weight of a node at a distance in cells."""
    s = distance.abs().clamp(max=1)
    return 1 - s * s * s * (s * (6 * s - 15) + 10)


def _interpolate_rows(octave: Octave, dtype: torch.dtype) -> Tensor:
    """(N, 2, m, W): sums of g_x h p and of g_y h over the nodes of each row, at every column of pixels."""
    columns = octave.gradient.shape[3]
    first, distance = _blocks(octave.x, columns, octave.step, dtype)
    node = first[:, :, None] + torch.arange(distance.shape[2], device=first.device)
    hat = fade_out(distance)
    rows = octave.gradient.shape[:3]
    chosen = octave.gradient.gather(3, node.flatten(1)[:, None, None].expand(*rows, -1)).unflatten(3, node.shape[1:])
    lines = exact_matmul(chosen.movedim(2, 3), torch.stack([hat * distance, hat], dim=1))  # (N, 2, blocks, m, size)
    return lines.movedim(2, 3).flatten(3)[..., : octave.x.shape[1]]


def _blocks(position: Tensor, nodes: int, step: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Cut the pixels of an axis into blocks.

    Args:
        position: (N, pixels), in cells, evenly spaced.
        nodes: on the axis.
        step: cells between two pixels.
        dtype: of the distances.

    Returns:
        (N, blocks), int64, the first node of each block; (N, blocks, count, size), the distances of its pixels from
        the `count` nodes from there on. The last pixel is repeated to fill its block.
    """
    pixels = position.shape[1]
    size = min(_BLOCK, pixels)
    missing = -pixels % size
    if missing:
        position = torch.cat([position, position[:, -1:].expand(-1, missing)], dim=1)
    position = position.unflatten(1, (-1, size))
    count = min(nodes, math.ceil((size - 1) * step + 1e-9) + 2)
    first = position[..., 0].detach().floor().clamp(0, nodes - count)
    node = first[..., None] + torch.arange(count, dtype=position.dtype, device=position.device)
    return first.long(), (position[:, :, None] - node[..., None]).to(dtype)


def _turns(key: Tensor, nodes: Sequence[Tensor], motion: Motion, dtype: torch.dtype) -> Tensor:
    """Compute (N, n, m): the angles of the gradients over 2 pi."""
    frame, decorrelation = motion.frame, motion.decorrelation
    if not requires_grad((frame, decorrelation)) and eager_values((frame / decorrelation == 0).all, of=frame):
        return lattice_noise(key, nodes, 1)[:, 0, 0].to(dtype)
    start, speed = lattice_noise(key, nodes, 2)[:, :, 0].unbind(1)
    elapsed = (frame.double() / (math.pi * decorrelation.double()))[:, None, None]
    # Whole turns are dropped in float64: late frames have many.
    return start.to(dtype) + ((2 * speed - 1).double().erfinv() * elapsed).frac().to(dtype)
