from collections.abc import Callable
from functools import partial

import pytest
import torch
from numpy.polynomial import Chebyshev
from torch.testing import assert_close

from torchrefract.restoration.models.coordconv import CoordConvSegmenter, ResUNet, SegFormer, pixel_coordinates
from torchrefract.restoration.models.denoiser import conditions
from torchrefract.restoration.models.fog_net import FogNet
from torchrefract.restoration.models.lens_net import LensNet

SMALL: dict[str, Callable[..., CoordConvSegmenter]] = {
    "resunet": partial(ResUNet, encoder="tu-resnet10t"),
    "segformer": partial(SegFormer, encoder="mit_b0"),
}

of_both_networks = pytest.mark.parametrize("network", SMALL)


def build(network: str, *, random_head: bool = True, smooth: bool = True) -> CoordConvSegmenter:
    """Build a network; a random last layer stands for training."""
    torch.manual_seed(0)
    model = SMALL[network](2, smooth=smooth).eval()
    for parameter in model.network.segmentation_head.parameters() if random_head else ():
        torch.nn.init.normal_(parameter, std=0.1)
    return model


def num_cells(model: CoordConvSegmenter, size: tuple[int, int]) -> tuple[int, int]:
    """Count the cells down and across, partial ones included."""
    return len(range(0, size[0], model.cell)), len(range(0, size[1], model.cell))


@torch.no_grad()
@of_both_networks
@pytest.mark.parametrize("size", [(33, 17), (64, 112), (1, 1)])
def test_an_untrained_network_predicts_zero_and_a_trained_one_varies_over_a_frame_of_any_size(network, size):
    model, image = build(network, random_head=False), torch.rand(2, 3, *size)
    assert torch.equal(model(image), torch.zeros(2, 2, *num_cells(model, size)))
    maps = build(network)(image)
    assert maps.shape == (2, 2, *num_cells(model, size))
    assert maps.isfinite().all()
    assert size == (1, 1) or maps.flatten(2).std(dim=2).min() > 1e-4


