from collections.abc import Callable
from functools import partial

import pytest
import torch
from numpy.polynomial import Chebyshev
from torch.testing import assert_close

from torchrefract.restoration.models.coordconv import Located
from torchrefract.restoration.models.resunet import ResUNet
from torchrefract.restoration.models.segformer import SegFormer

SMALL: dict[str, Callable[..., Located]] = {
    "resunet": partial(ResUNet, encoder="tu-resnet10t"),
    "segformer": partial(SegFormer, encoder="mit_b0"),
}
SIZES = [(32, 64), (33, 17), (50, 37), (37, 20), (20, 30), (1, 1)]

pytestmark = pytest.mark.parametrize("kind", SMALL)


def drawn(kind: str, *, awake: bool = True, smooth: bool = True) -> Located:
    """A network, whose last layer is drawn as after some training, if it is to be awake."""
    torch.manual_seed(0)
    network = SMALL[kind](2, smooth=smooth).eval()
    for parameter in network.network.segmentation_head.parameters() if awake else ():
        torch.nn.init.normal_(parameter, std=0.1)
    return network


def cells(network: Located, size: tuple[int, int]) -> tuple[int, int]:
    """How many values it predicts down and across: of partial cells, too."""
    return len(range(0, size[0], network.cell)), len(range(0, size[1], network.cell))


@torch.no_grad()
@pytest.mark.parametrize("size", SIZES)
def test_it_starts_by_doing_nothing_at_any_size(kind, size):
    network = drawn(kind, awake=False)
    assert torch.equal(network(torch.rand(2, 3, *size)), torch.zeros(2, 2, *cells(network, size)))


@torch.no_grad()
@pytest.mark.parametrize("size", [(33, 17), (50, 37), (64, 112)])
def test_its_answer_is_finite_and_differs_from_place_to_place_at_any_size(kind, size):
    network = drawn(kind)
    found = network(torch.rand(1, 3, *size))
    assert found.shape == (1, 2, *cells(network, size))
    assert found.isfinite().all()
    assert found.flatten(2).std(dim=2).min() > 1e-4


@torch.no_grad()
def test_it_sees_where_a_pixel_lies(kind):
    # A gray image looks alike everywhere but at its rim, and the network answers differently left and right.
    network = drawn(kind)
    found = network(torch.full((1, 3, 64, 512), 0.5))
    without = network.network(torch.zeros(1, 5, 64, 512))
    left, right = 160 // network.cell, 352 // network.cell
    place, rim = (value[0, :, value.shape[2] // 2, left:right].std(dim=1).max() for value in (found, without))
    assert place > 2 * rim


@torch.no_grad()
def test_the_coordinates_run_from_border_to_border_whatever_the_size(kind, monkeypatch):
    network, seen = drawn(kind), []
    encode = network.network.encoder.forward
    monkeypatch.setattr(network.network.encoder, "forward", lambda inputs: (seen.append(inputs), encode(inputs))[1])
    for height, width in ((64, 96), (33, 17)):
        image = torch.rand(1, 3, height, width)
        network(image)
        colors, (x, y) = seen[-1][0, :3, :height, :width], seen[-1][0, 3:, :height, :width]
        assert_close(colors, 4 * image[0] - 2)
        assert_close(x, ((2 * torch.arange(width) + 1) / width - 1).expand(height, width))
        assert_close(y, ((2 * torch.arange(height) + 1) / height - 1)[:, None].expand(height, width))
        assert all(side % 32 == 0 for side in seen[-1].shape[2:])


@torch.no_grad()
@pytest.mark.parametrize("size", [(64, 96), (33, 50)])
def test_what_is_said_of_the_whole_frame_is_added_at_the_centers_of_the_cells(kind, size):
    network, image = drawn(kind), torch.rand(2, 3, *size)
    assert network.whole is not None
    before = network(image)
    network.get_parameter("whole.layers.2.bias").copy_(bias := torch.randn(2 * len(network.whole.terms)))
    found = (network(image) - before).double()
    rows, columns = (torch.arange(count).double() for count in cells(network, size))
    y, x = (
        (network.cell * (2 * axis + 1) / side - 1).clamp(max=1)
        for axis, side in zip((rows, columns), size, strict=True)
    )
    expected = torch.zeros(2, len(y), len(x), dtype=torch.float64)
    for (i, j), *each in zip(network.whole.terms, *bias.double().view(2, -1), strict=True):
        # T_n as a polynomial, by NumPy.
        in_x, in_y = (torch.from_numpy(Chebyshev.basis(n)(axis.numpy())) for n, axis in ((i, x), (j, y)))
        expected += torch.stack(each)[:, None, None] * in_y[:, None] * in_x
    assert_close(found, expected.expand_as(found), rtol=0, atol=2e-4)


@torch.no_grad()
def test_what_is_said_of_the_whole_frame_is_in_float32_when_the_network_is_not(kind):
    network, image = drawn(kind), torch.rand(1, 3, 64, 96)
    network.get_parameter("whole.layers.2.bias").normal_()
    with torch.autocast("cpu", torch.bfloat16):
        assert network(image).dtype is torch.float32


@torch.no_grad()
def test_an_image_gets_the_same_answer_alone_and_in_a_batch(kind):
    network, images = drawn(kind), torch.rand(3, 3, 40, 56)
    together = network(images)
    for i in range(3):
        assert_close(network(images[i : i + 1])[0], together[i], rtol=0, atol=1e-4)


def test_the_gradient_reaches_every_weight_once_the_last_layer_is_awake(kind):
    network = drawn(kind)
    network(torch.rand(2, 3, 64, 64)).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
    first = next(network.network.encoder.parameters())
    assert first.grad is not None
    assert first.grad.abs().max() > 0


def test_an_encoder_that_is_not_known_is_named(kind):
    for name in ("nonsense", "tu-nonsense"):
        with pytest.raises(ValueError, match=f"encoder must be known to .*, got {name}"):
            SMALL[kind].func(2, encoder=name)  # pyright: ignore[reportFunctionMemberAccess]  # it is a partial


@pytest.mark.parametrize("shape", [(2, 1, 32, 32), (2, 4, 32, 32), (3, 32, 32)])
def test_an_image_that_is_not_three_colors_is_named(kind, shape):
    with pytest.raises(ValueError, match=r"image must have shape \(B, 3, H, W\), got \("):
        SMALL[kind](2)(torch.rand(shape))
