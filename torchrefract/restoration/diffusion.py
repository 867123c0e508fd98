"""Restoration by diffusion: noise is turned into the restoration step by step, seeing the degraded image."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import WeightAveraging
from pytorch_lightning.trainer.states import TrainerFn
from torch import Tensor, nn

from torchrefract._validation import check_choice, check_count, check_number
from torchrefract.random import Stream, stream, uniform
from torchrefract.restoration.metrics import masked_mean
from torchrefract.restoration.models.denoiser import conditions
from torchrefract.restoration.module import Learner
from torchrefract.restoration.sampler import LEVELS, SAMPLERS, check_steps, noise_levels, normal, sample
from torchrefract.restoration.targets import target_of
from torchrefract.restoration.tasks import Restored, Task
from torchrefract.types import Pair
from torchrefract.warping.grid import inside

_NOISE_WEIGHT = 0.8
_PREDICTIONS = ("v_prediction", "epsilon")


class _Part(NamedTuple):
    """What a network sees at once of a batch of pairs."""

    pair: Pair
    condition: Tensor
    size: Sequence[int]  # height and width of the frames that it is cut from


class Diffusion(Learner):
    """A conditional diffusion model of the restoration.

        noisy = sqrt(a) target + sqrt(1 - a) noise
        loss = 0.8 |found noise - noise|_1 + a |restored(found target) - clean|^2

    on the valid pixels, at one of 1000 levels of noise for each sample, a falling by variances that grow linearly from
    0.0001 to 0.02. The target is the flow that undoes a warp, companded as by `FlowTarget`, or the clean image from -1
    to 1. What the network predicts gives both that are found:

        epsilon:       found noise = predicted,  found target = (noisy - sqrt(1 - a) predicted) / sqrt(a)
        v_prediction:  found noise = sqrt(1 - a) noisy + sqrt(a) predicted,
                       found target = sqrt(a) noisy - sqrt(1 - a) predicted

    Where there is little but noise, a small error of a predicted noise is a large one of the target, which the degraded
    image tells all the same. So the velocity is the default; published weights predict the noise.

    The weights that validate, are saved, and restore are a moving average of those that learn. Noise, levels and crops
    depend on the seed, the step and the keys of a batch alone, and what `forward` draws on the seed and the key.

    Args:
        network: makes the network, given the number of channels of the target; called with a noisy target, its level
            and the conditions, as is `Denoiser`.
        task: Undistort or Deweather.
        lr, weight_decay, warmup_steps, schedule, metric_size: as for `Learner`.
        prediction: "v_prediction" or "epsilon", what the network predicts.
        sampler: "ddim", "dpm_solver" or "ddpm", which wants many steps.
        steps: of the sampler in `forward` and in an evaluation, from 1 to 1000.
        val_steps: of the sampler in a validation during training.
        crop: side of the squares that training looks at, px; None for whole frames, as where these are smaller.
        ema_decay: the share of the average that a step keeps, once there have been enough: of n, (1 + n) / (10 + n).
        seed: of all draws.

    Raises:
        ValueError: a number outside its range, a sampler or a prediction that is not known.
        TypeError: a number of the wrong kind, another task.

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
        options = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps, "schedule": schedule}
        super().__init__(network(target.channels), task, metric_size=metric_size, **options)
        self.target = target
        self.prediction = check_choice("prediction", prediction, _PREDICTIONS)
        self.sampler = check_choice("sampler", sampler, SAMPLERS)
        self.steps, self.val_steps = check_steps("steps", steps), check_steps("val_steps", val_steps)
        self.crop = None if crop is None else check_count("crop", crop)
        self.ema_decay = check_number("ema_decay", ema_decay, low=0.0, high=1.0)
        self.seed = check_count("seed", seed, low=0)
        self.levels = noise_levels()

    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """The restoration of images (B, 3, H, W) in [0, 1], each by itself; arguments as for `Learner`."""
        return self._sample(degraded, key, steps=self.steps)

    def learn(self, batch: Pair) -> tuple[Tensor, None]:
        """The loss at a level for each sample; the step is part of the draw, so that none comes twice."""
        source = self._draws(batch.key, 1 + self.global_step)
        return self._loss(self._crop(_whole(batch), source.at(0)), source), None

    def judge(self, batch: Pair) -> tuple[Tensor, Restored]:
        """The loss on whole frames, of the same draws each time, and the restoration."""
        loss = self._loss(_whole(batch), self._draws(batch.key, 0))
        training = self.trainer.state.fn == TrainerFn.FITTING
        return loss, self._sample(batch.degraded, batch.key, steps=self.val_steps if training else self.steps)

    def configure_callbacks(self) -> list[Callback]:
        """In training, the moving average of the weights."""
        return [WeightAveraging(avg_fn=self._average)] if self.trainer.state.fn == TrainerFn.FITTING else []

    def _average(self, average: Tensor, new: Tensor, count: Tensor) -> Tensor:
        # A short training would otherwise end with the weights that it began with.
        keep = ((1 + count) / (10 + count)).clamp(max=self.ema_decay)
        return torch.lerp(average, new, (1 - keep).to(average.dtype))

    def _draws(self, key: Tensor, step: int) -> Stream:
        # The complement: the corruption of a batch is drawn by the same keys, and seeds that are not negative.
        return stream(~((self.seed << 32) + step), key, device=self.device)

    def _crop(self, whole: _Part, source: Stream) -> _Part:
        """A square of each sample, or all of a side that is shorter; look-ups that leave it are not valid."""
        height, width = whole.size
        if self.crop is None or (height <= self.crop and width <= self.crop):
            return whole
        size = (min(self.crop, height), min(self.crop, width))
        room = torch.tensor([height - size[0] + 1, width - size[1] + 1])
        corners = (uniform(source.to(torch.device("cpu")), 2) * room).long().tolist()

        def cut(value: Tensor) -> Tensor:
            rows = zip(value, corners, strict=True)
            return torch.stack([v[:, y : y + size[0], x : x + size[1]] for v, (y, x) in rows])

        degraded, clean, flow, valid = (cut(value) for value in whole.pair[:4])
        pair = whole.pair._replace(degraded=degraded, clean=clean, flow=flow, valid=valid & inside(flow))
        return _Part(pair, cut(whole.condition), whole.size)

    def _loss(self, part: _Part, source: Stream) -> Tensor:
        """(), with noise and levels from a source."""
        pair, size = part.pair, part.size
        target = self.target.encode(pair, size)
        noise = normal(source.at(1), target)
        time = (uniform(source.at(2), 1)[:, 0] * LEVELS).long()
        noisy = self.levels.add_noise(target, noise, time)  # pyright: ignore[reportArgumentType]  # takes any int tensor
        found_noise, found = self._find(noisy, time, part.condition)
        restored = self.target.decode(found, pair.degraded, size)
        noise_error = masked_mean((found_noise - noise).abs(), pair.valid)
        image_error = masked_mean((restored.image - pair.clean).square(), pair.valid)
        return (_NOISE_WEIGHT * noise_error + self._kept(time) * image_error).mean()

    def _find(self, noisy: Tensor, time: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """The noise and the target."""
        predicted = self.network(noisy, time, condition)
        kept = self._kept(time).view(-1, 1, 1, 1)
        signal, spread = kept.sqrt(), (1 - kept).sqrt()
        if self.prediction == "epsilon":
            return predicted, (noisy - spread * predicted) / signal
        return spread * noisy + signal * predicted, signal * noisy - spread * predicted

    def _kept(self, time: Tensor) -> Tensor:
        return self.levels.alphas_cumprod.to(time.device)[time]

    @torch.no_grad()
    def _sample(self, degraded: Tensor, key: Tensor | None, *, steps: int) -> Restored:
        if key is None:
            key = torch.zeros(len(degraded), dtype=torch.int64)
        condition = conditions(degraded)

        def estimate(noisy: Tensor, time: Tensor) -> Tensor:
            return self._find(noisy, time, condition)[1].clamp(-1, 1)

        # A lane of its own: the loss of the validation has drawn from the others.
        source = self._draws(key, 0).at(3)
        start = normal(source, condition[:, : self.target.channels])
        target = sample(start, estimate, source.at(4), name=self.sampler, steps=steps)
        return self.target.decode(target, degraded, degraded.shape[2:])


def _whole(pair: Pair) -> _Part:
    return _Part(pair, conditions(pair.degraded), pair.clean.shape[2:])
