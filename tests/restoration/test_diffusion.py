from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from pytorch_lightning import Callback, LightningModule
from torch import Tensor, nn
from torch.nn.functional import grid_sample
from torch.testing import assert_close
from torch.utils.data import DataLoader

from torchrefract import LensDistortion, Pair, UniformFog
from torchrefract.data.module import make_pair
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.restoration.checkpoints import read_checkpoint
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.finite import NotFiniteError
from torchrefract.restoration.models.denoiser import Denoiser
from torchrefract.restoration.tasks import Deweather, Undistort
from torchrefract.types import Frame

SIZE = (16, 24)
KEPT = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
TASKS = {"undistort": Undistort(0.1), "deweather": Deweather()}

# Advice of Lightning on how to train, which small trainings do not follow; LeafSpec is of its own code.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*no `val_dataloader`", "ignore:.*LeafSpec"
)

tiny = partial(Denoiser, widths=(8, 16), attention=(False, True), layers=1, groups=4)


class Guess(nn.Module):
    """A network that is not one: what it finds follows from what it is given, which is kept."""

    def __init__(self, channels: int):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.7))
        self.given: list[tuple[Tensor, Tensor, Tensor]] = []

    def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        self.given.append((noisy.detach(), time, condition))
        return self.factor * noisy + 0.1 * condition[:, : noisy.shape[1]]


class Broken(Guess):
    def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        return super().forward(noisy, time, condition) * torch.nan


def guess(model: LightningModule) -> Guess:
    """The network of a model that guesses."""
    assert isinstance(model.network, Guess)
    return model.network


def pairs(task: str, count: int = 2, *, first: int = 0, size: tuple[int, int] = SIZE, batch: int = 4) -> list[Pair]:
    effect = LensDistortion(k1_range=(-0.2, 0.2)) if task == "undistort" else UniformFog()
    made = []
    for start in range(first, first + count * batch, batch):
        scenes = RoadScenes(batch, size=size, first=start)
        frame = Frame(*(torch.stack(part) for part in zip(*(scenes[i] for i in range(batch)), strict=True)))
        made.append(make_pair(frame, effect, seed=start))
    return made


def loader(batches: list[Pair]) -> DataLoader[Pair]:
    return DataLoader(batches, batch_size=None)  # pyright: ignore[reportArgumentType]  # a list is a map-style dataset


class Losses(Callback):
    """The loss of each step of a training."""

    def __init__(self):
        self.seen: list[float] = []

    def on_train_batch_end(self, trainer, pl_module, outputs: Any, batch, batch_idx) -> None:
        self.seen.append(float(outputs["loss"]))


def numpy_warp(image: Tensor, flow: np.ndarray) -> np.ndarray:
    height, width = image.shape[2:]
    x, y = np.arange(width) + flow[:, 0], np.arange(height)[:, None] + flow[:, 1]
    grid = torch.from_numpy(np.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], axis=-1))
    return grid_sample(image.double(), grid, padding_mode="border", align_corners=False).numpy()


def expected_loss(model: Diffusion, pair: Pair, *, size: tuple[int, int]) -> float:
    """0.8 |found - noise|_1 + a |restored - clean|^2 on the valid pixels, from what the network was given, in NumPy."""
    noisy, time, condition = (value.double().numpy() for value in guess(model).given[-1])
    kept = KEPT[time.astype(int)].reshape(-1, 1, 1, 1)
    unit = 0.1 * np.array([size[1], size[0]]).reshape(1, 2, 1, 1)
    flow = pair.flow.double().numpy()
    lens = model.task.name == "undistort"
    share = np.clip(flow / unit, -1, 1)
    companded = np.sign(share) * np.log(1 + 100 * np.abs(share)) / np.log(101)
    target = companded if lens else 2 * pair.clean.double().numpy() - 1
    noise = (noisy - np.sqrt(kept) * target) / np.sqrt(1 - kept)
    predicted = 0.7 * noisy + 0.1 * condition[:, : noisy.shape[1]]
    # The velocity is the derivative by the angle of (signal, spread) = (cos, sin); the inverse of that rotation.
    found, origin = predicted, (noisy - np.sqrt(1 - kept) * predicted) / np.sqrt(kept)
    if model.prediction == "v_prediction":
        rotation = np.stack(
            [np.stack([np.sqrt(kept), -np.sqrt(1 - kept)]), np.stack([np.sqrt(1 - kept), np.sqrt(kept)])]
        )
        origin, found = (row[0] * noisy + row[1] * predicted for row in rotation)
    expanded = np.sign(origin) * (101 ** np.clip(np.abs(origin), 0, 1) - 1) / 100
    restored = numpy_warp(pair.degraded, expanded * unit) if lens else (origin + 1) / 2
    losses = []
    for i, valid in enumerate(pair.valid[:, 0].numpy()):
        first = np.abs(found[i] - noise[i])[:, valid].mean()
        second = ((restored[i] - pair.clean[i].double().numpy()) ** 2)[:, valid].mean()
        losses.append(0.8 * first + kept[i, 0, 0, 0] * second)
    return float(np.mean(losses))


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize("task", TASKS)
def test_the_loss_is_its_formula_on_the_valid_pixels(trainer, task, prediction):
    (pair,) = pairs(task, 1)
    assert bool(pair.valid.all()) == (task == "deweather")
    model, losses = Diffusion(Guess, TASKS[task], prediction=prediction), Losses()
    trainer(max_epochs=1, callbacks=[losses]).fit(model, loader([pair]))
    assert losses.seen == [pytest.approx(expected_loss(model, pair, size=SIZE), rel=2e-4)]


