"""The flow that shows the frames of a camera of any model as a pinhole would have taken them, and the flow back."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchrefract._validation import check_positive
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.projection import columns, image_of, on_plane, radius_within, ray_of
from torchrefract.fields.lens import REACH, axes_on_plane, border, corner_radius, lens_rows, stacked
from torchrefract.fields.lens_bounds import LensErrors, cubic_errors, lines_of_cells
from torchrefract.warping.grid import pixel_axes
from torchrefract.warping.lattice import Lattice

_FAR = 8.0  # frames, to where pixels look that the camera shows nothing of
_CELLS = 48  # along each axis, in which cubics are compared with the flow
_MARGIN = 1.5


def rectification_flow(
    coefficients: Tensor,
    focal: Tensor,
    center: Tensor,
    *,
    model: str,
    height: int,
    width: int,
    zoom: float = 1.0,
    axes: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """The flow that turns frames of cameras into those of pinholes: each pixel looks where the lens shows its ray.

        flow(p) = f (distort(x) - zoom x),  x = (p - c) / (zoom f)

    Differentiable in the first three arguments. A pixel whose ray the camera does not show looks outside the frame.

    Args:
        coefficients: (B, n), of the model.
        focal: (B, 2), px, fx and fy.
        center: (B, 2), px, cx and cy.
        model: "polynomial12", "opencv", "fisheye" or "division".
        height, width: px, of the frame.
        zoom: of the focal lengths; below 1 the pinhole sees more.
        axes: x, (1, 1, 1, m), and y, (1, 1, n, 1), px, of the places; None is every pixel.

    Returns:
        flow: (B, 2, H, W), or (B, 2, n, m), px.
        exists: (B, 1, H, W), bool: the camera shows that ray, on the sheet that holds the center.
    """
    c = columns(coefficients, model)
    radius = radius_within(coefficients, REACH / zoom * _corner(focal, center, height, width), model)

    def looked_up(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y = x / zoom, y / zoom
        x_d, y_d, exists = image_of(x, y, torch.ones_like(x), c, model, radius)
        return x_d - zoom * x, y_d - zoom * y, exists

    return _flow(looked_up, focal, center, axes or _pixels(focal, height, width), height=height, width=width)


def rectification_restore_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, *, model: str, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """The flow that undoes `rectification_flow` (of no zoom): each pixel looks where its ray meets the pinhole's frame.

        flow(p) = f (undistort(x_d) - x_d),  x_d = (p - c) / f

    Args and Returns as there; `exists` is false where the camera shows no ray, or one that no pinhole shows.
    """
    c = columns(coefficients, model)
    radius = radius_within(coefficients, REACH * _corner(focal, center, height, width), model)

    def looked_up(x_d: Tensor, y_d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y, exists = on_plane(*ray_of(x_d, y_d, c, model, radius))
        return x - x_d, y - y_d, exists

    # The table of the inverse is of all pixels that are asked for, so these may not come in bands.
    axes = _pixels(focal, height, width)
    return _flow(looked_up, focal, center, axes, height=height, width=width, rows=height)


def shows_folded(coefficients: Tensor, focal: Tensor, center: Tensor, *, model: str, height: int, width: int) -> Tensor:
    """(B,), bool: part of the border of the pinhole's frame is not shown; arguments as for `rectification_flow`."""
    x, y = (places.detach().flatten(1) for places in border(focal, center, height, width))
    radius = radius_within(coefficients, REACH * _corner(focal, center, height, width), model)
    return ~image_of(x, y, torch.ones_like(x), columns(coefficients, model), model, radius)[2].all(dim=1)


def camera_flow(camera: Camera, *, zoom: float = 1.0) -> tuple[Tensor, Tensor, Camera]:
    """The flow of `rectification_flow` for one camera, computed in float64.

    Args:
        camera: of the frames.
        zoom: of its focal lengths; below 1 the pinhole sees more.

    Returns:
        flow: (1, 2, H, W), px, float32.
        exists: (1, 1, H, W), bool: the camera shows that ray.
        pinhole: the new camera.

    Raises:
        ValueError: a zoom of 0 or below; a camera with a pole inside its frame, see `Camera.check_pole`.
    """
    camera.check_pole()
    zoom, height, width = check_positive("zoom", zoom), camera.height, camera.width
    pinhole = replace(camera, model="opencv", coefficients=(0.0,) * 4, fx=zoom * camera.fx, fy=zoom * camera.fy)
    numbers = camera.tensors(torch.empty(0, dtype=torch.float64))
    flow, exists = rectification_flow(*numbers, model=camera.model, height=height, width=width, zoom=zoom)
    return flow.float(), exists, pinhole


def rectification_errors(camera: Camera, lattice: Lattice) -> LensErrors | None:
    """How far the flow of a camera on a lattice is from the exact one; None where it does not exist all over it.

    Measured in float64 in cells all over the frame, and taken 1.5 times, as `lens_errors` has it; for this one camera.
    """
    at = lines_of_cells(lattice, _CELLS)
    c, focal, center = camera.tensors(at)
    x, y = ((at[:, i] - center[:, i]) / focal[:, i] for i in range(2))
    reach = REACH * corner_radius(focal, center, lattice.height, lattice.width)
    radius = radius_within(c, reach, camera.model)
    x_d, y_d, exists = image_of(x, y, torch.ones_like(x), columns(c, camera.model), camera.model, radius)
    if not exists.all():
        return None
    off, *derivatives = cubic_errors(torch.stack([(x_d - x) * focal[:, 0], (y_d - y) * focal[:, 1]]), lattice.stride)
    stretch = torch.hypot(x_d, y_d) / torch.hypot(x, y).clamp(min=1e-9)
    return LensErrors(_MARGIN * off.item(), (), stretch.max().item(), *(_MARGIN * each.item() for each in derivatives))


def _pixels(like: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    return pixel_axes(height, width, dtype=like.dtype, device=like.device)


def _corner(focal: Tensor, center: Tensor, height: int, width: int) -> Tensor:
    return corner_radius(focal.detach(), center.detach(), height, width)


def _flow(
    looked_up: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    focal: Tensor,
    center: Tensor,
    axes: tuple[Tensor, Tensor],
    *,
    height: int,
    width: int,
    rows: int | None = None,
) -> tuple[Tensor, Tensor]:
    """The flow f (u, v) of a function from x and y, (B, N), on the plane z = 1 to u, v and whether it exists."""
    (x, y), far = axes_on_plane(axes, focal, center), _FAR * max(height, width)

    def band(y: Tensor) -> tuple[Tensor, Tensor]:
        shape = (x.shape[0], 1, y.shape[2], x.shape[3])
        flat_x, flat_y = (value.expand(shape).flatten(1) for value in (x, y))
        u, v, exists = looked_up(flat_x, flat_y)
        # Outward from the center of the lens, farther than any frame goes: padded, never extrapolated.
        with torch.no_grad():
            outward = far / (flat_x * flat_x + flat_y * flat_y).sqrt().clamp(min=1e-9)
        u, v = (
            torch.where(exists, part * focal[:, i, None], (outward * at).detach())
            for i, (part, at) in enumerate(((u, flat_x), (v, flat_y)))
        )
        return torch.stack([u, v], dim=1).view(shape[0], 2, *shape[2:]), exists.view(shape)

    return stacked([band(part) for part in y.split(rows or lens_rows(x, y.shape[2]), dim=2)])
