import pytest
import torch
from torch.testing import assert_close

from torchrefract.fields import modes as few
from torchrefract.fields.gaussian import spectrum
from torchrefract.fields.modes import Modes, mode_amplitude, mode_field, mode_noise
from torchrefract.random import noise_key, stream


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


@pytest.mark.parametrize("aperture", [None, 4.0])
@pytest.mark.parametrize("fields", [1, 2])
def test_fields_by_a_kernel_are_those_of_the_sum(aperture, fields, monkeypatch):
    modes, lengths, places = Modes((200, 216), 33, 40), torch.tensor([20.0, 25.0]), (range(0, 90, 4), range(3, 90, 5))
    noise = mode_noise(noise_key(stream(3, range(2))), modes, dtype=torch.float32)
    apertures = None if aperture is None else torch.tensor([aperture, 0.0])

    def found(dtype: torch.dtype) -> torch.Tensor:
        amplitude = mode_amplitude(modes, lengths, aperture=apertures, dtype=dtype, shortest=20.0)
        return mode_field(noise.to(dtype), amplitude, modes, *places, fields=fields)

    by_kernel = found(torch.float32)
    assert by_kernel.shape == (2, fields, 23, 18)
    assert_close(by_kernel.double(), found(torch.float64), rtol=0, atol=2e-6)
    monkeypatch.setattr(few, "kernels", asked := list[str]())  # calling it would raise
    monkeypatch.setattr(few, "obstacle", lambda *_: "for the test")
    assert_close(by_kernel, found(torch.float32), rtol=0, atol=2e-6)
    assert not asked
    # The sum by its definition, of the first sample at one place.
    amplitude = mode_amplitude(modes, lengths, aperture=apertures, dtype=torch.float64, shortest=20.0)
    phase = [
        2 * torch.pi * torch.arange(-n, n + 1).double() * at / size
        for n, at, size in zip((33, 40), (8, 13), modes.size, strict=True)
    ]
    angle = phase[0][:, None] + phase[1]
    weighted = torch.complex(*noise[0].double()) * amplitude[0][0, :, None] * amplitude[1][0]
    total = (weighted * torch.polar(torch.ones_like(angle), -angle)).sum()
    assert_close(by_kernel[0, 0, 2, 2].double(), total.real, rtol=0, atol=2e-6)
    if fields == 2:
        assert_close(by_kernel[0, 1, 2, 2].double(), total.imag, rtol=0, atol=2e-6)