@pytest.mark.parametrize("task", TASKS)
def test_a_crop_is_one_place_of_all_maps_and_look_ups_that_leave_it_do_not_count(trainer, task):
    (pair,) = pairs(task, 1, size=(20, 32), batch=8)
    model, losses = Diffusion(Guess, TASKS[task], crop=12), Losses()
    trainer(max_epochs=1, callbacks=[losses]).fit(model, loader([pair]))
    condition = guess(model).given[0][2]
    assert condition.shape == (8, 5, 12, 12)
    # Where a crop lies is told by the coordinates of its first pixel, which are those of the whole frame.
    left = ((condition[:, 3, 0, 0] + 1) * 32 - 1) / 2
    top = ((condition[:, 4, 0, 0] + 1) * 20 - 1) / 2
    corners = [(round(y), round(x)) for y, x in zip(top.tolist(), left.tolist(), strict=True)]
    assert len({*corners}) > 4
    assert all(0 <= y <= 8 and 0 <= x <= 20 for y, x in corners)
    cut = [[v[:, y : y + 12, x : x + 12] for v, (y, x) in zip(value, corners, strict=True)] for value in pair[:4]]
    degraded, clean, flow, valid = (torch.stack(value) for value in cut)
    assert_close(condition[:, :3], 2 * degraded - 1)
    x, y = torch.arange(12) + flow[:, :1], torch.arange(12)[:, None] + flow[:, 1:]
    inside = (x >= -1e-3) & (x <= 11 + 1e-3) & (y >= -1e-3) & (y <= 11 + 1e-3)
    assert bool(inside.all()) == (task == "deweather")
    part = Pair(degraded, clean, flow, valid & inside, pair.key)
    assert losses.seen == [pytest.approx(expected_loss(model, part, size=(20, 32)), rel=2e-4)]


def test_a_crop_of_a_smaller_frame_is_the_frame(trainer):
    batches = pairs("deweather", 1)
    found = []
    for crop in (None, 24, 20):
        losses = Losses()
        trainer(max_epochs=1, callbacks=[losses]).fit(Diffusion(Guess, Deweather(), crop=crop), loader(batches))
        found.append(losses.seen)
    assert found[0] == found[1] != found[2]


def test_each_sample_and_each_step_has_a_level_and_a_noise_of_its_own_all_levels_alike(trainer):
    (pair,) = pairs("deweather", 1, batch=20)
    model = Diffusion(Guess, Deweather(), lr=0.0)
    trainer(max_epochs=1).fit(model, loader([pair] * 20))
    time = torch.stack([time for _, time, _ in guess(model).given]).float()
    assert len(time.unique()) > 300  # 400 of 1000, about 330 of which differ
    assert (float(time.min()), float(time.max())) == pytest.approx((0, 999), abs=15)
    assert float(time.mean()) == pytest.approx(499.5, abs=4 * 289 / 20)


@pytest.mark.parametrize("task", TASKS)
def test_training_is_the_same_from_the_same_seed_whatever_else_is_drawn(trainer, task):
    found = []
    for seed, others in ((4, 1), (4, 2), (5, 1)):
        torch.manual_seed(3)
        model, losses = Diffusion(tiny, TASKS[task], seed=seed, lr=1e-3, crop=12), Losses()
        torch.manual_seed(others)
        trainer(max_epochs=1, callbacks=[losses]).fit(model, loader(pairs(task)))
        found.append(losses.seen)
    assert found[0] == found[1]
    assert found[0] != found[2]


