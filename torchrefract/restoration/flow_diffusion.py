"""Diffusion of a smooth flow on a lattice, given the whole frame: `model=ddpm`."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from diffusers import DDPMScheduler
from diffusers.schedulers.scheduling_ddpm import betas_for_alpha_bar
from torch import Tensor, nn

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_count, check_positive
from torchrefract.random import uniform
from torchrefract.restoration.diffusion import NUM_LEVELS, AveragedRestoration, check_steps, normal, sample
from torchrefract.restoration.metrics import masked_mean
from torchrefract.restoration.models.denoiser import lattice_size
from torchrefract.restoration.tasks import Restored, Task, Undistort
from torchrefract.types import Pair
from torchrefract.warping.warp import warp


class FlowDiffusion(AveragedRestoration):
    """Train a conditional diffusion model of the flow that undoes a warp.

        noisy = sqrt(a) target + sqrt(1 - a) noise
        loss = mean |predicted target - target|, over valid nodes
        a / (1 - a) = c / (1 - c) / shift^2,  c of the cosine schedule with 1000 levels

    The target is the flow at the nodes of a lattice, in shares of width and height, divided by its root mean square in
    the first batch. The network predicts it from the whole frame, see `LatticeDenoiser`. DDIM samples it in few steps.
    The mean of some samples is the restoration. Their spread is no measured uncertainty: after short trainings, all
    samples of a frame are alike, and so is their error.

    A lens is a few numbers, which every node shows. Therefore the noise of one number is smaller than that of a node by
    about the square root of their count, and without `shift` a noisy target would tell the lens at nearly all levels.

    Args:
        network: builds the network from the number of channels of the target, see `LatticeDenoiser`.
        task: Undistort.
        lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
        steps: steps of DDIM, from 1 to 1000.
        samples: number of samples that are averaged; the deviation needs at least 2.
        shift: factor of the noise over that of the cosine schedule, about the square root of the number of nodes.
        ema_decay, seed: see `AveragedRestoration`.

    Raises:
        ValueError: a number is outside its range.
        TypeError: the task is not Undistort.

    Source: Ho, Jain, Abbeel, "Denoising diffusion probabilistic models", NeurIPS 2020; Nichol, Dhariwal, "Improved
    denoising diffusion probabilistic models", ICML 2021, for the cosine; Hoogeboom, Heek, Salimans, "simple diffusion",
    ICML 2023, for the shift; Saxena et al., "The surprising effectiveness of diffusion models for optical flow and
    monocular depth estimation", NeurIPS 2023, for a flow with an L1 loss.
    """

    deviation: Tensor

    def __init__(
        self,
        network: Callable[[int], nn.Module],
        task: Task,
        *,
        lr: float = 2e-3,
        weight_decay: float = 1e-2,
        warmup_steps: int = 50,
        schedule: str = "cosine",
        metric_size: Sequence[int] = (1080, 1920),
        steps: int = 4,
        samples: int = 8,
        shift: float = 16.0,
        ema_decay: float = 0.999,
        seed: int = 0,
    ):
        if not isinstance(task, Undistort):
            raise TypeError(
                "task must be Undistort for FlowDiffusion: add model=ddpm_image for the diffusion of an image, got "
                f"{type(task).__name__}"
            )
        options: dict[str, Any] = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps}
        options |= {"schedule": schedule, "metric_size": metric_size, "ema_decay": ema_decay, "seed": seed}
        super().__init__(network(task.channels), task, **options)
        self.steps, self.samples = check_steps("steps", steps), check_count("samples", samples)
        self.betas = _shifted_cosine(check_positive("shift", shift))
        self.levels = DDPMScheduler(NUM_LEVELS, trained_betas=self.betas.numpy())
        self.register_buffer("deviation", torch.zeros(2))  # of the flow, in shares of width and height

    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """Restore images (B, 3, H, W) in [0, 1] by the mean of the samples; see `RestorationModule.forward`."""
        flow = self.flow_and_deviation(degraded, key)[0]
        return Restored(warp(degraded, flow, padding="border")[0], flow)

    @torch.no_grad()
    def flow_and_deviation(self, degraded: Tensor, key: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Sample flows, and return their mean (B, 2, H, W) and standard deviation per axis (B, 2, H, W), px.

        The deviation is 0 for one sample. The arguments are those of `forward`.
        """
        key = torch.zeros(len(degraded), dtype=torch.int64) if key is None else key
        source = self._stream(key, 0)
        condition = cast(Any, self.network).encode(degraded)
        like = condition.guess.repeat(1, self.samples, 1, 1)
        # All samples of an image are in its noise, so that they depend on its key alone.
        start = normal(source.at(3), like).unflatten(1, (self.samples, -1)).flatten(0, 1)
        repeated = type(condition)(*(part.repeat_interleave(self.samples, dim=0) for part in condition))

        def predict_target(noisy: Tensor, time: Tensor) -> Tensor:
            return self.network(noisy, time, repeated)

        target = sample(start, predict_target, source, name="ddim", steps=self.steps, betas=self.betas)
        flows = self._decode(target, degraded).unflatten(0, (-1, self.samples))
        return flows.mean(dim=1), flows.std(dim=1, correction=int(self.samples > 1))

    def training_loss(self, batch: Pair) -> tuple[Tensor, None]:
        """Compute the loss at a random level for each sample; each step has its own draws."""
        if not self.deviation.any():
            self.deviation.copy_(self._root_mean_square(batch))
        return self._loss(batch, 1 + self.global_step), None

    def validation_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        """Compute the loss with the same draws each time, and the restoration."""
        return self._loss(batch, 0), self(batch.degraded, batch.key)

    def _loss(self, batch: Pair, step: int) -> Tensor:
        source = self._stream(batch.key, step)
        target, valid = self._encode(batch)
        noise = normal(source.at(1), target)
        time = (uniform(source.at(2), 1)[:, 0] * NUM_LEVELS).long()
        noisy = self.levels.add_noise(target, noise, time)  # pyright: ignore[reportArgumentType]  # takes any int tensor
        predicted = self.network(noisy, time, cast(Any, self.network).encode(batch.degraded))
        return masked_mean((predicted - target).abs(), valid).mean()

    def _root_mean_square(self, batch: Pair) -> Tensor:
        """Return the root mean square of the valid flow in shares of width and height, (2,), over all ranks."""
        share = torch.where(batch.valid, batch.flow, 0.0) / _sides(batch.flow)
        mean = share.square().sum(dim=(0, 2, 3)) / batch.valid.sum().clamp(min=1)
        return self.trainer.strategy.reduce(mean, reduce_op="mean").sqrt().clamp(min=1e-6)

    def _encode(self, pair: Pair) -> tuple[Tensor, Tensor]:
        """Return the target at the nodes, (B, 2, h, w), and its validity, (B, 1, h, w)."""
        flow = torch.where(pair.valid, pair.flow, 0.0)
        scaled = flow / (_sides(flow) * self.deviation.view(1, 2, 1, 1))
        maps = torch.cat([scaled, pair.valid.to(flow)], dim=1)
        maps = F.interpolate(maps, lattice_size(flow), mode="bilinear", align_corners=True)
        return maps[:, :2], maps[:, 2:] > 1 - 1e-3

    def _decode(self, target: Tensor, degraded: Tensor) -> Tensor:
        """Interpolate the target to a flow, px, of the size of the images."""
        flow = F.interpolate(target, degraded.shape[2:], mode="bicubic", align_corners=True)
        return flow * (_sides(flow) * self.deviation.view(1, 2, 1, 1))


def _sides(flow: Tensor) -> Tensor:
    """Return width and height, (1, 2, 1, 1)."""
    sides = [flow.shape[3], flow.shape[2]]
    return as_device_tensor(sides, dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)


def _shifted_cosine(shift: float) -> Tensor:
    """Return the betas of the cosine schedule with `shift` times the noise, (1000,)."""
    share = torch.cumprod(1 - betas_for_alpha_bar(NUM_LEVELS).double(), dim=0)
    share = share / (share + (1 - share) * shift**2)
    before = torch.cat([torch.ones(1, dtype=torch.float64), share[:-1]])
    return (1 - share / before).clamp(max=0.999).float()
