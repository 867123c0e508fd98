"""Stationary Gaussian random fields with a given covariance, sampled exactly on a periodic domain by FFT.

The frame is cut out of a domain large enough that opposite edges of the frame are uncorrelated. The field is a sum of
waves, whose amplitudes are the roots of the eigenvalues of the covariance on that domain:

    field_1 + i field_2 = sum_k amplitude_k (n1_k + i n2_k) exp(-2 pi i k . p / size),  n1, n2 white noise

A sum of the lowest frequencies alone is cheaper, and can be evaluated at the nodes of a coarse lattice.

Source: Dietrich and Newsam, "Fast and exact simulation of stationary Gaussian processes through circulant embedding of
the covariance matrix", SIAM J. Sci. Comput. 18 (1997).
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import exact_matmul, shareable
from torchrefract.random import white_noise, white_noise_at
from torchrefract.warping.lattice import Lattice

# Lengths after which less than 4e-4 is left of each covariance.
REACH = {"exponential": 8.0, "gaussian": 5.0, "matern32": 6.0, "matern52": 6.0}
COVARIANCES = tuple(REACH)
_SMOOTHNESS = {"exponential": 0.5, "matern32": 1.5, "matern52": 2.5}  # nu of the Matern covariances
_APERTURE_REACH = 6.0  # margin of the domain in apertures: a smoothed field is correlated over sqrt(2) of them
_MAX_POINTS = 1 << 24  # larger domains need gigabytes
_ROUNDING = 5e-13  # of the transform, relative to the largest eigenvalue
_NEGLIGIBLE = 1e-16  # of an amplitude
_POINTS_AT_ONCE = 1 << 22  # frequencies of all samples that are in memory together


def covariance(distance: Tensor, length: Tensor, kind: str) -> Tensor:
    """Compute C(h), with C(0) = 1, at distances h in px for a correlation length l in px; the two broadcast.

        exponential  exp(-h / l)                       gaussian  exp(-h^2 / (2 l^2))
        matern32     (1 + a) exp(-a), a = sqrt(3) h / l
        matern52     (1 + a + a^2 / 3) exp(-a), a = sqrt(5) h / l

    Source: Rasmussen and Williams, "Gaussian processes for machine learning" (2006), section 4.2.
    """
    h = distance / length
    if kind == "gaussian":
        return torch.exp(-0.5 * h * h)
    if kind == "exponential":
        return torch.exp(-h)
    a = math.sqrt(3 if kind == "matern32" else 5) * h
    return (1 + a if kind == "matern32" else 1 + a + a * a / 3) * torch.exp(-a)


def gradient_rms(length: Tensor, *, kind: str, aperture: Tensor | None = None) -> Tensor:
    """Compute (N,), 1/px: the root mean square difference of neighboring pixels of fields of variance 1.

    sqrt(2 (1 - C(1) / C(0))),  C smoothed by the aperture a twice, for which it is a sum of Gaussians:
    C(h) = sum w s / (s + 2 a^2) exp(-h^2 / (2 (s + 2 a^2))),  w and s / l^2 from `gaussian_mixture`
    """
    weight, scale = gaussian_mixture(kind, length.device)
    variance = length.double()[:, None].square() * scale
    spread = variance if aperture is None else variance + 2 * aperture.double()[:, None].square()
    weight = weight * variance / spread
    return (-2 * (weight * torch.expm1(-0.5 / spread)).sum(dim=1) / weight.sum(dim=1)).sqrt()


def gaussian_mixture(kind: str, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return weights (n,) and squared lengths (n,) in l^2, float64, of the Gaussian covariances that sum to a kind.

    C(h) = sum w exp(-h^2 / (2 s l^2)),  s = t / nu,  w = t^nu exp(-t) over equal steps of ln t, normalized
    """
    t = torch.ones(1, dtype=torch.float64, device=device)
    if kind == "gaussian":
        return t, t
    t = torch.arange(-60.0, 5.0, 0.5, dtype=torch.float64, device=device).exp()
    weight = t ** _SMOOTHNESS[kind] * torch.exp(-t)
    return weight / weight.sum(), t / _SMOOTHNESS[kind]


