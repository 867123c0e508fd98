import math
from typing import Any

import gstools
import pytest
import torch
from scipy import special
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields import torus as torus_module
from torchrefract.fields.covariance import COVARIANCES, covariance, slope_rms
from torchrefract.fields.gaussian import (
    Spectrum,
    axis_spectrum,
    gaussian_random_field,
    spectrum,
)
from torchrefract.fields.torus import torus

# Correlation lengths from edge to edge round the torus.
REACH = {"exponential": 8, "gaussian": 5, "matern32": 6, "matern52": 6}
FRAMES = [(48, 48), (97, 131), (31, 200), (1, 40), (40, 1), (1, 1)]


def one(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def exact_spectrum(size: tuple[int, int], length: float, kind: str, aperture: float | None = None) -> Spectrum:
    apertures = None if aperture is None else one(aperture)
    return spectrum(size, one(length), kind=kind, aperture=apertures, dtype=torch.float64)


def whole(half: Tensor) -> Tensor:
    """(Ht, Wt) of a quarter (Ht / 2 + 1, Wt / 2 + 1) of what is even along both axes."""
    half = torch.cat([half, half[:, 1:-1].flip(1)], dim=1)
    return torch.cat([half, half[1:-1].flip(0)], dim=0)


def covariance_of(shape: Spectrum) -> Tensor:
    """(Ht, Wt): the covariance that the amplitudes of one sample stand for, by the inverse Fourier transform."""
    return torch.fft.ifft2(whole(shape.amplitude[0]).square(), norm="forward").real


def distances(height: int, width: int) -> Tensor:
    return torch.hypot(torch.arange(height).double()[:, None], torch.arange(width).double())


def noise(count: int, size: tuple[int, int], seed: int = 3) -> Tensor:
    return random.white_noise(random.noise_key(random.stream(seed, torch.arange(count))), size[0] * size[1]).view(
        -1, 2, *size
    )


def fields(pairs: int, height: int, width: int, *, length: float, kind: str) -> Tensor:
    """(pairs, 2, H, W), fp32."""
    size = torus(height, width, length=length, kind=kind)
    shape = spectrum(size, torch.tensor([length]), kind=kind, dtype=torch.float32).amplitude
    found = [
        gaussian_random_field(noise(1, size, seed=seed), shape, height=height, width=width) for seed in range(pairs)
    ]
    return torch.cat(found)


@pytest.mark.parametrize(("kind", "nu"), [("exponential", 0.5), ("matern32", 1.5), ("matern52", 2.5)])
@pytest.mark.parametrize("length", [0.7, 20.0])
def test_the_matern_covariances_are_those_of_the_bessel_function(kind, nu, length):
    h = torch.linspace(0.01, 60, 500, dtype=torch.float64)
    x = math.sqrt(2 * nu) * h.numpy() / length
    exact = torch.from_numpy(2 ** (1 - nu) / special.gamma(nu) * x**nu * special.kv(nu, x))
    assert_close(covariance(h, one(length), kind), exact, rtol=0, atol=1e-12)
    assert covariance(one(0), one(length), kind).item() == 1


def test_the_gaussian_covariance_has_the_length_for_its_deviation():
    h = torch.linspace(0, 60, 500, dtype=torch.float64)
    exact = torch.from_numpy(special.ndtr(0.0) * 2 * torch.exp(-((h / 7) ** 2) / 2).numpy())
    assert_close(covariance(h, one(7.0), "gaussian"), exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [0.1, 1.0, 3.0, 10.0, 50.0, 200.0])
@pytest.mark.parametrize("frame", FRAMES)
def test_the_eigenvalues_stand_for_the_covariance(frame, length, kind, oracle):
    size = torus(*frame, length=length, kind=kind)
    shape = exact_spectrum(size, length, kind)
    error = (covariance_of(shape)[: frame[0], : frame[1]] - covariance(distances(*frame), one(length), kind)).abs()
    assert error[0, 0] < 1e-12  # the variance is 1 in any case
    # What is left of the covariance at the far edge, from both axes together, and of what is clipped.
    left = covariance(one(min(size[0] - frame[0], size[1] - frame[1]) + 1), one(length), kind).item()
    assert error.max() <= 2 * left + 2 * shape.clipped.item() + 1e-12
    what = f"random field, inverse FFT of the eigenvalues, {kind}"
    oracle(what, error, torch.zeros_like(error), math.exp(-REACH[kind]), unit="")
    assert shape.clipped <= 1e-4


@pytest.mark.parametrize(
    ("kind", "size", "length"),
    [
        ("exponential", (128, 128), 10.0),
        ("exponential", (450, 600), 30.0),
        ("exponential", (1250, 1080), 8.0),
        ("gaussian", (128, 256), 6.0),
        ("gaussian", (1000, 450), 25.0),
        ("matern32", (256, 200), 4.0),
        ("matern52", (256, 200), 5.0),
    ],
)
def test_within_half_the_torus_the_covariance_is_exact_where_it_has_room(kind, size, length):
    shape = exact_spectrum(size, length, kind)
    frame = (size[0] // 2 + 1, size[1] // 2 + 1) if kind == "exponential" else (size[0] // 4, size[1] // 4)
    # The exponential covariance goes the shortest way; the others go round too, and what is left of them is added.
    left = 0.0 if kind == "exponential" else covariance(one(0.75 * min(size)), one(length), kind).item()
    assert left < 1e-12
    assert_close(
        covariance_of(shape)[: frame[0], : frame[1]],
        covariance(distances(*frame), one(length), kind),
        rtol=0,
        atol=1e-12,
    )
    assert shape.clipped < 1e-12


@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_fields_covariance_is_that_of_the_eigenvalues_and_its_components_are_independent(kind):
    height, width, length = 3, 4, 1.2
    size = torus(height, width, length=length, kind=kind)
    shape = exact_spectrum(size, length, kind)
    # The field is a matrix times the noise, one column for each number of it.
    count = 2 * size[0] * size[1]
    columns = torch.eye(count, dtype=torch.float64).view(count, 2, *size)
    matrix = gaussian_random_field(columns, shape.amplitude.expand(count, -1, -1), height=height, width=width).view(
        count, -1
    )
    found = (matrix.T @ matrix).view(2, height, width, 2, height, width)
    torus_covariance = covariance_of(shape)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    expected = torus_covariance[(y[:, :, None, None] - y) % size[0], (x[:, :, None, None] - x) % size[1]]
    for i in range(2):
        for j in range(2):
            assert_close(found[i, :, :, j], expected if i == j else torch.zeros_like(expected), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 5e-6)])
