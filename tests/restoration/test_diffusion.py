import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from pytorch_lightning import Callback, LightningModule
from torch import Tensor, nn
from torch.nn.functional import grid_sample
from torch.testing import assert_close

from torchrefract import LensDistortion, Pair, UniformFog
from torchrefract.random import stream
from torchrefract.restoration.checkpoints import CheckpointError, check_fits, read_checkpoint
from torchrefract.restoration.diffusion import Diffusion, FlowTarget, ImageTarget, normal, sample, target_of
from torchrefract.restoration.models.denoiser import Denoiser
from torchrefract.restoration.tasks import Deweather, Undistort

SIZE = (16, 24)
ALPHAS = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))  # a of the docstring, by level
TASKS = {"undistort": Undistort(0.1), "deweather": Deweather()}

# Lightning warns of small trainings, and of its own code (LeafSpec).
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*no `val_dataloader`", "ignore:.*LeafSpec"
)

tiny = partial(Denoiser, widths=(8, 16), attention=(False, True), layers=1, groups=4)


class Linear(nn.Module):
    """A linear function in place of a network; it keeps its inputs."""

    def __init__(self, channels: int):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.7))
        self.inputs: list[tuple[Tensor, Tensor, Tensor]] = []

    def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        self.inputs.append((noisy.detach(), time, condition))
        return self.factor * noisy + 0.1 * condition[:, : noisy.shape[1]]


def linear(model: LightningModule) -> Linear:
    assert isinstance(model.network, Linear)
    return model.network


@pytest.fixture
def pairs(make_batches):
    effects = {"undistort": LensDistortion(k1_range=(-0.2, 0.2)), "deweather": UniformFog()}
    return lambda task, count=2, size=SIZE, **options: make_batches(effects[task], count, size=size, **options)


def numpy_warp(image: Tensor, flow: np.ndarray) -> np.ndarray:
    height, width = image.shape[2:]
    x, y = np.arange(width) + flow[:, 0], np.arange(height)[:, None] + flow[:, 1]
    grid = torch.from_numpy(np.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], axis=-1))
    return grid_sample(image.double(), grid, padding_mode="border", align_corners=False).numpy()


def expected_loss(model: Diffusion, pair: Pair, *, size: tuple[int, int]) -> float:
    """Compute the loss in NumPy from the inputs of the network."""
    noisy, time, condition = (value.double().numpy() for value in linear(model).inputs[-1])
    a = ALPHAS[time.astype(int)].reshape(-1, 1, 1, 1)
    limit = 0.1 * np.array([size[1], size[0]]).reshape(1, 2, 1, 1)
    flow = pair.flow.double().numpy()
    is_lens = model.task.name == "undistort"
    share = np.clip(flow / limit, -1, 1)
    companded = np.sign(share) * np.log(1 + 100 * np.abs(share)) / np.log(101)
    target = companded if is_lens else 2 * pair.clean.double().numpy() - 1
    noise = (noisy - np.sqrt(a) * target) / np.sqrt(1 - a)
    output = 0.7 * noisy + 0.1 * condition[:, : noisy.shape[1]]
    predicted_noise, predicted_target = output, (noisy - np.sqrt(1 - a) * output) / np.sqrt(a)
    if model.prediction == "v_prediction":
        # (noisy, velocity) is (target, noise) rotated by the angle whose cosine is sqrt(a).
        predicted_target = np.sqrt(a) * noisy - np.sqrt(1 - a) * output
        predicted_noise = np.sqrt(1 - a) * noisy + np.sqrt(a) * output
    expanded = np.sign(predicted_target) * (101 ** np.clip(np.abs(predicted_target), 0, 1) - 1) / 100
    restored = numpy_warp(pair.degraded, expanded * limit) if is_lens else (predicted_target + 1) / 2
    values = []
    for i, valid in enumerate(pair.valid[:, 0].numpy()):
        first = np.abs(predicted_noise[i] - noise[i])[:, valid].mean()
        second = ((restored[i] - pair.clean[i].double().numpy()) ** 2)[:, valid].mean()
        values.append(0.8 * first + a[i, 0, 0, 0] * second)
    return float(np.mean(values))


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize("task", TASKS)
def test_the_loss_is_its_formula_on_the_valid_pixels(trainer, pairs, loader, losses, task, prediction):
    (pair,) = pairs(task, 1)
    assert bool(pair.valid.all()) == (task == "deweather")
    model, kept = Diffusion(Linear, TASKS[task], prediction=prediction), losses()
    trainer(max_epochs=1, callbacks=[kept]).fit(model, loader([pair]))
    assert kept.values == [pytest.approx(expected_loss(model, pair, size=SIZE), rel=2e-4)]