@pytest.mark.parametrize("task", TASKS)
def test_overfitting_one_batch_lowers_the_loss_markedly(trainer, task):
    batches = pairs(task, 1, size=(32, 32), batch=2)
    torch.manual_seed(0)
    model, losses = Diffusion(tiny, TASKS[task], lr=5e-3, warmup_steps=5), Losses()
    trainer(max_epochs=1, callbacks=[losses]).fit(model, loader(batches * 40))
    assert np.mean(losses.seen[-10:]) < 0.5 * np.mean(losses.seen[:5])


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm_solver"])
def test_a_restoration_is_that_of_the_image_and_its_key_whatever_the_batch(task, sampler):
    torch.manual_seed(0)
    model = Diffusion(tiny, TASKS[task], sampler=sampler, steps=5).eval()
    image = torch.rand(3, 3, 9, 14)
    key = torch.tensor([5, 8, 5])
    together = model(image, key)
    assert torch.equal(model(image, key).image, together.image)
    # Convolutions round in another order in another batch.
    assert_close(model(image[1:2], key[1:2]).image, together.image[1:2], rtol=0, atol=2e-3)
    order = torch.tensor([2, 0, 1])
    assert_close(model(image[order], key[order]).image, together.image[order], rtol=0, atol=2e-3)
    same = model(image[:1].expand(3, -1, -1, -1), key).image
    assert_close(same[0], same[2], rtol=0, atol=2e-3)
    assert float((same[0] - same[1]).abs().amax()) > 0.05
    assert not together.image.requires_grad


def test_without_keys_an_image_restores_alike_at_every_place_of_a_batch():
    torch.manual_seed(0)
    model = Diffusion(tiny, Deweather(), steps=4).eval()
    image = torch.rand(1, 3, 8, 8)
    assert_close(model(image.expand(2, -1, -1, -1)).image[1:], model(image).image, rtol=0, atol=2e-3)
    assert_close(model(image).image, model(image, torch.tensor([0])).image)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize("task", TASKS)
def test_a_network_that_knows_the_answer_restores_it_in_any_number_of_steps(task, prediction):
    (pair,) = pairs(task, 1)
    model = Diffusion(Guess, TASKS[task], prediction=prediction)
    target = model.target.encode(pair, SIZE).double()

    class Knowing(nn.Module):
        def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
            kept = torch.from_numpy(KEPT)[time].view(-1, 1, 1, 1)
            noise = (noisy - kept.sqrt() * target) / (1 - kept).sqrt()
            velocity = kept.sqrt() * noise - (1 - kept).sqrt() * target
            return (noise if prediction == "epsilon" else velocity).float()

    model.network = Knowing()
    for sampler, steps in (("ddim", 1), ("dpm_solver", 7), ("ddpm", 30)):
        model.sampler, model.steps = sampler, steps
        found = model(pair.degraded, pair.key)
        if found.flow is None:
            assert_close(found.image, pair.clean, rtol=0, atol=2e-3)
        else:
            error = (found.flow - pair.flow) * pair.valid
            assert float(error.abs().amax()) < 5e-3


class Weights(Callback):
    """The weights after each step, and those that validate."""

    def __init__(self):
        self.learned: list[Tensor] = []
        self.validating: list[Tensor] = []

    def on_train_start(self, trainer, pl_module) -> None:
        self.learned.append(guess(pl_module).factor.detach().clone())

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self.learned.append(guess(pl_module).factor.detach().clone())

    def on_validation_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0) -> None:
        self.validating.append(guess(pl_module).factor.detach().clone())


def average(weights: list[Tensor], decay: float) -> float:
    """The first learned weights, then n of them more: keep min(decay, (1 + n) / (10 + n)) of what there is."""
    found = float(weights[1])
    for n, new in enumerate(weights[2:], start=1):
        keep = min(decay, (1 + n) / (10 + n))
        found = keep * found + (1 - keep) * float(new)
    return found


@pytest.mark.parametrize("decay", [0.2, 0.999])
def test_the_moving_average_validates_is_saved_and_is_what_a_training_ends_with(trainer, tmp_path, decay):
    batches, seen = pairs("deweather", 4), Weights()
    model = Diffusion(Guess, Deweather(), lr=0.05, warmup_steps=0, ema_decay=decay, val_steps=2)
    run = trainer(max_epochs=2, callbacks=[seen])
    run.fit(model, loader(batches), loader(batches[:1]))
    for epoch in (0, 1):
        learned = seen.learned[: 5 + 4 * epoch]
        expected = average(learned, decay)
        assert float(seen.validating[epoch]) == pytest.approx(expected, rel=1e-5)
        assert abs(expected - float(learned[-1])) > 1e-4
    last = model.state_dict()["network.factor"]
    assert float(last) == pytest.approx(average(seen.learned, decay), rel=1e-5)
    run.save_checkpoint(tmp_path / "last.ckpt")
    saved = read_checkpoint(tmp_path / "last.ckpt", task="deweather")["state_dict"]
    assert_close(saved["network.factor"], last)


