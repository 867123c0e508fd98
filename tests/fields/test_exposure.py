"""Metering, gain and noise against the sRGB curve, closed forms and a numeric solver."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from helpers import decode, encode
from scipy.integrate import solve_ivp
from torch.testing import assert_close

from torchrefract.fields.exposure import (
    apply_gain,
    expose_clipped,
    exposure_gain,
    follow_gain,
    metered_mean,
    metered_nodes,
    sensor_noise,
)
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("gain", "levels"),
    [(1 / 32, 0.06), (1 / 8, 0.06), (0.5, 0.06), (0.99999, 1e-3), (1.0, 1e-3), (1.3, 0.06), (2.0, 0.06), (4.0, 0.4)],
)
def test_a_gain_multiplies_linear_light_within_the_stated_levels(gain, levels, dtype):
    image = torch.linspace(0, 1, 12_000, dtype=torch.float64).view(1, 3, 40, 100)
    actual = apply_gain(image.to(dtype), torch.tensor([gain], dtype=dtype))
    expected = torch.from_numpy(encode((gain * decode(image.numpy())).clip(0, 1)))
    assert 255 * (actual.double() - expected).abs().max() < levels
    assert (actual.flatten().diff() >= -1e-7).all()


def test_each_image_of_a_batch_has_its_gain_whatever_the_bands():
    image, gain = torch.rand(3, 3, 300, 400), torch.tensor([0.2, 1.0, 3.0])
    together = apply_gain(image, gain)
    for i in range(3):
        assert_close(apply_gain(image[i : i + 1], gain[i : i + 1]), together[i : i + 1], rtol=0, atol=1e-6)
    with_gradient = apply_gain(image.requires_grad_(), gain)
    assert torch.equal(with_gradient, together)


def test_the_gain_reaches_the_target_within_its_limits():
    mean, target = torch.tensor([0.5, 0.05, 0.0, 1.0]), torch.tensor([0.18, 0.18, 0.18, 0.01])
    one = torch.ones(4)
    gain = exposure_gain(mean, target, one, low=1 / 16, high=4.0)
    assert_close(gain[:2], (target[:2] + 0.001) / (mean[:2] + 0.001))
    assert gain[2:].tolist() == pytest.approx([4.0, 1 / 16])
    assert_close(exposure_gain(mean, target, 0.5 * one, low=1e-3, high=1e3), ((target + 0.001) / (mean + 0.001)).sqrt())
    assert (exposure_gain(mean, target, 0 * one, low=0.1, high=2.0) == 1).all()


def test_the_mean_is_that_of_a_lattice_in_linear_light_below_sixteen_times_white():
    image = torch.rand(2, 3, 400, 250, dtype=torch.float64)
    image[0, 0, 3, 3] = math.nan
    light, stride = metered_nodes(image)
    assert stride == 3
    assert_close(light, torch.from_numpy(decode(image[:, :, ::3, ::3].numpy())).nan_to_num(nan=0.0), rtol=0, atol=1e-7)
    light[1] = 100.0
    assert metered_mean(light).tolist() == pytest.approx([light[0].mean().item(), 16.0])


@pytest.mark.parametrize("tau", [0.7, 5.0, 40.0])
def test_the_gain_follows_the_differential_equation(tau):
    metered = torch.tensor([[1.0, 0.25, 0.25, 2.0, 2.0, 2.0, 0.5, 0.5]], dtype=torch.float64)
    actual = follow_gain(metered, torch.tensor([tau], dtype=torch.float64))[0].log().numpy()
    target = metered[0].log().numpy()

    def slope(time: float, log_gain: np.ndarray) -> np.ndarray:
        # The metered gain of a frame counts from the frame before it on.
        return (target[min(math.floor(time) + 1, 7)] - log_gain) / tau

    expected = solve_ivp(slope, (0, 7), target[:1], t_eval=range(8), max_step=0.01, rtol=1e-8, atol=1e-10).y[0]
    assert np.abs(actual - expected).max() < 0.01 * np.ptp(target)


@pytest.mark.parametrize("tau", [3.0, 10.0, 30.0])
def test_the_time_constant_is_that_of_the_step_response_within_one_percent(tau):
    metered = torch.ones(1, 200, dtype=torch.float64)
    metered[:, 1:] = 0.1
    remaining = 1 - follow_gain(metered, torch.tensor([tau], dtype=torch.float64))[0].log() / math.log(0.1)
    frames = torch.arange(1, 50, dtype=torch.float64)
    fitted = -frames / remaining[1:50].log()
    assert (fitted / tau - 1).abs().max() < 0.01
    assert follow_gain(metered, torch.zeros(1, dtype=torch.float64)).tolist() == pytest.approx(metered)


def test_the_noise_has_the_variance_of_shots_and_readout():
    light = torch.full((1, 1, 400, 500), 0.3, dtype=torch.float64)
    light[:, :, :200] = 0.0
    noise = torch.randn(light.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gain, shot, read = (torch.tensor([value], dtype=torch.float64) for value in (2.0, 1e-3, 1e-4))
    added = sensor_noise(light, gain, shot, read, noise)
    for rows, variance in ((slice(0, 200), 4e-4), (slice(200, 400), 3e-4 + 4e-4)):
        assert added[:, :, rows].var().item() == pytest.approx(variance, rel=0.02)
    assert added.mean().abs() < 1e-3


def test_clipped_light_stays_white_and_other_light_gets_the_gain():
    light = torch.tensor([0.0, 0.4, 0.79, 0.9, 1.0]).view(1, 1, 1, 5).expand(1, 3, 1, 5).clone()
    gain = torch.full((1, 1, 1, 1), 0.25)
    exposed = expose_clipped(light, gain)[0, 0, 0]
    assert_close(exposed[:3], 0.25 * light[0, 0, 0, :3])
    assert 0.25 * 0.9 < exposed[3] < 0.9
    assert exposed[4].item() == pytest.approx(1)
    light[:, 0] = 0.1  # a saturated color is no clipped light
    assert_close(expose_clipped(light, gain), 0.25 * light)


def test_white_that_a_jpeg_blurs_by_a_few_levels_stays_even_under_a_low_gain():
    stored = torch.arange(248.0, 256.0) / 255
    light = srgb_to_linear(stored).view(1, 1, 1, 8).expand(1, 3, 1, 8)
    exposed = linear_to_srgb(expose_clipped(light, torch.full((1, 1, 1, 1), 0.05)))[0, 0, 0]
    assert_close(exposed, stored, rtol=0, atol=2 / 255)


def test_gradients_match_finite_differences():
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(2, 2, 3, 4, generator=generator, dtype=torch.float64)
    gain = torch.tensor([0.4, 1.7], dtype=torch.float64)
    noise = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    metered = torch.rand(2, 5, generator=generator, dtype=torch.float64) + 0.1
    tau, shot, read = (torch.tensor(value, dtype=torch.float64) for value in ([2.0, 7.0], [0.01, 0.1], [0.02, 0.01]))
    for function, inputs in (
        (apply_gain, (image, gain)),
        (follow_gain, (metered, tau)),
        (partial(sensor_noise, noise=noise), (image, gain, shot, read)),
        (lambda x, g: expose_clipped(x, g.view(-1, 1, 1, 1)), (image, gain / 2)),
        (partial(exposure_gain, low=0.01, high=100.0), (gain, metered[:, 0], tau)),
    ):
        assert torch.autograd.gradcheck(function, [value.clone().requires_grad_() for value in inputs])
