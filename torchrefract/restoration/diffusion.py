"""Conditional diffusion of images, pixel by pixel: `model=ddpm_image` and the paper's `model=ddpm_cat256`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from diffusers import DDPMScheduler, DPMSolverMultistepScheduler
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import WeightAveraging
from pytorch_lightning.trainer.states import TrainerFn
from torch import Tensor, nn

from torchrefract._validation import check_choice, check_count, check_number
from torchrefract.random import Stream, noise_key, stream, uniform, white_noise
from torchrefract.restoration.metrics import masked_mean
from torchrefract.restoration.models.denoiser import conditions
from torchrefract.restoration.module import RestorationModule
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort, frame_sides
from torchrefract.types import Pair
from torchrefract.warping.grid import inside
from torchrefract.warping.warp import warp

SAMPLERS = ("ddpm", "ddim", "dpm_solver")
NUM_LEVELS = 1000  # noise levels of the training
_PREDICTIONS = ("v_prediction", "epsilon")
_NOISE_WEIGHT = 0.8
_MU = 100.0


class AveragedRestoration(RestorationModule, ABC):
    """Validate, save and apply a moving average of the trained weights; draw noise by seed, step and key.

    Args:
        network, task, lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
        ema_decay: upper limit of the decay of the moving average, which is (1 + n) / (10 + n) after n steps.
        seed: seed of all draws.
    """

    def __init__(self, network: nn.Module, task: Task, *, ema_decay: float, seed: int, **options: Any):
        super().__init__(network, task, **options)
        self.ema_decay = check_number("ema_decay", ema_decay, low=0.0, high=1.0)
        self.seed = check_count("seed", seed, low=0)

    def configure_callbacks(self) -> list[Callback]:
        """Add the moving average of the weights to a training."""
        return [WeightAveraging(avg_fn=self._average)] if self.trainer.state.fn == TrainerFn.FITTING else []

    @abstractmethod
    def loss_of_step(self, batch: Pair, step: int) -> Tensor:
        """Compute the loss () with the draws of a step of the training, 1 or above; those of a validation are of 0."""

    def training_loss(self, batch: Pair) -> tuple[Tensor, None]:
        return self.loss_of_step(batch, 1 + self.global_step), None

    def validation_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        return self.loss_of_step(batch, 0), self(batch.degraded, batch.key)

    def _average(self, average: Tensor, new: Tensor, count: Tensor) -> Tensor:
        if not average.is_floating_point():  # the counter of a batch normalization
            return new
        # With a constant decay, a short training would end near its initial weights.
        decay = ((1 + count) / (10 + count)).clamp(max=self.ema_decay)
        return torch.lerp(average, new, (1 - decay).to(average.dtype))

    def _stream(self, key: Tensor, step: int) -> Stream:
        # The corruption of a batch has the same keys and seeds >= 0, so the complement gives independent numbers.
        return stream(~((self.seed << 32) + step), key, device=self.device)


class Diffusion(AveragedRestoration):
    """Train a conditional diffusion model that restores images.

        noisy = sqrt(a) target + sqrt(1 - a) noise
        loss = 0.8 mean |predicted noise - noise| + a mean (restored(predicted target) - clean)^2

    Both means are over valid pixels. Each sample has one of 1000 noise levels; a is the cumulative product of
    1 - variance, and the variances grow linearly from 0.0001 to 0.02. The target is the flow that undoes a warp, as of
    `FlowTarget`, or the clean image in [-1, 1]. Noise and target follow from the prediction of the network:

        epsilon:       noise = predicted,  target = (noisy - sqrt(1 - a) predicted) / sqrt(a)
        v_prediction:  noise = sqrt(1 - a) noisy + sqrt(a) predicted
                       target = sqrt(a) noisy - sqrt(1 - a) predicted

    If a is small, a small error of a predicted noise is a large error of the target, although the degraded image
    determines the target. So the velocity is the default; published weights predict the noise.

    Validation, checkpoints and restorations use a moving average of the trained weights. Noise, levels and crops depend
    only on the seed, the step and the keys of a batch; the noise of `forward` depends only on the seed and the key.

    Args:
        network: builds the network from the number of channels of the target, see `Denoiser`.
        task: Undistort or Deweather.
        lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
        prediction: "v_prediction" or "epsilon", the output of the network.
        sampler: "ddim", "dpm_solver" or "ddpm"; "ddpm" needs many steps.
        steps: steps of the sampler in `forward` and in an evaluation, from 1 to 1000.
        val_steps: steps of the sampler in a validation during training, from 1 to 1000.
        crop: side of the squares that training uses, px; a shorter side of the frame is not cropped. None uses whole
            frames.
        ema_decay, seed: see `AveragedRestoration`.

    Raises:
        ValueError: a number is outside its range; the sampler or the prediction is unknown.
        TypeError: a number has the wrong type, or the task is another one.

    Source: Ho, Jain, Abbeel, "Denoising diffusion probabilistic models", NeurIPS 2020; Salimans, Ho, "Progressive
    distillation for fast sampling of diffusion models", ICLR 2022, for the velocity.
    """

    def __init__(
        self,
        network: Callable[[int], nn.Module],
        task: Task,
        *,
        lr: float = 1e-5,
        weight_decay: float = 1e-2,
        warmup_steps: int = 500,
        schedule: str = "cosine",
        metric_size: Sequence[int] = (1080, 1920),
        prediction: str = "v_prediction",
        sampler: str = "ddim",
        steps: int = 50,
        val_steps: int = 10,
        crop: int | None = 256,
        ema_decay: float = 0.999,
        seed: int = 0,
    ):
        target = target_of(task)
        options: dict[str, Any] = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps}
        options |= {"schedule": schedule, "metric_size": metric_size, "ema_decay": ema_decay, "seed": seed}
        super().__init__(network(target.channels), task, **options)
        self.target = target
        self.prediction = check_choice("prediction", prediction, _PREDICTIONS)
        self.sampler = check_choice("sampler", sampler, SAMPLERS)
        self.steps, self.val_steps = check_steps("steps", steps), check_steps("val_steps", val_steps)
        self.crop = None if crop is None else check_count("crop", crop)
        self.levels = DDPMScheduler(NUM_LEVELS, beta_schedule="linear")

    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """Restore images (B, 3, H, W) in [0, 1]; see `RestorationModule.forward`."""
        return self._sample(degraded, key, steps=self.steps)

    def validation_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        steps = self.val_steps if self.trainer.state.fn == TrainerFn.FITTING else self.steps
        return self.loss_of_step(batch, 0), self._sample(batch.degraded, batch.key, steps=steps)

    def loss_of_step(self, batch: Pair, step: int) -> Tensor:
        """Compute the loss at a random level for each sample; see `AveragedRestoration.loss_of_step`."""
        source, size = self._stream(batch.key, step), batch.clean.shape[2:]
        pair, condition = batch, conditions(batch.degraded)
        if step > 0:  # a validation is of whole frames
            pair, condition = self._crop(pair, condition, source.at(0))
        target = self.target.encode(pair, size)
        noise = normal(source.at(1), target)
        time = (uniform(source.at(2), 1)[:, 0] * NUM_LEVELS).long()
        noisy = self.levels.add_noise(target, noise, time)  # pyright: ignore[reportArgumentType]  # takes any int tensor
        predicted_noise, predicted_target = self._predict(noisy, time, condition)
        restored = self.target.decode(predicted_target, pair.degraded, size)
        noise_error = masked_mean((predicted_noise - noise).abs(), pair.valid)
        image_error = masked_mean((restored.image - pair.clean).square(), pair.valid)
        return (_NOISE_WEIGHT * noise_error + self._signal_share(time) * image_error).mean()

    def _crop(self, pair: Pair, condition: Tensor, source: Stream) -> tuple[Pair, Tensor]:
        """Cut a square out of each sample; flows that point out of it become invalid."""
        height, width = pair.clean.shape[2:]
        if self.crop is None or (height <= self.crop and width <= self.crop):
            return pair, condition
        size = (min(self.crop, height), min(self.crop, width))
        positions = torch.tensor([height - size[0] + 1, width - size[1] + 1])
        corners = (uniform(source.to(torch.device("cpu")), 2) * positions).long().tolist()

        def cut(value: Tensor) -> Tensor:
            rows = zip(value, corners, strict=True)
            return torch.stack([v[:, y : y + size[0], x : x + size[1]] for v, (y, x) in rows])

        degraded, clean, flow, valid = (cut(value) for value in pair[:4])
        return pair._replace(degraded=degraded, clean=clean, flow=flow, valid=valid & inside(flow)), cut(condition)

    def _predict(self, noisy: Tensor, time: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Predict the noise and the target."""
        predicted = self.network(noisy, time, condition)
        share = self._signal_share(time).view(-1, 1, 1, 1)
        signal, spread = share.sqrt(), (1 - share).sqrt()
        if self.prediction == "epsilon":
            return predicted, (noisy - spread * predicted) / signal
        return spread * noisy + signal * predicted, signal * noisy - spread * predicted

    def _signal_share(self, time: Tensor) -> Tensor:
        """Return a of the class docstring, (B,)."""
        return self.levels.alphas_cumprod.to(time.device)[time]

    @torch.no_grad()
    def _sample(self, degraded: Tensor, key: Tensor | None, *, steps: int) -> Restored:
        if key is None:
            key = torch.zeros(len(degraded), dtype=torch.int64)
        condition = conditions(degraded)

        def predict_target(noisy: Tensor, time: Tensor) -> Tensor:
            return self._predict(noisy, time, condition)[1].clamp(-1, 1)

        # The loss of a validation draws from lanes 1 and 2 of the same stream.
        source = self._stream(key, 0).at(3)
        start = normal(source, condition[:, : self.target.channels])
        target = sample(start, predict_target, source.at(4), name=self.sampler, steps=steps)
        return self.target.decode(target, degraded, degraded.shape[2:])


