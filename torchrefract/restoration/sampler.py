"""From noise to a restoration, in as many steps as one can afford."""

from collections.abc import Callable
from typing import Any

import torch
from diffusers import DDPMScheduler, DPMSolverMultistepScheduler
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_choice, check_count
from torchrefract.random import Stream, noise_key

SAMPLERS = ("ddpm", "ddim", "dpm_solver")
LEVELS = 1000  # of noise, in training


def noise_levels() -> DDPMScheduler:
    """The levels of noise of the training: variances that grow linearly, 1000 of them."""
    return DDPMScheduler(LEVELS, beta_schedule="linear")


def check_steps(name: str, steps: int) -> int:
    """`steps` if a sampler can take so many."""
    if check_count(name, steps) > LEVELS:
        raise ValueError(f"{name} must be at most the {LEVELS} levels of noise of the training, got {steps}")
    return steps


def normal(source: Stream, like: Tensor) -> Tensor:
    """Standard normal noise in the shape (B, C, H, W) of `like`, of each sample by its stream alone."""
    count = like[0].numel()
    pairs = random.white_noise(noise_key(source).to(like.device), -(-count // 2))
    return pairs.flatten(1)[:, :count].view_as(like)


def sample(
    start: Tensor, estimate: Callable[[Tensor, Tensor], Tensor], source: Stream, *, name: str, steps: int
) -> Tensor:
    """The target that noise stands for.

    "ddpm" adds fresh noise after each step; it wants many. "ddim" and "dpm_solver" follow the mean path, the latter by
    steps of second order, in fewer.

    Args:
        start: (B, C, H, W), standard normal.
        estimate: the target, given a noisy one and its step (B,).
        source: of the fresh noise.
        name: of SAMPLERS.
        steps: from 1 to 1000.

    Returns:
        (B, C, H, W)

    Source: Ho, Jain, Abbeel, "Denoising diffusion probabilistic models", NeurIPS 2020; Song, Meng, Ermon, "Denoising
    diffusion implicit models", ICLR 2021; Lu et al., "DPM-Solver++", 2022.
    """
    scheduler = _scheduler(check_choice("sampler", name, SAMPLERS))
    # From the noisiest level down; diffusers' own spacing is uneven, or one step off, where `steps` does not divide.
    scheduler.set_timesteps(timesteps=[LEVELS * (steps - i) // steps - 1 for i in range(check_steps("steps", steps))])
    # On the CPU, so that every device draws the same.
    generators = [torch.Generator().manual_seed(word) for word in noise_key(source)[:, 0].tolist()]
    noisy = start
    for time in scheduler.timesteps.tolist():
        found = estimate(noisy, torch.full((len(start),), time, device=start.device))
        drawn: Any = generators  # one for each sample, where diffusers' annotation has one for all
        noisy = scheduler.step(found, time, noisy, generator=drawn, return_dict=False)[0]
    return noisy


def _scheduler(name: str) -> DDPMScheduler | DPMSolverMultistepScheduler:
    if name == "ddpm":
        return DDPMScheduler(LEVELS, beta_schedule="linear", prediction_type="sample", clip_sample=False)
    # DDIM is the solver of first order. That of diffusers takes LEVELS // steps for its stride, dividing or not.
    order = 1 if name == "ddim" else 2
    return DPMSolverMultistepScheduler(LEVELS, beta_schedule="linear", prediction_type="sample", solver_order=order)
