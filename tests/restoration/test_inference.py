from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import warp
from torchrefract.restoration.inference import FullSizeModel, Restorer, restore_tiles, transfer_change
from torchrefract.restoration.tasks import Restored


class Model(nn.Module):
    """A function in place of a trained model; it keeps its inputs."""

    def __init__(self, function: Callable[[Tensor], Restored]):
        super().__init__()
        self.function, self.inputs = function, []

    def forward(self, degraded: Tensor) -> Restored:
        self.inputs.append(degraded)
        return self.function(degraded)


def stretch(height: int, width: int) -> Tensor:
    """Return a flow (1, 2, H, W), px, that stretches a frame of any size by 10 % and shifts it by 1/50."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([0.1 * (x - width / 2) + width / 50, -0.1 * (y - height / 2) + height / 50])[None]


def restore_by_flow(degraded: Tensor) -> Restored:
    flow = stretch(*degraded.shape[2:]).expand(len(degraded), -1, -1, -1)
    return Restored(warp(degraded, flow, padding="border")[0], flow)


def picture(height: int, width: int, seed: int = 0) -> Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("size", [(90, 160), (45, 61), (16, 28), (3, 5), (1, 1)])
def test_a_picture_is_warped_once_along_the_flow_of_its_own_size(size, interpolation):
    image = picture(*size)
    (restored,) = Restorer(restore_by_flow, size=(16, 28), interpolation=interpolation)([image])
    expected = warp(image[None], stretch(*size), padding="border", interpolation=interpolation)[0]
    # Rounding moves a position by 1e-5 px, between pixels that differ by at most 1.
    assert_close(restored, expected[0].clamp(0, 1), rtol=0, atol=1e-4)


@pytest.mark.quick
def test_pictures_of_several_sizes_are_one_batch_of_the_model():
    model = Model(restore_by_flow)
    images = [picture(40, 70), picture(70, 40, 1), picture(16, 28, 2)]
    results = Restorer(model, size=(16, 28))(images)
    assert [tuple(batch.shape) for batch in model.inputs] == [(3, 3, 16, 28)]
    assert torch.equal(model.inputs[0][2], images[2])
    for image, restored in zip(images, results, strict=True):
        (single,) = Restorer(restore_by_flow, size=(16, 28))([image])
        assert_close(restored, single, rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [(60, 65), (1, 1), (4, 300)])
def test_a_model_without_a_change_returns_the_picture(size):
    image = picture(*size)
    for tile in (None, (32, 32), (2, 3), (33, 48), (200, 200)):
        (restored,) = Restorer(Restored, size=(16, 28), tile=tile)([image])
        assert_close(restored, image, rtol=0, atol=1e-6)


def test_a_change_of_contrast_reaches_details_that_the_small_picture_lacks():
    # Removing fog multiplies the contrast and subtracts the airlight.
    image = 0.4 + 0.2 * F.interpolate(picture(32, 56)[None], (128, 224), mode="bilinear")[0] + 0.05 * picture(128, 224)
    (restored,) = Restorer(lambda small: Restored(3 * small - 1.1), size=(32, 56))([image])
    change = F.interpolate((2 * image - 1.1)[None], (32, 56), mode="area")
    without_details = image + F.interpolate(change, (128, 224), mode="bilinear")[0]
    errors = [(value - (3 * image - 1.1)).square().mean().sqrt() for value in (restored, without_details)]
    assert errors[0] < 0.3 * errors[1]
    assert errors[1] > 0.02


def test_a_change_of_brightness_is_constant_and_the_result_stays_in_range():
    image = picture(20, 30)[None] / 2
    small = F.interpolate(image, (10, 15), mode="area")
    assert_close(transfer_change(image, small, small + 0.25), image + 0.25, rtol=0, atol=1e-5)
    (restored,) = Restorer(lambda small: Restored(4 * small - 1), size=(16, 28))([picture(40, 50)])
    assert (restored.min(), restored.max()) == (0, 1)


def test_the_deviation_of_a_flow_is_that_of_the_px_of_each_picture():
    def deviate(small: Tensor) -> Restored:
        flow = stretch(*small.shape[2:]).expand(len(small), -1, -1, -1)
        return Restored(warp(small, flow, padding="border")[0], flow, deviation=torch.ones_like(flow))

    restorer, images = Restorer(deviate, size=(16, 28)), [picture(48, 56), picture(16, 28, 1)]
    wide, small = restorer.restore(images)
    assert wide.deviation is not None
    assert_close(wide.deviation, torch.tensor([2.0, 3.0]).view(1, 2, 1, 1).expand(1, 2, 48, 56))
    assert_close(small.deviation, torch.ones(1, 2, 16, 28))
    assert restorer.deviations == pytest.approx([13**0.5, 2**0.5])
    for image, full in zip(restorer(images), (wide, small), strict=True):
        assert torch.equal(image, full.image[0])


def test_a_model_that_predicts_a_flow_has_no_tiles():
    with pytest.raises(ValueError, match=r"^tile must be None for a model that predicts a flow"):
        Restorer(restore_by_flow, size=(16, 28), tile=(8, 8))([picture(20, 20)])


@pytest.mark.parametrize("tile", [None, (8, 8)])
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (255 * picture(20, 20), r"image must lie in \[0, 1\].* divide 0...255 by 255"),
        ((255 * picture(20, 20)).byte(), "images must be floating in .* got torch.uint8; use images.float"),
        (picture(20, 20)[:1], r"images must have shape \(B, 3, H, W\), got \(1, 1, 20, 20\)"),
    ],
)
def test_a_picture_of_other_values_or_channels_is_rejected(image, message, tile):
    with pytest.raises((ValueError, TypeError), match=message):
        Restorer(Restored, size=(16, 28), tile=tile)([image])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (0, 4)}, "size must be at least 1, got 0"),
        ({"size": (4, 4), "tile": (0, 4)}, "tile must be at least 1, got 0"),
        ({"size": (4, 4), "interpolation": "cubic"}, "interpolation must be one of nearest, bilinear, bicubic"),
        ({"size": (4, 4), "batch": 0}, "batch must be at least 1, got 0"),
    ],
)
def test_an_invalid_option_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        Restorer(restore_by_flow, **options)


def test_the_module_for_export_agrees_with_the_restorer():
    images = torch.stack([picture(40, 70), picture(40, 70, 1)])
    restored, flow = FullSizeModel(Model(restore_by_flow), size=(16, 28))(images)
    assert_close(flow, stretch(40, 70).expand(2, -1, -1, -1), rtol=0, atol=1e-4)
    assert_close(restored, torch.stack(Restorer(restore_by_flow, size=(16, 28))([*images])), rtol=0, atol=1e-5)
    assert len(FullSizeModel(Model(Restored), size=(16, 28))(images)) == 1


def maximum(tiles: Tensor) -> Tensor:
    return tiles.amax(dim=(2, 3), keepdim=True).expand_as(tiles)


@pytest.mark.parametrize("batch", [1, 100])
def test_tiles_are_blended_by_their_windows(batch):
    image = torch.arange(24.0).view(1, 4, 6).double()
    blended = restore_tiles(maximum, image, tile=(4, 4), batch=batch)
    w = torch.sin(torch.pi * (torch.arange(4).double() + 0.5) / 4) ** 2
    # The two tiles start at columns 0 and 2 and have maxima 21 and 23. Both cover columns 2 and 3.
    expected = [21, 21, *((21 * w[2 + i] + 23 * w[i]) / (w[2 + i] + w[i]) for i in range(2)), 23, 23]
    assert_close(blended, torch.tensor(expected).double().expand(1, 4, 6), rtol=0, atol=1e-12)


def test_a_step_between_two_tiles_leaves_no_seam():
    image = torch.linspace(0, 1, 256).expand(1, 64, 256)
    blended = restore_tiles(maximum, image, tile=(64, 64), batch=4)
    assert blended.max() - blended.min() > 0.15
    # Tiles start 48 px apart: a step of 48/256 over an overlap of 16 px, with a slope of at most pi/2 of the mean.
    assert (blended[..., 1:] - blended[..., :-1]).abs().max() < 48 / 256 / 16 * 2


def test_all_tiles_have_the_given_size():
    shapes = []

    def restore(tiles: Tensor) -> Tensor:
        shapes.append(tuple(tiles.shape))
        return tiles

    restore_tiles(restore, torch.zeros(3, 50, 90), tile=(32, 40), batch=4)
    # 50 px need two tiles of 32, and 90 px three tiles of 40 that overlap by 10 px or more.
    assert shapes == [(4, 3, 32, 40), (2, 3, 32, 40)]
