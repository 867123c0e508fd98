import math
from typing import Any

import gstools
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields import random_field
from torchrefract.fields.random_field import (
    COVARIANCES,
    FieldParams,
    Frequencies,
    Motion,
    amplitudes,
    covariance,
    embedding_size,
    frequency_noise,
    gaussian_mixture,
    gradient_rms,
    sample_field,
    sum_of_waves,
    turn_rates,
)

# Correlation lengths between opposite edges of the frame, around the periodic domain.
REACH = {"exponential": 8, "gaussian": 5, "matern32": 6, "matern52": 6}
FRAMES = [(48, 48), (31, 200), (1, 40), (1, 1)]


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def exact_amplitudes(
    size: tuple[int, int], length: float, kind: str, aperture: float | None = None
) -> tuple[Tensor, Tensor]:
    """Return the amplitudes (Ht, Wt) and the clipped share () of one sample."""
    apertures = None if aperture is None else double(aperture)
    quarter, clipped = amplitudes(
        Frequencies.all(size), double(length), kind=kind, aperture=apertures, dtype=torch.float64
    )
    return mirrored(quarter[0]), clipped[0]


def mirrored(quarter: Tensor) -> Tensor:
    """Return (Ht, Wt) from the quarter (Ht / 2 + 1, Wt / 2 + 1) of values that are even along both axes."""
    half = torch.cat([quarter, quarter[:, 1:-1].flip(1)], dim=1)
    return torch.cat([half, half[1:-1].flip(0)], dim=0)


def covariance_of(amplitude: Tensor) -> Tensor:
    """Return (Ht, Wt): the covariance of a field with these amplitudes, by the inverse Fourier transform."""
    return torch.fft.ifft2(amplitude.square(), norm="forward").real


def distances(height: int, width: int) -> Tensor:
    return torch.hypot(torch.arange(height).double()[:, None], torch.arange(width).double())


def field_params(length: Tensor, aperture: Tensor | None = None, seed: int = 3) -> FieldParams:
    return FieldParams(length, aperture, random.noise_key(random.stream(seed, range(len(length)))))


def fields(pairs: int, height: int, width: int, *, length: float, kind: str, **options: Any) -> Tensor:
    """Return (pairs, 2, H, W) of variance 1."""
    frequencies = Frequencies.all(embedding_size(height, width, length=length, kind=kind))
    params = field_params(torch.full((pairs,), length))
    options = {"kind": kind, "dtype": torch.float32} | options
    return sample_field(params, frequencies, range(height), range(width), **options)[0]


def gstools_model(kind: str, length: float) -> Any:
    """Return the same covariance in GSTools' units: exp(-pi / 4 (h / L)^2), and sqrt(nu) h / L for Matern."""
    nu = {"matern32": 1.5, "matern52": 2.5}.get(kind)
    if nu is not None:
        return gstools.Matern(dim=2, var=1, len_scale=length / math.sqrt(2), nu=nu)
    if kind == "gaussian":
        return gstools.Gaussian(dim=2, var=1, len_scale=math.sqrt(math.pi / 2) * length)
    return gstools.Exponential(dim=2, var=1, len_scale=length)


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
def test_covariances_match_gstools_and_their_gaussian_mixture(kind, oracle):
    h = torch.linspace(0, 90, 181, dtype=torch.float64)
    values = covariance(h, double(11.0), kind)
    theirs = torch.from_numpy(gstools_model(kind, 11.0).covariance(h.numpy()))
    oracle(f"covariance, GSTools, {kind}", values, theirs, 1e-12, unit="")
    weight, scale = gaussian_mixture(kind, h.device)
    assert_close(torch.exp(-0.5 * h[:, None].square() / (scale * 11.0**2)) @ weight, values, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [0.1, 3.0, 50.0])
