"""Flows of a batch: those of one warp or of several in a row, on lattices as coarse as a tolerance allows.

The composed flow of n warps, the first nearest to the scene, is

    d_1,  d_i = d_(i+1) + f_i(p + d_(i+1)),  d_n = f_n(p)

Cubics between the nodes of a lattice interpolate it. Their error is measured in each sample: the value at a node is
compared with the cubic through the four neighbors at distances of 1 and 3 strides, as on a lattice of twice the stride.
If the stride is halved, that error falls by up to 16 where the flow is smooth, and by 2.6 to 35 around a kink of the
second derivative, as at the points of a spline. In each part of the frame the factor between four times and twice the
stride tells which; it is reduced by a third, as it falls with the stride.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract._tensor import expand_batch
from torchrefract._validation import eager_values, requires_grad
from torchrefract.effects.batch import rows_of_samples, select_params, where_active
from torchrefract.planning.plan import PlanRequest, WarpPlan, plan_warp
from torchrefract.warping.grid import Points, inside
from torchrefract.warping.lattice import LatticeFlow, lattice_around, lattice_with_stride, pixel_lattice, within_reach
from torchrefract.warping.warp import sample_image

COARSEST = 64  # px, stride of the first lattice that is measured
_FEWEST_CELLS = 8  # along each axis of the frame, so that the nodes show how fast the error falls
_MARGIN = 2  # nodes beyond the frame that a measured lattice has
_LEAST_FACTOR = 2.5  # by which the error falls if the stride is halved
_BLOCK = 8  # nodes, along the sides of the parts in which that factor is measured
_SAFETY = 1.25  # of measured stretches, which are largest between the axes of the lattice


class SamplingOptions(NamedTuple):
    """Options of sampling an image, as for `warp`; None is undecided."""

    padding: str | None = None
    interpolation: str | None = None
    backend: str | None = None

    def or_else(self, other: Any) -> "SamplingOptions":
        """Take the options of a warp, of a composition or of other options where these are undecided."""
        return SamplingOptions(
            self.padding or other.padding, self.interpolation or other.interpolation, self.backend or other.backend
        )


class WarpFlow:
    """The flow of one warp as a function of points, zero for samples that do not move.

    Args:
        evaluate: computes the flow and where it exists, from params, points and plan, as `WarpEffect.flow`.
        params: with N or B rows.
        active: (N,) or (B,), bool.
        plan: of the warp.
        has_closed_form: False if the flow is computed at nodes, which then serve all points.
    """

    def __init__(
        self,
        evaluate: Callable[[Any, Points, WarpPlan], tuple[Tensor, Tensor]],
        params: Any,
        active: Tensor,
        plan: WarpPlan,
        *,
        has_closed_form: bool,
    ):
        self.evaluate, self.params, self.active, self.plan = evaluate, params, active, plan
        self.has_closed_form = has_closed_form
        self._field: LatticeFlow | None = None

    def at(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return the flow (N, 2, h, w), px, and where it exists."""
        at_nodes = points.lattice.stride == 1 >= self.plan.stride and not points.is_displaced
        if self.has_closed_form or at_nodes:
            flow, exists = self.evaluate(self.params, points, self.plan)
        else:
            points = within_reach(points)
            lattice = lattice_around(points, max(1, self.plan.stride))
            if self._field is None or lattice.margin > self._field.lattice.margin:
                nodes = lattice.points(dtype=points.x.dtype, device=points.x.device)
                self._field = LatticeFlow(self.evaluate(self.params, nodes, self.plan)[0], lattice)
            flow, exists = self._field.at(points), everywhere(self.active.device)
        return masked_flow(flow, exists, self.active, self.params)

    def exact(self) -> "WarpFlow":
        """Return the flow without a tolerance."""
        plan = plan_warp(None, PlanRequest(self.plan.height, self.plan.width, None, is_double=False))
        return WarpFlow(self.evaluate, self.params, self.active, plan, has_closed_form=self.has_closed_form)

    def select(self, rows: Tensor) -> "WarpFlow":
        """Return the flow of some samples."""
        params, active = select_params(self.params, rows), self.active[rows]
        selected = WarpFlow(self.evaluate, params, active, self.plan, has_closed_form=self.has_closed_form)
        if self._field is not None:
            nodes = expand_batch(self._field.nodes, len(self.active))[rows]
            selected._field = LatticeFlow(nodes, self._field.lattice)
        return selected


def masked_flow(flow: Tensor, exists: Tensor, active: Tensor, params: Any) -> tuple[Tensor, Tensor]:
    """Return a flow (N, 2, h, w), zero for samples that are not active, (N,) or (B,), and where it exists."""
    active = expand_batch(active, len(flow))
    return where_active(flow, 0.0, active, params), exists | ~active.view(-1, 1, 1, 1)


