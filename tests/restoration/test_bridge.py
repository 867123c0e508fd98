from functools import partial

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import Pair, UniformFog
from torchrefract.restoration.bridge import Bridge
from torchrefract.restoration.models.denoiser import Denoiser
from torchrefract.restoration.tasks import Deweather, Undistort

pytestmark = pytest.mark.filterwarnings(  # Lightning warns of small trainings, and of its own code (LeafSpec)
    "ignore:.*does not have many workers", "ignore:.*no `val_dataloader", "ignore:.*LeafSpec"
)

tiny = partial(Denoiser, widths=(8, 16), attention=(False, True), layers=1, groups=4)


class Linear(nn.Module):
    """A linear function in place of a network; it keeps its inputs."""

    def __init__(self, _: int):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.3))
        self.inputs: list[tuple[Tensor, Tensor, Tensor]] = []

    def forward(self, image: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        self.inputs.append((image.detach(), time, condition))
        return self.factor * image - 0.1 * condition[:, :3] + time.view(-1, 1, 1, 1) / 5000


@pytest.fixture
def pairs(make_batches) -> list[Pair]:
    return make_batches(UniformFog(visibility_range=(40, 60)), 4, size=(16, 24))


def test_the_loss_is_the_error_of_the_change_between_clean_and_degraded(trainer, pairs, loader, losses):
    pair, model, kept = pairs[0], Bridge(Linear, Deweather()), losses()
    trainer(max_epochs=1, callbacks=[kept]).fit(model, loader([pair]))
    (image, time, condition) = model.network.inputs[0]  # pyright: ignore[reportAttributeAccessIssue, reportIndexIssue]  # a Linear
    share = time.double().view(-1, 1, 1, 1) / 999  # t
    expected = 2 * ((1 - share) * pair.clean + share * pair.degraded) - 1
    assert (image - expected).abs().max() < 2 / 999  # t is rounded to a level of the network
    assert len(set(time.tolist())) > 1
    assert_close(condition[:, :3], 2 * pair.degraded - 1)
    change = 0.3 * image - 0.1 * (2 * pair.degraded - 1) + time.view(-1, 1, 1, 1) / 5000
    assert kept.values == [pytest.approx((change - (pair.clean - pair.degraded)).abs().mean().item(), rel=1e-4)]


@pytest.mark.parametrize("steps", [1, 3])
def test_a_restoration_follows_the_predicted_change_in_equal_steps(steps):
    degraded = torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(0))
    expected = degraded
    for k in range(steps):
        time = round((1 - k / steps) * 999)
        change = 0.3 * (2 * expected - 1) - 0.1 * (2 * degraded - 1) + time / 5000
        expected = expected + change / steps
    assert_close(Bridge(Linear, Deweather(), steps=steps)(degraded).image, expected)


def test_training_lowers_the_error_below_that_of_doing_nothing(trainer, pairs, loader):
    torch.manual_seed(0)
    model = Bridge(tiny, Deweather(), lr=5e-3)
    trainer(max_epochs=12).fit(model, loader(pairs))
    pair = pairs[0]
    errors = [(image - pair.clean).abs().mean().item() for image in (model(pair.degraded).image, pair.degraded)]
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"task": Undistort()}, TypeError, "task must be Deweather for Bridge: add model=ddpm for a lens, got Undist"),
        ({"task": Deweather(transmission_head=True)}, ValueError, "task.transmission_head must be false"),
        ({"steps": 0}, ValueError, "steps must be at least 1, got 0"),
    ],
)
def test_an_invalid_option_is_named(options, error, message):
    with pytest.raises(error, match=message):
        Bridge(Linear, **({"task": Deweather()} | options))
