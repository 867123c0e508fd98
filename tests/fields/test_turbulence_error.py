import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchrefract.fields import turbulence_error
from torchrefract.fields.random_field import Frequencies, amplitudes
from torchrefract.fields.turbulence_error import RandomFieldErrorModel

SIZE = (512, 640)
CASES = [("exponential", 20.0, 2.0), ("matern32", 12.0, 2.5), ("matern52", 25.0, 6.0), ("gaussian", 9.0, 0.0)]


def power(kind: str, length: float, aperture: float) -> Tensor:
    """Return (Ht, Wt): the variance of each frequency, of sum 1."""
    lengths, apertures = (torch.tensor([value], dtype=torch.float64) for value in (length, aperture))
    options = {"kind": kind, "aperture": apertures, "dtype": torch.float64}
    quarter = amplitudes(Frequencies.all(SIZE), lengths, **options)[0][0]
    half = torch.cat([quarter, quarter[:, 1:-1].flip(1)], dim=1)
    return torch.cat([half, half[1:-1].flip(0)]).square()


def stream_power(length: float) -> Tensor:
    """Return the variance of each frequency of u = D_y psi for a Gaussian psi, of sum 1."""
    values = power("gaussian", length, 0.0) * radians()[0].sin().square()
    return values / values.sum()


def radians() -> tuple[Tensor, Tensor]:
    y, x = (2 * math.pi * torch.fft.fftfreq(n, dtype=torch.float64) for n in SIZE)
    return y[:, None], x


def model(kind: str, length: float, aperture: float, *, is_stream: bool = False) -> RandomFieldErrorModel:
    ranges = ((0.5, 1.0), (length, 2 * length), (aperture, 2 * aperture))
    return RandomFieldErrorModel(*ranges, covariance=kind, is_stream=is_stream)


def interpolation_error(spectrum: Tensor, stride: int) -> float:
    """Return the largest deviation of the error of cubics at any pixel between the nodes."""
    nodes = torch.arange(-1, 3, dtype=torch.float64)

    def transfer(place: int, k: Tensor) -> Tensor:
        t = place / stride
        weights = [math.prod((t - m) / (n - m) for m in range(-1, 3) if m != n) for n in range(-1, 3)]
        return (torch.tensor(weights).double() * torch.exp(1j * k[..., None] * stride * (nodes - t))).sum(dim=-1)

    y, x = radians()
    return max(
        (spectrum * (1 - transfer(i, y) * transfer(j, x)).abs().square()).sum().sqrt().item()
        for i in range(stride)
        for j in range(stride)
    )


@pytest.mark.quick
@pytest.mark.parametrize(("kind", "length", "aperture"), CASES)
def test_frequencies_that_are_left_out_use_their_share_of_the_budget(kind, length, aperture):
    spectrum, (y, x) = power(kind, length, aperture), radians()
    for budget in (0.02, 0.2):
        simplified = model(kind, length, aperture).simplify(600, 700, budget)
        assert simplified is not None
        rows, columns = simplified.details[1:]
        size = simplified.details.size
        left_out = (y.abs() > 2 * math.pi * rows / size[0]) | (x.abs() > 2 * math.pi * columns / size[1])
        deviation = spectrum[left_out].sum().sqrt().item()
        assert 0.3 * simplified.error_px < 7 * deviation <= simplified.error_px <= 0.31 * budget


@pytest.mark.quick
@pytest.mark.parametrize(("kind", "length", "aperture"), CASES)
def test_gradients_and_errors_of_cubics_are_bounded_closely(kind, length, aperture):
    spectrum, (_, x) = power(kind, length, aperture), radians()
    bounds = model(kind, length, aperture).bounds(600, 700)
    assert bounds.max_displacement == 7
    gradient = 4 * (spectrum * x.square()).sum().sqrt()
    assert 0.8 * bounds.max_gradient < gradient <= bounds.max_gradient * (1 + 1e-9)
    for stride in (2, 3, 5):
        bound = bounds.interpolation_error(np.array([1.0, float(stride)]))[1]
        assert 0.6 * bound < 7 * interpolation_error(spectrum, stride) <= bound


@pytest.mark.quick
def test_the_bounds_of_a_stream_function_hold_for_its_curl():
    length = 12.0
    spectrum, (y, _) = stream_power(length), radians()
    bounds = model("gaussian", length, 0.0, is_stream=True).bounds(600, 700)
    assert 0.8 * bounds.max_gradient < 4 * (spectrum * y.square()).sum().sqrt() <= bounds.max_gradient
    for stride in (2, 4, 7):
        bound = bounds.interpolation_error(np.array([float(stride)]))[0]
        assert 0.6 * bound < 7 * interpolation_error(spectrum, stride) <= bound


@pytest.mark.quick
def test_fields_that_pixels_do_not_resolve_have_no_lattice():
    for ranges in [((0.5, 1.0), (50.0, 50.0), (0.0, 5.0), "exponential"), ((0.5, 1.0), (2.0, 50.0))]:
        coarse = RandomFieldErrorModel(*ranges)
        simplified = coarse.simplify(300, 400, 0.02)
        assert simplified is not None
        assert simplified.details is None
        assert not simplified.can_interpolate
        assert np.isinf(coarse.bounds(300, 400).interpolation_error(np.array([2.0, 3.0]))).all()
    assert math.isfinite(
        RandomFieldErrorModel((0.5, 1.0), (50.0, 50.0), covariance="exponential").bounds(9, 9).max_gradient
    )


@pytest.mark.quick
def test_parameters_are_compared_with_all_ranges():
    class Params:
        amplitude, length, aperture = (torch.tensor([value, value]) for value in (0.7, 15.0, 3.0))

    turbulence, stream = model("matern32", 12.0, 2.5), model("gaussian", 12.0, 0.0, is_stream=True)
    assert turbulence.contains(Params)
    assert stream.contains(Params)
    Params.aperture = torch.tensor([3.0, 6.0])
    assert not turbulence.contains(Params)
    Params.length = torch.tensor([11.0, 13.0])
    assert not stream.contains(Params)


@pytest.mark.quick
@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 4])
@pytest.mark.parametrize("k", [0.5, 1.5, 2.2])
def test_aliased_power_is_below_the_margin(k, angle):
    x, y = k * math.cos(angle), k * math.sin(angle)
    waves = [(i, j) for i in range(-80, 81) for j in range(-80, 81) if (i, j) != (0, 0)]
    aliased = sum((k / math.hypot(x + 2 * math.pi * i, y + 2 * math.pi * j)) ** 3 for i, j in waves)
    assert 0.03 * k**3 < aliased <= turbulence_error._ALIASED * k**3
