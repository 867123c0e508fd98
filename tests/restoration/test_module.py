import math
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import LearningRateFinder, ModelCheckpoint
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import Frame, LensDistortion, Pair, UniformFog, presets
from torchrefract._validation import UsageError
from torchrefract.data.module import make_pair, road_scenes
from torchrefract.restoration.checkpoints import read_checkpoint
from torchrefract.restoration.metrics import endpoint_error, psnr, restore_by_transmission
from torchrefract.restoration.models.coordconv import ResUNet
from torchrefract.restoration.module import NotFiniteError, Restoration
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort
from torchrefract.warping.flow import resize_flow

SIZE = (32, 64)
BATCH = 4
small_unet = partial(ResUNet, encoder="tu-test_resnet")

# Lightning warns of small trainings, and of its own code (LeafSpec).
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*no `val_dataloader`", "ignore:.*LeafSpec"
)


class Constant(nn.Module):
    """The smallest trainable network: one number for each channel."""

    def __init__(self, channels: int, *, smooth: bool = False):
        super().__init__()
        self.output = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, image: Tensor) -> Tensor:
        return self.output.expand(len(image), -1, *image.shape[2:])


@pytest.fixture(scope="module")
def training(make_batches) -> list[Pair]:
    return make_batches(LensDistortion(), 3, size=SIZE)


@pytest.fixture(scope="module")
def validation(make_batches) -> list[Pair]:
    return make_batches(LensDistortion(), 2, first=100, size=SIZE)


def mean_flow(pairs: list[Pair]) -> Tensor:
    """Average each pixel over the samples in which it is valid; return (2, H, W)."""
    flow = torch.cat([pair.flow for pair in pairs]).double()
    valid = torch.cat([pair.valid for pair in pairs]).expand_as(flow)
    return flow.masked_fill(~valid, torch.nan).nanmean(dim=0).nan_to_num(0.0).float()


def mean_epe(pairs: list[Pair], flow: Tensor) -> float:
    """Average the endpoint error of a constant flow over images, in px of 1920x1080."""
    scale = torch.tensor([1920 / SIZE[1], 1080 / SIZE[0]]).view(2, 1, 1)
    errors = [
        ((flow - target) * scale).norm(dim=0)[valid].mean()
        for pair in pairs
        for target, valid in zip(pair.flow, pair.valid[:, 0], strict=True)
    ]
    return float(torch.stack(errors).mean())


def mean_psnr(pairs: list[Pair]) -> float:
    """Average the PSNR of the degraded images."""
    values = [
        -10 * torch.log10((clean - degraded)[valid.expand_as(clean)].square().mean())
        for pair in pairs
        for clean, degraded, valid in zip(pair.clean, pair.degraded, pair.valid, strict=True)
    ]
    return float(torch.stack(values).mean())


def test_the_baselines_are_the_degraded_image_and_the_mean_valid_flow_of_the_training(
    trainer, training, validation, loader, tmp_path
):
    assert not torch.cat([pair.valid for pair in training]).all()
    garbage = [pair._replace(flow=torch.where(pair.valid, pair.flow, 1e6)) for pair in training]
    model, run = Restoration(Constant, Undistort()), trainer(max_epochs=2)
    assert torch.equal(model.constant_flow(training[0].flow), torch.zeros(BATCH, 2, *SIZE))
    run.fit(model, loader(garbage), loader(validation))
    scores, expected = run.callback_metrics, mean_flow(training)
    assert_close(model.constant_flow(training[0].flow)[0], expected, rtol=0, atol=1e-5)
    twice = torch.zeros(1, 2, *(2 * side for side in SIZE))
    assert_close(model.constant_flow(twice), resize_flow(expected[None], twice.shape[2:]), rtol=0, atol=1e-5)
    assert scores["val/epe_identity"] == pytest.approx(mean_epe(validation, torch.zeros(2, 1, 1)), rel=1e-4)
    assert scores["val/epe_constant"] == pytest.approx(mean_epe(validation, expected), rel=1e-4)
    assert scores["val/psnr_identity"] == pytest.approx(mean_psnr(validation), abs=1e-3)
    assert scores["val/epe_constant"] < scores["val/epe_identity"]
    assert scores["val/psnr_constant"] > scores["val/psnr_identity"]
    run.save_checkpoint(tmp_path / "last.ckpt")
    assert read_checkpoint(tmp_path / "last.ckpt")["task"] == "undistort"
    loaded, options = Restoration(Constant, Undistort()), {"verbose": False, "weights_only": True}
    trainer().validate(loaded, loader(validation), ckpt_path=str(tmp_path / "last.ckpt"), **options)
    assert_close(loaded.constant_flow(training[0].flow)[0], expected, rtol=0, atol=1e-5)
    assert_close(loaded.state_dict(), model.state_dict())


