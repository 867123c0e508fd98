"""Points of an image that follow a backward flow."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import check_count, check_flow, check_positive, check_tensor, eager_values, requires_grad
from torchrefract.warping.flow import Jacobian
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.implicit import LinearSample, implicit, sample_linear

# Smooth flows converge in 6 Newton steps; flows that nearly fold gain little beyond 16.
_STEPS = 16
_TOLERANCE_PX = 0.01
# Nodes along each side of the lattice from which the search starts.
_NUM_NODES = 17
# Larger coordinates count as invalid; the square of this still fits into float32.
_LARGEST_PX = 1e7
# Rounding error of float32 coordinates, px.
_ROUNDING_PX = 1e-3
# Points that are compared with all nodes at once; this bounds the memory of their distances.
_CHUNK = 4096


def warp_points(
    points_xy: Tensor, flow: Tensor, *, steps: int = _STEPS, tolerance_px: float = _TOLERANCE_PX
) -> tuple[Tensor, Tensor]:
    """Map points of the input image to the warped image.

    Newton's method solves the following equation at each point, with steps that are halved until the residual falls.

        q + flow(q) = p

    The flow is interpolated bilinearly and extrapolated along its secant. The search starts from p - flow(p) or from
    the best node of a coarse lattice, whichever has the smaller residual. A fold shows a point several times; the
    search returns one of these solutions. Gradients of both arguments follow from the implicit function theorem.

    Args:
        points_xy: (B, N, 2), px, x and y; (N, 2) for a flow of shape (2, H, W). A NaN point is invisible.
        flow: (B, 2, H, W) or (1, 2, H, W), px, backward; pixels with NaN or infinite flow show nothing.
        steps: number of Newton steps, at least 1.
        tolerance_px: largest residual of a solution, px.

    Returns:
        points: (B, N, 2) or (N, 2), px, float32 or float64, finite; the best attempt if the search fails.
        visible: (B, N) or (N,), bool: the search converged within the pixel centers of the frame, and the image is not
            folded over at the point, that is, the local orientation is that of most of the frame.

    Raises:
        ValueError: if shapes do not fit, or `steps` or `tolerance_px` is out of range.
        TypeError: if an argument is not a tensor of real numbers.
    """
    check_tensor("points_xy", points_xy)
    check_tensor("flow", flow)
    if points_xy.ndim == 2 and flow.ndim == 3:
        points, visible = warp_points(points_xy[None], flow[None], steps=steps, tolerance_px=tolerance_px)
        return points[0], visible[0]
    check_coordinates("points_xy", points_xy, flow, 2)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    solution = solve_points(points_xy, flow, steps=steps, tolerance_px=tolerance_px)
    visible = solution.converged & solution.upright & in_frame(solution.points, flow, 0.0)
    return solution.points, visible


class PointSolution(NamedTuple):
    """Positions of points in the warped image."""

    points: Tensor  # (B, N, 2), px
    converged: Tensor  # (B, N), bool: the residual is small and the flow is valid there
    upright: Tensor  # (B, N), bool: the local orientation is that of most of the frame


def solve_points(
    points: Tensor, flow: Tensor, *, steps: int = _STEPS, tolerance_px: float = _TOLERANCE_PX
) -> PointSolution:
    """Solve q + flow(q) = p for points (B, N, 2) and a flow (B or 1, 2, H, W), without checks."""
    dtype = field_dtype(torch.promote_types(points.dtype, flow.dtype))
    p, flow = points.to(dtype).movedim(-1, 1), flow.to(dtype).expand(points.shape[0], -1, -1, -1)
    usable = p.abs().amax(dim=1, keepdim=True) <= _LARGEST_PX
    valid = flow.abs().amax(dim=1, keepdim=True) <= _LARGEST_PX
    p, flow = torch.where(usable, p, 0), torch.where(valid, flow, 0)
    with torch.no_grad():
        table = torch.cat([flow, valid.to(dtype)], dim=1).detach()
        node, orientation = _nearest_node(table, p.detach())
        shifted = p.detach() - sample_linear(table, _clamp(p.detach(), flow)).value[:, :2]
        q, error, sample = _newton(table, p.detach(), _clamp(shifted, flow), node, steps)
        # A point is invalid if its bilinear sample touches an invalid pixel of the flow.
        converged = (_squared_norm(error) <= tolerance_px**2) & (sample.value[:, 2:] > 0.999) & usable
        upright = sample.jacobian.determinant * orientation > 0
    if requires_grad((p, flow)):
        # A point without a solution keeps the best attempt, which has no derivative.
        q = torch.where(converged, torch.cat(implicit(q.split(1, dim=1), (p, flow), _error), dim=1), q)
    return PointSolution(q.movedim(1, -1), converged[:, 0], upright[:, 0])


def _newton(table: Tensor, p: Tensor, start: Tensor, node: Tensor, steps: int) -> tuple[Tensor, Tensor, LinearSample]:
    """Return the solution (B, 2, N), its error and the sample of the table, from the better of two starts."""
    q = start
    best = sample_linear(table, q)
    error = q + best.value[:, :2] - p
    trial, length = node, torch.ones_like(q[:, :1])
    rounding = 2 * torch.finfo(p.dtype).eps * max(table.shape[2:])
    for step in range(steps + 1):
        sample = sample_linear(table, trial)
        trial_error = trial + sample.value[:, :2] - p
        better = _merit(trial_error, sample) < _merit(error, best)
        q, error = torch.where(better, trial, q), torch.where(better, trial_error, error)
        best = LinearSample(*(torch.where(better, new, old) for new, old in zip(sample, best, strict=True)))
        if eager_values((_merit(error, best) <= rounding**2).all, of=error):
            break
        if step > 0:  # the first trial is the second start, whose failure says nothing about the step length
            length = torch.where(better, (2 * length).clamp(max=1), length / 2)
        trial = _clamp(q - length * _newton_step(best, error), table)
    return q, error, best


def _merit(error: Tensor, sample: LinearSample) -> Tensor:
    """Return the squared residual; invalid flow, which is stored as zero, is worse than any residual."""
    squared = _squared_norm(error)
    return torch.where(sample.value[:, 2:] > 0.999, squared, squared + 4 * _LARGEST_PX**2)


def _nearest_node(table: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Return the node of a coarse lattice that shows the content nearest to p, (B, 2, N), and the orientation."""
    x, y = pixel_subset(table, 3, _NUM_NODES), pixel_subset(table, 2, _NUM_NODES)
    nodes = table[:, :, y.long()][..., x.long()]
    content, valid = torch.stack([nodes[:, 0] + x, nodes[:, 1] + y[:, None]], dim=1), nodes[:, 2:] > 0.5
    # Invalid nodes get a distance larger than any valid one, whose square is still finite.
    targets = torch.where(valid, content, 4 * _LARGEST_PX).flatten(2)
    # Products of matrices would round away differences between large coordinates.
    distances = (
        torch.cdist(chunk, targets.mT, compute_mode="donot_use_mm_for_euclid_dist")
        for chunk in p.mT.split(_CHUNK, dim=1)
    )
    index = torch.cat([distance.argmin(dim=2) for distance in distances], dim=1)
    node = torch.stack([x[index % x.shape[0]], y[index // x.shape[0]]], dim=1)
    return node, _orientation(content, valid)


def pixel_subset(table: Tensor, dim: int, count: int) -> Tensor:
    """Return at most `count` pixel centers spread from one end of a dimension to the other."""
    size = table.shape[dim]
    return torch.linspace(0, size - 1, min(size, count), dtype=table.dtype, device=table.device).round()


def _orientation(content: Tensor, valid: Tensor) -> Tensor:
    """Return 1, or -1 if most cells of the lattice are mirrored: (B, 1, 1)."""
    for dim, step in ((-1, (1.0, 0.0)), (-2, (0.0, 1.0))):
        if content.shape[dim] == 1:  # one line of nodes has no cells: repeat it one pixel further
            content = torch.cat([content, content + content.new_tensor(step).view(1, 2, 1, 1)], dim=dim)
            valid = torch.cat([valid, valid], dim=dim)
    falling, rising = content[..., 1:, 1:] - content[..., :-1, :-1], content[..., 1:, :-1] - content[..., :-1, 1:]
    area = falling[:, :1] * rising[:, 1:] - falling[:, 1:] * rising[:, :1]
    is_complete = valid[..., 1:, 1:] & valid[..., :-1, :-1] & valid[..., 1:, :-1] & valid[..., :-1, 1:]
    balance = torch.where(is_complete, area.sign(), 0).sum(dim=(2, 3))[..., None]
    return torch.where(balance < 0, -1, 1).to(content.dtype)


def frame_bounds(flow: Tensor, border_px: float) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest corner, (2,), px, of the pixel centers with a border around them."""
    height, width = flow.shape[2:]
    corners = [[-border_px, -border_px], [width - 1 + border_px, height - 1 + border_px]]
    low, high = torch.tensor(corners, dtype=flow.dtype, device=flow.device)
    return low, high


def in_frame(points: Tensor, flow: Tensor, border_px: float) -> Tensor:
    """Return True for points (B, ..., 2) on the pixel centers or a border around them: (B, ...)."""
    low, high = frame_bounds(flow, border_px + _ROUNDING_PX)
    return ((points >= low) & (points <= high)).all(dim=-1)


def _clamp(points: Tensor, flow: Tensor) -> Tensor:
    """Clamp points (B, 2, N) to eight frame sizes."""
    reach = 8 * max(flow.shape[2:])
    return points.clamp(-reach, reach)


def _error(x: Tensor, y: Tensor, p: Tensor, flow: Tensor) -> tuple[tuple[Tensor, Tensor], Jacobian]:
    q = torch.cat([x, y], dim=1)
    sample = sample_linear(flow, q)
    u, v = (q + sample.value - p).split(1, dim=1)
    return (u, v), sample.jacobian


def _squared_norm(vector: Tensor) -> Tensor:
    return vector[:, :1].square() + vector[:, 1:2].square()


def _newton_step(sample: LinearSample, error: Tensor) -> Tensor:
    """Return (I + slopes)^-1 error in closed form."""
    jacobian = sample.jacobian
    (xx, xy, yx, yy), determinant = jacobian, jacobian.determinant
    # Near a fold the step length is meaningless: bound it, and let the residual decide.
    determinant = torch.where(determinant >= 0, determinant.clamp(min=1e-3), determinant.clamp(max=-1e-3))
    u, v = error.split(1, dim=1)
    return torch.cat([yy * u - xy * v, xx * v - yx * u], dim=1) / determinant


def check_coordinates(name: str, rows: Tensor, flow: Tensor, length: int) -> None:
    """Raise unless `rows` holds real numbers (B, N, length) and the flow has the same batch and at least one pixel."""
    check_flow("flow", flow)
    if 0 in flow.shape[2:]:
        raise ValueError(f"flow must have at least one pixel, got {tuple(flow.shape)}")
    if rows.ndim != 3 or rows.shape[2] != length:
        raise ValueError(f"{name} must have shape (B, N, {length}) for a batched flow, got {tuple(rows.shape)}")
    if rows.is_complex() or rows.dtype is torch.bool:
        raise TypeError(f"{name} must contain real numbers, got {rows.dtype}")
    if flow.shape[0] not in (1, rows.shape[0]):
        raise ValueError(f"flow must have a batch of 1 or {rows.shape[0]}, as {name}, got {tuple(flow.shape)}")