class Target(nn.Module, ABC):
    """Represent a restoration by maps in about [-1, 1]. Buffers of `decode` make other weights unfit to load."""

    channels: int

    @abstractmethod
    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """Encode the restoration of a pair cropped from frames of `size` = (height, width) to (B, channels, H, W)."""

    @abstractmethod
    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """Restore images (B, 3, H, W) that were cropped from frames of `size` by their target; inverts `encode`."""


class FlowTarget(Target):
    """Represent the flow that undoes a warp by its companded value.

        target = sign(r) ln(1 + mu |r|) / ln(1 + mu),  r = flow / (limit (W, H)),  mu = 100

    Most flows of a mix are a few hundredths of the longest one. The noise that a denoiser leaves has the same size
    everywhere and would hide them if the target were r itself. Companding gives each factor of ten a similar range.

    Args:
        limit: largest displacement, as a share of the width and the height of the frame.

    Source: the mu-law of ITU-T G.711, Pulse code modulation (1988), with mu = 255 for speech.
    """

    channels = 2
    mu: Tensor

    def __init__(self, limit: float):
        super().__init__()
        self.limit = limit
        self.register_buffer("mu", torch.tensor(_MU))

    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """Encode the flow, clamped to the limit."""
        # Invalid pixels may have any flow, and the network sees them next to valid ones.
        share = (pair.flow / (self.limit * frame_sides(pair.flow, size))).nan_to_num(0.0).clamp(-1, 1)
        return torch.log1p(self.mu * share.abs()).copysign(share) / self.mu.log1p()

    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """Warp the images along the flow."""
        target = target.clamp(-1, 1)  # from 1 to 2, the inverse of the companding grows by a factor of 100
        share = torch.expm1(self.mu.log1p() * target.abs()).copysign(target) / self.mu
        flow = share * self.limit * frame_sides(target, size)
        return Restored(warp(degraded, flow, padding="border")[0], flow)


