"""Fog in space: the mean extinction along each pixel's ray, through banks and holes that drift and change."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._compiled import obstacle
from torchrefract._tensor import as_device_tensor, cat_bands, exact_matmul
from torchrefract._validation import finite_or, requires_grad, why_not_eager
from torchrefract.fields import fog_drawn
from torchrefract.fields.fog_view import SLICES, View, by_pixel, by_row, keys, view
from torchrefract.fields.perlin3d import VARIANCE, Rays, deviation_of_mean, noise_on_planes

_PLANES = 64  # across the axis, on which the field is evaluated
# An octave fades out where rays come to lie so many of its periods apart, or planes as many times as many.
_SPARSE, _SPARSEST = 0.4, 0.8
_LONGER = 5.0
_MOST_CONTRAST = 30.0  # from there on fog is all holes, and its exponentials leave float32
_FEWEST = 1 << 12  # pixels of a frame that kernels are asked for; smaller ones are PyTorch's to the last digit


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
    four octaves E q is 0.99 at c = 1, and 0.89 at c = 2. By a kernel m is as near to that of real numbers, and not the
    same in its last digits.

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
    own, distance = view(height, width, focal, center), distance.to(dtype)
    fog = _Fog(key, weights, contrast, frame, wind, decorrelation)
    if _may_be_drawn(fog, distance, pixels=height * width):
        return _by_kernel(own, fog, distance, scales=scales, reach=reach)
    # The result has its type whatever autocast would make of a matrix product.
    with torch.autocast(key.device.type, enabled=False):
        if torch.compiler.is_compiling() or key.device.type != "cpu" or len(key) == 1:
            return _path_mean(own, fog, distance, scales=scales, reach=reach)
        # Matrix products of several samples round in another way than those of one.
        each = zip(distance.expand(len(key), -1, -1, -1).split(1), *(value.split(1) for value in fog), strict=True)
        found = (_path_mean(own, _Fog(*one), d, scales=scales, reach=reach) for d, *one in each)
        return cat_bands(found, dim=0, length=len(key))


def _may_be_drawn(fog: _Fog, distance: Tensor, *, pixels: int) -> bool:
    """Whether kernels can make the means."""
    plain = pixels < _FEWEST or requires_grad((distance, *fog)) or obstacle(distance)
    return not (plain or any(map(why_not_eager, fog)))


def _by_kernel(own: View, fog: _Fog, distance: Tensor, *, scales: Sequence[float], reach: float) -> Tensor:
    planes = _planes(own.rays, tuple(scales), reach, fog.key.device)
    octaves = _octaves(fog, planes)
    drawn = fog_drawn.Drawn(fog.key, octaves.amplitude, octaves.half, octaves.moved, octaves.turns)
    volume = fog_drawn.Volume(own.rays, reach, tuple(scales), planes.counts, _PLANES)
    return fog_drawn.path_means(own, drawn, volume, distance)


def _path_mean(view: View, fog: _Fog, distance: Tensor, *, scales: Sequence[float], reach: float) -> Tensor:
    volume = _volume(view.rays, fog, scales=scales, reach=reach, dtype=distance.dtype)
    volume = exact_matmul(keys(view.down, volume), volume)
    sample_image = by_row if distance.shape[3] == 1 else by_pixel
    return sample_image(view, volume, distance, reach)


def _volume(rays: Rays, fog: _Fog, *, scales: Sequence[float], reach: float, dtype: torch.dtype) -> Tensor:
    """(N, slices + 1, rows, columns): m - 1 along each ray up to the slices d = reach n (n + 1) / (S (S + 1))."""
    excess = _excess(rays, fog, scales=scales, reach=reach, dtype=dtype)
    mean = exact_matmul(_quadrature(excess), excess.flatten(2))
    x, y = rays.slopes(mean.device)
    n = torch.arange(SLICES + 1, dtype=torch.float64, device=mean.device)
    # A ray is longer than its depth, and planes lie at squares.
    depth = (n * (n + 1) / (SLICES * (SLICES + 1)))[:, None] / (1 + x * x + (y * y)[:, None]).sqrt().flatten()
    place = _PLANES * depth.sqrt()
    first = place.long().clamp(max=_PLANES - 1)
    part, index = (place - first).to(dtype), first.expand(len(mean), -1, -1)
    volume = torch.lerp(mean.gather(1, index), mean.gather(1, index + 1), part)
    return volume.view(-1, SLICES + 1, rays.rows, rays.columns)


class _Planes(NamedTuple):
    """Where the field is evaluated."""

    depths: tuple[float, ...]  # m
    counts: tuple[int, ...]  # of each octave: only so many, the nearest, have it
    damping: Tensor  # (octaves, planes + 2)


def _planes(rays: Rays, scales: tuple[float, ...], reach: float, device: torch.device) -> _Planes:
    depths = tuple(reach * (k / _PLANES) ** 2 for k in range(_PLANES + 2))
    lengths = [2 * reach * k / _PLANES**2 for k in range(_PLANES + 2)]  # between planes
    cell = max(rays.step_x, rays.step_y)
    apart = [max(cell * depth, length / _LONGER) for depth, length in zip(depths, lengths, strict=True)]
    counts = tuple(sum(one < _SPARSEST * scale for one in apart) for scale in scales)
    period, apart_m, length_m = (
        as_device_tensor(value, dtype=torch.float64, device=device) for value in (scales, apart, lengths)
    )
    return _Planes(depths, counts, _damping(apart_m / period[:, None], length_m / period[:, None]))


class _Octaves(NamedTuple):
    """What ln q, a sum of octaves less its half variance, is made of on the planes, in float64."""

    amplitude: Tensor  # (N, octaves, planes + 2)
    half: Tensor  # (N, planes + 2)
    moved: Tensor  # (N, 3), m
    turns: Tensor  # (N,)


def _octaves(fog: _Fog, planes: _Planes) -> _Octaves:
    weights, frame = fog.weights.double(), fog.frame.double()
    contrast = finite_or(fog.contrast.double(), 0.0).clamp(0, _MOST_CONTRAST)
    share = weights * (contrast / (VARIANCE * weights.square().sum(dim=1)).sqrt())[:, None]
    amplitude = share[:, :, None] * planes.damping
    half = VARIANCE / 2 * amplitude.square().sum(dim=1)
    turns = frame / fog.decorrelation.double() * _pace(contrast.square())
    return _Octaves(amplitude, half, fog.wind.double() * frame[:, None], turns)


def _excess(rays: Rays, fog: _Fog, *, scales: Sequence[float], reach: float, dtype: torch.dtype) -> Tensor:
    """(N, planes + 2, rows, columns): q - 1 on the planes."""
    planes = _planes(rays, tuple(scales), reach, fog.key.device)
    amplitude, half, moved, turns = _octaves(fog, planes)
    noise = noise_on_planes(
        fog.key,
        rays,
        planes.depths,
        periods=scales,
        planes=planes.counts,
        amplitude=amplitude.to(dtype),
        moved=moved,
        turns=turns,
    )
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
