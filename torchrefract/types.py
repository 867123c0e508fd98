"""Plain values that cross layers."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple, cast

from torch import Tensor

Range = tuple[float, float]


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
    """

    degraded: Tensor
    clean: Tensor
    flow: Tensor
    valid: Tensor
    key: Tensor


class Degraded:
    """What an effect makes of an image, with the maps that tell how; maps are computed when they are first read.

    image: as the input, (B, C, H, W) or (C, H, W); the maps lose their batch dimension with it.
    params: what was drawn, a NamedTuple of tensors with a leading batch dimension.
    flow: (B, 2, H, W), px, makes the image from the clean one; None for an effect that moves nothing.
    valid: (B, 1, H, W), bool, the pixels that show what the clean image holds.
    restore_flow: (B, 2, H, W), px, warp(image, restore_flow) = clean on restore_valid; None without a flow.
    restore_valid: (B, 1, H, W), bool; None without a flow.
    transmission: (B, 1, H, W) in [0, 1], the share of the clean light that arrives; None without such a map.
    intensity: (B, 1, H, W), light added; None without such a map.
    """

    def __init__(
        self,
        image: Tensor,
        params: Any,
        *,
        valid: Callable[[], Tensor],
        flow: Tensor | None = None,
        restore: Callable[[], tuple[Tensor, Tensor]] | None = None,
        transmission: Tensor | None = None,
        intensity: Tensor | None = None,
    ):
        self.image = image
        self.params = params
        self.flow = flow
        self.transmission = transmission
        self.intensity = intensity
        self._valid = valid
        self._restore = restore

    @cached_property
    def valid(self) -> Tensor:
        """Where the image shows what the clean one holds."""
        return self._valid()

    @cached_property
    def restored(self) -> tuple[Tensor, Tensor] | None:
        """(restore_flow, restore_valid), which are computed together."""
        return None if self._restore is None else self._restore()

    @property
    def restore_flow(self) -> Tensor | None:
        """The flow that undoes the damage."""
        return None if self.restored is None else self.restored[0]

    @property
    def restore_valid(self) -> Tensor | None:
        """Where it does."""
        return None if self.restored is None else self.restored[1]

    def map(self, function: Callable[[Tensor], Tensor]) -> "Degraded":
        """A copy with `function` applied to each map, not to image and params; what is lazy stays so."""

        def restore() -> tuple[Tensor, Tensor]:
            flow, valid = cast(tuple[Tensor, Tensor], self.restored)
            return function(flow), function(valid)

        return Degraded(
            self.image,
            self.params,
            valid=lambda: function(self.valid),
            flow=None if self.flow is None else function(self.flow),
            restore=None if self._restore is None else restore,
            transmission=None if self.transmission is None else function(self.transmission),
            intensity=None if self.intensity is None else function(self.intensity),
        )

    def __getstate__(self) -> dict[str, Any]:
        """All maps computed: what is still to be computed cannot travel to another process."""
        _ = self.valid, self.restored
        return self.__dict__ | {"_valid": None, "_restore": None}
