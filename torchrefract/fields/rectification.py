"""The flow that shows frames of a camera of any model as a pinhole would have taken them, and the flow back."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor, cached_constant
from torchrefract._validation import check_positive
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.projection import columns, image_of, on_plane, radius_within, ray_of
from torchrefract.fields import lens
from torchrefract.fields.filled_frame import MARGIN_PX, border_points
from torchrefract.fields.lens import REACH, border_on_plane, corner_radius
from torchrefract.fields.lens_error import cell_lines, flow_bounds, outermost_nodes, with_zoom
from torchrefract.types import FlowBounds, Simplification
from torchrefract.warping.grid import Points
from torchrefract.warping.lattice import pixel_lattice

_FAR = 8.0  # frames, to where pixels without a ray are sent
_LARGEST_ZOOM = 64.0
_CLOSE = 1e-5  # relative rounding error of camera parameters


def rectification_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, points: Points, *, model: str, zoom: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Compute the flow that turns frames of cameras into those of pinholes.

        flow(p) = f (distort(x) - zoom x),  x = (p - c) / (zoom f)

    Differentiable in the first three arguments and in the points. A pixel whose ray the camera does not show is
    sampled outside the frame.

    Args:
        coefficients: (B, n), of the model.
        focal: (B, 2), px, fx and fy.
        center: (B, 2), px, cx and cy.
        points: positions in the frame.
        model: "polynomial12", "opencv", "fisheye" or "division".
        zoom: of the focal lengths; below 1 the pinhole sees more.

    Returns:
        flow: (B, 2, h, w), px.
        exists: (B, 1, h, w), bool: the camera shows that ray, on the sheet that holds the center.
    """
    x, y = (axis / zoom for axis in _on_plane(points, focal, center))
    reach = REACH / zoom * _corner(focal, center, points)
    x_d, y_d, exists = _project(coefficients, x, y, model, reach)
    return _to_flow(x_d - zoom * x, y_d - zoom * y, exists, zoom * x, zoom * y, focal, points)


def rectification_restore_flow(
    coefficients: Tensor, focal: Tensor, center: Tensor, points: Points, *, model: str
) -> tuple[Tensor, Tensor]:
    """Compute the flow that undoes `rectification_flow` without a zoom.

        flow(p) = f (undistort(x_d) - x_d),  x_d = (p - c) / f

    Args, Returns: as there; `exists` is False where the camera shows no ray, or one that no pinhole shows.
    """
    x_d, y_d = _on_plane(points, focal, center)
    radius = radius_within(coefficients, REACH * _corner(focal, center, points), model)
    x, y, exists = on_plane(*ray_of(x_d, y_d, columns(coefficients, model), model, radius))
    return _to_flow(x - x_d, y - y_d, exists, x_d, y_d, focal, points)


def is_border_missing(
    coefficients: Tensor, focal: Tensor, center: Tensor, *, model: str, height: int, width: int
) -> Tensor:
    """Return (B,), bool: the camera does not show part of the border of the pinhole's frame."""
    x, y = (axis.detach().flatten(1) for axis in border_on_plane(focal, center, height, width))
    reach = REACH * corner_radius(focal.detach(), center.detach(), height, width)
    return ~_project(coefficients, x, y, model, reach)[2].all(dim=1)


