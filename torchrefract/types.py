"""Plain values that cross layers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

Range = tuple[float, float]


Map = Tensor | Callable[[], Tensor]
_LIGHT = ("transmission", "extinction", "intensity")


class Inverse(NamedTuple):
    """The flow that undoes a warp."""

    flow: Tensor  # (B, 2, H, W), px
    valid: Tensor  # (B, 1, H, W), bool: where it does


@dataclass(frozen=True)
class FlowBounds:
    """Upper bounds for all flows of an error model, over the frame and a margin around it.

    max_displacement: px.
    max_gradient: px per px; inf if unknown.
    max_second_derivative: px per px^2, along any line; inf if unknown.
    max_third_derivative: px per px^3; inf if the second derivative has kinks.
    interpolation_error: from strides, an array in px, to the largest error in px of cubic Lagrange polynomials through
        4 nodes along each axis, wherever the nodes lie; inf if unknown.
    """

    max_displacement: float
    max_gradient: float
    max_second_derivative: float
    max_third_derivative: float
    interpolation_error: Callable[[np.ndarray], np.ndarray]


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
    """What folding does to each sample of a batch."""

    fraction: Tensor  # (B,), share of the pixels that lie on a fold
    min_determinant: Tensor  # (B,), smallest Jacobian determinant, <= 0 where the map folds


class Frame(NamedTuple):
    """A clean frame, or a batch of them, before any corruption.

    image: (3, H, W) or (B, 3, H, W), float in [0, 1].
    key: () or (B,), int64, what the draw of a corruption depends on.
    depth: (1, H, W) or (B, 1, H, W), metres, inf for the sky; an empty tensor where the source knows no depth.
    """

    image: Tensor
    key: Tensor
    depth: Tensor


class Pair(NamedTuple):
    """A batch to learn a restoration from.

    degraded, clean: (B, 3, H, W), float in [0, 1].
    flow: (B, 2, H, W), px, with warp(degraded, flow) = clean; zero where the corruption moves nothing.
    valid: (B, 1, H, W), bool, the pixels that the degraded image can still give back.
    key: (B,), int64, the key that the corruption was drawn with.
    transmission: (B, 1, H, W) in [0, 1], the share of the clean light that arrives; (B, 0) where none is asked for.
    """

    degraded: Tensor
    clean: Tensor
    flow: Tensor
    valid: Tensor
    key: Tensor
    transmission: Tensor = torch.empty(0)


class Degraded:
    """What an effect makes of an image, with the maps that tell how; maps are computed when they are first read.

    image: as the input, (B, C, H, W), (C, H, W) or (B, T, C, H, W); the maps have the same dimensions before C.
    params: what was drawn, a NamedTuple of tensors with a leading batch dimension; may be given as a function, too.
    flow: (B, 2, H, W), px, makes the image from the clean one; None for an effect that moves nothing.
    valid: (B, 1, H, W), bool, the pixels that show what the clean image holds.
    restore_flow: (B, 2, H, W), px, warp(image, restore_flow) = clean on restore_valid; None without a flow.
    restore_valid: (B, 1, H, W), bool; None without a flow.
    folding: share of the pixels that lie on a fold of the flow, and its smallest Jacobian determinant, (B,) each,
        counted on `valid`; None without a flow.
    restore_residual: (B, 1, H, W), px, how far from its place each pixel is looked up when both flows are applied;
        None without a flow.
    transmission: (B, 1, H, W) in [0, 1], the share of the clean light that arrives; None without such a map.
    extinction: (B, 1, H, W), 1/m, of the air, its mean along the ray of each pixel (the paper's k-map); None without
        such a map.
    intensity: (B, 1, H, W), light added; None without such a map.

    Of clips, (B, T, ...), the maps have the dimension of time too. Each map is given as a tensor or as a function that
    computes it; what needs other maps is handed the result, so that nothing here holds the result itself and its memory
    is free once it is let go; `restore_valid` is handed what `restore` says of where the flow back exists, too. Those
    that can be None are typed Any: whoever knows the effect knows which maps it has.
    """

    def __init__(
        self,
        image: Tensor,
        params: Any,
        *,
        valid: Map,
        flow: Map | None = None,
        restore: Callable[["Degraded"], Inverse] | None = None,
        restore_valid: Callable[["Degraded", Tensor], Tensor] | None = None,
        residual: Callable[["Degraded"], Tensor] | None = None,
        folding: Callable[["Degraded"], Folding] | None = None,
        light: Mapping[str, Map] | None = None,
    ):
        self.image = image
        self._params = params
        # Each a value, or a function of the result that computes it. Compilers cannot enter the lock of a cached
        # property.
        self._maps: dict[str, Any] = {
            "valid": _of_result(valid),
            "flow": _of_result(flow),
            **{name: _of_result((light or {}).get(name)) for name in _LIGHT},
            "restored": restore,
            "restore_valid": restore_valid and (lambda result: restore_valid(result, result._read("restored").valid)),
            "restore_residual": residual,
            "folding": folding,
        }

    @property
    def params(self) -> Any:
        """What was drawn."""
        if callable(self._params):
            self._params = self._params()
        return self._params

    @property
    def valid(self) -> Tensor:
        """Where the image shows what the clean one holds."""
        return self._read("valid")

    @property
    def flow(self) -> Any:
        """The flow that makes the image from the clean one."""
        return self._read("flow")

    @property
    def folding(self) -> Any:
        """How much of the image is folded."""
        return self._read("folding")

    @property
    def transmission(self) -> Any:
        """The share of the clean light that arrives."""
        return self._read("transmission")

    @property
    def extinction(self) -> Any:
        """The extinction of the air, in 1/m."""
        return self._read("extinction")

    @property
    def intensity(self) -> Any:
        """Light added."""
        return self._read("intensity")

    @property
    def restore_flow(self) -> Any:
        """The flow that undoes the damage."""
        restored = self._read("restored")
        return None if restored is None else restored.flow

    @property
    def restore_valid(self) -> Any:
        """Where it does."""
        return self._read("restore_valid")

    @property
    def restore_residual(self) -> Any:
        """By how much it misses, in px."""
        return self._read("restore_residual")

    def has(self, name: str) -> bool:
        """Whether there is a map of this name, without computing it."""
        return self._maps[name] is not None

    def map(self, function: Callable[[Tensor], Tensor]) -> "Degraded":
        """A copy with `function` applied to each map, not to image and params; what is lazy stays so."""

        def later(name: str, mapped: Callable[[Any], Any] = function) -> Any:
            return None if self._maps[name] is None else lambda *_: mapped(self._read(name))

        return Degraded(
            self.image,
            lambda: self.params,
            valid=lambda: function(self.valid),
            flow=later("flow"),
            restore=later("restored", lambda restored: Inverse(*map(function, restored))),
            restore_valid=later("restore_valid"),
            residual=later("restore_residual"),
            folding=later("folding", lambda folding: Folding(*map(function, folding))),
            light={name: value for name in _LIGHT if (value := later(name)) is not None},
        )

    def _read(self, name: str) -> Any:
        value = self._maps[name]
        if callable(value):
            value = self._maps[name] = value(self)
        return value

    def __getstate__(self) -> dict[str, Any]:
        """All maps computed: what is still to be computed cannot travel to another process."""
        return self.__dict__ | {"_params": self.params, "_maps": {name: self._read(name) for name in self._maps}}


def _of_result(value: Map | None) -> Any:
    """A map's function as one of the result."""
    return (lambda _: value()) if callable(value) else value