class ImageTarget(Target):
    """Represent the clean image by 2 clean - 1."""

    channels = 3

    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """Map the clean image to [-1, 1]."""
        return 2 * pair.clean - 1

    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """Map the target to [0, 1]."""
        return Restored((target + 1) / 2)


def target_of(task: Task) -> Target:
    """Choose the representation of a task's restoration.

    Raises:
        TypeError: the task is neither Undistort nor Deweather.
        ValueError: the task also predicts a transmission.
    """
    if isinstance(task, Undistort):
        return FlowTarget(task.limit)
    if isinstance(task, Deweather):
        if task.channels != ImageTarget.channels:
            raise ValueError("task.transmission_head must be false for a diffusion model, got true")
        return ImageTarget()
    raise TypeError(f"task must be Undistort or Deweather for a diffusion model, got {type(task).__name__}")


def normal(source: Stream, like: Tensor) -> Tensor:
    """Draw standard normal noise in the shape (B, ...) of `like`; each sample depends only on its own stream."""
    count = like[0].numel()
    pairs = white_noise(noise_key(source).to(like.device), -(-count // 2))
    return pairs.flatten(1)[:, :count].view_as(like)


def sample(
    start: Tensor,
    predict_target: Callable[[Tensor, Tensor], Tensor],
    source: Stream,
    *,
    name: str,
    steps: int,
    schedule: str = "linear",
) -> Tensor:
    """Sample a target from noise. "ddpm" adds noise after each step, "dpm_solver" takes steps of second order.

    Args:
        start: (B, ...), standard normal; the target has the same shape.
        predict_target: predicts the target from a noisy one and its level (B,).
        source: stream of the noise of "ddpm".
        name, steps: as for `Diffusion`.
        schedule: of the variances of the levels, a name of diffusers.

    Source: Ho et al. as for `Diffusion`; Song, Meng, Ermon, "Denoising diffusion implicit models", ICLR 2021; Lu et
    al., "DPM-Solver++", 2022.
    """
    options: dict[str, Any] = {"prediction_type": "sample", "beta_schedule": schedule}
    if check_choice("sampler", name, SAMPLERS) == "ddpm":
        scheduler = DDPMScheduler(NUM_LEVELS, clip_sample=False, **options)
    else:
        # DDIM is the first-order solver. DDIMScheduler of diffusers requires that the steps divide 1000.
        scheduler = DPMSolverMultistepScheduler(NUM_LEVELS, solver_order=1 if name == "ddim" else 2, **options)
    # From the highest level down. The spacing of diffusers is uneven, or off by one, if `steps` does not divide 1000.
    levels = [NUM_LEVELS * (steps - i) // steps - 1 for i in range(check_steps("steps", steps))]
    scheduler.set_timesteps(timesteps=levels)
    # CPU generators draw the same numbers for every device.
    generators = [torch.Generator().manual_seed(word) for word in noise_key(source)[:, 0].tolist()]
    noisy = start
    for time in scheduler.timesteps.tolist():
        target = predict_target(noisy, torch.full((len(start),), time, device=start.device))
        generator: Any = generators  # the annotation of diffusers allows one generator only
        noisy = scheduler.step(target, time, noisy, generator=generator, return_dict=False)[0]
    return noisy


def check_steps(name: str, steps: int) -> int:
    """Return a number of sampling steps; raise ValueError unless it lies from 1 to the number of noise levels."""
    if check_count(name, steps) > NUM_LEVELS:
        raise ValueError(f"{name} must be at most the {NUM_LEVELS} noise levels of the training, got {steps}")
    return steps