def test_the_field_is_the_sum_of_its_waves(dtype, atol):
    size, height, width = (12, 10), 7, 5
    shape = torch.rand(2, 7, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    numbers = noise(2, size).double()
    ky, kx = (2 * math.pi * torch.arange(n).double() / n for n in size)
    phase = ky[:, None] * torch.arange(height)[:, None, None, None] + kx * torch.arange(width)[:, None, None]
    amplitude = torch.stack([whole(half) for half in shape])
    waves = torch.einsum(
        "bkl,hwkl->bhw", amplitude * torch.complex(*numbers.unbind(1)), torch.polar(torch.ones_like(phase), -phase)
    )
    found = gaussian_random_field(numbers.to(dtype), shape.to(dtype), height=height, width=width)
    assert found.dtype == dtype
    assert_close(found.double(), torch.stack([waves.real, waves.imag], dim=1), rtol=0, atol=atol * shape.sum().item())


# Lags, px, at which the number of independent pieces of 48 fields allows for 3 % (three standard deviations or more).
@pytest.mark.parametrize(
    ("length", "frame", "lags"),
    [(1.0, (127, 160), (1, 2, 3)), (5.0, (240, 331), (1, 2, 5, 10)), (20.0, (480, 640), (1, 5, 10, 20))],
)
@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_variogram_of_samples_is_the_theoretical_one(kind, length, frame, lags, oracle):
    found = fields(24, *frame, length=length, kind=kind).double()
    assert found[:, 0].numel() + found[:, 1].numel() == 48 * frame[0] * frame[1]
    assert found.square().mean() == pytest.approx(1, rel=0.03)
    assert abs((found[:, 0] * found[:, 1]).mean()) < 0.03
    for lag in lags:
        exact = 1 - covariance(one(lag), one(length), kind).item()
        rows = (found[:, :, lag:] - found[:, :, :-lag]).square().mean() / 2
        columns = (found[:, :, :, lag:] - found[:, :, :, :-lag]).square().mean() / 2
        what = f"random field, variogram of 48 fields, {kind}"
        oracle(what, (rows + columns) / 2 / exact, torch.ones_like(rows), 0.03, unit="")
        both = (found[:, :, lag:, lag:] - found[:, :, :-lag, :-lag]).square().mean() / 2
        exact = 1 - covariance(one(lag * math.sqrt(2)), one(length), kind).item()
        oracle(what, both / exact, torch.ones_like(both), 0.03, unit="")


def gstools_model(kind: str, length: float) -> Any:
    """The same covariance in the conventions of GSTools: exp(-pi / 4 (h / L)^2), and sqrt(nu) h / L for Matern."""
    nu = {"matern32": 1.5, "matern52": 2.5}.get(kind)
    if nu is not None:
        return gstools.Matern(dim=2, var=1, len_scale=length / math.sqrt(2), nu=nu)
    if kind == "gaussian":
        return gstools.Gaussian(dim=2, var=1, len_scale=math.sqrt(math.pi / 2) * length)
    return gstools.Exponential(dim=2, var=1, len_scale=length)


@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_covariance_is_that_of_gstools(kind, oracle):
    h = torch.linspace(0, 90, 181, dtype=torch.float64)
    theirs = torch.from_numpy(gstools_model(kind, 11.0).covariance(h.numpy()))
    oracle(f"covariance, GSTools, {kind}", covariance(h, one(11.0), kind), theirs, 1e-12, unit="")


@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_variogram_by_gstools_is_that_of_its_model(kind, oracle):
    length, lags = 5.0, 12
    found = fields(24, 131, 160, length=length, kind=kind).flatten(0, 1).double()
    # The least its estimator can do: pairs along each axis, of every field.
    estimates = [gstools.vario_estimate_axis(one.numpy(), axis) for one in found for axis in ("x", "y")]
    gamma = torch.stack([torch.from_numpy(estimate[1 : lags + 1]) for estimate in estimates]).mean(dim=0)
    expected = torch.from_numpy(gstools_model(kind, length).variogram(torch.arange(1.0, lags + 1).numpy()))
    what = f"random field, GSTools' estimate of 48 fields and its model, {kind}"
    oracle(what, gamma / expected, torch.ones_like(gamma), 0.03, unit="")


def test_the_variogram_of_long_correlations_is_the_theoretical_one():
    # Of 200 px only the exponential field has enough independent pieces: those of its roughness.
    found = fields(20, 131, 240, length=200.0, kind="exponential").double()
    for lag in (1, 2, 4):
        exact = 1 - math.exp(-lag / 200)
        assert (found[:, :, lag:] - found[:, :, :-lag]).square().mean() / 2 == pytest.approx(exact, rel=0.03)
        assert (found[..., lag:] - found[..., :-lag]).square().mean() / 2 == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("kind", COVARIANCES)
def test_opposite_edges_do_not_know_each_other(kind):
    found = fields(24, 60, 90, length=6.0, kind=kind).double()
    # A frame that were a torus itself would have C(1) here. Forty-eight fields have about 48 * 90 / 12 pieces.
    assert abs((found[:, :, 0] * found[:, :, -1]).mean()) < 4 / math.sqrt(48 * 90 / 12 / 2)
    assert abs((found[..., 0] * found[..., -1]).mean()) < 4 / math.sqrt(48 * 60 / 12 / 2)


@pytest.mark.parametrize("kind", COVARIANCES)
def test_a_field_of_no_length_is_white_noise(kind):
    found = fields(24, 127, 160, length=0.1, kind=kind)
    assert found.std().item() == pytest.approx(1, abs=0.01)
    assert found.mean().item() == pytest.approx(0, abs=0.01)
    neighbors = (found[..., 1:] * found[..., :-1]).mean().item()
    assert neighbors == pytest.approx(0, abs=5 / math.sqrt(found.numel()))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", COVARIANCES)
def test_a_length_of_ten_frames_is_finite_and_near_its_covariance(monkeypatch, kind, dtype):
    monkeypatch.setattr(torus_module, "_MOST_POINTS", 1 << 16)
    frame, length = (40, 64), 640.0
    size = torus(*frame, length=length, kind=kind)
    lengths = torch.tensor([length], dtype=dtype, requires_grad=True)
    shape = spectrum(size, lengths, kind=kind, dtype=dtype)
    found = gaussian_random_field(noise(1, size).to(dtype), shape.amplitude, height=frame[0], width=frame[1])
    assert found.isfinite().all()
    assert torch.autograd.grad(found.square().sum(), lengths)[0].isfinite().all()
    exact = exact_spectrum(size, length, kind)
    error = (covariance_of(exact)[: frame[0], : frame[1]] - covariance(distances(*frame), one(length), kind)).abs()
    assert 1e-3 < exact.clipped < 0.05
    # The clipped part is missing and, by the normalization, spread over what is left: twice at most.
    share = exact.clipped.item()
    assert error.max() <= 2 * share / (1 - 2 * share)
    # A frame so small holds nearly one value.
    assert found.std(dim=(2, 3)).max() < 0.6


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [2.0, 30.0, 1e5])
@pytest.mark.parametrize("aperture", [None, 0.0, 1.5])
def test_the_clipped_share_is_that_of_the_negative_eigenvalues(kind, length, aperture):
    size = (24, 30)
    found = exact_spectrum(size, length, kind, aperture)
    y, x = (torch.minimum(torch.arange(n), n - torch.arange(n)).double() for n in size)
    values = covariance(torch.hypot(y[:, None], x), one(length), kind)
    if REACH[kind] * length <= 24 and kind != "exponential":
        values = sum(
            covariance(torch.hypot(y[:, None] + a, x + b), one(length), kind)
            for a in (-24, 0, 24)
            for b in (-30, 0, 30)
        )
    eigenvalues = torch.fft.fft2(values).real
    if aperture is not None:
        ky, kx = (2 * math.pi * torch.fft.fftfreq(n, dtype=torch.float64) for n in size)
        eigenvalues = eigenvalues * torch.exp(-(aperture**2) * (ky[:, None] ** 2 + kx**2))
    clipped = -eigenvalues.clamp(max=0).sum() / eigenvalues.abs().sum()
    assert found.clipped.item() == pytest.approx(clipped.item(), abs=1e-7)
    assert (clipped > 1e-3) == (length == 30)
    kept = eigenvalues.clamp(min=0)
    assert_close(whole(found.amplitude[0]).square(), kept / kept.sum(), rtol=0, atol=1e-8)
    assert whole(found.amplitude[0]).square().sum().item() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("frame", [(1080, 1920), (1079, 1913), (1, 1), (1, 40_000), (64, 64), (2160, 3840)])
