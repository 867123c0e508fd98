import math
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample
from torch.testing import assert_close

from torchrefract import Pair
from torchrefract.restoration.checkpoints import CheckpointError, check_fits
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.targets import FlowTarget, ImageTarget, target_of
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort

SIZE = (6, 10)


def made(flow: Tensor) -> Pair:
    degraded, clean = torch.rand(2, 1, 3, *flow.shape[2:], generator=torch.Generator().manual_seed(0))
    return Pair(degraded, clean, flow, torch.ones_like(flow[:, :1], dtype=torch.bool), torch.zeros(1).long())


def companded(share: float) -> float:
    """The mu-law of 100, of a share of the limit."""
    return math.copysign(math.log(1 + 100 * abs(share)) / math.log(101), share)


def test_a_flow_of_the_largest_displacement_is_one_and_longer_ones_are_cut_off():
    flow = torch.zeros(1, 2, *SIZE)
    flow[0, :, 0, :4] = torch.tensor([[2.5, -1.25, 40, torch.nan], [1.5, 0.75, -40, torch.inf]])
    target = FlowTarget(0.25).encode(made(flow), SIZE)  # 0.25 x 10 px and 0.25 x 6 px
    half = companded(0.5)
    assert_close(target[0, :, 0, :4], torch.tensor([[1, -half, 1, 0], [1, half, -1, 1]]))
    assert not target[0, :, 1:].any()


def test_a_flow_of_a_crop_is_in_units_of_the_whole_frame():
    flow = torch.full((1, 2, 3, 5), 1.5)
    expected = torch.tensor([companded(0.3), companded(0.5)])
    assert_close(FlowTarget(0.5).encode(made(flow), (6, 10))[0, :, 0, 0], expected)


def test_what_a_denoiser_finds_beyond_the_limit_is_the_longest_flow_and_no_longer_one():
    found = torch.tensor([1.5, -30.0]).view(1, 2, 1, 1).expand(-1, -1, *SIZE)
    flow = FlowTarget(0.25).decode(found, torch.rand(1, 3, *SIZE), SIZE).flow
    assert flow is not None
    assert_close(flow[0, :, 0, 0], torch.tensor([2.5, -1.5]))


def test_an_encoded_flow_decodes_to_the_image_looked_up_along_it():
    flow = torch.rand(1, 2, *SIZE, generator=torch.Generator().manual_seed(1)) * 2 - 1
    pair, target = made(flow), FlowTarget(0.25)
    found = target.decode(target.encode(pair, SIZE), pair.degraded, SIZE)
    assert found.flow is not None
    assert_close(found.flow, flow)
    x = torch.arange(SIZE[1]) + flow[:, 0]
    y = torch.arange(SIZE[0])[:, None] + flow[:, 1]
    grid = torch.stack([(2 * x + 1) / SIZE[1] - 1, (2 * y + 1) / SIZE[0] - 1], dim=-1)
    assert_close(found.image, grid_sample(pair.degraded, grid, padding_mode="border", align_corners=False))


def test_weights_of_flows_as_they_are_do_not_fit_and_those_of_another_law_bring_it():
    model = Diffusion(lambda _: nn.Identity(), Undistort(0.25))
    state = model.state_dict()
    with pytest.raises(CheckpointError, match=r"got old\.ckpt, where target\.mu differs"):
        check_fits(
            {"state_dict": {name: value for name, value in state.items() if name != "target.mu"}},
            model,
            Path("old.ckpt"),
        )
    model.load_state_dict(state | {"target.mu": torch.tensor(255.0)})
    assert isinstance(model.target, FlowTarget)
    encoded = model.target.encode(made(torch.full((1, 2, *SIZE), 0.5)), SIZE)[0, :, 0, 0]
    expected = [math.log1p(255 * 0.5 / (0.25 * side)) / math.log1p(255) for side in reversed(SIZE)]
    assert_close(encoded, torch.tensor(expected))


def test_an_image_goes_from_minus_one_to_one_and_back():
    pair, target = made(torch.zeros(1, 2, *SIZE)), ImageTarget()
    encoded = target.encode(pair, SIZE)
    assert_close(encoded, pair.clean * 2 - 1)
    found = target.decode(encoded, pair.degraded, SIZE)
    assert found.flow is None
    assert_close(found.image, pair.clean)


def test_the_target_is_that_of_the_task_with_its_limit():
    flow = target_of(Undistort(0.1))
    assert isinstance(flow, FlowTarget)
    assert (flow.limit, flow.channels) == (0.1, 2)
    image = target_of(Deweather())
    assert isinstance(image, ImageTarget)
    assert image.channels == 3


class Other(Task):
    name, channels = "other", 1

    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        return Restored(degraded)

    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        return restored.image.mean()


def test_a_task_of_another_kind_is_named():
    with pytest.raises(TypeError, match="task must be Undistort or Deweather for a diffusion model, got Other"):
        target_of(Other())


def test_a_transmission_is_not_a_part_of_the_target():
    with pytest.raises(ValueError, match=r"task.transmission_head must be false for a diffusion model, got true"):
        target_of(Deweather(transmission_head=True))
