import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.restoration.models.lens_net import Edges, LensNet, concentration, find_edges, undistorted_lines

SIZE = (96, 168)


def build(**options: int) -> LensNet:
    """Build a small network; a random last layer stands for training."""
    torch.manual_seed(0)
    model = LensNet(2, smooth=True, weightings=2, **options).eval()
    torch.nn.init.normal_(model.head.layers[-1].weight, std=0.1)  # pyright: ignore[reportArgumentType]  # a linear layer
    return model


def distorted(x: Tensor, y: Tensor, strength: float) -> tuple[Tensor, Tensor]:
    """Invert q / (1 + lambda |q|^2) = p, for lambda < 0, where the smaller root is that of a lens."""
    r2 = x * x + y * y
    scale = 2 / (1 + (1 - 4 * strength * r2).sqrt())
    return x * scale, y * scale


def edges_of_lines(strength: float, *, count: int = 12, points: int = 40) -> tuple[Edges, Tensor, Tensor]:
    """Return the distorted edges of random straight lines, and their true angles and offsets."""
    random = torch.Generator().manual_seed(0)
    angle = math.pi * torch.rand(count, 1, generator=random, dtype=torch.float64)
    offset = 0.25 * torch.randn(count, 1, generator=random, dtype=torch.float64)
    along = torch.linspace(-0.3, 0.3, points, dtype=torch.float64)

    def at(along: Tensor) -> tuple[Tensor, Tensor]:
        x, y = offset * angle.cos() - along * angle.sin(), offset * angle.sin() + along * angle.cos()
        return distorted(x, y, strength)

    (x, y), (next_x, next_y) = at(along), at(along + 1e-6)
    normal = torch.atan2(next_y - y, next_x - x) - math.pi / 2
    edges = Edges(*(value.reshape(1, -1) for value in (x, y, normal, torch.ones_like(x))))
    return edges, angle.expand_as(x).reshape(1, -1), offset.expand_as(x).reshape(1, -1)


@pytest.mark.parametrize("degrees", [10, 80, 130, 200])
def test_an_edge_has_the_place_and_the_direction_of_a_step_in_the_image(degrees):
    height, width = SIZE
    angle, offset = math.radians(degrees), 0.04
    y, x = torch.meshgrid(torch.arange(height) - 47.5, torch.arange(width) - 83.5, indexing="ij")
    step = (x * math.cos(angle) + y * math.sin(angle)) / width - offset
    edges, features = find_edges((0.5 + 0.3 * (step * width).clamp(-0.5, 0.5)).expand(1, 3, -1, -1))
    assert features.shape == (1, 12, 24, 42)
    strong = edges.strength[0] > 0.5
    assert strong.sum() > 20
    found, place = edges.angle[0, strong], (edges.x[0, strong], edges.y[0, strong])
    assert float(torch.sin(found - angle).abs().max()) < math.sin(math.radians(2.5))
    distance = place[0] * math.cos(angle) + place[1] * math.sin(angle) - offset
    # A cell at the flank of an edge sees only that flank, so that the positions are right on average.
    assert float(distance.abs().max()) < 1.5 / width
    assert float(distance.mean().abs()) < 0.2 / width


@pytest.mark.quick
def test_a_flat_image_has_no_edges():
    edges, _ = find_edges(torch.full((1, 3, 30, 50), 0.4))
    assert edges.strength.shape == (1, 8 * 13)
    assert float(edges.strength.abs().max()) < 1e-3


