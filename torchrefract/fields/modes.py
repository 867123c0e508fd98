"""Gaussian random fields of few frequencies: those of `gaussian_random_field`, at any rows and columns."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import random
from torchrefract._compiled import kernels, obstacle
from torchrefract._tensor import as_device_tensor, by_samples, cached, exact_matmul
from torchrefract._validation import requires_grad
from torchrefract.fields.evolution import turned
from torchrefract.fields.gaussian import axis_spectrum

_SMOOTH = 2.0  # px, from which length on a Gaussian covariance has no frequencies beyond those of pixels
_LARGE = 1 << 12  # numbers, of which a kernel is faster


class Modes(NamedTuple):
    """The lowest frequencies of a torus: -rows ... rows and -columns ... columns periods."""

    size: tuple[int, int]  # (Ht, Wt), px, of the torus
    rows: int
    columns: int

    @property
    def counts(self) -> tuple[int, int]:
        """How many along each axis."""
        return 2 * self.rows + 1, 2 * self.columns + 1


def mode_noise(key: Tensor, modes: Modes, *, dtype: torch.dtype) -> Tensor:
    """(B, 2, My, Mx): the white noise of these frequencies, as in `random.white_noise` of the whole torus."""
    return random.white_noise_at(key, _places(modes, key.device).flatten()).unflatten(2, modes.counts).to(dtype)


def mode_turn_rates(key: Tensor, modes: Modes, *, dtype: torch.dtype) -> Tensor:
    """(B, My, Mx), the rates of these frequencies, as in `turn_rates` of the whole torus."""
    half = modes.size[0] * modes.size[1] // 2
    place = _places(modes, key.device).flatten()
    pairs = random.white_noise_at(key.flip(1), place % half)
    return torch.where(place < half, pairs[:, 0], pairs[:, 1]).unflatten(1, modes.counts).to(dtype)


def evolved_modes(
    noise: Tensor, rates: Tensor, modes: Modes, *, frame: Tensor, wind: Tensor, decorrelation: Tensor
) -> Tensor:
    """The noise (B, 2, My, Mx) at a later frame; as `evolved` of the whole torus."""
    frequency = [k / n for k, n in zip(_numbers(modes, noise.device), modes.size, strict=True)]
    return turned(noise, rates, *frequency, frame=frame, wind=wind, decorrelation=decorrelation)


def mode_amplitude(
    modes: Modes, length: Tensor, *, aperture: Tensor | None, dtype: torch.dtype, shortest: float = 0.0
) -> tuple[Tensor, Tensor]:
    """(B, My) and (B, Mx), whose product is the amplitude of a Gaussian covariance's `spectrum` at each frequency.

    Along an axis of N px the eigenvalues of lengths l of 2 px or more are those of the real line, and so, with k in
    radians per px and L^2 = l^2 + 2 a^2 for an aperture a,

        amplitude^2 = sqrt(2 pi) L / N exp(-(k L)^2 / 2) / (1 + 2 exp(-(N / L)^2 / 2))

    but for shares of exp(-2 (pi l - k l)^2) and exp(-2 (N / L)^2). For shorter ones they are transformed.

    Args:
        modes: the frequencies, of a torus with room for the length.
        length: (B,), px.
        aperture: (B,), px.
        dtype: of the amplitude.
        shortest: px, no length is shorter.
    """
    if shortest < _SMOOTH:
        sides = zip(modes.size, _numbers(modes, length.device), strict=True)
        rows, columns = (axis_spectrum(n, length, aperture)[:, k.abs()].to(dtype) for n, k in sides)
        return rows, columns
    values = (length,) if aperture is None else (length, aperture)
    if (
        dtype is torch.float32
        and math.prod(modes.counts) >= _LARGE
        and not requires_grad(values)
        and not obstacle(*values)
    ):
        down, across = (length.new_empty(len(length), count) for count in modes.counts)
        sides, exponent = (own.numpy() for own in _sides(modes, length.device))
        lengths, apertures = (own.contiguous().numpy() for own in (length, values[-1]))
        work = kernels("fields.kernels.modes").amplitudes
        work(lengths, apertures, aperture is not None, sides, exponent, down.numpy(), across.numpy())
        return down, across
    square = length.double().square()[:, None]
    square = square if aperture is None else square + 2 * aperture.double().square()[:, None]
    sides, exponent = _sides(modes, length.device)
    largest = math.sqrt(2 * math.pi) / sides * square.sqrt() / (1 + 2 * torch.exp(-0.5 * sides.square() / square))
    below = torch.exp(exponent * square).split(modes.counts, dim=1)
    rows, columns = ((end * own).to(dtype) for end, own in zip(largest.sqrt().split(1, dim=1), below, strict=True))
    return rows, columns


def mode_field(
    noise: Tensor,
    amplitude: tuple[Tensor, Tensor],
    modes: Modes,
    rows: Sequence[int],
    columns: Sequence[int],
    *,
    fields: int = 2,
) -> Tensor:
    """Two independent fields (B, 2, n, m) at rows and columns of pixels, by two products of matrices.

        field = Re, Im of sum_k amplitude_k (n1_k + i n2_k) exp(-2 pi i k . p / size)

    Args:
        noise: (B, 2, My, Mx).
        amplitude: (B, My) and (B, Mx).
        modes: their frequencies.
        rows, columns: px, whole numbers.
        fields: 2, or 1 for the first alone, (B, 1, n, m).
    """
    values = noise, *amplitude
    if noise.numel() >= _LARGE and not requires_grad(values) and not obstacle(*values):
        both = noise.new_empty(len(noise), fields, *modes.counts)
        kernels("fields.kernels.modes").folded(*(own.contiguous().numpy() for own in values), both.numpy())
    else:
        both = _folded_twice(noise * (amplitude[0][:, None, :, None] * amplitude[1][:, None, None, :]))[:, :fields]
    return _sum_of(both, modes, rows, columns)


def sum_of_modes(weighted: Tensor, modes: Modes, rows: Sequence[int], columns: Sequence[int]) -> Tensor:
    """The fields of `mode_field`, from the noise times its amplitude, (B, 2, My, Mx)."""
    return _sum_of(_folded_twice(weighted), modes, rows, columns)


def _sum_of(folded: Tensor, modes: Modes, rows: Sequence[int], columns: Sequence[int]) -> Tensor:
    """(B, n, n, m): the same of what is folded along both axes, (B, 2, My, Mx), or of the first field alone."""
    single, count = folded.shape[1] == 1, len(columns)
    in_y, in_x = _waves(modes, tuple(rows), tuple(columns), 1 + single, folded.dtype, folded.device)

    def fields(pairs: Tensor) -> Tensor:
        # Two products to a sample, of two fields or of two halves: one by itself may round by the threads.
        both = pairs.expand(-1, 2, -1, -1).flatten(0, 1)
        along = exact_matmul(both, in_x.expand(len(pairs), 2, -1, -1).flatten(0, 1))
        found = exact_matmul(in_y.expand(len(both), -1, -1), along).unflatten(0, (-1, 2))
        return found.transpose(1, 2).flatten(2)[:, None, :, :count] if single else found

    return by_samples(folded, fields)


def _folded_twice(weighted: Tensor) -> Tensor:
    return _folded(_folded(weighted, 2), 3)


def _folded(values: Tensor, dim: int) -> Tensor:
    """Sums and differences of opposite frequencies along an axis, of (real, imaginary) parts: half as many factors.

    With even and odd parts e and o of a sum over k = -n ... n, of which e_0 counts twice,

        sum_k (r_k + i m_k) exp(-i k t) = sum_k>=0 (e(r) cos k t + o(m) sin k t) + i (e(m) cos k t - o(r) sin k t)

    Args:
        values: (B, 2, ...), 2 n + 1 long along the axis.
        dim: the axis.

    Returns:
        (B, 2, ...), of the same shape: e_0 ... e_n and o_1 ... o_n of the real and of the imaginary sum.
    """
    n, other = values.shape[dim] // 2, values.flip(dim)
    even, odd = (values + other).narrow(dim, n, n + 1), (values - other).narrow(dim, n + 1, n)
    real = torch.cat([even[:, 0], odd[:, 1]], dim=dim - 1)
    return torch.stack([real, torch.cat([even[:, 1], -odd[:, 0]], dim=dim - 1)], dim=1)


@cached
def _waves(
    modes: Modes, rows: tuple[int, ...], columns: tuple[int, ...], parts: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """(n, My) and (parts, Mx, m): cos and sin of 2 pi k p / size, as `_folded` pairs them.

    The columns are in so many parts, with zeros behind where they are not as many as others.
    """

    def waves(most: int, places: Sequence[int], size: int) -> Tensor:
        # Whole turns are taken out of whole numbers, exactly.
        k = torch.arange(most + 1, device=device)
        angle = (k[:, None] * as_device_tensor(places, device=device)).remainder(size).to(dtype) * (2 * math.pi / size)
        cosines = torch.cat([torch.full_like(angle[:1], 0.5), angle[1:].cos()])
        return torch.cat([cosines, angle[1:].sin()])

    in_x = F.pad(waves(modes.columns, columns, modes.size[1]), (0, -len(columns) % parts))
    return waves(modes.rows, rows, modes.size[0]).mT.contiguous(), torch.stack(in_x.chunk(parts, dim=1))


def _numbers(modes: Modes, device: torch.device) -> tuple[Tensor, Tensor]:
    rows, columns = (torch.arange(-most, most + 1, device=device) for most in (modes.rows, modes.columns))
    return rows, columns


@cached
def _sides(modes: Modes, device: torch.device) -> tuple[Tensor, Tensor]:
    """(2,), px, and (My + Mx,), what the square of a length counts times in the exponent of each root."""
    turns = [-((math.pi / n * k.double()) ** 2) for k, n in zip(_numbers(modes, device), modes.size, strict=True)]
    return as_device_tensor(modes.size, dtype=torch.float64, device=device), torch.cat(turns)


@cached
def _places(modes: Modes, device: torch.device) -> Tensor:
    """(My, Mx): where each frequency stands among those of the torus."""
    ky, kx = _numbers(modes, device)
    return ky[:, None].remainder(modes.size[0]) * modes.size[1] + kx.remainder(modes.size[1])
