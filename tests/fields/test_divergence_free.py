import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random, warp
from torchrefract.fields.covariance import COVARIANCES
from torchrefract.fields.gaussian import gaussian_random_field, spectrum
from torchrefract.fields.stream import curl, curl_rms
from torchrefract.fields.torus import torus

PRECISION = [(torch.float64, 1e-12), (torch.float32, 1e-4)]


def random_field(kind: str, length: float, *, samples: int, height: int, width: int) -> Tensor:
    """(2 samples, 1, H, W), fp64: fields of variance 1."""
    size = torus(height, width, length=length, kind=kind)
    lengths = torch.full((samples,), length, dtype=torch.float64)
    shape = spectrum(size, lengths, kind=kind, dtype=torch.float64).amplitude
    key = random.noise_key(random.stream(11, torch.arange(samples)))
    noise = random.white_noise(key, size[0] * size[1]).view(-1, 2, *size).double()
    return gaussian_random_field(noise, shape, height=height, width=width).flatten(0, 1)[:, None]


def around(height: int, width: int) -> tuple[Tensor, Tensor]:
    """x and y, (H + 2, W + 2), of a frame and the pixels around it."""
    y, x = torch.meshgrid(torch.arange(-1, height + 1), torch.arange(-1, width + 1), indexing="ij")
    return x.double(), y.double()


@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
@pytest.mark.parametrize("size", [(30, 47), (1, 9), (9, 1), (1, 1)])
def test_the_curl_of_products_of_sines_is_that_of_the_central_difference(size, dtype, atol, oracle):
    x, y = around(*size)
    a, b, amplitude = 0.31, 0.17, 5.0
    psi = (amplitude * torch.sin(a * x + 0.4) * torch.cos(b * y - 0.7))[None, None]
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1]
    # A central difference takes exp(i b y) to i sin(b) exp(i b y).
    u = -amplitude * math.sin(b) * torch.sin(a * x + 0.4) * torch.sin(b * y - 0.7)
    v = -amplitude * math.sin(a) * torch.cos(a * x + 0.4) * torch.cos(b * y - 0.7)
    flow = curl(psi.to(dtype))
    assert flow.dtype == dtype
    kind = str(dtype).replace("torch.float", "fp")
    oracle(f"curl, analytic psi, {kind}", flow, torch.stack([u, v])[None], atol)


@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
def test_the_curl_of_a_quadratic_is_exact_and_turns_as_the_axes_say(dtype, atol):
    x, y = around(20, 30)
    psi = (0.5 * x * x + 0.25 * x * y - 0.125 * y * y + 3)[None, None].to(dtype)
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1]
    expected = torch.stack([0.25 * x - 0.25 * y, -x - 0.25 * y])[None]
    assert_close(curl(psi).double(), expected, rtol=0, atol=atol)


@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_divergence_of_the_matched_stencil_vanishes(kind, dtype, atol, oracle):
    psi = random_field(kind, 4.0, samples=2, height=37, width=53).to(dtype)
    u, v = (10 * curl(psi)).split(1, dim=1)
    # As `curl` itself differences: twice of it is (u, v) = (D_y, -D_x).
    divergence = -curl(u)[:, 1] + curl(v)[:, 0]
    slopes = curl(u)[:, 1].abs().max()
    assert slopes > 0.1
    what = f"divergence by the matched stencil, {dtype}".replace("torch.float", "fp")
    oracle(what, divergence / slopes, torch.zeros_like(divergence), atol, unit="")
    by_hand = (u[..., 1:-1, 2:] - u[..., 1:-1, :-2] + v[..., 2:, 1:-1] - v[..., :-2, 1:-1]) / 2
    assert by_hand.abs().max() <= atol * slopes


def test_the_divergence_of_another_stencil_does_not_vanish():
    psi = random_field("exponential", 4.0, samples=1, height=37, width=53)
    u, v = curl(psi).unbind(1)
    divergence = (u[:, :-1, 1:] - u[:, :-1, :-1]) + (v[:, 1:, :-1] - v[:, :-1, :-1])
    assert divergence.abs().max() > 0.1 * (u[:, :, 1:] - u[:, :, :-1]).abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("value", [0.0, 1.0, -3.7, 1e6])
def test_a_constant_moves_nothing_at_all(value, dtype):
    flow = curl(torch.full((2, 1, 9, 14), value, dtype=dtype))
    assert flow.shape == (2, 2, 7, 12)
    assert not flow.any()
    image = torch.rand(2, 3, 7, 12, generator=torch.Generator().manual_seed(0), dtype=dtype)
    assert_close(warp(image, flow)[0], image, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", COVARIANCES)
@pytest.mark.parametrize("length", [1.0, 5.0, 12.0])
def test_the_rms_of_the_flow_is_the_theoretical_one(kind, length):
    flow = curl(random_field(kind, length, samples=24, height=202, width=212))
    expected = curl_rms(torch.tensor([length], dtype=torch.float64), kind)
    assert len(flow) >= 40
    found = flow.square().mean(dim=(0, 2, 3)).sqrt()
    assert_close(found, expected.expand(2), rtol=0.03, atol=0)


@pytest.mark.parametrize("length", [20.0, 1e3])
def test_the_theoretical_rms_tends_to_the_derivatives_own(length):
    lengths = torch.tensor([length], dtype=torch.float64)
    slopes = {"gaussian": 1.0, "matern52": math.sqrt(5 / 3), "matern32": math.sqrt(3)}
    for kind, slope in slopes.items():
        # Var psi' = -C''(0); the next term of a Matern 3/2 is of the third power of the distance.
        assert_close(length * curl_rms(lengths, kind), lengths.new_tensor([slope]), rtol=2.5 / length, atol=0)
    # (1 - exp(-2 / l)) / 2 -> 1 / l: not a derivative, which this one has none of.
    assert_close(curl_rms(lengths, "exponential"), lengths.rsqrt(), rtol=1 / length, atol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_rms_of_each_sample_is_its_own(dtype):
    lengths = torch.tensor([0.1, 3.0, 40.0], dtype=dtype)
    for kind in COVARIANCES:
        together = curl_rms(lengths, kind)
        assert together.dtype == dtype
        assert torch.equal(together, torch.cat([curl_rms(lengths[i : i + 1], kind) for i in range(3)]))
        assert together[0] == pytest.approx(math.sqrt(0.5), rel=1e-6)  # white noise


@pytest.mark.parametrize("field", [curl, lambda psi: curl(psi.square())])
def test_gradients_are_those_of_finite_differences(field: Callable[[Tensor], Tensor]):
    psi = torch.randn(2, 1, 5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(field, [psi.requires_grad_()])


@pytest.mark.parametrize("kind", COVARIANCES)
def test_gradients_of_the_rms_are_those_of_finite_differences(kind):
    lengths = torch.tensor([0.7, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: curl_rms(t, kind), [lengths])
