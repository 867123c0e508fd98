import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.flare import flare_axes


def flare_mask(center: Tensor, radius: Tensor, *, height: int, width: int) -> Tensor:
    along_x, along_y = flare_axes(center, radius, height=height, width=width)
    return along_y * along_x


@pytest.mark.quick
def test_the_mask_is_the_gaussian_of_the_distance():
    center = torch.tensor([[3.3, 7.2], [-20.0, 4.0], [11.0, 50.5]], dtype=torch.float64)
    radius = torch.tensor([4.0, 30.0, 0.7], dtype=torch.float64)
    masks = flare_mask(center, radius, height=13, width=17)
    y, x = np.mgrid[:13, :17]
    for mask, (cx, cy), r in zip(masks, center.numpy(), radius.numpy(), strict=True):
        distance = np.hypot(x - cx, y - cy)
        expected = torch.from_numpy(np.exp(-0.5 * (distance / r) ** 2))
        assert_close(mask[0], expected, rtol=0, atol=1e-12)


def test_the_mask_in_float32_is_exact_to_1e_6_at_full_size():
    center, radius = torch.tensor([[900.25, 100.5]]), torch.tensor([661.0])
    along_x, along_y = flare_axes(center, radius, height=1080, width=1920)
    assert (along_x.shape, along_y.shape) == ((1, 1, 1, 1920), (1, 1, 1080, 1))
    double = flare_mask(center.double(), radius.double(), height=1080, width=1920)
    assert_close((along_y * along_x).double(), double, rtol=0, atol=1e-6)


def test_a_radius_of_zero_is_a_point_with_finite_gradients():
    center = torch.tensor([[3.0, 2.0], [3.0, 2.5], [3.0, 2.0]], dtype=torch.float64, requires_grad=True)
    radius = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64, requires_grad=True)
    mask = flare_mask(center, radius, height=5, width=7)
    assert mask[0].nonzero().tolist() == [[0, 2, 3]]
    assert not mask[1].any()
    assert mask[2].all()
    for gradient in torch.autograd.grad(mask.sum(), [center, radius]):
        assert gradient.isfinite().all()
        assert not gradient[:2].any()