def test_a_crop_cuts_all_maps_alike_and_flows_out_of_it_are_invalid(trainer, pairs, loader, losses):
    (pair,) = pairs("undistort", 1, size=(20, 32), batch=8)
    model, kept = Diffusion(Linear, TASKS["undistort"], crop=12), losses()
    trainer(max_epochs=1, callbacks=[kept]).fit(model, loader([pair]))
    condition = linear(model).inputs[0][2]
    assert condition.shape == (8, 5, 12, 12)
    # The coordinates of its first pixel are those of the frame, so they reveal the position of a crop.
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
    assert not inside.all()
    cropped = Pair(degraded, clean, flow, valid & inside, pair.key)
    assert kept.values == [pytest.approx(expected_loss(model, cropped, size=(20, 32)), rel=2e-4)]


def test_a_crop_as_large_as_the_frame_is_the_frame(trainer, pairs, loader):
    shapes = []
    for crop in (None, 24, 20):
        model = Diffusion(Linear, Deweather(), crop=crop)
        trainer(max_epochs=1).fit(model, loader(pairs("deweather", 1)))
        shapes.append(linear(model).inputs[0][0].shape[2:])
    assert shapes == [(16, 24), (16, 24), (16, 20)]


def test_levels_are_uniform_over_samples_and_steps(trainer, pairs, loader):
    (pair,) = pairs("deweather", 1, batch=20)
    model = Diffusion(Linear, Deweather(), lr=0.0)
    trainer(max_epochs=1).fit(model, loader([pair] * 20))
    time = torch.stack([time for _, time, _ in linear(model).inputs]).float()
    assert len(time.unique()) > 300  # of 400 draws from 1000 levels, about 330 differ
    assert (float(time.min()), float(time.max())) == pytest.approx((0, 999), abs=15)
    assert float(time.mean()) == pytest.approx(499.5, abs=4 * 289 / 20)


def test_training_depends_on_the_seed_alone_and_lowers_the_loss(trainer, pairs, loader, losses):
    batches, runs = pairs("undistort", 1, size=(16, 16), batch=2) * 40, []
    for seed, global_seed in ((0, 1), (0, 2), (1, 1)):
        torch.manual_seed(3)
        model, kept = Diffusion(tiny, Undistort(0.1), seed=seed, lr=5e-3, warmup_steps=5), losses()
        torch.manual_seed(global_seed)
        trainer(max_epochs=1, callbacks=[kept]).fit(model, loader(batches[: 4 if runs else 40]))
        runs.append(kept.values)
    assert runs[0][0] == runs[1][0] != runs[2][0]
    assert np.mean(runs[0][-10:]) < 0.5 * np.mean(runs[0][:5])


@pytest.mark.parametrize(
    ("task", "sampler"), [("undistort", "ddpm"), ("deweather", "ddim"), ("undistort", "dpm_solver")]
)
def test_a_restoration_depends_on_image_and_key_alone(task, sampler):
    torch.manual_seed(0)
    model = Diffusion(tiny, TASKS[task], sampler=sampler, steps=5).eval()
    image, key, order = torch.rand(3, 3, 9, 14), torch.tensor([5, 8, 5]), torch.tensor([2, 0, 1])
    together = model(image, key)
    assert torch.equal(model(image, key).image, together.image)
    # Convolutions round differently in other batches.
    assert_close(model(image[1:2], key[1:2]).image, together.image[1:2], rtol=0, atol=2e-3)
    assert_close(model(image[order], key[order]).image, together.image[order], rtol=0, atol=2e-3)
    same_image = model(image[:1].expand(3, -1, -1, -1), key).image
    assert_close(same_image[0], same_image[2], rtol=0, atol=2e-3)
    assert float((same_image[0] - same_image[1]).abs().amax()) > 0.05
    assert not together.image.requires_grad
    assert_close(model(image).image, model(image, torch.zeros(3, dtype=torch.int64)).image)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize("task", TASKS)
