"""Gaussian random fields without high frequencies, of covariances whose spectrum is no product of two axes."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import by_samples, cached, cat_bands, rows_at_once
from torchrefract.fields.gaussian import eigenvalues, root, smoothing
from torchrefract.fields.modes import Modes, sum_of_modes
from torchrefract.types import Range

_CACHED = 1 << 17  # complex numbers that stay in a core's cache
_MOST_TABLES, _MOST_KEPT = 64, 1 << 25  # and numbers in all of them
_tables: dict[tuple[Modes, str, Range, int], Tensor] = {}  # those asked for last come last


class _Line(NamedTuple):
    """Places along an axis, as some of what a transform of so many frequencies returns."""

    start: int  # px
    number: int
    length: int  # of the transform
    every: int  # of how many that it returns one is kept

    def of(self, values: Tensor) -> Tensor:
        """The sums of frequencies -most ... most along the last axis, turned to the start."""
        found = torch.fft.fft(_placed(values, self.length), dim=-1)
        return found[..., : (self.number - 1) * self.every + 1 : self.every]


def low_eigenvalues(modes: Modes, length: Tensor, *, kind: str, lengths: Range, nodes: int | None) -> Tensor:
    """(B, rows + 1, columns + 1), float64: the eigenvalues of `spectrum` from frequency 0 on, none below 0.

    Small ones are kept that `spectrum` takes for rounding, up to 5e-13 of the largest.

    On the CPU they are polynomials in ln(length), through Chebyshev points between the ends of its range. Tables are
    kept of them, of 8 nodes (rows + 1) (columns + 1) bytes each: the latest 64, up to 256 MB. Elsewhere, and in a
    compiled graph, all eigenvalues of the torus are transformed for each length.

    Args:
        modes: the frequencies, below half of all along both axes.
        length: (B,), px, in the range.
        kind: one of COVARIANCES but the Gaussian one.
        lengths: (low, high), px, the range.
        nodes: how many points, as `nodes_needed` tells; None to transform each length in any case.
    """
    # One node knows no slope.
    flat = nodes == 1 and length.requires_grad and torch.is_grad_enabled()
    if nodes is None or flat or torch.compiler.is_compiling() or length.device.type != "cpu":
        return _low(modes, length, kind).clamp(min=0)
    table = _coefficients(modes, kind, lengths, nodes)
    found = by_samples(_polynomials(length, lengths, nodes), lambda weights: weights @ table)
    return found.clamp(min=0).unflatten(1, (modes.rows + 1, modes.columns + 1))


def low_amplitude(
    modes: Modes,
    length: Tensor,
    *,
    kind: str,
    lengths: Range,
    nodes: int | None,
    aperture: Tensor | None,
    dtype: torch.dtype,
) -> Tensor:
    """(B, My, Mx): the amplitude of `spectrum` at each frequency, as if there were no others.

    Args:
        modes, length, kind, lengths, nodes: as for `low_eigenvalues`.
        aperture: (B,), px.
        dtype: of the amplitude.
    """
    values = low_eigenvalues(modes, length, kind=kind, lengths=lengths, nodes=nodes)
    y, x = (torch.arange(count, dtype=torch.float64, device=length.device) for count in values.shape[1:])
    smooth_y, smooth_x = smoothing(y[:, None] / modes.size[0], aperture), smoothing(x / modes.size[1], aperture)
    # Each frequency but 0 stands there twice.
    share_y, share_x = smooth_y.square() * (1 + y.sign())[:, None], smooth_x.square() * (1 + x.sign())
    variance = by_samples(values * share_x * share_y, lambda one: one.sum(dim=2, keepdim=True).sum(dim=1, keepdim=True))
    quarter = root(values).to(dtype) * (smooth_y / variance.sqrt()).to(dtype) * smooth_x.to(dtype)
    half = torch.cat([quarter[:, 1:].flip(1), quarter], dim=1)
    return torch.cat([half[:, :, 1:].flip(2), half], dim=2)


def low_field(noise: Tensor, amplitude: Tensor, modes: Modes, rows: Sequence[int], columns: Sequence[int]) -> Tensor:
    """Two independent fields (B, 2, n, m) at rows and columns of pixels, by Fourier transforms where these allow it.

        field = Re, Im of sum_k amplitude_k (n1_k + i n2_k) exp(-2 pi i k . p / size)

    At p = start + s j with s a divisor of the size, the sum is a transform of size / s frequencies, which those that
    are there do not fill, of noise turned by exp(-2 pi i k start / size). For other steps, s is a divisor of both.

    Args:
        noise: (B, 2, My, Mx).
        amplitude: (B, My, Mx).
        modes: their frequencies, below half of all along both axes.
        rows, columns: px, whole numbers.
    """
    lines = _line(rows, modes.size[0], modes.rows), _line(columns, modes.size[1], modes.columns)
    if lines[0] is None or lines[1] is None or torch.compiler.is_compiling() or noise.shape[0] == 0:
        return sum_of_modes(noise * amplitude.unsqueeze(1), modes, rows, columns)  # compilers know no complex numbers
    turns = _turns(modes, lines[0].start, lines[1].start, noise.dtype, noise.device)
    each = 1 if noise.device.type == "cpu" else noise.shape[0]
    both = zip(noise.split(each), amplitude.split(each), strict=True)
    parts = [_transformed(*one, turns, lines[0], lines[1]) for one in both]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _transformed(noise: Tensor, amplitude: Tensor, turns: tuple[Tensor, Tensor], down: _Line, across: _Line) -> Tensor:
    # Columns and then rows at a time stay in the cache, and only what is asked for is kept of them.
    at_once = rows_at_once(noise.device, noise.shape[3], each=down.length, cached=_CACHED)
    both = zip(noise.split(at_once, dim=3), amplitude.split(at_once, dim=2), strict=True)
    rows = cat_bands((down.of(_turned(*band, turns[0]).mT) for band in both), dim=1, length=noise.shape[3]).mT
    at_once = rows_at_once(noise.device, down.number, each=across.length, cached=_CACHED)
    bands = (torch.view_as_real(across.of(band * turns[1])).movedim(-1, 1) for band in rows.split(at_once, dim=1))
    return cat_bands(bands, dim=2, length=down.number).contiguous()


def _turned(noise: Tensor, amplitude: Tensor, turns: Tensor) -> Tensor:
    weighted = noise * amplitude.unsqueeze(1)
    return torch.complex(weighted[:, 0], weighted[:, 1]) * turns


def _placed(values: Tensor, length: int) -> Tensor:
    """Frequencies -most ... most along the last axis, as a transform takes them."""
    most = values.shape[-1] // 2
    between = values.new_zeros(*values.shape[:-1], length - values.shape[-1])
    return torch.cat([values[..., most:], between, values[..., :most]], dim=-1)


def _line(places: Sequence[int], size: int, most: int) -> _Line | None:
    """The places as those of the shortest transform that tells all frequencies up to `most` apart, if there is one."""
    step = places[1] - places[0] if len(places) > 1 else size
    if step < 1 or list(places) != list(range(places[0], places[0] + step * len(places), step)):
        return None
    common = math.gcd(step, size)
    apart = next(s for s in range(common, 0, -1) if common % s == 0 and size // s > 2 * most)
    line = _Line(places[0], len(places), size // apart, step // apart)
    return line if (line.number - 1) * line.every < line.length else None


@cached
def _turns(modes: Modes, y: int, x: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(My, 1) and (Mx,), complex: exp(-2 pi i k p / size) of a row and a column."""

    def turns(most: int, place: int, size: int) -> Tensor:
        k = torch.arange(-most, most + 1, device=device)
        # Whole turns are taken out of whole numbers, exactly.
        angle = (k * place).remainder(size).double() * (-2 * math.pi / size)
        return torch.complex(angle.cos().to(dtype), angle.sin().to(dtype))

    return turns(modes.rows, y, modes.size[0])[:, None], turns(modes.columns, x, modes.size[1])


