"""Warps by random fields, here and at the peers, on one frame."""

import importlib
import math
from collections.abc import Mapping
from itertools import count
from types import ModuleType
from typing import Any

import numpy as np
import torch
from timing import Candidate
from torch import Tensor

from torchrefract import DivergenceFree, Turbulence

LENGTH_PX = 20.0
FIELD_PX = 1.0
TOLERANCE_PX = 0.05
MODES = 1000  # of the paper's fields
# White noise of variance 1, blurred by a Gaussian of standard deviation s, has standard deviation 1 / (2 sqrt(pi) s).
_BLURRED = 1 / (2 * math.sqrt(math.pi) * LENGTH_PX)
_LARGEST_NORMAL = 5.3  # of as many normal numbers as a 1080p frame has: what albumentations divides its noise by
_TAPS = 17  # so few of them are nearly a box, which divides the standard deviation by their number


def candidates(frame: Tensor, pixels: Any, peers: Mapping[str, ModuleType]) -> dict[str, Candidate]:
    """Fields on a frame (1, 3, H, W), and on the same as uint8 HxWx3, by job and name."""
    found = _ours(frame)
    if "kornia" in peers:
        found |= _kornia(frame)
    if "torchvision" in peers:
        found |= _torchvision(frame)
    if "gstools" in peers and "cv2" in peers:
        found |= _paper(peers["gstools"], peers["cv2"], pixels)
    return found


def _ours(frame: Tensor) -> dict[str, Candidate]:
    ranges: dict[str, Any] = {"amplitude_range": (FIELD_PX, FIELD_PX), "length_range": (LENGTH_PX, LENGTH_PX)}
    within = f"within {TOLERANCE_PX} px"
    effects = {
        "field: ours Turbulence, exact": Turbulence(**ranges, tolerance_px=None),
        f"field: ours Turbulence {within}": Turbulence(**ranges, tolerance_px=TOLERANCE_PX),
        f"field: ours Turbulence, Gaussian {within}": Turbulence(
            **ranges, covariance="gaussian", tolerance_px=TOLERANCE_PX
        ),
        "field: ours DivergenceFree, exact": DivergenceFree(**ranges, tolerance_px=None),
        f"field: ours DivergenceFree {within}": DivergenceFree(**ranges, tolerance_px=TOLERANCE_PX),
    }
    return {name: lambda effect=effect: effect(frame) for name, effect in effects.items()}


def _kornia(frame: Tensor) -> dict[str, Candidate]:
    transform = importlib.import_module("kornia.geometry.transform")
    height, width = frame.shape[2:]
    strength = (FIELD_PX / _BLURRED * 2 / width, FIELD_PX / _BLURRED * 2 / height)

    def elastic() -> Tensor:
        noise = torch.randn(1, 2, height, width)
        return transform.elastic_transform2d(frame, noise, (121, 121), (LENGTH_PX, LENGTH_PX), strength)

    return {"field: kornia elastic_transform2d": elastic}


def _torchvision(frame: Tensor) -> dict[str, Candidate]:
    transforms = importlib.import_module("torchvision.transforms.v2")
    # Uniform noise in [-1, 1], in half widths.
    elastic = transforms.ElasticTransform(alpha=2 * math.sqrt(3) * FIELD_PX / _BLURRED, sigma=LENGTH_PX)
    return {"field: torchvision ElasticTransform": lambda: elastic(frame)}


def albumentations(package: Any) -> dict[str, Any]:
    """The transforms, by job and name."""
    strength = _LARGEST_NORMAL * FIELD_PX / _BLURRED
    return {
        "field: albumentations ElasticTransform": package.ElasticTransform(alpha=strength, sigma=LENGTH_PX, p=1.0),
        "field: albumentations ElasticTransform, approximate": package.ElasticTransform(
            alpha=_LARGEST_NORMAL * FIELD_PX * _TAPS, sigma=LENGTH_PX, approximate=True, p=1.0
        ),
    }


def _paper(gstools: Any, cv2: Any, pixels: Any) -> dict[str, Candidate]:
    """Two fields of exponential covariance, each divided by its standard deviation, and one look-up."""
    height, width = pixels.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    model = gstools.Exponential(dim=2, var=1.0, len_scale=LENGTH_PX)
    seeds = count()

    def shift() -> Any:
        field = gstools.SRF(model, mode_no=MODES, seed=next(seeds)).structured(
            [x[0].astype(float), y[:, 0].astype(float)]
        )
        return (FIELD_PX / field.std() * field.T).astype(np.float32)

    def warp() -> Any:
        return cv2.remap(pixels, x + shift(), y + shift(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    return {f"field: GSTools SRF, {MODES} modes + OpenCV remap": warp}
