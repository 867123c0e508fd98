"""Exposure against a reference in NumPy, its noise, and its memory in clips."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import decode, encode
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, Exposure, UniformFog

SIZE = (24, 32)


def picture(*shape: int, brightness: float = 1.0, seed: int = 0) -> Tensor:
    return brightness * torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def fixed(**options: Any) -> Exposure:
    """Return an exposure with the target 0.18 and the strength 0.9."""
    fixed_options: dict[str, Any] = {"target_range": (0.18, 0.18), "gamma_range": (0.9, 0.9)}
    return Exposure(**(fixed_options | options))


@pytest.mark.quick
@pytest.mark.parametrize("brightness", [0.3, 0.6, 1.0])
def test_the_image_is_the_exposed_one_of_a_camera(brightness):
    image = picture(2, 3, *SIZE, brightness=brightness)
    degraded = fixed().degrade(image, seed=1)
    light = decode(image.numpy())
    gain = np.minimum((0.181 / (light.mean(axis=(1, 2, 3), keepdims=True) + 0.001)) ** 0.9, 4.0)
    assert np.abs(degraded.image.numpy() - encode(np.clip(gain * light, 0, 1))).max() < 0.4 / 255
    assert torch.equal(degraded.valid, torch.from_numpy((gain * light <= 1).all(axis=1, keepdims=True)))
    assert degraded.flow is None


def test_a_bright_frame_gets_darker_and_a_dark_one_brighter_up_to_the_limits():
    for brightness, sign in ((1.0, -1), (0.3, 1)):
        image = picture(1, 3, *SIZE, brightness=brightness)
        change = fixed().degrade(image, seed=1).image - image
        assert (sign * change[image > 0.02] > 0).all()
    dark = picture(1, 3, *SIZE, brightness=0.02)
    assert_close(fixed(max_gain=1.0).degrade(dark, seed=1).image, dark, rtol=0, atol=1e-5)
    white = torch.ones(1, 3, *SIZE, dtype=torch.float64)
    limited = fixed(min_gain=0.5).degrade(white, seed=1).image
    assert limited.mean().item() == pytest.approx(float(encode(np.array(0.5))), abs=1e-3)


def test_fog_is_exposed_for():
    image = 0.5 * picture(1, 3, *SIZE)
    foggy = UniformFog(visibility_range=(20, 20))
    effect = Compose([foggy, fixed(gamma_range=(1.0, 1.0))])
    exposed = decode(effect.degrade(image, seed=1).image.numpy()).mean()
    assert exposed == pytest.approx(0.18, abs=0.01)
    assert decode(foggy.degrade(image, seed=1).image.numpy()).mean() > 0.4


def test_noise_has_the_stated_variance_and_differs_by_key_channel_and_frame():
    gray = torch.full((2, 3, 3, 90, 80), 0.5)
    shot, read = 2e-3, 1e-3
    effect = Exposure(gamma_range=(0, 0), shot_range=(shot, shot), read_range=(read, read))
    noisy = effect.degrade(gray, seed=3, keys=[5, 9]).image
    light = torch.from_numpy(decode(noisy.double().numpy()))
    mean = float(decode(np.array(0.5)))
    assert light.var().item() == pytest.approx(shot * mean + read, rel=0.02)
    assert light.mean().item() == pytest.approx(mean, abs=1e-3)
    planes = (light - mean).reshape(18, -1)
    correlation = torch.corrcoef(planes) - torch.eye(18)
    assert correlation.abs().max() < 5 / math.sqrt(planes.shape[1])
    neighbors = torch.corrcoef(torch.stack([light[..., 1:].flatten(), light[..., :-1].flatten()]))[0, 1]
    assert abs(neighbors) < 5 / math.sqrt(light.numel())
    again = effect.degrade(gray[1:, 2], seed=3, keys=[9], frame=2).image
    assert torch.equal(again, noisy[1:, 2])


def test_a_clip_adapts_with_its_time_constant():
    clip = torch.full((1, 40, 3, *SIZE), 0.2, dtype=torch.float64)
    clip[:, 1:] = 0.8  # out of a tunnel
    effect = fixed(gamma_range=(1, 1), time_constant_range=(6, 6), min_gain=1 / 32)
    image = effect.degrade(clip, seed=1).image
    gain = decode(image.numpy()) / decode(clip.numpy())
    log_gain = np.log(gain[0, :, 0, 0, 0])
    dark, bright = (math.log(0.181 / (float(decode(np.array(v))) + 0.001)) for v in (0.2, 0.8))
    expected = bright + (min(dark, math.log(4)) - bright) * np.exp(-np.arange(40) / 6)
    # Saturated frames, just out of the tunnel, do not show their gain.
    visible = np.exp(expected) * float(decode(np.array(0.8))) < 0.95
    visible[0] = False
    assert visible.sum() > 20
    remaining = (log_gain - bright)[visible] / (min(dark, math.log(4)) - bright)
    fitted = -np.arange(40)[visible][:15] / np.log(remaining[:15])
    assert np.abs(fitted / 6 - 1).max() < 0.01
    instant = fixed(gamma_range=(1, 1)).degrade(clip, seed=1).image
    assert_close(instant[:, 1:], instant[:, 1:2].expand(-1, 39, -1, -1, -1))


def test_invalid_pixels_count_as_black_and_spread_no_further_than_the_meter():
    clean = 0.25 + picture(2, 3, *SIZE) / 2
    for value in (math.nan, math.inf, -math.inf):
        image = clean.clone()
        image[0, 1, 5, 7] = value
        black = clean.clone()
        black[0, 1, 5, 7] = 0.0
        effect = fixed(shot_range=(1e-3, 1e-3))
        params = effect.sample(image, seed=1)
        gamma = params.gamma.clone().requires_grad_()
        degraded = effect.apply(image.requires_grad_(), params._replace(gamma=gamma))
        assert torch.equal(degraded.image, effect.apply(black, params).image)
        assert not degraded.valid[0, 0, 5, 7]
        gradients = torch.autograd.grad(degraded.image.sum(), [image, gamma])
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_a_quantized_image_has_levels_and_the_gradient_of_the_unrounded_one():
    image = picture(1, 3, *SIZE).requires_grad_()
    quantized, exact = (fixed(quantize=value).degrade(image, seed=1).image for value in (True, False))
    assert_close(255 * quantized, (255 * exact).round(), rtol=0, atol=1e-9)
    gradients = [torch.autograd.grad(result.sum(), image)[0] for result in (quantized, exact)]
    assert torch.equal(*gradients)
