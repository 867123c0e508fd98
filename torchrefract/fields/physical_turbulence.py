"""Turbulent air along the rays of a camera: angles of arrival from layers of air with a von Karman spectrum.

The variance of the angle of arrival of a point at the distance L, along each axis, is

    sigma^2 = 2 pi int_0^L ds Cn2(s) (1 - s/L)^2 int d^2k kx^2 Phi(k) A(k D (1 - s/L)),
    Phi = 0.033 (k^2 + k0^2)^(-11/6) exp(-(k / km)^2),  k0 = 2 pi / L0,  km = 5.92 / l0,  A(u) = (2 J1(u/2) / (u/2))^2

for an aperture D, an inner scale l0 and an outer scale L0, in m. No wavelength counts. Layers are the gradients of
potentials, so the field of each has no curl; depth changes their weights alone. The spectrum of a layer is the integral
over all air in it, so a few layers have the correlations of the whole path.

Source: Tatarskii, "Wave propagation in a turbulent medium" (1961); Andrews and Phillips, "Laser beam propagation
through random media" (2005), section 6.5; Wyngaard, Izumi, Collins, "Behavior of the refractive-index-structure
parameter near the ground", JOSA 61 (1971), for the decrease with height.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor, cached_constant, exact_matmul, shareable
from torchrefract._validation import why_not_eager
from torchrefract.fields.random_field import fast_size, periodic_part, turn_waves
from torchrefract.random import white_noise

GREEN = 550e-9  # m, wavelength of the light that counts most

_RATIO = 5.0  # of the far ends of successive layers
_HEIGHT_EXPONENT = -4 / 3  # of Cn2, by day
_NEAREST = 1e-3  # of the reach
_SMALLEST_DOMAIN = 8  # px; smaller ones have hardly any frequency that has a derivative
# Clamps, since torch.where takes several times as long; the third power of the first one is a normal float32.
_SMALLEST_BASE, _SMALLEST_SQUARE = 2.0**-40, 2.0**-66
_NUM_GAINS = 513  # nodes of the table of gains
_NUM_DENSITIES = 1025  # nodes of the table of densities, over more than twenty e-foldings
_SUBCELLS = (-0.5 / math.sqrt(3), 0.5 / math.sqrt(3))  # Gauss-Legendre, of a cell


class Air(NamedTuple):
    """Aperture and turbulence, m: aperture D, inner scale l0, outer scale L0."""

    aperture: float
    inner_scale: float
    outer_scale: float


@dataclass(frozen=True)
class Layers:
    """Layers of air, from the camera to the reach; layer k lies between edges k and k + 1.

    edges: m, the first one is 0 and the last one the reach.
    distances: m, the mean one of each layer, at which the wind moves it.
    densities: of each layer, the table of `_densities`.
    air: aperture and scales.
    exponent: m in [8/3, 3]: a stretch of air at s adds to the variance of a path of length L as (1 - s/L)^(m - 1).
    gains: the table of `height_gain`.
    """

    edges: tuple[float, ...]
    distances: tuple[float, ...]
    densities: tuple[tuple[float, ...], ...]
    air: Air
    exponent: float
    gains: tuple[float, ...]


def tilt_variance(distance: float, air: Air) -> float:
    """Return the variance of the angle of arrival along one axis, rad^2, for Cn2 = 1, m^(-2/3), everywhere.

    Multiply it by Cn2. For D >> l0 it is 1.062 L D^(-1/3), for D << l0 1.093 L l0^(-1/3).

    Args:
        distance: m, L.
        air: aperture and scales.
    """
    return 2 * math.pi * distance * _strength(air) / _exponent(air)


def fried_parameter(cn2: float, distance: float, *, wavelength: float = GREEN) -> float:
    """Return Fried's parameter of a level path with the same air everywhere, m; inf without turbulence.

        r0 = (0.423 k^2 int_0^L Cn2 (1 - s/L)^(5/3) ds)^(-3/5) = (0.423 k^2 Cn2 L 3/8)^(-3/5),  k = 2 pi / wavelength

    An aperture D blurs short exposures by diffraction alone while D / r0 is below about 1; see
    `torchrefract.fields.turbulence_blur`.

    Args:
        cn2: m^(-2/3), at least 0.
        distance: m, L.
        wavelength: m.

    Source: Fried, "Optical resolution through a randomly inhomogeneous medium for very long and very short exposures",
    JOSA 56 (1966), for a spherical wave.
    """
    strength = 0.423 * (2 * math.pi / wavelength) ** 2 * cn2 * distance * 3 / 8
    return strength**-0.6 if strength > 0 else math.inf


@lru_cache(maxsize=64)
def layers_of(reach: float, count: int, air: Air) -> Layers:
    """Divide the path up to a reach, m, into layers whose far ends form a geometric series."""
    exponent = _exponent(air)
    edges = (0.0, *(reach * _RATIO ** (k - count + 1) for k in range(count)))
    distances, densities = [], []
    for start, end in pairwise(edges):
        s = start + (end - start) * (np.arange(1000) + 0.5) / 1000
        # The correlation is nearly linear in the cubic root of the distance.
        distances.append(float(np.average(np.cbrt(s), weights=(1 - s / reach) ** (exponent - 1)) ** 3))
        densities.append(_densities(start, end, reach, air))
    return Layers(edges, tuple(distances), tuple(densities), air, exponent, height_gains(exponent))


def layer_shares(depth: Tensor, layers: Layers) -> list[Tensor]:
    """Return the weight of each layer for a pixel at a depth, relative to the standard deviation at the reach.

        w_k^2 = (d / R) ((1 - a_k / d)_+^m - (1 - a_(k+1) / d)_+^m),  sum_k w_k^2 = d / R,  d = min(depth, reach R)

    It is the root mean square of the weight 1 - s/d over the part of the layer in front of the pixel.

    Args:
        depth: m, of any shape, inf for the sky.
        layers: with edges a_k and exponent m.
    """
    reach = layers.edges[-1]
    share = (depth / reach).clamp(_NEAREST, 1.0)
    inverse = 1 / share
    beyond = [_power(1 - edge / reach * inverse, layers.exponent) for edge in layers.edges[1:-1]]
    powers = [torch.ones_like(share), *beyond, torch.zeros_like(share)]
    return [_root(share * (near - far)) for near, far in pairwise(powers)]


def height_gain(end_height: Tensor, gains: Sequence[float]) -> Tensor:
    """Return the standard deviation of the angle of arrival relative to that of a level ray.

        gain^2 = m int_0^1 x^(m - 1) (e + (1 - e) x)^(-4/3) dx

    Cn2 falls with the height above the ground as h^(-4/3). The ray leads from the camera, x = 1, to the height e.

    Args:
        end_height: e, of the end of each ray, in heights of the camera, of any shape; below 0 counts as 0.
        gains: the table of `height_gains` for m.
    """
    table = as_device_tensor(gains, dtype=end_height.dtype, device=end_height.device)
    # The gain is smooth in 1 / (1 + e^(1/3)).
    return _interpolate(table, (_NUM_GAINS - 1) / (1 + _power(end_height, 1 / 3)))


def layer_gradients(
    key: Tensor,
    layers: Layers,
    *,
    focal: tuple[float, float],
    size: tuple[int, int],
    rows: range,
    columns: range,
    shift: Tensor | None,
    dtype: torch.dtype,
) -> Iterator[list[Tensor]]:
    """Compute the gradient of each layer's potential, with a variance of 1 along each axis.

    The potential is periodic, and its spectrum is that of the air as far as pixels resolve it. The variance of what
    they do not resolve is spread evenly over all frequencies, and that of waves longer than the domain is a uniform
    tilt.

    Args:
        key: (N, 4), int64, of the white noise.
        layers: of the path.
        focal: px, fx and fy.
        size: (Ht, Wt), px, even, of the periodic domain.
        rows, columns: px, where the gradient is computed.
        shift: (N, 2), m, of the air to the right and down since frame 0; None is 0.
        dtype: of the result.

    Yields:
        For each layer two tensors (N, 1, n, m), along x and along y.
    """
    options = {"focal": focal, "size": size, "rows": rows, "columns": columns, "dtype": dtype}
    for k, distance in enumerate(layers.distances):
        yield _layer_gradient(key, layers, k, moved=shift if shift is None else shift / distance, **options)


@shareable
def _layer_gradient(
    key: Tensor,
    layers: Layers,
    k: int,
    *,
    moved: Tensor | None,
    focal: tuple[float, float],
    size: tuple[int, int],
    rows: range,
    columns: range,
    dtype: torch.dtype,
) -> list[Tensor]:
    """Compute the gradient of layer k of `layer_gradients`, moved by angles (N, 2), rad."""
    height, half = size[0], size[1] // 2 + 1
    count = height * half
    noise = white_noise(key, count, start=k * count).to(dtype).unflatten(2, (height, half))
    # A FakeTensor cannot be mixed with cached values, which must not be written to.
    amplitudes = _cached_amplitudes if why_not_eager(key) is None else _amplitudes
    amplitude, uniform = amplitudes(layers, k, focal, size, dtype, key.device)
    values = noise * amplitude
    if moved is not None:
        values = _moved(values, moved, focal, size)
    qy, qx = (q.to(dtype) for q in _frequencies(focal, size, key.device))
    return _gradient(values, noise[:, :, :1, :1] * uniform, (qx, qy), size, rows, columns)


def domain_size(height: int, width: int) -> tuple[int, int]:
    """Return (Ht, Wt), px: the periodic domain of a frame."""
    return fast_size(max(height, _SMALLEST_DOMAIN)), fast_size(max(width, _SMALLEST_DOMAIN))


def _spectrum(k: Tensor, air: Air) -> Tensor:
    """Return k^2 Phi(k) A(k D) at wave numbers k, 1/m, float64."""
    k0, km = 2 * math.pi / air.outer_scale, 5.92 / air.inner_scale
    u = (k * (air.aperture / 2)).clamp(min=1e-6)
    seen = (2 * torch.special.bessel_j1(u) / u).square()
    return 0.033 * k.square() * (k.square() + k0 * k0) ** (-11 / 6) * torch.exp(-(k / km).square()) * seen


@lru_cache(maxsize=4096)
def _strength(air: Air) -> float:
    """Return int kx^2 Phi A d^2k = pi int k (k^2 Phi A) dk, rad^2/m, for Cn2 = 1."""
    k = _wave_numbers(1.0, air)
    return _variance_up_to(k, _spectrum(k, air))[-1].item()


@lru_cache(maxsize=64)
def _exponent(air: Air) -> float:
    """Return m with int_0^1 x^2 v(D x) dx = v(D) / m, v the strength: 3 for D << l0, 8/3 for D >> l0."""
    x, weight = np.polynomial.legendre.leggauss(24)
    x, weight = (x + 1) / 2, weight / 2
    values = [_strength(air._replace(aperture=air.aperture * share)) for share in x.tolist()]
    return _strength(air) / float(weight @ (x * x * np.array(values)))


def _densities(start: float, end: float, reach: float, air: Air) -> tuple[float, ...]:
    """Return p of a layer at angular wave numbers q, 1/rad, at equal steps of ln q from 1e-6 k0 end to 5 km end.

        p(q) = c int ds (1 - s/R)^2 (k^2 Phi A)(q / s) / s^2 between its edges,  pi int q p(q) dq = 1

    That is the variance along one axis; A is that of the width D (1 - s/R) which the light of the reach R has at s.
    """
    y, weight = np.polynomial.legendre.leggauss(24)
    near, far = np.cbrt([start, end])
    root = near + (far - near) * (y + 1) / 2  # the correlation is nearly linear in it
    q = _wave_numbers(end, air)
    density = torch.zeros_like(q)
    for s, w in zip((root**3).tolist(), (weight * root**2).tolist(), strict=True):
        width = 1 - s / reach
        density += w * (width / s) ** 2 * _spectrum(q / s, air._replace(aperture=air.aperture * width))
    return tuple((density / _variance_up_to(q, density)[-1]).tolist())


def _wave_numbers(end: float, air: Air, device: torch.device | None = None) -> Tensor:
    """Return q of the table of densities of a layer up to a distance, 1/rad, float64."""
    low, high = 1e-6 * 2 * math.pi / air.outer_scale * end, 5 * 5.92 / air.inner_scale * end
    exponents = torch.linspace(0, 1, _NUM_DENSITIES, dtype=torch.float64, device=device or torch.device("cpu"))
    return low * (high / low) ** exponents


def _variance_up_to(q: Tensor, density: Tensor) -> Tensor:
    """Return pi int q p dq up to each of the wave numbers, by trapezoids over their logarithms."""
    values = math.pi * q.square() * density
    steps = (q[1:] / q[:-1]).log() * (values[1:] + values[:-1]) / 2
    return torch.cat([torch.zeros_like(q[:1]), steps.cumsum(dim=0)])


def _interpolate(table: Tensor, place: Tensor) -> Tensor:
    """Interpolate a table linearly at fractional indices of any shape."""
    low = place.detach().floor().clamp(0, len(table) - 2)
    index = low.long().flatten()
    near, far = (table.index_select(0, index + step).view_as(place) for step in (0, 1))
    return near + (far - near) * (place - low)


@lru_cache(maxsize=64)
def height_gains(exponent: float) -> tuple[float, ...]:
    """Return the table of `height_gain` for the exponent m, over 1 / (1 + e^(1/3)) from 0 to 1."""
    y, weight = np.polynomial.legendre.leggauss(64)
    y, weight = (y + 1) / 2, weight / 2
    z = np.linspace(0, 1, _NUM_GAINS)
    e = (1 / np.maximum(z, 1e-9) - 1)[:, None] ** 3
    # The integrand is smooth in the cubic root of the distance to the lower end of the ray.
    x = np.where(e < 1, y**3, 1 - y**3)
    values = (exponent * x ** (exponent - 1) * (e + (1 - e) * x) ** _HEIGHT_EXPONENT * 3 * y * y) @ weight
    return tuple(np.where(z > 0, np.sqrt(values), 0.0).tolist())


def _frequencies(focal: tuple[float, float], size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return qy, (Ht, 1), and qx, (Wt / 2 + 1,), 1/rad, float64: wave numbers at a distance of 1 m."""
    height, width = size
    ky = torch.arange(height, dtype=torch.float64, device=device)
    ky = torch.where(2 * ky < height, ky, ky - height)[:, None]
    kx = torch.arange(width // 2 + 1, dtype=torch.float64, device=device)
    return ky * (2 * math.pi * focal[1] / height), kx * (2 * math.pi * focal[0] / width)


def _amplitudes(
    layers: Layers,
    k: int,
    focal: tuple[float, float],
    size: tuple[int, int],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor, Tensor]:
    """Return the factors of the noise, for the potential, (Ht, Wt / 2 + 1), and for the uniform tilt, (2, 1, 1)."""
    qy, qx = _frequencies(focal, size, device)
    cell_y, cell_x = (2 * math.pi * f / n for f, n in zip(focal[::-1], size, strict=True))
    table_q = _wave_numbers(layers.edges[k + 1], layers.air, device)
    density = as_device_tensor(layers.densities[k], dtype=torch.float64, device=device)

    def at(table: Tensor, q: Tensor) -> Tensor:
        place = (q / table_q[0]).log() / (table_q[1] / table_q[0]).log()
        return _interpolate(table, place.clamp(0, _NUM_DENSITIES - 1))

    power = torch.zeros(qy.shape[0], qx.shape[0], dtype=torch.float64, device=device)
    for dy in _SUBCELLS:  # the spectrum is steep at the lowest frequencies
        for dx in _SUBCELLS:
            power = power + at(density, torch.hypot(qy + dy * cell_y, qx + dx * cell_x)) / 4
    power = power * (cell_x * cell_y)
    # The highest frequency of an even size has no derivative, and that of 0 is the uniform tilt.
    ky, kx = (torch.arange(n, device=device) for n in power.shape)
    is_used = (ky[:, None] != size[0] // 2) & (kx != size[1] // 2) & ((ky[:, None] != 0) | (kx != 0))
    times = (2 - (kx == 0).to(power.dtype)) * is_used  # how often a frequency of the half occurs among all
    radius = torch.full((1,), math.sqrt(cell_x * cell_y / math.pi), dtype=torch.float64, device=device)
    uniform = at(_variance_up_to(table_q, density), radius)[0].clamp(max=1)
    missing = (1 - uniform - (power * times).sum() / 2).clamp(min=0)
    power = (power + 2 * missing / times.sum()) * is_used
    power = power * ((1 - uniform) / ((power * times).sum() / 2))
    q = torch.hypot(qy, qx).clamp(min=1e-12)
    # A frame that is not square resolves more of the long waves along one axis than along the other.
    variances = [1 - (power * times * (along / q).square()).sum() for along in (qx, qy)]
    uniform = torch.stack(variances).clamp(min=0).sqrt().view(2, 1, 1)
    amplitude = (power / (2 - (kx == 0).to(power.dtype))).sqrt() / q
    return amplitude.to(dtype), uniform.to(dtype)


_cached_amplitudes = cached_constant(maxsize=16)(_amplitudes)


def _moved(values: Tensor, angle: Tensor, focal: tuple[float, float], size: tuple[int, int]) -> Tensor:
    """Move waves (N, 2, Ky, Kx), real and imaginary part, by angles (N, 2), rad, to the right and down."""
    qy, qx = _frequencies(focal, size, values.device)
    # Whole turns are subtracted in float64, so that late frames are as exact as the first.
    phase_x, phase_y = angle[:, 0, None, None].double() * qx, angle[:, 1, None, None].double() * qy
    phase = (phase_x + phase_y).remainder(2 * math.pi).to(values.dtype)
    return turn_waves(values, -phase)


def _gradient(
    values: Tensor,
    uniform: Tensor,
    wave_numbers: tuple[Tensor, Tensor],
    size: tuple[int, int],
    rows: range,
    columns: range,
) -> list[Tensor]:
    """Compute the gradient of Re sum_k c z_k exp(i q . p), along x and along y, c = 1 for kx = 0 and otherwise 2.

    Args:
        values: (N, 2, Ht, Wt / 2 + 1), real and imaginary part of i z, which are distributed as those of z.
        uniform: (N, 2, 1, 1), added to the gradient.
        wave_numbers: qx and qy.
        size: px, of the domain.
        rows, columns: px, of p.

    Returns:
        Two tensors (N, 1, n, m).
    """
    real, imaginary = values.split(1, dim=1)
    qx, qy = wave_numbers
    offsets = uniform.split(1, dim=1)
    if torch.compiler.is_compiling() or not len(values):  # the compiler supports no complex numbers
        return [
            _sum(real * q, imaginary * q, size, rows, columns) + offset
            for q, offset in zip((qx, qy), offsets, strict=True)
        ]
    spectrum = torch.complex(real, imaginary)
    along_x = periodic_part(torch.fft.ifft(spectrum, dim=2, norm="forward"), 2, rows) * qx
    along_y = periodic_part(torch.fft.ifft(spectrum * qy, dim=2, norm="forward"), 2, rows)
    gradient = []
    for lines, offset in zip((along_x, along_y), offsets, strict=True):
        lines.narrow(3, 0, 1).add_(offset)  # kx = 0 is what all pixels of a row share
        gradient.append(periodic_part(torch.fft.irfft(lines, n=size[1], dim=3, norm="forward"), 3, columns))
    return gradient


def _sum(real: Tensor, imaginary: Tensor, size: tuple[int, int], rows: range, columns: range) -> Tensor:
    """Compute the sum of waves (N, 1, Ky, Kx) by products of matrices, (N, 1, n, m)."""
    ky, kx = (torch.arange(n, device=real.device) for n in real.shape[2:])
    turn_y, turn_x = (
        (torch.arange(span.start, span.stop, span.step, device=k.device)[:, None] * k).remainder(n).to(real.dtype)
        * (2 * math.pi / n)
        for span, k, n in zip((rows, columns), (ky, kx), size, strict=True)
    )
    cos, sin = turn_y.cos(), turn_y.sin()
    real_lines = exact_matmul(cos, real) - exact_matmul(sin, imaginary)
    imaginary_lines = exact_matmul(sin, real) + exact_matmul(cos, imaginary)
    times = 2 - (kx == 0).to(real.dtype)
    cos, sin = turn_x.cos() * times, turn_x.sin() * times
    return exact_matmul(real_lines, cos.mT) - exact_matmul(imaginary_lines, sin.mT)


def _power(value: Tensor, exponent: float) -> Tensor:
    """Return value^exponent, 0 up to rounding below 0; several times as fast as `pow`."""
    return (value.clamp(min=_SMALLEST_BASE).log() * exponent).exp()


def _root(value: Tensor) -> Tensor:
    """Return the square root less 2^-33, 0 with a gradient of 0 where the value is 0 or, by rounding, below."""
    return value.clamp(min=_SMALLEST_SQUARE).sqrt() - math.sqrt(_SMALLEST_SQUARE)
