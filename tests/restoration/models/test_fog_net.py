import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import GroundPlaneDepth, UniformFog
from torchrefract.restoration.export import trace
from torchrefract.restoration.inference import FullSizeModel
from torchrefract.restoration.models.fog_net import FogNet, airlight_in_fog
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.tasks import Deweather

SIZE = (48, 80)


def build(channels: int = 3) -> FogNet:
    """Build a small network; a random last layer stands for training."""
    torch.manual_seed(0)
    model = FogNet(channels, width=4).eval()
    torch.nn.init.normal_(model.head.weight, std=0.1)
    return model


def picture(batch: int = 2, size: tuple[int, int] = SIZE) -> Tensor:
    return torch.rand(batch, 3, *size, generator=torch.Generator().manual_seed(0))


@pytest.mark.quick
@pytest.mark.parametrize("airlight", [(0.9, 0.9, 0.9), (0.7, 0.75, 0.85), (0.3, 0.28, 0.25)])
def test_the_airlight_is_that_of_the_fog_around_a_road(airlight):
    fog = UniformFog(visibility_range=(60.0, 60.0), airlight=airlight, depth=GroundPlaneDepth())
    road = 0.8 * min(airlight) * picture(3, (96, 160))
    road[:, :, 70:75, 80:84] = 1.0  # a white car: small bright things are no fog
    estimate = airlight_in_fog(fog.degrade(road, seed=0).image)
    assert_close(estimate, torch.tensor(airlight).expand(3, -1), rtol=0, atol=0.01)


def test_the_airlight_has_the_gradient_of_its_equation():
    image = picture(1, (9, 14)).double().requires_grad_()
    assert torch.autograd.gradcheck(airlight_in_fog, image)


@pytest.mark.quick
@pytest.mark.parametrize("size", [SIZE, (33, 57), (1, 1)])
def test_maps_have_the_size_of_the_image_and_start_at_zero(size):
    assert torch.equal(FogNet(4, width=4).eval()(picture(2, size)), torch.zeros(2, 4, *size))
    maps = build(4)(picture(2, size))
    assert maps.shape == (2, 4, *size)
    assert maps.isfinite().all()


@pytest.mark.quick
@pytest.mark.parametrize("t", [0.05, 0.4])
def test_a_constant_gain_restores_what_fog_left(t):
    model, image = build(), picture()
    bias = torch.zeros(1 + 3)
    bias[0] = -math.log(t)
    model.head.load_state_dict({"weight": torch.zeros_like(model.head.weight), "bias": bias})
    airlight = airlight_in_fog(image)[:, :, None, None]
    foggy = airlight + t * (image - airlight)
    fog_of_all = airlight_in_fog(foggy)[:, :, None, None]
    assert_close(foggy + model(foggy), fog_of_all + (foggy - fog_of_all) / t)


@pytest.mark.quick
@pytest.mark.parametrize("light", [(0.8, 0.9, 1.0), (1.0, 0.9, 0.8), (0.5, 0.5, 0.5)])
def test_the_color_of_the_light_and_the_exposure_pass_through(light):
    model, image, gain = build(4), 0.3 * picture(), torch.tensor(light)[:, None, None]
    image[:, :, : SIZE[0] // 2] = 0.9  # fog, which gives the airlight
    change, transmission = model(image).split([3, 1], dim=1)
    of_other_light = model(gain * image)
    assert change.abs().max() > 0.05
    assert_close(of_other_light, torch.cat([gain * change, transmission], dim=1), rtol=0, atol=1e-3)


def test_every_weight_and_the_image_have_a_gradient():
    model, image = build().train(), picture().requires_grad_()
    model(image).square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in model.parameters())
    assert image.grad is not None
    assert image.grad.isfinite().all()
    assert image.grad.abs().sum() > 0


def test_invalid_arguments_are_named():
    with pytest.raises(ValueError, match="width must be at least 1, got 0"):
        FogNet(3, width=0)
    with pytest.raises(ValueError, match=r"channels must be .* got 2"):
        FogNet(2)
    with pytest.raises(ValueError, match=r"smooth must be False for fog_net, .* got True: use model=lens_net"):
        FogNet(2, smooth=True)
    with pytest.raises(ValueError, match=r"image must have shape \(B, 3, H, W\), got \(1, 1, 8, 8\)"):
        FogNet(3)(torch.zeros(1, 1, 8, 8))


def test_a_program_of_torch_export_agrees_with_the_model_at_the_size_of_a_frame():
    model = Restoration(lambda channels, smooth: build(channels), Deweather()).eval()
    network, frames = FullSizeModel(model, size=SIZE).eval(), picture(3, (60, 100))
    program = trace(network.to(memory_format=torch.contiguous_format), frames[:2])  # pyright: ignore[reportCallIssue]  # missing in torch's annotations
    with torch.no_grad():
        (expected,) = network(frames)
        (restored,) = program.module()(frames)
    assert_close(restored, expected, rtol=0, atol=1e-4)
    assert (expected - frames).abs().mean() > 1e-3