class ComposedFlow(NamedTuple):
    """The flow of warps in a row at some points."""

    flow: Tensor  # (N, 2, h, w), px
    exists: Tensor  # bool, broadcasts to (N, 1, h, w)
    ends: list[Points]  # after each warp, the last one first


def compose_at(warps: Sequence[WarpFlow], points: Points) -> ComposedFlow:
    """Evaluate the composed flow of warps, the first nearest to the scene, at points."""
    flow, exists = warps[-1].at(points)
    ends = [points.displaced(flow)]
    for warp in reversed(warps[:-1]):
        moved, moved_exists = warp.at(ends[-1])
        flow, exists = flow + moved, exists & moved_exists
        ends.append(points.displaced(flow))
    return ComposedFlow(flow, exists, ends)


class FlowPart(NamedTuple):
    """The flow of some samples of a batch."""

    samples: Tensor | None  # (n,), their numbers; None for the whole batch
    flow: LatticeFlow
    exists: Tensor  # bool, broadcasts to (n, 1, H, W)
    is_zero: bool = False  # whether the plan computes no flow

    def of_samples(self, samples: Tensor | None) -> "FlowPart":
        """Return the part with the numbers of a larger batch, from those of its samples (m,)."""
        if samples is None:
            return self
        return self._replace(samples=samples if self.samples is None else samples[self.samples])


