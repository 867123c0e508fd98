"""Fog in space: the mean extinction along each pixel's ray, through banks and holes that drift and change."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._bands import join, rows_at_once
from torchrefract._checks import learns, or_else
from torchrefract._constants import constant
from torchrefract.fields.perlin3d import VARIANCE, Rays, deviation_of_mean, noise_on_planes

_CELLS = 48  # between rays, over the longer side of the frame
_FINER = 2  # times: the lattice in the image that pixels are interpolated from linearly
_PLANES = 64  # across the axis, on which the field is evaluated
_SLICES = 48  # of the distance, in which means are kept
# An octave fades out where rays come to lie so many of its periods apart, or planes as many times as many.
_SPARSE, _SPARSEST = 0.4, 0.8
_LONGER = 5.0
_MOST_CONTRAST = 30.0  # from there on fog is all holes, and its exponentials leave float32
_CACHED = 1 << 16  # pixels that stay in a core's cache, a few times over


class _View(NamedTuple):
    """Where the rays of the volume go through the frame; there is one more of them beyond each edge."""

    height: int
    width: int
    cell: float  # px, between rays
    down: int  # cells
    across: int
    rays: Rays


class _Fog(NamedTuple):
    """The arguments of `path_mean` that a sample has of its own."""

    key: Tensor
    weights: Tensor
    contrast: Tensor
    frame: Tensor
    wind: Tensor
    decorrelation: Tensor


def path_mean(
    key: Tensor,
    distance: Tensor,
    *,
    height: int,
    width: int,
    focal: tuple[float, float],
    center: tuple[float, float],
    scales: Sequence[float],
    weights: Tensor,
    contrast: Tensor,
    frame: Tensor,
    wind: Tensor,
    decorrelation: Tensor,
    reach: float,
    dtype: torch.dtype,
) -> Tensor:
    """The mean along each pixel's ray, from the camera to a distance, of a field q > 0 with E q = 1.

        m = (1 / d) integral over s from 0 to d of q(s r) as far as the reach, m = 1 + (m(reach) - 1) reach / d beyond,
        q(X) = exp(c g - c^2 / 2),  g = sum of w_i n_i / sqrt(VARIANCE sum of w_i^2),  n_i as by `noise_on_planes`

    q is known on planes at (k / 64)^2 of the reach, along 48 rays over the longer side of the frame; m is interpolated,
    cubically between rays, linearly between 48 slices of d. What these cannot resolve is missing in g and in its c^2,
    so that E q = 1: an octave fades out where rays come to lie 0.4 to 0.8 of its periods apart or planes 2 to 4, and on
    a plane it deviates as its mean from there to the next would. Perlin noise is bounded, as a Gaussian is not: for
    four octaves E q is 0.99 at c = 1, and 0.89 at c = 2.

    Args:
        key: (N, 4), int64, of `noise_key`.
        distance: (N or 1, 1, H, 1 or W), m, d along the ray, at least 0, may be inf.
        height, width: px, of the frame.
        focal: px, fx and fy of a pinhole.
        center: px, cx and cy, its principal point.
        scales: m, scale_i, the periods of the octaves.
        weights: (N, octaves), w_i, not all 0.
        contrast: (N,), c, the standard deviation of ln q.
        frame: (N,), t.
        wind: (N, 3), m per frame, to the right, down and ahead, as the camera sees it.
        decorrelation: (N,), frames, above 0, after which q in the wind is correlated with itself by 1 / e, so that g
            is by exp(-t^2 ln(1 / r) / decorrelation^2), r = ln(1 + (exp(c^2) - 1) / e) / c^2; may be inf.
        reach: m.
        dtype: of the result.

    Returns:
        (N, 1, H, W), 0 or above.

    Source: for volumes of rays and slices, Wronski, "Volumetric fog", SIGGRAPH 2014.
    """
    if not len(key) * height * width:
        return distance.new_ones((len(key), 1, height, width), dtype=dtype)
    view, distance = _view(height, width, focal, center), distance.to(dtype)
    fog = _Fog(key, weights, contrast, frame, wind, decorrelation)
    # The result has its type whatever autocast would make of a matrix product.
    with torch.autocast(key.device.type, enabled=False):
        if torch.compiler.is_compiling() or key.device.type != "cpu" or len(key) == 1:
            return _path_mean(view, fog, distance, scales=scales, reach=reach)
        # Matrix products of several samples round in another way than those of one.
        each = zip(distance.expand(len(key), -1, -1, -1).split(1), *(value.split(1) for value in fog), strict=True)
        found = (_path_mean(view, _Fog(*one), d, scales=scales, reach=reach) for d, *one in each)
        return join(found, dim=0, length=len(key))


def _view(height: int, width: int, focal: tuple[float, float], center: tuple[float, float]) -> _View:
    longer = max(height, width)
    cell, down, across = longer / _CELLS, -(-height * _CELLS // longer), -(-width * _CELLS // longer)
    left, top = ((-0.5 - cell - c) / f for c, f in zip(center, focal, strict=True))
    rays = Rays(left, cell / focal[0], across + 3, top, cell / focal[1], down + 3)
    return _View(height, width, cell, down, across, rays)


def _path_mean(view: _View, fog: _Fog, distance: Tensor, *, scales: Sequence[float], reach: float) -> Tensor:
    volume = _volume(view.rays, fog, scales=scales, reach=reach, dtype=distance.dtype)
    volume = _keys(view.down, volume) @ volume
    look_up = _by_row if distance.shape[3] == 1 else _by_pixel
    return look_up(view, volume, distance, reach)


def _volume(rays: Rays, fog: _Fog, *, scales: Sequence[float], reach: float, dtype: torch.dtype) -> Tensor:
    """(N, slices + 1, rows, columns): m - 1 along each ray up to the slices d = reach n (n + 1) / (S (S + 1))."""
    excess = _excess(rays, fog, scales=scales, reach=reach, dtype=dtype)
    mean = _quadrature(excess) @ excess.flatten(2)
    x, y = rays.slopes(mean.device)
    n = torch.arange(_SLICES + 1, dtype=torch.float64, device=mean.device)
    # A ray is longer than its depth, and planes lie at squares.
    depth = (n * (n + 1) / (_SLICES * (_SLICES + 1)))[:, None] / (1 + x * x + (y * y)[:, None]).sqrt().flatten()
    place = _PLANES * depth.sqrt()
    first = place.long().clamp(max=_PLANES - 1)
    part, index = (place - first).to(dtype), first.expand(len(mean), -1, -1)
    volume = torch.lerp(mean.gather(1, index), mean.gather(1, index + 1), part)
    return volume.view(-1, _SLICES + 1, rays.rows, rays.columns)


def _excess(rays: Rays, fog: _Fog, *, scales: Sequence[float], reach: float, dtype: torch.dtype) -> Tensor:
    """(N, planes + 2, rows, columns): q - 1 on the planes."""
    depths = [reach * (k / _PLANES) ** 2 for k in range(_PLANES + 2)]
    lengths = [2 * reach * k / _PLANES**2 for k in range(_PLANES + 2)]  # between planes
    cell = max(rays.step_x, rays.step_y)
    apart = [max(cell * depth, length / _LONGER) for depth, length in zip(depths, lengths, strict=True)]
    weights, frame = fog.weights.double(), fog.frame.double()
    contrast = or_else(fog.contrast.double(), 0.0).clamp(0, _MOST_CONTRAST)
    share = weights * (contrast / (VARIANCE * weights.square().sum(dim=1)).sqrt())[:, None]
    period, apart_m, length_m = (
        constant(value, dtype=weights.dtype, device=weights.device) for value in (scales, apart, lengths)
    )
    amplitude = share[:, :, None] * _damping(apart_m / period[:, None], length_m / period[:, None])
    noise = noise_on_planes(
        fog.key,
        rays,
        depths,
        periods=scales,
        planes=[sum(one < _SPARSEST * scale for one in apart) for scale in scales],
        amplitude=amplitude.to(dtype),
        moved=fog.wind.double() * frame[:, None],
        turns=frame / fog.decorrelation.double() * _pace(contrast.square()),
    )
    half = VARIANCE / 2 * amplitude.square().sum(dim=1)
    return torch.expm1(noise - half.to(dtype)[:, :, None, None])


def _pace(variance: Tensor) -> Tensor:
    """How much slower a Gaussian field of a variance forgets itself than its exponential, up to a correlation of 1/e.

    The exponentials of two Gaussians of variance v and correlation r are correlated by (exp(v r) - 1) / (exp(v) - 1).
    """
    share, little = math.exp(-1), variance < 1e-4
    some = torch.where(little, 1.0, variance)
    # ln(1 + (exp(v) - 1) / e), which overflows for no v.
    left = torch.logaddexp(some - 1, torch.full_like(some, math.log1p(-share))) / some
    return torch.where(little, share + variance * (share - share * share) / 2, left).log().neg().sqrt()


def _damping(apart: Tensor, length: Tensor) -> Tensor:
    """How much of an octave there is where rays lie so many of its periods apart, and planes so many."""
    sparse = ((apart - _SPARSE) / (_SPARSEST - _SPARSE)).clamp(0, 1)
    return (1 - sparse * sparse * (3 - 2 * sparse)) * deviation_of_mean(length)


def _quadrature(like: Tensor) -> Tensor:
    """(planes + 1, planes + 2): from values on the planes to their mean from the camera to each plane.

    With z = reach (k / K)^2 the mean up to plane i is the integral of 2 k / i^2 q(k) from 0 to i: the trapezoid rule,
    and corrections at both ends that make its error one of fourth order.
    """
    k = torch.arange(_PLANES + 2, dtype=torch.float64, device=like.device)
    end = k[:-1, None]
    lag = end - k
    weight = (lag >= 1).double() + (lag == 1) / 24 + (lag == 0) / 2 - (lag == -1) / 24 + (lag >= 0) * (k == 1) / 12
    return torch.where(end == 0, (k == 0).double(), 2 * k / end.clamp(min=1).square() * weight).to(like.dtype)


def _keys(cells: int, like: Tensor) -> Tensor:
    """(finer cells + 1, cells + 3): from rays to a finer lattice, by Keys' cubic of a = -1/2."""
    fine = torch.arange(cells * _FINER + 1, dtype=torch.float64, device=like.device) / _FINER
    x = (fine[:, None] + 1 - torch.arange(cells + 3, dtype=torch.float64, device=like.device)).abs()
    near, far = (1.5 * x - 2.5) * x * x + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    return torch.where(x < 1, near, torch.where(x < 2, far, 0)).to(like.dtype)


