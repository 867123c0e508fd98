"""Volumetric fog: the mean extinction along the ray of each pixel, through a random field in space that moves.

The field is evaluated on planes across the camera's axis, along a coarse grid of rays. Means along these rays up to a
set of distances make a volume in front of the camera, from which every pixel is interpolated.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, exact_matmul, shareable, without_autocast
from torchrefract._validation import finite_or
from torchrefract.fields.perlin import fade_out
from torchrefract.fields.random_field import Motion
from torchrefract.random import lattice_noise
from torchrefract.warping.flow import keys_cubic

# Variance of the noise over all gradients and places in a cell. Each of the 8 nodes adds a third of the mean of
# (h(p) h(q) h(r))^2 (p^2 + q^2 + r^2); the mean of h^2 is 181 / 462, that of (h p)^2 is 535 / 18018.
VARIANCE = 8 * (181 / 462) ** 2 * (535 / 18018)
# 1 / r, 1 / r^2 and 1 / r^3 with r^4 = r + 1: multiples of them stay apart modulo 1, so octaves share no nodes.
_PHASES = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
_UPPER = 2048  # a number of 23 bits makes two: its upper 11 bits and the others
# The coordinates of a node become one number modulo 2^32, so many to a line; octaves are so many planes apart.
_LINE = 2048
_OCTAVE = 633

_PLANES = 64  # across the axis, on which the field is evaluated
_SLICES = 48  # of the distance, up to which means are kept
_CELLS = 48  # between rays, over the longer side of the frame
_FINER = 2  # cells of the image lattice per cell between rays; pixels are interpolated from it linearly
# An octave fades out where rays are so many of its periods apart, or planes `_LONGER` times as many.
_SPARSE, _SPARSEST = 0.4, 0.8
_LONGER = 5.0
_MAX_CONTRAST = 30.0  # above it the exponentials leave float32


class Rays(NamedTuple):
    """The rays from the camera through the points (left + j step_x, top + i step_y) of the plane z = 1."""

    left: float
    step_x: float
    columns: int
    top: float
    step_y: float
    rows: int

    def slopes(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return x / z, (columns,), and y / z, (rows,), float64."""
        j, i = (torch.arange(n, dtype=torch.float64, device=device) for n in (self.columns, self.rows))
        return self.left + self.step_x * j, self.top + self.step_y * i

    def box(self, depth: float) -> list[tuple[float, float]]:
        """Return (low, high) in x, y and z of the space that the rays cross from the camera to a depth."""
        right, bottom = self.left + self.step_x * (self.columns - 1), self.top + self.step_y * (self.rows - 1)
        ends = ((self.left, right), (self.top, bottom), (0.0, 1.0))
        return [(depth * min(0.0, low), depth * max(0.0, high)) for low, high in ends]


class ExtinctionField(NamedTuple):
    """The random extinction of each sample, see `mean_extinction_along_rays`.

    key: (N, 4), int64, of `noise_key`.
    weights: (N, octaves), w_i, not all 0.
    contrast: (N,), c, the standard deviation of ln q.
    motion: wind: (N, 3), m per frame, to the right, down and ahead, as seen by the camera; decorrelation: (N,), frames,
        after which q in the wind has the correlation 1 / e with itself, so that that of g is
        exp(-t^2 ln(1 / r) / decorrelation^2), r = ln(1 + (exp(c^2) - 1) / e) / c^2.
    """

    key: Tensor
    weights: Tensor
    contrast: Tensor
    motion: Motion


class View(NamedTuple):
    """The grid of rays of a frame, with one more ray beyond each edge."""

    height: int
    width: int
    cell: float  # px between rays
    down: int  # cells
    across: int
    rays: Rays