@pytest.mark.parametrize("left_out", [[1], [0, 1, 2, 3]])
def test_the_scores_of_a_run_leave_out_frames_without_a_valid_pixel(trainer, validation, loader, left_out):
    pairs = [pair._replace(valid=pair.valid.clone()) for pair in validation]
    pairs[0].valid[left_out] = False
    (scores,) = trainer().validate(Restoration(Constant, Undistort()), loader(pairs), verbose=False)
    kept = [i for i in range(BATCH) if i not in left_out]
    rest = [Pair(*(value[kept] for value in pairs[0][:5])), *pairs[1:]]
    assert scores["val/psnr_identity"] == pytest.approx(mean_psnr(rest), abs=1e-3)
    assert scores["val/epe_identity"] == pytest.approx(mean_epe(rest, torch.zeros(2, 1, 1)), rel=1e-4)


def test_an_untrained_network_scores_like_the_degraded_image_in_px_of_the_metric_size(trainer, validation, loader):
    runs = []
    for metric_size in ([1080, 1920], [270, 480]):
        runs.append(trainer())
        model = Restoration(Constant, Undistort(), metric_size=metric_size)
        runs[-1].validate(model, loader(validation), verbose=False)
    full, quarter = (run.callback_metrics for run in runs)
    for score in ("psnr", "ssim", "epe"):
        assert full[f"val/{score}"] == pytest.approx(float(full[f"val/{score}_identity"]), rel=1e-5)
    assert full["val/epe"] == pytest.approx(4 * float(quarter["val/epe"]), rel=1e-5)


def test_a_task_without_a_flow_has_no_endpoint_error(trainer, make_batches, loader):
    fog = make_batches(UniformFog(), 1, size=SIZE)
    run = trainer(max_epochs=1)
    run.fit(Restoration(Constant, Deweather()), loader(fog), loader(fog))
    names = set(run.callback_metrics)
    assert {"val/psnr", "val/psnr_identity", "val/ssim", "val/ssim_identity", "val/loss", "train/loss"} <= names
    assert not [name for name in names if "epe" in name or "constant" in name or "L_k" in name]
    assert run.callback_metrics["val/L_rec"] == run.callback_metrics["val/L"] == run.callback_metrics["val/loss"]


def test_a_training_computes_ssim_in_its_last_epoch_alone(trainer, training, validation, loader):
    class Names(Callback):
        def on_validation_end(self, trainer, pl_module) -> None:
            logged.append({name for name in trainer.logged_metrics if name.startswith("val/")})

    logged: list[set[str]] = []
    trainer(max_epochs=3, callbacks=[Names()]).fit(
        Restoration(Constant, Undistort()), loader(training), loader(validation)
    )
    of_last = {f"val/ssim{suffix}" for suffix in ("", "_identity", "_constant")}
    assert [names & of_last for names in logged] == [set(), set(), of_last]
    assert "val/epe" in logged[0]


def test_a_validation_logs_the_loss_and_its_terms_of_the_model_and_of_the_baselines(trainer, training, loader):
    run, task = trainer(), Undistort()
    run.validate(Restoration(Constant, task), loader(training[:1]), verbose=False)
    scores, pair = run.callback_metrics, training[0]
    nothing = Restored(pair.degraded, torch.zeros_like(pair.flow))
    image_loss, flow_loss = task.loss_terms(nothing, pair)
    for suffix in ("", "_identity", "_constant"):  # the network predicts 0, and no flow is known yet
        assert scores[f"val/L_rec{suffix}"] == pytest.approx(float(image_loss.mean()), rel=1e-4)
        assert scores[f"val/L_k{suffix}"] == pytest.approx(float(flow_loss.mean()), rel=1e-4)
        assert scores[f"val/L{suffix}"] == pytest.approx(float((image_loss + flow_loss).mean()), rel=1e-4)


