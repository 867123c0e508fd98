"""How boxes follow a flow."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_count, check_flag, check_number, check_tensor, check_values
from torchrefract.labels.points import (
    STEPS,
    TOLERANCE_PX,
    check_rows,
    frame_ends,
    land,
    on_frame,
    read_linearly,
    spread_over,
)
from torchrefract.warping.grid import field_dtype

# Places inside the frame, a side, that tell what it shows of a box whose outline lands nowhere.
_SHOWN = 49


def warp_boxes(
    boxes: Tensor,
    flow: Tensor,
    *,
    min_area: float = 0.0,
    min_visibility: float = 0.0,
    clip: bool = True,
    samples: int = 64,
) -> tuple[Tensor, Tensor]:
    """The bounding boxes of warped boxes, and which of them are worth keeping.

    Each outline is sampled and its points follow `warp_points`; with them counts each pixel on the border of the
    frame that shows the inside of the box. Points of an outline that land nowhere, as where a lens shows nothing, are
    left out. As boxes bound pixels, not centers, the frame is (-0.5, -0.5, W - 0.5, H - 0.5): boxes that count from
    the edge of the first pixel, as those of torchvision and COCO, need 0.5 taken off and put back.

    Args:
        boxes: (B, N, 4), px, x1, y1, x2, y2; (N, 4) beside a flow of (2, H, W).
        flow: (B, 2, H, W) or (1, 2, H, W), px, backward.
        min_area: px^2 of a box, clipped, below which it is not kept.
        min_visibility: the share, in [0, 1], of the warped box's area left by clipping, below which it is not kept.
        clip: return what the frame shows; otherwise boxes reach beyond it.
        samples: points on each of the four edges, at least 2.

    Returns:
        boxes: (B, N, 4) or (N, 4), px, float32 or float64, finite; one that is not seen has no area if clipped.
        keep: (B, N) or (N,), bool: seen, with an area above 0, and within the limits.

    Raises:
        ValueError: shapes that do not fit, x2 < x1 or y2 < y1 (on the CPU), a limit out of its range.
        TypeError: an argument that is no tensor of real numbers.
    """
    check_tensor("boxes", boxes)
    check_tensor("flow", flow)
    if boxes.ndim == 2 and flow.ndim == 3:
        limits = {"min_area": min_area, "min_visibility": min_visibility}
        moved, keep = warp_boxes(boxes[None], flow[None], clip=clip, samples=samples, **limits)
        return moved[0], keep[0]
    check_rows("boxes", boxes, flow, 4)
    check_policy(min_area, min_visibility, clip)
    check_count("samples", samples, low=2)
    check_values("boxes", "have x1 <= x2 and y1 <= y2", boxes[..., 2:] - boxes[..., :2], lambda size: size >= 0)
    x1, y1, x2, y2 = boxes.unbind(-1)
    corners = torch.stack([x1, y1, x2, y1, x2, y2, x1, y2], dim=-1).unflatten(-1, (4, 2))
    extent = warp_outlines(corners, flow, samples=samples).extent()
    return torch.cat(extent.clipped if clip else extent.whole, dim=-1), extent.keep(min_area, min_visibility)


class Extent(NamedTuple):
    """The rectangles around warped outlines, each (lowest, highest corner), (B, N, 2), px."""

    whole: tuple[Tensor, Tensor]
    clipped: tuple[Tensor, Tensor]
    seen: Tensor  # (B, N), bool: the frame shows some of it

    def keep(self, min_area: float, min_visibility: float) -> Tensor:
        """(B, N), bool: seen, with an area above 0, and within the limits."""
        area, whole = ((high - low).prod(dim=-1) for low, high in (self.clipped, self.whole))
        return self.seen & (area > 0) & (area >= min_area) & (area >= min_visibility * whole)


class Outlines(NamedTuple):
    """Outlines of quadrilaterals after a warp, sampled."""

    points: Tensor  # (B, N, 4, S, 2), px: where the points of each edge land
    found: Tensor  # (B, N, 4, S), bool: that they land
    on_frame: Tensor  # (B, N, 4, S), bool: that they land on the frame, which ends half a pixel off the centers
    shown: Tensor  # (1, K, 2), px: places on the border of the frame, on its edge, and some inside
    hits: Tensor  # (B, N, K), bool: which of them show the inside of the quadrilateral
    middle: Tensor  # (B, N, 2), px: of the frame's point that is nearest to the middle of the quadrilateral as it was

    def extent(self, axes: Tensor | None = None) -> Extent:
        """The rectangles along x and y, or along the unit vectors `axes`, (B, N, 2, 2), measured along them."""

        def along(points: Tensor) -> Tensor:
            return points if axes is None else (points[..., None, :] * axes[:, :, None]).sum(dim=-1)

        points, shown = along(self.points.flatten(2, 3)), along(self.shown[:, None])
        inside = _bounds(shown, self.hits)
        whole, clipped = (
            (torch.minimum(low, inside[0]), torch.maximum(high, inside[1]))
            for low, high in (_bounds(points, self.found.flatten(2)), _bounds(points, self.on_frame.flatten(2)))
        )
        middle = along(self.middle[:, :, None])[:, :, 0]
        seen = (self.on_frame.flatten(2).any(dim=-1)) | self.hits.any(dim=-1)
        found = self.found.flatten(2).any(dim=-1) | seen
        low, high = (torch.where(found[..., None], corner, middle) for corner in whole)
        first, last = (torch.where(seen[..., None], corner, middle) for corner in clipped)
        return Extent((low, high), (first, last), seen)


def warp_outlines(corners: Tensor, flow: Tensor, *, samples: int) -> Outlines:
    """The outlines of convex quadrilaterals, (B, N, 4, 2) in px, after a warp; the arguments are taken as checked."""
    dtype = field_dtype(torch.promote_types(corners.dtype, flow.dtype))
    corners, flow = corners.to(dtype), flow.to(dtype).expand(corners.shape[0], -1, -1, -1)
    t = torch.linspace(0, 1, samples, dtype=dtype, device=flow.device)[:, None]
    start, end = corners[..., None, :], corners.roll(-1, dims=2)[..., None, :]
    # From the nearer end, so that both ends, and a coordinate that they share, stay as they are.
    outline = torch.where(t < 0.5, start + t * (end - start), end - (1 - t) * (end - start))
    landing = land(outline.flatten(1, 3), flow, STEPS, TOLERANCE_PX)
    points, found = landing.points.view(outline.shape), landing.found.view(outline.shape[:-1])
    lands_on_frame = found & on_frame(points, flow, 0.5)
    # A point that rounding alone has put off the frame is on it.
    low, high = frame_ends(flow, 0.5)
    points = torch.where(lands_on_frame[..., None], torch.minimum(torch.maximum(points, low), high), points)
    shown, content = _shown(flow)
    middle = torch.minimum(torch.maximum(corners.detach().mean(dim=2), low), high)
    return Outlines(points, found, lands_on_frame, shown, _in_quadrilateral(content, corners.detach()), middle)


def check_policy(min_area: float, min_visibility: float, clip: bool) -> None:
    """Raise for limits on boxes that are out of their range."""
    check_number("min_area", min_area, low=0.0)
    check_number("min_visibility", min_visibility, low=0.0, high=1.0)
    check_flag("clip", clip)


def _shown(flow: Tensor) -> tuple[Tensor, Tensor]:
    """Places of the frame, (1, K, 2), px, and what they show, (B, K, 2): its border, its edge, and a lattice."""
    height, width = flow.shape[2:]
    x, y = (torch.arange(size, dtype=flow.dtype, device=flow.device) for size in (width, height))
    lattice_x, lattice_y = spread_over(flow, 3, _SHOWN), spread_over(flow, 2, _SHOWN)
    places = [torch.stack(torch.meshgrid(lattice_x, lattice_y, indexing="xy")).flatten(1)]
    for rim in (0.0, 0.5):
        places += [torch.stack([x, torch.full_like(x, edge)]) for edge in (-rim, height - 1 + rim)]
        places += [torch.stack([torch.full_like(y, edge), y]) for edge in (-rim, width - 1 + rim)]
    shown = torch.cat(places, dim=1)[None]
    content = shown + read_linearly(flow, shown.expand(flow.shape[0], -1, -1)).value
    return shown.mT, content.mT.detach()


def _in_quadrilateral(points: Tensor, corners: Tensor) -> Tensor:
    """(B, N, K), bool: which of the points (B, K, 2) lie in the convex quadrilaterals (B, N, 4, 2)."""
    px, py = points[:, None].unbind(-1)
    sides = []
    for start, end in zip(corners.unbind(2), corners.roll(-1, dims=2).unbind(2), strict=True):
        (x, y), (dx, dy) = start[..., None].unbind(2), (end - start)[..., None].unbind(2)
        sides.append(dx * (py - y) - dy * (px - x))
    low, high = torch.minimum(sides[0], sides[1]), torch.maximum(sides[0], sides[1])
    for side in sides[2:]:
        low, high = torch.minimum(low, side), torch.maximum(high, side)
    return (low >= 0) | (high <= 0)


def _bounds(points: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest and the highest corner, (B, N, 2), of the points (B, N, K, 2) that are chosen."""
    chosen = chosen[..., None]
    return torch.where(chosen, points, torch.inf).amin(dim=2), torch.where(chosen, points, -torch.inf).amax(dim=2)
