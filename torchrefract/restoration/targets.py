"""What a diffusion model makes out of noise: the restoration of each task, in numbers of about [-1, 1]."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrefract._tensor import as_device_tensor
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort
from torchrefract.types import Pair
from torchrefract.warping.warp import warp

_MU = 100.0


class Target(nn.Module, ABC):
    """A restoration as `channels` maps. What decodes them is in its state, so that weights for another do not fit."""

    channels: int

    @abstractmethod
    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """(B, channels, H, W), within [-1, 1]: the true one of a pair, cut from a frame of `size` = (height, width)."""

    @abstractmethod
    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """The restoration of images (B, 3, H, W), cut from a frame of `size`."""


class FlowTarget(Target):
    """The flow that undoes a warp, companded; the image is looked up along it. `limit`: of the task.

        target = sign(r) ln(1 + mu |r|) / ln(1 + mu),  r = flow / (limit (W, H)),  mu = 100

    Most flows of a mix are a few hundredths of its longest. Told by r itself they would be lost in what a denoiser
    leaves of the noise, whose height is the same for every pixel; this law gives each tenfold of them a like share.

    Source: the mu-law of ITU-T G.711, Pulse code modulation (1988), which has 255 for speech.
    """

    channels = 2
    mu: Tensor

    def __init__(self, limit: float):
        super().__init__()
        self.limit = limit
        self.register_buffer("mu", torch.tensor(_MU))

    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """The flow, what is beyond the limit cut off."""
        # What no look-up can give back may be anything, and the network sees it beside what counts.
        share = (pair.flow / self._unit(pair.flow, size)).nan_to_num(0.0).clamp(-1, 1)
        return torch.log1p(self.mu * share.abs()).copysign(share) / self.mu.log1p()

    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """The image looked up along the flow."""
        target = target.clamp(-1, 1)  # the law grows a hundredfold from one to two
        share = torch.expm1(self.mu.log1p() * target.abs()).copysign(target) / self.mu
        flow = share * self._unit(target, size)
        return Restored(warp(degraded, flow, padding="border")[0], flow)

    def _unit(self, like: Tensor, size: Sequence[int]) -> Tensor:
        return self.limit * as_device_tensor([size[1], size[0]], dtype=like.dtype, device=like.device).view(1, 2, 1, 1)


class ImageTarget(Target):
    """The clean image, 2 clean - 1."""

    channels = 3

    def encode(self, pair: Pair, size: Sequence[int]) -> Tensor:
        """The clean image from -1 to 1."""
        return 2 * pair.clean - 1

    def decode(self, target: Tensor, degraded: Tensor, size: Sequence[int]) -> Restored:
        """The image from 0 to 1."""
        return Restored((target + 1) / 2)


def target_of(task: Task) -> Target:
    """What stands for the restoration of a task.

    Raises:
        TypeError: a task of another kind.
        ValueError: a task that has a transmission predicted, too.
    """
    if isinstance(task, Undistort):
        return FlowTarget(task.limit)
    if isinstance(task, Deweather):
        if task.channels != ImageTarget.channels:
            raise ValueError("task.transmission_head must be false for a diffusion model, got true")
        return ImageTarget()
    raise TypeError(f"task must be Undistort or Deweather for a diffusion model, got {type(task).__name__}")
