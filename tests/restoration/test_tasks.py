import math

import pytest
import torch
from torch.testing import assert_close

from torchrefract import LensDistortion, Pair, UniformFog, warp
from torchrefract.restoration.tasks import Deweather, Restored, Undistort

SIZE = (48, 80)


def smooth(batch: int) -> torch.Tensor:
    """Images of long waves, which a look-up reproduces to a hundredth."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    channels = [0.5 + 0.4 * torch.sin(a * x + b * y) for a, b in ((5, 2), (-3, 4), (2, -6))]
    return torch.stack(channels).expand(batch, -1, -1, -1).contiguous()


@pytest.fixture(scope="module")
def distorted():
    clean = smooth(3)
    made = LensDistortion().degrade(clean, seed=1)
    assert made.restore_flow is not None
    assert made.restore_valid is not None
    return Pair(made.image, clean, made.restore_flow, made.restore_valid, torch.arange(3))


@pytest.fixture(scope="module")
def foggy():
    clean = smooth(3)
    made = UniformFog().degrade(clean, seed=1)
    zero = torch.zeros(3, 2, *SIZE)
    everywhere = torch.ones(3, 1, *SIZE, dtype=torch.bool)
    return Pair(made.image, clean, zero, everywhere, torch.arange(3), made.transmission)


def per_image(value: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """The mean over the valid pixels of each image, written the long way."""
    means = [image[mask.expand_as(image)].mean() for image, mask in zip(value, valid, strict=True)]
    return torch.stack(means)


def test_the_cost_of_an_undistortion_is_image_plus_flow_in_half_frames(distorted):
    flow = distorted.flow + torch.randn(distorted.flow.shape, generator=torch.Generator().manual_seed(0))
    image = (distorted.clean + 0.1).clamp(max=1)
    height, width = SIZE
    error = flow - distorted.flow
    in_halves = torch.stack([error[:, 0] / (width / 2), error[:, 1] / (height / 2)], dim=1).abs()
    expected = per_image((image - distorted.clean).abs(), distorted.valid) + per_image(in_halves, distorted.valid)
    assert_close(Undistort().loss(Restored(image, flow), distorted), expected.mean())


def test_garbage_in_an_invalid_pixel_costs_an_undistortion_nothing(distorted):
    valid = distorted.valid.clone()
    valid[:, :, :, :30] = False
    pair = distorted._replace(valid=valid)
    restored = Restored(distorted.degraded, torch.zeros_like(distorted.flow))
    garbage = Restored(torch.where(valid, restored.image, 0.77), torch.where(valid, torch.zeros(()), 1e3))
    assert_close(Undistort().loss(garbage, pair), Undistort().loss(restored, pair))


def test_the_cost_of_a_deweathering_is_the_image_on_all_pixels(foggy):
    pair = foggy._replace(valid=torch.zeros_like(foggy.valid))
    offset = torch.tensor([0.1, -0.2, 0.6]).view(3, 1, 1, 1)
    assert_close(Deweather().loss(Restored(foggy.clean + offset), pair), torch.tensor(0.3))


def test_a_wrong_transmission_costs_its_mean_error(foggy):
    task = Deweather(transmission_head=True)
    image, wrong = foggy.clean + 0.1, (foggy.transmission - 0.25).abs()
    expected = 0.1 + (wrong - foggy.transmission).abs().double().mean()
    assert_close(task.loss(Restored(image, transmission=wrong), foggy).double(), expected, rtol=1e-5, atol=0)
    assert_close(Deweather().loss(Restored(image), foggy), torch.tensor(0.1))


@pytest.mark.parametrize("cell", [1, 4])
def test_the_last_channel_is_the_transmission_as_a_logistic(cell):
    task, image = Deweather(transmission_head=True), torch.rand(2, 3, 32, 64)
    prediction = torch.tensor([0.1, -0.2, 0.0, 1.5]).view(1, 4, 1, 1).expand(2, 4, 32 // cell, 64 // cell)
    restored = task.restore(prediction, image)
    assert task.channels == 4
    assert_close(restored.image, image + torch.tensor([0.1, -0.2, 0.0]).view(3, 1, 1))
    assert restored.transmission is not None
    assert_close(restored.transmission, torch.full((2, 1, 32, 64), 1 / (1 + math.exp(-1.5))))


def test_a_pair_without_a_transmission_is_named(foggy):
    task, pair = Deweather(transmission_head=True), foggy._replace(transmission=torch.empty(3, 0))
    restored = task.restore(torch.zeros(3, 4, *SIZE), foggy.degraded)
    with pytest.raises(ValueError, match=r"pair must have a transmission .* data\.transmission=true, got none"):
        task.loss(restored, pair)


def test_the_true_flow_costs_what_its_look_up_blurs(distorted):
    image, _ = warp(distorted.degraded, distorted.flow, padding="border")
    cost = Undistort().loss(Restored(image, distorted.flow), distorted)
    nothing = Undistort().loss(Restored(distorted.degraded, torch.zeros_like(distorted.flow)), distorted)
    # Two bilinear look-ups of waves of length l = 2 pi / 6.7 of the width are off by at most 2 (pi / l)^2 / 2 of 0.4.
    assert cost < 0.4 * (6.7 / SIZE[1]) ** 2
    assert cost < 0.05 * nothing


def test_the_prediction_of_the_true_flow_restores_the_image(distorted):
    task, (height, width) = Undistort(), SIZE
    share = distorted.flow / torch.tensor([width, height]).view(1, 2, 1, 1)
    restored = task.restore(torch.atanh(share / task.limit), distorted.degraded)
    assert restored.flow is not None
    # Cells of 4 px can be this wrong about a lens: an eighth of their size squared times its curvature, 3 terms deep.
    assert (restored.flow - distorted.flow).abs()[distorted.valid.expand(-1, 2, -1, -1)].mean() < 0.05
    assert task.loss(restored, distorted) < 0.1 * task.loss(
        task.restore(torch.zeros_like(distorted.flow), distorted.degraded), distorted
    )


@pytest.mark.parametrize("size", [SIZE, (33, 17), (5, 3), (1, 1)])
@pytest.mark.parametrize("task", [Undistort(), Deweather()], ids=["undistort", "deweather"])
def test_a_prediction_of_zero_does_nothing(task, size):
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


def test_no_prediction_moves_a_pixel_beyond_the_limit():
    restored = Undistort(limit=0.1).restore(torch.full((1, 2, *SIZE), 1e6), torch.rand(1, 3, *SIZE))
    assert restored.flow is not None
    assert_close(restored.flow.amax(dim=(0, 2, 3)), torch.tensor([8.0, 4.8]))


@pytest.mark.parametrize("size", [(50, 81), (33, 17)])
def test_a_prediction_of_a_linear_field_keeps_its_place_at_any_size(size):
    # Cells of 4 px must not shift the field, whether the frame is a whole number of them or not.
    x = torch.arange(size[1], dtype=torch.float32).expand(size)
    field = torch.stack([x, x])[None] * 1e-3
    flow = Undistort().restore(field, torch.rand(1, 3, *size)).flow
    assert flow is not None
    found = torch.atanh(flow[0, 0] / (0.25 * size[1])) * 1e3
    assert (found - x)[:, 4:-4].abs().max() < 0.5


@pytest.mark.parametrize("size", [(50, 81), (33, 17), (4, 4), (1, 1), (1, 8)])
def test_a_prediction_of_cells_is_one_of_pixels_that_are_alike_in_a_cell(size):
    generator = torch.Generator().manual_seed(0)
    cells = 0.1 * torch.randn(2, 2, -(-size[0] // 4), -(-size[1] // 4), generator=generator)
    pixels = cells.repeat_interleave(4, dim=2).repeat_interleave(4, dim=3)[:, :, : size[0], : size[1]]
    image = torch.rand(2, 3, *size, generator=generator)
    found, expected = (Undistort().restore(prediction, image) for prediction in (cells, pixels))
    assert_close(found, expected)


@pytest.mark.parametrize("size", [(50, 81), (33, 17)])
def test_a_change_of_color_that_is_linear_in_the_centers_of_cells_is_so_in_pixels(size):
    y, x = (1.5 + 4 * torch.arange(-(-side // 4)) for side in size)  # cells of 4 px from pixel 0 on
    slopes = torch.tensor([[1e-3, 2e-3], [-2e-3, 0.0], [0.0, 1e-3]]).view(3, 2, 1, 1)
    change = slopes[:, 0] * x + slopes[:, 1] * y[:, None]
    degraded = torch.rand(1, 3, *size)
    found = Deweather().restore(change[None], degraded).image - degraded
    expected = slopes[:, 0] * torch.arange(size[1]) + slopes[:, 1] * torch.arange(size[0])[:, None]
    assert_close(found[0, :, 6:-9, 6:-9], expected[:, 6:-9, 6:-9], rtol=0, atol=1e-6)


@pytest.mark.parametrize("task", [Undistort(), Deweather()], ids=["undistort", "deweather"])
def test_the_gradient_reaches_the_prediction_everywhere(task, distorted, foggy):
    pair = distorted if isinstance(task, Undistort) else foggy
    generator = torch.Generator().manual_seed(0)
    prediction = (0.01 * torch.randn(3, task.channels, *SIZE, generator=generator)).requires_grad_()
    task.loss(task.restore(prediction, pair.degraded), pair).backward()
    gradient = prediction.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert (gradient[:, :, 8:-8, 8:-8] != 0).float().mean() > 0.99


def test_the_gradient_of_an_undistortion_points_to_the_true_flow(distorted):
    task = Undistort()
    prediction = torch.zeros(3, 2, *SIZE, requires_grad=True)
    task.loss(task.restore(prediction, distorted.degraded), distorted).backward()
    assert prediction.grad is not None
    agreement = (-prediction.grad * distorted.flow * distorted.valid).sum(dim=(1, 2, 3))
    assert (agreement > 0).all()


def test_a_half_precision_prediction_gives_a_flow_in_single_precision():
    prediction = torch.full((1, 2, *SIZE), 0.3, dtype=torch.bfloat16)
    restored = Undistort().restore(prediction, torch.rand(1, 3, *SIZE))
    assert restored.flow is not None
    assert (restored.flow.dtype, restored.image.dtype) == (torch.float32, torch.float32)