class FieldParams(NamedTuple):
    """Sizes, noise and motion of N random fields.

    length: (N,), px, correlation length.
    aperture: (N,), px, standard deviation of the Gaussian that smooths the field; None for no smoothing.
    key: (N, 4), int64, of `noise_key`.
    motion: None for frame 0 of a clip.
    """

    length: Tensor
    aperture: Tensor | None
    key: Tensor
    motion: "Motion | None" = None


class Motion(NamedTuple):
    """Time and change of N random fields.

    frame: (N,), number of the frame t.
    wind: (N, 2), px per frame, to the right and down; of fog in space (N, 3), m per frame.
    decorrelation: (N,), frames, above 0; inf for a field that is only moved by the wind.
    """

    frame: Tensor
    wind: Tensor
    decorrelation: Tensor


class Frequencies(NamedTuple):
    """Frequencies on a periodic domain: -rows ... rows and -columns ... columns periods, or all of them.

    size: (Ht, Wt), px, even, of the domain.
    """

    size: tuple[int, int]
    rows: int
    columns: int

    @classmethod
    def all(cls, size: tuple[int, int]) -> "Frequencies":
        """Return all frequencies of a domain."""
        return cls(size, size[0] // 2, size[1] // 2)

    @property
    def is_all(self) -> bool:
        """Return True if no frequency is missing."""
        return 2 * self.rows >= self.size[0] and 2 * self.columns >= self.size[1]

    @property
    def counts(self) -> tuple[int, int]:
        """Return how many frequencies there are along each axis."""
        return self.size if self.is_all else (2 * self.rows + 1, 2 * self.columns + 1)

    def numbers(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return the periods (Ky,) and (Kx,), int64: 0 ... N - 1 of all, or those from -rows and -columns on."""
        if self.is_all:
            return torch.arange(self.size[0], device=device), torch.arange(self.size[1], device=device)
        rows = torch.arange(-self.rows, self.rows + 1, device=device)
        return rows, torch.arange(-self.columns, self.columns + 1, device=device)


def embedding_size(height: int, width: int, *, length: float, kind: str, aperture: float = 0.0) -> tuple[int, int]:
    """Return (Ht, Wt), px: a periodic domain on which opposite edges of a frame are uncorrelated.

    Args:
        height, width: px, of the frame.
        length: px, the longest correlation length.
        kind: one of COVARIANCES.
        aperture: px, the widest aperture.
    """
    # A frame as large as the cap still gets a margin, so that its edges do not join.
    cap = max(_MAX_POINTS, 2 * height * width)
    margin = math.ceil(min(math.hypot(REACH[kind] * length, _APERTURE_REACH * aperture), cap))
    size = fast_size(height + margin), fast_size(width + margin)
    if size[0] * size[1] <= cap:
        return size
    # The largest margin for which (height + margin) (width + margin) stays below the cap.
    half = (height + width) / 2
    margin = math.floor(math.sqrt(half * half - height * width + cap) - half)
    return _fast_size_below(height + margin, height), _fast_size_below(width + margin, width)


def eigenvalues(frequencies: Frequencies, length: Tensor, *, kind: str) -> Tensor:
    """Compute (N, rows + 1, columns + 1), float64, up to rounding: eigenvalues of a covariance on a periodic domain.

    They are the discrete Fourier transform of the covariance, for lengths (N,), over the distances on the domain, which
    is even along both axes: the frequencies from 0 on hold all of them.
    """
    size, length = frequencies.size, length.double()[:, None, None]
    y, x = (torch.arange(n // 2 + 1, dtype=torch.float64, device=length.device) for n in size)
    y = y[:, None]
    # The covariance of the shortest distance has a kink half-way around the domain, and so negative eigenvalues. The
    # sum over all ways around has none, but on a domain too small for it the sum is off by more.
    is_summed = (REACH[kind] * length <= min(size)).double()
    if kind == "gaussian":  # a product of two functions of one axis
        rows, columns = (
            covariance(t, length, kind)
            + is_summed * (covariance(n - t, length, kind) + covariance(n + t, length, kind))
            for t, n in ((y, size[0]), (x, size[1]))
        )
        return even_transform(rows, 1, frequencies.rows + 1) * even_transform(columns, 2, frequencies.columns + 1)
    values = covariance((x * x + y * y).sqrt(), length, kind)
    if kind != "exponential":
        far_x2, far_y2 = (size[1] - x).square(), (size[0] - y).square()
        for square in (far_x2 + y * y, x * x + far_y2, far_x2 + far_y2):
            values = values + is_summed * covariance(square.sqrt(), length, kind)
    return even_transform(even_transform(values, 2, frequencies.columns + 1), 1, frequencies.rows + 1)


def amplitudes(
    frequencies: Frequencies, length: Tensor, *, kind: str, aperture: Tensor | None, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Compute the factor of the noise at each frequency, normalized to a field of variance 1.

    It is the root of the eigenvalue, multiplied by exp(-(k a)^2 / 2) for an aperture a: the field is then smoothed by a
    Gaussian of standard deviation a. Negative eigenvalues count as 0.

    Returns:
        amplitude: (N, rows + 1, columns + 1).
        clipped: (N,), negative eigenvalues as a share of all.
    """
    values = eigenvalues(frequencies, length, kind=kind)
    if kind != "exponential":  # eigenvalues below rounding would have roots with arbitrary gradients
        values = torch.where(values.abs() > _ROUNDING * values.amax(dim=(1, 2), keepdim=True), values, 0)
    positive = values.clamp(min=0)
    smooth_x, weight_x = _axis_factors(frequencies.size[1], frequencies.columns, aperture, values.device)
    smooth_y, weight_y = _axis_factors(frequencies.size[0], frequencies.rows, aperture, values.device)
    smooth_y, weight_y = smooth_y.mT, weight_y.mT

    def total(eigenvalues: Tensor) -> Tensor:
        return ((eigenvalues * weight_x).sum(dim=2, keepdim=True) * weight_y).sum(dim=1, keepdim=True)

    variance = total(positive)
    clipped = 1 - variance / (2 * variance - total(values))
    amplitude = _root(positive).to(dtype) * (smooth_y / variance.sqrt()).to(dtype) * smooth_x.to(dtype)
    return amplitude, clipped[:, 0, 0].to(dtype)


@shareable
def coefficients(
    params: FieldParams, frequencies: Frequencies, *, kind: str, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Compute the noise times its amplitude, (N, 2, Ky, Kx), real and imaginary part, and the clipped share, (N,)."""
    quarter, clipped = amplitudes(frequencies, params.length, kind=kind, aperture=params.aperture, dtype=dtype)
    noise = frequency_noise(params.key, frequencies, dtype=dtype)
    if params.motion is not None:
        noise = _evolve(noise, turn_rates(params.key, frequencies, dtype=dtype), frequencies, params.motion)
    ky, kx = (
        torch.minimum(k.remainder(n), (-k).remainder(n))
        for k, n in zip(frequencies.numbers(noise.device), frequencies.size, strict=True)
    )
    return noise * quarter.index_select(2, kx).index_select(1, ky)[:, None], clipped


def sum_of_waves(values: Tensor, frequencies: Frequencies, rows: range, columns: range) -> Tensor:
    """Compute Re and Im of sum_k z_k exp(-2 pi i k . p / size), (N, 2, n, m), at rows and columns of the domain.

    The values z are (N, 2, Ky, Kx), real and imaginary part; positions beyond the domain continue it periodically.
    All frequencies are summed at adjacent pixels by FFT, others by products of matrices.
    """
    size, spans = frequencies.size, (rows, columns)
    # The compiler supports no complex numbers, and PyTorch cannot transform empty batches.
    if frequencies.is_all and rows.step == columns.step == 1 and len(values) and not torch.compiler.is_compiling():
        spectrum = torch.complex(values[:, 0], values[:, 1])
        for dim in (2, 1):
            spectrum = periodic_part(torch.fft.fft(spectrum, dim=dim), dim, spans[dim - 1])
        return torch.view_as_real(spectrum).movedim(-1, 1)
    for span, n, periods in list(zip(spans, size, frequencies.numbers(values.device), strict=True))[::-1]:
        positions = torch.arange(span.start, span.stop, span.step, device=values.device)
        # Whole turns are subtracted from integers, exactly.
        angle = (positions[:, None] * periods).remainder(n).to(values.dtype) * (2 * math.pi / n)
        real, imaginary = values.mT.unbind(1)
        pairs = torch.stack([torch.cat([real, imaginary], dim=1), torch.cat([imaginary, -real], dim=1)], dim=1)
        values = exact_matmul(torch.cat([angle.cos(), angle.sin()], dim=1), pairs)
    return values


def periodic_part(values: Tensor, dim: int, span: range) -> Tensor:
    """Return the values at some positions of a periodic dimension."""
    size = values.shape[dim]
    if span.step == 1 and span.start >= 0 and span.stop <= size:  # far faster than by index
        return values.narrow(dim, span.start, len(span))
    index = torch.arange(span.start, span.stop, span.step, device=values.device)
    return values.index_select(dim, index.remainder(size))


@shareable
def sample_field(
    params: FieldParams,
    frequencies: Frequencies,
    rows: range,
    columns: range,
    *,
    kind: str,
    dtype: torch.dtype,
    transform: Callable[[Tensor, Frequencies], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Sample two independent fields of mean 0 and variance 1 with a covariance.

    Args:
        params: of N fields.
        frequencies: of the domain, all or the lowest ones.
        rows, columns: px, where the fields are evaluated.
        kind, dtype: of the covariance and of the fields.
        transform: changes the coefficients of the waves, (N, 2, Ky, Kx).

    Returns:
        field: (N, 2, n, m).
        clipped: (N,), share of the spectrum that is negative and was set to 0.
    """
    parts = []
    for part in _split(params, frequencies):
        values, clipped = coefficients(part, frequencies, kind=kind, dtype=dtype)
        values = values if transform is None else transform(values, frequencies)
        parts.append((sum_of_waves(values, frequencies, rows, columns), clipped))
    fields, clipped = zip(*parts, strict=True)
    return torch.cat(fields), torch.cat(clipped)


def node_positions(lattice: Lattice) -> tuple[range, range]:
    """Return the rows and columns of the nodes of a lattice, px."""
    start, step = -lattice.margin * lattice.stride, lattice.stride
    rows, columns = (range(start, start + count * step, step) for count in lattice.num_nodes)
    return rows, columns


def _split(params: FieldParams, frequencies: Frequencies) -> list[FieldParams]:
    """Split N fields into groups whose noise fits into memory together."""
    count, at_once = len(params.length), max(1, _POINTS_AT_ONCE // math.prod(frequencies.counts))
    if count <= at_once or torch.compiler.is_compiling():
        return [params]

    def group(rows: slice) -> FieldParams:
        aperture = None if params.aperture is None else params.aperture[rows]
        motion = params.motion and Motion(*(value[rows] for value in params.motion))
        return FieldParams(params.length[rows], aperture, params.key[rows], motion)

    return [group(slice(first, first + at_once)) for first in range(0, count, at_once)]


def frequency_noise(key: Tensor, frequencies: Frequencies, *, dtype: torch.dtype) -> Tensor:
    """Compute (N, 2, Ky, Kx): the white noise of the frequencies, the same for all and for the lowest ones."""
    if frequencies.is_all:
        return white_noise(key, math.prod(frequencies.size)).unflatten(2, frequencies.size).to(dtype)
    return white_noise_at(key, _indices(frequencies, key.device)).unflatten(2, frequencies.counts).to(dtype)


def turn_rates(key: Tensor, frequencies: Frequencies, *, dtype: torch.dtype) -> Tensor:
    """Compute (N, Ky, Kx), standard normal: how fast the phase of each frequency turns, in 1 / decorrelation."""
    key = key.flip(1)  # the words of the key in another order are another key
    half = math.prod(frequencies.size) // 2
    if frequencies.is_all:
        return white_noise(key, half).reshape(-1, *frequencies.size).to(dtype)
    index = _indices(frequencies, key.device)
    pairs = white_noise_at(key, index % half)
    return torch.where(index < half, pairs[:, 0], pairs[:, 1]).unflatten(1, frequencies.counts).to(dtype)


def _evolve(noise: Tensor, rates: Tensor, frequencies: Frequencies, motion: Motion) -> Tensor:
    """Turn the noise (N, 2, Ky, Kx) of each frequency (kx, ky) by its own angle.

        n_t = n exp(i phase),  phase = sqrt(2) rate t / decorrelation + 2 pi (kx wind_x / Wt + ky wind_y / Ht) t

    The field moves with the wind, and its correlation with the moved field of frame 0 is exp(-(t / decorrelation)^2),
    since the rates are normal. Amplitudes stay, and any frame is computed without those before it.
    """
    ky, kx = (
        torch.where(2 * k < n, k, k - n).double() / n
        for k, n in zip(frequencies.numbers(noise.device), frequencies.size, strict=True)
    )
    shift = 2 * math.pi * (motion.frame.double()[:, None] * motion.wind.double())[:, :, None]
    # Whole turns are subtracted in float64, so that late frames are as exact as the first.
    angles = shift[:, :1] * kx, shift[:, 1:].mT * ky[:, None]
    drift = sum(angle.remainder(2 * math.pi).to(noise.dtype) for angle in angles)
    phase = (math.sqrt(2) * motion.frame / motion.decorrelation)[:, None, None].to(noise.dtype) * rates + drift
    return turn_waves(noise, phase)


def turn_waves(values: Tensor, phase: Tensor) -> Tensor:
    """Multiply waves (N, 2, Ky, Kx), real and imaginary part, by exp(i phase), (N, Ky, Kx)."""
    cos, sin = phase.cos(), phase.sin()
    real, imaginary = values.unbind(1)
    return torch.stack([real * cos - imaginary * sin, real * sin + imaginary * cos], dim=1)


def even_transform(values: Tensor, dim: int, count: int) -> Tensor:
    """Transform even, periodic sequences, given and returned by their halves; `count` values from frequency 0 on."""
    largest = values.shape[dim] - 1
    if torch.compiler.is_compiling():  # the compiler supports no complex numbers
        k, p = torch.arange(count, device=values.device)[:, None], torch.arange(largest + 1, device=values.device)
        cosine = ((k * p).remainder(2 * largest).to(values.dtype) * (math.pi / largest)).cos()
        matrix = cosine * _multiplicity(largest + 1, values.device, has_middle=True)
        return matrix @ values if dim == 1 else values @ matrix.mT
    if values.shape[0] == 0:  # PyTorch cannot transform empty batches
        return values.narrow(dim, 0, count)
    mirrored = values.narrow(dim, 1, largest - 1).flip(dim)
    return torch.fft.rfft(torch.cat([values, mirrored], dim=dim), dim=dim).narrow(dim, 0, count).real


def _indices(frequencies: Frequencies, device: torch.device) -> Tensor:
    """Return (Ky Kx,), int64: the index of each frequency among all of the domain."""
    ky, kx = frequencies.numbers(device)
    height, width = frequencies.size
    return (ky[:, None].remainder(height) * width + kx.remainder(width)).flatten()


def _axis_factors(size: int, highest: int, aperture: Tensor | None, device: torch.device) -> tuple[Tensor, Tensor]:
    """Compute the factors of a Gaussian aperture at frequencies from 0 to the highest one along an axis of a domain.

    Returns:
        factor: (N or 1, 1, highest + 1).
        weight: (N or 1, 1, highest + 1), the squared factor, as often as the frequency occurs in the domain.
    """
    frequency = torch.arange(highest + 1, dtype=torch.float64, device=device) / size
    if aperture is None:
        factor = torch.ones_like(frequency)[None, None]
    else:
        factor = torch.exp(-0.5 * (2 * math.pi * aperture.double()[:, None, None] * frequency).square())
        # Arithmetic with denormal products of smaller factors is many times slower.
        factor = torch.where(factor > _NEGLIGIBLE, factor, 0)
    return factor, _multiplicity(highest + 1, device, has_middle=2 * highest >= size) * factor.square()


def _multiplicity(count: int, device: torch.device, *, has_middle: bool) -> Tensor:
    """Return (count,), float64: how often each value of a half occurs in the even, periodic sequence."""
    times = torch.full((count,), 2.0, dtype=torch.float64, device=device)
    times[:1].fill_(1)  # of slices, since an accelerator waits for a number that is put in one place
    if has_middle:
        times[-1:].fill_(1)
    return times


def _root(values: Tensor) -> Tensor:
    """Compute the square root, with a gradient of 0 where the value is 0."""
    return torch.where(values > 0, values, 1).sqrt() * (values > 0)


def fast_size(least: int) -> int:
    """Return the smallest even number from `least` on that has no prime factor above 7."""
    return next(filter(_has_small_factors, itertools.count(max(2, least + least % 2), 2)))


def _fast_size_below(largest: int, least: int) -> int:
    """Return the largest such number up to `largest`, or the smallest from `least` on if that is below `least`."""
    sizes = range(largest - largest % 2, max(least, 2) - 1, -2)
    return next(filter(_has_small_factors, sizes), fast_size(least))


def _has_small_factors(size: int) -> bool:
    return 210**64 % size == 0