@pytest.mark.parametrize("resized", [False, True])
def test_a_black_border_adds_no_edges(resized):
    random = torch.Generator().manual_seed(0)
    image = 0.3 + 0.4 * torch.rand(1, 3, *SIZE, generator=random)
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
    shown = x * x + y * y < 1.1
    bordered = torch.where(shown, image, 0.0)
    if resized:  # which makes pixels at the border of the padding gray
        bordered = torch.nn.functional.interpolate(bordered, scale_factor=0.5, mode="bilinear", antialias=True)
        image = torch.nn.functional.interpolate(image, scale_factor=0.5, mode="bilinear", antialias=True)
    (edges, _), (with_border, _) = find_edges(image), find_edges(bordered)
    kept = with_border.strength > 0
    assert kept.float().mean() > 0.4
    assert kept.float().mean() < 0.9
    inside = edges.x.square() * 4 + (edges.y * 2 * SIZE[1] / SIZE[0]).square() < 0.6
    for value, expected in zip(with_border, edges, strict=True):
        assert_close(value[inside], expected[inside])
    assert not kept[edges.x.square() * 4 + (edges.y * 2 * SIZE[1] / SIZE[0]).square() > 1.0].any()


@pytest.mark.parametrize("strength", [0.0, -0.2, -0.7])
def test_the_lens_of_bent_lines_makes_them_straight(strength):
    edges, angle, offset = edges_of_lines(strength)
    got_angle, got_offset = undistorted_lines(edges, strength)
    assert got_angle.min() >= 0
    assert got_angle.max() <= math.pi
    # (angle, offset) and (angle + pi, -offset) are the same line.
    for component in (torch.cos, torch.sin):
        assert_close(got_offset * component(got_angle), offset * component(angle), rtol=0, atol=1e-4)
    assert_close(torch.cos(2 * (got_angle - angle)), torch.ones_like(angle), rtol=0, atol=1e-6)


@pytest.mark.parametrize("strength", [0.0, -0.3, -0.6])
def test_votes_concentrate_most_for_the_lens_of_the_lines(strength):
    edges, *_ = edges_of_lines(strength)
    edges = Edges(*(value.float() for value in edges))
    lenses = [0.0, -0.15, -0.3, -0.45, -0.6, -0.75]
    values = torch.stack([concentration(edges, torch.ones(1, 1, edges.x.shape[1]), lens) for lens in lenses])
    assert lenses[int(values.argmax())] == strength
    one = Edges(*(value[:, :1] for value in edges))
    twice = torch.cat([torch.ones(1, 1, 1), torch.full((1, 1, 1), 7.0)], dim=1)
    alone = concentration(one, twice, 0.0)
    assert_close(alone[:, 0], alone[:, 1])  # shares of the votes have no scale
    assert -math.log(4) - 1e-4 <= float(alone[0, 0]) <= 1e-4  # one vote falls into one bin to four bins


@torch.no_grad()
@pytest.mark.parametrize("size", [(33, 17), (64, 112), (1, 1)])
def test_an_untrained_network_predicts_zero_and_a_trained_one_varies_over_a_frame_of_any_size(size):
    image, cells = torch.rand(2, 3, *size), (-(-size[0] // 4), -(-size[1] // 4))
    assert torch.equal(LensNet(2, smooth=True)(image), torch.zeros(2, 2, *cells))
    maps = build()(image)
    assert maps.shape == (2, 2, *cells)
    assert maps.isfinite().all()
    with torch.autocast("cpu", torch.bfloat16):
        assert_close(build()(image), maps)


def test_images_of_a_batch_are_independent_and_gradients_reach_every_weight():
    model, images = build(), torch.rand(3, 3, *SIZE)
    together = model(images)
    assert_close(model(images[1:2]), together[1:2], rtol=0, atol=1e-5)
    together.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"smooth": False}, r"task must predict a flow for lens_net, as undistort does: add model=resunet"),
        ({"smooth": True, "weightings": 0}, "weightings must be at least 1, got 0"),
        ({"smooth": True, "lenses": 1}, "lenses must be at least 2, got 1"),
        ({"smooth": True, "edges": 0}, "edges must be at least 1, got 0"),
    ],
)
def test_invalid_options_raise(options, message):
    with pytest.raises(ValueError, match=message):
        LensNet(2, **options)
    with pytest.raises(ValueError, match=r"image must have shape \(B, 3, H, W\), got \(3, 8, 8\)"):
        build()(torch.rand(3, 8, 8))