def test_doing_nothing_counts_as_clear_air_if_the_task_restores_a_transmission(trainer, make_batches, loader):
    (pair,) = (
        pair._replace(transmission=torch.full_like(pair.clean[:, :1], 0.25))
        for pair in make_batches(UniformFog(), 1, size=SIZE)
    )
    run = trainer()
    run.validate(Restoration(Constant, Deweather(transmission_head=True)), loader([pair]), verbose=False)
    assert run.callback_metrics["val/L_k_identity"] == pytest.approx(0.75, rel=1e-4)
    assert run.callback_metrics["val/L_k"] == pytest.approx(0.25, rel=1e-4)  # 1 / (1 + exp(0)) = 0.5


def test_a_validation_of_fog_says_what_its_true_transmission_allows(trainer, make_batches, loader):
    (clear,) = make_batches(UniformFog(), 1, size=SIZE)
    frame = Frame(clear.clean, clear.key, torch.empty(0))
    pair = make_pair(frame, UniformFog(), seed=1, transmission=True)
    run = trainer()
    run.validate(Restoration(Constant, Deweather()), loader([pair]), verbose=False)
    seen = pair.transmission >= 1 / 255
    expected = {"psnr_fog": psnr(restore_by_transmission(pair), pair.clean, pair.valid)}
    expected |= {"psnr_seen": psnr(pair.degraded, pair.clean, seen)}  # the network predicts no change
    expected |= {"psnr_seen_fog": psnr(restore_by_transmission(pair), pair.clean, seen)}
    for name, value in expected.items():
        assert run.callback_metrics[f"val/{name}"] == pytest.approx(float(value.mean()), rel=1e-5)
    assert run.callback_metrics["val/psnr_seen_fog"] > run.callback_metrics["val/psnr_seen"] + 10


class Rates(Callback):
    """Keep the learning rate of each step."""

    def __init__(self):
        self.values: list[float] = []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self.values.append(trainer.optimizers[0].param_groups[0]["lr"])


def test_the_learning_rate_warms_up_and_falls_along_a_cosine(trainer, training, loader):
    rates, steps, warmup = Rates(), 40, 4  # the warm-up takes at most a tenth of a run
    model = Restoration(Constant, Undistort(), lr=0.01, warmup_steps=50)
    trainer(max_epochs=4, callbacks=[rates]).fit(model, loader((training * 4)[:10]))
    rise = [0.01 * i / warmup for i in range(warmup)]
    fall = [0.005 * (1 + math.cos(math.pi * (i - warmup) / (steps - warmup))) for i in range(warmup, steps)]
    assert rates.values == pytest.approx(rise + fall)


@pytest.mark.quick
def test_a_plateau_halves_the_rate_after_more_than_five_epochs_without_a_lower_loss():
    options = Restoration(Constant, Undistort(), lr=1.0, schedule="plateau").configure_optimizers()
    optimizer, scheduler = options["optimizer"], options["lr_scheduler"]["scheduler"]
    rates = []
    for loss in [1.0] * 7 + [0.5] * 8:
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step(loss)
    # The first 1.0 is the lowest until the eighth epoch, so the seventh is the sixth without a lower loss.
    assert rates == [1.0] * 7 + [0.5] * 7 + [0.25]


@pytest.mark.filterwarnings("ignore:.*not available but strict is set to `False`")  # every second epoch has no score
def test_a_plateau_takes_a_validation_every_second_epoch(trainer, training, validation, loader):
    model, run = (
        Restoration(Constant, Undistort(), schedule="plateau"),
        trainer(max_epochs=3, check_val_every_n_epoch=2),
    )
    run.fit(model, loader(training), loader(validation))
    assert run.lr_scheduler_configs[0].scheduler.last_epoch == 1


