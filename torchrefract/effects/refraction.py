"""What every effect that moves pixels is: a flow, the flow back, and one look-up."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._tensor import scatter_batch
from torchrefract._validation import check_choice, eager_bool, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.plan import Plan, PlanRequest
from torchrefract.effects.rows import (
    column,
    expand_alike,
    expand_batch,
    frames_of,
    params_part,
    part,
    put,
    some,
    where_active,
)
from torchrefract.types import Degraded, Inverse, Map
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.grid import Positions, field_dtype, inside, length
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.jacobian import folding
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.masks import mixes_only
from torchrefract.warping.mixed import Flow, MixedFlow, PartFlow, dense
from torchrefract.warping.resample import BACKENDS, INTERPOLATIONS, PADDINGS, sample_image

_MISSED = 0.5  # px; smooth flows back, read between pixels, miss by far less, rough ones seldom by more


class WarpEffect(Effect):
    """An effect that moves pixels.

    Args:
        padding: what lies outside the frame: "zeros", "border" or "reflection".
        interpolation: "nearest", "bilinear" or "bicubic".
        backend: "auto", "torch", "numba" or "opencv", as for `warp`.
        p: chance that a sample is degraded at all.
    """

    def __init__(
        self, *, padding: str = "zeros", interpolation: str = "bilinear", backend: str = "auto", p: float = 1.0
    ):
        super().__init__(p=p)
        self.padding = check_choice("padding", padding, PADDINGS)
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)
        self.backend = check_choice("backend", backend, BACKENDS)

    @property
    def takes_levels(self) -> bool:
        """It does: a look-up rounds what it finds."""
        return True

    @abstractmethod
    def flow(self, params: Any, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow (B, 2, H, W) in px, and where it exists, (B, 1, H, W), bool; B T rows if it changes over a clip."""

    def restore_flow(self, params: Any, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow that undoes `flow`, and where it exists."""
        return self.undo(params, self.flow(params, height=height, width=width)[0])

    def undo(self, params: Any, flow: Tensor) -> tuple[Tensor, Tensor]:
        """The flow that undoes a flow of these parameters, and where it exists: by Newton's method on the flow."""
        inverse, valid, _ = invert_flow(flow)
        return inverse, valid

    def planned(self, height: int, width: int, dtype: torch.dtype) -> Plan:
        """That of an exact flow."""
        return PlanRequest(height, width, None, dtype is torch.float64).plan(1, 0.0, "it has no lattice")

    @abstractmethod
    def moves(self, params: Any) -> Tensor:
        """(B,), bool: the samples whose parameters move anything at all."""

    def stirs(self, params: Any, height: int, width: int) -> bool:
        """Whether a sample may be moved, or a gradient is asked for that could move it."""
        return eager_bool((params.applied & self.moves(params)).any, of=params.applied) is not False or requires_grad(
            params
        )

    def masked_flow(self, params: Any, *, height: int, width: int) -> "Moved":
        """The flow, zero for the samples that the effect leaves alone."""
        return self._moved(params, lambda own: self.flow(own, height=height, width=width), height, width)

    def _moved(self, params: Any, flow_of: Callable[[Any], tuple[Tensor, Tensor]], height: int, width: int) -> "Moved":
        """The same, of a flow at every pixel that is made as told."""
        active = self.active(params, height, width)
        index, batch = some(active, params), len(active)
        if index is None:
            flow, exists = flow_of(params)
        else:
            flow, exists = flow_of(params_part(params, index))
            flow, exists = put(flow, index, 0.0, batch), put(exists, index, True, batch)
        active = expand_batch(active, flow.shape[0])
        return Moved(where_active(flow, 0.0, active, params), exists | ~column(active), active)

    def active(self, params: Any, height: int, width: int) -> Tensor:
        """(B,), bool: the samples that are moved at all."""
        return params.applied & self.moves(params) & (height * width > 1)

    def masked_inverse_flow(self, params: Any, moved: "Moved") -> tuple[Tensor, Tensor]:
        """The flow that undoes `gated`, zero for the samples that the effect leaves alone, and where it exists."""
        active, batch = moved.active.view(len(params.applied), -1)[:, 0], len(params.applied)
        index = some(active, params)
        if index is not None:
            back, known = self.undo(params_part(params, index), part(moved.flow, index, batch))
            return put(back, index, 0.0, batch), put(known, index, True, batch)
        back, known = self.undo(params, moved.flow)
        return where_active(back, 0.0, moved.active, params), known | ~column(moved.active)

    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The batch looked up along the flow."""
        height, width = image.shape[2:]
        if not self.stirs(params, height, width):
            return identity(image, params)
        moved = self.masked_flow(params, height=height, width=width)
        own = moved.expand_batch(image.shape[0])
        options = {"padding": self.padding, "interpolation": self.interpolation, "backend": self.backend}
        return moving(
            looked_up(image, own.path, own.active, params, **options),
            params,
            flow=lambda: moved.flow,
            valid=lambda: (moved.exists & inside(moved.flow)) | ~column(moved.active),
            undo=lambda: self.masked_inverse_flow(params, moved),
        )


class Moved:
    """What an effect moves, in one row for each clip or for each frame.

    path: (B, 2, H, W), px, the flow, or the flow in another form.
    exists: bool, of (B, 1, H, W) or what broadcasts to it.
    active: (B,), bool: the samples that are moved at all.
    """

    def __init__(self, path: Flow, exists: Tensor, active: Tensor):
        self.path, self.exists, self.active = path, exists, active
        self._flow: Tensor | None = None

    @property
    def flow(self) -> Tensor:
        """(B, 2, H, W), px."""
        # Compilers cannot enter the lock of a cached property.
        if self._flow is None:
            self._flow = dense(self.path)
        return self._flow

    def expand_batch(self, rows: int) -> "Moved":
        """The same in so many rows."""
        if rows == len(self.active):
            return self
        return Moved(
            _spread_path(self.path, rows, len(self.active)),
            expand_batch(self.exists, rows),
            expand_batch(self.active, rows),
        )


def moving(
    image: Tensor,
    params: Any,
    *,
    flow: Callable[[], Tensor],
    valid: Callable[[], Tensor],
    undo: Callable[[], tuple[Tensor, Tensor]],
    several: Callable[[], Tensor] | None = None,
    light: Mapping[str, Map] | None = None,
) -> Degraded:
    """What an effect with a flow hands over; `restore_valid` is where the flow back exists and sees valid pixels.

    several: gives the samples, (B,), bool, that several warps move. Their flow back is read between pixels that may lie
        on two sheets of a fold, where it leads to neither: it counts where it leads to its place.
    """

    def restore_valid(result: Degraded, known: Tensor) -> Tensor:
        good, many = known & sees(result.valid, result.restore_flow), None if several is None else several()
        if many is None or eager_bool(many.any, of=many) is False:
            return good
        return good & (~column(many) | (result.restore_residual <= _MISSED))

    return Degraded(
        image,
        params,
        valid=valid,
        flow=flow,
        restore=lambda _: Inverse(*undo()),
        restore_valid=restore_valid,
        residual=lambda result: length(compose_flows(result.flow, result.restore_flow)),
        folding=lambda result: folding(result.flow, result.valid),
        light=light,
    )


def looked_up(image: Tensor, path: Flow | Positions, active: Tensor, params: Any, **options: Any) -> Tensor:
    """The image (N, C, H, W) along a path; samples that are not active, (N,), bool, bit for bit as they are."""
    if requires_grad(params):
        return where_active(sample_image(image, path, **options), image, active, params)
    return sample_image(image, path, active=None if eager_bool(active.all, of=active) else active, **options)


def sees(good: Tensor, flow: Tensor) -> Tensor:
    """(B, 1, H, W), bool: all pixels that a look-up along the flow mixes are good, but for weights below 1/1000."""
    return mixes_only(*expand_alike(good, flow))


def identity(image: Tensor, params: Any) -> Degraded:
    """The image as it is, with maps that say so."""
    size = (image.shape[0], 1, *image.shape[2:])
    everywhere = torch.ones(size, dtype=torch.bool, device=image.device)
    still = torch.zeros(size, dtype=field_dtype(image.dtype), device=image.device).expand(-1, 2, -1, -1)
    return Degraded(
        image,
        params,
        valid=lambda: everywhere,
        flow=lambda: still,
        restore=lambda _: Inverse(still, everywhere),
        restore_valid=lambda _, known: known,
        residual=lambda _: still[:, :1],
        folding=lambda _: folding(still),
    )


def mixed(parts: Sequence[tuple[Tensor, Moved]]) -> Moved:
    """What is moved in several ways, each for some rows of a batch, (n,), all of which are there."""
    path = MixedFlow(tuple((index, cast(PartFlow, moved.path)) for index, moved in parts))
    height, width = max(moved.exists.shape[2:] for _, moved in parts)
    exists = scatter_batch([(index, moved.exists.expand(len(index), 1, height, width)) for index, moved in parts])
    return Moved(path, exists, scatter_batch([(index, moved.active) for index, moved in parts]))


def _spread_path(path: Flow, rows: int, before: int) -> Flow:
    if isinstance(path, LatticeFlow):
        return path.with_nodes(expand_batch(path.nodes, rows))
    if isinstance(path, MixedFlow):
        frames = rows // before
        parts = ((frames_of(own, frames), _spread_path(flow, frames * len(own), len(own))) for own, flow in path.parts)
        return MixedFlow(tuple((index, cast(PartFlow, flow)) for index, flow in parts))
    return expand_batch(cast(Tensor, path), rows)  # no warp alone follows others
