import math
from collections.abc import Callable
from functools import partial

import pytest
import torch
from pytorch_lightning import Callback, Trainer
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils.data import DataLoader

from torchrefract import LensDistortion, Pair, UniformFog
from torchrefract.data.module import make_pair
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.effects.base import Effect
from torchrefract.restoration.checkpoints import read_checkpoint
from torchrefract.restoration.models.resunet import ResUNet
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort
from torchrefract.types import Frame

SIZE = (32, 64)
BATCH = 4

# Advice of Lightning on how to train, which small trainings do not follow; LeafSpec is of its own code.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*no `val_dataloader`", "ignore:.*LeafSpec"
)


class Flat(nn.Module):
    """The least that can learn: one number for each channel."""

    def __init__(self, channels: int, *, smooth: bool = False):
        super().__init__()
        self.answer = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, image: Tensor) -> Tensor:
        return self.answer.expand(len(image), -1, *image.shape[2:])


def batches(count: int, effect: Effect, *, first: int = 0) -> list[Pair]:
    made = []
    for start in range(first, first + count * BATCH, BATCH):
        scenes = RoadScenes(BATCH, size=SIZE, first=start)
        frame = Frame(*(torch.stack(part) for part in zip(*(scenes[i] for i in range(BATCH)), strict=True)))
        made.append(make_pair(frame, effect, seed=start))
    return made


@pytest.fixture(scope="module")
def distorted():
    return batches(3, LensDistortion())


@pytest.fixture(scope="module")
def held():
    return batches(2, LensDistortion(), first=100)


def loader(pairs: list[Pair]) -> DataLoader[Pair]:
    return DataLoader(pairs, batch_size=None)  # pyright: ignore[reportArgumentType]  # a list is a map-style dataset


def mean_flow(pairs: list[Pair]) -> Tensor:
    """(2, H, W): the mean over the samples that are valid at a pixel, written the long way."""
    flow = torch.cat([pair.flow for pair in pairs]).double()
    valid = torch.cat([pair.valid for pair in pairs]).expand_as(flow)
    return flow.masked_fill(~valid, torch.nan).nanmean(dim=0).nan_to_num(0.0).float()


def test_the_constant_flow_is_the_mean_of_the_valid_flows_of_the_training(trainer, distorted, held):
    model = Restoration(Flat, Undistort())
    trainer(max_epochs=1).fit(model, loader(distorted), loader(held))
    found = model.constant_flow(torch.empty(2, 2, *SIZE))
    expected = mean_flow(distorted)
    assert not torch.cat([pair.valid for pair in distorted]).all()
    assert_close(found, expected.expand(2, -1, -1, -1), rtol=0, atol=1e-5)


def test_the_constant_flow_of_two_epochs_is_the_mean_of_both(trainer, distorted):
    model = Restoration(Flat, Undistort())
    trainer(max_epochs=2).fit(model, loader(distorted))
    assert_close(model.constant_flow(distorted[0].flow)[0], mean_flow(2 * distorted), rtol=0, atol=1e-5)


def test_the_constant_flow_of_nothing_seen_is_zero(distorted):
    model = Restoration(Flat, Undistort())
    assert torch.equal(model.constant_flow(distorted[0].flow), torch.zeros(BATCH, 2, *SIZE))


def test_garbage_in_an_invalid_pixel_changes_no_constant_flow(trainer, distorted):
    garbage = [pair._replace(flow=torch.where(pair.valid, pair.flow, 1e6)) for pair in distorted]
    model = Restoration(Flat, Undistort())
    trainer(max_epochs=1).fit(model, loader(garbage))
    assert_close(model.constant_flow(garbage[0].flow)[0], mean_flow(distorted), rtol=0, atol=1e-5)


def test_the_constant_flow_survives_a_checkpoint(trainer, distorted, tmp_path):
    model = Restoration(Flat, Undistort())
    run = trainer(max_epochs=1)
    run.fit(model, loader(distorted))
    run.save_checkpoint(tmp_path / "last.ckpt")
    assert read_checkpoint(tmp_path / "last.ckpt", task="undistort")["task"] == "undistort"
    again = Restoration(Flat, Undistort())
    trainer().validate(
        again, loader(distorted), ckpt_path=str(tmp_path / "last.ckpt"), verbose=False, weights_only=True
    )
    assert_close(again.constant_flow(distorted[0].flow)[0], mean_flow(distorted), rtol=0, atol=1e-5)
    assert_close(again.state_dict(), model.state_dict())


def lengths(pairs: list[Pair], flow: Tensor) -> float:
    """The mean endpoint error in px of 1920x1080, image by image."""
    scale = torch.tensor([1920 / SIZE[1], 1080 / SIZE[0]]).view(2, 1, 1)
    errors = []
    for pair in pairs:
        for target, valid in zip(pair.flow, pair.valid[:, 0], strict=True):
            errors.append(((flow - target) * scale).norm(dim=0)[valid].mean())
    return float(torch.stack(errors).mean())


def decibels(pairs: list[Pair], images: list[Tensor]) -> float:
    found = []
    for pair, batch in zip(pairs, images, strict=True):
        for clean, image, valid in zip(pair.clean, batch, pair.valid, strict=True):
            error = (clean - image)[valid.expand_as(clean)].square().mean()
            found.append(-10 * torch.log10(error))
    return float(torch.stack(found).mean())