def test_a_cosine_without_a_last_step_raises(trainer, training, loader):
    with pytest.raises(UsageError, match="schedule must be plateau for a training without a last step, got cosine"):
        trainer(max_epochs=-1, max_time={"seconds": 60}).fit(Restoration(Constant, Undistort()), loader(training))


@pytest.mark.parametrize("kind", [Frame, list, dict])
def test_batches_that_are_no_pairs_raise_with_the_remedy(trainer, training, loader, kind):
    pair = training[0]
    batch = {Frame: Frame(pair.clean, pair.key, pair.transmission), list: list(pair), dict: pair._asdict()}[kind]
    for start in ("fit", "validate", "predict"):
        with pytest.raises(TypeError, match=f"batch must be a Pair.*, got {kind.__name__}; .*datamodule=PairData"):
            getattr(trainer(max_epochs=1), start)(Restoration(Constant, Undistort()), loader([batch]))


def test_a_trainer_predicts_for_images_and_for_pairs(trainer, training, loader):
    model = Restoration(Constant, Undistort())
    for batch in (training[0], training[0].degraded):
        (restored,) = trainer().predict(model, loader([batch]))
        assert_close(restored.image, training[0].degraded)


@pytest.mark.parametrize(
    ("factor", "dtype", "message"),
    [
        (255, torch.uint8, "batch must be floating in .*, got torch.uint8; use images.float"),
        (255, torch.float32, "image must lie in .* 0...255 by 255"),
    ],
)
def test_a_trainer_predicts_for_no_images_of_0_to_255(trainer, training, loader, factor, dtype, message):
    images = (factor * training[0].degraded).to(dtype)
    with pytest.raises((TypeError, ValueError), match=message):
        trainer().predict(Restoration(Constant, Undistort()), loader([images]))


def test_the_learning_rate_finder_of_lightning_trains_before_a_training(trainer, training, loader):
    finder = LearningRateFinder(num_training_steps=3, early_stop_threshold=None, update_attr=False)
    model = Restoration(Constant, Undistort())
    trainer(max_epochs=2, callbacks=[finder], plugins=[]).fit(model, loader(training))
    assert finder.optimal_lr is not None
    assert len(finder.optimal_lr.results["loss"]) == 3


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_loss_that_is_not_finite_names_the_keys_of_its_batch(trainer, training, loader, value):
    batch = training[1]._replace(clean=torch.full_like(training[1].clean, value), valid=training[1].valid | True)
    with pytest.raises(NotFiniteError, match=rf"got {value:g} in step 1 of epoch 0 for the keys 4, 5, 6, 7$"):
        trainer(max_epochs=1).fit(Restoration(Constant, Undistort()), loader([training[0], batch]))


@pytest.mark.quick
def test_a_warm_up_takes_at_most_a_tenth_of_the_steps():
    model = Restoration(Constant, Undistort(), warmup_steps=50)
    assert [model.num_warmup_steps(steps) for steps in (9, 192, 499, 500, 10_000)] == [0, 19, 49, 50, 50]


class StoppedError(Exception):
    """Ends a run in the middle of an epoch."""


class Stop(Callback):
    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        if (trainer.current_epoch, batch_idx) == (1, 1):
            raise StoppedError


class Impatient(Restoration):
    """Halve the rate of a plateau in each epoch."""

    def configure_optimizers(self) -> Any:
        options = super().configure_optimizers()
        if self.schedule == "plateau":
            options["lr_scheduler"]["scheduler"].patience = 0
            options["lr_scheduler"]["scheduler"].threshold = 1.0
        return options


class Dropping(nn.Sequential):
    """A small network with running statistics and dropout."""

    def __init__(self, channels: int, *, smooth: bool = False):
        layers = (nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.Dropout(0.5), nn.Conv2d(8, channels, 1))
        super().__init__(*layers)


