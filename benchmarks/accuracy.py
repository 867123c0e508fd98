"""How far the values of a knob are from the truth, which is computed densely in float64."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any, NamedTuple

import torch
from composites import spline_read
from one_resample import sound
from sweeps import Variant
from torch import Tensor

from torchrefract.effects.base import Effect
from torchrefract.warping.grid import length

SEED = 7


class Errors(NamedTuple):
    """Of one frame, or over several."""

    largest_px: float | None
    mean_px: float | None
    largest_levels: float
    mean_levels: float
    square: float  # mean, of values in [0, 1]


class Truth(NamedTuple):
    """What a frame should become, in float64."""

    image: Tensor  # (1, C, H, W)
    flow: Tensor | None  # (1, 2, H, W), px
    good: Tensor  # (1, 1, H, W), bool, the pixels of the image that are judged


def frame_errors(variants: Sequence[Variant], frame: Tensor, key: int) -> list[Errors]:
    """Of each variant on one frame (1, 3, H, W), whose key is that of the draw."""
    truths: dict[tuple[Any, bool], Truth] = {}
    found = []
    for variant in variants:
        group = variant.truth, variant.sharp
        if group not in truths:
            truths = {group: truth(variant, frame, key)}  # the last one alone: they are large
        effect = variant.make()
        made = effect.apply(frame, draw_params(effect, frame, key))
        found.append(compare(made.image, made.flow, truths[group]))
    return found


def truth(variant: Variant, frame: Tensor, key: int) -> Truth:
    """What the variant is held against, for one draw."""
    effect = variant.truth()
    made = effect.apply(frame.double(), draw_params(effect, frame, key).to(torch.float64))
    if not variant.sharp:
        return Truth(made.image, made.flow, torch.ones_like(made.valid))
    return Truth(spline_read(frame, made.flow).clamp(0, 1), made.flow, sound(made.valid, made.flow))


def draw_params(effect: Effect, frame: Tensor, key: int) -> Any:
    """The draw of a key, the same for all values of a knob."""
    return effect.sample(frame, seed=SEED, keys=[key])


def compare(image: Tensor, flow: Tensor | None, true: Truth) -> Errors:
    """An image (1, C, H, W) and its flow against the truth."""
    off = (image.clamp(0, 1).double() - true.image)[true.good.expand_as(image)].abs()
    px = None if flow is None or true.flow is None else length(flow.double() - true.flow)
    return Errors(
        None if px is None else px.max().item(),
        None if px is None else px.mean().item(),
        255 * off.max().item(),
        255 * off.mean().item(),
        off.square().mean().item(),
    )


def together(found: Sequence[Errors]) -> Errors:
    """Over frames of one size: the largest of what is largest, and means."""
    still = found[0].largest_px is None
    return Errors(
        None if still else max(error.largest_px or 0.0 for error in found),
        None if still else fmean(error.mean_px or 0.0 for error in found),
        max(error.largest_levels for error in found),
        fmean(error.mean_levels for error in found),
        fmean(error.square for error in found),
    )


def decibels(square: float) -> float:
    """PSNR of a mean square error."""
    return math.inf if square == 0 else -10 * math.log10(square)
