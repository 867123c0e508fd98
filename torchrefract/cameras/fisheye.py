"""The fisheye model of Kannala and Brandt in OpenCV's form: a polynomial in the angle to the axis."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.radial import (
    first_root,
    growth_of_polynomial,
    limit_of_curve,
    newton_radius,
    radial_factor,
    radial_factor_slope,
    reach_of,
)

_AXIS = 1e-14  # squared sine of the angle to the axis below which a fisheye is computed as a pinhole
_RESIDUALS = {torch.float32: 2e-6, torch.float64: 1e-12}  # of a solved angle, relative to 1 + theta_d


def fisheye_image(
    x: Tensor, y: Tensor, z: Tensor, k: Sequence[Tensor], max_angle: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Project rays through a fisheye.

        (x_d, y_d) = theta_d (x, y) / r,  theta = atan2(r, z),  r^2 = x^2 + y^2

    Args:
        x, y, z: (B, N), rays of any length.
        k: k1 ... k4, each (B, 1).
        max_angle: (B,), rad, up to which theta_d grows, see `fisheye_angle`.

    Returns:
        x_d, y_d: (B, N), in focal lengths; 0 where `valid` is false.
        valid: (B, N), bool: the angle of the ray is at most `max_angle`, and the ray does not point straight back.
    """
    with torch.no_grad():
        r2 = x * x + y * y
        on_axis = r2 <= _AXIS * (r2 + z * z)
        valid = (torch.atan2(r2.sqrt(), z) <= max_angle[:, None]) & ~(on_axis & (z <= 0))
        off_axis = valid & ~on_axis
    # Operands are replaced before every root and division: the gradient of torch.where is NaN if a branch has NaN.
    x, y, z = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0), torch.where(valid, z, 1.0)
    r = torch.where(off_axis, x * x + y * y, 1.0).sqrt()
    scale = torch.where(off_axis, distort_angle(torch.atan2(r, z), k) / r, 1 / torch.where(off_axis, 1.0, z))
    return scale * x, scale * y, valid


def fisheye_ray(
    x_d: Tensor, y_d: Tensor, k: Sequence[Tensor], max_angle: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return the rays of unit length that a fisheye shows, the inverse of `fisheye_image`.

    Args:
        x_d, y_d: (B, N), in focal lengths.
        k: k1 ... k4, each (B, 1).
        max_angle: (B,), rad, up to which theta_d grows.

    Returns:
        ray: x, y and z, each (B, N).
        valid: (B, N), bool.
    """
    with torch.no_grad():
        off_axis = x_d * x_d + y_d * y_d > _AXIS
    theta_d = torch.where(off_axis, x_d * x_d + y_d * y_d, 1.0).sqrt()
    theta = undistort_angle(torch.where(off_axis, theta_d, 0.0), k, max_angle)
    with torch.no_grad():
        residual = (distort_angle(theta, k) - theta_d).abs()
        valid = ~off_axis | (residual <= _RESIDUALS[theta.dtype] * (1 + theta_d))
    scale = torch.where(off_axis, theta.sin() / theta_d, 1.0)
    return (scale * x_d, scale * y_d, torch.where(off_axis, theta.cos(), 1.0)), valid


def distort_angle(theta: Tensor, k: Sequence[Tensor]) -> Tensor:
    """Distort angles to the axis; the result is the radius in the image, in focal lengths.

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    Args:
        theta: (B, N), rad, in [0, pi].
        k: k1 ... k4, each (B, 1).

    Source: Kannala, Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
    lenses", IEEE PAMI 28 (2006), its symmetric part with the linear term as the focal length.
    """
    return theta * radial_factor(theta * theta, k)


def undistort_angle(theta_d: Tensor, k: Sequence[Tensor], max_angle: Tensor) -> Tensor:
    """Invert `distort_angle` by a table and Newton's method, with the gradient of the exact inverse.

    Args:
        theta_d: (B, N), >= 0.
        k: k1 ... k4, each (B, 1).
        max_angle: (B,), rad, up to which theta_d grows.
    """
    with torch.no_grad():
        fixed = tuple(value.detach() for value in k)
        limit = limit_of_curve(max_angle, reach_of(theta_d), lambda theta: distort_angle(theta, fixed))

        def factor_and_slope(q: Tensor) -> tuple[Tensor, Tensor]:
            return radial_factor(q, fixed), radial_factor_slope(q, fixed)

        theta = newton_radius(theta_d, limit.inverse(theta_d), limit, factor_and_slope)
        q = theta * theta
        g, slope = factor_and_slope(q)
        growth = (g + 2 * q * slope).clamp(min=torch.finfo(q.dtype).eps)
    error = distort_angle(theta, k) - theta_d
    return theta - (error - error.detach()) / growth


def fisheye_angle(k: Tensor) -> Tensor:
    """Return the angle (B,), float64, at most pi, up to which the polynomial of coefficients (B, 4) grows."""
    growth = growth_of_polynomial(k.detach().double().unbind(1))
    return first_root(torch.stack(growth, dim=1)).sqrt().clamp(max=math.pi)
