"""The fisheye model of Kannala and Brandt in OpenCV's form: a polynomial in the angle to the axis.

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

Source: Kannala, Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
lenses", IEEE PAMI 28 (2006), its symmetric part with the linear term as the focal length.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import MAX_RESIDUAL
from torchrefract.cameras.radial import first_root, growth, invert_radius, radial_factor
from torchrefract.warping.implicit import Slope, Solution, implicit

_AXIS = 1e-14  # squared sine of the angle to the axis below which a fisheye is computed as a pinhole


def fisheye_image(
    x: Tensor, y: Tensor, z: Tensor, k: Sequence[Tensor], max_angle: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Project rays through a fisheye.

        (x_d, y_d) = theta_d (x, y) / r,  theta = atan2(r, z),  r^2 = x^2 + y^2

    The rays (x, y, z), (B, N) each, may have any length. k are k1 ... k4, each (B, 1). `max_angle`, (B,), rad, is that
    of `fisheye_angle`. Returns x_d and y_d in focal lengths, 0 where the last result, valid, is False: beyond
    `max_angle`, or if the ray points straight back.
    """
    with torch.no_grad():
        r2 = x * x + y * y
        on_axis = r2 <= _AXIS * (r2 + z * z)
        valid = (torch.atan2(r2.sqrt(), z) <= max_angle[:, None]) & ~(on_axis & (z <= 0))
        off_axis = valid & ~on_axis
    # Operands are replaced before every root and division: the gradient of torch.where is NaN if a branch has NaN.
    x, y, z = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0), torch.where(valid, z, 1.0)
    r = torch.where(off_axis, x * x + y * y, 1.0).sqrt()
    scale = torch.where(off_axis, _distort_angle(torch.atan2(r, z), k) / r, 1 / torch.where(off_axis, 1.0, z))
    return scale * x, scale * y, valid


def fisheye_ray(
    x_d: Tensor, y_d: Tensor, k: Sequence[Tensor], max_angle: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Invert `fisheye_image`, with its arguments: return rays of unit length, three (B, N), and their validity."""
    with torch.no_grad():
        off_axis = x_d * x_d + y_d * y_d > _AXIS
    theta_d = torch.where(off_axis, x_d * x_d + y_d * y_d, 1.0).sqrt()
    target = torch.where(off_axis, theta_d, 0.0)
    with torch.no_grad():
        fixed = [value.detach() for value in k]
        theta = invert_radius(target.detach(), max_angle, fixed)
        residual = (_distort_angle(theta, fixed) - theta_d).abs()
        valid = ~off_axis | (residual <= MAX_RESIDUAL[theta.dtype] * (1 + theta_d))
    (theta,) = implicit((theta,), (target, *k), _angle_error)
    scale = torch.where(off_axis, theta.sin() / theta_d, 1.0)
    return (scale * x_d, scale * y_d, torch.where(off_axis, theta.cos(), 1 - (x_d * x_d + y_d * y_d) / 2)), valid


def fisheye_angle(k: Tensor) -> Tensor:
    """Return the angle (B,), float64, at most pi, up to which the polynomial of coefficients (B, 4) grows."""
    a = growth(k.detach().double().unbind(1))
    return first_root(torch.stack(a, dim=1)).sqrt().clamp(max=math.pi)


def _distort_angle(theta: Tensor, k: Sequence[Tensor]) -> Tensor:
    return theta * radial_factor(theta * theta, k)


def _angle_error(theta: Tensor, target: Tensor, *k: Tensor) -> tuple[Solution, Slope]:
    return (_distort_angle(theta, k) - target,), Slope(radial_factor(theta * theta, growth(k)))
