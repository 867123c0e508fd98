"""Compare the rise of a loss by `worst_case` with that by random search, at equal calls of the model.

    python benchmarks/worst_case.py [--count 8] [--size 90x160] [--steps 8] [--restarts 1]

Frames are rendered roads with keys from 9000 on, on which nothing was tuned. For each, `worst_case` makes `steps`
calls in each of its restarts, and random search as many draws with the same seeds; the rise is the highest loss less
that of the clean frame. A row states the mean rises over the frames, their ratio, and its 95 % interval by resampling
of the frames. A call of `worst_case` with its gradient takes about three times as long as one without.

A fog of one number leaves little to a search of many calls. The loss rises with the density of the fog, and the densest
of N random draws lies on average 1 / (N + 1) of the range below its end, 11 % for 8 draws and 2.4 % for 40: all that is
left is the rise over that piece. Ratios grow with the number of parameters that must be bad together.

Models, which need no weights: a segmenter of colors and positions, whose loss is the cross-entropy of its classes for
the clean frame, moved along the flow; and a convolutional network with random weights, whose loss is the squared
change of its features.
"""

import argparse
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from timing import Bar, count, size
from torch import Tensor, nn
from torchvision import tv_tensors

from torchrefract import (
    Compose,
    HeterogeneousFog,
    LensDistortion,
    SunGlare,
    ThinPlateSpline,
    UniformFog,
    presets,
    worst_case,
)
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect

LIMIT = 1.3  # of the rise by `worst_case` over that by random search
_FIRST_KEY = 9000
_RESAMPLES = 1000


def effects() -> dict[str, Effect]:
    """Return the effects by name, with their default ranges or those of scenes."""
    fog, lens, glare = UniformFog(visibility_range=(40, 400)), LensDistortion(), SunGlare()
    return {
        "UniformFog": fog,
        "HeterogeneousFog": HeterogeneousFog(visibility_range=(40, 400)),
        "cape_town_fog": presets.cape_town_fog(3),
        "lens": lens,
        "glare": glare,
        "composition": Compose([ThinPlateSpline(), lens, fog, glare]),
    }


def segmenter(images: Tensor) -> Tensor:
    """Return scores (B, 4, H, W) of other, sky, plants and road."""
    red, green, blue = images.unbind(1)
    down = torch.linspace(0, 1, images.shape[2], dtype=images.dtype, device=images.device)[:, None]
    sky, road = 4 * (blue - 0.5 * red) * (0.6 - down), down * (0.45 - 3 * (images.mean(dim=1) - 0.35).abs())
    return 8 * torch.stack([torch.full_like(red, 0.12), sky, 8 * (green - torch.maximum(red, blue)), road], dim=1)


def segmenter_target(frames: Tensor) -> tv_tensors.Mask:
    """Return the classes of clean frames, (B, H, W)."""
    return tv_tensors.Mask(segmenter(frames).argmax(dim=1))


def segmenter_loss(images: Tensor, target: Tensor) -> Tensor:
    """Compute the cross-entropy of each sample, (B,)."""
    classes = target.as_subclass(Tensor)
    return F.cross_entropy(segmenter(images), classes, reduction="none").mean(dim=(1, 2))


@lru_cache
def network() -> nn.Module:
    """Return a convolutional network with random weights, from images to 36 features."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        layers = [nn.Conv2d(3, 8, 5, 2), nn.Tanh(), nn.Conv2d(8, 8, 5, 2), nn.Tanh(), nn.AdaptiveAvgPool2d(3)]
        return nn.Sequential(*layers, nn.Flatten(), nn.Linear(72, 36)).requires_grad_(False)


def network_target(frames: Tensor) -> Tensor:
    """Return the features of clean frames, (B, 36), which do not move along a flow."""
    return network()(frames)


def network_loss(images: Tensor, target: Tensor) -> Tensor:
    """Compute how far the features move from those of the clean frame, squared, (B,)."""
    return (network()(images) - target).square().sum(dim=1)


MODELS = {"segmenter": (segmenter_target, segmenter_loss), "network": (network_target, network_loss)}


class Rises(NamedTuple):
    """The rise of the loss of each frame, (n,)."""

    search: np.ndarray
    random: np.ndarray

    def ratio(self) -> tuple[float, float, float]:
        """Return the ratio of the mean rises, with its 95 % interval."""
        rows = np.random.default_rng(0).integers(0, len(self.search), (_RESAMPLES, len(self.search)))
        ratios = self.search[rows].mean(axis=1) / self.random[rows].mean(axis=1)
        low, high = np.quantile(ratios, [0.025, 0.975])
        return float(self.search.mean() / self.random.mean()), float(low), float(high)


def rises(
    effect: Effect,
    frames: Sequence[Tensor],
    target_of: Callable[[Tensor], Tensor],
    loss: Callable[[Tensor, Tensor], Tensor],
    *,
    steps: int,
    restarts: int,
) -> Rises:
    """Search the worst case of each frame (3, H, W) in both ways, with the same keys."""
    values: dict[int, list[float]] = {steps: [], 1: []}
    for key, frame in enumerate(frames, _FIRST_KEY):
        image = frame[None]
        target = target_of(image)
        clean = loss(image, target).item()
        for number in (steps, 1):
            options = {"steps": number, "restarts": steps * restarts // number, "keys": [key]}
            values[number].append(worst_case(loss, effect, image, target, **options).loss.item() - clean)
    return Rises(np.array(values[steps]), np.array(values[1]))


def main() -> None:
    """Measure and print; a limit that does not hold is marked and is no failure of the command."""
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--size", type=size, default=(90, 160), help="height x width of rendered roads, 90x160")
    options.add_argument("--count", type=count(2), default=8, help="frames, 8")
    options.add_argument("--steps", type=count(2), default=8, help="calls of each restart, 8")
    options.add_argument("--restarts", type=count(1), default=1, help="draws to begin at, 1")
    options.add_argument("--effects", nargs="*", default=list(effects()), choices=list(effects()), help="all")
    args = options.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of the assumed depth
    frames = list(render_road_scenes(torch.arange(_FIRST_KEY, _FIRST_KEY + args.count), *args.size)[0])
    print(f"{args.count} frames, {args.steps * args.restarts} calls each; rise of the loss: search, random, ratio")
    for model, (target_of, loss) in MODELS.items():
        for name in args.effects:
            of = rises(effects()[name], frames, target_of, loss, steps=args.steps, restarts=args.restarts)
            ratio, low, high = of.ratio()
            print(
                f"{model:10} {name:17} {of.search.mean():8.4f} {of.random.mean():8.4f}  [{low:.2f}, {high:.2f}]  ",
                end="",
            )
            print(Bar(name, ratio, ">=", LIMIT, "x random search"), flush=True)


if __name__ == "__main__":
    main()
