"""OpenCV's lens model: a ratio of polynomials, tangential and thin-prism terms, and a tilted sensor.

All functions take x and y, (B, N), and the coefficients as 14 tensors (B, 1) in the order of `OPENCV14`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import Jacobian, distort_by_factor
from torchrefract.cameras.radial import (
    first_root,
    growth_of_ratio,
    limit_of_curve,
    newton_radius,
    radial_factor,
    radial_factor_slope,
    reach_of,
)

OPENCV14 = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
OPENCV_COUNTS = (4, 5, 8, 12, 14)  # lengths that OpenCV accepts
_NEWTON_STEPS = 8  # in the plane; strong decentering needs more than the usual 5


def ratio(c: Sequence) -> tuple[tuple, tuple]:
    """Return the coefficients k1, k2, k3 of the numerator and k4, k5, k6 of the denominator."""
    return (c[0], c[1], c[4]), tuple(c[5:8])


def distort_opencv(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor, Jacobian]:
    """Distort points by OpenCV's model.

        g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
        x_l = x g + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_l = y g + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4
        (x_d, y_d) = (cos tau_x x_l, cos tau_y y_l - sin tau_x sin tau_y x_l) / w
        w = sin tau_y x_l - cos tau_y sin tau_x y_l + cos tau_y cos tau_x

    Args:
        x, y: (B, N), on the plane z = 1.
        c: the coefficients.

    Returns:
        x_d, y_d: (B, N), in focal lengths.
        jacobian: the derivatives of x_d and y_d with respect to x and y.

    Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction"; the tilt as in Louhichi, Fournel, Lavest, Ben
    Aissia, "Self-calibration of Scheimpflug cameras: an easy protocol", Measurement Science and Technology 18 (2007).
    """
    x, y, lens = _lens(x, y, c)
    x, y, tilt = _tilt(x, y, *c[12:])
    return x, y, tilt.after(lens)


def undistort_opencv(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], radius: Tensor) -> tuple[Tensor, Tensor]:
    """Invert `distort_opencv` by Newton's method, without gradient.

    Inverts the tilt in closed form, then the radial ratio by a table and Newton steps along the radius, then the
    whole lens by 8 Newton steps in the plane.

    Args:
        x_d, y_d: (B, N), in focal lengths.
        c: the coefficients.
        radius: (B,), up to which the ratio grows, see `opencv_radius`.

    Returns:
        x, y: (B, N), on the plane z = 1, finite. The caller must check that they distort back to (x_d, y_d).
    """
    with torch.no_grad():
        x_l, y_l = _invert_tilt(x_d, y_d, *c[12:])
        r_l = (x_l * x_l + y_l * y_l).sqrt()
        limit = limit_of_curve(radius, reach_of(r_l), lambda r: r * _ratio(r * r, c)[0])
        r = newton_radius(r_l, limit.inverse(r_l), limit, lambda r2: _ratio(r2, c))
        scale = r / r_l.clamp(min=torch.finfo(r.dtype).tiny)
        x, y = scale * x_l, scale * y_l
        for _ in range(_NEWTON_STEPS):
            back_x, back_y, jacobian = _lens(x, y, c)
            step_x, step_y = jacobian.solve(back_x - x_l, back_y - y_l)
            x, y = x - step_x, y - step_y
        return x.nan_to_num(0, 0, 0), y.nan_to_num(0, 0, 0)


def opencv_radius(c: Tensor) -> Tensor:
    """Return the radius (B,), float64, up to which the ratio of coefficients (B, 14) grows and has no pole."""
    numerator, denominator = ratio(c.detach().double().unbind(1))
    growth = first_root(torch.stack(growth_of_ratio(numerator, denominator), dim=1))
    pole = first_root(torch.stack(denominator, dim=1))
    return torch.minimum(growth, (1 - 1e-9) * pole).sqrt()  # just before the pole the ratio is finite


def hits_sensor_front(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> Tensor:
    """Return (B, N), bool: the ray of a point (x, y) meets the tilted sensor from its front."""
    return _depth(*_lens(x, y, c)[:2], *c[12:]) > 0


def _ratio(r2: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return g and dg/d(r^2)."""
    numerator, denominator = ratio(c)
    scale = 1 / radial_factor(r2, denominator)
    g = radial_factor(r2, numerator) * scale
    return g, (radial_factor_slope(r2, numerator) - g * radial_factor_slope(r2, denominator)) * scale


def _lens(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor, Jacobian]:
    """Distort points by all but the tilt."""
    r2 = x * x + y * y
    point, jacobian = distort_by_factor(x, y, r2, *_ratio(r2, c), c[2:4], c[8:12])
    return *point, jacobian


def _depth(x: Tensor, y: Tensor, tau_x: Tensor, tau_y: Tensor) -> Tensor:
    return tau_y.sin() * x - tau_y.cos() * tau_x.sin() * y + tau_y.cos() * tau_x.cos()


def _tilt(x: Tensor, y: Tensor, tau_x: Tensor, tau_y: Tensor) -> tuple[Tensor, Tensor, Jacobian]:
    w = 1 / _depth(x, y, tau_x, tau_y)
    x_d = tau_x.cos() * x * w
    y_d = (tau_y.cos() * y - tau_x.sin() * tau_y.sin() * x) * w
    return x_d, y_d, Jacobian(*(value * w for value in _tilt_matrix(x_d, y_d, tau_x, tau_y)))


def _invert_tilt(x_d: Tensor, y_d: Tensor, tau_x: Tensor, tau_y: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the tilt for (x_l, y_l), after multiplying by w and collecting x_l and y_l on one side."""
    scale = tau_y.cos() * tau_x.cos()
    return _tilt_matrix(x_d, y_d, tau_x, tau_y).solve(scale * x_d, scale * y_d)


def _tilt_matrix(x_d: Tensor, y_d: Tensor, tau_x: Tensor, tau_y: Tensor) -> Jacobian:
    right, down = tau_y.sin(), tau_y.cos() * tau_x.sin()
    return Jacobian(tau_x.cos() - x_d * right, x_d * down, -tau_x.sin() * right - y_d * right, tau_y.cos() + y_d * down)