def flow_on_measured_lattice(
    warps: Sequence[WarpFlow], *, stride: int, is_smooth: bool = True, tolerance_px: float
) -> list[FlowPart]:
    """Compute a composed flow on the coarsest lattice whose measured error is within a tolerance, sample by sample.

    Args:
        warps: of N samples, whose values can be read.
        stride: px, of the coarsest lattice.
        is_smooth: False computes every pixel, after a measurement of how far the warps stretch each other's errors.
        tolerance_px: of the composed flow.
    """
    height, width = warps[0].plan.height, warps[0].plan.width
    while stride > max(1, min(height, width) // _FEWEST_CELLS):
        stride //= 2
    lattice = lattice_with_stride(height, width, stride, margin=_MARGIN)
    composed = compose_at(warps, lattice.points(dtype=flow_dtype(warps[0].params), device=warps[0].active.device))
    if stride == 1:
        return [FlowPart(None, LatticeFlow(composed.flow, lattice), composed.exists)]
    lattice_px = lattice_error(composed.flow.detach())
    stretched_px = _stretched_errors(warps, composed.ends)
    exists = composed.exists.expand(len(composed.flow), 1, *lattice.num_nodes)
    exists_inside = exists[..., _MARGIN:-_MARGIN, _MARGIN:-_MARGIN].flatten(1).all(dim=1)
    lattice_px = torch.where(exists.flatten(1).all(dim=1), lattice_px, torch.inf)
    values = torch.stack([lattice_px, stretched_px, exists_inside.to(lattice_px.dtype)], dim=1).tolist()
    rows: dict[tuple[bool, int], list[int]] = {}  # by whether they must be exact, and by their next stride
    for i, (between, stretched, is_inside) in enumerate(values):
        if not stretched <= tolerance_px / 2:
            choice = True, 1
        elif not (is_smooth and is_inside):
            choice = False, 1
        else:
            fits = between + stretched <= tolerance_px
            choice = False, stride if fits else _next_stride(stride, between, tolerance_px)
        rows.setdefault(choice, []).append(i)
    parts: list[FlowPart] = []
    for (is_exact, next_stride), chosen in rows.items():
        index = None if len(chosen) == len(values) else torch.tensor(chosen, device="cpu")
        if next_stride == stride:
            nodes = composed.flow if index is None else composed.flow[index]
            parts.append(FlowPart(index, LatticeFlow(nodes, lattice), everywhere(nodes.device)))
            continue
        selected = warps if index is None else [warp.select(index) for warp in warps]
        remaining = flow_on_measured_lattice(
            [warp.exact() for warp in selected] if is_exact else selected,
            stride=next_stride,
            is_smooth=is_smooth,
            tolerance_px=tolerance_px,
        )
        parts += [part.of_samples(index) for part in remaining]
    return parts


def lattice_error(nodes: Tensor) -> Tensor:
    """Estimate the error of the cubics between nodes (N, 2, h, w), at least 13 along each axis: (N,), px."""
    fine = F.max_pool2d(errors_at_nodes(nodes), _BLOCK, ceil_mode=True)
    coarse = F.max_pool2d(errors_at_nodes(nodes[..., ::2, ::2]), _BLOCK // 2, ceil_mode=True)
    factor = (coarse / fine.clamp(min=1e-12) / 1.5).clamp(min=_LEAST_FACTOR)
    return (fine / factor).flatten(1).amax(dim=1)


def errors_at_nodes(nodes: Tensor) -> Tensor:
    """Measure how far nodes (N, 2, h, w) lie from the cubics through every other node: (N, 1, h, w), px.

    The three outermost nodes, which have no such cubic, get the values of the nearest ones.
    """
    errors = []
    for values in (nodes, nodes.mT):
        near, far = values[..., 2:-4] + values[..., 4:-2], values[..., :-6] + values[..., 6:]
        missed = torch.hypot(*(values[..., 3:-3] - (9 * near - far) / 16).split(1, dim=1))
        errors.append(F.pad(missed, (3, 3, 0, 0), mode="replicate"))
    return errors[0] + errors[1].mT


def _stretched_errors(warps: Sequence[WarpFlow], ends: Sequence[Points]) -> Tensor:
    """Add the errors of the warps, each as often as the warps before it stretch distances: (N,), px."""
    last = ends[-1]
    fixed = torch.zeros(len(last.x), dtype=last.x.dtype, device=last.x.device)
    squares = torch.zeros_like(fixed)  # of independent random errors
    for warp, end in zip(reversed(warps), ends, strict=True):
        if warp.plan.error_px > 0:
            error = warp.plan.error_px * (1.0 if end is last else _SAFETY * _largest_stretch(end, last))
            if warp.plan.is_random:
                squares = squares + error**2
            else:
                fixed = fixed + error
    return fixed + squares.sqrt()


def _largest_stretch(start: Points, end: Points) -> Tensor:
    """Return (N,), the largest ratio of the distances of neighboring points after and before a map."""
    ratios = []
    for dim in (2, 3):
        before, after = [
            torch.hypot(points.x.detach().diff(dim=dim), points.y.detach().diff(dim=dim)) for points in (start, end)
        ]
        ratios.append((after / before.clamp(min=1e-6)).flatten(1).amax(dim=1))
    return torch.maximum(*ratios)


def _next_stride(stride: int, error_px: float, tolerance_px: float) -> int:
    """Return a finer stride that may fit, if the error falls with the third power of the stride."""
    if error_px == torch.inf:
        return stride // 2
    return max(1, min(stride - 1, int(stride * (tolerance_px / error_px) ** (1 / 3))))


def zero_flow(params: Any, plan: WarpPlan) -> FlowPart:
    """Return a flow that moves nothing."""
    batch, device = len(params.applied), params.applied.device
    zero = torch.zeros(1, 2, plan.height, plan.width, dtype=flow_dtype(params), device=device)
    lattice = pixel_lattice(plan.height, plan.width)
    return FlowPart(None, LatticeFlow(zero.expand(batch, -1, -1, -1), lattice), everywhere(device), is_zero=True)


def can_read(params: Any) -> bool:
    """Return True if the values of parameters, and of a depth with them, can be read without waiting for a device."""
    # Inside torch.vmap any of them may be that of one sample, which has no values of its own.
    values = pytree.tree_leaves(params) if torch._C._are_functorch_transforms_active() else [params.applied]
    return all(eager_values(value.any, of=value) is not None for value in values if isinstance(value, Tensor))


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

    def leads_inside(self, active: Tensor) -> Tensor:
        """Return (N, 1, H, W), bool: the flow leads into the frame, or the sample is not active, (N,) or (B,)."""
        active = expand_batch(active, self.num_rows)
        return (self.exists & inside(self.dense)) | ~active.view(-1, 1, 1, 1)

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
        # Samples that do not move need the gradient of their parameters.
        has_gradient = requires_grad([part.flow.nodes for part in self.parts])
        mask = None if has_gradient or eager_values(active.all, of=active) else active

        def sampled(part: Tensor, flow: LatticeFlow, mask: Tensor | None) -> Tensor:
            each = LatticeFlow(expand_batch(flow.nodes, len(part)), flow.lattice)
            return sample_image(part, each, active=mask, **options._asdict())

        if len(self.parts) == 1:
            result = sampled(image, self.parts[0].flow, mask)
        else:
            result = torch.empty_like(image)
            for index, flow, *_ in self.parts:
                assert index is not None  # of several parts
                rows = rows_of_samples(index, len(image) // self.num_rows * len(flow.nodes) // len(index))
                part = sampled(image[rows], flow, None if mask is None else mask[rows])
                # Forward-mode gradients cannot be written into a tensor without any.
                result = (result.index_copy if requires_grad((part,)) else result.index_copy_)(0, rows, part)
        return where_active(result, image, active, params) if has_gradient else result

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
    for value in params:
        if isinstance(value, tuple):
            return flow_dtype(value)
        if isinstance(value, Tensor) and value.is_floating_point():
            return value.dtype
    raise TypeError(f"params must hold a floating tensor, got {type(params).__name__}")


def everywhere(device: torch.device) -> Tensor:
    """Return True, (1, 1, 1, 1)."""
    return torch.ones(1, 1, 1, 1, dtype=torch.bool, device=device)
