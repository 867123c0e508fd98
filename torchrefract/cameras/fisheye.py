"""The fisheye model of Kannala and Brandt, in OpenCV's form: a polynomial in the angle to the axis."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import newton_radius
from torchrefract.cameras.growth import first_root, growth_of_powers
from torchrefract.cameras.radial import limit_of_curve, radial, radial_slope, reach_of

# Of the squared sine of the angle to the axis: so near to it a fisheye is a pinhole.
_CENTER = 1e-14
_MISSES = {torch.float32: 2e-6, torch.float64: 1e-12}  # of a solved angle, relative to 1 + theta_d


def fisheye_image(x: Tensor, y: Tensor, z: Tensor, k: Sequence[Tensor], most: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where a fisheye shows rays.

        (x_d, y_d) = theta_d (x, y) / r,  theta = atan2(r, z),  r^2 = x^2 + y^2

    Args:
        x, y, z: (B, N), of any length.
        k: 4 of (B, 1).
        most: (B,), rad, the angle up to which the polynomial grows, see `fisheye_angle`.

    Returns:
        x_d, y_d: (B, N), in focal lengths from the center; the center where there is no place.
        seen: (B, N), bool: the polynomial still grows at the ray's angle.
    """
    with torch.no_grad():
        r2 = x * x + y * y
        axis = r2 <= _CENTER * (r2 + z * z)
        seen = _angle(r2.sqrt(), z) <= most[:, None]
        seen = seen & ~(axis & (z <= 0))
        off = seen & ~axis
    x, y, z = (torch.where(seen, a, b) for a, b in ((x, 0.0), (y, 0.0), (z, 1.0)))
    r = torch.where(off, x * x + y * y, 1.0).sqrt()
    scale = torch.where(off, distort_angle(_angle(r, z), k) / r, 1 / torch.where(off, 1.0, z))
    return scale * x, scale * y, seen


def fisheye_ray(
    x_d: Tensor, y_d: Tensor, k: Sequence[Tensor], most: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """The rays of unit length that a fisheye shows at places, the inverse of `fisheye_image`, and which there are.

    Args:
        x_d, y_d: (B, N), in focal lengths from the center.
        k: 4 of (B, 1).
        most: as for `fisheye_image`.
    """
    with torch.no_grad():
        off = x_d * x_d + y_d * y_d > _CENTER
        still = [value.detach() for value in k]
    theta_d = torch.where(off, x_d * x_d + y_d * y_d, 1.0).sqrt()
    theta = undistort_angle(torch.where(off, theta_d, 0.0), k, most)
    with torch.no_grad():
        missed = (distort_angle(theta, still) - theta_d).abs()
        seen = ~off | (missed <= _MISSES[theta.dtype] * (1 + theta_d))
    scale = torch.where(off, theta.sin() / theta_d, 1.0)
    return (scale * x_d, scale * y_d, torch.where(off, theta.cos(), 1.0)), seen


def _angle(r: Tensor, z: Tensor) -> Tensor:
    """atan2(r, z), r >= 0, but for rays of no length; torch.atan2 rounds by where in a row a number stands."""
    steep = r > z
    ratio = torch.where(steep, z, r) / torch.where(steep, r, torch.where(z > 0, z, 1.0))
    return torch.where(steep, math.pi / 2 - ratio.atan(), ratio.atan())


def distort_angle(theta: Tensor, k: Sequence[Tensor]) -> Tensor:
    """The angle after distortion, which is the radius in the image in focal lengths.

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    Args:
        theta: (B, N), rad, in [0, pi].
        k: 4 of (B, 1).

    Source: Kannala, Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
    lenses", IEEE PAMI 28 (2006), its symmetric part with the linear term as the focal length.
    """
    return theta * radial(theta * theta, tuple(k), 4)


def undistort_angle(theta_d: Tensor, k: Sequence[Tensor], most: Tensor) -> Tensor:
    """The angle that `distort_angle` maps to theta_d, by a table and Newton steps, with the exact gradient.

    Args:
        theta_d: (B, N), >= 0.
        k: 4 of (B, 1).
        most: (B,), rad, the angle up to which the polynomial grows, see `fisheye_angle`.
    """
    with torch.no_grad():
        still = tuple(value.detach() for value in k)
        limit = limit_of_curve(most, reach_of(theta_d), lambda theta: distort_angle(theta, still))
        start = limit.sample_image(theta_d)
        theta = newton_radius(theta_d, start, limit, lambda q: (radial(q, still, 4), radial_slope(q, still, 4)))
        q = theta * theta
        growth = (radial(q, still, 4) + 2 * q * radial_slope(q, still, 4)).clamp(min=torch.finfo(q.dtype).eps)
    error = distort_angle(theta, k) - theta_d
    return theta - (error - error.detach()) / growth


def fisheye_angle(k: Tensor) -> Tensor:
    """(B,), float64, of coefficients (B, 4): the angle up to which the polynomial grows, pi at most."""
    k = k.detach().double()
    root = first_root(torch.stack(growth_of_powers(k.unbind(1)), dim=1))
    return root.sqrt().clamp(max=math.pi)
