from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import DivergenceFree, folding, jacobian_determinant, warp
from torchrefract.fields.random_field import COVARIANCES

GENTLE: dict[str, Any] = {"amplitude_range": (3.0, 3.0), "length_range": (12.0, 20.0)}


def divergence(flow: Tensor) -> Tensor:
    """Return the divergence by central differences, inside the frame."""
    u_x = (flow[:, 0, 1:-1, 2:] - flow[:, 0, 1:-1, :-2]) / 2
    v_y = (flow[:, 1, 2:, 1:-1] - flow[:, 1, :-2, 1:-1]) / 2
    return u_x + v_y


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-4), (torch.float64, 1e-12)])
def test_the_flow_has_no_divergence(dtype, bound):
    effect = DivergenceFree(**GENTLE, tolerance_px=None)
    flow = effect.degrade(torch.zeros(2, 1, 61, 83, dtype=dtype), seed=1).flow
    slope = (flow[:, 0, :, 2:] - flow[:, 0, :, :-2]).square().mean().sqrt() / 2
    assert divergence(flow).abs().max() < bound * slope
    # The curl is as large as the gradients.
    curl = (flow[:, 1, 1:-1, 2:] - flow[:, 1, 1:-1, :-2] - flow[:, 0, 2:, 1:-1] + flow[:, 0, :-2, 1:-1]) / 2
    assert curl.square().mean().sqrt() > slope


@pytest.mark.parametrize("covariance", COVARIANCES)
def test_the_amplitude_is_the_standard_deviation_of_each_component(covariance):
    effect = DivergenceFree(amplitude_range=(2.0, 2.0), length_range=(4.0, 7.0), covariance=covariance)
    flow = effect.degrade(torch.zeros(48, 1, 64, 96), seed=1).flow
    assert_close(flow.square().mean(dim=(0, 2, 3)).sqrt(), torch.full((2,), 2.0), rtol=0.03, atol=0)


def test_the_longest_displacement_is_the_amplitude_if_normalized_by_the_maximum():
    flow = DivergenceFree(**GENTLE, normalize="max").degrade(torch.zeros(3, 1, 61, 83), seed=1).flow
    assert_close(flow.norm(dim=1).amax(dim=(1, 2)), torch.full((3,), 3.0), rtol=1e-5, atol=0)


def test_the_amplitude_multiplies_the_curl_without_normalization():
    image = torch.zeros(48, 1, 160, 160)
    effect = DivergenceFree(amplitude_range=(3.0, 3.0), length_range=(10.0, 10.0), normalize="none")
    flow = effect.degrade(image, seed=1).flow
    assert flow.square().mean().sqrt().item() == pytest.approx(0.3, rel=0.04)  # a Gaussian psi has a slope of 1 / l


def test_steps_preserve_areas_better_and_keep_the_map_one_to_one():
    image = torch.zeros(4, 1, 96, 128, dtype=torch.float64)
    strong: dict[str, Any] = {"amplitude_range": (4.0, 4.0), "length_range": (10.0, 10.0)}
    once, often = (DivergenceFree(**strong, steps=n).degrade(image, seed=1).flow for n in (1, 16))
    inner = (slice(None), slice(None), slice(12, -12), slice(12, -12))
    ratios = [jacobian_determinant(flow)[inner] for flow in (once, often)]
    assert ratios[0].amin() < 0 < ratios[1].amin()
    change = [(ratio.clamp(min=0.05).log().square().mean().sqrt()) for ratio in ratios]
    assert change[1] < 0.5 * change[0]


def test_the_change_of_areas_is_what_the_stream_function_predicts():
    # det - 1 = psi_xx psi_yy - psi_xy^2 without a divergence: of mean 0 and, for a Gaussian psi of standard deviation
    # amplitude times length, of standard deviation sqrt(12) (amplitude / length)^2 by Wick's theorem.
    amplitude, length = 2.0, 20.0
    effect = DivergenceFree(amplitude_range=(amplitude, amplitude), length_range=(length, length))
    flow = effect.degrade(torch.zeros(40, 1, 120, 160, dtype=torch.float64), seed=1).flow
    change = jacobian_determinant(flow) - 1
    expected = 12**0.5 * (amplitude / length) ** 2
    assert change.std().item() == pytest.approx(expected, rel=0.1)
    # The determinant is the smallest of four corners, so its mean lies a little below 1.
    assert -0.5 * expected < change.mean().item() < 0


def test_an_amplitude_that_folds_is_measured_and_folded_pixels_are_not_valid():
    image = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    calm, wild = (
        DivergenceFree(amplitude_range=(a, a), length_range=(12.0, 12.0)).degrade(image, seed=1) for a in (1.0, 8.0)
    )
    assert not folding(calm.flow).fraction.any()
    assert (folding(calm.flow).min_determinant > 0).all()
    assert (folding(wild.flow).fraction > 0.1).all()
    assert (folding(wild.flow).min_determinant < -1).all()
    assert wild.image.isfinite().all()
    assert wild.restore_flow.isfinite().all()
    assert wild.restore_valid.double().mean() < 0.5 < calm.restore_valid.double().mean()
    assert wild.restore_residual[wild.restore_valid].max() < 0.05
    # Valid coordinates come back, up to bilinear interpolation.
    ramp = torch.arange(96.0).expand(2, 1, 64, 96)
    degraded, _ = warp(ramp, wild.flow)
    restored, _ = warp(degraded, wild.restore_flow)
    assert (restored - ramp)[wild.restore_valid].abs().max() < 0.05
