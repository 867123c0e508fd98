import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract.warping.flow import resize_flow, resize_image

SIZES = [(1, 1), (7, 9), (20, 24), (57, 61), (20, 5)]


def lines(x: Tensor, y: Tensor) -> Tensor:
    """(1, 2, H, W), px of a frame of 20 x 24: a flow that is linear in the place."""
    return torch.stack([0.3 * x - 0.2 * y + 1, 0.1 * x + 0.5 * y - 2])[None]


@pytest.mark.parametrize("size", SIZES)
def test_a_linear_flow_comes_out_as_it_is_up_to_the_border(pixels, oracle, size):
    x, y = pixels(*size)
    # The center of a pixel lies at the same share of the frame in both sizes.
    expected = lines((x + 0.5) * 24 / size[1] - 0.5, (y + 0.5) * 20 / size[0] - 0.5)
    expected *= torch.tensor([size[1] / 24, size[0] / 20], dtype=torch.float64).view(1, 2, 1, 1)
    oracle("resized flow, lines", resize_flow(lines(*pixels(20, 24)), size), expected, 1e-12)


def test_a_flow_of_its_own_size_is_itself(waves, pixels):
    flow = waves(*pixels(13, 17), 3.0, 4.0).float()
    assert torch.equal(resize_flow(flow, (13, 17)), flow)


def test_between_pixels_lie_the_cubics_of_torch(waves, pixels, oracle):
    flow = waves(*pixels(20, 24), 3.0, 4.0)
    # With antialias torch has a = -1/2, where it enlarges; at the border it has other rules.
    expected = F.interpolate(flow, (57, 61), mode="bicubic", antialias=True)
    expected *= torch.tensor([61 / 24, 57 / 20], dtype=torch.float64).view(1, 2, 1, 1)
    inner = (..., slice(9, -9), slice(9, -9))
    oracle("resized flow, torch's cubics", resize_flow(flow, (57, 61))[inner], expected[inner], 1e-12)


def test_a_flow_of_one_pixel_is_the_same_everywhere():
    flow = torch.tensor([2.0, -3.0]).view(1, 2, 1, 1)
    expected = torch.tensor([10.0, -9.0]).view(1, 2, 1, 1).expand(1, 2, 3, 5)
    assert torch.equal(resize_flow(flow, (3, 5)), expected)


def test_the_gradient_of_a_resized_flow_is_right(waves, pixels):
    flow = waves(*pixels(4, 5), 1.0, 2.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda value: resize_flow(value, (6, 3)), (flow,))


@pytest.mark.parametrize("size", [(1, 1), (13, 20), (61, 9)])
def test_a_smaller_image_is_the_mean_of_what_its_pixels_cover(oracle, size):
    image = torch.rand(2, 3, 61, 47, generator=torch.Generator().manual_seed(0))
    arrays = [one.permute(1, 2, 0).numpy() for one in image]
    small = [cv2.resize(one, (size[1], size[0]), interpolation=cv2.INTER_AREA) for one in arrays]
    expected = torch.from_numpy(np.stack(small)).permute(0, 3, 1, 2)
    oracle("smaller image, OpenCV", resize_image(image, size), expected, 1e-5, unit="")


def test_a_larger_image_stays_within_the_range_of_its_values():
    image = (torch.rand(1, 3, 8, 9, generator=torch.Generator().manual_seed(0)) > 0.5).float()
    large = resize_image(image, (40, 30))
    assert (large.min(), large.max()) == (0, 1)
    assert torch.equal(resize_image(image, (8, 9)), image)


@pytest.mark.parametrize("size", [(0, 4), (4, -1)])
def test_a_size_is_of_one_pixel_or_more(size):
    with pytest.raises(ValueError, match="size must be at least 1, got"):
        resize_flow(torch.zeros(1, 2, 4, 4), size)
    with pytest.raises(ValueError, match="size must be at least 1, got"):
        resize_image(torch.zeros(1, 3, 4, 4), size)


def test_an_image_is_a_batch_of_floats():
    with pytest.raises(ValueError, match=r"image must be \(B, C, H, W\) of floats, got \(3, 4, 4\) of torch.float32"):
        resize_image(torch.zeros(3, 4, 4), (2, 2))
