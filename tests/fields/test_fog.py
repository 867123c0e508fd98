import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchrefract.fields.fog import blend_fog, extinction, transmission, unblend_fog
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear


def srgb_by_the_standard(linear: np.ndarray) -> np.ndarray:
    """Convert linear light by IEC 61966-2-1, one number at a time."""
    return np.array([12.92 * v if v <= 0.0031308 else 1.055 * math.pow(v, 1 / 2.4) - 0.055 for v in linear])


@pytest.mark.quick
def test_the_extinction_is_koschmieders():
    assert extinction(torch.tensor(100.0).double(), 0.05).item() == pytest.approx(0.029957, abs=5e-7)
    # A contrast of 2 % is Koschmieder's 3.912 / V.
    assert extinction(torch.tensor(50.0).double(), 0.02).item() == pytest.approx(3.912 / 50, abs=1e-5)
    assert extinction(torch.tensor(math.inf), 0.05).item() == 0


@pytest.mark.parametrize("visibility", [1e-3, 100.0, 1e6])
@pytest.mark.parametrize("threshold", [0.02, 0.05, 0.5])
def test_the_threshold_arrives_from_the_distance_of_the_visibility(visibility, threshold):
    v = torch.tensor(visibility, dtype=torch.float64)
    assert transmission(v, extinction(v, threshold)).item() == pytest.approx(threshold, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("depth", "k", "t"),
    [(math.inf, 0.03, 0.0), (math.inf, 0.0, 1.0), (0.0, 3e6, 1.0), (1e30, 3e6, 0.0), (5.0, 0.0, 1.0)],
)
def test_the_transmission_is_exact_at_its_ends_and_has_finite_gradients(dtype, depth, k, t):
    d, k = (torch.tensor(value, dtype=dtype).requires_grad_() for value in (depth, k))
    result = transmission(d, k)
    assert result.item() == t
    for gradient in torch.autograd.grad(result, [d, k]):
        assert gradient.isfinite()


@pytest.mark.parametrize("columns", [1, 5])
def test_the_blend_is_exact_at_both_ends(columns):
    image, airlight = torch.rand(2, 3, 4, 5), torch.rand(2, 3, 1, 1)
    assert torch.equal(blend_fog(image, torch.ones(2, 1, 4, columns), airlight), image)
    assert torch.equal(blend_fog(image, torch.ones(2, 1, 4, columns), airlight, linear_light=True), image)
    assert torch.equal(blend_fog(image, torch.zeros(2, 1, 4, columns), airlight), airlight.expand_as(image))
    middle = blend_fog(image, torch.full((2, 1, 4, columns), 0.25), airlight)
    assert_close(middle, 0.25 * image + 0.75 * airlight)


@pytest.mark.parametrize("linear_light", [False, True])
def test_unblending_inverts_the_blend(linear_light):
    image, t, airlight = torch.rand(2, 3, 4, 5).double(), 0.1 + 0.9 * torch.rand(2, 1, 4, 5).double(), torch.rand(3)
    foggy = blend_fog(image, t, airlight.double().view(1, 3, 1, 1), linear_light=linear_light)
    clean = unblend_fog(foggy, t, airlight.double().view(1, 3, 1, 1), linear_light=linear_light)
    # The curves of the standard and their inverses differ by 1e-7 where their pieces meet.
    assert_close(clean, image, rtol=0, atol=2e-6 if linear_light else 1e-12)


def test_the_srgb_curves_are_those_of_the_standard():
    linear = np.concatenate([np.linspace(0, 0.006, 200), np.linspace(0.006, 1, 200)])
    stored = torch.from_numpy(srgb_by_the_standard(linear))
    assert_close(linear_to_srgb(torch.from_numpy(linear)), stored, rtol=0, atol=1e-14)
    assert_close(srgb_to_linear(stored), torch.from_numpy(linear), rtol=0, atol=1e-7)
    assert_close(linear_to_srgb(srgb_to_linear(stored.float())), stored.float(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("convert", [linear_to_srgb, srgb_to_linear])
def test_black_has_a_finite_gradient(convert):
    value = torch.zeros(3).requires_grad_()
    (gradient,) = torch.autograd.grad(convert(value).sum(), value)
    assert_close(gradient, torch.full((3,), 12.92 if convert is linear_to_srgb else 1 / 12.92))


def test_gradients_in_linear_light_match_finite_differences():
    generator = torch.Generator().manual_seed(0)
    image, airlight, depth = (
        torch.rand(shape, generator=generator, dtype=torch.float64).requires_grad_()
        for shape in ((2, 3, 3, 4), (2, 3, 1, 1), (2, 1, 3, 4))
    )
    visibility = torch.tensor([20.0, 90.0], dtype=torch.float64).requires_grad_()

    def foggy(image, airlight, depth, visibility):
        k = extinction(visibility, 0.05).view(-1, 1, 1, 1)
        return blend_fog(image, transmission(100 * depth, k), airlight, linear_light=True)

    assert torch.autograd.gradcheck(foggy, [image, airlight, depth, visibility])