def mean_extinction_along_rays(
    field: ExtinctionField,
    distance: Tensor,
    *,
    height: int,
    width: int,
    focal: tuple[float, float],
    center: tuple[float, float],
    scales: Sequence[float],
    reach: float,
) -> Tensor:
    """Average a random extinction q > 0 with E q = 1 along the ray of each pixel, from the camera to its distance.

        m = (1 / d) integral over s from 0 to d of q(s r) up to the reach, m = 1 + (m(reach) - 1) reach / d beyond it
        q(X) = exp(c g - c^2 / 2),  g = sum of w_i n_i / sqrt(VARIANCE sum of w_i^2),  n_i as by `noise_on_planes`

    q is evaluated on planes at (k / 64)^2 of the reach, along 48 rays over the longer side of the frame. m is
    interpolated cubically between rays and linearly between 48 slices of d. Noise that these cannot resolve is left out
    of g and of its variance, so that E q = 1: an octave fades out where rays are 0.4 to 0.8 of its periods apart or
    planes 2 to 4, and on a plane its deviation is that of its mean up to the next plane. Perlin noise is bounded, as a
    Gaussian is not: for four octaves E q is 0.99 at c = 1, and 0.89 at c = 2.

    Args:
        field: of N samples.
        distance: (N or 1, 1, H, 1 or W), m, d along the ray, at least 0, may be inf; gives the type.
        height, width: px, of the frame.
        focal, center: px, fx and fy of a pinhole camera, and cx and cy of its principal point.
        scales: m, the periods of the octaves.
        reach: m; beyond it the fog is uniform.

    Returns:
        (N, 1, H, W), 0 or above.

    Source: Wronski, "Volumetric fog", SIGGRAPH 2014, for volumes of rays and slices.
    """
    view = make_view(height, width, focal, center)
    with without_autocast(distance.device):  # it would round the products of matrices
        excess = extinction_on_planes(field, view.rays, scales=scales, reach=reach, dtype=distance.dtype)
        volume = _means_up_to_slices(view.rays, excess)
        volume = exact_matmul(_cubic_weights(view.down, volume), volume)
        interpolate = _interpolate_rows if distance.shape[3] == 1 else _interpolate_pixels
        return interpolate(view, volume, distance, reach)