@pytest.mark.filterwarnings("ignore:.*dirpath has changed")
@pytest.mark.parametrize("schedule", ["plateau", "cosine"])
def test_a_resumed_run_ends_with_the_weights_of_an_uninterrupted_one_bit_for_bit(
    trainer, training, loader, tmp_path, on_threads, schedule
):
    on_threads(1)

    def train(name: str, *callbacks: Callback, ckpt_path: Path | None = None) -> tuple[dict[str, Tensor], list[float]]:
        torch.manual_seed(3)
        model, rates = Impatient(Dropping, Undistort(), lr=1e-2, schedule=schedule), Rates()
        checkpoint = ModelCheckpoint(tmp_path / name, monitor="val/loss", save_last=True)
        run = trainer(max_epochs=3, callbacks=[rates, checkpoint, *callbacks], enable_checkpointing=True)
        run.fit(model, loader(training[:2]), loader(training[2:]), ckpt_path=ckpt_path, weights_only=True)
        return model.state_dict(), rates.values

    weights, rates = train("uninterrupted")
    with pytest.raises(StoppedError):
        train("stopped", Stop())
    resumed_weights, resumed_rates = train("resumed", ckpt_path=tmp_path / "stopped" / "last.ckpt")
    assert resumed_rates == rates[2:]
    if schedule == "plateau":
        assert rates == [1e-2, 1e-2, 5e-3, 5e-3, 2.5e-3, 2.5e-3]
    for name, value in weights.items():
        assert torch.equal(value, resumed_weights[name]), name


def overfit(network: nn.Module, task: Task, pair: Pair, *, steps: int, lr: float) -> Restored:
    """Train a network on a single batch and restore the batch."""
    optimizer = torch.optim.AdamW(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        task.loss(task.restore(network(pair.degraded), pair.degraded), pair).backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return task.restore(network(pair.degraded), pair.degraded)


def test_a_network_learns_to_undistort_one_batch_to_half_a_pixel(make_batches, on_threads):
    on_threads(1)  # rounding depends on the number of threads
    torch.manual_seed(0)
    (pair,) = make_batches(presets.cheap_dashcam(severity=5), 1, size=SIZE, batch=1)
    restored = overfit(small_unet(2, smooth=True), Undistort(), pair, steps=50, lr=3e-3)
    assert restored.flow is not None
    before, after = (
        endpoint_error(flow, pair.flow, pair.valid, size=SIZE).mean() for flow in (0 * pair.flow, restored.flow)
    )
    assert before > 1
    assert after < 0.5


def test_a_network_learns_to_remove_the_fog_of_one_image_to_35_decibels(make_batches):
    torch.manual_seed(0)
    (pair,) = make_batches(presets.cape_town_fog(4), 1, size=SIZE, batch=1)
    restored = overfit(small_unet(3), Deweather(), pair, steps=140, lr=1e-2)
    before, after = (psnr(image, pair.clean, pair.valid).mean() for image in (pair.degraded, restored.image))
    assert before < 20
    assert after > 35


def test_mixed_precision_trains_with_finite_float32_weights(trainer, make_batches, loader):
    batches = make_batches(LensDistortion(), 2, size=SIZE, batch=2)
    model, dtypes = Restoration(small_unet, Undistort()), []
    model.get_submodule("network.network.segmentation_head").register_forward_hook(
        lambda module, inputs, outputs: dtypes.append(outputs.dtype)
    )
    run = trainer(max_epochs=1, precision="bf16-mixed")
    run.fit(model, loader(batches[:1]), loader(batches[1:]))
    assert {*dtypes} == {torch.bfloat16}
    assert all(value.isfinite() for value in run.callback_metrics.values())
    assert all(value.isfinite().all() and value.dtype == torch.float32 for value in model.parameters())


def test_two_processes_with_unequal_numbers_of_frames_have_the_scores_of_one(trainer, monkeypatch):
    """Lightning rounds the mean number of frames of a process down, if it is an integer."""
    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    data = road_scenes(effect=LensDistortion(), size=SIZE, train_count=4, val_count=5, batch_size=2, workers=0)
    model = Restoration(Constant, Undistort())
    one, two = (
        trainer(devices=devices, strategy=strategy).validate(model, data, verbose=False)[0]
        for devices, strategy in ((1, "auto"), (2, "ddp_fork"))
    )
    assert one["val/psnr"] > 0
    assert two == pytest.approx(one, rel=1e-4)