def _slice(distance: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """The slice below a distance, the part of the way to the next, and reach / d, at most 1."""
    scale = _SLICES * (_SLICES + 1) / reach
    # n (n + 1) = scale d has a slope in d at 0 too.
    place = distance.clamp(max=reach).mul_(scale).add_(0.25).sqrt_()
    first = place.detach().sub(0.5).floor_().clamp(max=_SLICES - 1)
    return first, place - (first + 0.5), reach / distance.clamp(min=reach)


def _by_row(view: _View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
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
    keys = _keys(view.across, volume)
    across = torch.lerp(keys[x], keys[x + 1], dx[:, None])
    # The product adds 1, too. Cubics overshoot where the contrast is high.
    mean = F.pad(sum(others, first), (0, 1), value=1.0) @ F.pad(across, (0, 1), value=1.0).T
    return mean.relu_().unsqueeze(1)


def _places(pixels: int, cell: float, cells: int, like: Tensor) -> tuple[Tensor, Tensor]:
    place = (torch.arange(pixels, dtype=torch.float64, device=like.device) + 0.5) * (_FINER / cell)
    first = place.floor().clamp(max=cells * _FINER - 1)
    return first.long(), (place - first).to(like.dtype)


def _by_pixel(view: _View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
    """m for distances (N or 1, 1, H, W)."""
    volume = volume @ _keys(view.across, volume).T
    rows, columns = volume.shape[2:]
    # One slice below the other as an image, the next slice as its second channel.
    pairs = torch.stack([volume[:, :-1], volume[:, 1:]], dim=1).flatten(2, 3)
    x, y = (
        (2 * (torch.arange(n, dtype=torch.float64, device=volume.device) + 0.5) * (_FINER / view.cell) + 1) / size
        for n, size in ((view.width, columns), (view.height, rows * _SLICES))
    )
    x, y = (x - 1).to(volume.dtype), (y - 1).to(volume.dtype)[:, None]
    at_once = view.height
    if not learns((pairs,)):
        at_once = rows_at_once(pairs.device, at_once, each=view.width, cached=_CACHED)
    bands = (
        _looked_up(pairs, band, x, middle, reach)
        for band, middle in zip(distance.split(at_once, dim=2), y.split(at_once), strict=True)
    )
    return join(bands, dim=2, length=view.height)


def _looked_up(pairs: Tensor, distance: Tensor, x: Tensor, y: Tensor, reach: float) -> Tensor:
    first, part, share = _slice(distance, reach)
    y = first[:, 0].mul_(2 / _SLICES) + y
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
