"""The flow of a lens, and the flow that undoes it."""

import torch
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract._tensor import as_device_tensor, rows_at_once
from torchrefract._validation import eager_bool, requires_grad
from torchrefract.cameras.brown_conrady import (
    Terms,
    distort_polynomial,
    distort_with_jacobian,
    implicit,
    jacobian_polynomial,
    newton_undistort,
    undistort_polynomial,
    used_terms,
)
from torchrefract.cameras.radial import RadialLimit, radial_limit
from torchrefract.warping.grid import pixel_axes

# The preimage of a pixel is looked for up to so many half-diagonals of the frame; beyond, nothing of it is seen.
REACH = 4.0
# Points of each side of the frame at which a fold is looked for; folds begin at the border.
_BORDER = 17
_CACHED = 1 << 16  # places whose numbers stay in a core's cache


def lens_flow(coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The flow that shows a frame as seen through a lens: each pixel looks where it came from before the lens.

        flow(p) = f (undistort((p - c) / f) - (p - c) / f)

    Differentiable in all three arguments by the implicit function theorem. A pixel without a preimage looks outside
    the frame.

    Args:
        coefficients: (B, 12), k1 ... k6, p1, p2, s1 ... s4 of the polynomial model.
        focal: (B, 2), px, fx and fy.
        center: (B, 2), px, cx and cy.
        height, width: px, of the frame.

    Returns:
        flow: (B, 2, H, W), px.
        exists: (B, 1, H, W), bool: the pixel has a preimage.
    """
    c, terms, x_d, y_d = _normalized(coefficients, focal, center, height, width)
    limit = frame_limit(coefficients, focal, center, height=height, width=width)
    bands = y_d.split(lens_rows(x_d, height), dim=2)
    return stacked([_flow_of_rows(x_d, rows, c, focal, limit, terms) for rows in bands])


def lens_restore_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """The flow that undoes `lens_flow`, in closed form: each clean pixel looks where the lens has put it.

        flow(p) = f (distort((p - c) / f) - (p - c) / f)

    Args and Returns as for `lens_flow`; `exists` is false where the lens shows that part of the scene folded over.
    """
    c, terms, x, y = _normalized(coefficients, focal, center, height, width)
    limit = frame_limit(coefficients, focal, center, height=height, width=width)
    bands = y.split(lens_rows(x, height), dim=2)
    return stacked([_restore_flow_of_rows(x, rows, c, focal, limit, terms) for rows in bands])


def smooth_lens_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, x: Tensor, y: Tensor, *, steps: int, terms: Terms, large: bool
) -> Tensor:
    """The flow of `lens_flow` at any places, for lenses that fold nowhere near, by so many Newton steps.

    Args:
        coefficients, focal, center: as for `lens_flow`.
        x, y: (1, 1, 1, m) and (1, 1, n, 1), px.
        steps: of `newton_undistort`.
        terms: those to compute.
        large: the frame is worth a kernel.

    Returns:
        (B, 2, n, m), px.
    """
    values = coefficients, focal, center, x, y
    if large and not requires_grad(values) and not compiled.obstacle(*values):
        out = coefficients.new_empty(len(coefficients), 2, y.shape[2], x.shape[3])
        arrays = (own.contiguous().numpy() for own in (_kept(coefficients, terms), focal, center))
        places = x.flatten().numpy(), y.flatten().numpy()
        compiled.kernels("fields.kernels.lenses").smooth_flows(*arrays, *places, steps, out.numpy())
        return out
    c = coefficients[:, :, None, None, None]
    x_d, y_d = axes_on_plane((x, y), focal, center)
    found_x, found_y = newton_undistort(x_d.detach(), y_d.detach(), c.detach(), steps=steps, terms=terms)
    if torch.is_grad_enabled() and (c.requires_grad or x_d.requires_grad):
        found_x, found_y = _attach(found_x, found_y, x_d, y_d, c, terms)
    return torch.cat([found_x - x_d, found_y - y_d], dim=1) * focal[:, :, None, None]


def _kept(coefficients: Tensor, terms: Terms) -> Tensor:
    """(B, 12): those of the terms, and 0 for the others."""
    flags = [i < terms.radial for i in range(6)] + [terms.tangential] * 2 + [terms.prism] * 4
    return torch.where(as_device_tensor(flags, device=coefficients.device), coefficients, 0)


def frame_limit(coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int) -> RadialLimit:
    """How far the radial part can be inverted, looked for as far as the frame asks; arguments as for `lens_flow`."""
    corner = corner_radius(focal.detach(), center.detach(), height, width)
    return radial_limit(coefficients.detach()[:, :, None, None, None], REACH * corner, 1.1 * corner)


def folds_inside(coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int) -> Tensor:
    """(B,), bool: part of the border of the frame has no preimage; arguments as for `lens_flow`."""
    limit = frame_limit(coefficients, focal, center, height=height, width=width)
    c = coefficients.detach()[:, :, None, None, None]
    x_d, y_d = border(focal.detach(), center.detach(), height, width)
    return ~undistort_polynomial(x_d, y_d, c, limit=limit)[2].flatten(1).all(dim=1)


def border(focal: Tensor, center: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """x and y, (B, 1, 1, N), on the plane z = 1, of points on the border of the frame."""
    steps = torch.linspace(0, 1, _BORDER, dtype=focal.dtype, device=focal.device)
    ends = as_device_tensor([0, 1], dtype=focal.dtype, device=focal.device)
    sides = torch.cat([torch.cartesian_prod(steps, ends), torch.cartesian_prod(ends, steps)])
    size = as_device_tensor([width - 1, height - 1], dtype=focal.dtype, device=focal.device)
    x, y = ((sides * size - center[:, None]) / focal[:, None])[:, None, None].unbind(-1)
    return x, y


def corner_radius(focal: Tensor, center: Tensor, height: int, width: int) -> Tensor:
    """(B,), on the plane z = 1: the distance of the farthest corner of the frame."""
    size = as_device_tensor([width - 1, height - 1], dtype=focal.dtype, device=focal.device)
    # Half a pixel at least, so that a frame of one pixel has a radius too.
    farthest = torch.maximum(center.abs(), (size - center).abs()).clamp(min=0.5) / focal
    return farthest.square().sum(dim=1).sqrt()


def _normalized(
    coefficients: Tensor, focal: Tensor, center: Tensor, height: int, width: int
) -> tuple[Tensor, Terms, Tensor, Tensor]:
    x, y = axes_on_plane(pixel_axes(height, width, dtype=focal.dtype, device=focal.device), focal, center)
    return coefficients[:, :, None, None, None], used_terms(coefficients), x, y


def axes_on_plane(axes: tuple[Tensor, Tensor], focal: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Places in px on the plane z = 1."""
    x, y = ((axis - center[:, i, None, None, None]) / focal[:, i, None, None, None] for i, axis in enumerate(axes))
    return x, y


def lens_rows(x: Tensor, height: int) -> int:
    """How many rows of places x, (B, 1, 1, W), of so many are computed at once."""
    return rows_at_once(x.device, height, each=x.shape[0] * x.shape[3], cached=_CACHED)


def stacked(bands: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Flows and where they exist, from those of bands of rows."""
    if len(bands) == 1:
        return bands[0]
    flows, exists = zip(*bands, strict=True)
    return torch.cat(flows, dim=2), torch.cat(exists, dim=2)


def _flow_of_rows(
    x_d: Tensor, y_d: Tensor, c: Tensor, focal: Tensor, limit: RadialLimit, terms: Terms
) -> tuple[Tensor, Tensor]:
    x, y, exists = undistort_polynomial(x_d.detach(), y_d.detach(), c.detach(), limit=limit, terms=terms)
    if torch.is_grad_enabled() and (c.requires_grad or x_d.requires_grad):
        x, y = _attach(*_known(x, y, exists), x_d, y_d, c, terms)
    return _as_flow(x - x_d, y - y_d, exists, x_d, y_d, focal), exists


def _restore_flow_of_rows(
    x: Tensor, y: Tensor, c: Tensor, focal: Tensor, limit: RadialLimit, terms: Terms
) -> tuple[Tensor, Tensor]:
    x, y = (axis.contiguous() for axis in torch.broadcast_tensors(x, y))
    with torch.no_grad():
        if terms.bent:
            (x_d, y_d), jacobian = distort_with_jacobian(x, y, c, terms)
            exists = _unfolded(x, y, jacobian.determinant, limit)
        else:
            x_d, y_d = distort_polynomial(x, y, c, terms)
            exists = x * x + y * y <= limit.radius.square()
    if torch.is_grad_enabled() and (c.requires_grad or x.requires_grad):
        x_d, y_d = distort_polynomial(*_known(x, y, exists), c, terms)
    return _as_flow(x_d - x, y_d - y, exists, x, y, focal), exists


def _known(x: Tensor, y: Tensor, exists: Tensor) -> tuple[Tensor, Tensor]:
    """The points that exist; the others at the center, as zero times an infinite slope would be a gradient of NaN."""
    return torch.where(exists, x, 0), torch.where(exists, y, 0)


def _unfolded(x: Tensor, y: Tensor, determinant: Tensor, limit: RadialLimit) -> Tensor:
    """(B, 1, H, W), bool: the points that are shown, and not folded over."""
    squared, most = x * x + y * y, limit.radius.square()
    # Comparisons of every point are slow.

    def everywhere() -> Tensor:
        return ((squared - most).amax() <= 0) & (determinant.amin() > 0) & (determinant.amax() < torch.inf)

    if eager_bool(everywhere, of=squared):
        return torch.ones_like(squared, dtype=torch.bool)
    return (squared <= most) & (determinant > 0) & (determinant < torch.inf)  # no number: nothing is shown there


def _attach(x: Tensor, y: Tensor, x_d: Tensor, y_d: Tensor, c: Tensor, terms: Terms) -> tuple[Tensor, Tensor]:
    """(x, y) with the gradient of the exact inverse."""
    with torch.no_grad():
        jacobian = jacobian_polynomial(x, y, c, terms)
    reached_x, reached_y = distort_polynomial(x, y, c, terms)
    return implicit((x, y), (reached_x - x_d, reached_y - y_d), jacobian)


def _as_flow(u: Tensor, v: Tensor, exists: Tensor, x: Tensor, y: Tensor, focal: Tensor) -> Tensor:
    if not eager_bool(exists.all, of=exists):
        # Where there is no answer, look outward past every frame: padded, never extrapolated.
        u, v = torch.where(exists, u, 2 * REACH * x.detach()), torch.where(exists, v, 2 * REACH * y.detach())
    return torch.cat([u, v], dim=1) * focal[:, :, None, None]