def camera_flow(camera: Camera, *, zoom: float = 1.0) -> tuple[Tensor, Tensor, Camera]:
    """Compute `rectification_flow` for one camera in float64.

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
    zoom = check_positive("zoom", zoom)
    numbers = camera.tensors(torch.empty(0, dtype=torch.float64, device="cpu"))
    points = pixel_lattice(camera.height, camera.width).points(dtype=torch.float64, device=torch.device("cpu"))
    flow, exists = rectification_flow(*numbers, points, model=camera.model, zoom=zoom)
    return flow.float(), exists, camera.without_lens(zoom=zoom)


@cached_constant(maxsize=256)
def zoom_to_crop(camera: Camera) -> float:
    """Return the smallest zoom, 1 or above, for which the camera shows all that its rectified frame does.

    Found by bisection, from the border of the frame alone.

    Raises:
        ValueError: there is none up to 64.
    """
    numbers = camera.tensors(torch.empty(0, dtype=torch.float64, device="cpu"))
    border = border_points(camera.height, camera.width, [0.0], numbers[2])

    def is_shown(zoom: float) -> bool:
        flow, exists = rectification_flow(*numbers, border, model=camera.model, zoom=zoom)
        inside = [
            (axis + flow[:, i : i + 1] - (side - 1) / 2).abs() <= (side - 1) / 2 - MARGIN_PX
            for i, (axis, side) in enumerate(((border.x, camera.width), (border.y, camera.height)))
        ]
        return bool((exists & inside[0] & inside[1]).all())

    if is_shown(1.0) or camera.is_pinhole:
        return 1.0
    low, high = 1.0, 2.0
    while not is_shown(high):
        low, high = high, 2 * high
        if high > _LARGEST_ZOOM:
            raise ValueError(f"camera must show the rays around its axis, got {camera} that shows too few to crop to")
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if is_shown(middle) else (middle, high)
    return high


@dataclass(frozen=True)
class RectificationErrorModel:
    """Error bounds for the rectification of one camera, measured as those of a lens; see `ErrorModel`."""

    camera: Camera
    numbers: tuple[float, ...]  # coefficients, then focal lengths and center as the parameters hold them
    crops: bool = False

    is_random = False

    def bounds(self, height: int, width: int) -> FlowBounds | None:
        """Return measured bounds, or None if the camera does not show all rays around the frame.

        Raises:
            ValueError: frames with another ratio of the sides than those of the camera.
        """
        bounds = _measure(self.camera.resized(width=width, height=height))
        return with_zoom(bounds) if self.crops and bounds is not None else bounds

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification | None:
        """Keep all terms: the model is of one camera, and each of its terms counts."""
        return Simplification(0.0, why="cubic polynomials between nodes")

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: the parameters are those of the camera, up to rounding."""
        values = torch.cat([params.coefficients, params.focal, params.center], dim=1)
        numbers = as_device_tensor(self.numbers, dtype=values.dtype, device=values.device)
        return ((values - numbers).abs() <= _CLOSE * numbers.abs()).all()


@lru_cache(maxsize=64)
def _measure(camera: Camera) -> FlowBounds | None:
    for num_levels in (5, 3, 2, 1):
        lines = cell_lines(camera.height, camera.width, num_levels)
        points = torch.cat([lines, outermost_nodes(camera.height, camera.width, num_levels)])
        c, focal, center = camera.tensors(points)
        x, y = ((points[None, :, i] - center[:, i, None]) / focal[:, i, None] for i in range(2))
        reach = REACH * corner_radius(focal, center, camera.height, camera.width)
        x_d, y_d, exists = _project(c, x, y, camera.model, reach)
        if exists.all():
            x, y, x_d, y_d = (value[:, : len(lines)] for value in (x, y, x_d, y_d))
            flow = torch.stack([(x_d - x) * focal[:, 0, None], (y_d - y) * focal[:, 1, None]])
            return flow_bounds(flow, num_levels, torch.hypot(x_d, y_d) / torch.hypot(x, y).clamp(min=1e-9))
    return None


def _corner(focal: Tensor, center: Tensor, points: Points) -> Tensor:
    return corner_radius(focal.detach(), center.detach(), points.lattice.height, points.lattice.width)


def _on_plane(points: Points, focal: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y of the points on the plane z = 1, (B, h w)."""
    x, y = (axis.flatten(1) for axis in torch.broadcast_tensors(*lens.on_plane(points, focal, center)))
    return x, y


def _project(coefficients: Tensor, x: Tensor, y: Tensor, model: str, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distort points (B, N) on the plane z = 1 within a radius (B,), and tell which the camera shows."""
    radius = radius_within(coefficients, reach, model)
    return image_of(x, y, torch.ones_like(x), columns(coefficients, model), model, radius)


def _to_flow(
    u: Tensor, v: Tensor, exists: Tensor, x: Tensor, y: Tensor, focal: Tensor, points: Points
) -> tuple[Tensor, Tensor]:
    """Return f (u, v), (B, 2, h, w), and `exists`, of points (x, y) on the plane z = 1, all (B, h w)."""
    # Points without a ray are sent outward, farther than any frame: padded, never extrapolated.
    far = _FAR * max(points.lattice.height, points.lattice.width)
    with torch.no_grad():
        outward = far / (x * x + y * y).sqrt().clamp(min=1e-9)
    flow = torch.stack(
        [
            torch.where(exists, part * focal[:, i, None], (outward * axis).detach())
            for i, (part, axis) in enumerate(((u, x), (v, y)))
        ],
        dim=1,
    )
    size = torch.broadcast_shapes(points.x.shape, points.y.shape)[2:]
    return flow.unflatten(2, size), exists.view(-1, 1, *size)
