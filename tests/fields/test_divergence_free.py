import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields.divergence_free import curl, curl_rms, divergence_free_flow
from torchrefract.fields.random_field import COVARIANCES, FieldParams, Frequencies, embedding_size, sample_field
from torchrefract.warping.lattice import Lattice, pixel_lattice

PRECISION = [(torch.float64, 1e-12), (torch.float32, 1e-4)]


def stream_functions(kind: str, length: float, *, samples: int, height: int, width: int) -> Tensor:
    """Return (2 samples, 1, H, W), float64: fields of variance 1."""
    frequencies = Frequencies.all(embedding_size(height, width, length=length, kind=kind))
    key = random.noise_key(random.stream(11, range(samples)))
    params = FieldParams(torch.full((samples,), length, dtype=torch.float64), None, key)
    psi, _ = sample_field(params, frequencies, range(height), range(width), kind=kind, dtype=torch.float64)
    return psi.flatten(0, 1)[:, None]


def frame_and_border(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return x and y, (H + 2, W + 2), of a frame and the pixels around it."""
    y, x = torch.meshgrid(torch.arange(-1, height + 1), torch.arange(-1, width + 1), indexing="ij")
    return x.double(), y.double()


@pytest.mark.quick
@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
@pytest.mark.parametrize("size", [(30, 47), (1, 9), (1, 1)])
def test_the_curl_of_products_of_sines_is_that_of_the_central_difference(size, dtype, atol, oracle):
    x, y = frame_and_border(*size)
    a, b, amplitude = 0.31, 0.17, 5.0
    psi = (amplitude * torch.sin(a * x + 0.4) * torch.cos(b * y - 0.7))[None, None]
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1]
    # A central difference turns exp(i b y) into i sin(b) exp(i b y).
    u = -amplitude * math.sin(b) * torch.sin(a * x + 0.4) * torch.sin(b * y - 0.7)
    v = -amplitude * math.sin(a) * torch.cos(a * x + 0.4) * torch.cos(b * y - 0.7)
    flow = curl(psi.to(dtype))
    assert flow.dtype == dtype
    kind = str(dtype).replace("torch.float", "fp")
    oracle(f"curl, analytic psi, {kind}", flow, torch.stack([u, v])[None], atol)


@pytest.mark.quick
@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
def test_the_curl_of_a_quadratic_is_exact_and_that_of_a_constant_zero(dtype, atol):
    x, y = frame_and_border(20, 30)
    psi = (0.5 * x * x + 0.25 * x * y - 0.125 * y * y + 3)[None, None].to(dtype)
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1]
    expected = torch.stack([0.25 * x - 0.25 * y, -x - 0.25 * y])[None]
    assert_close(curl(psi).double(), expected, rtol=0, atol=atol)
    assert not curl(torch.full((2, 1, 9, 14), -3.7, dtype=dtype)).any()


@pytest.mark.quick
@pytest.mark.parametrize(("dtype", "atol"), PRECISION)
@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_divergence_of_the_matched_stencil_vanishes(kind, dtype, atol, oracle):
    psi = stream_functions(kind, 4.0, samples=2, height=37, width=53).to(dtype)
    u, v = (10 * curl(psi)).unbind(1)
    divergence = (u[:, 1:-1, 2:] - u[:, 1:-1, :-2] + v[:, 2:, 1:-1] - v[:, :-2, 1:-1]) / 2
    largest = (u[:, :, 2:] - u[:, :, :-2]).abs().max() / 2
    assert largest > 0.1
    what = f"divergence by the matched stencil, {dtype}".replace("torch.float", "fp")
    oracle(what, divergence / largest, torch.zeros_like(divergence), atol, unit="")
    # Of one-sided differences it does not vanish.
    other = (u[:, :-1, 1:] - u[:, :-1, :-1]) + (v[:, 1:, :-1] - v[:, :-1, :-1])
    assert other.abs().max() > 0.1 * largest


@pytest.mark.parametrize(("kind", "length"), [*zip(COVARIANCES, (1.0, 12.0) * 2, strict=True)])
def test_the_rms_of_the_flow_is_the_theoretical_one(kind, length):
    flow = curl(stream_functions(kind, length, samples=24, height=202, width=212))
    expected = curl_rms(torch.tensor([length], dtype=torch.float64), kind)
    assert_close(flow.square().mean(dim=(0, 2, 3)).sqrt(), expected.expand(2), rtol=0.03, atol=0)


@pytest.mark.quick
@pytest.mark.parametrize("stride", [2, 3, 6])
def test_flows_of_low_frequencies_at_nodes_are_those_at_the_pixels(stride):
    size = embedding_size(62, 82, length=9.0, kind="gaussian")
    params = FieldParams(torch.tensor([8.0, 9.0]).double(), None, random.noise_key(random.stream(2, range(2))))
    options = {"covariance": "gaussian", "frequencies": Frequencies(size, size[0] // 4, size[1] // 4)}
    amplitude = torch.tensor([3.0, 5.0]).double()
    dense, _ = divergence_free_flow(params, amplitude, lattice=pixel_lattice(60, 80), **options)
    lattice = Lattice(60, 80, stride, margin=2)
    nodes, _ = divergence_free_flow(params, amplitude, lattice=lattice, **options)
    inside = nodes[:, :, 2 : 2 + len(range(0, 60, stride)), 2 : 2 + len(range(0, 80, stride))]
    assert_close(inside, dense[:, :, ::stride, ::stride], rtol=0, atol=1e-10)


@pytest.mark.quick
@pytest.mark.parametrize("kind", COVARIANCES)
def test_gradients_of_the_rms_match_finite_differences(kind):
    lengths = torch.tensor([0.7, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: curl_rms(t, kind), [lengths])