def test_a_torus_has_room_or_is_as_large_as_may_be(frame, kind):
    for length in (0.1, 1.0, 20.0, 200.0, 1e4, 1e30):
        size = torus(*frame, length=length, kind=kind)
        assert size[0] * size[1] <= 1 << 24
        for points, pixels in zip(size, frame, strict=True):
            assert points % 2 == 0
            assert points >= max(pixels, 2)
            assert (2 * 3 * 5 * 7) ** 64 % points == 0  # no other prime factors
        if min(n - m for n, m in zip(size, frame, strict=True)) < REACH[kind] * length:
            assert size[0] * size[1] > 0.9 * (1 << 24)


def test_the_edges_of_a_frame_as_large_as_the_cap_do_not_join():
    assert min(n - m for n, m in zip(torus(4320, 7680, length=50.0, kind="matern32"), (4320, 7680), strict=True)) >= 300


def test_a_wide_aperture_has_room_too():
    frame, length, aperture = (40, 50), 2.0, 10.0
    size = torus(*frame, length=length, kind="gaussian", aperture=aperture)
    found = covariance_of(exact_spectrum(size, length, "gaussian", aperture))[:40, :50]
    exact = covariance(distances(*frame), one(math.sqrt(length**2 + 2 * aperture**2)), "gaussian")
    assert_close(found, exact, rtol=0, atol=4e-4)