@torch.no_grad()
@of_both_networks
def test_the_prediction_depends_on_the_position_of_a_pixel(network):
    # A gray image is constant except for the padding at its border.
    model = build(network)
    maps = model(torch.full((1, 3, 64, 512), 0.5))
    without_coordinates = model.network(torch.zeros(1, 5, 64, 512))
    left, right = 160 // model.cell, 352 // model.cell
    coordinates, border = (
        value[0, :, value.shape[2] // 2, left:right].std(dim=1).max() for value in (maps, without_coordinates)
    )
    assert coordinates > 2 * border


@pytest.mark.quick
def test_pixel_coordinates_are_those_of_pixel_centers_in_units_of_half_the_frame():
    x, y = pixel_coordinates(torch.rand(2, 1, 4, 5))[1]
    assert_close(x, torch.tensor([-0.8, -0.4, 0.0, 0.4, 0.8]).expand(4, 5))
    assert_close(y, torch.tensor([-0.75, -0.25, 0.25, 0.75])[:, None].expand(4, 5))


@torch.no_grad()
def test_the_encoder_sees_normalized_colors_and_coordinates_padded_to_its_stride(monkeypatch):
    model, inputs, (height, width) = build("resunet"), [], (33, 17)
    encode = model.network.encoder.forward
    monkeypatch.setattr(model.network.encoder, "forward", lambda value: (inputs.append(value), encode(value))[1])
    image = torch.rand(1, 3, height, width)
    model(image)
    assert inputs[0].shape == (1, 5, 64, 32)
    assert_close(inputs[0][:, :3, :height, :width], 4 * image - 2)
    assert_close(inputs[0][:, 3:, :height, :width], pixel_coordinates(image))


@torch.no_grad()
@of_both_networks
@pytest.mark.parametrize("size", [(64, 96), (33, 50)])
def test_the_polynomial_head_adds_chebyshev_polynomials_at_the_centers_of_cells(network, size):
    model, image = build(network), torch.rand(2, 3, *size)
    assert model.polynomial_head is not None
    before = model(image)
    terms = [(i, j) for i in range(6) for j in range(6 - i)]
    model.get_parameter("polynomial_head.layers.2.bias").copy_(bias := torch.randn(2 * len(terms)))
    added = (model(image) - before).double()
    axes = (torch.arange(count).double() for count in num_cells(model, size))
    y, x = ((model.cell * (2 * axis + 1) / side - 1).clamp(max=1) for axis, side in zip(axes, size, strict=True))
    expected = torch.zeros(2, len(y), len(x), dtype=torch.float64)
    for (i, j), *coefficients in zip(terms, *bias.double().view(2, -1), strict=True):
        in_x, in_y = (torch.from_numpy(Chebyshev.basis(n)(axis.numpy())) for n, axis in ((i, x), (j, y)))
        expected += torch.stack(coefficients)[:, None, None] * in_y[:, None] * in_x
    assert_close(added, expected.expand_as(added), rtol=0, atol=2e-4)
    with torch.autocast("cpu", torch.bfloat16):
        assert model(image).dtype is torch.float32


@of_both_networks
def test_images_of_a_batch_are_independent_and_gradients_reach_every_weight(network):
    model, images = build(network), torch.rand(2, 3, 64, 64)
    together = model(images)
    together.square().sum().backward()
    assert_close(model(images[1:]), together[1:], rtol=0, atol=1e-4)
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
    first = next(model.network.encoder.parameters()).grad
    assert first is not None
    assert first.abs().max() > 0


@pytest.mark.parametrize(("network", "millions"), [(ResUNet, 24.4), (SegFormer, 13.7)])
def test_the_baselines_of_the_paper_have_their_numbers_of_parameters(network, millions):
    # ResNet34 without its classifier has 21.28 M, its decoder 3.15 M. Table 7 of SegFormer: B1 has 13.7 M.
    parameters = sum(parameter.numel() for parameter in network(2).parameters())
    assert parameters == pytest.approx(1e6 * millions, rel=0.005)


@torch.no_grad()
def test_segformer_returns_the_values_of_its_cells_without_enlarging_them():
    # The library would enlarge by 4 with aligned corners, which shifts the maps by up to 1.5 px.
    model, values = build("segformer", smooth=False), []
    head = model.network.segmentation_head[0]
    head.register_forward_hook(lambda _, inputs, outputs: values.append((inputs[0], outputs)))
    maps = model(torch.rand(1, 3, 64, 96))
    features, outputs = values[0]
    assert features.shape[2:] == (16, 24)
    assert torch.equal(maps, outputs)
    expected = torch.einsum("oc,bchw->bohw", head.weight[:, :, 0, 0], features) + head.bias.view(1, -1, 1, 1)
    assert_close(maps, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.quick
@pytest.mark.parametrize("encoder", ["nonsense", "tu-nonsense"])
def test_an_unknown_encoder_is_named(encoder):
    with pytest.raises(ValueError, match=f"encoder must be a name of .*, got {encoder}"):
        ResUNet(2, encoder=encoder)


@pytest.mark.parametrize("shape", [(2, 4, 32, 32), (3, 32, 32)])
def test_an_image_without_three_colors_is_rejected(shape):
    with pytest.raises(ValueError, match=r"image must have shape \(B, 3, H, W\), got \("):
        build("segformer")(torch.rand(shape))


@pytest.mark.quick
@pytest.mark.parametrize("network", [LensNet(2, smooth=True), FogNet(3), conditions], ids=["lens", "fog", "denoiser"])
def test_bytes_are_rejected_by_every_network(network):
    with pytest.raises(TypeError, match=r"image must be floating in \[0, 1\], got torch.uint8; use images.float"):
        network(torch.zeros(1, 3, 32, 32, dtype=torch.uint8))
