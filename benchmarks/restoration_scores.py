"""How near restorations come, effect by effect, beside what needs no network: for benchmarks/table1.py."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor
from torchrefract.effects.defog import remove_fog

from torchrefract._tensor import to_float, to_uint8
from torchrefract.data.module import make_pair
from torchrefract.effects.base import Effect
from torchrefract.effects.flare import LensFlare
from torchrefract.effects.lens import LensDistortion
from torchrefract.effects.one_of import OneOf
from torchrefract.presets import paper_refractive, paper_weather
from torchrefract.restoration.metrics import endpoint_error, masked_mean, psnr, ssim
from torchrefract.restoration.tasks import Restored
from torchrefract.types import Frame, Pair
from torchrefract.warping.warp import warp

METRIC_SIZE = (1080, 1920)  # px, that the paper gives its endpoint errors at
MIX = "all of the paper's"
_SEED = 1 << 40  # above the seeds that training and its validation draw from
_CONSTANT_DRAWS = 256

Restore = Callable[[Tensor], Restored]


class Scores(NamedTuple):
    """Means over frames; flow and endpoint error are NaN for a task without a flow.

    loss: image_loss + flow_loss, as the networks learn by.
    image_loss: mean |restored - clean| on valid pixels.
    flow_loss: mean |flow - true flow| there, in halves of the frame.
    psnr, ssim: dB, and none.
    epe: px at METRIC_SIZE.
    """

    loss: float
    image_loss: float
    flow_loss: float
    psnr: float
    ssim: float
    epe: float


def effects_of(task: str, width: int) -> dict[str, tuple[Effect, bool]]:
    """The effects that a task is scored on, by name, and whether the paper's mix has them."""
    if task == "undistort":
        names = ("cheap_dashcam lens", "turbulence", "thin-plate spline", "divergence-free")
        wide = LensDistortion(k1_range=(-0.4, 0.2), focal_range=(0.9, 1.1))
        return _in_mix(paper_refractive(width=width), names) | {"wide lens": (wide, False)}
    return _in_mix(paper_weather(), ("uniform fog", "heterogeneous fog", "lens flare"))


def _in_mix(mix: OneOf, names: Sequence[str]) -> dict[str, tuple[Effect, bool]]:
    return {name: (cast(Effect, effect), True) for name, effect in zip(names, mix.effects, strict=True)}


def corrupted(frames: Iterable[Frame], effect: Effect) -> list[Pair]:
    """Batches and what an effect makes of them, by draws that depend on the frames' keys alone."""
    return [make_pair(frame, effect, seed=_SEED) for frame in frames]


def references(task: str, effect: Effect, frames: Iterable[Frame], pairs: list[Pair]) -> dict[str, Tensor]:
    """The scores, as of `score`, of what needs no network: nothing, the best constant flow, and the true map."""
    if task == "undistort":
        constant = constant_flow(effect, pairs[0].clean)
        rivals: dict[str, Iterator[Restored]] = {
            "do nothing": (Restored(pair.degraded, torch.zeros_like(pair.flow)) for pair in pairs),
            "best constant flow": (_along(pair, constant.expand_as(pair.flow)) for pair in pairs),
            "the true flow": (_along(pair, pair.flow) for pair in pairs),
        }
    else:
        rivals = {
            "do nothing": (Restored(pair.degraded) for pair in pairs),
            "the true map": (Restored(undone(frame, effect)) for frame in frames),
        }
    return {name: score(restored, pairs) for name, restored in rivals.items()}


def score(restored: Iterable[Restored], pairs: list[Pair]) -> Tensor:
    """(N, 6), float64, in the order of `Scores`: each frame of batches."""
    found = torch.cat([_scores(one, pair) for one, pair in zip(restored, pairs, strict=True)])
    return found.double().cpu()


def mean_of(frames: Tensor) -> Scores:
    """The means over frames (N, 6)."""
    return Scores(*frames.mean(dim=0).tolist())


def constant_flow(effect: Effect, like: Tensor) -> Tensor:
    """(1, 2, H, W), px: the mean restore flow of other draws than the ones that are scored, on their valid pixels."""
    keys = torch.arange(_CONSTANT_DRAWS, device=like.device).split(8)
    total, count = torch.zeros_like(like[:1, :2], dtype=torch.float64), torch.zeros_like(like[:1, :1])
    for some in keys:
        blank = Frame(like.new_zeros(len(some), *like.shape[1:]), some, torch.empty(0))
        pair = make_pair(blank, effect, seed=_SEED - 1)
        total += (pair.flow * pair.valid).sum(dim=0, keepdim=True)
        count += pair.valid.sum(dim=0, keepdim=True)
    return (total / count.clamp(min=1)).to(like)


def undone(frame: Frame, effect: Effect) -> Tensor:
    """(B, 3, H, W): the clean image from the degraded one in 8 bits and the true map, where that leaves any of it."""
    degraded = effect.degrade(frame.image, seed=_SEED, keys=frame.key)
    image = to_float(to_uint8(degraded.image))
    if isinstance(effect, LensFlare):
        return torch.where(degraded.valid, image - degraded.intensity, image)
    return remove_fog(image, degraded.transmission, degraded.params.airlight)[0].clamp(0, 1)


def _along(pair: Pair, flow: Tensor) -> Restored:
    return Restored(warp(pair.degraded, flow, padding="border")[0], flow)


def _scores(restored: Restored, pair: Pair) -> Tensor:
    """(B, 6), in the order of `Scores`."""
    image = restored.image.float().clamp(0, 1)
    image_loss = masked_mean((image - pair.clean).abs(), pair.valid)
    flow_loss = epe = torch.full_like(image_loss, torch.nan)
    if restored.flow is not None:
        size = pair.flow.new_tensor([pair.flow.shape[3], pair.flow.shape[2]]).view(1, 2, 1, 1)
        flow_loss = masked_mean((restored.flow - pair.flow).abs() * 2 / size, pair.valid)
        epe = endpoint_error(restored.flow, pair.flow, pair.valid, size=METRIC_SIZE)
    loss = image_loss + flow_loss.nan_to_num()
    near = psnr(image, pair.clean, pair.valid), ssim(image, pair.clean, pair.valid)
    return torch.stack([loss, image_loss, flow_loss, *near, epe], dim=1)
