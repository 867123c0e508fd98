"""Bounding boxes, quadrilaterals and polygons that follow a backward flow."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_count, check_flag, check_number, check_tensor, check_values
from torchrefract.labels.points import check_coordinates, frame_bounds, in_frame, pixel_subset, solve_points
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.implicit import sample_linear

# Probes along each side of the frame: they find the part of a box whose outline the frame does not show.
_NUM_PROBES = 49
_SAMPLES = 64  # points on each edge
_SLIVER_PX = 1.0  # the frame cuts off all but less than this of a side
_STEP_PX = 1.0  # longest piece of an edge, between whose ends a flow is taken as linear


def warp_boxes(
    boxes: Tensor,
    flow: Tensor,
    *,
    min_area: float = 0.0,
    min_visibility: float = 0.0,
    clip: bool = True,
    samples: int = _SAMPLES,
) -> tuple[Tensor, Tensor]:
    """Return the bounding boxes of warped boxes and a mask of the boxes to keep.

    `warp_points` maps sampled points of each outline. Pixels of the frame, among them all border pixels, that show the
    inside of the box count as well. Points of the outline that the warped image does not show are ignored. Boxes bound
    pixels, not pixel centers: the frame is (-0.5, -0.5, W - 0.5, H - 0.5). Subtract 0.5 from boxes of torchvision and
    COCO, which count from the edge of the first pixel, and add it to the result.

    Args:
        boxes: (B, N, 4), px, x1, y1, x2, y2; (N, 4) for a flow of shape (2, H, W).
        flow: (B, 2, H, W) or (1, 2, H, W), px, backward.
        min_area: smallest area of a clipped box to keep, px^2.
        min_visibility: smallest share of the warped box's area in the frame to keep it, in [0, 1].
        clip: clip boxes to the frame.
        samples: number of points on each edge, at least 2.

    Returns:
        boxes: (B, N, 4) or (N, 4), px, float32 or float64, finite; an invisible box has zero area if clipped.
        keep: (B, N) or (N,), bool: the box is visible, has an area above 0, and satisfies both limits. A box of which
            the frame cuts off all but less than 1 px of its width or height is not kept.

    Raises:
        ValueError: if shapes do not fit, x2 < x1 or y2 < y1 (checked on the CPU), or a limit is out of range.
        TypeError: if an argument is not a tensor of real numbers, or `boxes` are `BoundingBoxes` of torchvision.
    """
    check_tensor("boxes", boxes)
    check_tensor("flow", flow)
    if hasattr(boxes, "format"):
        raise TypeError(
            "boxes must be a plain tensor of x1, y1, x2, y2, got BoundingBoxes of torchvision, whose format and edges "
            "differ; pass them to warp_labels"
        )
    if boxes.ndim == 2 and flow.ndim == 3:
        limits = {"min_area": min_area, "min_visibility": min_visibility}
        warped, keep = warp_boxes(boxes[None], flow[None], clip=clip, samples=samples, **limits)
        return warped[0], keep[0]
    check_coordinates("boxes", boxes, flow, 4)
    check_box_limits(min_area, min_visibility, clip)
    check_count("samples", samples, low=2)
    check_values("boxes", "have x1 <= x2 and y1 <= y2", boxes[..., 2:] - boxes[..., :2], lambda size: size >= 0)
    x1, y1, x2, y2 = boxes.unbind(-1)
    corners = torch.stack([x1, y1, x2, y1, x2, y2, x1, y2], dim=-1).unflatten(-1, (4, 2))
    extent = warp_outlines(corners, flow, samples=samples).extent()
    return torch.cat(extent.clipped if clip else extent.unclipped, dim=-1), extent.keep(min_area, min_visibility)


class Extent(NamedTuple):
    """Rectangles around warped outlines: (lowest corner, highest corner), each (B, N, 2), px."""

    unclipped: tuple[Tensor, Tensor]
    clipped: tuple[Tensor, Tensor]
    visible: Tensor  # (B, N), bool: the frame shows a part of the outline or of its inside

    def keep(self, min_area: float, min_visibility: float) -> Tensor:
        """Return True for visible rectangles with an area above 0 that satisfy all limits: (B, N)."""
        sides, full_sides = (high - low for low, high in (self.clipped, self.unclipped))
        area, full_area = sides.prod(dim=-1), full_sides.prod(dim=-1)
        is_sliver = (sides < full_sides.clamp(max=_SLIVER_PX)).any(dim=-1)
        return self.visible & ~is_sliver & (area > 0) & (area >= min_area) & (area >= min_visibility * full_area)


class Outlines(NamedTuple):
    """Sampled outlines of warped quadrilaterals."""

    points: Tensor  # (B, N, 4, S, 2), px: warped points of each edge
    converged: Tensor  # (B, N, 4, S), bool: the points have a position in the warped image
    in_frame: Tensor  # (B, N, 4, S), bool: the points lie on the frame, which ends half a pixel outside the centers
    probes: Tensor  # (1, K, 2), px: positions at the border of the frame and inside it
    hits: Tensor  # (B, N, K), bool: the probes that show the inside of the quadrilateral
    center: Tensor  # (B, N, 2), px: center of the original quadrilateral, clamped to the frame

    def extent(self, axes: Tensor | None = None) -> Extent:
        """Return the rectangles along x and y, or in coordinates along the unit vectors `axes`, (B, N, 2, 2)."""

        def project(points: Tensor) -> Tensor:
            return points if axes is None else (points[..., None, :] * axes[:, :, None]).sum(dim=-1)

        points, center = project(self.points.flatten(2, 3)), project(self.center[:, :, None])[:, :, 0]
        low, high = _bounds(project(self.probes[:, None]), self.hits)

        def rectangle(chosen: Tensor, exists: Tensor) -> tuple[Tensor, Tensor]:
            first, last = _bounds(points, chosen.flatten(2))
            exists = exists[..., None]
            return (
                torch.where(exists, torch.minimum(first, low), center),
                torch.where(exists, torch.maximum(last, high), center),
            )

        visible = self.in_frame.flatten(2).any(dim=-1) | self.hits.any(dim=-1)
        exists = self.converged.flatten(2).any(dim=-1) | visible
        return Extent(rectangle(self.converged, exists), rectangle(self.in_frame, visible), visible)


def warp_outlines(corners: Tensor, flow: Tensor, *, samples: int = _SAMPLES) -> Outlines:
    """Warp the outlines of convex quadrilaterals, (B, N, 4, 2) in px, without checks."""
    dtype = field_dtype(torch.promote_types(corners.dtype, flow.dtype))
    corners, flow = corners.to(dtype), flow.to(dtype).expand(corners.shape[0], -1, -1, -1)
    t = torch.linspace(0, 1, samples, dtype=dtype, device=flow.device)[:, None]
    start, end = corners[..., None, :], corners.roll(-1, dims=2)[..., None, :]
    # Interpolate from the nearer end, so that both ends and a coordinate that they share stay exact.
    outline = torch.where(t < 0.5, start + t * (end - start), end - (1 - t) * (end - start))
    solution = solve_points(outline.flatten(1, 3), flow)
    points, converged = solution.points.view(outline.shape), solution.converged.view(outline.shape[:-1])
    is_inside = converged & in_frame(points, flow, 0.5)
    # Clamp points that only rounding moved off the frame.
    low, high = frame_bounds(flow, 0.5)
    points = torch.where(is_inside[..., None], points.maximum(low).minimum(high), points)
    probes, content = _probe(flow)
    center = corners.detach().mean(dim=2).maximum(low).minimum(high)
    return Outlines(points, converged, is_inside, probes, _in_quadrilateral(content, corners.detach()), center)


def check_box_limits(min_area: float, min_visibility: float, clip: bool) -> None:
    """Raise if a limit on boxes is out of its range."""
    check_number("min_area", min_area, low=0.0)
    check_number("min_visibility", min_visibility, low=0.0, high=1.0)
    check_flag("clip", clip)


def _probe(flow: Tensor) -> tuple[Tensor, Tensor]:
    """Return probes of the frame, (1, K, 2), px, and the clean positions that they show, (B, K, 2).

    The probes are the border pixels, the points half a pixel outside them, and a lattice over the frame.
    """
    height, width = flow.shape[2:]
    x, y = (torch.arange(size, dtype=flow.dtype, device=flow.device) for size in (width, height))
    lattice = torch.meshgrid(pixel_subset(flow, 3, _NUM_PROBES), pixel_subset(flow, 2, _NUM_PROBES), indexing="xy")
    parts = [torch.stack(lattice).flatten(1)]
    for border_px in (0.0, 0.5):
        parts += [torch.stack([x, torch.full_like(x, edge)]) for edge in (-border_px, height - 1 + border_px)]
        parts += [torch.stack([torch.full_like(y, edge), y]) for edge in (-border_px, width - 1 + border_px)]
    probes = torch.cat(parts, dim=1)[None]
    content = probes + sample_linear(flow, probes.expand(flow.shape[0], -1, -1)).value
    return probes.mT, content.mT.detach()


def _in_quadrilateral(points: Tensor, corners: Tensor) -> Tensor:
    """Return True for points (B, K, 2) in the convex quadrilaterals (B, N, 4, 2): (B, N, K)."""
    px, py = points[:, None].unbind(-1)
    sides = []
    for start, end in zip(corners.unbind(2), corners.roll(-1, dims=2).unbind(2), strict=True):
        (x, y), (dx, dy) = start[..., None].unbind(2), (end - start)[..., None].unbind(2)
        sides.append(dx * (py - y) - dy * (px - x))
    low, high = sides[0].minimum(sides[1]), sides[0].maximum(sides[1])
    for side in sides[2:]:
        low, high = low.minimum(side), high.maximum(side)
    # All sides are 0 at the points of a quadrilateral without an area, and of the line that continues it.
    return ((low >= 0) & (high > 0)) | ((high <= 0) & (low < 0))


def _bounds(points: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest corner, (B, N, 2), of the chosen points among (B, N, K, 2)."""
    chosen = chosen[..., None]
    return torch.where(chosen, points, torch.inf).amin(dim=2), torch.where(chosen, points, -torch.inf).amax(dim=2)


