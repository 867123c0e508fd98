import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.functional.image.psnr import peak_signal_noise_ratio

from torchrefract import LensFlare, UniformFog, remove_fog
from torchrefract._tensor import to_float, to_uint8
from torchrefract.data.module import make_pair
from torchrefract.restoration.metrics import (
    coverage,
    endpoint_error,
    masked_mean,
    psnr,
    restore_by_transmission,
    ssim,
    through_fog,
)
from torchrefract.types import Frame

SIZE = (24, 31)
ROWS = (24, 12, 1)  # valid rows of each image


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    clean = torch.rand(3, 3, *SIZE, generator=generator)
    return (clean + 0.2 * torch.randn(clean.shape, generator=generator)).clamp(0, 1), clean


@pytest.fixture
def everywhere() -> Tensor:
    return torch.ones(3, 1, *SIZE, dtype=torch.bool)


@pytest.fixture
def left() -> Tensor:
    """Mark the left 20 columns of the first `ROWS` rows as valid."""
    valid = torch.zeros(3, 1, *SIZE, dtype=torch.bool)
    for sample, rows in enumerate(ROWS):
        valid[sample, :, :rows, :20] = True
    return valid


@pytest.mark.quick
def test_a_masked_mean_is_the_mean_over_valid_pixels_and_0_without_any(pair, left, everywhere):
    expected = [pair[0][i, :, :rows, :20].mean() for i, rows in enumerate(ROWS)]
    assert_close(masked_mean(pair[0], left), torch.stack(expected))
    assert masked_mean(pair[0], ~everywhere).tolist() == [0, 0, 0]


@pytest.mark.quick
def test_a_score_of_an_image_without_a_valid_pixel_is_nan(pair, left):
    restored, clean = pair
    left[1] = False
    flows = torch.zeros(2, 3, 2, *SIZE)
    for score in (
        psnr(restored, clean, left),
        ssim(restored, clean, left),
        endpoint_error(flows[0], flows[1], left, size=SIZE),
        coverage(flows[0], flows[0], flows[1], left),
    ):
        assert score.isnan().tolist() == [False, True, False]


def test_psnr_agrees_with_torchmetrics_on_the_valid_pixels_of_each_image(pair, left):
    restored, clean = pair
    expected = [
        peak_signal_noise_ratio(restored[i, :, :rows, :20], clean[i, :, :rows, :20], data_range=1.0)
        for i, rows in enumerate(ROWS)
    ]
    assert_close(psnr(restored, clean, left), torch.stack(expected))


@pytest.mark.quick
def test_psnr_clamps_the_image_and_ends_at_100_decibels(everywhere):
    white = torch.ones(3, 3, *SIZE)
    assert_close(psnr(3 * white, white, everywhere), torch.full((3,), 100.0))


def test_ssim_agrees_with_torchmetrics_on_each_image(pair, everywhere):
    restored, clean = pair
    expected = structural_similarity_index_measure(restored, clean, sigma=1.5, data_range=1.0, reduction="none")
    assert isinstance(expected, Tensor)
    assert_close(ssim(restored, clean, everywhere), expected, rtol=0, atol=1e-5)


def test_ssim_of_two_gray_images_follows_from_their_means(everywhere):
    low, high, c1 = 0.3, 0.5, 0.01**2
    gray = torch.ones(3, 3, *SIZE)
    expected = (2 * low * high + c1) / (low**2 + high**2 + c1)
    assert_close(ssim(low * gray, high * gray, everywhere), torch.full((3,), expected), rtol=0, atol=1e-4)
    assert_close(ssim(gray, gray, everywhere), torch.ones(3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_invalid_pixels_have_no_influence(pair, left, metric):
    restored, clean = pair
    garbage = torch.where(left, restored, 1 - clean)
    assert_close(metric(garbage, clean, left), metric(restored, clean, left), rtol=0, atol=1e-6)


@pytest.mark.quick
def test_an_endpoint_error_is_a_length_in_px_of_the_given_size():
    flow = torch.zeros(2, 2, 36, 64)
    target = torch.zeros(2, 2, 36, 64)
    target[0, 0] = 3.0  # px of 64: 3 * 1920 / 64 = 90 px of 1920
    target[0, 1] = -4.0  # px of 36: -4 * 1080 / 36 = -120 px of 1080
    valid = torch.ones(2, 1, 36, 64, dtype=torch.bool)
    assert endpoint_error(flow, target, valid, size=(1080, 1920)).tolist() == [150.0, 0.0]
    assert endpoint_error(flow, target, valid, size=(36, 64)).tolist() == [5.0, 0.0]
    assert_close(endpoint_error(flow, target, valid, size=(72, 64))[0], torch.tensor(math.hypot(3, 8)))


def test_invalid_flows_have_no_influence(left):
    generator = torch.Generator().manual_seed(0)
    flow, target = torch.randn(2, 3, 2, *SIZE, generator=generator)
    error = endpoint_error(torch.where(left, flow, 1e4), target, left, size=SIZE)
    expected = [(flow - target)[i, :, :rows, :20].norm(dim=0).mean() for i, rows in enumerate(ROWS)]
    assert_close(error, torch.stack(expected))


@pytest.mark.quick
def test_the_true_fog_restores_as_remove_fog_does_in_float64_and_leaves_a_flare(pair):
    frame = Frame(pair[1].double(), torch.arange(3), torch.empty(0))
    fog = UniformFog(visibility_range=(40.0, 40.0), airlight=0.8)
    foggy = make_pair(frame, fog, seed=1, transmission=True)
    rounded = to_float(to_uint8(foggy.degraded)).double()
    expected, valid = remove_fog(rounded, foggy.transmission, 0.8)
    assert_close(restore_by_transmission(foggy), expected, rtol=0, atol=1e-9)
    assert torch.equal(through_fog(foggy), valid)
    assert 0.2 < valid.double().mean() < 1
    # A level of rounding grows by 1 / t, and nothing else is wrong.
    error = (restore_by_transmission(foggy) - frame.image).abs() * foggy.transmission
    assert error[valid.expand_as(error)].max() <= 0.5 / 255 + 1e-7
    flare = make_pair(frame, LensFlare(), seed=1)._replace(transmission=torch.ones_like(frame.image[:, :1]))
    assert torch.equal(restore_by_transmission(flare), to_float(to_uint8(flare.degraded)).double())


def test_two_standard_deviations_of_a_normal_flow_cover_95_percent_of_its_valid_values():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 2, 80, 90, generator=generator)
    deviation = torch.rand(2, 2, 80, 90, generator=generator)
    flow = torch.full_like(noise, 3.0)
    valid = torch.ones(2, 1, 80, 90, dtype=torch.bool)
    valid[:, :, :40] = False
    noise[:, :, :40] = 9.0  # where it is not valid
    expected = math.erf(2 / math.sqrt(2))
    assert coverage(flow, deviation, flow + deviation * noise, valid).tolist() == pytest.approx(
        [expected] * 2, abs=0.01
    )
    assert coverage(flow, 0 * deviation, flow + deviation * noise, valid).tolist() == [0, 0]
