"""What every effect that changes light is: it moves nothing, and tells what arrives and what is added."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._checks import is_true
from torchrefract.effects.base import Effect, column
from torchrefract.types import Degraded, Map


class Shaded(NamedTuple):
    """What a radiance effect makes of a batch."""

    image: Tensor
    valid: Callable[[], Tensor]
    transmission: Tensor | None = None
    intensity: Tensor | None = None


class RadianceEffect(Effect):
    """An effect that changes light and moves nothing."""

    @abstractmethod
    def shade(self, image: Tensor, params: Any, depth: Tensor | None) -> Shaded:
        """The batch (B, C, H, W) in other light."""

    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The batch in other light, where the gate is open."""
        if depth is not None and is_true(params.gate.any) is False:
            depth = None  # and nobody looks at its values
        shaded = self.shade(image, params, depth)
        size = (image.shape[0], 1, *image.shape[2:])

        def gated(value: Tensor | None, off: float) -> Map | None:
            if value is None:
                return None
            return lambda: _gated(value, torch.full_like(value, off), params.gate).expand(size)

        return Degraded(
            _gated(shaded.image, image, params.gate),
            params,
            valid=lambda: (shaded.valid() | ~column(params.gate)).expand(size),
            transmission=gated(shaded.transmission, 1.0),
            intensity=gated(shaded.intensity, 0.0),
        )


def _gated(changed: Tensor, same: Tensor, gate: Tensor) -> Tensor:
    return changed if is_true(gate.all) else torch.where(column(gate), changed, same)
