"""What every effect that changes light is: it moves nothing, and tells what arrives and what is added."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract._validation import eager_bool, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.rows import column, expand_batch, params_part, part, put, some, where_active
from torchrefract.types import Degraded, Map
from torchrefract.warping.grid import field_dtype


class Shaded(NamedTuple):
    """What a radiance effect makes of a batch, in rows for each frame; maps also in one row for each clip."""

    image: Tensor
    valid: Callable[[], Tensor]
    transmission: Map | None = None
    extinction: Map | None = None
    intensity: Map | None = None


# What the maps say where nothing is changed.
_CLEAR = {"transmission": 1.0, "extinction": 0.0, "intensity": 0.0}


def _stirs(active: Tensor, params: Any) -> bool:
    return eager_bool(active.any, of=active) is not False or requires_grad(params)


class RadianceEffect(Effect):
    """An effect that changes light and moves nothing.

    maps: the names of those of `Degraded` that it has.
    """

    maps: tuple[str, ...]

    @abstractmethod
    def shade(self, image: Tensor, params: Any, depth: Tensor | None) -> Shaded:
        """The rows (N, C, H, W) in other light."""

    @abstractmethod
    def acts(self, params: Any) -> Tensor:
        """(B,), bool: the samples whose parameters change anything at all."""

    def stirs(self, params: Any) -> bool:
        """Whether a sample may be changed, or a gradient is asked for that could change it."""
        return _stirs(params.applied & self.acts(params), params)

    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The rows in other light, where the gate is open."""
        active = params.applied & self.acts(params)
        if not _stirs(active, params):
            everywhere = active.new_ones(()).expand(_map_size(image))
            return Degraded(image, params, valid=everywhere, light=clear_maps(self.maps, image))
        if depth is not None and eager_bool(active.any, of=active) is False:
            depth = None  # and nobody looks at its values
        index, batch = some(active, params), len(active)
        if index is None:
            shaded = self.shade(image, params, depth)
        else:
            few = None if depth is None else part(depth, index, batch)
            shaded = self.shade(part(image, index, batch), params_part(params, index), few)
        height, width = image.shape[2:]

        def spread_map(value: Tensor, off: float | bool) -> Tensor:
            if index is not None:
                value = put(value, index, off, batch)
            elif eager_bool(active.all, of=active) is not True:
                value = _choose(value, off, active)
            return value.expand(-1, 1, height, width)

        def masked_flow(name: str) -> Map | None:
            value = cast(Map | None, getattr(shaded, name))
            if value is None:
                return None
            return lambda: spread_map(value() if callable(value) else value, _CLEAR[name])

        if index is not None:
            shone = put(shaded.image, index, image, batch)
        else:
            shone = image if shaded.image is image else where_active(shaded.image, image, active, params)
        return Degraded(
            shone,
            params,
            valid=lambda: spread_map(shaded.valid(), True),
            light={name: value for name in _CLEAR if (value := masked_flow(name)) is not None},
        )


def clear_maps(names: Iterable[str], image: Tensor) -> dict[str, Map]:
    """The maps of these names, as they are where nothing is changed."""
    size, dtype, device = _map_size(image), field_dtype(image.dtype), image.device

    def everywhere(value: float) -> Map:
        return lambda: torch.full((), value, dtype=dtype, device=device).expand(size)

    return {name: everywhere(_CLEAR[name]) for name in names}


def _map_size(image: Tensor) -> tuple[int, ...]:
    return (image.shape[0], 1, *image.shape[2:])


def _choose(value: Tensor, off: float | bool, active: Tensor) -> Tensor:
    rows = max(value.shape[0], active.shape[0])
    return torch.where(column(expand_batch(active, rows)), expand_batch(value, rows), off)
