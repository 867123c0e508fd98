"""Polygons that follow a backward flow."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.labels.points import STEPS, TOLERANCE_PX, frame_bounds, solve_points
from torchrefract.warping.grid import field_dtype

_STEP_PX = 1.0  # longest piece of an edge, between whose ends a flow is taken as linear


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
    solution = solve_points(torch.cat(pieces)[None], flow[None], STEPS, TOLERANCE_PX)
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