def warp_polygons(polygons: Sequence[Tensor], flow: Tensor) -> list[Tensor]:
    """Warp the outlines of polygons and clip them to the frame.

    Each edge is divided into pieces of at most 1 px, and each point is mapped as by `warp_points`. Points without a
    position in the warped image are left out. Clipping joins the parts of a polygon along the border of the frame.

    Args:
        polygons: (N, 2) each, px, x and y, floating; pixel centers are integers.
        flow: (2, H, W), px, backward.

    Returns:
        (M, 2) each, px, inside the frame (-0.5, -0.5, W - 0.5, H - 0.5); (0, 2) if the frame shows nothing of it.

    Source: Sutherland and Hodgman, "Reentrant polygon clipping", Communications of the ACM 17 (1974).
    """
    if not polygons:
        return []
    dtype = field_dtype(flow.dtype)
    pieces = [_divide(polygon.to(dtype)) for polygon in polygons]
    solution = solve_points(torch.cat(pieces)[None], flow[None])
    low, high = frame_bounds(flow[None], 0.5)
    sizes = [len(piece) for piece in pieces]
    warped = []
    for points, converged in zip(solution.points[0].split(sizes), solution.converged[0].split(sizes), strict=True):
        clipped = points[converged]
        for axis in (0, 1):
            clipped = _clip(clipped, low[axis] - clipped[:, axis])
            clipped = _clip(clipped, clipped[:, axis] - high[axis])
        warped.append(clipped if len(clipped) > 2 else clipped[:0])
    return warped


