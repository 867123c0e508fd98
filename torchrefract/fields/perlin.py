"""Perlin's gradient noise in the plane, at every pixel of a frame."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor, cat_bands, exact_matmul
from torchrefract._validation import requires_grad
from torchrefract.fields.perlin_lattice import Octave
from torchrefract.warping.lattice import Lattice, along_rows, row_weights

# Pixels that are made of the same nodes: as many rows, and up to so many columns.
BAND = 24
_STRIPE = 128
_AT_ONCE = 4  # bands, whose nodes stay in a core's cache


class Nodes(NamedTuple):
    """A part of the noise that is known at the nodes of a lattice."""

    value: Tensor  # (N, 1, n, m)
    lattice: Lattice  # with one node before the frame


def perlin_noise(octaves: Sequence[Octave], weights: Tensor, *, nodes: Nodes | None = None) -> Tensor:
    """(N, 1, H, W), the sum of the noises of octaves of one frame, each times its weight.

        noise = sum over the 4 nodes around (x, y) of h(p) h(q) (g_x p + g_y q),  (p, q) = (x, y) - node,
        h(p) = 1 - fade(|p|),  fade(s) = 6 s^5 - 15 s^4 + 10 s^3

    It is 0 at the nodes, with the gradient g, has two continuous derivatives, and is at most sqrt(1/2).

    Args:
        octaves: at least one, or none where there are nodes.
        weights: (N, octaves).
        nodes: what else is added, cubics between them.

    Source: Perlin, "Improving noise", SIGGRAPH 2002.
    """
    with torch.autocast(weights.device.type, enabled=False):  # it would round the products of matrices
        return _by_sample(_noise, octaves, weights, nodes).unsqueeze(1)


class _Beside(NamedTuple):
    """The two nodes beside each pixel along an axis."""

    node: Tensor  # (N, octaves, 2, pixels)
    weight: Tensor  # (N, 2, octaves, 2, pixels), h and h p


class _Blocks(NamedTuple):
    """Blocks of pixels along an axis, and S nodes that suffice for all in one, octave by octave."""

    node: Tensor  # (N, blocks, S)
    weight: Tensor  # (N, 2, blocks, S, size), h and h p
    counts: list[int]  # how many of the S nodes are those of each octave


def _by_sample(
    function: Callable[..., Tensor], octaves: Sequence[Octave], weights: Tensor, nodes: Nodes | None
) -> Tensor:
    weights = weights.to(octaves[0].gradient.dtype if nodes is None else nodes.value.dtype)
    if len(weights) < 2 or weights.device.type != "cpu" or torch.compiler.is_compiling():
        return function(octaves, weights, nodes)

    def alone(i: int) -> Tensor:
        mine = None if nodes is None else nodes._replace(value=nodes.value[i : i + 1])
        return function([Octave(*(part[i : i + 1] for part in each)) for each in octaves], weights[i : i + 1], mine)

    # Sums of several samples at once might round in another way than those of one.
    parts = (alone(i) for i in range(len(weights)))
    return cat_bands(parts, dim=0, length=len(weights))


class _Lines(NamedTuple):
    """What bands of pixels are made of: lines as wide as a stripe of pixels, and their weights."""

    parts: Iterable[Tensor]  # of the table, (lines, stripe)
    total: int  # lines in all parts
    needed: Tensor  # (N bands, terms stripes), of the lines that a band needs
    weight: Tensor  # (N bands, rows of a band, terms)


def _noise(octaves: Sequence[Octave], weights: Tensor, nodes: Nodes | None) -> Tensor:
    """(N, H, W), by two products of matrices for each octave: first along the rows of nodes, then across them."""
    batch = len(weights)
    height, width = nodes.lattice[:2] if nodes else (octaves[0].y.shape[1], octaves[0].x.shape[1])
    if 0 in (batch, height, width):
        return weights.new_zeros(batch, height, width)
    y_counts, x_counts = _sizes(octaves, 2), _sizes(octaves, 3)
    band, stripe = _short(min(BAND, height), y_counts, height), _short(_stripe(width), x_counts, width)
    found = [_of_octaves(octaves, weights, band=band, stripe=stripe)] if octaves else []
    found += [] if nodes is None else [_of_nodes(nodes, band=band, stripe=stripe)]
    table = cat_bands(chain(*(each.parts for each in found)), dim=0, length=sum(each.total for each in found))
    index, down = found[0].needed, found[0].weight
    for each in found[1:]:
        index, down = torch.cat([index, found[0].total + each.needed], dim=1), torch.cat([down, each.weight], dim=2)
    # A gradient costs one of the whole table each time that bands are looked up in it.
    few = weights.device.type == "cpu" and not torch.compiler.is_compiling() and not requires_grad((table,))
    at_once = _AT_ONCE if few else len(down)
    bands = (
        exact_matmul(weight, table.index_select(0, numbers.flatten()).view(len(weight), weight.shape[2], -1))
        for weight, numbers in zip(down.split(at_once), index.split(at_once), strict=True)
    )
    image = cat_bands(bands, dim=0, length=len(down))
    return image.view(batch, -1, image.shape[2])[:, :height, :width].contiguous()


def _of_octaves(octaves: Sequence[Octave], weights: Tensor, *, band: int, stripe: int) -> _Lines:
    y = _blocks(_rows(octaves), _sizes(octaves, 2), size=band, dtype=weights.dtype)
    x = _blocks(_columns(octaves), _sizes(octaves, 3), size=stripe, dtype=weights.dtype)
    parts = zip(octaves, x.node.split(x.counts, dim=2), x.weight.split(x.counts, dim=3), strict=True)
    lines = [2 * len(weights) * x.node.shape[1] * m for m in _sizes(octaves, 2)]
    index = _line_numbers(y, lines=lines, stripes=x.node.shape[1])
    down = (y.weight * _spread(weights, y.counts)[:, None, None, :, None]).movedim(1, 2).flatten(2, 3).flatten(0, 1).mT
    return _Lines((_lines(each.gradient, *beside) for each, *beside in parts), sum(lines), index, down)


def _of_nodes(nodes: Nodes, *, band: int, stripe: int) -> _Lines:
    """Lines through all rows of nodes, and cubics between these."""
    batch, _, rows, _ = nodes.value.shape
    lattice, device = nodes.lattice, nodes.value.device
    across = along_rows(nodes.value, lattice)[:, 0]
    stripes, bands = -(-lattice.width // stripe), -(-lattice.height // band)
    table = _padded(across, stripes * stripe).reshape(-1, stripe)
    # So many rows of nodes suffice for any band.
    terms = min(rows, (band + lattice.stride - 2) // lattice.stride + 4)
    first = (torch.arange(bands, device=device) * band // lattice.stride).clamp(max=rows - terms)
    own = first[:, None] + torch.arange(terms, device=device)
    weight = _padded(row_weights(nodes.value, lattice).mT, bands * band).mT.view(bands, band, rows)
    weight = weight.gather(2, own[:, None].expand(-1, band, -1)).expand(batch, -1, -1, -1).flatten(0, 1)
    line = torch.arange(batch, device=device).view(-1, 1, 1, 1) * rows + own[..., None]
    index = (line * stripes + torch.arange(stripes, device=device)).flatten(0, 1).flatten(1)
    return _Lines([table], len(table), index, weight)


def _lines(gradient: Tensor, nodes: Tensor, across: Tensor) -> Tensor:
    """(N 2 stripes m, size): g_x h p and g_y h, summed along each row of nodes, at each column of pixels."""
    batch, _, m, n = gradient.shape
    lane = n * torch.arange(2 * batch, device=nodes.device).view(batch, 2, 1, 1)
    chosen = gradient.mT.reshape(-1, m).index_select(0, (nodes[:, None] + lane).flatten())
    return exact_matmul(chosen.unflatten(0, (-1, nodes.shape[2])).mT, across.flatten(0, 2)).flatten(0, 1)


def _line_numbers(y: _Blocks, *, lines: Sequence[int], stripes: int) -> Tensor:
    """(N bands, 2 S stripes): where in the table of all octaves stand the lines that a band of pixels needs."""
    batch = len(y.node)
    lane = torch.arange(2 * batch * stripes, device=y.node.device).view(batch, 1, 2, 1, stripes)
    ends = [[sum(lines[:i]) for i in range(len(lines))], [count // (2 * batch * stripes) for count in lines]]
    start, length = _spread(as_device_tensor(ends, device=y.node.device), y.counts)
    return ((y.node + start)[:, :, None, :, None] + length[:, None] * lane).flatten(0, 1).flatten(1)


def _sizes(octaves: Sequence[Octave], dim: int) -> list[int]:
    return [each.gradient.shape[dim] for each in octaves]


def _rows(octaves: Sequence[Octave]) -> _Beside:
    return _beside([each.y for each in octaves], _sizes(octaves, 2))


def _columns(octaves: Sequence[Octave]) -> _Beside:
    """Those of x with h p first, as g_x goes with h p of x and h of y, and g_y with h of x and h p of y."""
    node, weight = _beside([each.x for each in octaves], _sizes(octaves, 3))
    return _Beside(node, weight.flip(1))


def _beside(positions: Sequence[Tensor], counts: Sequence[int]) -> _Beside:
    position = torch.stack(list(positions), dim=1)
    last = as_device_tensor([n - 2 for n in counts], device=position.device)[:, None]
    node = position.detach().long().clamp(min=0).minimum(last)
    p = position - node
    fade = p * p * p * (p * (6 * p - 15) + 10)
    hat = torch.stack([1 - fade, fade], dim=2)
    weight = torch.stack([hat, hat * torch.stack([p, p - 1], dim=2)], dim=1)
    return _Beside(torch.stack([node, node + 1], dim=2), weight)


def _blocks(beside: _Beside, counts: Sequence[int], *, size: int, dtype: torch.dtype) -> _Blocks:
    batch, _, _, length = beside.node.shape
    blocks = -(-length // size)
    node, weight = (_padded(t, blocks * size).unflatten(-1, (blocks, size)) for t in beside)
    # As evenly spaced pixels cannot need more.
    count = [min(n, math.ceil((size - 1) * (n - 1) / max(1, length - 1) + 1e-6) + 2) for n in counts]
    device = node.device
    last, start = as_device_tensor(
        [[n - k for n, k in zip(counts, count, strict=True)], [sum(count[:i]) for i in range(len(count))]],
        device=device,
    )
    first = node[:, :, 0].amin(dim=3).minimum(last[:, None])
    place = (node - first[:, :, None, :, None] + start[:, None, None, None]).movedim(3, 1).flatten(2, 3)
    weight = weight.to(dtype).movedim(4, 2).flatten(3, 4)
    none = weight.new_zeros((batch, 2, blocks, sum(count), size))
    step = as_device_tensor([j for k in count for j in range(k)], device=device)
    nodes = _spread(first.mT, count) + step
    return _Blocks(nodes, none.scatter(3, place[:, None].expand_as(weight), weight), count)


def _spread(values: Tensor, count: Sequence[int]) -> Tensor:
    """(..., S), of each node, from values (..., octaves)."""
    owner = [i for i, k in enumerate(count) for _ in range(k)]
    return values.index_select(-1, as_device_tensor(owner, device=values.device))


def _padded(values: Tensor, length: int) -> Tensor:
    """As many as `length`, by repeating the last."""
    more = length - values.shape[-1]
    return torch.cat([values, values[..., -1:].expand(*values.shape[:-1], more)], dim=-1) if more else values


def _short(size: int, counts: Sequence[int], length: int) -> int:
    """A size of blocks for which no product has so many terms that threads share them, and round in another way."""
    return max(1, min(size, size * length // max(counts, default=1)))


def _stripe(width: int) -> int:
    """A width of stripes that divides that of the frame, where there is any."""
    divisors = (size for size in range(_STRIPE, _STRIPE // 2, -1) if width % size == 0)
    return next(divisors, min(_STRIPE, width))
