import pytest
import torch
from torch.testing import assert_close

from torchrefract.restoration.models.resunet import ResUNet

SMALL = "tu-resnet10t"


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return ResUNet(2, encoder=SMALL).eval()


@pytest.fixture(scope="module")
def awake():
    """A network whose last layer is drawn, as after some training."""
    torch.manual_seed(0)
    network = ResUNet(2, encoder=SMALL).eval()
    for parameter in network.network.segmentation_head.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return network


@pytest.mark.parametrize("size", [(32, 64), (33, 17), (50, 37), (1, 1)])
def test_it_starts_by_doing_nothing_at_any_size(network, size):
    image = torch.rand(2, 3, *size)
    assert torch.equal(network(image), torch.zeros(2, 2, *size))


@torch.no_grad()
@pytest.mark.parametrize("size", [(33, 17), (50, 37), (64, 112)])
def test_its_answer_is_finite_and_differs_from_pixel_to_pixel_at_any_size(awake, size):
    found = awake(torch.rand(1, 3, *size))
    assert found.shape == (1, 2, *size)
    assert found.isfinite().all()
    assert found.flatten(2).std(dim=2).min() > 1e-4


@torch.no_grad()
def test_it_sees_where_a_pixel_lies(awake):
    # A gray image looks alike everywhere but at its rim, and the network answers differently left and right.
    found = awake(torch.full((1, 3, 64, 512), 0.5))
    without = awake.network(torch.zeros(1, 5, 64, 512))
    place, rim = (value[0, :, 32, 160:352].std(dim=1).max() for value in (found, without))
    assert place > 2 * rim


@torch.no_grad()
def test_the_coordinates_run_from_border_to_border_whatever_the_size(awake, monkeypatch):
    seen = []
    monkeypatch.setattr(awake.network, "forward", lambda inputs: (seen.append(inputs), inputs[:, :2])[1])
    for height, width in ((64, 96), (33, 17)):
        awake(torch.rand(1, 3, height, width))
        x, y = seen[-1][0, 3:, :height, :width]
        assert_close(x, ((2 * torch.arange(width) + 1) / width - 1).expand(height, width))
        assert_close(y, ((2 * torch.arange(height) + 1) / height - 1)[:, None].expand(height, width))
        assert all(side % 32 == 0 for side in seen[-1].shape[2:])


@torch.no_grad()
def test_an_image_gets_the_same_answer_alone_and_in_a_batch(awake):
    images = torch.rand(3, 3, 40, 56)
    together = awake(images)
    for i in range(3):
        assert_close(awake(images[i : i + 1])[0], together[i], rtol=0, atol=1e-4)


def test_the_gradient_reaches_the_first_layer_once_the_last_is_awake(awake):
    awake(torch.rand(2, 3, 32, 64)).square().sum().backward()
    first = next(awake.network.encoder.parameters())
    assert first.grad is not None
    assert first.grad.abs().max() > 0
    awake.zero_grad(set_to_none=True)


def test_the_baseline_of_the_paper_has_24_million_parameters():
    # ResNet34 without its classifier has 21.28 M, the decoder of segmentation-models-pytorch 3.15 M.
    assert sum(parameter.numel() for parameter in ResUNet(2).parameters()) == pytest.approx(24.4e6, rel=0.005)