@pytest.mark.parametrize("aperture", [0.0, 0.5, 2.0, 5.0])
@pytest.mark.parametrize("length", [3.0, 8.0])
def test_an_aperture_makes_a_gaussian_covariance_wider_by_the_closed_form(length, aperture):
    # exp(-h^2 / 2 l^2) smoothed twice by a deviation of a.
    found = covariance_of(exact_spectrum((160, 180), length, "gaussian", aperture))[:40, :50]
    exact = covariance(distances(40, 50), one(math.sqrt(length**2 + 2 * aperture**2)), "gaussian")
    assert_close(found, exact, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", COVARIANCES)
def test_an_amplitude_is_a_normal_number_or_zero(kind):
    amplitude = spectrum(
        (200, 300), torch.tensor([20.0]), kind=kind, aperture=torch.tensor([5.0]), dtype=torch.float32
    ).amplitude
    assert (amplitude == 0).any()
    assert amplitude[amplitude > 0].min() >= torch.finfo(torch.float32).tiny


@pytest.mark.parametrize("kind", COVARIANCES)
def test_an_aperture_smooths_the_field_by_a_gaussian(kind):
    size, length, aperture = (64, 80), 4.0, 1.7
    sharp, smooth = (exact_spectrum(size, length, kind, a).amplitude for a in (None, aperture))
    ky, kx = (2 * math.pi * torch.arange(n // 2 + 1).double() / n for n in size)
    # The Fourier transform of a Gaussian; what it takes from the variance is given back.
    expected = sharp * torch.exp(-(aperture**2) * (ky[:, None] ** 2 + kx**2) / 2)
    expected = expected / whole(expected[0]).square().sum().sqrt()
    assert_close(smooth, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [1.0, 3.0, 20.0, 60.0])
def test_the_slope_is_that_of_the_spectrum(kind, length):
    for aperture, rel in ((None, 2e-3), (0.0, 2e-3), (0.3, 0.1), (1.0, 0.03), (2.0, 0.01), (8.0, 0.01), (30.0, 0.01)):
        size = tuple(n + n % 2 for n in torus(40, 40, length=length, kind=kind, aperture=2 * (aperture or 0.0)))
        found = covariance_of(exact_spectrum(size, length, kind, aperture))  # pyright: ignore[reportArgumentType]  # two numbers
        exact = math.sqrt(2 * (1 - found[0, 1].item()))
        apertures = None if aperture is None else one(aperture)
        assert slope_rms(one(length), kind=kind, aperture=apertures).item() == pytest.approx(exact, rel=rel)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [0.05, 1.0, 30.0, 1e6])
def test_without_an_aperture_the_slope_is_the_closed_form(kind, length):
    h = 1 / length
    drop = {
        "exponential": -math.expm1(-h),
        "gaussian": -math.expm1(-h * h / 2),
        "matern32": 1 - (1 + 3**0.5 * h) * math.exp(-(3**0.5) * h) if h > 1e-3 else 1.5 * h * h,
        "matern52": 1 - (1 + 5**0.5 * h + 5 / 3 * h * h) * math.exp(-(5**0.5) * h) if h > 1e-3 else 5 / 6 * h * h,
    }[kind]
    assert slope_rms(one(length), kind=kind).item() == pytest.approx(math.sqrt(2 * drop), rel=1e-5)


def test_a_wide_aperture_leaves_the_slope_of_its_own_width():
    for kind in COVARIANCES:
        found = slope_rms(torch.tensor([1e-3, 1.0, 1e3]), kind=kind, aperture=torch.tensor([1e4, 1e3, 0.0]))
        assert found[:2].tolist() == pytest.approx([1e-4 / 2**0.5, 1e-3 / 2**0.5], rel=1e-3)
        assert found[2] == slope_rms(torch.tensor([1e3]), kind=kind)[0]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("frame", [(37, 53), (131, 160)])
def test_every_sample_of_a_batch_is_drawn_by_itself_bit_for_bit(frame, kind, dtype):
    lengths, apertures = torch.tensor([5.0, 0.3, 2.0, 4.9, 1.0]), torch.tensor([0.0, 1.0, 0.3, 2.0, 0.0])
    size = torus(*frame, length=5.0, kind=kind)
    together = spectrum(size, lengths, kind=kind, aperture=apertures, dtype=dtype)
    numbers = noise(5, size).to(dtype)
    found = gaussian_random_field(numbers, together.amplitude, height=frame[0], width=frame[1])
    for i in (slice(k, k + 1) for k in range(5)):
        alone = spectrum(size, lengths[i], kind=kind, aperture=apertures[i], dtype=dtype)
        assert torch.equal(alone.amplitude, together.amplitude[i])
        assert torch.equal(alone.clipped, together.clipped[i])
        assert torch.equal(
            gaussian_random_field(numbers[i], alone.amplitude, height=frame[0], width=frame[1]), found[i]
        )
        assert torch.equal(
            slope_rms(lengths[i], kind=kind, aperture=apertures[i]),
            slope_rms(lengths, kind=kind, aperture=apertures)[i],
        )


@pytest.mark.parametrize(("samples", "kind"), [(1, "exponential"), (2, "gaussian"), (1, "matern52")])
def test_threads_do_not_change_a_bit(samples, kind, on_threads):
    frame = (211, 397)
    size = torus(*frame, length=20.0, kind=kind)
    found = []
    for threads in (1, 2, 3):
        on_threads(threads)
        shape = spectrum(
            size, torch.full((samples,), 20.0), kind=kind, aperture=torch.ones(samples), dtype=torch.float32
        )
        field = gaussian_random_field(noise(samples, size), shape.amplitude, height=frame[0], width=frame[1])
        found.append((field, shape.amplitude, shape.clipped))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, found[0], strict=True))


