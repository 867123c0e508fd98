"""Fog in space by kernels: means along rays, and those of pixels."""

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels
from torchrefract._threads import share
from torchrefract.fields.fog_view import SLICES, Between, View, between, finer_places
from torchrefract.fields.perlin3d import PHASES, Rays
from torchrefract.random import _HASH as HASH

_AT_ONCE = 8  # rows of rays that are worth a thread
_TOGETHER = 16  # frames, whose volumes are kept at once


class Drawn(NamedTuple):
    """What the volumes of N frames are drawn from: ln q is a sum of octaves, less `half`."""

    key: Tensor  # (N, 4), int64
    amplitude: Tensor  # (N, octaves, planes + 2)
    half: Tensor  # (N, planes + 2)
    moved: Tensor  # (N, 3), m
    turns: Tensor  # (N,)


class Volume(NamedTuple):
    """Where means are made."""

    rays: Rays
    reach: float  # m
    periods: tuple[float, ...]  # m, of the octaves
    counts: tuple[int, ...]  # of planes, the nearest, that have each octave
    planes: int  # at (k / planes)^2 of the reach, and one behind it


def path_means(view: View, drawn: Drawn, volume: Volume, distance: Tensor) -> Tensor:
    """(N, 1, H, W), the means for distances (N or 1, 1, H, 1 or W)."""
    out = torch.empty(len(drawn.key), 1, view.height, view.width)
    for start in range(0, len(out), _TOGETHER):
        some = slice(start, start + _TOGETHER)
        own = distance[some] if len(distance) > 1 else distance
        _some_means(view, Drawn(*(value[some] for value in drawn)), volume, own, out[some, 0].numpy())
    return out


def _some_means(view: View, drawn: Drawn, volume: Volume, distance: Tensor, out: np.ndarray) -> None:
    views, reach = kernels("fields.kernels.views"), np.float32(volume.reach)
    down = tuple(between(view.height, view.cell, view.down))
    ends = tuple(_numbers(end.flatten(1)) for end in torch.aminmax(distance.detach(), dim=3))
    wanted = np.empty((len(distance), view.rays.rows, 2), np.int64)
    views.ask_for(ends, reach, SLICES, down, wanted)
    means = _means(drawn, volume, wanted)
    if distance.shape[3] == 1:
        across = _groups(view.width, view.cell, view.across)
        work = partial(views.rows_at_distances, means, ends[0], reach, down, across)
    else:
        finer = np.empty((*means.shape[:3], 2 * means.shape[3]), np.float32)
        refined = partial(views.refined, means, wanted)
        share(lambda start, stop: refined(start, stop, finer), means.shape[0] * means.shape[1], least=_AT_ONCE)
        across = finer_places(view.width, view.cell, view.across)
        work = partial(views.rows_of_pixels, finer, _numbers(distance[:, 0]), ends, reach, down, across)
    share(lambda start, stop: work(start, stop, out), len(out) * view.height, least=SMALLEST // view.width + 1)


def _means(drawn: Drawn, volume: Volume, wanted: np.ndarray) -> np.ndarray:
    """(N, rows, slices + 1, W), W in whole groups, means along rays, less one, up to the slices that are wanted."""
    keys = drawn.key.to(torch.int32).contiguous().numpy().view(np.uint32), tuple(word % 2**32 for word in HASH)
    rays, count, rows = _rays(volume), len(drawn.key), volume.rays.rows
    out = np.empty((count, rows, SLICES + 1, len(rays[2])), np.float32)
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
    x, y = (np.array(slopes.numpy()) for slopes in volume.rays.slopes(torch.device("cpu")))
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
    return begins, np.ascontiguousarray((cell_of - begins[:, None]).ravel()), weights


def _group() -> int:
    return kernels("warping.kernels.across").GROUP


def _numbers(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()
