"""Gaussian random fields, sampled exactly on a torus that the frame is cut out of."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import cat_bands, rows_at_once
from torchrefract.fields.covariance import REACH, covariance

_ROUNDING = 5e-13  # of the transform, relative to the largest eigenvalue
_NOTHING = 1e-16  # of an amplitude: what adds nothing to the sum of all
_CACHED = 1 << 18  # complex numbers that stay in a core's cache


class Spectrum(NamedTuple):
    """The eigenvalues of a covariance on a torus, ready to shape white noise."""

    amplitude: Tensor  # (B, Ht / 2 + 1, Wt / 2 + 1): what noise of variance 1 is multiplied by, at each frequency
    clipped: Tensor  # (B,): negative eigenvalues that were set to zero, as a share of all


def spectrum(
    size: tuple[int, int], length: Tensor, *, kind: str, aperture: Tensor | None = None, dtype: torch.dtype
) -> Spectrum:
    """The spectrum of a covariance on a torus, normalized to variance 1.

    The eigenvalues are the discrete Fourier transform of the covariance at the distances on the torus, multiplied by
    exp(-(k a)^2) for an aperture a: the field is then smoothed by a Gaussian of standard deviation a.

    Args:
        size: (Ht, Wt), even, of the torus.
        length: (B,), px.
        kind: one of COVARIANCES.
        aperture: (B,), px.
        dtype: of the amplitude.

    Source: Dietrich and Newsam, "Fast and exact simulation of stationary Gaussian processes through circulant embedding
    of the covariance matrix", SIAM J. Sci. Comput. 18 (1997).
    """
    if torch.compiler.is_compiling() or len(length) < 2:
        return _spectrum(size, length, kind=kind, aperture=aperture, dtype=dtype)
    # Transforms and sums of several samples round in another way than those of one.
    apertures = [None] * len(length) if aperture is None else aperture.split(1)
    parts = [
        _spectrum(size, one, kind=kind, aperture=wide, dtype=dtype)
        for one, wide in zip(length.split(1), apertures, strict=True)
    ]
    return Spectrum(*(torch.cat(values) for values in zip(*parts, strict=True)))


def axis_spectrum(size: int, length: Tensor, aperture: Tensor | None) -> Tensor:
    """(B, size / 2 + 1), float64: the factor of `spectrum` along one axis, for a Gaussian covariance.

    Args:
        size: px, even, of the torus along the axis, with room for the length.
        length: (B,), px.
        aperture: (B,), px.
    """
    distance = torch.arange(size // 2 + 1, dtype=torch.float64, device=length.device)
    ways = (distance, size - distance, size + distance)
    near, *far = (covariance(h, length.double()[:, None], "gaussian") for h in ways)
    values = _transform(near + sum(far), -1)
    kept = torch.where(values > _ROUNDING * values.amax(dim=1, keepdim=True), values, 0)
    smooth = smoothing(distance / size, aperture).reshape(-1, size // 2 + 1)
    variance = (kept * smooth.square() * _multiplicity(size, length.device)).sum(dim=1, keepdim=True)
    return root(kept) * smooth / variance.sqrt()


def gaussian_random_field(noise: Tensor, shape: Tensor, *, height: int, width: int) -> Tensor:
    """Two independent fields (B, 2, H, W) of mean 0 and variance 1, with the covariance that a spectrum stands for.

        field = Re, Im of sum_k amplitude_k (n1_k + i n2_k) exp(-2 pi i k . p / size)

    Args:
        noise: (B, 2, Ht, Wt), white, standard normal, for each frequency of the torus.
        shape: (B, Ht / 2 + 1, Wt / 2 + 1), the amplitude of a `Spectrum`.
        height, width: of the frame, at most Ht and Wt.
    """
    if torch.compiler.is_compiling():  # the compiler knows no complex numbers
        return torch.ops.torchrefract.gaussian_random_field(noise, shape, height, width)
    return _fields(noise, shape, height, width)


def _spectrum(
    size: tuple[int, int], length: Tensor, *, kind: str, aperture: Tensor | None, dtype: torch.dtype
) -> Spectrum:
    values = eigenvalues(size, length.double()[:, None, None], kind)
    if kind != "exponential":  # what rounding leaves is no eigenvalue: the slope of its root would be anything
        values = torch.where(values.abs() > _ROUNDING * values.amax(dim=(1, 2), keepdim=True), values, 0)
    kept = values.clamp(min=0)
    y, x = _half_axes(size, length.device)
    smooth_y, smooth_x = smoothing(y / size[0], aperture), smoothing(x / size[1], aperture)
    weight_y = _multiplicity(size[0], length.device)[:, None] * smooth_y.square()
    weight_x = _multiplicity(size[1], length.device) * smooth_x.square()

    def total(eigenvalues: Tensor) -> Tensor:  # of all points of the torus; by rows, which no threads share
        return ((eigenvalues * weight_x).sum(dim=2, keepdim=True) * weight_y).sum(dim=1, keepdim=True)

    variance = total(kept)
    clipped = 1 - variance / (2 * variance - total(values))
    amplitude = root(kept).to(dtype) * (smooth_y / variance.sqrt()).to(dtype) * smooth_x.to(dtype)
    return Spectrum(amplitude, clipped[:, 0, 0].to(dtype))


def eigenvalues(
    size: tuple[int, int], length: Tensor, kind: str, *, most: tuple[int | None, int | None] = (None, None)
) -> Tensor:
    """(B, Ht / 2 + 1, Wt / 2 + 1), float64, up to rounding; fewer rows and columns, from frequency 0 on, up to `most`.

    The lengths are (B, 1, 1), px, float64.
    """
    # The covariance is even along both axes, so a quarter of it holds everything. Smooth ones need float64: their
    # eigenvalues span sixteen powers of ten.
    y, x = _half_axes(size, length.device)
    if kind == "gaussian":  # a product of two functions of one axis
        others = _others(size, length, kind)
        rows, columns = (
            covariance(t, length, kind) + others * (covariance(n - t, length, kind) + covariance(n + t, length, kind))
            for t, n in ((y, size[0]), (x, size[1]))
        )
        return _transform(rows, -2)[:, : most[0]] * _transform(columns, -1)[:, :, : most[1]]
    at_once = rows_at_once(length.device, len(y), each=len(length) * size[1], cached=_CACHED // 2)
    parts = (_on_torus(part, x, size, length, kind) for part in y.split(at_once))
    bands = (_transform(part, -1)[:, :, : most[1]] for part in parts)
    return _transform(cat_bands(bands, dim=1, length=len(y)), -2)[:, : most[0]]


def _on_torus(y: Tensor, x: Tensor, size: tuple[int, int], length: Tensor, kind: str) -> Tensor:
    """(B, n, m): a Matern covariance at rows (n, 1) and columns (m,) of the torus."""
    x2, y2, far_x2, far_y2 = x * x, y * y, (size[1] - x).square(), (size[0] - y).square()
    if kind == "exponential":
        return covariance((x2 + y2).sqrt(), length, kind)
    near, *far = (
        covariance(square.sqrt(), length, kind) for square in (x2 + y2, far_x2 + y2, x2 + far_y2, far_x2 + far_y2)
    )
    return near + _others(size, length, kind) * sum(far)


def _others(size: tuple[int, int], length: Tensor, kind: str) -> Tensor:
    """(B, 1, 1): whether the covariance is summed over the ways round the torus."""
    # That of the shortest way has a kink half-way where the covariance is smooth, and so negative eigenvalues. The sum
    # has none; on a torus too short for it, it would be off by more.
    return (REACH[kind] * length <= min(size)).double()


def _half_axes(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    y, x = (torch.arange(n // 2 + 1, dtype=torch.float64, device=device) for n in size)
    return y[:, None], x


def smoothing(frequency: Tensor, aperture: Tensor | None) -> Tensor:
    """What a Gaussian aperture leaves of the amplitude at frequencies in cycles per px."""
    if aperture is None:
        return torch.ones_like(frequency)
    kept = torch.exp(-0.5 * (2 * math.pi * aperture.double()[:, None, None] * frequency).square())
    # Below, products are no normal numbers of float32 any more, with which all arithmetic is many times slower.
    return torch.where(kept > _NOTHING, kept, 0)


def root(values: Tensor) -> Tensor:
    """The square root, without a slope where there is nothing."""
    if not (values.requires_grad and torch.is_grad_enabled()):
        return values.sqrt()
    # The root of zero has no slope, and a frequency that is not there needs none.
    return torch.where(values > 0, values, 1).sqrt() * (values > 0)


def _transform(values: Tensor, dim: int) -> Tensor:
    """The real Fourier transform of an even, periodic sequence, half of which is given and returned."""
    if torch.compiler.is_compiling():
        return torch.ops.torchrefract.even_transform(values, dim)
    return _even_transform(values, dim)


def _even_transform(values: Tensor, dim: int) -> Tensor:
    if values.shape[0] == 0:  # which PyTorch before 2.15 cannot transform
        return values.clone()
    # One sample at a time on the CPU: there long transforms of several round otherwise.
    each = values.split(1) if values.device.type == "cpu" else [values]
    return torch.cat([torch.fft.rfft(_whole(one, dim), dim=dim).real for one in each])


def _fields(noise: Tensor, shape: Tensor, height: int, width: int) -> Tensor:
    if noise.shape[0] == 0:
        return noise.new_zeros(0, 2, height, width)
    parts = [_field(*one, height, width) for one in zip(noise.split(1), shape.split(1), strict=True)]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _field(noise: Tensor, shape: Tensor, height: int, width: int) -> Tensor:
    rows = noise.shape[2]
    # Rows and then columns at a time stay in the cache, and only what the frame needs is kept of them.
    half = cat_bands(_shaped_rows(noise, shape, width), dim=1, length=rows)
    bands = (
        torch.view_as_real(torch.fft.fft(band, dim=1)[:, :height]).movedim(-1, 1)
        for band in half.split(_at_once(noise, rows), dim=2)
    )
    return cat_bands(bands, dim=3, length=width)


def _shaped_rows(noise: Tensor, shape: Tensor, width: int) -> Iterator[Tensor]:
    rows, columns = noise.shape[2:]
    most, middle = _at_once(noise, columns), shape.shape[1]
    starts = [*range(0, middle, most), *range(middle, rows, most)]
    for start, end in zip(starts, [*starts[1:], rows], strict=True):
        part = shape[:, start:end] if end <= middle else shape[:, rows - end + 1 : rows - start + 1].flip(1)
        weighted = noise[:, :, start:end] * _whole(part, -1).unsqueeze(1)
        yield torch.fft.fft(torch.complex(weighted[:, 0], weighted[:, 1]), dim=2)[:, :, :width]


def _whole(half: Tensor, dim: int) -> Tensor:
    """An even, periodic sequence, half of which is given."""
    return torch.cat([half, half.narrow(dim, 1, half.shape[dim] - 2).flip(dim)], dim=dim)


def _at_once(noise: Tensor, count: int) -> int:
    """How many lines of `count` points go through the cache together."""
    return noise.shape[2] * noise.shape[3] if noise.device.type != "cpu" else max(1, _CACHED // count)


def _multiplicity(count: int, device: torch.device) -> Tensor:
    """How often each value of a half stands in the whole."""
    times = torch.full((count // 2 + 1,), 2.0, dtype=torch.float64, device=device)
    times[:1].fill_(1)  # of slices: numbers put in one place are waited for by an accelerator
    times[-1:].fill_(1)
    return times


@torch.library.custom_op("torchrefract::even_transform", mutates_args=())
def _even_transform_op(values: Tensor, dim: int) -> Tensor:
    return _even_transform(values, dim).contiguous()


@_even_transform_op.register_fake
def _(values: Tensor, dim: int) -> Tensor:
    return torch.empty_like(values, memory_format=torch.contiguous_format)


def _keep_even_transform(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.dim = inputs[1]


def _even_transform_gradient(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
    times = _multiplicity(2 * (slope.shape[ctx.dim] - 1), slope.device)
    times = times if ctx.dim == -1 else times[:, None]
    return times * torch.ops.torchrefract.even_transform(slope / times, ctx.dim), None


_even_transform_op.register_autograd(_even_transform_gradient, setup_context=_keep_even_transform)


@torch.library.custom_op("torchrefract::gaussian_random_field", mutates_args=())
def _field_op(noise: Tensor, shape: Tensor, height: int, width: int) -> Tensor:
    # Of one sample in one band the fields are a view, and compilers rely on the strides that the op below states.
    return _fields(noise, shape, height, width).contiguous()


@_field_op.register_fake
def _(noise: Tensor, shape: Tensor, height: int, width: int) -> Tensor:
    return noise.new_empty((noise.shape[0], 2, height, width))


@torch.library.custom_op("torchrefract::gaussian_random_field_gradients", mutates_args=())
def _field_gradients(slope: Tensor, noise: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """What `_fields` passes back from the slope (B, 2, H, W) to its two inputs."""
    size = noise.shape[2:]
    if noise.shape[0] == 0:
        return torch.zeros_like(noise), torch.zeros_like(shape)
    weighted = torch.fft.fft2(torch.complex(slope[:, 0], -slope[:, 1]), s=tuple(size)).conj()
    weighted = torch.view_as_real(weighted.resolve_conj()).movedim(-1, 1)
    quarter = (noise * weighted).sum(dim=1)
    for dim, count in ((1, size[0]), (2, size[1])):
        half, mirrored = quarter.split([count // 2 + 1, count // 2 - 1], dim=dim)
        inner = half.narrow(dim, 1, count // 2 - 1) + mirrored.flip(dim)
        quarter = torch.cat([half.narrow(dim, 0, 1), inner, half.narrow(dim, count // 2, 1)], dim=dim)
    return (_whole(_whole(shape, -1), -2).unsqueeze(1) * weighted).contiguous(), quarter


@_field_gradients.register_fake
def _(slope: Tensor, noise: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    return noise.new_empty(noise.shape), shape.new_empty(shape.shape)


def _keep_field(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:2])


def _field_gradient(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor, None, None]:
    return *torch.ops.torchrefract.gaussian_random_field_gradients(slope, *ctx.saved_tensors), None, None


_field_op.register_autograd(_field_gradient, setup_context=_keep_field)
