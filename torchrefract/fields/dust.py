"""Dust and ground fog, whose density falls with the height above the road."""

import math

import torch
from torch import Tensor

_LEVEL = 1e-4  # heights of descent over scale height below which a ray counts as level
_FARTHEST = 1e12  # m; as for the transmission


def mean_density(distance: Tensor, descent: Tensor, scale_height: Tensor, *, camera_height: float) -> Tensor:
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
    y_h = horizon * height - 0.5
    rows = torch.arange(height, dtype=torch.float64, device=device)
    return ((rows - y_h) / math.hypot(focal, center - y_h)).to(dtype).view(1, 1, height, 1)
