"""Plain values that cross layers, and the vocabulary of the library.

Flow: (B, 2, H, W), px, backward: pixel p of the output shows the position p + flow(p) of the input.
Restore flow: the flow that undoes a flow; warping the degraded image along it gives the clean image.
Transmission: the share of the scene's light that reaches the camera, in [0, 1].
Extinction: the rate at which fog attenuates light, 1/m.
"""

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

Range = tuple[float, float]
Map = Tensor | Callable[[], Tensor]


class Inverse(NamedTuple):
    """Inverse of a flow."""

    flow: Tensor  # (B, 2, H, W), px
    valid: Tensor  # (B, 1, H, W), bool: the inverse exists and was computed


def _infinite(strides: np.ndarray) -> np.ndarray:
    return np.full(np.shape(strides), np.inf)


@dataclass(frozen=True)
class FlowBounds:
    """Upper bounds for all flows of an error model, over the frame and a margin around it.

    max_displacement: px.
    max_gradient: px per px; inf if unknown.
    interpolation_error: from strides, an array in px, to the largest error in px of cubic Lagrange polynomials through
        4 nodes along each axis, wherever the nodes lie; inf if unknown.
    """

    max_displacement: float
    max_gradient: float = math.inf
    interpolation_error: Callable[[np.ndarray], np.ndarray] = _infinite


class Simplification(NamedTuple):
    """Parts of a flow that can be left out.

    error_px: the largest error that they cause together.
    kept: names of the terms that are computed.
    dropped: names of the others, each with its own largest effect in px.
    details: a hashable value that the effect finds again as `WarpPlan.details`.
    can_interpolate: False if the flow must be computed at every pixel.
    why: a phrase for the printed plan.
    """

    error_px: float
    kept: tuple[str, ...] = ()
    dropped: tuple[tuple[str, float], ...] = ()
    details: Any = None
    can_interpolate: bool = True
    why: str = ""


class Folding(NamedTuple):
    """Folding of each sample of a batch."""

    fraction: Tensor  # (B,), share of the pixels that lie on a fold
    min_determinant: Tensor  # (B,), smallest Jacobian determinant, <= 0 where the flow folds the image


class Frame(NamedTuple):
    """A clean frame, or a batch of frames.

    image: (3, H, W) or (B, 3, H, W), float in [0, 1].
    key: () or (B,), int64; selects the random draw of the corruption.
    depth: (1, H, W) or (B, 1, H, W), m, inf for the sky; an empty tensor if the depth is unknown.
    """

    image: Tensor
    key: Tensor
    depth: Tensor


class Pair(NamedTuple):
    """A batch of degraded and clean frames to train a restoration model on.

    degraded, clean: (B, 3, H, W), float in [0, 1].
    flow: (B, 2, H, W), px, with warp(degraded, flow) = clean; zero if the corruption has no flow.
    valid: (B, 1, H, W), bool, the pixels of the clean image that the degraded image still shows.
    key: (B,), int64, the key of the random draw.
    transmission: (B, 1, H, W) in [0, 1], the share of the clean light that arrives; (B, 0) if it was not requested.
    """

    degraded: Tensor
    clean: Tensor
    flow: Tensor
    valid: Tensor
    key: Tensor
    transmission: Tensor = torch.empty(0, dtype=torch.float32, device="cpu")


class Degraded:
    """A degraded image with its maps, each of which is computed when it is first read.

    The `valid` of some effects of light then looks at the clean image: read it before you write to that image.

    image: as the input, (B, C, H, W), (C, H, W) or (B, T, C, H, W). Maps have the same dimensions before C, which are
        (B, T) for clips.
    params: the drawn parameters, a NamedTuple of tensors with a leading batch dimension.
    flow: (B, 2, H, W), px, with warp(clean, flow) = image; None for an effect without a flow.
    valid: (B, 1, H, W), bool, the pixels that show a part of the clean image.
    restore_flow: (B, 2, H, W), px, with warp(image, restore_flow) = clean on restore_valid; None without a flow.
    restore_valid: (B, 1, H, W), bool; None without a flow.
    inverse: `restore_flow` and where it exists, both in an `Inverse`; None without a flow.
    folding: share of folded pixels and smallest Jacobian determinant of the flow on `valid`, (B,) each; None without a
        flow.
    restore_residual: (B, 1, H, W), px, distance between a pixel and where the flow and the restore flow together map
        it; None without a flow.
    transmission: (B, 1, H, W) in [0, 1], share of the clean light that arrives; None if the effect has no such map.
    extinction: (B, 1, H, W), 1/m, mean extinction of the fog along the ray of each pixel; None if the effect has no
        such map.
    intensity: (B, 1, H, W), added light; None if the effect has no such map.

    Maps are typed Any where they may be None, since a caller knows which maps its effect has.

    Args:
        image, params: see above.
        maps: functions that compute the maps from this result, by name; "restore_flow" is an `Inverse`.
    """

    def __init__(self, image: Tensor, params: Any, maps: Mapping[str, Callable[["Degraded"], Any]]):
        self.image = image
        self.params = params
        # Values take the place of the functions. Passing the result to these avoids a reference cycle, so that memory
        # is freed at once. torch.compile does not support the lock of functools.cached_property.
        self._maps: dict[str, Any] = dict(maps)

    @property
    def valid(self) -> Tensor:
        """Return the mask of pixels that show a part of the clean image."""
        return self._read("valid")

    @property
    def flow(self) -> Any:
        """Return the flow from the clean image, px."""
        return self._read("flow")

    @property
    def folding(self) -> Any:
        """Return the folding of the flow."""
        return self._read("folding")

    @property
    def transmission(self) -> Any:
        """Return the share of the clean light that arrives."""
        return self._read("transmission")

    @property
    def extinction(self) -> Any:
        """Return the mean extinction along each ray, 1/m."""
        return self._read("extinction")

    @property
    def intensity(self) -> Any:
        """Return the added light."""
        return self._read("intensity")

    @property
    def inverse(self) -> Any:
        """Return the inverse of the flow, and where it exists."""
        return self._read("restore_flow")

    @property
    def restore_flow(self) -> Any:
        """Return the inverse of the flow, px."""
        return None if self.inverse is None else self.inverse.flow

    @property
    def restore_valid(self) -> Any:
        """Return the mask of pixels at which the restore flow gives the clean image."""
        return self._read("restore_valid")

    @property
    def restore_residual(self) -> Any:
        """Return the distance between each pixel and its position under both flows, px."""
        return self._read("restore_residual")

    def has(self, name: str) -> bool:
        """Return True if the effect has this map, without computing it."""
        return name in self._maps

    def map(self, function: Callable[[Tensor], Tensor]) -> "Degraded":
        """Return a copy with `function` applied to each map, lazily; image and params stay."""

        def mapped(name: str) -> Any:
            value = self._read(name)
            return type(value)(*map(function, value)) if isinstance(value, tuple) else function(value)

        return Degraded(self.image, self.params, {name: lambda _, name=name: mapped(name) for name in self._maps})

    def _read(self, name: str) -> Any:
        value = self._maps.get(name)
        if callable(value):
            device = self.image.device.type
            is_autocast = device != "meta" and torch.is_autocast_enabled(device)
            # Maps are computed when they are read, which may be inside of autocast, but positions need float32.
            with torch.autocast(device, enabled=False) if is_autocast else nullcontext():
                value = self._maps[name] = value(self)
        return value

    def __getstate__(self) -> dict[str, Any]:
        """Compute all maps, since functions cannot be pickled."""
        return self.__dict__ | {"_maps": {name: self._read(name) for name in self._maps}}