def polygon_area(polygon: Tensor) -> float:
    """Return the area of a polygon (N, 2), px^2."""
    x, y = (polygon.double() - polygon[:1].double()).unbind(1)
    return abs((x * y.roll(-1) - x.roll(-1) * y).sum().item()) / 2


def _divide(polygon: Tensor) -> Tensor:
    """Divide each edge into equal pieces: (N, 2) -> (M, 2)."""
    steps = polygon.roll(-1, dims=0) - polygon
    counts = (steps.norm(dim=1) / _STEP_PX).ceil().clamp(min=1).long()
    first = counts.cumsum(0) - counts
    index = torch.arange(int(counts.sum()), device=polygon.device)
    share = (index - first.repeat_interleave(counts)) / counts.repeat_interleave(counts)
    return polygon.repeat_interleave(counts, dim=0) + share[:, None] * steps.repeat_interleave(counts, dim=0)


def _clip(polygon: Tensor, excess: Tensor) -> Tensor:
    """Cut off the part of a polygon (N, 2) whose excess (N,), which is linear along edges, is above 0."""
    following = excess.roll(-1)
    is_inside, crosses = excess <= 0, (excess <= 0) != (following <= 0)
    share = torch.where(crosses, excess / (excess - following), 0)
    crossings = polygon + share[:, None] * (polygon.roll(-1, dims=0) - polygon)
    return torch.stack([polygon, crossings], dim=1)[torch.stack([is_inside, crosses], dim=1)]