def test_the_scores_of_the_rivals_are_those_of_doing_nothing_and_of_the_mean_flow(trainer, distorted, held):
    run = trainer(max_epochs=1)
    run.fit(Restoration(Flat, Undistort()), loader(distorted), loader(held))
    found = run.callback_metrics
    assert found["val/epe_identity"] == pytest.approx(lengths(held, torch.zeros(2, 1, 1)), rel=1e-4)
    assert found["val/epe_constant"] == pytest.approx(lengths(held, mean_flow(distorted)), rel=1e-4)
    assert found["val/psnr_identity"] == pytest.approx(decibels(held, [pair.degraded for pair in held]), abs=1e-3)
    assert found["val/epe_constant"] < found["val/epe_identity"]
    assert found["val/psnr_constant"] > found["val/psnr_identity"]


def test_a_network_that_does_nothing_scores_as_doing_nothing(trainer, held):
    run = trainer()
    run.validate(Restoration(Flat, Undistort()), loader(held), verbose=False)
    found = run.callback_metrics
    for score in ("psnr", "ssim", "epe"):
        assert found[f"val/{score}"] == pytest.approx(float(found[f"val/{score}_identity"]), rel=1e-5)


def test_the_endpoint_error_is_in_pixels_of_the_metric_size(trainer, held):
    native, quarter = trainer(), trainer()
    native.validate(Restoration(Flat, Undistort(), metric_size=[1080, 1920]), loader(held), verbose=False)
    quarter.validate(Restoration(Flat, Undistort(), metric_size=[270, 480]), loader(held), verbose=False)
    assert native.callback_metrics["val/epe"] == pytest.approx(4 * float(quarter.callback_metrics["val/epe"]), rel=1e-5)


def test_a_task_without_a_flow_has_no_endpoint_error(trainer):
    fog = batches(1, UniformFog())
    run = trainer(max_epochs=1)
    run.fit(Restoration(Flat, Deweather()), loader(fog), loader(fog))
    names = set(run.callback_metrics)
    assert {"val/psnr", "val/psnr_identity", "val/ssim", "val/ssim_identity", "val/loss", "train/loss"} <= names
    assert not [name for name in names if "epe" in name or "constant" in name]


class Rates(Callback):
    def __init__(self):
        self.seen: list[float] = []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self.seen.append(trainer.optimizers[0].param_groups[0]["lr"])


def test_the_learning_rate_warms_up_and_falls_along_a_cosine(trainer, distorted):
    rates, steps, warm = Rates(), 40, 4  # the warm-up is at most a tenth of a short run
    model = Restoration(Flat, Undistort(), lr=0.01, warmup_steps=50)
    trainer(max_epochs=4, callbacks=[rates]).fit(model, loader((distorted * 4)[:10]))
    rise = [0.01 * i / warm for i in range(warm)]
    fall = [0.005 * (1 + math.cos(math.pi * (i - warm) / (steps - warm))) for i in range(warm, steps)]
    assert rates.seen == pytest.approx(rise + fall)


def cost(task: Task, pair: Pair, flow: Tensor) -> float:
    """What a given flow would cost."""
    x = torch.arange(SIZE[1]) + flow[:, 0]
    y = torch.arange(SIZE[0])[:, None] + flow[:, 1]
    grid = torch.stack([(2 * x + 1) / SIZE[1] - 1, (2 * y + 1) / SIZE[0] - 1], dim=-1)
    image = nn.functional.grid_sample(pair.degraded, grid, padding_mode="border", align_corners=False)
    return float(task.loss(Restored(image, flow), pair))


def overfitted(trainer: Callable[..., Trainer], task: Task, pair: Pair, *, steps: int) -> float:
    """The loss of a small network that has seen one batch, and nothing else, for some steps."""
    torch.manual_seed(0)
    model = Restoration(partial(ResUNet, encoder="tu-resnet10t"), task, lr=2e-3, warmup_steps=5)
    trainer(max_epochs=1).fit(model, loader([pair] * steps))
    with torch.no_grad():
        return float(task.loss(model.train()(pair.degraded), pair))


def test_an_undistorter_that_overfits_one_batch_beats_every_flow_that_does_not_look(trainer, distorted):
    pair, task = distorted[0], Undistort()
    nothing, perfect = cost(task, pair, torch.zeros_like(pair.flow)), cost(task, pair, pair.flow)
    constant = cost(task, pair, mean_flow([pair]).expand_as(pair.flow))
    found = overfitted(trainer, task, pair, steps=50)
    assert perfect < found < constant < nothing


def test_a_deweatherer_that_overfits_one_batch_beats_every_offset(trainer):
    pair, task = batches(1, UniformFog())[0], Deweather()
    error = (pair.clean - pair.degraded).flatten(2)
    offset = (error - error.median(dim=2, keepdim=True).values).abs().mean()  # the best that a shift of color can do
    found = overfitted(trainer, task, pair, steps=25)
    assert found < 0.75 * offset < 0.75 * error.abs().mean()


def test_training_is_the_same_from_the_same_seed(trainer, distorted):
    found = []
    for _ in range(2):
        torch.manual_seed(3)
        model = Restoration(partial(ResUNet, encoder="tu-resnet10t"), Undistort())
        trainer(max_epochs=1).fit(model, loader(distorted))
        found.append(model.state_dict())
    assert_close(found[0], found[1], rtol=0, atol=1e-6)
