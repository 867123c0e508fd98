"""OpenCV's lens model: a ratio of polynomials, decentring, thin prisms and a tilted sensor.

All functions here take x and y, (B, N), and the coefficients apart, 14 tensors (B, 1) in OpenCV's order: k1, k2, p1,
p2, k3, k4, k5, k6, s1 ... s4, tau_x, tau_y.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.cameras.distortion import ALL_TERMS, bent, bent_slopes, newton_radius
from torchrefract.cameras.growth import first_root, growth_of_ratio
from torchrefract.cameras.radial import limit_of_curve, radial, radial_slope, reach_of
from torchrefract.warping.flow import Jacobian

OPENCV_COUNTS = (4, 5, 8, 12, 14)
_STEPS = 8  # of Newton's method in the plane; a lens that is far from round needs more than the 5 of most


def distort_opencv(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor, Jacobian]:
    """The point that OpenCV's model maps (x, y) to, and the derivatives there.

        g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
        x_l = x g + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y_l = y g + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4
        (x_d, y_d) = (cos tau_x x_l, cos tau_y y_l - sin tau_x sin tau_y x_l) / w
        w = sin tau_y x_l - cos tau_y sin tau_x y_l + cos tau_y cos tau_x

    Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction"; the tilt as in Louhichi, Fournel, Lavest, Ben
    Aissia, "Self-calibration of Scheimpflug cameras: an easy protocol", Measurement Science and Technology 18 (2007).
    """
    x, y, lens = _lens(x, y, c)
    x, y, tilt = _tilt(x, y, c[12], c[13])
    return x, y, tilt.after(lens)


def undistort_opencv(x_d: Tensor, y_d: Tensor, c: Sequence[Tensor], radius: Tensor) -> tuple[Tensor, Tensor]:
    """The point that `distort_opencv` maps to (x_d, y_d), if there is one; without gradient.

    The tilt is taken back in closed form. A table gives the inverse of the radial part to 1e-6; from there go 3 Newton
    steps (in float32 2) along the radius and 8 in the plane.

    Args:
        x_d, y_d: (B, N), on the plane z = 1.
        c: the coefficients.
        radius: (B,), up to which the ratio grows, see `opencv_radius`.

    Returns:
        x, y: (B, N), finite; whether they are the point that was asked for is for the caller to check.
    """
    with torch.no_grad():
        x_l, y_l = _untilted(x_d, y_d, c[12], c[13])
        r_l = (x_l * x_l + y_l * y_l).sqrt()
        limit = limit_of_curve(radius, reach_of(r_l), lambda r: r * _ratio(r * r, c)[0])
        r = newton_radius(r_l, limit.sample_image(r_l), limit, lambda r2: _ratio(r2, c))
        scale = r / r_l.clamp(min=torch.finfo(r.dtype).tiny)
        x, y = scale * x_l, scale * y_l
        for _ in range(_STEPS):
            reached_x, reached_y, jacobian = _lens(x, y, c)
            step_x, step_y = jacobian.solve(reached_x - x_l, reached_y - y_l)
            x, y = x - step_x, y - step_y
        return x.nan_to_num(0, 0, 0), y.nan_to_num(0, 0, 0)


def opencv_radius(c: Tensor) -> Tensor:
    """(B,), float64, of coefficients (B, 14): the radius up to which the ratio grows and has no pole."""
    c = c.detach().double()
    above, below = c[:, (0, 1, 4)], c[:, 5:8]
    grows = first_root(torch.stack(growth_of_ratio(above.unbind(1), below.unbind(1)), dim=1))
    # Just before the pole the ratio is still a number.
    return torch.minimum(grows, (1 - 1e-9) * first_root(below)).sqrt()


def in_front(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> Tensor:
    """(B, N), bool: the tilted sensor is met from its front by the ray to a point (x, y) that the lens has placed."""
    return _depth(*_lens(x, y, c)[:2], c[12], c[13]) > 0


def _ratio(r2: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """g and its derivative with respect to r^2."""
    k, below = (c[0], c[1], c[4]), tuple(c[5:8])
    denominator = 1 / radial(r2, below, 3)
    g = radial(r2, k, 3) * denominator
    return g, (radial_slope(r2, k, 3) - g * radial_slope(r2, below, 3)) * denominator


def _lens(x: Tensor, y: Tensor, c: Sequence[Tensor]) -> tuple[Tensor, Tensor, Jacobian]:
    """The point before the tilt."""
    r2 = x * x + y * y
    g, slope = _ratio(r2, c)
    others = (c[2], c[3], *c[8:12])
    (x_l, y_l), g = bent(x, y, r2, g, others, ALL_TERMS)
    return x_l, y_l, bent_slopes(x, y, r2, g, slope, others, ALL_TERMS)


def _depth(x: Tensor, y: Tensor, tau_x: Tensor, tau_y: Tensor) -> Tensor:
    return tau_y.sin() * x - tau_y.cos() * tau_x.sin() * y + tau_y.cos() * tau_x.cos()


def _tilt(x: Tensor, y: Tensor, tau_x: Tensor, tau_y: Tensor) -> tuple[Tensor, Tensor, Jacobian]:
    w = 1 / _depth(x, y, tau_x, tau_y)
    x_d = tau_x.cos() * x * w
    y_d = (tau_y.cos() * y - tau_x.sin() * tau_y.sin() * x) * w
    rows = _tilt_rows(x_d, y_d, tau_x, tau_y)
    return x_d, y_d, Jacobian(*(value * w for value in rows))


def _untilted(x_d: Tensor, y_d: Tensor, tau_x: Tensor, tau_y: Tensor) -> tuple[Tensor, Tensor]:
    """The tilt taken back: of (cos tau_x x, ...) = w (x_d, y_d) what has x or y is brought to the left."""
    scale = tau_y.cos() * tau_x.cos()
    return _tilt_rows(x_d, y_d, tau_x, tau_y).solve(scale * x_d, scale * y_d)


def _tilt_rows(x_d: Tensor, y_d: Tensor, tau_x: Tensor, tau_y: Tensor) -> Jacobian:
    right, down = tau_y.sin(), tau_y.cos() * tau_x.sin()
    return Jacobian(tau_x.cos() - x_d * right, x_d * down, -tau_x.sin() * right - y_d * right, tau_y.cos() + y_d * down)
