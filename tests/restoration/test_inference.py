from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import warp
from torchrefract.restoration.inference import Restorer, Restoring, with_change
from torchrefract.restoration.tasks import Restored


class Fake(nn.Module):
    """A model that sees images, and answers what a test wants."""

    def __init__(self, answer: Callable[[Tensor], Restored]):
        super().__init__()
        self.answer, self.seen = answer, []

    def forward(self, degraded: Tensor) -> Restored:
        self.seen.append(degraded)
        return self.answer(degraded)


def stretched(height: int, width: int) -> Tensor:
    """(1, 2, H, W), px: what a frame needs that is stretched by 10 % and shifted by 1/50 of it, in any size."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([0.1 * (x - width / 2) + width / 50, -0.1 * (y - height / 2) + height / 50])[None]


def by_flow(degraded: Tensor) -> Restored:
    flow = stretched(*degraded.shape[2:]).expand(len(degraded), -1, -1, -1)
    return Restored(warp(degraded, flow, padding="border")[0], flow)


def picture(height: int, width: int, seed: int = 0) -> Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("size", [(90, 160), (160, 90), (45, 61), (16, 28), (3, 5), (1, 1)])
def test_a_picture_is_looked_up_once_along_the_flow_of_its_own_size(size, interpolation):
    image = picture(*size)
    (found,) = Restorer(by_flow, size=(16, 28), interpolation=interpolation)([image])
    expected = warp(image[None], stretched(*size), padding="border", interpolation=interpolation)[0]
    # Places are off by rounding, 1e-5 px, between pixels that differ by 1 at most.
    assert_close(found, expected[0].clamp(0, 1), rtol=0, atol=1e-4)


def test_pictures_of_several_sizes_go_to_the_model_together():
    model = Fake(by_flow)
    images = [picture(40, 70), picture(70, 40, 1), picture(16, 28, 2)]
    found = Restorer(model, size=(16, 28))(images)
    assert [tuple(batch.shape) for batch in model.seen] == [(3, 3, 16, 28)]
    assert torch.equal(model.seen[0][2], images[2])
    for image, restored in zip(images, found, strict=True):
        (alone,) = Restorer(by_flow, size=(16, 28))([image])
        assert torch.equal(restored, alone)


@pytest.mark.parametrize("size", [(60, 100), (100, 60), (1, 1), (4, 300)])
def test_a_model_that_changes_nothing_gives_the_picture_itself(size):
    image = picture(*size)
    for tile in (None, (32, 32)):
        (found,) = Restorer(Restored, size=(16, 28), tile=tile)([image])
        assert_close(found, image, rtol=0, atol=1e-6)


def test_a_change_of_contrast_reaches_the_details_that_the_small_picture_lacks():
    # What takes fog off: contrast is multiplied, and the light of the air subtracted.
    image = 0.4 + 0.2 * F.interpolate(picture(32, 56)[None], (128, 224), mode="bilinear")[0] + 0.05 * picture(128, 224)
    (found,) = Restorer(lambda small: Restored(3 * small - 1.1), size=(32, 56))([image])
    enlarged = F.interpolate((2 * image - 1.1)[None], (32, 56), mode="area")
    plain = image + F.interpolate(enlarged, (128, 224), mode="bilinear")[0]
    expected = 3 * image - 1.1
    errors = [(value - expected).square().mean().sqrt() for value in (found, plain)]
    assert errors[0] < 0.3 * errors[1]
    assert errors[1] > 0.02


def test_a_change_of_brightness_is_the_same_everywhere():
    image = picture(20, 30)[None] / 2
    small = F.interpolate(image, (10, 15), mode="area")
    assert_close(with_change(image, small, small + 0.25), image + 0.25, rtol=0, atol=1e-5)


def test_what_is_restored_stays_in_range():
    (found,) = Restorer(lambda small: Restored(4 * small - 1), size=(16, 28))([picture(40, 50)])
    assert (found.min(), found.max()) == (0, 1)


def test_a_model_that_predicts_a_flow_takes_no_tiles():
    with pytest.raises(ValueError, match=r"^tile must be None for a model that predicts a flow"):
        Restorer(by_flow, size=(16, 28), tile=(8, 8))([picture(20, 20)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (0, 4)}, "size must be at least 1, got 0"),
        ({"size": (4, 4), "tile": (0, 4)}, "tile must be at least 1, got 0"),
        ({"size": (4, 4), "interpolation": "cubic"}, "interpolation must be one of nearest, bilinear, bicubic"),
        ({"size": (4, 4), "batch": 0}, "batch must be at least 1, got 0"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Restorer(by_flow, **options)


def test_a_batch_of_one_size_is_restored_as_picture_by_picture():
    images = torch.stack([picture(40, 70), picture(40, 70, 1)])
    restored, flow = Restoring(Fake(by_flow), size=(16, 28))(images)
    assert_close(flow, stretched(40, 70).expand(2, -1, -1, -1), rtol=0, atol=1e-4)
    expected = Restorer(by_flow, size=(16, 28))([*images])
    assert torch.equal(restored, torch.stack(expected))
    assert len(Restoring(Fake(Restored), size=(16, 28))(images)) == 1