@pytest.mark.parametrize("frame", FRAMES)
def test_the_inverse_fft_of_the_eigenvalues_is_the_covariance(frame, length, kind, oracle):
    size = embedding_size(*frame, length=length, kind=kind)
    amplitude, clipped = exact_amplitudes(size, length, kind)
    error = (
        covariance_of(amplitude)[: frame[0], : frame[1]] - covariance(distances(*frame), double(length), kind)
    ).abs()
    assert error[0, 0] < 1e-12  # the variance is always 1
    # The covariance at the far edge, from both axes together, and the clipped share.
    rest = covariance(double(min(size[0] - frame[0], size[1] - frame[1]) + 1), double(length), kind).item()
    assert error.max() <= 2 * rest + 2 * clipped.item() + 1e-12
    what = f"random field, inverse FFT of the eigenvalues, {kind}"
    oracle(what, error, torch.zeros_like(error), math.exp(-REACH[kind]), unit="")
    assert clipped <= 1e-4


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [2.0, 30.0])
@pytest.mark.parametrize("aperture", [None, 1.5])
def test_the_clipped_share_is_that_of_the_negative_eigenvalues(kind, length, aperture):
    size = (24, 30)
    amplitude, clipped = exact_amplitudes(size, length, kind, aperture)
    y, x = (torch.minimum(torch.arange(n), n - torch.arange(n)).double() for n in size)
    values = covariance(torch.hypot(y[:, None], x), double(length), kind)
    if REACH[kind] * length <= 24 and kind != "exponential":
        values = sum(
            covariance(torch.hypot(y[:, None] + a, x + b), double(length), kind)
            for a in (-24, 0, 24)
            for b in (-30, 0, 30)
        )
    eigenvalues = torch.fft.fft2(values).real
    if aperture is not None:
        ky, kx = (2 * math.pi * torch.fft.fftfreq(n, dtype=torch.float64) for n in size)
        eigenvalues = eigenvalues * torch.exp(-(aperture**2) * (ky[:, None] ** 2 + kx**2))
    share = -eigenvalues.clamp(max=0).sum() / eigenvalues.abs().sum()
    assert clipped.item() == pytest.approx(share.item(), abs=1e-7)
    assert (share > 1e-3) == (length == 30)
    positive = eigenvalues.clamp(min=0)
    assert_close(amplitude.square(), positive / positive.sum(), rtol=0, atol=1e-8)


@pytest.mark.parametrize("aperture", [0.5, 10.0])
def test_an_aperture_widens_a_gaussian_covariance_as_in_closed_form(aperture):
    length = 3.0
    size = embedding_size(40, 50, length=length, kind="gaussian", aperture=aperture)
    values = covariance_of(exact_amplitudes(size, length, "gaussian", aperture)[0])[:40, :50]
    exact = covariance(distances(40, 50), double(math.sqrt(length**2 + 2 * aperture**2)), "gaussian")
    assert_close(values, exact, rtol=0, atol=4e-4)


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
def test_no_amplitude_is_a_denormal_number(kind):
    frequencies = Frequencies.all((200, 300))
    options = {"kind": kind, "aperture": torch.tensor([5.0]), "dtype": torch.float32}
    amplitude, _ = amplitudes(frequencies, torch.tensor([20.0]), **options)
    assert (amplitude == 0).any()
    assert amplitude[amplitude > 0].min() >= torch.finfo(torch.float32).tiny


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("frame", [(1080, 1920), (1, 1), (1, 40_000), (2160, 3840)])
def test_the_domain_is_large_enough_or_as_large_as_the_cap_allows(frame, kind):
    for length in (0.1, 20.0, 200.0, 1e4, 1e30):
        size = embedding_size(*frame, length=length, kind=kind)
        assert size[0] * size[1] <= 1 << 24
        for points, pixels in zip(size, frame, strict=True):
            assert points % 2 == 0
            assert points >= max(pixels, 2)
            assert (2 * 3 * 5 * 7) ** 64 % points == 0  # no other prime factors
        if min(n - m for n, m in zip(size, frame, strict=True)) < REACH[kind] * length:
            assert size[0] * size[1] > 0.9 * (1 << 24)


