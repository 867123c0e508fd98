import math

import pytest
import torch
from torchrefract.fields.field_bounds import FieldRanges, FieldSpectrum, error_of_cubics, field_spectrum
from torchrefract.fields.gaussian import spectrum

from torchrefract.fields.covariance import COVARIANCES, as_gaussians, covariance
from torchrefract.ops.cubic import lagrange_weights

SIZE = (512, 640)
CASES = [("exponential", 20.0, 2.0), ("exponential", 40.0, 4.0), ("matern32", 12.0, 2.5), ("matern52", 25.0, 6.0)]


def power(kind: str, length: float, aperture: float) -> torch.Tensor:
    """(Ht, Wt): the variance at each frequency of the torus, of sum 1."""
    tensors = (torch.tensor([value], dtype=torch.float64) for value in (length, aperture))
    found = spectrum(SIZE, next(tensors), kind=kind, aperture=next(tensors), dtype=torch.float64).amplitude[0]
    half = torch.cat([found, found[:, 1:-1].flip(1)], dim=1)
    return torch.cat([half, half[1:-1].flip(0)]).square()


def frequencies() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = (2 * math.pi * torch.fft.fftfreq(n, dtype=torch.float64) for n in SIZE)
    return y[:, None], x


def ranges(kind: str, length: float, aperture: float) -> FieldRanges:
    return FieldRanges((1.0, 1.0), (length, 2 * length), (aperture, 2 * aperture), kind=kind)


def bounds(kind: str, length: float, aperture: float) -> FieldSpectrum:
    found = field_spectrum(ranges(kind, length, aperture))
    assert found is not None
    return found


@pytest.mark.parametrize("kind", COVARIANCES)
def test_covariances_are_sums_of_gaussian_ones(kind):
    h, length = torch.linspace(0, 300, 200, dtype=torch.float64), torch.tensor(30.0, dtype=torch.float64)
    weight, scale = as_gaussians(kind, h.device)
    found = torch.exp(-0.5 * h[:, None].square() / (scale * length**2)) @ weight
    torch.testing.assert_close(found, covariance(h, length, kind), rtol=0, atol=2e-6)


@pytest.mark.parametrize(("kind", "length", "aperture"), CASES)
def test_frequencies_beyond_a_cutoff_are_as_weak_as_stated(kind, length, aperture):
    own, (y, x) = power(kind, length, aperture), frequencies()
    assert own.sum() == pytest.approx(1)
    for error in (0.1, 1e-2, 1e-3):
        cutoff = bounds(kind, length, aperture).cutoff(error)
        left_out = own[(y.abs() > cutoff) | (x.abs() > cutoff)].sum().sqrt()
        assert 0.5 * error < left_out <= error


@pytest.mark.parametrize(("kind", "length", "aperture"), CASES)
def test_derivatives_are_as_large_as_stated(kind, length, aperture):
    own, (_, x) = power(kind, length, aperture), frequencies()
    for order in (1, 2, 3):
        found = (own * x.abs() ** (2 * order)).sum().sqrt()
        bound = bounds(kind, length, aperture).derivative(order)
        assert 0.8 * bound < found <= bound


@pytest.mark.parametrize("stride", [2, 3, 5])
@pytest.mark.parametrize(("kind", "length", "aperture"), CASES)
def test_cubics_between_nodes_are_as_far_off_as_stated(kind, length, aperture, stride):
    own, (y, x) = power(kind, length, aperture), frequencies()
    weights = lagrange_weights(stride, dtype=torch.float64, device=torch.device("cpu"))
    nodes = stride * torch.arange(-1, 3, dtype=torch.float64)

    def transfer(place: int, k: torch.Tensor) -> torch.Tensor:
        return (weights[place] * torch.exp(1j * k[..., None] * (nodes - place))).sum(dim=-1)

    errors = [
        (own * (1 - transfer(i, y) * transfer(j, x)).abs().square()).sum().sqrt().item()
        for i in range(stride)
        for j in range(stride)
    ]
    bound = bounds(kind, length, aperture).error_between(stride, 4)
    assert 0.8 * bound < max(errors) <= bound
    assert bound < error_of_cubics(ranges(kind, length, aperture), stride)


def test_pixels_may_be_too_coarse_for_a_field():
    assert field_spectrum(FieldRanges((1.0, 1.0), (50.0, 50.0), (0.0, 5.0), kind="exponential")) is None
    assert field_spectrum(FieldRanges((1.0, 1.0), (2.0, 50.0), (0.0, 0.0))) is None
    assert field_spectrum(FieldRanges((1.0, 1.0), (2.0, 50.0), (3.0, 3.0))) is not None


@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 4])
@pytest.mark.parametrize("k", [0.5, 1.0, 1.5, 2.0, 2.2])
def test_what_pixels_fold_back_is_no_more_than_the_margin_takes_it_for(k, angle):
    x, y = k * math.cos(angle), k * math.sin(angle)
    places = [(i, j) for i in range(-80, 81) for j in range(-80, 81) if (i, j) != (0, 0)]
    folded = sum((k / math.hypot(x + 2 * math.pi * i, y + 2 * math.pi * j)) ** 3 for i, j in places)
    assert 0.03 * k**3 < folded <= 0.045 * k**3