@pytest.mark.parametrize("frame", [(1, 1), (1, 9), (9, 1), (0, 9)])
def test_frames_of_one_row_or_less_are_cut_out_like_any(frame):
    size = torus(9, 9, length=2.0, kind="exponential")
    shape = exact_spectrum(size, 2.0, "exponential").amplitude
    whole_frame = gaussian_random_field(noise(1, size).double(), shape, height=9, width=9)
    found = gaussian_random_field(noise(1, size).double(), shape, height=frame[0], width=frame[1])
    assert_close(found, whole_frame[:, :, : frame[0], : frame[1]], rtol=0, atol=1e-12)
    assert min(torus(*frame, length=0.1, kind="gaussian")) >= 2


@pytest.mark.parametrize("kind", COVARIANCES)
def test_gradients_of_a_field_are_those_of_finite_differences(kind):
    size = (12, 10)
    numbers = noise(2, size).double()
    inputs = [torch.tensor(pair, dtype=torch.float64, requires_grad=True) for pair in ((0.8, 1.4), (0.6, 0.3))]

    def field(length: Tensor, aperture: Tensor) -> Tensor:
        shape = spectrum(size, length, kind=kind, aperture=aperture, dtype=torch.float64)
        return gaussian_random_field(numbers, shape.amplitude, height=5, width=4)

    assert torch.autograd.gradcheck(field, inputs)
    assert torch.autograd.gradgradcheck(field, inputs, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("batch", [1, 2])
def test_compilers_are_told_the_layout_that_a_field_has(batch):
    shape = spectrum((12, 10), torch.full((batch,), 0.8), kind="gaussian", dtype=torch.float32).amplitude
    args = (noise(batch, (12, 10)), shape, 5, 4)
    torch.library.opcheck(torch.ops.torchrefract.gaussian_random_field, args, test_utils="test_faketensor")


def test_a_batch_of_none_stays_one():
    shape = spectrum((12, 10), torch.zeros(0), kind="matern32", aperture=torch.zeros(0), dtype=torch.float32)
    assert shape.amplitude.shape == (0, 7, 6)
    assert gaussian_random_field(torch.zeros(0, 2, 12, 10), shape.amplitude, height=5, width=4).shape == (0, 2, 5, 4)


def test_an_aperture_of_zero_has_a_gradient_of_zero():
    aperture = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    shape = spectrum((16, 16), one(3.0), kind="exponential", aperture=aperture, dtype=torch.float64).amplitude
    assert torch.autograd.grad(shape.square().sin().sum(), aperture)[0].item() == 0


def test_clipped_eigenvalues_have_finite_gradients():
    length = one(30.0).requires_grad_()
    shape = spectrum((16, 20), length, kind="exponential", dtype=torch.float64)
    assert shape.clipped > 0
    assert (shape.amplitude == 0).any()
    assert torch.autograd.gradcheck(
        lambda t: spectrum((16, 20), t, kind="exponential", dtype=torch.float64).amplitude, [length]
    )


def test_the_operators_of_the_compiler_have_the_gradients_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(2, 2, 6, 8, generator=generator, dtype=torch.float64, requires_grad=True)
    shape = torch.rand(2, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    ops = torch.ops.torchrefract
    assert torch.autograd.gradcheck(lambda n, s: ops.gaussian_random_field(n, s, 5, 3), [numbers, shape])
    assert torch.autograd.gradcheck(lambda v: ops.even_transform(v, -1), [shape])
    assert torch.autograd.gradcheck(lambda v: ops.even_transform(v, -2), [shape])
    for operator, inputs in ((ops.gaussian_random_field, (numbers, shape, 5, 3)), (ops.even_transform, (shape, -2))):
        torch.library.opcheck(
            operator, inputs, test_utils=("test_schema", "test_autograd_registration", "test_faketensor")
        )


@pytest.mark.parametrize(("kind", "backend"), [("exponential", "inductor"), ("gaussian", "aot_eager")])
def test_compiled_code_gives_the_same_field_and_gradient(kind, backend):
    size = torus(9, 14, length=4.0, kind=kind)
    key = random.noise_key(random.stream(3, torch.arange(2)))

    def field(length: Tensor, aperture: Tensor) -> Tensor:
        shape = spectrum(size, length, kind=kind, aperture=aperture, dtype=torch.float32)
        numbers = random.white_noise(key, size[0] * size[1]).view(-1, 2, *size)
        return gaussian_random_field(numbers, shape.amplitude, height=9, width=14)

    inputs = [torch.tensor(pair, requires_grad=True) for pair in ((4.0, 2.0), (0.5, 1.0))]
    found, expected = torch.compile(field, fullgraph=True, backend=backend)(*inputs), field(*inputs)
    assert_close(found, expected, rtol=0, atol=1e-5)
    for compiled, eager in zip(*(torch.autograd.grad(f.sin().sum(), inputs) for f in (found, expected)), strict=True):
        assert_close(compiled, eager, rtol=1e-4, atol=1e-4)


def test_a_map_over_samples_gives_the_same_fields():
    size = torus(9, 14, length=4.0, kind="matern52")
    lengths, apertures, numbers = torch.tensor([4.0, 1.0]), torch.tensor([0.0, 1.0]), noise(2, size)

    def field(length: Tensor, aperture: Tensor, numbers: Tensor) -> Tensor:
        shape = spectrum(size, length[None], kind="matern52", aperture=aperture[None], dtype=torch.float32)
        return gaussian_random_field(numbers[None], shape.amplitude, height=9, width=14)[0]

    expected = torch.stack([field(*one_sample) for one_sample in zip(lengths, apertures, numbers, strict=True)])
    assert_close(torch.func.vmap(field)(lengths, apertures, numbers), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [640, 4608, 9216])
def test_the_factor_of_an_axis_is_that_of_each_sample_alone(size):
    length = torch.tensor([40.0, 85.4668, 3.0], dtype=torch.float64)
    together = axis_spectrum(size, length, None)
    for i in range(3):
        assert torch.equal(axis_spectrum(size, length[i : i + 1], None)[0], together[i])