@pytest.mark.quick
def test_the_edges_of_a_frame_as_large_as_the_cap_do_not_join():
    size = embedding_size(4320, 7680, length=50.0, kind="matern32")
    assert min(size[0] - 4320, size[1] - 7680) >= 300


# Lags, px, at which the number of independent pieces of 48 fields allows for 3 % (three standard deviations or more).
@pytest.mark.parametrize(
    ("kind", "length", "frame", "lags"),
    [("exponential", 1.0, (127, 160), (1, 2, 3)), ("matern32", 20.0, (480, 640), (1, 5, 10, 20))],
)
def test_the_variogram_of_samples_is_the_theoretical_one(kind, length, frame, lags, oracle):
    values = fields(24, *frame, length=length, kind=kind).double()
    assert values.square().mean() == pytest.approx(1, rel=0.03)
    assert abs((values[:, 0] * values[:, 1]).mean()) < 0.03
    for lag in lags:
        exact = 1 - covariance(double(lag), double(length), kind).item()
        rows = (values[:, :, lag:] - values[:, :, :-lag]).square().mean() / 2
        columns = (values[:, :, :, lag:] - values[:, :, :, :-lag]).square().mean() / 2
        what = f"random field, variogram of 48 fields, {kind}"
        oracle(what, (rows + columns) / 2 / exact, torch.ones_like(rows), 0.03, unit="")
        diagonal = (values[:, :, lag:, lag:] - values[:, :, :-lag, :-lag]).square().mean() / 2
        exact = 1 - covariance(double(lag * math.sqrt(2)), double(length), kind).item()
        oracle(what, diagonal / exact, torch.ones_like(diagonal), 0.03, unit="")


@pytest.mark.parametrize("kind", COVARIANCES)
def test_opposite_edges_are_uncorrelated_and_fields_without_length_are_white(kind):
    values = fields(24, 60, 90, length=6.0, kind=kind).double()
    # A periodic frame would have C(1) between its edges. Forty-eight fields have about 48 * 90 / 12 pieces.
    assert abs((values[:, :, 0] * values[:, :, -1]).mean()) < 4 / math.sqrt(48 * 90 / 12 / 2)
    assert abs((values[..., 0] * values[..., -1]).mean()) < 4 / math.sqrt(48 * 60 / 12 / 2)
    values = fields(24, 127, 160, length=0.1, kind=kind)
    assert values.std().item() == pytest.approx(1, abs=0.01)
    assert (values[..., 1:] * values[..., :-1]).mean().item() == pytest.approx(0, abs=5 / math.sqrt(values.numel()))