def _polynomials(length: Tensor, lengths: Range, nodes: int) -> Tensor:
    """(B, nodes), float64: Chebyshev's polynomials of ln(length), which goes from -1 to 1."""
    low, high = (math.log(end) for end in lengths)
    x = (2 * length.double().log() - low - high) / ((high - low) or 1.0)
    found = [torch.ones_like(x), x]
    while len(found) < nodes:
        found.append(2 * x * found[-1] - found[-2])
    return torch.stack(found[:nodes], dim=1)


def _coefficients(modes: Modes, kind: str, lengths: Range, nodes: int) -> Tensor:
    """(nodes, (rows + 1) (columns + 1)), float64: of Chebyshev's polynomials, for each eigenvalue."""
    key = modes, kind, lengths, nodes
    found = _tables.pop(key, None)
    if found is None:
        found = _made(modes, kind, lengths, nodes)
    _tables[key] = found
    while len(_tables) > 1 and (
        len(_tables) > _MOST_TABLES or sum(table.numel() for table in _tables.values()) > _MOST_KEPT
    ):
        _tables.pop(next(iter(_tables)), None)  # that nobody has asked for longest
    return found


def _made(modes: Modes, kind: str, lengths: Range, nodes: int) -> Tensor:
    # Tensors made in inference mode could not be used outside of it.
    with torch.inference_mode(False), torch.no_grad():
        low, high = (math.log(end) for end in lengths)
        points, matrix = _chebyshev(nodes)
        found = ((low + high) / 2 + (high - low) / 2 * points).exp().clamp(*lengths).split(1)
        return matrix @ torch.stack([_low(modes, length, kind).flatten() for length in found])


def _low(modes: Modes, length: Tensor, kind: str) -> Tensor:
    """(B, rows + 1, columns + 1), some of which may be below 0."""
    return eigenvalues(modes.size, length.double()[:, None, None], kind, most=(modes.rows + 1, modes.columns + 1))


def _chebyshev(nodes: int) -> tuple[Tensor, Tensor]:
    """(nodes,), float64, Chebyshev points, and (nodes, nodes): what makes coefficients of the values there.

    x_i = cos(pi i / n),  c_j = 2 / n w_j sum_i w_i value_i cos(pi i j / n),  i, j = 0 ... n,  w = 1/2, 1, ..., 1, 1/2
    """
    if nodes == 1:
        return torch.zeros(1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    i, n = torch.arange(nodes, dtype=torch.float64), nodes - 1
    weight = torch.where(i % n == 0, 0.5, 1.0).double()
    cosine = torch.cos(math.pi / n * (i[:, None] * i).remainder(2 * n))
    return cosine[1], 2 / n * weight[:, None] * weight * cosine
