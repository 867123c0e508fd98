from typing import Any, NamedTuple

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import LensDistortion
from torchrefract.restoration.diffusion import NUM_LEVELS
from torchrefract.restoration.flow_diffusion import FlowDiffusion
from torchrefract.restoration.models.denoiser import LatticeDenoiser, lattice_size
from torchrefract.restoration.tasks import Deweather, Undistort

SIZE = (48, 80)


class Condition(NamedTuple):
    guess: Tensor


class Known(nn.Module):
    """A denoiser that knows the target; with a spread, it adds a part of the noise that is left."""

    def __init__(self, channels: int):
        super().__init__()
        self.target, self.spread = torch.zeros(1, channels, 1, 1), 0.0

    def encode(self, image: Tensor) -> Condition:
        return Condition(self.target.expand(len(image), -1, *lattice_size(image)))

    def forward(self, noisy: Tensor, time: Tensor, condition: Condition) -> Tensor:
        return condition.guess + self.spread * noisy


@pytest.fixture
def model() -> FlowDiffusion:
    model = FlowDiffusion(Known, Undistort(0.1), seed=3)
    model.deviation.fill_(0.05)
    return model


def test_nodes_hold_the_flow_of_a_lens_to_three_hundredths(model, make_batches):
    size = (96, 160)
    batch = make_batches(LensDistortion(), 2, size=size)[0]
    target, valid = model._encode(batch)
    assert target.shape[2:] == valid.shape[2:] == (7, 11)
    assert 0.1 < target.abs().mean() < 10  # about unit deviation
    decoded = model._decode(target, batch.degraded)
    # A cubic through a node whose flow is unknown is wrong up to two nodes away.
    inner = -F.max_pool2d(-valid.float(), 3, stride=1, padding=1)
    known = F.interpolate(inner, size, mode="bilinear", align_corners=True) == 1
    error = (decoded - batch.flow).norm(dim=1, keepdim=True)[batch.valid & known]
    assert known.float().mean() > 0.1
    assert error.mean() < 0.03 * batch.flow.norm(dim=1)[batch.valid[:, 0]].mean()


def test_samples_of_a_known_flow_are_it_without_a_spread(model):
    model.network.target = torch.tensor([0.7, -0.4]).view(1, 2, 1, 1)
    image = torch.rand(2, 3, *SIZE)
    flow, deviation = model.flow_and_deviation(image, torch.tensor([5, 6]))
    assert_close(flow[:, 0], torch.full((2, *SIZE), 0.7 * 0.05 * 80), rtol=1e-3, atol=0)
    assert_close(flow[:, 1], torch.full((2, *SIZE), -0.4 * 0.05 * 48), rtol=1e-3, atol=0)
    assert deviation.max() < 1e-3
    assert_close(model(image, torch.tensor([5, 6])).flow, flow)


def test_a_sample_depends_on_its_key_alone_and_noise_shows_in_the_deviation(model):
    model.network.spread = 0.5
    image = torch.rand(3, 3, *SIZE)
    flow, deviation = model.flow_and_deviation(image, torch.tensor([5, 6, 7]))
    alone, _ = model.flow_and_deviation(image[2:], torch.tensor([7]))
    assert_close(alone, flow[2:], rtol=1e-4, atol=1e-4)
    assert deviation.mean() > 1e-3
    model.samples = 1
    assert not model.flow_and_deviation(image, torch.tensor([5, 6, 7]))[1].any()


def test_the_noise_is_the_shift_times_that_of_the_cosine_schedule():
    levels, plain = (FlowDiffusion(Known, Undistort(0.1), shift=s).levels.alphas_cumprod for s in (16.0, 1.0))
    ratio = ((1 - levels) / levels / ((1 - plain) / plain)).sqrt()
    assert len(levels) == NUM_LEVELS
    assert_close(ratio[10:900], torch.full((890,), 16.0), rtol=1e-2, atol=0)


def test_an_untrained_denoiser_predicts_no_flow_and_every_size_fits():
    torch.manual_seed(0)
    network = LatticeDenoiser(2, widths=(32, 32), weightings=2, lenses=3).eval()
    for size in (SIZE, (33, 97)):
        image = torch.rand(2, 3, *size)
        noisy = torch.randn(2, 2, *lattice_size(image))
        predicted = network(noisy, torch.tensor([3, 900]), network.encode(image))
        assert predicted.shape == noisy.shape
        assert not predicted.any()


def test_another_task_and_invalid_numbers_raise():
    with pytest.raises(TypeError, match="task must be Undistort for FlowDiffusion: add model=ddpm_image"):
        FlowDiffusion(Known, Deweather())
    invalid: list[tuple[dict[str, Any], str]] = [
        ({"steps": 1001}, "steps must be at most"),
        ({"samples": 0}, "samples must"),
        ({"shift": 0.0}, "shift must"),
    ]
    for options, rule in invalid:
        with pytest.raises(ValueError, match=rule):
            FlowDiffusion(Known, Undistort(0.1), **options)
