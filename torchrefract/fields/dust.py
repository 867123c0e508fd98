"""Dust and ground fog, whose density falls with the height above the road, and dust that vehicles raise."""

import math

import torch
from torch import Tensor

_LEVEL = 1e-4  # heights of descent over scale height below which a ray counts as level
_FARTHEST = 1e12  # m; as for the transmission
_NEAREST = 1e-6  # m
_FARTHEST_VEHICLE = 1000.0  # m
_SHORTEST_WAYS = 5.0  # lengths of a wake, from the camera to the vehicle


def mean_density(distance: Tensor, descent: Tensor, scale_height: Tensor, *, camera_height: float | Tensor) -> Tensor:
    """Return the mean along rays of the density exp(-h / H), relative to that on the road.

        exp(-c) (exp(x) - 1) / x,  c = camera_height / H,  x = min(descent d / H, c)

    The height h of a point falls linearly along its ray, from the camera to the end of the ray or to the road, so the
    integral of the density is exact.

    Args:
        distance: d in m, along the rays, at least 0, may be inf.
        descent: m that a ray descends per m, negative above the horizon; broadcasts with the distance.
        scale_height: H in m, above 0; broadcasts with the distance.
        camera_height: m, above the road.

    Returns:
        In (0, 1], of the broadcast shape.
    """
    c = camera_height / scale_height
    x = torch.minimum(descent * distance.clamp(max=_FARTHEST) / scale_height, c)
    is_level, is_steep = x.abs() < _LEVEL, x > 1
    safe = torch.where(is_level | is_steep, 1.0, x)
    flat = torch.exp(-c) * torch.where(is_level, 1 + x / 2, torch.expm1(safe) / safe)
    steep = torch.where(is_steep, x, 1.0)  # exp(x) may overflow where exp(x - c) does not
    return torch.where(is_steep, ((steep - c).exp() - torch.exp(-c)) / steep, flat)


def mean_wake_density(
    depth: Tensor,
    boxes: Tensor,
    *,
    width: int,
    horizon: float,
    focal: float,
    center: float,
    camera_height: float,
    length: float,
) -> Tensor:
    """Return the mean along rays of the density of dust behind vehicles that drive ahead, their sum.

        exp(-2 ((x - x_v) / w)^2) exp(-h / H) exp(-(Z_v - Z) / l) at the depth Z < Z_v, 0 beyond;  l = min(L, Z_v / 5)

    A vehicle stands where the ray of the lower edge of its box meets the road, at Z_v and at most 1000 m away. Its box
    has the center x_v and the width w, px, and is H m high at Z_v. Along a ray x is constant, and h and Z are linear.
    So the integral is exact: that of `mean_density` with a descent of descent / H + 1 / l scale heights per m of depth.
    Within l the width in m hardly changes with Z; dust at the camera, which would be as narrow as the box, is left out.

    Args:
        depth: Z in m, (N or 1, 1, H, 1 or W), at least 0, may be inf.
        boxes: (N, V, 4), x1, y1, x2, y2, px from the center of the first pixel; one without an area raises no dust.
        width: px, of the frame.
        horizon, focal, center: as for `descent_of_rows`.
        camera_height: m, above the road.
        length: L in m.

    Returns:
        (N, 1, H, W), relative to the density on the road at a vehicle.
    """
    view = {"horizon": horizon, "height": depth.shape[2], "focal": focal, "center": center}
    depth = depth.clamp(min=_NEAREST, max=_FARTHEST)
    x = torch.arange(width, dtype=depth.dtype, device=depth.device)
    descent = descent_of_rows(**view, dtype=depth.dtype, device=depth.device)
    total = depth.new_zeros(len(boxes), 1, depth.shape[2], width)
    for box in boxes.unbind(1):
        x1, y1, x2, y2 = box.view(-1, 4, 1, 1, 1).unbind(1)
        is_vehicle = (x2 > x1) & (y2 > y1)
        place = camera_height / descent_at(y2, **view).clamp(min=camera_height / _FARTHEST_VEHICLE)
        high = torch.where(is_vehicle, place * (descent_at(y2, **view) - descent_at(y1, **view)), 1.0)
        across = torch.exp(-2 * ((x - (x1 + x2) / 2) / torch.where(is_vehicle, x2 - x1, 1.0)).square()) * is_vehicle
        steep = 1 / (place / _SHORTEST_WAYS).clamp(max=length)
        # Scale heights per m of depth, and of the camera above the dust on the road at the vehicle.
        steepness, above = descent / high + steep, camera_height / high + place * steep
        end = torch.minimum(depth, place)
        density = mean_density(end, steepness, torch.ones_like(above), camera_height=above)
        total = total + across * density * (end / depth)
    return total


def descent_at(y: Tensor, *, horizon: float, height: int, focal: float, center: float) -> Tensor:
    """Return by how many m the rays of rows y descend per m of depth; arguments as for `descent_of_rows`."""
    y_h = horizon * height - 0.5
    return (y - y_h) / math.hypot(focal, center - y_h)


def descent_of_rows(
    horizon: float, *, height: int, focal: float, center: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Return by how many m the ray of each row descends per m of depth, (1, 1, H, 1).

        cos(theta) (y - y_h) / f,  y_h = horizon H - 1/2,  tan(theta) = (c_y - y_h) / f

    Args:
        horizon: 0 at the top edge of the frame and 1 at its bottom edge.
        height: px.
        focal, center: px, f and c_y of the camera.
        dtype, device: of the result.
    """
    rows = torch.arange(height, dtype=torch.float64, device=device).view(1, 1, height, 1)
    return descent_at(rows, horizon=horizon, height=height, focal=focal, center=center).to(dtype)
