"""Images on their way through a composition, with all maps that their result will have."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchrefract._tensor import expand_batch
from torchrefract._validation import eager_values
from torchrefract.effects.base import Effect
from torchrefract.effects.batch_flow import BatchFlow, FlowPart, SamplingOptions
from torchrefract.effects.photometric_effect import PhotometricEffect
from torchrefract.effects.warp_effect import WarpEffect, mean_of_exposures, warped
from torchrefract.fields.depth import DepthProvider, DepthSource, depth_of
from torchrefract.types import Degraded
from torchrefract.warping.flow import compose_flows
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.warp import sees_only_valid

_T = TypeVar("_T")

# How photometric maps of several effects combine.
_COMBINE: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "transmission": torch.mul,
    "intensity": torch.add,
    "extinction": torch.add,
}


class Leaf(NamedTuple):
    """An effect of a composition, with what it needs."""

    effect: Any  # a `WarpEffect` or a `PhotometricEffect`
    params: Any
    options: SamplingOptions  # first those of the compositions around it
    place: int  # among all effects that are not compositions, in order


class _Segment(NamedTuple):
    """Warps that were sampled together."""

    applied: Tensor  # (N,), bool: one of the warps is applied
    active: Tensor  # (N,), bool: and moves the sample
    flow: BatchFlow

    def sample(self, image: Tensor, options: SamplingOptions) -> Tensor:
        """Sample images (N, C, H, W) along the flow."""
        return self.flow.sample(image, self.active, _Applied(self.applied, self.flow.parts[0].flow.nodes), options)


def _segment(leaves: Sequence[Leaf], active: Sequence[Tensor], parts: Sequence[FlowPart]) -> _Segment:
    """Return the segment of warps with a composed flow; arguments as for `Progress.move`."""
    applied = torch.stack([leaf.params.applied for leaf in leaves]).any(dim=0)
    moved = torch.stack(list(active)).any(dim=0)
    for part in parts:
        if part.is_zero:
            moved = torch.zeros_like(moved) if part.samples is None else moved.index_fill(0, part.samples, False)
    return _Segment(applied, moved, BatchFlow(parts))


class _Applied(NamedTuple):
    """The parts of parameters that `where_active` reads."""

    applied: Tensor
    nodes: Tensor


class Progress:
    """Images on their way through the effects of a composition, and what their maps are computed from."""

    def __init__(self, image: Tensor, depth: Tensor | None, batch: int):
        self.image, self.depth = image, depth
        self._frame = image  # before the photometric effects since the latest warp
        self._assumed: list[tuple[DepthSource, Callable[[], Tensor]]] = []
        self.frames = image.shape[0] // max(batch, 1)
        self.has_warps = False
        self.segments: list[_Segment] = []
        self.warps: list[tuple[WarpEffect, Any, Callable[[], BatchFlow], Tensor]] = []  # with params, own flow, active
        self.valid: Callable[[], Tensor] | None = None  # None is everywhere
        self.light: dict[str, Callable[[], Tensor]] = {}

    def move(
        self,
        leaves: Sequence[Leaf],
        active: Sequence[Tensor],
        parts: Sequence[FlowPart],
        share_px: float | None,
        *,
        exposures: Sequence[Sequence[FlowPart]],
    ) -> None:
        """Sample the images along the composed flow of several warps.

        Args:
            leaves: the warps, in order, with parameters of N rows.
            active: (N,), bool, for each warp: the samples that it moves.
            parts: the composed flow.
            share_px: tolerance of the flow of each warp, from which valid and inverse follow; None is exact.
            exposures: the composed flows along which images are sampled, whose mean is the image.
        """
        height, width = self.image.shape[2:]
        segment = _segment(leaves, active, parts)
        if self.depth is not None:
            self.depth = self._moved_depth(self.depth, segment)
        self._assumed = [
            (source, _remember(lambda depth=depth: self._moved_depth(depth(), segment)))
            for source, depth in self._assumed
        ]
        segments = [segment] if len(exposures) == 1 else [_segment(leaves, active, each) for each in exposures]

        def sampled(image: Tensor, k: int) -> Tensor:
            return _sample_segment(image, segments[k], leaves, active)

        applied = _Applied(segment.applied, segment.flow.parts[0].flow.nodes)
        self._frame = self.image = mean_of_exposures(self.image, len(segments), sampled, segment.active, applied)
        self.light = {name: _moved(value, segment) for name, value in self.light.items()}
        for leaf, moves in zip(leaves, active, strict=True):
            flow = _remember(partial(leaf.effect.planned_flow, leaf.params, height, width, share_px))
            self.warps.append((leaf.effect, leaf.params, flow, moves))
            self.valid = _valid_after(self.valid, flow, moves)
        if len(leaves) > 1:  # cubics between pixels may lead out of the frame though all pixels around lead into it
            self.valid = _combined(torch.logical_and, self.valid, lambda: inside(segment.flow.dense))
        self.segments.append(segment)

    def depth_for(self, effect: Effect) -> Tensor | None:
        """Return the depth that was passed in, or what a function of the effect gives, once for all that share it.

        Fog changes no distance, so the function sees the frame before it. Warps move what it gave.
        """
        source = effect.depth
        if self.depth is not None or source is None or isinstance(source, DepthProvider):
            return self.depth
        for function, depth in self._assumed:
            if function is source:
                return depth()
        depth = depth_of(source, self._frame, field_dtype(self._frame.dtype))
        self._assumed.append((source, lambda: depth))
        return depth

    def moved_depth(self, leaves: Sequence[Leaf], active: Sequence[Tensor], parts: Sequence[FlowPart]) -> Tensor | None:
        """Return the depth after warps that are not sampled yet; arguments as for `move`."""
        return None if self.depth is None else self._moved_depth(self.depth, _segment(leaves, active, parts))

    def shade(self, effect: PhotometricEffect, params: Any) -> None:
        """Apply a photometric effect."""
        depth = self.depth_for(effect) if effect.may_change(params) else self.depth
        shaded = effect.degrade_batch(self.image, params, depth)
        rows, light = self.image.shape[0], dict(self.light)
        self.image = shaded.image

        def each_frame(name: str) -> Callable[[], Tensor]:
            return lambda: expand_batch(getattr(shaded, name), rows)

        self.valid = _combined(torch.logical_and, self.valid, each_frame("valid"))
        maps = {name: each_frame(name) for name in _COMBINE if shaded.has(name)}
        if "intensity" in light and "transmission" in maps:  # light that was added before is attenuated
            light["intensity"] = _combined(torch.mul, light["intensity"], maps["transmission"])
        self.light = light | {name: _combined(_COMBINE[name], light.get(name), value) for name, value in maps.items()}

    def result(self, params: Any) -> Degraded:
        """Return the images with all maps."""
        size, device = self.image.shape, self.image.device
        everywhere = lambda: torch.ones(size[0], 1, *size[2:], dtype=torch.bool, device=device)  # noqa: E731 - used once
        valid = everywhere if self.valid is None else self.valid
        if not self.has_warps:
            maps = {"valid": valid, **self.light}
            return Degraded(self.image, params, {name: lambda _, value=value: value() for name, value in maps.items()})
        return warped(
            self.image,
            params,
            flow=self._flow,
            valid=valid,
            inverse=self._inverse,
            is_composed=self._is_composed if len(self.warps) > 1 else None,
            light=self.light,
        )

    def _moved_depth(self, depth: Tensor, segment: _Segment) -> Tensor:
        depth, detached = expand_batch(depth, len(self.image)), segment._replace(flow=segment.flow.detach())
        return detached.sample(depth, SamplingOptions("border", "nearest", "auto"))

    def _flow(self) -> Tensor:
        """Return (N, 2, H, W), px, the composed flow of all segments."""
        if not self.segments:
            rows, _, height, width = self.image.shape
            return torch.zeros(rows, 2, height, width, dtype=field_dtype(self.image.dtype), device=self.image.device)
        flow = self.segments[-1].flow.dense
        for segment in reversed(self.segments[:-1]):
            flow = torch.where(segment.active.view(-1, 1, 1, 1), compose_flows(segment.flow.dense, flow), flow)
        return flow

    def _is_composed(self) -> Tensor:
        """Return (N,), bool: samples that several warps move."""
        return torch.stack([moves for _, _, _, moves in self.warps]).sum(dim=0) > 1

    def _inverse(self) -> tuple[Tensor, Tensor]:
        """Compose the inverse flows of all warps, sample by sample of those that move it."""
        total: Tensor | None = None
        valid = moved = torch.empty(0, dtype=torch.bool, device=self.image.device)
        for effect, params, flow, moves in self.warps:
            inverse, exists = effect.masked_inverse_flow(params, flow().dense)
            exists = exists.expand(len(inverse), 1, *inverse.shape[2:])
            if total is None:
                total, valid, moved = inverse, exists, moves
                continue
            both, alone = (moved & moves).view(-1, 1, 1, 1), moves.view(-1, 1, 1, 1)
            if eager_values(both.any, of=both) is not False:
                exists = torch.where(both, valid & sees_only_valid(exists, total), exists)
                inverse = torch.where(both, compose_flows(inverse, total), inverse)
            total, valid = torch.where(alone, inverse, total), torch.where(alone, exists, valid)
            moved = moved | moves
        if total is None:
            flow = self._flow()
            return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)
        return total, valid


def _remember(compute: Callable[[], _T]) -> Callable[[], _T]:
    """Compute a value when it is first needed, and keep it."""
    computed: list[_T] = []

    def value() -> _T:
        if not computed:
            computed.append(compute())
        return computed[0]

    return value


def _valid_after(
    before: Callable[[], Tensor] | None, flow: Callable[[], BatchFlow], moves: Tensor
) -> Callable[[], Tensor]:
    """Return where an image is valid after one more warp."""

    def valid() -> Tensor:
        sampled_inside = flow().leads_inside(moves)
        return sampled_inside if before is None else sampled_inside & sees_only_valid(before(), flow().dense)

    return valid


def _moved(value: Callable[[], Tensor], segment: _Segment) -> Callable[[], Tensor]:
    """Move a photometric map along."""
    return lambda: segment.sample(value(), SamplingOptions("border", "bilinear", "auto"))


def _combined(
    combine: Callable[[Tensor, Tensor], Tensor], first: Callable[[], Tensor] | None, second: Callable[[], Tensor]
) -> Callable[[], Tensor]:
    """Return a map that combines two; the second one if there is no first."""
    return second if first is None else lambda: combine(first(), second())


def _sample_segment(image: Tensor, segment: _Segment, leaves: Sequence[Leaf], active: Sequence[Tensor]) -> Tensor:
    """Sample the images, each with the options of the last warp that moves it."""
    result = segment.sample(image, leaves[-1].options)
    decided = active[-1]
    for leaf, moves in zip(reversed(leaves[:-1]), reversed(active[:-1]), strict=True):
        chosen = moves & ~decided
        if leaf.options != leaves[-1].options and eager_values(chosen.any, of=chosen) is not False:
            result = torch.where(chosen.view(-1, 1, 1, 1), segment.sample(image, leaf.options), result)
        decided = decided | moves
    return result