def test_a_perfect_network_restores_the_clean_image_with_every_sampler(pairs, task, prediction):
    (pair,) = pairs(task, 1)
    model = Diffusion(Linear, TASKS[task], prediction=prediction)
    target = model.target.encode(pair, SIZE).double()

    class Perfect(nn.Module):
        def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
            a = torch.from_numpy(ALPHAS)[time].view(-1, 1, 1, 1)
            noise = (noisy - a.sqrt() * target) / (1 - a).sqrt()
            velocity = a.sqrt() * noise - (1 - a).sqrt() * target
            return (noise if prediction == "epsilon" else velocity).float()

    model.network = Perfect()
    for sampler, steps in (("ddim", 1), ("dpm_solver", 7), ("ddpm", 30)):
        model.sampler, model.steps = sampler, steps
        restored = model(pair.degraded, pair.key)
        if restored.flow is None:
            assert_close(restored.image, pair.clean, rtol=0, atol=2e-3)
        else:
            assert float(((restored.flow - pair.flow) * pair.valid).abs().amax()) < 5e-3


class Weights(Callback):
    """Keep the weight after each training step and the weight of each validation."""

    def __init__(self):
        self.trained: list[float] = []
        self.validated: list[float] = []

    def on_train_start(self, trainer, pl_module) -> None:
        self.trained.append(linear(pl_module).factor.item())

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self.trained.append(linear(pl_module).factor.item())

    def on_validation_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0) -> None:
        self.validated.append(linear(pl_module).factor.item())


def average(weights: list[float], decay: float) -> float:
    """Start at the weight after the first step; then decay by min(decay, (1 + n) / (10 + n)) in each of n steps."""
    mean = weights[1]
    for n, new in enumerate(weights[2:], start=1):
        share = min(decay, (1 + n) / (10 + n))
        mean = share * mean + (1 - share) * new
    return mean


@pytest.mark.parametrize("decay", [0.2, 0.999])
def test_the_moving_average_is_validated_saved_and_kept_after_training(trainer, pairs, loader, tmp_path, decay):
    batches, weights = pairs("deweather", 4), Weights()
    model = Diffusion(Linear, Deweather(), lr=0.05, warmup_steps=0, ema_decay=decay, val_steps=2)
    run = trainer(max_epochs=2, callbacks=[weights])
    run.fit(model, loader(batches), loader(batches[:1]))
    for epoch in (0, 1):
        trained = weights.trained[: 5 + 4 * epoch]
        assert weights.validated[epoch] == pytest.approx(average(trained, decay), rel=1e-5)
        assert abs(average(trained, decay) - trained[-1]) > 1e-4
    last = model.state_dict()["network.factor"]
    assert float(last) == pytest.approx(average(weights.trained, decay), rel=1e-5)
    run.save_checkpoint(tmp_path / "last.ckpt")
    saved = read_checkpoint(tmp_path / "last.ckpt", task="deweather")["state_dict"]
    assert_close(saved["network.factor"], last)


class Save(Callback):
    """Write a checkpoint after the first epoch."""

    def __init__(self, path):
        self.path = path

    def on_validation_end(self, trainer, pl_module) -> None:
        if trainer.current_epoch == 0:
            trainer.save_checkpoint(self.path)


@pytest.mark.filterwarnings("ignore:.*outside the 'fit' stage")
def test_a_resumed_training_ends_with_the_weights_of_an_uninterrupted_one(trainer, pairs, loader, tmp_path):
    batches, path = pairs("undistort", 3), tmp_path / "first.ckpt"

    def train(*callbacks: Callback, ckpt_path: Path | None = None) -> dict[str, Tensor]:
        torch.manual_seed(0)
        model = Diffusion(tiny, Undistort(0.1), lr=1e-3, val_steps=1)
        run = trainer(max_epochs=2, callbacks=[*callbacks])
        run.fit(model, loader(batches), loader(batches[:1]), ckpt_path=ckpt_path, weights_only=True)
        return model.state_dict()

    uninterrupted = train(Save(path))
    assert read_checkpoint(path, task="undistort")["epoch"] == 0
    assert_close(train(ckpt_path=path), uninterrupted, rtol=0, atol=1e-6)


