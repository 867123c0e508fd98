"""The zoom and the shift of the clean view that leave no pixel of a degraded frame without a source.

A barrel lens sees more of the scene than a pinhole with the same focal length. The clean frame is therefore taken as
the view of a pinhole with a shorter focal length, and where the lens is decentered, another principal point.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract.warping.grid import Points
from torchrefract.warping.lattice import pixel_lattice

_POINTS = 33  # on each side of the frame
# The border of the pixel centers, and that of the pixels, so that the zoom also fits the same frame in another size.
_OUTSETS_PX = (0.0, 0.5)
MARGIN_PX = 1 / 16  # to keep from the border of the clean frame, above the default tolerance of flows
STILL_PX = 1e-3  # a frame whose border moves by less is left as it is
_STEPS = 2.0**22  # the results are rounded to multiples of 1 / _STEPS, so that they have equal bits in every batch


def zoom_to_fill(
    position: Callable[[Points], Tensor], center: Tensor, *, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Find the largest zoom, at most 1, for which the clean frame holds all that a degraded frame shows.

    A position q of the clean view without zoom moves to c + zoom (q - c) + shift. Only the border of the frame is
    looked at, which decides for lenses whose distortion is monotone.

    Args:
        position: returns the position in the clean view without zoom, px, (B, 2, h, w), NaN where there is none.
        center: (B, 2), px, c, in float64.
        height, width: px, of the frame.

    Returns:
        zoom: (B,), in (0, 1].
        shift: (B, 2), px; zero unless a smaller zoom would be needed without it.
    """
    border = border_points(height, width, _OUTSETS_PX, center)
    reached = position(border).unflatten(2, (len(_OUTSETS_PX), -1))  # (B, 2, outsets, sides, points)
    low, high = _extent(reached - center[:, :, None, None, None])
    sides = [side - 1 if side > 1 else torch.inf for side in (width, height)]  # a side of one pixel decides nothing
    size = as_device_tensor(sides, dtype=center.dtype, device=center.device)[:, None]
    space = as_device_tensor(_OUTSETS_PX, dtype=center.dtype, device=center.device) - MARGIN_PX
    # Each lower end must fit together with each upper end.
    spans = (high[..., None] - low[..., None, :]).clamp(min=1e-9)
    zoom = ((size[..., None] + space[:, None] + space) / spans).flatten(1).amin(dim=1).clamp(max=1.0)
    rounded = (zoom.detach() * _STEPS).floor().clamp(min=8) / _STEPS
    zoom = zoom + (rounded - zoom).detach() if zoom.requires_grad else rounded  # with the gradient before rounding
    middle, scale = center[..., None], zoom[:, None, None]
    lowest_shift = (-space - middle - scale * low).amax(dim=2)
    highest_shift = (size + space - middle - scale * high).amin(dim=2)
    lowest_shift = torch.where(size.isfinite().all(dim=1), lowest_shift, -torch.inf)
    shift = torch.zeros_like(center).clamp(min=lowest_shift).clamp(max=highest_shift)
    pixels = torch.cat([border.x, border.y], dim=1).unflatten(2, (len(_OUTSETS_PX), -1))
    is_still = (reached - pixels).abs().amax(dim=(1, 2, 3, 4)) <= STILL_PX
    return torch.where(is_still, 1.0, zoom), torch.where(is_still[:, None], 0.0, shift)


def zoomed_flow(flow: Tensor, points: Points, center: Tensor, zoom: Tensor, shift: Tensor | None = None) -> Tensor:
    """Return the flow into the zoomed clean view, from that into the view without zoom.

        p + flow'(p) = c + zoom (p + flow(p) - c) + shift

    Args:
        flow: (B, 2, h, w), px, at the points.
        points: positions in the degraded frame.
        center, zoom, shift: as for `zoom_to_fill`; None is no shift.
    """
    return zoom[:, None, None, None] * flow + _zoom_offset(points, center, zoom, shift)


def points_without_zoom(points: Points, center: Tensor, zoom: Tensor, shift: Tensor | None = None) -> Points:
    """Return the positions in the clean view without zoom of positions in the zoomed one; arguments as above."""
    return points.displaced(-_zoom_offset(points, center, zoom, shift) / zoom[:, None, None, None])


def _zoom_offset(points: Points, center: Tensor, zoom: Tensor, shift: Tensor | None) -> Tensor:
    """Return how far the zoom and the shift alone move the points, (B, 2, h, w), px."""
    (cx, cy), still = center[:, :, None, None, None].unbind(1), (1 - zoom)[:, None, None, None]
    x, y = torch.broadcast_tensors(still * (cx - points.x), still * (cy - points.y))
    offset = torch.cat([x, y], dim=1)
    return offset if shift is None else offset + shift[:, :, None, None]


def border_points(height: int, width: int, outsets: Sequence[float], like: Tensor) -> Points:
    """Return positions on the four sides of rectangles around a frame, (1, 1, 4 outsets, n), px.

    Args:
        height, width: px, of the frame.
        outsets: px, of each rectangle from the pixel centers of the border.
        like: gives dtype and device.
    """
    steps = torch.linspace(0, 1, _POINTS, dtype=like.dtype, device=like.device)
    start, end = torch.zeros_like(steps), torch.ones_like(steps)
    along, across = torch.stack([steps, steps, start, end]), torch.stack([start, end, steps, steps])
    outset = as_device_tensor(outsets, dtype=like.dtype, device=like.device)[:, None, None]
    x = (along * (width - 1 + 2 * outset) - outset).flatten(0, 1)
    y = (across * (height - 1 + 2 * outset) - outset).flatten(0, 1)
    return Points(x[None, None], y[None, None], pixel_lattice(height, width), is_displaced=True)


def _extent(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest of offsets (..., sides, points) along borders; NaN counts as zero."""
    offset = torch.where(offset.isfinite(), offset, 0.0)
    # The extremes of the parabolas through three points each, where they lie between these.
    before, at, after = offset[..., :-2], offset[..., 1:-1], offset[..., 2:]
    slope, bend = (after - before) / 2, before - 2 * at + after
    is_between = slope.abs() < bend.abs()
    extremes = torch.where(is_between, at - slope.square() / (2 * torch.where(is_between, bend, 1.0)), at)
    values = torch.cat([offset, extremes], dim=-1)
    return values.amin(dim=(-2, -1)), values.amax(dim=(-2, -1))