@pytest.mark.quick
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-11), (torch.float32, 5e-5)])
@pytest.mark.parametrize("frequencies", [Frequencies.all((12, 20)), Frequencies((12, 20), 2, 3)], ids=["all", "low"])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_field_is_the_sum_of_its_waves_at_any_rows_and_columns(frequencies, dtype, atol, step):
    # By FFT if the step divides the domain, otherwise by products of matrices.
    rows, columns = range(-4 * step, 9 * step, step), range(-step, 25 * step, step)
    values = torch.randn(2, 2, *frequencies.counts, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ky, kx = (2 * math.pi / n * k.double() for k, n in zip(frequencies.numbers(values.device), (12, 20), strict=True))
    phase = [k[:, None] * torch.tensor(list(p)).double() for k, p in ((ky, rows), (kx, columns))]
    waves = [torch.polar(torch.ones_like(angle), -angle) for angle in phase]
    expected = torch.einsum("bkl,ky,lx->byx", torch.complex(*values.unbind(1)), *waves)
    field = sum_of_waves(values.to(dtype), frequencies, rows, columns)
    assert field.dtype == dtype
    assert_close(field.double(), torch.stack([expected.real, expected.imag], dim=1), rtol=0, atol=atol)


@pytest.mark.quick
def test_low_frequencies_have_the_noise_and_turn_rates_of_all():
    size = (12, 20)
    key = random.noise_key(random.stream(5, range(2)))
    every, low = Frequencies.all(size), Frequencies(size, 3, 4)
    ky, kx = (k.remainder(n) for k, n in zip(low.numbers(key.device), size, strict=True))
    for draw in (frequency_noise, turn_rates):
        expected = draw(key, every, dtype=torch.float32)[..., ky[:, None], kx]
        assert torch.equal(draw(key, low, dtype=torch.float32), expected)


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
def test_low_frequencies_give_the_field_of_all_where_an_aperture_removes_the_others(kind):
    size, span = (120, 160), (range(60), range(0, 80, 2))
    params = field_params(double(6.0, 9.0), double(4.0, 5.0))
    params = params._replace(motion=Motion(double(3.0, -70.0), torch.rand(2, 2).double(), double(9.0, math.inf)))
    options: Any = {"kind": kind, "dtype": torch.float64}
    whole, _ = sample_field(params, Frequencies.all(size), *span, **options)
    low, _ = sample_field(params, Frequencies(size, 32, 44), *span, **options)
    assert_close(low, whole, rtol=0, atol=1e-5)


@pytest.mark.quick
def test_the_wind_moves_a_field_and_time_decorrelates_it():
    frequencies, span = Frequencies.all((96, 120)), (range(40), range(50))
    params = field_params(double(6.0).expand(400))
    options: Any = {"kind": "gaussian", "dtype": torch.float64}

    def at(frame: float, decorrelation: float) -> Tensor:
        motion = Motion(
            *(
                double(*value).expand(400, *[-1] * (len(value) > 1))
                for value in ((frame,), (2.0, -1.0), (decorrelation,))
            )
        )
        return sample_field(params._replace(motion=motion), frequencies, *span, **options)[0]

    still, _ = sample_field(params, frequencies, *span, **options)
    assert_close(at(3.0, math.inf)[:, :, :-3, 6:], still[:, :, 3:, :-6], rtol=0, atol=1e-9)
    later = at(3.0, 4.0)[:, :, :-3, 6:]
    correlation = (later * still[:, :, 3:, :-6]).mean().item()
    assert correlation == pytest.approx(math.exp(-((3 / 4) ** 2)), abs=0.02)
    assert later.square().mean().item() == pytest.approx(1, rel=0.03)


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [1.0, 20.0])
def test_the_rms_gradient_is_that_of_the_spectrum(kind, length):
    for aperture, rel in ((None, 2e-3), (0.3, 0.1), (1.0, 0.03), (2.0, 0.01), (8.0, 0.01)):
        size = embedding_size(40, 40, length=length, kind=kind, aperture=2 * (aperture or 0.0))
        values = covariance_of(exact_amplitudes(size, length, kind, aperture)[0])
        exact = math.sqrt(2 * (1 - values[0, 1].item()))
        apertures = None if aperture is None else double(aperture)
        assert gradient_rms(double(length), kind=kind, aperture=apertures).item() == pytest.approx(exact, rel=rel)


@pytest.mark.quick
def test_the_rms_gradient_of_a_wide_aperture_is_that_of_its_width():
    for kind in COVARIANCES:
        values = gradient_rms(torch.tensor([1e-3, 1.0]), kind=kind, aperture=torch.tensor([1e4, 1e3]))
        assert values.tolist() == pytest.approx([1e-4 / 2**0.5, 1e-3 / 2**0.5], rel=1e-3)