def test_validation_uses_val_steps_in_training_and_steps_in_an_evaluation(trainer, pairs, loader):
    batches = pairs("undistort", 1)
    model = Diffusion(Linear, Undistort(0.1), steps=9, val_steps=3)
    run, inputs = trainer(max_epochs=1), linear(model).inputs
    run.fit(model, loader(batches), loader(batches))
    assert len(inputs) == 1 + 1 + 3  # training loss, validation loss, sampler
    assert [int(time[0]) for _, time, _ in inputs[2:]] == [999, 665, 332]
    scores = []
    for _ in range(2):
        inputs.clear()
        scores.append(run.validate(model, loader(batches), verbose=False)[0])
        assert len(inputs) == 1 + 9
    names = ("val/loss", "val/psnr", "val/psnr_identity", "val/ssim", "val/epe", "val/epe_identity", "val/epe_constant")
    assert {*names} <= scores[0].keys()
    assert scores[0]["val/loss"] == scores[1]["val/loss"]


def test_mixed_precision_trains_and_restores_without_nan(trainer, pairs, loader, losses):
    batches, kept = pairs("undistort"), losses()
    torch.manual_seed(0)
    model = Diffusion(tiny, Undistort(), lr=1e-3, val_steps=2)
    run = trainer(max_epochs=1, precision="bf16-mixed", callbacks=[kept])
    run.fit(model, loader(batches), loader(batches[:1]))
    assert np.isfinite(kept.values).all()
    assert torch.isfinite(run.callback_metrics["val/epe"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"steps": 1001}, "steps must be at most the 1000 noise levels of the training, got 1001"),
        ({"val_steps": 0}, "val_steps must be at least 1, got 0"),
        ({"val_steps": 2.5}, r"val_steps must be a whole number, got 2\.5"),
        ({"sampler": "euler"}, "sampler must be one of ddpm, ddim, dpm_solver, got 'euler'"),
        ({"prediction": "flow"}, "prediction must be one of v_prediction, epsilon, got 'flow'"),
        ({"crop": 0}, "crop must be at least 1, got 0"),
        ({"ema_decay": 1.5}, r"ema_decay must be a number in \[0, 1\], got 1.5"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
    ],
)
def test_an_invalid_option_is_named(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Diffusion(Linear, Undistort(), **options)


SHAPE = (3, 2, 5, 7)


def predict(noisy: Tensor, time: Tensor) -> Tensor:
    """Return a function of both inputs in place of a trained network."""
    return torch.tanh(0.4 * noisy + 0.3 - time.view(-1, 1, 1, 1) / 2000)


def run_sampler(name: str, steps: int, start: Tensor) -> Tensor:
    return sample(start, predict, stream(7, torch.tensor([1, 2, 3])), name=name, steps=steps)


def numpy_ddim(start: np.ndarray, steps: int) -> np.ndarray:
    """Apply equation 12 of Song, Meng, Ermon 2021 with sigma = 0 from level to level."""
    noisy = start.astype(np.float64)
    times = [1000 * (steps - i) // steps - 1 for i in range(steps)]
    for time, after in zip(times, [*times[1:], None], strict=True):
        a, a_after = ALPHAS[time], 1.0 if after is None else ALPHAS[after]
        target = np.tanh(0.4 * noisy + 0.3 - time / 2000)
        noise = (noisy - np.sqrt(a) * target) / np.sqrt(1 - a)
        noisy = np.sqrt(a_after) * target + np.sqrt(1 - a_after) * noise
    return noisy


@pytest.mark.parametrize("steps", [1, 3, 7, 50])
def test_ddim_follows_its_formula_whether_or_not_the_steps_divide_the_levels(steps):
    start = torch.randn(SHAPE, generator=torch.Generator().manual_seed(steps))
    result = run_sampler("ddim", steps, start)
    assert_close(result.double(), torch.from_numpy(numpy_ddim(start.numpy(), steps)), rtol=0, atol=2e-4)


def test_the_solver_converges_with_its_steps_and_faster_than_ddim():
    start = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    limit = torch.from_numpy(numpy_ddim(start.numpy(), 1000)).float()
    coarse, fine, ddim = (
        float((run_sampler(name, steps, start) - limit).abs().max())
        for name, steps in (("dpm_solver", 10), ("dpm_solver", 100), ("ddim", 100))
    )
    assert fine < coarse / 2
    assert fine < ddim


def test_a_step_of_ddpm_has_the_mean_and_variance_of_its_posterior():
    # Ho et al. 2020, equations 6 and 7. The target is 0, so the second input is the posterior of the first step.
    inputs = []

    def zero(noisy: Tensor, time: Tensor) -> Tensor:
        inputs.append(noisy)
        return torch.zeros_like(noisy)

    result = sample(torch.ones(1, 1, 200, 200), zero, stream(7, torch.tensor([4])), name="ddpm", steps=2)
    a, after = ALPHAS[999], ALPHAS[499]
    mean = np.sqrt(a / after) * (1 - after) / (1 - a)
    variance = (1 - after) / (1 - a) * (1 - a / after)
    assert float(inputs[1].mean()) == pytest.approx(mean, abs=4 * np.sqrt(variance) / 200)
    assert float(inputs[1].var()) == pytest.approx(variance, rel=0.04)
    assert_close(result, torch.zeros(1, 1, 200, 200), rtol=0, atol=1e-6)  # the last step removes all noise


def test_the_noise_is_standard_normal_and_depends_on_the_key_alone():
    noise = normal(stream(7, torch.tensor([1, 2])), torch.empty(2, 3, 101, 99))
    assert torch.equal(normal(stream(7, torch.tensor([2])), torch.empty(1, 3, 101, 99)), noise[1:])
    for values in noise.flatten(1):
        assert float(values.mean()) == pytest.approx(0, abs=4 / len(values) ** 0.5)
        assert float(values.std()) == pytest.approx(1, abs=0.02)
    assert abs(float(torch.corrcoef(noise.flatten(1))[0, 1])) < 4 / noise[0].numel() ** 0.5


FRAME = (6, 10)


def flow_pair(flow: Tensor) -> Pair:
    degraded, clean = torch.rand(2, 1, 3, *flow.shape[2:], generator=torch.Generator().manual_seed(0))
    return Pair(degraded, clean, flow, torch.ones_like(flow[:, :1], dtype=torch.bool), torch.zeros(1).long())


def compand(share: float, mu: float = 100) -> float:
    return math.copysign(math.log(1 + mu * abs(share)) / math.log(1 + mu), share)


@pytest.mark.quick
def test_a_flow_is_companded_and_clamped_to_the_limit():
    flow = torch.zeros(1, 2, *FRAME)
    flow[0, :, 0, :4] = torch.tensor([[2.5, -1.25, 40, torch.nan], [1.5, 0.75, -40, torch.inf]])
    target = FlowTarget(0.25).encode(flow_pair(flow), FRAME)  # the limit is 2.5 px and 1.5 px
    half = compand(0.5)
    assert_close(target[0, :, 0, :4], torch.tensor([[1, -half, 1, 0], [1, half, -1, 1]]))
    assert not target[0, :, 1:].any()
    crop = torch.full((1, 2, 3, 5), 1.5)  # in units of the frame, not of the crop
    expected = torch.tensor([compand(0.3), compand(0.5)])
    assert_close(FlowTarget(0.5).encode(flow_pair(crop), FRAME)[0, :, 0, 0], expected)


def test_a_target_beyond_the_limit_decodes_to_the_limit():
    target = torch.tensor([1.5, -30.0]).view(1, 2, 1, 1).expand(-1, -1, *FRAME)
    flow = FlowTarget(0.25).decode(target, torch.rand(1, 3, *FRAME), FRAME).flow
    assert flow is not None
    assert_close(flow[0, :, 0, 0], torch.tensor([2.5, -1.5]))


def test_a_checkpoint_holds_the_companding_of_its_flows():
    model = Diffusion(lambda _: nn.Identity(), Undistort(0.25))
    state = model.state_dict()
    without = {name: value for name, value in state.items() if name != "target.mu"}
    with pytest.raises(CheckpointError, match=r"got old\.ckpt, where target\.mu differs"):
        check_fits({"state_dict": without}, model, Path("old.ckpt"))
    model.load_state_dict(state | {"target.mu": torch.tensor(255.0)})
    encoded = model.target.encode(flow_pair(torch.full((1, 2, *FRAME), 0.5)), FRAME)[0, :, 0, 0]
    assert_close(encoded, torch.tensor([compand(0.5 / (0.25 * side), 255) for side in (10, 6)]))


def test_the_target_follows_from_the_task():
    flow = target_of(Undistort(0.1))
    assert isinstance(flow, FlowTarget)
    assert (flow.limit, flow.channels) == (0.1, 2)
    assert isinstance(target_of(Deweather()), ImageTarget)
    with pytest.raises(TypeError, match="task must be Undistort or Deweather for a diffusion model, got NoneType"):
        target_of(None)  # pyright: ignore[reportArgumentType]  # the wrong type is the test
    with pytest.raises(ValueError, match=r"task.transmission_head must be false for a diffusion model, got true"):
        target_of(Deweather(transmission_head=True))