def make_view(height: int, width: int, focal: tuple[float, float], center: tuple[float, float]) -> View:
    """Lay a grid of 48 cells over the longer side of a frame."""
    longer = max(height, width)
    cell, down, across = longer / _CELLS, -(-height * _CELLS // longer), -(-width * _CELLS // longer)
    left, top = ((-0.5 - cell - c) / f for c, f in zip(center, focal, strict=True))
    rays = Rays(left, cell / focal[0], across + 3, top, cell / focal[1], down + 3)
    return View(height, width, cell, down, across, rays)


@shareable
def extinction_on_planes(
    field: ExtinctionField, rays: Rays, *, scales: Sequence[float], reach: float, dtype: torch.dtype
) -> Tensor:
    """Evaluate q - 1 of `mean_extinction_along_rays` on its planes and one more, (N, 66, rows, columns)."""
    device = field.key.device
    depths = [reach * (k / _PLANES) ** 2 for k in range(_PLANES + 2)]
    lengths = [2 * reach * k / _PLANES**2 for k in range(_PLANES + 2)]  # between planes
    cell = max(rays.step_x, rays.step_y)
    apart = [max(cell * depth, length / _LONGER) for depth, length in zip(depths, lengths, strict=True)]
    period, apart_m, length_m = (
        as_device_tensor(value, dtype=torch.float64, device=device) for value in (scales, apart, lengths)
    )
    sparse = ((apart_m / period[:, None] - _SPARSE) / (_SPARSEST - _SPARSE)).clamp(0, 1)
    damping = (1 - sparse * sparse * (3 - 2 * sparse)) * deviation_of_mean(length_m / period[:, None])
    weights, frame = field.weights.double(), field.motion.frame.double()
    contrast = finite_or(field.contrast.double(), 0.0).clamp(0, _MAX_CONTRAST)
    deviation = weights * (contrast / (VARIANCE * weights.square().sum(dim=1)).sqrt())[:, None]
    amplitude = deviation[:, :, None] * damping
    noise = noise_on_planes(
        field.key,
        rays,
        depths,
        periods=scales,
        planes=[sum(value < _SPARSEST * scale for value in apart) for scale in scales],
        amplitude=amplitude.to(dtype),
        moved=field.motion.wind.double() * frame[:, None],
        turns=frame / field.motion.decorrelation.double() * log_field_pace(contrast.square()),
    )
    half_variance = VARIANCE / 2 * amplitude.square().sum(dim=1)
    return torch.expm1(noise - half_variance.to(dtype)[:, :, None, None])


def log_field_pace(variance: Tensor) -> Tensor:
    """Return by how much slower a Gaussian field decorrelates than its exponential, to a correlation of 1 / e.

    The exponentials of two Gaussians of variance v and correlation r are correlated by (exp(v r) - 1) / (exp(v) - 1).
    """
    share, is_small = math.exp(-1), variance < 1e-4
    safe = torch.where(is_small, 1.0, variance)
    # ln(1 + (exp(v) - 1) / e), which overflows for no v.
    correlation = torch.logaddexp(safe - 1, torch.full_like(safe, math.log1p(-share))) / safe
    series = share + variance * (share - share * share) / 2
    return torch.where(is_small, series, correlation).log().neg().sqrt()


def deviation_of_mean(length: Tensor) -> Tensor:
    """Return the standard deviation of the mean of the noise over a length along an axis, over that of the noise.

    (1 + (length / 0.851)^2)^(-1/4),  within 2.5 %; 0.851 periods are twice the integral of the correlation
    """
    return (1 + (length / 0.851).square()).pow(-0.25)


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
    """Sum octaves of Perlin's gradient noise in space, each times its amplitude, where rays cross planes.

        noise = sum over the 8 nodes around (x, y, z) of h(p) h(q) h(r) (g_x p + g_y q + g_z r)
        (p, q, r) = (x, y, z) - node,  h(p) = 1 - fade(|p|),  fade(s) = 6 s^5 - 15 s^4 + 10 s^3
        (x, y, z) = ((X, Y, Z) - moved) / period + phase

    Gradients have length 1, and phases are uniform. Each gradient turns on a great circle at a normal rate: the
    variance is constant, and the correlation with the noise at turns = 0 is exp(-turns^2).

    Args:
        key: (N, 4), int64, of `noise_key`.
        rays: in rows and columns.
        depths: K of them, m, of the planes, from near to far.
        periods: m, above 0, between two nodes, of each octave.
        planes: of each octave, at least 1: the number of planes, the nearest ones, that have it.
        amplitude: (N, octaves, K), gives the type.
        moved: (N, 3), m, how far the wind has carried the noise.
        turns: (N,), time over the time of decorrelation.

    Returns:
        (N, K, rows, columns); an octave has the standard deviation amplitude sqrt(VARIANCE).

    Source: Perlin, "Improving noise", SIGGRAPH 2002; Perlin and Neyret, "Flow noise", SIGGRAPH 2001 technical sketches,
    for the turning.
    """
    device, dtype = key.device, amplitude.dtype
    boxes = [rays.box(depths[count - 1] / period) for count, period in zip(planes, periods, strict=True)]
    nodes = [[math.ceil(high - low) + 2 for low, high in box] for box in boxes]
    lowest = [[low for low, _ in box] for box in boxes]
    low, period, phase, depth = (
        as_device_tensor(values, dtype=torch.float64, device=device) for values in (lowest, periods, _PHASES, depths)
    )
    phase = key[:, None, :3].double() * 2.0**-32 + torch.arange(1, len(periods) + 1, device=device)[:, None] * phase
    origin = phase.frac() - moved.double()[:, None] / period[:, None]
    # From the first node on, float32 suffices for positions, however far the wind has carried the noise.
    first = (origin.detach() + low).floor()
    gradients = _gradients(key, first.long(), nodes, turns, dtype=dtype)
    x, y = rays.slopes(device)
    total = amplitude.new_zeros(len(key), len(depths), rays.rows, rays.columns)
    for i, count in enumerate(planes):
        z = depth[:count] / periods[i]
        start = (origin - first)[:, i]
        hat_x, ramp_x = _weights(start[:, 0, None, None] + z[:, None] * x, nodes[i][0], dtype)
        hat_y, ramp_y = _weights(start[:, 1, None, None] + z[:, None] * y, nodes[i][1], dtype)
        hat_z, ramp_z = (weight.mT for weight in _weights(start[:, 2, None] + z, nodes[i][2], dtype))
        # h h h is a product: one axis after the other.
        gx, gy, gz = (
            exact_matmul(weight, gradient.flatten(2)).unflatten(2, gradient.shape[2:])
            for weight, gradient in zip((hat_z, hat_z, ramp_z), gradients[i], strict=True)
        )
        along = exact_matmul(gx, ramp_x) + exact_matmul(gz, hat_x)
        octave = exact_matmul(hat_y.mT, along) + exact_matmul(ramp_y.mT, exact_matmul(gy, hat_x))
        octave = octave * amplitude[:, i, :count, None, None]
        total = total + F.pad(octave, (0, 0, 0, 0, 0, len(depths) - count))
    return total


def _weights(position: Tensor, nodes: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Compute (..., nodes, places): h and h p of every node at positions (..., places)."""
    node = torch.arange(nodes, dtype=dtype, device=position.device)[:, None]
    distance = position.to(dtype).unsqueeze(-2) - node
    hat = fade_out(distance)
    return hat, hat * distance


def _gradients(
    key: Tensor, first: Tensor, nodes: Sequence[Sequence[int]], turns: Tensor, *, dtype: torch.dtype
) -> list[list[Tensor]]:
    """The three components of each octave at a box of nodes, (N, nodes along z, along y, along x)."""
    numbers = []
    for i, counts in enumerate(nodes):
        x, y, z = (first[:, i, axis, None] + torch.arange(n, device=key.device) for axis, n in enumerate(counts))
        plane = z[:, :, None, None] + i * _OCTAVE
        numbers.append((x[:, None, None] + _LINE * (y[:, None, :, None] + _LINE * plane)).flatten(1))
    scaled = _UPPER * lattice_noise(key, [torch.cat(numbers, dim=1)], 2)
    upper = scaled.floor()
    lower = scaled - upper
    # Whole turns are dropped in float64: late frames have many.
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


def _means_up_to_slices(rays: Rays, excess: Tensor) -> Tensor:
    """(N, slices + 1, rows, columns): m - 1 along each ray up to the slices d = reach n (n + 1) / (S (S + 1))."""
    mean = exact_matmul(_quadrature(excess), excess.flatten(2))
    x, y = rays.slopes(mean.device)
    n = torch.arange(_SLICES + 1, dtype=torch.float64, device=mean.device)
    # A ray is longer than its depth, and planes lie at squares.
    depth = (n * (n + 1) / (_SLICES * (_SLICES + 1)))[:, None] / (1 + x * x + (y * y)[:, None]).sqrt().flatten()
    plane = _PLANES * depth.sqrt()
    first = plane.long().clamp(max=_PLANES - 1)
    part, index = (plane - first).to(mean.dtype), first.expand(len(mean), -1, -1)
    volume = torch.lerp(mean.gather(1, index), mean.gather(1, index + 1), part)
    return volume.view(-1, _SLICES + 1, rays.rows, rays.columns)


def _quadrature(like: Tensor) -> Tensor:
    """(planes + 1, planes + 2): from values on the planes to their mean from the camera to each plane.

    With z = reach (k / K)^2 the mean up to plane i is the integral of 2 k / i^2 q(k) from 0 to i: the trapezoid rule,
    and corrections at both ends that make its error one of fourth order.
    """
    k = torch.arange(_PLANES + 2, dtype=torch.float64, device=like.device)
    end = k[:-1, None]
    lag = end - k
    after, at, before = ((lag == step).double() for step in (1, 0, -1))
    weight = (lag >= 1).double() + after / 24 + at / 2 - before / 24 + ((lag >= 0) & (k == 1)).double() / 12
    return torch.where(end == 0, (k == 0).double(), 2 * k / end.clamp(min=1).square() * weight).to(like.dtype)


def _cubic_weights(cells: int, like: Tensor) -> Tensor:
    """(finer cells + 1, cells + 3): from rays to a finer lattice, by Keys' cubic of a = -1/2."""
    fine = torch.arange(cells * _FINER + 1, dtype=torch.float64, device=like.device) / _FINER
    rays = torch.arange(cells + 3, dtype=torch.float64, device=like.device)
    return keys_cubic(fine[:, None] + 1 - rays).to(like.dtype)


def _slice_of(distance: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """The slice below a distance, the part of the way to the next, and reach / d, at most 1."""
    scale = _SLICES * (_SLICES + 1) / reach
    # n (n + 1) = scale d has a slope in d at 0 too.
    n = (distance.clamp(max=reach) * scale + 0.25).sqrt() - 0.5
    first = n.detach().floor().clamp(0, _SLICES - 1)
    return first, n - first, reach / distance.clamp(min=reach)


def _positions(pixels: int, cell: float, cells: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """The node of the finer lattice before each pixel, int64, and the part of the way to the next."""
    place = (torch.arange(pixels, dtype=torch.float64, device=like.device) + 0.5) * (_FINER / cell)
    first = place.floor().clamp(max=cells * _FINER - 1)
    return first.long(), (place - first).to(like.dtype)


def _interpolate_rows(view: View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
    """Compute m for distances (N or 1, 1, H, 1): each row of pixels reads one slice, so that matrix products serve."""
    first, part, share = (value.flatten(1) for value in _slice_of(distance, reach))
    y, dy = _positions(view.height, view.cell, view.down, volume)
    batch, slices, rows = volume.shape[:3]
    start = torch.arange(batch, device=volume.device)[:, None] * slices
    index, lines = (start + first.long()) * rows + y, volume.flatten(0, 2)
    near, far = share * (1 - part), share * part
    corners = ((0, near * (1 - dy)), (1, near * dy), (rows, far * (1 - dy)), (rows + 1, far * dy))
    row = torch.stack([lines[index + step] * weight[..., None] for step, weight in corners]).sum(dim=0)
    x, dx = _positions(view.width, view.cell, view.across, volume)
    finer = _cubic_weights(view.across, volume)
    mean = exact_matmul(row, torch.lerp(finer[x], finer[x + 1], dx[:, None]).T).add_(1)
    return mean.relu_().unsqueeze(1)  # cubics overshoot where the contrast is high


def _interpolate_pixels(view: View, volume: Tensor, distance: Tensor, reach: float) -> Tensor:
    """Compute m for distances (N or 1, 1, H, W)."""
    volume = exact_matmul(volume, _cubic_weights(view.across, volume).T)
    rows, columns = volume.shape[2:]
    # The slices lie below one another in one image, and the next slice of each is a second channel.
    pairs = torch.stack([volume[:, :-1], volume[:, 1:]], dim=1).flatten(2, 3)
    x, y = (
        ((2 * (torch.arange(n, dtype=torch.float64, device=volume.device) + 0.5) * (_FINER / view.cell) + 1) / size - 1)
        for n, size in ((view.width, columns), (view.height, rows * _SLICES))
    )
    first, part, share = _slice_of(distance, reach)
    y = first[:, 0] * (2 / _SLICES) + y.to(volume.dtype)[:, None]
    grid = torch.stack([x.to(volume.dtype).expand_as(y), y], dim=3).expand(len(pairs), -1, -1, -1)
    below, above = F.grid_sample(pairs, grid, align_corners=False).split(1, dim=1)
    return (torch.lerp(below, above, part) * share + 1).relu()
