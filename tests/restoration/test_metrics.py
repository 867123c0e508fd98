import math

import pytest
import torch
from torch.testing import assert_close
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.functional.image.psnr import peak_signal_noise_ratio

from torchrefract.restoration.metrics import endpoint_error, masked_mean, psnr, ssim

SIZE = (24, 31)


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    clean = torch.rand(3, 3, *SIZE, generator=generator)
    restored = (clean + 0.2 * torch.randn(clean.shape, generator=generator)).clamp(0, 1)
    return restored, clean


@pytest.fixture
def everywhere():
    return torch.ones(3, 1, *SIZE, dtype=torch.bool)


@pytest.fixture
def left():
    """The left 20 columns are valid, of another height in each image."""
    valid = torch.zeros(3, 1, *SIZE, dtype=torch.bool)
    for sample, rows in enumerate((24, 12, 1)):
        valid[sample, :, :rows, :20] = True
    return valid


def test_a_masked_mean_is_the_mean_of_the_valid_values(pair, left):
    value = pair[0]
    expected = [value[i, :, :rows, :20].mean() for i, rows in enumerate((24, 12, 1))]
    assert_close(masked_mean(value, left), torch.stack(expected))


def test_a_masked_mean_without_a_valid_pixel_is_zero(pair, everywhere):
    assert masked_mean(pair[0], ~everywhere).tolist() == [0, 0, 0]


def test_psnr_is_that_of_torchmetrics_on_each_image(pair, everywhere):
    restored, clean = pair
    expected = [peak_signal_noise_ratio(a, b, data_range=1.0) for a, b in zip(restored, clean, strict=True)]
    assert_close(psnr(restored, clean, everywhere), torch.stack(expected))


@pytest.mark.parametrize("offset", [0.1, 0.01])
def test_psnr_of_an_offset_is_its_size_in_decibels(everywhere, offset):
    clean = torch.full((3, 3, *SIZE), 0.5)
    expected = torch.full((3,), -20 * math.log10(offset))
    assert_close(psnr(clean + offset, clean, everywhere), expected, rtol=0, atol=1e-3)


def test_psnr_of_an_equal_image_is_capped_at_100_decibels(pair, everywhere):
    assert_close(psnr(pair[1], pair[1], everywhere), torch.full((3,), 100.0))


def test_psnr_counts_what_a_screen_shows_and_not_what_lies_beyond_white(everywhere):
    white = torch.ones(3, 3, *SIZE)
    assert_close(psnr(3 * white, white, everywhere), torch.full((3,), 100.0))


def test_psnr_counts_the_valid_pixels_alone(pair, left):
    restored, clean = pair
    expected = [
        peak_signal_noise_ratio(restored[i, :, :rows, :20], clean[i, :, :rows, :20], data_range=1.0)
        for i, rows in enumerate((24, 12, 1))
    ]
    assert_close(psnr(restored, clean, left), torch.stack(expected))


def test_ssim_is_that_of_torchmetrics_on_each_image(pair, everywhere):
    restored, clean = pair
    expected = structural_similarity_index_measure(restored, clean, sigma=1.5, data_range=1.0, reduction="none")
    assert isinstance(expected, torch.Tensor)
    assert_close(ssim(restored, clean, everywhere), expected, rtol=0, atol=1e-5)


def test_ssim_of_two_gray_images_is_the_closed_form_of_their_means(everywhere):
    low, high, c1 = 0.3, 0.5, 0.01**2
    gray = torch.ones(3, 3, *SIZE)
    expected = (2 * low * high + c1) / (low**2 + high**2 + c1)
    assert_close(ssim(low * gray, high * gray, everywhere), torch.full((3,), expected), rtol=0, atol=1e-4)


def test_ssim_of_an_equal_image_is_one(pair, everywhere):
    assert_close(ssim(pair[1], pair[1], everywhere), torch.ones(3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_garbage_in_an_invalid_pixel_changes_no_score(pair, left, metric):
    restored, clean = pair
    garbage = torch.where(left, restored, 1 - clean)
    assert_close(metric(garbage, clean, left), metric(restored, clean, left), rtol=0, atol=1e-6)


def test_an_endpoint_error_is_the_length_in_pixels_of_the_stated_size():
    flow = torch.zeros(2, 2, 36, 64)
    target = torch.zeros(2, 2, 36, 64)
    target[0, 0] = 3.0  # px of 64: 3 * 1920 / 64 = 90 px of 1920
    target[0, 1] = -4.0  # px of 36: -4 * 1080 / 36 = -120 px of 1080
    valid = torch.ones(2, 1, 36, 64, dtype=torch.bool)
    assert endpoint_error(flow, target, valid, size=(1080, 1920)).tolist() == [150.0, 0.0]
    assert endpoint_error(flow, target, valid, size=(36, 64)).tolist() == [5.0, 0.0]


def test_each_axis_of_an_endpoint_error_has_its_own_scale():
    flow, target = torch.zeros(1, 2, 10, 10), torch.ones(1, 2, 10, 10)
    valid = torch.ones(1, 1, 10, 10, dtype=torch.bool)
    found = endpoint_error(flow, target, valid, size=(40, 30))
    assert_close(found, torch.tensor([math.hypot(3, 4)]))


def test_garbage_in_an_invalid_pixel_changes_no_endpoint_error(left):
    generator = torch.Generator().manual_seed(0)
    flow, target = torch.randn(2, 3, 2, *SIZE, generator=generator)
    garbage = torch.where(left, flow, 1e4)
    found = endpoint_error(garbage, target, left, size=SIZE)
    expected = [(flow - target)[i, :, :rows, :20].norm(dim=0).mean() for i, rows in enumerate((24, 12, 1))]
    assert_close(found, torch.stack(expected))
