"""The base class of effects that move pixels: a flow, its inverse, and one sampling of the image."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result, expand_batch
from torchrefract._validation import check_choice, eager_bool, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import per_sample, select_params, where_active
from torchrefract.planning.plan import (
    DEFAULT_ULPS,
    TOLERANCE_PX,
    ErrorModel,
    PlanRequest,
    WarpPlan,
    check_tolerance,
    lattice_with_stride,
    plan_warp,
)
from torchrefract.types import Degraded, Inverse, Map
from torchrefract.warping.flow import compose_flows, folding
from torchrefract.warping.grid import Points, field_dtype, inside, length
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.warp import BACKENDS, INTERPOLATIONS, PADDINGS, sample_image, sees_only_valid

_MAX_RESIDUAL_PX = (
    0.5  # of a composed inverse; smooth ones are off by far less, those between two sheets of a fold by more
)
# A plan of its own for each sample pays off if that of the ranges is finer than this, in frames of this size.
_FINE_STRIDE, _MIN_PIXELS = 4, 1 << 16


class SamplingOptions(NamedTuple):
    """How an image is sampled, as for `warp`; None is undecided."""

    padding: str | None = None
    interpolation: str | None = None
    backend: str | None = None

    def or_else(self, other: "SamplingOptions") -> "SamplingOptions":
        """Take the options of another where these are undecided."""
        return SamplingOptions(
            self.padding or other.padding, self.interpolation or other.interpolation, self.backend or other.backend
        )


class WarpEffect(Effect):
    """An effect that moves pixels.

    Subclasses implement `sample_params`, `validate` and `flow`, and where they can `inverse_flow` and `error_model`.
    Their parameters are a NamedTuple with `applied` and a property `is_identity`, both (B,), bool.

    Args:
        padding: values outside the frame: "zeros", "border" or "reflection".
        interpolation: "nearest", "bilinear" or "bicubic".
        backend: "auto", "torch", "numba" or "triton", as for `warp`.
        tolerance_px: largest error of the flow in px, anywhere and for all parameters in the ranges of the effect; the
            flow is then computed on a coarser lattice, see `plan`. None is exact, and so is the default in frames so
            large that float32 cannot reach it.
        p: probability that a sample is degraded.
    """

    rounding_ulps = DEFAULT_ULPS
    has_closed_form = False  # whether `flow` computes any point without a lattice of its own
    has_sample_models = False  # whether `error_model` accepts the parameters of one sample

    def __init__(
        self,
        *,
        padding: str = "zeros",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(p=p)
        self.padding = check_choice("padding", padding, PADDINGS)
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)
        self.backend = check_choice("backend", backend, BACKENDS)
        self.tolerance_px = check_tolerance(tolerance_px)

    @abstractmethod
    def flow(self, params: Any, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow at points of the frame.

        Args:
            params: with B rows.
            points: the nodes of the plan's lattice, or in a composition any points, with N rows.
            plan: how exact the flow has to be.

        Returns:
            flow: (N, 2, h, w), px; N is B, or B T if the flow changes over a clip.
            exists: bool, broadcasts to (N, 1, h, w): False where there is no flow; the point is then sampled outside.
        """

    def inverse_flow(self, params: Any, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Return the flow (N, 2, H, W) that undoes `flow`, and where it exists; by default with Newton's method."""
        inverse, valid, _ = invert_flow(flow)
        return inverse, valid

    def error_model(self, params: Any | None = None) -> ErrorModel | None:
        """Return error bounds for the ranges, or for the given parameters of one sample if `has_sample_models`."""
        return None

    @property
    def keeps_uint8(self) -> bool:
        """Return True: sampling rounds its result."""
        return True

    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> WarpPlan:
        """Return the plan for all parameters in the ranges."""
        request = self.plan_request(height, width, dtype).with_reachable_default()
        plan = plan_warp(self.error_model() if request.tolerance_px else None, request)
        is_fine = 0 < plan.stride < _FINE_STRIDE and height * width >= _MIN_PIXELS
        if self.has_sample_models and is_fine and request.tolerance_px is not None:
            plan = replace(plan, is_per_sample=True, error_px=request.tolerance_px)
        return plan

    def plan_request(self, height: int, width: int, dtype: torch.dtype) -> PlanRequest:
        """Return the request of a plan under the tolerance of this effect."""
        return PlanRequest(height, width, self.tolerance_px, dtype is torch.float64, self.rounding_ulps)

    def for_params(self, params: Any, height: int, width: int) -> "WarpEffect":
        """Return this effect, or an exact one if parameters lie outside the ranges that its plan holds for."""
        model = self.error_model() if self.tolerance_px is not None else None
        if model is None or eager_bool(lambda: model.contains(params), of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "WarpEffect":
        """Return the effect without a tolerance."""
        effect = copy(self)
        effect.tolerance_px = None
        return effect

    def active(self, params: Any, height: int, width: int) -> Tensor:
        """Return (B,), bool: the samples that move."""
        return params.applied & ~params.is_identity & (height * width > 1)

    def masked_flow(self, params: Any, plan: WarpPlan) -> tuple[LatticeFlow, Tensor]:
        """Compute the flow at the nodes of a plan, zero for samples that do not move, and where it exists."""
        dtype, device = flow_dtype(params), params.applied.device
        lattice = lattice_with_stride(plan.height, plan.width, plan.stride)
        if plan.stride == 0 and not requires_grad(params):
            zero = torch.zeros(1, 2, plan.height, plan.width, dtype=dtype, device=device)
            everywhere = torch.ones(1, 1, 1, 1, dtype=torch.bool, device=device)
            return LatticeFlow(zero.expand(len(params.applied), -1, -1, -1), lattice), everywhere
        nodes, exists = self.flow(params, lattice.points(dtype=dtype, device=device), plan)
        active = expand_batch(self.active(params, plan.height, plan.width), nodes.shape[0])
        if plan.stride > 1:
            exists = active.new_ones(1, 1, 1, 1)
        return LatticeFlow(where_active(nodes, 0.0, active, params), lattice), exists | ~per_sample(active)

    def masked_inverse_flow(self, params: Any, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the flow that undoes a masked one (N, 2, H, W), zero for samples that do not move."""
        active = expand_batch(self.active(params, *flow.shape[2:]), flow.shape[0])
        inverse, exists = self.inverse_flow(params, flow)
        inverse = expand_batch(inverse, flow.shape[0])
        return where_active(inverse, 0.0, active, params), exists | ~per_sample(active)

    def planned_flow(self, params: Any, height: int, width: int, *, is_exact: bool = False) -> "BatchFlow":
        """Compute the flow by the plan of the ranges or by one for each sample, or exactly."""
        dtype = flow_dtype(params)
        plan = self._constant_plan(id(self), height, width, dtype, is_exact)
        if not plan.is_per_sample or requires_grad(params):
            return BatchFlow([self._flow_part(None, params, plan)])
        request = self.plan_request(height, width, dtype)
        plans = [plan_warp(model, request) for model in self.sample_models(params)]
        groups: dict[Any, list[int]] = {}
        for i, sample_plan in enumerate(plans):
            groups.setdefault((sample_plan.stride, sample_plan.details), []).append(i)
        if len(groups) == 1:
            return BatchFlow([self._flow_part(None, params, plans[0])])
        parts = []
        for group in groups.values():
            index = torch.tensor(group)
            parts.append(self._flow_part(index, select_params(params, index), plans[group[0]]))
        return BatchFlow(parts)

    def _flow_part(self, samples: Tensor | None, params: Any, plan: WarpPlan) -> "FlowPart":
        is_zero = plan.stride == 0 and not requires_grad(params)
        return FlowPart(samples, *self.masked_flow(params, plan), is_zero)

    def sample_models(self, params: Any) -> Sequence[ErrorModel | None]:
        """Return the error model of each sample; that of the ranges if values cannot be read."""
        count = len(params.applied)
        if not self.has_sample_models or eager_bool(params.applied.any, of=params.applied) is None:
            return [self.error_model()] * count
        return [self.error_model(select_params(params, torch.tensor([i]))) for i in range(count)]

    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Sample the images along the flow."""
        height, width = image.shape[2:]
        if not self.may_change(params) or height * width == 1:
            return unchanged(image, params)
        flow = self.planned_flow(params, height, width)
        if flow.is_zero:
            return unchanged(image, params)
        active = self.active(params, height, width)  # a flow has B rows, or as many as there are images
        options = SamplingOptions(self.padding, self.interpolation, self.backend)
        return warped(
            flow.sample(image, expand_batch(active, image.shape[0]), params, options),
            params,
            flow=lambda: flow.dense,
            valid=lambda: (flow.exists & inside(flow.dense)) | ~per_sample(expand_batch(active, flow.dense.shape[0])),
            inverse=lambda: self.masked_inverse_flow(params, flow.dense),
        )

    @assume_constant_result
    def _constant_plan(self, _: int, height: int, width: int, dtype: torch.dtype, is_exact: bool) -> WarpPlan:
        # torch.compile takes the plan as a constant. It accepts this of methods only, and tells effects apart by the
        # argument.
        return (self.exact() if is_exact else self).plan_for_dtype(height, width, dtype)


class FlowPart(NamedTuple):
    """The flow of some samples of a batch."""

    samples: Tensor | None  # (n,), their numbers; None for the whole batch
    flow: LatticeFlow
    exists: Tensor  # bool, broadcasts to (n, 1, H, W)
    is_zero: bool = False  # whether the plan computes no flow


class BatchFlow:
    """Flows of a batch, whose samples may have lattices of their own."""

    def __init__(self, parts: Sequence[FlowPart]):
        self.parts = parts
        self._dense: Tensor | None = None

    @property
    def num_rows(self) -> int:
        """Return B, or B T for flows that change over a clip."""
        return sum(len(part.flow.nodes) for part in self.parts)

    @property
    def is_zero(self) -> bool:
        """Return True if no flow was computed, because none exceeds the tolerance."""
        return all(part.is_zero for part in self.parts)

    @property
    def dense(self) -> Tensor:
        """Return (N, 2, H, W), px."""
        # torch.compile cannot trace the lock of functools.cached_property.
        if self._dense is None:
            self._dense = self._gather([part.flow.dense() for part in self.parts])
        return self._dense

    @property
    def exists(self) -> Tensor:
        """Return bool, which broadcasts to (N, 1, H, W)."""
        size = self.parts[0].flow.lattice
        if len(self.parts) == 1:
            return self.parts[0].exists
        return self._gather(
            [part.exists.expand(len(part.flow.nodes), 1, size.height, size.width) for part in self.parts]
        )

    def detach(self) -> "BatchFlow":
        """Return the flows without gradients."""
        return BatchFlow([part._replace(flow=part.flow.detach()) for part in self.parts])

    def sample(self, image: Tensor, active: Tensor, params: Any, options: SamplingOptions) -> Tensor:
        """Sample images (N, C, H, W) along the flows; samples that are not active, (N,), stay bit for bit.

        Args:
            image, active: as above.
            params: with `applied`; the gradient of applied samples is kept at strength zero.
            options: all decided.
        """
        chosen = options._asdict()
        if requires_grad(part.flow for part in self.parts):
            # Samples that do not move need the gradient of their parameters.
            return where_active(self._sample(image, None, chosen), image, active, params)
        return self._sample(image, None if eager_bool(active.all, of=active) else active, chosen)

    def _sample(self, image: Tensor, active: Tensor | None, options: dict[str, Any]) -> Tensor:
        if len(self.parts) == 1:
            flow = self.parts[0].flow
            nodes = expand_batch(flow.nodes, image.shape[0])
            return sample_image(image, flow.with_nodes(nodes), active=active, **options)
        result = torch.empty_like(image)
        frames = image.shape[0] // self.num_rows
        for index, flow, *_ in self.parts:
            assert index is not None  # of several parts
            rows = rows_of_samples(index, frames * len(flow.nodes) // len(index))
            nodes = expand_batch(flow.nodes, len(rows))
            part = sample_image(
                image[rows], flow.with_nodes(nodes), active=None if active is None else active[rows], **options
            )
            result.index_copy_(0, rows, part)
        return result

    def _gather(self, values: Sequence[Tensor]) -> Tensor:
        if len(values) == 1:
            return values[0]
        result = values[0].new_empty(sum(map(len, values)), *values[0].shape[1:])
        for (index, *_), value in zip(self.parts, values, strict=True):
            assert index is not None
            result = result.index_copy(0, rows_of_samples(index, len(value) // len(index)), value)
        return result


def flow_dtype(params: Any) -> torch.dtype:
    """Return the type of the flow that parameters give."""
    return next(value.dtype for value in params if value.is_floating_point())


def rows_of_samples(index: Tensor, frames: int) -> Tensor:
    """Return (n T,), the rows of some samples, (n,), of T frames each."""
    return (frames * index[:, None] + torch.arange(frames, device=index.device)).flatten()


def warped(
    image: Tensor,
    params: Any,
    *,
    flow: Callable[[], Tensor],
    valid: Callable[[], Tensor],
    inverse: Callable[[], tuple[Tensor, Tensor]],
    is_composed: Callable[[], Tensor] | None = None,
    light: Mapping[str, Map] | None = None,
) -> Degraded:
    """Build the result of an effect with a flow; its maps are computed when they are first read.

    Args:
        image, params: of the result.
        flow, valid: of the result.
        inverse: returns the flow that undoes `flow`, and where it exists.
        is_composed: returns (N,), bool: samples that several warps move. Their inverse is interpolated between pixels
            that may lie on two sheets of a fold; it counts where it leads back to its pixel.
        light: photometric maps by name.
    """

    def restore_valid(result: Degraded, exists: Tensor) -> Tensor:
        good = exists & sees_only_valid(*_expand_alike(result.valid, result.restore_flow))
        composed = None if is_composed is None else is_composed()
        if composed is None or eager_bool(composed.any, of=composed) is False:
            return good
        return good & (~per_sample(composed) | (result.restore_residual <= _MAX_RESIDUAL_PX))

    return Degraded(
        image,
        params,
        valid=valid,
        flow=flow,
        restore=lambda _: Inverse(*inverse()),
        restore_valid=restore_valid,
        residual=lambda result: length(compose_flows(result.flow, result.restore_flow)),
        folding=lambda result: folding(result.flow, result.valid),
        light=light,
    )


def unchanged(image: Tensor, params: Any) -> Degraded:
    """Return the image itself, with a flow of zero that is valid everywhere."""
    size = (image.shape[0], 1, *image.shape[2:])
    everywhere = torch.ones(size, dtype=torch.bool, device=image.device)
    zero = torch.zeros(size, dtype=field_dtype(image.dtype), device=image.device).expand(-1, 2, -1, -1)
    return Degraded(
        image,
        params,
        valid=lambda: everywhere,
        flow=lambda: zero,
        restore=lambda _: Inverse(zero, everywhere),
        restore_valid=lambda _, exists: exists,
        residual=lambda _: zero[:, :1],
        folding=lambda _: folding(zero),
    )


def _expand_alike(*values: Tensor) -> list[Tensor]:
    rows = max(value.shape[0] for value in values)
    return [expand_batch(value, rows) for value in values]
