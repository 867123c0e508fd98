"""Fog in space by kernels: means along rays, and those of pixels whose distances are known by row."""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels
from torchrefract._threads import share
from torchrefract.fields.fog_view import SLICES, Between, View, between
from torchrefract.fields.perlin3d import PHASES, Rays
from torchrefract.white_noise import HASH


class Drawn(NamedTuple):
    """What the volumes of N frames are drawn from: ln q is a sum of octaves, less `half`."""

    key: Tensor  # (N, 4), int64
    amplitude: Tensor  # (N, octaves, planes + 2)
    half: Tensor  # (N, planes + 2)
    moved: Tensor  # (N, 3), m
    turns: Tensor  # (N,)


_AT_ONCE = 8  # rows of rays that are worth a thread


class Volume(NamedTuple):
    """Where means are made."""

    rays: Rays
    reach: float  # m
    periods: tuple[float, ...]  # m, of the octaves
    counts: tuple[int, ...]  # of planes, the nearest, that have each octave
    planes: int  # at (k / planes)^2 of the reach, and one behind it


def by_row(view: View, drawn: Drawn, volume: Volume, distance: Tensor) -> Tensor:
    """(N, 1, H, W), the means for distances (N or 1, 1, H, 1)."""
    down = between(view.height, view.cell, view.down)
    views, wanted = kernels("fields.kernels.views"), np.empty((len(distance), view.rays.rows, 2), np.int64)
    known = distance.detach().flatten(1).contiguous().numpy()
    slices = views.slices_of(known, volume.reach, SLICES, down.cell, wanted)
    means = _means(drawn, volume, wanted, np.empty)
    out = torch.empty(len(means), 1, view.height, view.width)
    into, across = out[:, 0].numpy(), _groups(view.width, view.cell, view.across)
    work = partial(views.rows_of_pixels, means, slices, *down, across)
    count, least = len(means) * view.height, SMALLEST // view.width + 1
    share(lambda start, stop: work(start, stop, into), count, least=least)
    return out


def volume_up_to(drawn: Drawn, volume: Volume, distance: Tensor) -> Tensor:
    """(N, slices + 1, rows, columns), the means along rays, less one, as far as distances (N or 1, 1, H, W) lead."""
    farthest = distance.detach().flatten(1).amax(dim=1).double().clamp(0, volume.reach).numpy()
    # The look-up reads one slice more, though it gives it no weight.
    place = np.sqrt(farthest * (SLICES * (SLICES + 1) / volume.reach) + 0.25) + 2
    wanted = np.zeros((len(distance), volume.rays.rows, 2), np.int64)
    wanted[..., 1] = np.minimum(np.nan_to_num(place, nan=SLICES), SLICES)[:, None]
    means = torch.from_numpy(_means(drawn, volume, wanted, np.zeros))
    return means[..., : volume.rays.columns].transpose(1, 2)


def _means(drawn: Drawn, volume: Volume, wanted: np.ndarray, empty: Callable[..., np.ndarray]) -> np.ndarray:
    """(N, rows, slices + 1, W), W in whole groups, means along rays, less one, up to the slices that are wanted."""
    keys = drawn.key.to(torch.int32).contiguous().numpy().view(np.uint32), tuple(word % 2**32 for word in HASH)
    rays, count, rows = _rays(volume), len(drawn.key), volume.rays.rows
    out = empty((count, rows, SLICES + 1, len(rays[2])), np.float32)
    work = partial(kernels("fields.kernels.volumes").volumes, *keys, _fog(drawn, volume), rays, wanted)
    share(lambda start, stop: work(start, stop, out), count * rows, least=_AT_ONCE)
    return out


def _fog(drawn: Drawn, volume: Volume) -> tuple[np.ndarray, ...]:
    """As `volumes` has it: the first node of each octave is the last one before the camera."""
    period, number = np.array(volume.periods)[:, None], np.arange(1, len(volume.periods) + 1)[:, None]
    phases = drawn.key[:, None, :3].double().numpy() * 2.0**-32 + number * np.array(PHASES)
    place = phases - np.floor(phases) - _numbers(drawn.moved)[:, None] / period
    first = np.floor(place)
    narrow = (_numbers(value.float()) for value in (drawn.amplitude, drawn.half))
    return _numbers(drawn.turns) / math.pi, *narrow, first.astype(np.int64), place - first


@lru_cache(maxsize=16)
def _rays(volume: Volume) -> tuple[np.ndarray, ...]:
    """As `volumes` has them; nobody writes to them."""
    depths = volume.reach * (np.arange(volume.planes + 2) / volume.planes) ** 2
    x, y = (slopes.numpy() for slopes in volume.rays.slopes(torch.device("cpu")))
    # Whole groups of rays are made, of which the last are alike.
    x = np.pad(x, (0, -len(x) % _group()), mode="edge")
    last = volume.planes * (1 + x * x + (y * y)[:, None]) ** -0.25
    n = np.arange(SLICES + 1)
    slices = np.sqrt(n * (n + 1) / (SLICES * (SLICES + 1)))
    return depths / np.array(volume.periods)[:, None], np.array(volume.counts), x, y, last, slices


@lru_cache(maxsize=16)
def _groups(pixels: int, cell: float, cells: int) -> tuple[Any, ...]:
    """Where columns of pixels lie, as `along_nodes` has it; nobody writes to it."""
    place: Between = between(pixels, cell, cells)
    more = -pixels % _group()
    cell_of = np.pad(place.cell, (0, more), mode="edge").reshape(-1, _group())
    begins = np.ascontiguousarray(cell_of[:, 0])
    weights = np.pad(place.weights, ((0, 0), (0, more)), mode="edge")
    return begins, np.ascontiguousarray((cell_of - begins[:, None]).ravel()), weights, cells + 3


def _group() -> int:
    return kernels("fields.kernels.pixels").GROUP


def _numbers(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()
