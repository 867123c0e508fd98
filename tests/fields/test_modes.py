import pytest
import torch
from torch.testing import assert_close

from torchrefract.fields.gaussian import spectrum
from torchrefract.fields.modes import Modes, mode_amplitude


@pytest.mark.parametrize("shortest", [0.0, 2.0])
@pytest.mark.parametrize("aperture", [None, 0.0, 4.0])
@pytest.mark.parametrize(("size", "length"), [((120, 96), 2.0), ((200, 216), 20.0), ((300, 420), 60.0)])
def test_amplitudes_of_low_frequencies_are_those_of_the_torus(size, length, aperture, shortest):
    options = {"aperture": None if aperture is None else torch.tensor([aperture]), "dtype": torch.float64}
    modes, lengths = Modes(size, 6, 9), torch.tensor([length])
    down, across = mode_amplitude(modes, lengths, **options, shortest=shortest)
    of_torus = spectrum(size, lengths, kind="gaussian", **options).amplitude
    found = down[:, 6:, None] * across[:, None, 9:]
    # What is below 1e-6 of the largest is rounding of the torus.
    assert_close(found, of_torus[:, :7, :10], rtol=1e-6, atol=1e-6 * found.max().item())
    assert_close(down, down.flip(1))
    assert found.min() < 0.9 * found.max()


def test_the_slope_of_amplitudes_is_that_of_the_torus():
    modes, slopes = Modes((200, 216), 6, 9), []
    for shortest in (0.0, 2.0):
        numbers = [torch.tensor([value], dtype=torch.float64, requires_grad=True) for value in (20.0, 3.0)]
        down, across = mode_amplitude(modes, numbers[0], aperture=numbers[1], dtype=torch.float64, shortest=shortest)
        slopes.append(torch.cat(torch.autograd.grad((down.sum() * across).square().sum(), numbers)))
    assert_close(*slopes, rtol=1e-6, atol=0)