@pytest.mark.parametrize("kind", COVARIANCES)
def test_a_length_of_ten_frames_is_finite_and_near_its_covariance(monkeypatch, kind):
    monkeypatch.setattr(random_field, "_MAX_POINTS", 1 << 16)
    frame, length = (40, 64), 640.0
    size = embedding_size(*frame, length=length, kind=kind)
    lengths = torch.tensor([length], requires_grad=True)
    options: Any = {"kind": kind, "dtype": torch.float32}
    values, _ = sample_field(field_params(lengths), Frequencies.all(size), range(40), range(64), **options)
    assert values.isfinite().all()
    assert torch.autograd.grad(values.square().sum(), lengths)[0].isfinite().all()
    assert values.std(dim=(2, 3)).max() < 0.6  # so small a frame holds nearly one value
    amplitude, clipped = exact_amplitudes(size, length, kind)
    error = (covariance_of(amplitude)[:40, :64] - covariance(distances(*frame), double(length), kind)).abs()
    assert 1e-3 < clipped < 0.05
    # The clipped part is missing, and the normalization spreads it over the rest: twice at most.
    assert error.max() <= 2 * clipped / (1 - 2 * clipped)


@pytest.mark.quick
def test_fields_do_not_depend_on_their_batch_or_its_division(monkeypatch):
    frequencies, options = Frequencies.all((60, 72)), {"kind": "matern32", "dtype": torch.float64}
    params = field_params(double(5.0, 0.3, 2.0), double(0.0, 1.0, 2.0))
    together, _ = sample_field(params, frequencies, range(9), range(14), **options)
    monkeypatch.setattr(random_field, "_POINTS_AT_ONCE", 1)
    split, clipped = sample_field(params, frequencies, range(9), range(14), **options)
    assert clipped.shape == (3,)
    assert_close(split, together, rtol=0, atol=1e-12)
    assert params.aperture is not None
    empty = FieldParams(params.length[:0], params.aperture[:0], params.key[:0])
    assert sample_field(empty, frequencies, range(9), range(14), **options)[0].shape == (0, 2, 9, 14)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("frequencies", [Frequencies.all((12, 10)), Frequencies((12, 10), 3, 2)], ids=["all", "low"])
def test_gradients_of_a_field_match_finite_differences(kind, frequencies):
    key = random.noise_key(random.stream(3, range(2)))
    inputs = [double(0.8, 1.4).requires_grad_(), double(0.6, 0.3).requires_grad_()]

    def field(length: Tensor, aperture: Tensor) -> Tensor:
        params = FieldParams(length, aperture, key)
        return sample_field(params, frequencies, range(0, 8, 2), range(3), kind=kind, dtype=torch.float64)[0]

    assert torch.autograd.gradcheck(field, inputs)


@pytest.mark.quick
def test_gradients_are_finite_at_zero_aperture_and_at_clipped_eigenvalues():
    def amplitude(length: Tensor, aperture: Tensor) -> Tensor:
        every = Frequencies.all((16, 20))
        return amplitudes(every, length, kind="exponential", aperture=aperture, dtype=torch.float64)[0]

    length, aperture = double(30.0).requires_grad_(), double(0.0).requires_grad_()
    assert (amplitude(length, aperture) == 0).any()
    assert torch.autograd.gradcheck(lambda t: amplitude(t, aperture.detach()), [length])
    assert torch.autograd.grad(amplitude(length.detach(), aperture).square().sin().sum(), aperture)[0].item() == 0


def test_one_graph_computes_the_same_field_and_gradient():
    kind = "gaussian"
    frequencies = Frequencies.all(embedding_size(9, 14, length=4.0, kind=kind))

    def field(length: Tensor, aperture: Tensor) -> Tensor:
        params = field_params(length, aperture)
        motion = Motion(length, torch.stack([aperture, length], dim=1), length)
        options: Any = {"kind": kind, "dtype": torch.float32}
        return sample_field(params._replace(motion=motion), frequencies, range(9), range(14), **options)[0]

    inputs = [torch.tensor(pair, requires_grad=True) for pair in ((4.0, 2.0), (0.5, 1.0))]
    compiled, expected = torch.compile(field, fullgraph=True, backend="aot_eager")(*inputs), field(*inputs)
    assert_close(compiled, expected, rtol=0, atol=2e-5)
    gradients = [torch.autograd.grad(value.sin().sum(), inputs) for value in (compiled, expected)]
    for ours, eager in zip(*gradients, strict=True):
        assert_close(ours, eager, rtol=1e-3, atol=1e-3)
