import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import LensDistortion, Pair, UniformFog
from torchrefract.restoration.tasks import Deweather, Restored, Undistort

SIZE = (48, 80)


def smooth_images(batch: int) -> Tensor:
    """Return images of long waves, which bilinear sampling reproduces to 1/100."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    channels = [0.5 + 0.4 * torch.sin(a * x + b * y) for a, b in ((5, 2), (-3, 4), (2, -6))]
    return torch.stack(channels).expand(batch, -1, -1, -1).contiguous()


@pytest.fixture(scope="module")
def distorted() -> Pair:
    clean = smooth_images(3)
    degraded = LensDistortion().degrade(clean, seed=1)
    return Pair(degraded.image, clean, degraded.restore_flow, degraded.restore_valid, torch.arange(3))


@pytest.fixture(scope="module")
def foggy() -> Pair:
    clean = smooth_images(3)
    degraded = UniformFog().degrade(clean, seed=1)
    valid = torch.ones(3, 1, *SIZE, dtype=torch.bool)
    return Pair(degraded.image, clean, torch.zeros(3, 2, *SIZE), valid, torch.arange(3), degraded.transmission)


def mean_per_image(value: Tensor, valid: Tensor) -> Tensor:
    return torch.stack([image[mask.expand_as(image)].mean() for image, mask in zip(value, valid, strict=True)])


@pytest.mark.quick
def test_the_loss_of_an_undistortion_is_image_plus_flow_in_half_frames_over_valid_pixels(distorted):
    valid = distorted.valid.clone()
    valid[:, :, :, :30] = False
    pair = distorted._replace(valid=valid)
    flow = pair.flow + torch.randn(pair.flow.shape, generator=torch.Generator().manual_seed(0))
    image, (height, width) = (pair.clean + 0.1).clamp(max=1), SIZE
    error = (flow - pair.flow).abs() / torch.tensor([width / 2, height / 2]).view(1, 2, 1, 1)
    expected = (mean_per_image((image - pair.clean).abs(), valid) + mean_per_image(error, valid)).mean()
    assert_close(Undistort().loss(Restored(image, flow), pair), expected)
    terms = Undistort().loss_terms(Restored(image, flow), pair)
    assert_close(terms, (mean_per_image((image - pair.clean).abs(), valid), mean_per_image(error, valid)))
    garbage = Restored(torch.where(valid, image, 0.77), torch.where(valid, flow, 1e3))
    assert_close(Undistort().loss(garbage, pair), expected)


@pytest.mark.quick
def test_the_loss_of_a_deweathering_is_the_image_over_all_pixels_and_the_transmission(foggy):
    pair = foggy._replace(valid=torch.zeros_like(foggy.valid))
    offset = torch.tensor([0.1, -0.2, 0.6]).view(3, 1, 1)
    assert_close(Deweather().loss(Restored(foggy.clean + offset), pair), torch.tensor(0.3))
    wrong = (foggy.transmission - 0.25).abs()
    expected = 0.3 + (wrong - foggy.transmission).abs().double().mean()
    restored = Restored(foggy.clean + offset, transmission=wrong)
    loss = Deweather(transmission_head=True).loss(restored, pair)
    assert_close(loss.double(), expected, rtol=1e-5, atol=0)
    image_error, map_error = Deweather().loss_terms(restored, pair)
    assert_close(image_error, torch.full((3,), 0.3))
    assert map_error is not None
    assert_close(map_error, (wrong - foggy.transmission).abs().mean(dim=(1, 2, 3)))
    assert Deweather().loss_terms(Restored(foggy.clean), pair)[1] is None


@pytest.mark.quick
def test_the_loss_psnr_is_the_logarithm_of_the_squared_error_of_each_image_and_the_transmission(foggy):
    offset = torch.tensor([0.01, 0.1, 0.3]).view(3, 1, 1, 1)
    restored = Restored(foggy.clean + offset, transmission=foggy.transmission * 0 + 0.5)
    expected = (offset.square() + 1e-4).log().mean() / 10
    task = Deweather(loss_of_image="psnr")
    assert_close(task.loss(restored._replace(transmission=None), foggy), expected, rtol=1e-4, atol=0)
    of_map = (foggy.transmission - 0.5).abs().mean()
    assert_close(task.loss(restored, foggy), expected + of_map, rtol=1e-4, atol=0)
    assert_close(task.loss_terms(restored, foggy), Deweather().loss_terms(restored, foggy))
    with pytest.raises(ValueError, match="loss_of_image must be one of l1, psnr, got 'l2'"):
        Deweather(loss_of_image="l2")


@pytest.mark.parametrize("cell", [1, 4])
def test_the_last_channel_is_the_transmission_as_a_logistic(cell):
    task, image = Deweather(transmission_head=True), torch.rand(2, 3, 32, 64)
    prediction = torch.tensor([0.1, -0.2, 0.0, 1.5]).view(1, 4, 1, 1).expand(2, 4, 32 // cell, 64 // cell)
    restored = task.restore(prediction, image)
    assert task.channels == 4
    assert_close(restored.image, image + torch.tensor([0.1, -0.2, 0.0]).view(3, 1, 1))
    assert restored.transmission is not None
    assert_close(restored.transmission, torch.full((2, 1, 32, 64), 1 / (1 + math.exp(-1.5))))


def test_a_pair_without_a_transmission_is_rejected(foggy):
    task, pair = Deweather(transmission_head=True), foggy._replace(transmission=torch.empty(3, 0))
    restored = task.restore(torch.zeros(3, 4, *SIZE), foggy.degraded)
    with pytest.raises(ValueError, match=r"pair must have a transmission .* data\.transmission=true, got none"):
        task.loss(restored, pair)


def test_the_prediction_of_the_true_flow_restores_the_image(distorted):
    task, (height, width) = Undistort(), SIZE
    share = distorted.flow / torch.tensor([width, height]).view(1, 2, 1, 1)
    restored = task.restore(torch.atanh(share / task.limit), distorted.degraded)
    assert restored.flow is not None
    # Cells of 4 px miss a lens by an eighth of their squared side times its curvature.
    assert (restored.flow - distorted.flow).abs()[distorted.valid.expand(-1, 2, -1, -1)].mean() < 0.05
    nothing = task.restore(torch.zeros_like(distorted.flow), distorted.degraded)
    assert task.loss(restored, distorted) < 0.1 * task.loss(nothing, distorted)


@pytest.mark.parametrize("size", [SIZE, (33, 17), (1, 1)])
@pytest.mark.parametrize("task", [Undistort(), Deweather()], ids=["undistort", "deweather"])
def test_a_prediction_of_zero_changes_nothing(task, size):
    image = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    restored = task.restore(torch.zeros(2, task.channels, *size), image)
    assert_close(restored.image, image, rtol=0, atol=1e-5)
    assert (restored.flow is None) == isinstance(task, Deweather)
    if restored.flow is not None:
        assert torch.equal(restored.flow, torch.zeros(2, 2, *size))


@pytest.mark.parametrize("size", [(48, 80), (50, 81), (33, 17)])
def test_a_constant_prediction_is_a_constant_flow_in_shares_of_the_frame(size):
    share = torch.tensor([0.1, -0.05]).view(1, 2, 1, 1)
    prediction = torch.atanh(share / 0.25).expand(1, 2, *size)
    restored = Undistort().restore(prediction, torch.rand(1, 3, *size))
    expected = (share * torch.tensor([size[1], size[0]]).view(1, 2, 1, 1)).expand(1, 2, *size)
    assert restored.flow is not None
    assert_close(restored.flow, expected, rtol=0, atol=1e-4)


def test_no_flow_exceeds_the_limit_and_flows_are_float32():
    restored = Undistort(limit=0.1).restore(torch.full((1, 2, *SIZE), 1e6).bfloat16(), torch.rand(1, 3, *SIZE))
    assert restored.flow is not None
    assert_close(restored.flow.amax(dim=(0, 2, 3)), torch.tensor([8.0, 4.8]))
    assert (restored.flow.dtype, restored.image.dtype) == (torch.float32, torch.float32)


@pytest.mark.parametrize("size", [(50, 81), (33, 17)])
def test_averaging_over_cells_does_not_shift_a_linear_prediction(size):
    x = torch.arange(size[1], dtype=torch.float32).expand(size)
    flow = Undistort().restore(torch.stack([x, x])[None] * 1e-3, torch.rand(1, 3, *size)).flow
    assert flow is not None
    prediction = torch.atanh(flow[0, 0] / (0.25 * size[1])) * 1e3
    assert (prediction - x)[:, 4:-4].abs().max() < 0.5


@pytest.mark.parametrize("size", [(50, 81), (4, 4), (1, 8)])
def test_a_prediction_of_cells_equals_one_of_pixels_that_is_constant_in_each_cell(size):
    generator = torch.Generator().manual_seed(0)
    cells = 0.1 * torch.randn(2, 2, -(-size[0] // 4), -(-size[1] // 4), generator=generator)
    pixels = cells.repeat_interleave(4, dim=2).repeat_interleave(4, dim=3)[:, :, : size[0], : size[1]]
    image = torch.rand(2, 3, *size, generator=generator)
    assert_close(Undistort().restore(cells, image), Undistort().restore(pixels, image))


@pytest.mark.parametrize("size", [(50, 81), (33, 17)])
def test_a_change_of_color_that_is_linear_in_the_cells_is_linear_in_the_pixels(size):
    y, x = (1.5 + 4 * torch.arange(-(-side // 4)) for side in size)  # centers of cells of 4 px
    slopes = torch.tensor([[1e-3, 2e-3], [-2e-3, 0.0], [0.0, 1e-3]]).view(3, 2, 1, 1)
    change = slopes[:, 0] * x + slopes[:, 1] * y[:, None]
    degraded = torch.rand(1, 3, *size)
    restored = Deweather().restore(change[None], degraded).image - degraded
    expected = slopes[:, 0] * torch.arange(size[1]) + slopes[:, 1] * torch.arange(size[0])[:, None]
    assert_close(restored[0, :, 6:-9, 6:-9], expected[:, 6:-9, 6:-9], rtol=0, atol=1e-6)


@pytest.mark.parametrize("task", [Undistort(), Deweather()], ids=["undistort", "deweather"])
def test_the_gradient_reaches_every_pixel_and_points_to_the_true_flow(task, distorted, foggy):
    pair = distorted if isinstance(task, Undistort) else foggy
    generator = torch.Generator().manual_seed(0)
    prediction = (1e-3 * torch.randn(3, task.channels, *SIZE, generator=generator)).requires_grad_()
    task.loss(task.restore(prediction, pair.degraded), pair).backward()
    gradient = prediction.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert (gradient[:, :, 8:-8, 8:-8] != 0).float().mean() > 0.99
    if isinstance(task, Undistort):
        assert ((-gradient * pair.flow * pair.valid).sum(dim=(1, 2, 3)) > 0).all()
