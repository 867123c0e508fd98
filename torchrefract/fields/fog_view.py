"""How pixels see the volume of fog in space: where rays go through a frame, and what lies between them."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import cat_bands, exact_matmul, rows_at_once
from torchrefract._validation import requires_grad
from torchrefract.fields.perlin3d import Rays

SLICES = 48  # of the distance, in which means are kept
_CELLS = 48  # between rays, over the longer side of the frame
_FINER = 2  # times: the lattice in the image that pixels are interpolated from linearly
_CACHED = 1 << 16  # pixels that stay in a core's cache, a few times over


class View(NamedTuple):
    """Where the rays of the volume go through the frame; there is one more of them beyond each edge."""

    height: int
    width: int
    cell: float  # px, between rays
    down: int  # cells
    across: int
    rays: Rays


def view(height: int, width: int, focal: tuple[float, float], center: tuple[float, float]) -> View:
    longer = max(height, width)
    cell, down, across = longer / _CELLS, -(-height * _CELLS // longer), -(-width * _CELLS // longer)
    left, top = ((-0.5 - cell - c) / f for c, f in zip(center, focal, strict=True))
    rays = Rays(left, cell / focal[0], across + 3, top, cell / focal[1], down + 3)
    return View(height, width, cell, down, across, rays)


def keys(cells: int, like: Tensor) -> Tensor:
    """(finer cells + 1, cells + 3): from rays to a finer lattice, by Keys' cubic of a = -1/2."""
    fine = torch.arange(cells * _FINER + 1, dtype=torch.float64, device=like.device) / _FINER
    x = (fine[:, None] + 1 - torch.arange(cells + 3, dtype=torch.float64, device=like.device)).abs()
    near, far = (1.5 * x - 2.5) * x * x + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    return torch.where(x < 1, near, torch.where(x < 2, far, 0)).to(like.dtype)


def _slice(distance: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """The slice below a distance, the part of the way to the next, and reach / d, at most 1."""
    scale = SLICES * (SLICES + 1) / reach
    # n (n + 1) = scale d has a slope in d at 0 too.
    place = distance.clamp(max=reach).mul_(scale).add_(0.25).sqrt_()
    first = place.detach().sub(0.5).floor_().clamp(max=SLICES - 1)
    return first, place - (first + 0.5), reach / distance.clamp(min=reach)


def by_row(view: View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
    """m for distances (N or 1, 1, H, 1)."""
    first, part, share = (value.flatten(1) for value in _slice(distance, reach))
    y, dy = _places(view.height, view.cell, view.down, volume)
    batch, slices, rows = volume.shape[:3]
    start = torch.arange(batch, device=volume.device)[:, None] * slices
    index, lines = (start + first.long()) * rows + y, volume.flatten(0, 2)
    near, far = share * (1 - part), share * part
    corners = ((0, near * (1 - dy)), (1, near * dy), (rows, far * (1 - dy)), (rows + 1, far * dy))
    first, *others = (lines[index + step] * weight[..., None] for step, weight in corners)
    x, dx = _places(view.width, view.cell, view.across, volume)
    finer = keys(view.across, volume)
    across = torch.lerp(finer[x], finer[x + 1], dx[:, None])
    # The product adds 1, too. Cubics overshoot where the contrast is high.
    mean = exact_matmul(F.pad(sum(others, first), (0, 1), value=1.0), F.pad(across, (0, 1), value=1.0).T)
    return mean.relu_().unsqueeze(1)


def _places(pixels: int, cell: float, cells: int, like: Tensor) -> tuple[Tensor, Tensor]:
    place = (torch.arange(pixels, dtype=torch.float64, device=like.device) + 0.5) * (_FINER / cell)
    first = place.floor().clamp(max=cells * _FINER - 1)
    return first.long(), (place - first).to(like.dtype)


class Between(NamedTuple):
    """Where rows or columns of pixels lie, each between four rays."""

    cell: np.ndarray  # (n,), int32, the first of the four
    weights: np.ndarray  # (4, n), float32


@lru_cache(maxsize=16)
def between(pixels: int, cell: float, cells: int) -> Between:
    """For pixels of a cell each, as `by_row` has them; nobody writes to it."""
    like = torch.empty(0, dtype=torch.float64)
    (first, part), finer = _places(pixels, cell, cells, like), keys(cells, like)
    near = first // _FINER
    weights = torch.lerp(finer[first], finer[first + 1], part[:, None]).gather(1, near[:, None] + torch.arange(4))
    # Copies: arrays that are a tensor's would keep it.
    return Between(np.array(near.numpy(), np.int32), np.array(weights.T.numpy(), np.float32, order="C"))


@lru_cache(maxsize=16)
def finer_places(pixels: int, cell: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The column of the finer lattice before each pixel, int32, and how far on this is; nobody writes to them."""
    first, part = _places(pixels, cell, cells, torch.empty(0))
    return np.array(first.numpy(), np.int32), np.array(part.numpy())


def by_pixel(view: View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
    """m for distances (N or 1, 1, H, W)."""
    volume = exact_matmul(volume, keys(view.across, volume).T)
    rows, columns = volume.shape[2:]
    # One slice below the other as an image, the next slice as its second channel.
    pairs = torch.stack([volume[:, :-1], volume[:, 1:]], dim=1).flatten(2, 3)
    x, y = (
        (2 * (torch.arange(n, dtype=torch.float64, device=volume.device) + 0.5) * (_FINER / view.cell) + 1) / size
        for n, size in ((view.width, columns), (view.height, rows * SLICES))
    )
    x, y = (x - 1).to(volume.dtype), (y - 1).to(volume.dtype)[:, None]
    at_once = view.height
    if not requires_grad((pairs,)):
        at_once = rows_at_once(pairs.device, at_once, each=view.width, cached=_CACHED)
    bands = (
        _looked_up(pairs, band, x, middle, reach)
        for band, middle in zip(distance.split(at_once, dim=2), y.split(at_once), strict=True)
    )
    return cat_bands(bands, dim=2, length=view.height)


def _looked_up(pairs: Tensor, distance: Tensor, x: Tensor, y: Tensor, reach: float) -> Tensor:
    first, part, share = _slice(distance, reach)
    y = first[:, 0].mul_(2 / SLICES) + y
    grid = torch.stack([x.expand_as(y), y], dim=1).movedim(1, -1)
    below, above = _sample(pairs, grid).split(1, dim=1)
    return torch.addcmul(torch.ones_like(share[:1, :1, :1, :1]), torch.lerp(below, above, part), share).relu_()


def _sample(source: Tensor, grid: Tensor) -> Tensor:
    rows, columns = grid.shape[1:3]
    eager = source.device.type == "cpu" and not torch.compiler.is_compiling()
    threads = torch.get_num_threads() if eager else 1
    if threads == 1 or rows % threads:
        return F.grid_sample(source, grid.expand(len(source), -1, -1, -1), align_corners=False)
    # The CPU sampler threads over the batch alone.
    bands = grid.unflatten(1, (threads, -1)).flatten(0, 1)
    found = F.grid_sample(source.expand(threads, -1, -1, -1), bands, align_corners=False)
    return found.movedim(0, 1).reshape(1, 2, rows, columns)
