"""The flow of a lens, and the flow that undoes it."""

from functools import partial

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import eager_values, requires_grad
from torchrefract.cameras.brown_conrady import (
    Point,
    Terms,
    distort_polynomial,
    distort_with_jacobian,
    newton_undistort,
    undistort_polynomial,
    used_terms,
)
from torchrefract.cameras.radial import RadialLimit, radial_limit
from torchrefract.warping.flow import Jacobian
from torchrefract.warping.grid import Points
from torchrefract.warping.implicit import implicit

# Preimages are searched up to this many half-diagonals of the frame from the center.
REACH = 4.0


def lens_flow(coefficients: Tensor, focal: Tensor, center: Tensor, points: Points) -> tuple[Tensor, Tensor]:
    """Compute the flow that shows a frame as seen through a lens.

        flow(p) = f (undistort((p - c) / f) - (p - c) / f)

    Differentiable in the lens and in the points, by the implicit function theorem. A point without a preimage is
    sampled outside the frame.

    Args:
        coefficients: (B, 12), k1 ... k6, p1, p2, s1 ... s4 of the polynomial model.
        focal: (B, 2), px, fx and fy.
        center: (B, 2), px, cx and cy.
        points: positions in the frame.

    Returns:
        flow: (B, 2, h, w), px.
        exists: (B, 1, h, w), bool: the point has a preimage.
    """
    c, terms = coefficients[:, :, None, None, None], used_terms(coefficients)
    limit = frame_limit(coefficients, focal, center, height=points.lattice.height, width=points.lattice.width)
    x_d, y_d = on_plane(points, focal, center)
    x, y, exists = undistort_polynomial(x_d.detach(), y_d.detach(), c.detach(), limit=limit, terms=terms)
    if requires_grad((c, x_d)):
        x, y = _with_gradient(*_replace_missing(x, y, exists), x_d, y_d, c, terms)
    return _to_flow(x - x_d, y - y_d, exists, x_d, y_d, focal), exists


def lens_restore_flow(coefficients: Tensor, focal: Tensor, center: Tensor, points: Points) -> tuple[Tensor, Tensor]:
    """Compute the flow that undoes `lens_flow`, in closed form.

        flow(p) = f (distort((p - c) / f) - (p - c) / f)

    Args, Returns: as for `lens_flow`; `exists` is False where the lens shows that part of the scene folded over.
    """
    c, terms = coefficients[:, :, None, None, None], used_terms(coefficients)
    limit = frame_limit(coefficients, focal, center, height=points.lattice.height, width=points.lattice.width)
    x, y = (axis.contiguous() for axis in torch.broadcast_tensors(*on_plane(points, focal, center)))
    with torch.no_grad():
        is_shown = x * x + y * y <= limit.radius.square()
        if terms.bent:
            (x_d, y_d), jacobian = distort_with_jacobian(x, y, c, terms)
            exists = is_shown & (jacobian.determinant > 0) & (jacobian.determinant < torch.inf)
        else:
            (x_d, y_d), exists = distort_polynomial(x, y, c, terms), is_shown
    if requires_grad((c, x)):
        x_d, y_d = distort_polynomial(*_replace_missing(x, y, exists), c, terms)
    return _to_flow(x_d - x, y_d - y, exists, x, y, focal), exists


def newton_lens_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, points: Points, *, num_steps: int, terms: Terms
) -> Tensor:
    """Compute `lens_flow` with a fixed number of Newton steps, for lenses that fold nowhere near the points.

    Args:
        coefficients, focal, center, points: as for `lens_flow`.
        num_steps: of `newton_undistort`.
        terms: the terms of the polynomial to compute.

    Returns:
        (B, 2, h, w), px.
    """
    c = coefficients[:, :, None, None, None]
    x_d, y_d = on_plane(points, focal, center)
    x, y = newton_undistort(x_d.detach(), y_d.detach(), c.detach(), steps=num_steps, terms=terms)
    if requires_grad((c, x_d)):
        x, y = _with_gradient(x, y, x_d, y_d, c, terms)
    return torch.cat([x - x_d, y - y_d], dim=1) * focal[:, :, None, None]


def frame_limit(coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int) -> RadialLimit:
    """Return how far the radial part of lenses can be inverted in a frame; arguments as for `lens_flow`."""
    corner = corner_radius(focal.detach(), center.detach(), height, width)
    return radial_limit(coefficients.detach()[:, :, None, None, None], REACH * corner, 1.1 * corner)


def misses_in_frame(exists: Tensor, points: Points) -> Tensor:
    """Return (B,), bool: a point inside of the frame has no preimage; `exists` as from `lens_flow` at the points."""
    last_x, last_y = points.lattice.width - 1, points.lattice.height - 1
    is_inside = (points.x >= 0) & (points.x <= last_x) & (points.y >= 0) & (points.y <= last_y)
    return (is_inside & ~exists).flatten(1).any(dim=1)


def corner_radius(focal: Tensor, center: Tensor, height: int, width: int) -> Tensor:
    """Return (B,), on the plane z = 1: the distance of the farthest corner of the frame from the center."""
    size = as_device_tensor([width - 1, height - 1], dtype=focal.dtype, device=focal.device)
    # Half a pixel at least, so that a frame of one pixel has a radius too.
    farthest = torch.maximum(center.abs(), (size - center).abs()).clamp(min=0.5) / focal
    return farthest.square().sum(dim=1).sqrt()


def on_plane(points: Points, focal: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y of the points on the plane z = 1, which broadcast to (B, 1, h, w)."""
    (fx, fy), (cx, cy) = focal[:, :, None, None, None].unbind(1), center[:, :, None, None, None].unbind(1)
    return (points.x - cx) / fx, (points.y - cy) / fy


def _replace_missing(x: Tensor, y: Tensor, exists: Tensor) -> tuple[Tensor, Tensor]:
    # Zero times an infinite slope is NaN, so that points without a solution must not reach the backward pass.
    return torch.where(exists, x, 0), torch.where(exists, y, 0)


def _with_gradient(x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, c: Tensor, terms: Terms) -> tuple[Tensor, Tensor]:
    """Attach the gradient of the exact inverse to a solution (x, y)."""
    x, y = implicit((x, y), (x_d, y_d, c), partial(_distortion_error, terms=terms))
    return x, y


def _distortion_error(
    x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, c: Tensor, *, terms: Terms
) -> tuple[Point, Jacobian]:
    (reached_x, reached_y), jacobian = distort_with_jacobian(x, y, c, terms)
    return (reached_x - x_d, reached_y - y_d), jacobian


def _to_flow(u: Tensor, v: Tensor, exists: Tensor, x: Tensor, y: Tensor, focal: Tensor) -> Tensor:
    if not eager_values(exists.all, of=exists):
        # Points without a solution are sampled outward past every frame: padded, never extrapolated.
        u, v = torch.where(exists, u, 2 * REACH * x.detach()), torch.where(exists, v, 2 * REACH * y.detach())
    return torch.cat([u, v], dim=1) * focal[:, :, None, None]
