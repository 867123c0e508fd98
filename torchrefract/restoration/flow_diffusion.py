"""Diffusion of the numbers of a lens, given the frame, which gives its flow and a deviation: `model=ddpm`."""

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, cast

import torch
from diffusers import DDPMScheduler
from torch import Tensor, nn

from torchrefract._tensor import without_autocast
from torchrefract._validation import UsageError, check_count
from torchrefract.random import Stream, uniform
from torchrefract.restoration.diffusion import NUM_LEVELS, AveragedRestoration, check_steps, normal, sample
from torchrefract.restoration.models.coordconv import NUM_TERMS, cell_axes, polynomial_basis
from torchrefract.restoration.tasks import Restored, Task, Undistort, frame_sides
from torchrefract.types import Pair
from torchrefract.warping.warp import warp

_SCHEDULE = "squaredcos_cap_v2"  # the cosine of diffusers
_STRIDE = 4  # px, between the pixels that tell the coefficients of a flow
_NUM_NOISY = 8  # noisy versions of each sample in a step
_RIDGE = 1e-6  # of the number of pixels: a frame with few valid pixels has small coefficients
_WEAKEST = 1e-2  # of the strongest component, the least deviation that a component is divided by


class FlowDiffusion(AveragedRestoration):
    """Train a conditional diffusion model of the flow that undoes a lens.

        flow = (W, H) sum_t c_t basis_t,  c = mean + sum_i z_i component_i,  noisy = sqrt(a) z + sqrt(1 - a) noise
        loss = mean ((z - predicted mean) / predicted deviation)^2 / 2 + log predicted deviation

    The coefficients c of the flow are those of `polynomial_basis`, over valid pixels. Their mean and principal
    components in the first batch, scaled to unit deviation, turn them into a few numbers z. The network predicts the
    mean and the deviation of z from noisy ones at a level of the cosine schedule and from the frame, see
    `LensDenoiser`.

    A step of the sampler draws z from the predicted distribution, and then the noisy z of the next level given both.
    Without the predicted deviation, few steps would draw samples that are too much alike. The mean of the samples of a
    frame is the restoration, and their standard deviation its uncertainty. That is as good as the training:
    `val/coverage` is the share of the flow within two deviations on the validation frames, 0.95 if they are right.

    Args:
        network: builds the network from the number of components, see `LensDenoiser`.
        task: Undistort.
        lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
        components: number of principal components, at most 42; an ordinary lens has fewer than 8.
        steps: steps of the sampler, from 1 to 1000.
        samples: number of samples of each frame; the deviation needs at least 2.
        ema_decay, seed: see `AveragedRestoration`.

    Raises:
        ValueError: a number is outside its range.
        TypeError: the task is not Undistort.

    Source: Ho, Jain, Abbeel, "Denoising diffusion probabilistic models", NeurIPS 2020; Nichol, Dhariwal, "Improved
    denoising diffusion probabilistic models", ICML 2021, for the cosine; Bao, Li, Sun, Zhu, Zhang, "Estimating the
    optimal covariance with imperfect mean in diffusion probabilistic models", ICML 2022, for the deviation.
    """

    center: Tensor
    components: Tensor

    def __init__(
        self,
        network: Callable[[int], nn.Module],
        task: Task,
        *,
        lr: float = 4e-3,
        weight_decay: float = 1e-2,
        warmup_steps: int = 50,
        schedule: str = "cosine",
        metric_size: Sequence[int] = (1080, 1920),
        components: int = 8,
        steps: int = 4,
        samples: int = 64,
        ema_decay: float = 0.999,
        seed: int = 0,
    ):
        if not isinstance(task, Undistort):
            raise TypeError(
                f"task must be Undistort for FlowDiffusion: add model=bridge for an image, got {type(task).__name__}"
            )
        num_coefficients = task.channels * NUM_TERMS
        if check_count("components", components) > num_coefficients:
            raise ValueError(f"components must be at most {num_coefficients}, got {components}")
        options: dict[str, Any] = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps}
        options |= {"schedule": schedule, "metric_size": metric_size, "ema_decay": ema_decay, "seed": seed}
        super().__init__(network(components), task, **options)
        self.steps, self.samples = check_steps("steps", steps), check_count("samples", samples)
        self.levels = DDPMScheduler(NUM_LEVELS, beta_schedule=_SCHEDULE)
        # Of the coefficients, in shares of width and height; components are scaled to the deviation along them.
        self.register_buffer("center", torch.zeros(num_coefficients))
        self.register_buffer("components", torch.zeros(components, num_coefficients))

    @property
    def has_deviation(self) -> bool:
        """Return True for at least two samples."""
        return self.samples > 1

    @torch.no_grad()
    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """Restore images (B, 3, H, W) in [0, 1] by the mean of the samples, with the deviation of the flow, px.

        One sample has no deviation. The key is that of `RestorationModule.forward`.
        """
        key = torch.zeros(len(degraded), dtype=torch.int64) if key is None else key
        numbers = self._sample(cast(Any, self.network).encode(degraded), self._stream(key, 0))
        mean = numbers.mean(dim=1)
        rest = numbers - mean[:, None]
        with without_autocast(degraded.device):
            basis = polynomial_basis(*cell_axes(degraded, 1))
            coefficients = torch.cat([self.center[None], self.components]).unflatten(1, (2, -1))
            maps = frame_sides(degraded) * torch.einsum("kct,thw->kchw", coefficients, basis)  # px
            center, maps = maps[0], maps[1:]
            flow = center + torch.einsum("bk,kchw->bchw", mean, maps)
            restored = Restored(warp(degraded, flow, padding="border")[0], flow)
            if not self.has_deviation:
                return restored
            covariance = rest.mT @ rest / (self.samples - 1)
            variance = (torch.einsum("bkl,lchw->bkchw", covariance, maps) * maps).sum(dim=1)
        return restored._replace(deviation=variance.clamp(min=0).sqrt())

    def training_loss(self, batch: Pair) -> tuple[Tensor, None]:
        """Compute the loss; raise UsageError if the first batch has no more lenses than there are components."""
        if not self.components.any():
            self._find_components(batch)
        return super().training_loss(batch)

    def loss_of_step(self, batch: Pair, step: int) -> Tensor:
        """Compute the loss at random levels for each sample; see `AveragedRestoration.loss_of_step`."""
        source, features = self._stream(batch.key, step), cast(Any, self.network).encode(batch.degraded)
        variance = self.components.square().sum(dim=1)
        with without_autocast(batch.flow.device):
            numbers = (fit_polynomial(batch) - self.center) @ self.components.mT / variance
        numbers = numbers[:, None].expand(-1, _NUM_NOISY, -1)
        # One level in each of equal parts of the range, so that the loss varies less from step to step.
        parts = torch.arange(_NUM_NOISY, device=numbers.device)
        time = ((uniform(source.at(2), _NUM_NOISY) + parts) * (NUM_LEVELS / _NUM_NOISY)).long()
        share = self._share(time)
        noisy = share.sqrt() * numbers + (1 - share).sqrt() * normal(source.at(1), numbers)
        mean, deviation = self.network(noisy, share, features)
        loss = ((numbers - mean) / deviation).square() / 2 + deviation.log()
        return (loss.mean(dim=(1, 2)) * batch.valid.flatten(1).any(dim=1)).mean()

    def _sample(self, features: Tensor, source: Stream) -> Tensor:
        """Draw the numbers of the lens, (B, samples, components)."""
        # All samples of an image are in its noise, so that they depend on its key alone.
        start = normal(source.at(3), self.components[:, :1].T.expand(len(features), self.samples, -1))
        lanes = count(5)

        def draw(noisy: Tensor, time: Tensor) -> Tensor:
            share = self._share(time[:, None].expand(-1, self.samples))
            mean, deviation = self.network(noisy, share, features)
            return mean + deviation * normal(source.at(next(lanes)), noisy)

        return sample(start, draw, source.at(4), name="ddpm", steps=self.steps, schedule=_SCHEDULE)

    def _share(self, time: Tensor) -> Tensor:
        """Return a of the class docstring, (B, K, 1), at levels (B, K)."""
        return self.levels.alphas_cumprod.to(time.device)[time][..., None]

    def _find_components(self, batch: Pair) -> None:
        """Find the mean and the principal components of the coefficients of a batch, over all ranks."""
        num_lenses, num_components = len(batch.flow) * self.trainer.world_size, len(self.components)
        if num_lenses <= num_components:
            raise UsageError(
                f"data.batch_size must be above model.components={num_components}, which are those of the lenses of "
                f"the first batch, got {num_lenses}: raise it, or lower model.components"
            )
        coefficients = fit_polynomial(batch).double()  # autocast leaves doubles as they are
        reduce = self.trainer.strategy.reduce
        mean = reduce(coefficients.mean(dim=0), reduce_op="mean")
        rest = coefficients - mean
        values, vectors = torch.linalg.eigh(reduce(rest.mT @ rest / len(rest), reduce_op="mean"))
        deviation = values.clamp(min=0).sqrt().flip(0)[: len(self.components)]
        deviation = deviation.clamp(min=float((_WEAKEST * deviation[0]).clamp(min=1e-6)))
        self.center.copy_(mean)
        self.components.copy_(deviation[:, None] * vectors.T.flip(0)[: len(self.components)])


def fit_polynomial(pair: Pair) -> Tensor:
    """Fit polynomials to the valid flows of pairs, in shares of width and height; return coefficients (B, 2 * 21)."""
    shares = pair.flow / frame_sides(pair.flow)
    flow, valid = (value[:, :, ::_STRIDE, ::_STRIDE].flatten(2) for value in (shares, pair.valid))
    basis = polynomial_basis(*cell_axes(pair.flow, 1))[:, ::_STRIDE, ::_STRIDE].flatten(1).double()
    weighted = basis * valid  # (B, 21, n)
    ridge = _RIDGE * basis.shape[1] * torch.eye(NUM_TERMS, dtype=basis.dtype, device=basis.device)
    sums = weighted @ torch.where(valid, flow, 0.0).mT.double()
    return torch.linalg.solve(weighted @ basis.T + ridge, sums).mT.flatten(1).to(pair.flow)
