import re
from functools import partial
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import LensDistortion, Pair
from torchrefract._validation import UsageError
from torchrefract.restoration.flow_diffusion import FlowDiffusion, fit_polynomial
from torchrefract.restoration.models.coordconv import cell_axes, polynomial_basis
from torchrefract.restoration.models.denoiser import LensDenoiser
from torchrefract.restoration.models.lens_net import LENS_FEATURES
from torchrefract.restoration.tasks import Deweather, Undistort

SIZE = (24, 40)
DEVIATIONS = 0.3, 1.0  # of what the frames of the toy problem tell of the strength of their lens
small = partial(LensDenoiser, weightings=2, lenses=3)


class FirstPixel(nn.Module):
    """Describe a frame by its first pixel."""

    def forward(self, image: Tensor) -> tuple[Tensor, None]:
        return F.pad(image[:, :, :1, :1], (0, 0, 0, 0, 0, LENS_FEATURES - 3)), None


def toy(first: int, count: int) -> tuple[Pair, Tensor]:
    """Return lenses of normal strength, which the first pixel tells with a deviation that it tells too.

    The second value is the mean and the deviation of the flow in the corner given the pixel, by Bayes' rule, (B, 2).
    """
    strength, noise = torch.randn(2, count, generator=torch.Generator().manual_seed(first))
    deviation = torch.tensor(DEVIATIONS)[torch.arange(count) % 2]
    seen, variance = strength + deviation * noise, deviation.square()
    image = torch.zeros(count, 3, *SIZE)
    image[:, :2, 0, 0] = torch.stack([seen, deviation], dim=1)
    x, y = cell_axes(image, 1)
    radial = torch.stack([x.expand(SIZE), y[:, None].expand(SIZE)]) * (x.square() + y[:, None].square())
    unit = radial * torch.tensor([SIZE[1], SIZE[0]]).view(2, 1, 1) / 20  # px
    valid = torch.ones(count, 1, *SIZE, dtype=torch.bool)
    posterior = torch.stack([-seen / (1 + variance), (variance / (1 + variance)).sqrt()], dim=1)
    pair = Pair(image, image, strength.view(-1, 1, 1, 1) * unit, valid, torch.arange(first, first + count))
    return pair, posterior * unit[0, 0, 0].abs()


@pytest.mark.filterwarnings(  # of Lightning: a small training, its own code
    "ignore:.*does not have many workers", "ignore:.*LeafSpec"
)
def test_two_deviations_of_a_lens_of_known_posterior_cover_95_percent_in_4_steps(trainer, loader):
    torch.manual_seed(0)
    model = FlowDiffusion(small, Undistort(0.25), components=1, ema_decay=0.98, lr=1e-2)
    model.network.encoder = FirstPixel()
    run, (pair, posterior) = trainer(max_epochs=1), toy(10**6, 600)
    run.fit(model, loader([toy(64 * i, 64)[0] for i in range(250)]), loader([pair]))
    assert float(run.callback_metrics["val/coverage"]) == pytest.approx(0.95, abs=0.03)
    restored = model.eval()(pair.degraded, pair.key)
    assert restored.flow is not None
    assert restored.deviation is not None
    covered = (restored.flow - pair.flow).abs() <= 2 * restored.deviation
    for rows in (slice(0, None, 2), slice(1, None, 2)):
        assert float(covered[rows].float().mean()) == pytest.approx(0.95, abs=0.05)
        mean, deviation = restored.flow[rows, 0, 0, 0], restored.deviation[rows, 0, 0, 0]
        assert float(deviation.mean()) == pytest.approx(float(posterior[rows, 1].mean()), rel=0.2)
        assert (mean - posterior[rows, 0]).square().mean().sqrt() < 0.7 * posterior[rows, 1].mean()


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec")  # as above
def test_a_first_batch_with_too_few_lenses_for_the_components_is_an_error(trainer, loader):
    model = FlowDiffusion(small, Undistort(0.25), components=4)
    model.network.encoder = FirstPixel()
    message = (
        "data.batch_size must be above model.components=4, which are those of the lenses of the first batch, got 4"
    )
    with pytest.raises(UsageError, match=re.escape(message)):
        trainer(max_steps=1).fit(model, loader([toy(0, 4)[0]]), loader([toy(0, 4)[0]]))
    trainer(max_steps=1).fit(model, loader([toy(0, 5)[0]]), loader([toy(0, 4)[0]]))
    assert (model.components.square().sum(dim=1) > 0).all()


def test_coefficients_hold_the_flow_of_a_lens_also_where_it_is_not_valid(make_batches):
    batch = make_batches(LensDistortion(), 2, size=(96, 160))[0]
    coefficients = fit_polynomial(batch).unflatten(1, (2, -1))
    flow = torch.einsum("bct,thw->bchw", coefficients, polynomial_basis(*cell_axes(batch.flow, 1)))
    error = (flow * torch.tensor([160.0, 96.0]).view(2, 1, 1) - batch.flow).norm(dim=1, keepdim=True)
    assert batch.valid.float().mean() < 0.99
    assert error[batch.valid].mean() < 0.03 * batch.flow.norm(dim=1)[batch.valid[:, 0]].mean()


def test_a_sample_depends_on_its_key_alone_and_a_single_one_has_no_deviation():
    torch.manual_seed(0)
    model = FlowDiffusion(small, Undistort(0.1), components=3, samples=5, seed=3).eval()
    nn.init.normal_(model.components, std=0.01)
    image = torch.rand(3, 3, *SIZE)
    restored, alone = model(image, torch.tensor([5, 6, 7])), model(image[2:], torch.tensor([7]))
    for value, same in ((restored.flow, alone.flow), (restored.deviation, alone.deviation)):
        assert_close(same, value[2:], rtol=1e-4, atol=1e-4)
        assert value.abs().mean() > 1e-3
    with torch.autocast("cpu", torch.bfloat16):
        assert_close(model(image, torch.tensor([5, 6, 7])).flow, restored.flow, rtol=1e-3, atol=1e-4)
    assert model.has_deviation
    model.samples = 1
    assert not model.has_deviation
    assert model(image).deviation is None


def test_an_untrained_denoiser_knows_only_that_the_numbers_are_standard_normal():
    torch.manual_seed(0)
    network = small(4).eval()
    noisy, share = torch.randn(2, 5, 4), torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9]).view(1, 5, 1).expand(2, -1, -1)
    mean, deviation = network(noisy, share, network.encode(torch.rand(2, 3, 33, 97)))
    assert_close(mean, share.sqrt() * noisy)  # of z given sqrt(a) z + sqrt(1 - a) noise
    assert_close(deviation, (1 - share).sqrt().expand_as(noisy))


def test_another_task_and_invalid_numbers_raise():
    with pytest.raises(TypeError, match="task must be Undistort for FlowDiffusion: add model=bridge"):
        FlowDiffusion(small, Deweather())
    invalid: list[tuple[dict[str, Any], str]] = [
        ({"steps": 1001}, "steps must be at most"),
        ({"samples": 0}, "samples must"),
        ({"components": 43}, "components must be at most 42, got 43"),
    ]
    for options, rule in invalid:
        with pytest.raises(ValueError, match=rule):
            FlowDiffusion(small, Undistort(0.1), **options)
