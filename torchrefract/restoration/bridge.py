"""Restoration in several steps, which begin at the degraded image instead of noise: `model=bridge`, for weather."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrefract.random import uniform
from torchrefract.restoration.diffusion import NUM_LEVELS, AveragedRestoration, ImageTarget, check_steps, target_of
from torchrefract.restoration.models.denoiser import conditions
from torchrefract.restoration.tasks import Restored, Task
from torchrefract.types import Pair


class Bridge(AveragedRestoration):
    """Train a network to change a degraded image into the clean one, at any point between the two.

        x_t = (1 - t) clean + t degraded,  t in (0, 1]
        loss = mean |network(x_t, t, degraded) - (clean - degraded)|
        x_(t - 1/K) = x_t + network(x_t, t, degraded) / K,  from x_1 = degraded to x_0, in K steps

    A diffusion model must draw from noise what the degraded image shows already. The difference of clean and degraded
    is the velocity of x_t, and a step of the sampler follows it. With one step it is a plain
    network; with more, each corrects what the earlier ones predicted. Nothing is drawn: an image has one restoration.

    Args:
        network: builds the network from the number of channels, see `Denoiser`.
        task: Deweather, without a transmission.
        lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
        steps: K, from 1 to 1000.
        ema_decay, seed: see `AveragedRestoration`; the seed is of the points t of the training.

    Raises:
        ValueError: a number is outside its range; the task also predicts a transmission.
        TypeError: the task is not Deweather.

    Source: Delbracio, Milanfar, "Inversion by direct iteration: an alternative to denoising diffusion for image
    restoration", TMLR 2023; Liu, Gong, Liu, "Flow straight and fast", ICLR 2023.
    """

    def __init__(
        self,
        network: Callable[[int], nn.Module],
        task: Task,
        *,
        lr: float = 1e-3,
        weight_decay: float = 1e-2,
        warmup_steps: int = 50,
        schedule: str = "cosine",
        metric_size: Sequence[int] = (1080, 1920),
        steps: int = 4,
        ema_decay: float = 0.999,
        seed: int = 0,
    ):
        if not isinstance(target_of(task), ImageTarget):
            raise TypeError(f"task must be Deweather for Bridge: add model=ddpm for a lens, got {type(task).__name__}")
        options: dict[str, Any] = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps}
        options |= {"schedule": schedule, "metric_size": metric_size, "ema_decay": ema_decay, "seed": seed}
        super().__init__(network(ImageTarget.channels), task, **options)
        self.steps = check_steps("steps", steps)

    @torch.no_grad()
    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """Restore images (B, 3, H, W) in [0, 1]. The key has no effect, because nothing is random."""
        image = degraded
        for step in range(self.steps):
            point = torch.full((len(image),), 1 - step / self.steps, dtype=torch.float32, device=image.device)
            image = image + self._change(image, point, degraded) / self.steps
        return Restored(image)

    def loss_of_step(self, batch: Pair, step: int) -> Tensor:
        """Compute the loss at a random point for each sample; see `AveragedRestoration.loss_of_step`."""
        point = 1 - uniform(self._stream(batch.key, step), 1)[:, 0]
        image = torch.lerp(batch.clean, batch.degraded, point.view(-1, 1, 1, 1))
        return (self._change(image, point, batch.degraded) - (batch.clean - batch.degraded)).abs().mean()

    def _change(self, image: Tensor, point: Tensor, degraded: Tensor) -> Tensor:
        """Predict clean - degraded from images at points (B,) between the two."""
        return self.network(2 * image - 1, (point * (NUM_LEVELS - 1)).round().long(), conditions(degraded))
