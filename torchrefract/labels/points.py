"""Where points of an image land."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_count, check_flow, check_positive, check_tensor
from torchrefract.warping.grid import field_dtype

# Newton steps: smooth flows take 6, and those that nearly fold gain little beyond 16.
STEPS = 16
TOLERANCE_PX = 0.01
# Nodes of the lattice, a side, on which the search for a point begins.
_NODES = 17
# Outside the frame the flow goes on as its secant over so many px at the border: one pixel's slope would be noise.
_SECANT = 16
# Nothing that a frame shows is moved farther; the square of it still fits a float32.
_FARTHEST = 1e7
# Rounding of fp32 coordinates, px.
_ROUNDING = 1e-3


def warp_points(
    points_xy: Tensor, flow: Tensor, *, steps: int = STEPS, tolerance_px: float = TOLERANCE_PX
) -> tuple[Tensor, Tensor]:
    """Where points of the input image land in the output, to a fraction of a pixel, and whether they are seen there.

        q + flow(q) = p, solved by Newton's method at the points alone, each step halved until the residual falls

    The flow is read bilinearly, and beyond the frame as its secant there. The search starts from p - flow(p) or from
    the best node of a coarse lattice, whichever fits better; where a fold shows a point several times, the landing
    that it finds from there is the one returned. Differentiable in both arguments by one attached Newton step
    (implicit function theorem).

    Args:
        points_xy: (B, N, 2), px, x and y; (N, 2) beside a flow of (2, H, W). NaN is a point that is not seen.
        flow: (B, 2, H, W) or (1, 2, H, W), px, backward; what is not finite shows nothing.
        steps: Newton steps, at least 1.
        tolerance_px: the residual up to which a point counts as found, px.

    Returns:
        points: (B, N, 2) or (N, 2), px, float32 or float64, finite; where nothing is found, the best that was seen.
        visible: (B, N) or (N,), bool: found, on a pixel center or between some, on a sheet that is not folded over. A
            sheet is folded over if it is turned against most of the frame, so a mirror image folds nothing.

    Raises:
        ValueError: shapes that do not fit, no step, a tolerance that is not positive.
        TypeError: an argument that is no tensor of real numbers.
    """
    check_tensor("points_xy", points_xy)
    check_tensor("flow", flow)
    if points_xy.ndim == 2 and flow.ndim == 3:
        points, visible = warp_points(points_xy[None], flow[None], steps=steps, tolerance_px=tolerance_px)
        return points[0], visible[0]
    check_rows("points_xy", points_xy, flow, 2)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    landing = land(points_xy, flow, steps, tolerance_px)
    return landing.points, landing.found & landing.upright & on_frame(landing.points, flow, 0.0)


class Landing(NamedTuple):
    """Where points land."""

    points: Tensor  # (B, N, 2), px
    found: Tensor  # (B, N), bool: the residual is small, and so far all is known of the flow
    upright: Tensor  # (B, N), bool: turned like most of the frame


class Reading(NamedTuple):
    """What a table says at some points, and how that changes."""

    value: Tensor  # (B, C, N)
    slope_x: Tensor  # (B, C, N)
    slope_y: Tensor  # (B, C, N)


def land(points: Tensor, flow: Tensor, steps: int, tolerance_px: float) -> Landing:
    """The landing of points (B, N, 2) in a flow (B or 1, 2, H, W); the arguments are taken as checked."""
    dtype = field_dtype(torch.promote_types(points.dtype, flow.dtype))
    p, flow = points.to(dtype).movedim(-1, 1), flow.to(dtype).expand(points.shape[0], -1, -1, -1)
    usual, known = p.abs().amax(dim=1, keepdim=True) <= _FARTHEST, flow.abs().amax(dim=1, keepdim=True) <= _FARTHEST
    p, flow = torch.where(usual, p, 0), torch.where(known, flow, 0)
    with torch.no_grad():
        table = torch.cat([flow, known.to(dtype)], dim=1).detach()
        node, orientation = _nearest_node(table, p.detach())
        near = _clamped(p.detach() - read_linearly(table, _clamped(p.detach(), flow)).value[:, :2], flow)
        q, error, read = _newton(table, p.detach(), near, node, steps)
        # Nothing is known where a hole in the flow would have been read.
        found = (_squared(error) <= tolerance_px**2) & (read.value[:, 2:] > 0.999) & usual
        upright = _determinant(read) * orientation > 0
    if torch.is_grad_enabled() and (p.requires_grad or flow.requires_grad):
        error = read_linearly(flow, q).value - p
        q = q - _solve(read, error - error.detach())
    return Landing(q.movedim(1, -1), found[:, 0], upright[:, 0])


def _newton(table: Tensor, p: Tensor, near: Tensor, node: Tensor, steps: int) -> tuple[Tensor, Tensor, Reading]:
    """The solution (B, 2, N), its error and the reading there, from the better of two places to start."""
    q = near
    read = read_linearly(table, q)
    error = q + read.value[:, :2] - p
    trial, length = node, torch.ones_like(q[:, :1])
    for step in range(steps + 1):
        reading = read_linearly(table, trial)
        trial_error = trial + reading.value[:, :2] - p
        better = _merit(trial_error, reading) < _merit(error, read)
        q, error = torch.where(better, trial, q), torch.where(better, trial_error, error)
        read = Reading(*(torch.where(better, new, old) for new, old in zip(reading, read, strict=True)))
        if step > 0:  # the first trial is the other start, and its failure says nothing of the length
            length = torch.where(better, (2 * length).clamp(max=1), length / 2)
        trial = _clamped(q - length * _solve(read, error), table)
    return q, error, read


def _merit(error: Tensor, read: Reading) -> Tensor:
    """What the search lessens: the residual, but a hole in the flow, read as no motion, is worse than any."""
    return _squared(error) + torch.where(read.value[:, 2:] > 0.999, 0, 4 * _FARTHEST**2)


def read_linearly(table: Tensor, at: Tensor) -> Reading:
    """The table (B, C, H, W) at the points (B, 2, N), bilinearly."""
    height, width = table.shape[2:]
    left, right, span_x = _cell(at[:, :1], width)
    top, bottom, span_y = _cell(at[:, 1:], height)
    tx, ty = (at[:, :1] - left) / span_x, (at[:, 1:] - top) / span_y
    flat = table.flatten(2)
    a, b, c, d = (
        flat.gather(2, (row * width + column).expand(-1, table.shape[1], -1))
        for row in (top, bottom)
        for column in (left, right)
    )
    above, below = a + tx * (b - a), c + tx * (d - c)
    value = above + ty * (below - above)
    return Reading(value, ((b - a) + ty * ((d - c) - (b - a))) / span_x, (below - above) / span_y)


def _cell(position: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """The whole numbers on both sides, and their distance; beyond the frame, those of the secant at its border."""
    outside = (position < 0) | (position > size - 1)
    span = torch.where(outside, min(_SECANT, max(size - 1, 1)), 1)
    low = torch.minimum(position.floor().long().clamp(min=0), size - 1 - span).clamp(min=0)
    return low, (low + span).clamp(max=size - 1), span


def _nearest_node(table: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """The node of a coarse lattice that shows what is nearest to p, (B, 2, N), and how the lattice is turned."""
    x, y = spread_over(table, 3, _NODES), spread_over(table, 2, _NODES)
    nodes = table[:, :, y.long()][..., x.long()]
    seen, known = torch.stack([nodes[:, 0] + x, nodes[:, 1] + y[:, None]], dim=1), nodes[:, 2:] > 0.5
    # What is not known is farther than anything that is, and still finite when squared.
    targets = torch.where(known, seen, 4 * _FARTHEST).flatten(2)
    nearest = [_nearest(targets, some) for some in p.split(_at_once(p), dim=2)]
    index = torch.cat(nearest, dim=1)
    node = torch.stack([x[index % x.shape[0]], y[index // x.shape[0]]], dim=1)
    return node, _orientation(x, y, seen, known)


def _nearest(targets: Tensor, p: Tensor) -> Tensor:
    """(B, N): which of the targets (B, 2, K) is the nearest to each of the points (B, 2, N)."""
    apart = targets[:, :, None] - p[..., None]
    return (apart[:, 0].square() + apart[:, 1].square()).argmin(dim=-1)


def _at_once(p: Tensor) -> int:
    """Points whose distances to all nodes stay in a core's cache; an accelerator, or a compiled graph, takes all."""
    if p.device.type != "cpu" or torch.compiler.is_compiling():
        return max(1, p.shape[2])
    return max(1, (1 << 18) // (max(1, p.shape[0]) * _NODES**2))


def spread_over(table: Tensor, dim: int, count: int) -> Tensor:
    """At most `count` pixel centers from one end of the frame to the other."""
    size = table.shape[dim]
    return torch.linspace(0, size - 1, min(size, count), dtype=table.dtype, device=table.device).round()


def _orientation(x: Tensor, y: Tensor, seen: Tensor, known: Tensor) -> Tensor:
    """(B, 1, 1): 1, or -1 where most cells of the lattice are shown mirrored."""
    if x.shape[0] == 1:
        seen = torch.cat([seen, seen + seen.new_tensor([1, 0]).view(1, 2, 1, 1)], dim=-1)
        known = known.expand(-1, -1, -1, 2)
    if y.shape[0] == 1:
        seen = torch.cat([seen, seen + seen.new_tensor([0, 1]).view(1, 2, 1, 1)], dim=-2)
        known = known.expand(-1, -1, 2, -1)
    falling, rising = seen[..., 1:, 1:] - seen[..., :-1, :-1], seen[..., 1:, :-1] - seen[..., :-1, 1:]
    area = falling[:, :1] * rising[:, 1:] - falling[:, 1:] * rising[:, :1]
    whole = known[..., 1:, 1:] & known[..., :-1, :-1] & known[..., 1:, :-1] & known[..., :-1, 1:]
    turned = torch.where(whole, area.sign(), 0).sum(dim=(2, 3))[..., None]
    return torch.where(turned < 0, -1, 1).to(seen.dtype)


def frame_ends(flow: Tensor, rim: float) -> tuple[Tensor, Tensor]:
    """The lowest and the highest corner, (2,), px, of the frame with a rim around its pixel centers."""
    height, width = flow.shape[2:]
    ends = torch.tensor([[-rim, -rim], [width - 1 + rim, height - 1 + rim]], dtype=flow.dtype, device=flow.device)
    return ends[0], ends[1]


def on_frame(points: Tensor, flow: Tensor, rim: float) -> Tensor:
    """(B, ...), bool: which points (B, ..., 2) lie on the frame with a rim around its pixel centers."""
    low, high = frame_ends(flow, rim + _ROUNDING)
    return ((points >= low) & (points <= high)).all(dim=-1)


def _clamped(points: Tensor, flow: Tensor) -> Tensor:
    """The points (B, 2, N) not farther off than eight frames."""
    reach = 8 * max(flow.shape[2:])
    return points.clamp(-reach, reach)


def _squared(vector: Tensor) -> Tensor:
    return vector[:, :1].square() + vector[:, 1:2].square()


def _determinant(read: Reading) -> Tensor:
    return (1 + read.slope_x[:, :1]) * (1 + read.slope_y[:, 1:2]) - read.slope_y[:, :1] * read.slope_x[:, 1:2]


def _solve(read: Reading, error: Tensor) -> Tensor:
    """(I + slopes)^-1 error, in closed form."""
    determinant = _determinant(read)
    # Near a fold the step has no good length; a bounded determinant keeps it finite, the residual tells the rest.
    determinant = torch.where(determinant >= 0, determinant.clamp(min=1e-3), determinant.clamp(max=-1e-3))
    a, b = error.split(1, dim=1)
    x = (1 + read.slope_y[:, 1:2]) * a - read.slope_y[:, :1] * b
    y = (1 + read.slope_x[:, :1]) * b - read.slope_x[:, 1:2] * a
    return torch.cat([x, y], dim=1) / determinant


def check_rows(name: str, rows: Tensor, flow: Tensor, length: int) -> None:
    """Raise unless rows are (B, N, length) of real numbers, of the batch of a flow with a pixel."""
    check_flow("flow", flow)
    if 0 in flow.shape[2:]:
        raise ValueError(f"flow must have a pixel, got {tuple(flow.shape)}")
    if rows.ndim != 3 or rows.shape[2] != length:
        raise ValueError(f"{name} must have shape (B, N, {length}) beside a batched flow, got {tuple(rows.shape)}")
    if rows.is_complex() or rows.dtype is torch.bool:
        raise TypeError(f"{name} must be of real numbers, got {rows.dtype}")
    if flow.shape[0] not in (1, rows.shape[0]):
        raise ValueError(f"flow must have the batch of {name}, {rows.shape[0]}, got {tuple(flow.shape)}")