class Saving(Callback):
    """A checkpoint after the first epoch."""

    def __init__(self, path):
        self.path = path

    def on_validation_end(self, trainer, pl_module) -> None:
        if trainer.current_epoch == 0:
            trainer.save_checkpoint(self.path)


@pytest.mark.filterwarnings("ignore:.*outside the 'fit' stage")
@pytest.mark.parametrize("task", TASKS)
def test_a_stopped_training_goes_on_as_if_never_stopped(trainer, tmp_path, task):
    batches, path = pairs(task, 3), tmp_path / "first.ckpt"

    def for_params(resumed: bool) -> dict[str, Tensor]:
        torch.manual_seed(0)
        model = Diffusion(tiny, TASKS[task], lr=1e-3, val_steps=1)
        run = trainer(max_epochs=2, callbacks=[] if resumed else [Saving(path)])
        run.fit(model, loader(batches), loader(batches[:1]), ckpt_path=path if resumed else None, weights_only=True)
        return model.state_dict()

    whole = for_params(False)
    assert read_checkpoint(path, task=task)["epoch"] == 0
    assert_close(for_params(True), whole, rtol=0, atol=1e-6)


@pytest.mark.parametrize("task", TASKS)
def test_a_validation_of_a_training_takes_few_steps_and_an_evaluation_all(trainer, task):
    batches = pairs(task, 1)
    model = Diffusion(Guess, TASKS[task], steps=9, val_steps=3)
    run = trainer(max_epochs=1)
    run.fit(model, loader(batches), loader(batches))
    given = guess(model).given
    assert len(given) == 1 + 1 + 3  # the loss of the training, that of the validation, and the steps
    assert [int(time[0]) for _, time, _ in given[2:]] == [999, 665, 332]
    given.clear()
    run.validate(model, loader(batches), verbose=False)
    assert len(given) == 1 + 9
    names = {"val/loss", "val/psnr", "val/psnr_identity", "val/ssim"}
    names |= {"val/epe", "val/epe_identity", "val/epe_constant"} if task == "undistort" else set()
    assert names <= set(run.callback_metrics)


def test_the_loss_of_a_validation_is_of_the_same_draws_each_time(trainer):
    batches = pairs("undistort", 1)
    run = trainer()
    model = Diffusion(Guess, Undistort(), steps=1)
    found = [run.validate(model, loader(batches), verbose=False)[0]["val/loss"] for _ in range(2)]
    assert found[0] == found[1]


def test_mixed_precision_trains_and_restores_without_nan(trainer):
    batches = pairs("undistort", 2)
    torch.manual_seed(0)
    model, losses = Diffusion(tiny, Undistort(), lr=1e-3, val_steps=2), Losses()
    run = trainer(max_epochs=1, precision="bf16-mixed", callbacks=[losses])
    run.fit(model, loader(batches), loader(batches[:1]))
    assert np.isfinite(losses.seen).all()
    assert torch.isfinite(run.callback_metrics["val/epe"])


def test_a_loss_that_is_not_a_number_stops_with_the_keys(trainer):
    batches = pairs("deweather", 1, first=40)
    with pytest.raises(
        NotFiniteError, match=r"^loss must be finite, got nan in step 0 of epoch 0 for the keys 40, 41, 42, 43$"
    ):
        trainer(max_epochs=1).fit(Diffusion(Broken, Deweather()), loader(batches))


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ({"steps": 0}, ValueError, "steps must be at least 1, got 0"),
        ({"steps": 1001}, ValueError, "steps must be at most the 1000 levels .*, got 1001"),
        ({"val_steps": 0}, ValueError, "val_steps must be at least 1, got 0"),
        ({"sampler": "euler"}, ValueError, "sampler must be one of ddpm, ddim, dpm_solver, got 'euler'"),
        ({"prediction": "flow"}, ValueError, "prediction must be one of v_prediction, epsilon, got 'flow'"),
        ({"crop": 0}, ValueError, "crop must be at least 1, got 0"),
        ({"ema_decay": 1.5}, ValueError, r"ema_decay must be a number in \[0, 1\], got 1.5"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
    ],
)
def test_a_wrong_number_is_named(words, error, message):
    with pytest.raises(error, match=message):
        Diffusion(Guess, Undistort(), **words)
