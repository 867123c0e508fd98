"""The base class of effects that move pixels: a flow, its inverse, and one sampling of the image."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result, expand_batch, to_float
from torchrefract._validation import check_choice, eager_values, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import ParamsAtDepth, params_per_frame, where_active
from torchrefract.effects.batch_flow import (
    COARSEST,
    BatchFlow,
    FlowPart,
    SamplingOptions,
    WarpFlow,
    can_read,
    everywhere,
    flow_dtype,
    flow_on_measured_lattice,
    masked_flow,
    zero_flow,
)
from torchrefract.fields.depth import frame_depth
from torchrefract.planning.plan import (
    DEFAULT_ULPS,
    TOLERANCE_PX,
    ErrorModel,
    PlanRequest,
    WarpPlan,
    check_tolerance,
    plan_warp,
)
from torchrefract.types import Degraded, Inverse
from torchrefract.warping.flow import compose_flows, folding, is_shown_once
from torchrefract.warping.grid import Points, field_dtype, length
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.lattice import LatticeFlow, lattice_with_stride
from torchrefract.warping.warp import BACKENDS, INTERPOLATIONS, PADDINGS, sees_only_valid

# Of a composed inverse; smooth ones are off by far less, those between two sheets of a fold by more.
_MAX_RESIDUAL_PX = 0.1
_SOLVED_PX = 0.005  # residual of a valid inverse of one flow; frames of 8K have positions that are rounded to 0.001 px
# Measuring the error in each sample pays off if the bounds need a lattice finer than this, in frames of this size.
_FINE_STRIDE, _MIN_PIXELS = 4, 1 << 16


class WarpEffect(Effect):
    """An effect that moves pixels.

    Subclasses implement `sample_params`, `validate` and `flow`, and where they can `inverse_flow` and `error_model`.
    Their parameters are a NamedTuple with `applied` and a property `is_identity`, both (B,), bool. Those that depend on
    depth set `depth`; `flow` and `inverse_flow` then take a `ParamsAtDepth` in place of the parameters.

    Args:
        padding: values outside the frame: "zeros", "border" or "reflection".
        interpolation: "nearest", "bilinear" or "bicubic".
        backend: "auto", "torch", "numba" or "triton", as for `warp`.
        tolerance_px: largest error of the flow in px, anywhere and for all parameters in the ranges of the effect; the
            flow is then computed on a coarser lattice, see `plan`. None is exact, and so is the default in frames so
            large that float32 cannot reach it. Where it is valid, `restore_flow` is within 4 `tolerance_px` + 0.02 px
            of the exact one, as pixels next to a fold, where it would move farther, are not valid. Nor are pixels that
            a warp shows twice.
        p: probability that a sample is degraded.
    """

    rounding_ulps = DEFAULT_ULPS
    has_closed_form = False  # whether `flow` computes any points, not only the nodes of a lattice
    has_kinks = False  # whether the lattice follows from error bounds alone, since measurements miss kinks
    bounds_hold_at_any_depth = False  # whether error bounds hold for maps of depth, not only for that of the provider

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
            params: with B rows; a `ParamsAtDepth`, with N rows, if the effect has a `depth`.
            points: the nodes of a lattice with the plan's stride; any points, with N rows, if `has_closed_form`.
            plan: how exact the flow has to be.

        Returns:
            flow: (N, 2, h, w), px; N is B, or B T if the flow changes over a clip.
            exists: bool, broadcasts to (N, 1, h, w): False where there is no flow; the point is then sampled outside.
        """

    def inverse_flow(self, params: Any, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Return the flow (N, 2, H, W) that undoes `flow`, and where it exists.

        `params` are as for `flow`. By default Newton's method inverts the flow. Pixels next to a fold, or that a fold
        shows several times, have no inverse: there a small error of the flow moves it far.
        """
        inverse, is_solved, _ = invert_flow(flow, tolerance_px=_SOLVED_PX)
        return inverse, is_solved & is_shown_once(flow, inverse, is_solved)

    def error_model(self) -> ErrorModel | None:
        """Return error bounds for all parameters in the ranges, or None if none are known."""
        return None

    def moments(self) -> list[float]:
        """Return the moments of the exposure whose images are averaged, as for `ParamsAtDepth`; by default its middle.

        A warp with several of them has a `depth`.
        """
        return [0.0]

    @property
    def keeps_uint8(self) -> bool:
        """Return True: sampling rounds its result."""
        return True

    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> WarpPlan:
        """Return the plan for all parameters in the ranges."""
        request = PlanRequest(height, width, self.tolerance_px, dtype is torch.float64, self.rounding_ulps)
        return self.plan_under(request.with_reachable_default())

    def plan_under(self, request: PlanRequest) -> WarpPlan:
        """Return the plan for a request; an effect without a tolerance stays exact.

        The error is measured in each sample if the bounds need a fine lattice.
        """
        if self.tolerance_px is None:
            request = replace(request, tolerance_px=None)
        plan = plan_warp(self.error_model() if request.tolerance_px else None, request)
        is_fine = 0 < plan.stride < _FINE_STRIDE and request.height * request.width >= _MIN_PIXELS
        if self.has_closed_form and not self.has_kinks and is_fine and request.tolerance_px is not None:
            plan = replace(plan, is_measured=True, error_px=request.tolerance_px)
        return plan

    def for_params(self, params: Any, height: int, width: int) -> "WarpEffect":
        """Return this effect, or an exact one if parameters lie outside the ranges that its plan holds for."""
        model = self.error_model() if self.tolerance_px is not None else None
        if model is None or eager_values(lambda: model.contains(params), of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "WarpEffect":
        """Return the effect without a tolerance."""
        effect = copy(self)
        effect.tolerance_px = None
        return effect

    def at_depth(self, params: Any, image: Tensor, depth: Tensor | None) -> Any:
        """Return what `flow` takes for images (N, C, H, W): parameters with the depth of each frame, if it counts.

        Args:
            params: with B rows, or N.
            image: before the warp.
            depth: of the image, (N or B, 1, H, W), m; None takes that of the provider.
        """
        if self.depth is None:
            return params
        rows = image.shape[0]
        params = params_per_frame(params, rows // max(len(params.applied), 1))
        return ParamsAtDepth(params, expand_batch(frame_depth(self.depth, image, depth), rows))

    def warp_flow(self, params: Any, plan: WarpPlan) -> WarpFlow:
        """Return the flow as a function of points."""
        return WarpFlow(self.flow, params, self.active(params), plan, has_closed_form=self.has_closed_form)

    def masked_inverse_flow(self, params: Any, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the flow that undoes a masked one (N, 2, H, W), zero for samples that do not move."""
        inverse, exists = self.inverse_flow(params, flow)
        return masked_flow(expand_batch(inverse, len(flow)), exists, self.active(params), params)

    def must_be_exact(self, params: Any) -> bool:
        """Return True at a map of depth for which no plan of the ranges holds."""
        return isinstance(params, ParamsAtDepth) and params.is_map and not self.bounds_hold_at_any_depth

    def flow_by_plan(self, params: Any, height: int, width: int) -> BatchFlow:
        """Compute the flow by the plan of the ranges, or exactly at a map of depth, for which no plan holds."""
        if self.must_be_exact(params):
            return self.planned_flow(params, height, width, None)
        return BatchFlow(self.flow_parts(params, self._constant_plan(id(self), height, width, flow_dtype(params))))

    def planned_flow(self, params: Any, height: int, width: int, share_px: float | None) -> BatchFlow:
        """Compute the flow for a share of the tolerance of a composition, exactly if rounding exceeds it."""
        share_px = None if self.must_be_exact(params) else share_px
        return BatchFlow(
            self.flow_parts(params, self._constant_share(id(self), height, width, flow_dtype(params), share_px))
        )

    def flow_parts(self, params: Any, plan: WarpPlan) -> list[FlowPart]:
        """Compute the flow by a plan."""
        if plan.stride == 0 and not requires_grad(params):
            return [zero_flow(params, plan)]
        if plan.is_measured and can_read(params):
            exact = self.warp_flow(params, plan).exact()
            return flow_on_measured_lattice([exact], stride=COARSEST, tolerance_px=plan.error_px)
        lattice = lattice_with_stride(plan.height, plan.width, plan.stride)
        points = lattice.points(dtype=flow_dtype(params), device=params.applied.device)
        flow, exists = masked_flow(*self.flow(params, points, plan), self.active(params), params)
        return [FlowPart(None, LatticeFlow(flow, lattice), exists if lattice.stride == 1 else everywhere(flow.device))]

    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Sample the images along the flow."""
        height, width = image.shape[2:]
        if not self.may_change(params) or height * width == 1:
            return unchanged(image, params)
        drawn, params = params, self.at_depth(params, image, depth)
        flow, moments = self.flow_by_plan(params, height, width), self.moments()
        if flow.parts[0].is_zero and len(moments) == 1:
            return unchanged(image, drawn)
        active = self.active(params)  # a flow has B rows, or as many as there are images
        moves = expand_batch(active, len(image))
        options = SamplingOptions(self.padding, self.interpolation, self.backend)

        def sampled(source: Tensor, k: int) -> Tensor:
            along = flow if len(moments) == 1 else self.flow_by_plan(params.at(moments[k]), height, width)
            return along.sample(source, moves, params, options)

        return warped(
            mean_of_exposures(image, len(moments), sampled, moves, params),
            drawn,
            flow=lambda: flow.dense,
            valid=lambda: flow.leads_inside(active),
            inverse=lambda: self.masked_inverse_flow(params, flow.dense),
        )

    # torch.compile takes the plan as a constant. It accepts this of methods only, and tells effects apart by the first
    # argument.
    @assume_constant_result
    def _constant_plan(self, _: int, height: int, width: int, dtype: torch.dtype) -> WarpPlan:
        return self.plan_for_dtype(height, width, dtype)

    @assume_constant_result
    def _constant_share(self, _: int, height: int, width: int, dtype: torch.dtype, share_px: float | None) -> WarpPlan:
        request = PlanRequest(height, width, share_px, dtype is torch.float64, self.rounding_ulps)
        return self.plan_under(request.if_reachable())


def mean_of_exposures(
    image: Tensor, count: int, sample: Callable[[Tensor, int], Tensor], active: Tensor, params: Any
) -> Tensor:
    """Return the mean of several samplings of images (N, C, H, W), uint8 if they are and there is one sampling.

    Args:
        image: as above.
        count: of samplings.
        sample: returns sampling k of images.
        active, params: as for `where_active`.
    """
    if count == 1:
        return sample(image, 0)
    source = to_float(image) if image.dtype is torch.uint8 else image
    total = sample(source, 0)
    for k in range(1, count):
        total = total + sample(source, k)
    return where_active(total / count, source, active, params)


def warped(
    image: Tensor,
    params: Any,
    *,
    flow: Callable[[], Tensor],
    valid: Callable[[], Tensor],
    inverse: Callable[[], tuple[Tensor, Tensor]],
    is_composed: Callable[[], Tensor] | None = None,
    light: Mapping[str, Callable[[], Tensor]] | None = None,
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

    def restore_valid(result: Degraded) -> Tensor:
        exists = result.inverse.valid
        good = exists & sees_only_valid(*_expand_alike(result.valid, result.restore_flow))
        composed = None if is_composed is None else is_composed()
        if composed is None or eager_values(composed.any, of=composed) is False:
            return good
        is_once = is_shown_once(*_expand_alike(result.flow, result.restore_flow, exists, result.valid))
        is_inverse = (result.restore_residual <= _MAX_RESIDUAL_PX) & is_once
        return good & (~composed.view(-1, 1, 1, 1) | is_inverse)

    maps: dict[str, Callable[[Degraded], Any]] = {
        "valid": lambda _: valid(),
        "flow": lambda _: flow(),
        "restore_flow": lambda _: Inverse(*inverse()),
        "restore_valid": restore_valid,
        "restore_residual": lambda result: length(compose_flows(result.flow, result.restore_flow)),
        "folding": lambda result: folding(result.flow, result.valid),
    }
    return Degraded(
        image, params, maps | {name: lambda _, value=value: value() for name, value in (light or {}).items()}
    )


def unchanged(image: Tensor, params: Any) -> Degraded:
    """Return the image itself, with a flow of zero that is valid everywhere."""
    size = (image.shape[0], 1, *image.shape[2:])
    everywhere = torch.ones(size, dtype=torch.bool, device=image.device)
    zero = torch.zeros(size, dtype=field_dtype(image.dtype), device=image.device).expand(-1, 2, -1, -1)
    maps: dict[str, Callable[[Degraded], Any]] = {
        "valid": lambda _: everywhere,
        "flow": lambda _: zero,
        "restore_flow": lambda _: Inverse(zero, everywhere),
        "restore_valid": lambda _: everywhere,
        "restore_residual": lambda _: zero[:, :1],
        "folding": lambda _: folding(zero),
    }
    return Degraded(image, params, maps)


def _expand_alike(*values: Tensor) -> list[Tensor]:
    rows = max(value.shape[0] for value in values)
    return [expand_batch(value, rows) for value in values]
