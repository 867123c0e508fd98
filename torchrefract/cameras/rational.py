"""OpenCV's lens model: a ratio of polynomials, tangential and thin-prism terms, and a tilted sensor.

The Brown-Conrady polynomial is its special case without denominator and tilt. All functions take x and y, (B, N).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import MAX_RESIDUAL, Jacobian, Point, converge, distort_by_factor
from torchrefract.cameras.radial import RADIAL, first_root, growth, invert_radius

OPENCV14 = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
OPENCV_COUNTS = (4, 5, 8, 12, 14)  # lengths that OpenCV accepts


class RationalLens(NamedTuple):
    """Coefficients, numbers or tensors (B, 1), by their terms; all but the numerator may be empty."""

    numerator: Sequence[Any]
    denominator: Sequence[Any]
    p: Sequence[Any]
    s: Sequence[Any]
    tilt: Sequence[Any]  # tau_x, tau_y, rad

    @staticmethod
    def of(c: Sequence[Any], model: str) -> "RationalLens":
        """Group the coefficients of "polynomial12", or the 14 of "opencv"."""
        if model == "polynomial12":
            n = len(RADIAL)
            return RationalLens(c[:n], (), c[n : n + 2], c[n + 2 :], ())
        return RationalLens((c[0], c[1], c[4]), c[5:8], c[2:4], c[8:12], c[12:])

    def distort(self, x: Tensor, y: Tensor) -> tuple[Point, Jacobian]:
        """Distort points of the plane z = 1, to focal lengths, with the derivatives.

            g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
            x_l = x g + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
            y_l = y g + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4
            (x_d, y_d) = (cos tau_x x_l, cos tau_y y_l - sin tau_x sin tau_y x_l) / w
            w = sin tau_y x_l - cos tau_y sin tau_x y_l + cos tau_y cos tau_x

        Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction"; the tilt as in Louhichi, Fournel, Lavest,
        Ben Aissia, "Self-calibration of Scheimpflug cameras: an easy protocol", Measurement Science and Technology 18
        (2007).
        """
        (x, y), jacobian = self._distort_before_tilt(x, y)
        if not self.tilt:
            return (x, y), jacobian
        w = 1 / self._depth(x, y)
        tau_x, tau_y = self.tilt
        x_d = tau_x.cos() * x * w
        y_d = (tau_y.cos() * y - tau_x.sin() * tau_y.sin() * x) * w
        tilt = Jacobian(*(value * w for value in self._tilt_matrix(x_d, y_d)))
        return (x_d, y_d), tilt.after(jacobian)

    def undistort(self, x_d: Tensor, y_d: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Invert `distort` up to a radius (B,) by Newton's method, without gradient.

        Inverts the tilt in closed form, then the radial ratio by a table and Newton steps along the radius, then the
        whole lens by Newton steps in the plane.

        Returns:
            x, y: (B, N), on the plane z = 1, finite everywhere.
            exists: (B, N), bool: the point distorts back to (x_d, y_d) and `is_before_fold`.
        """
        with torch.no_grad():
            x_l, y_l = x_d, y_d
            if self.tilt:  # multiplied by w, it is linear in x_l and y_l
                scale = self.tilt[1].cos() * self.tilt[0].cos()
                x_l, y_l = self._tilt_matrix(x_d, y_d).solve(scale * x_d, scale * y_d)
            r_l = (x_l * x_l + y_l * y_l).sqrt()
            r = invert_radius(r_l, radius, self.numerator, self.denominator)
            scale = r / r_l.clamp(min=torch.finfo(r.dtype).tiny)
            solved = converge((scale * x_l, scale * y_l), (x_l, y_l), self._distort_before_tilt)
            x, y = (value.nan_to_num(0, 0, 0) for value in solved)
            back_x, back_y = self.distort(x, y)[0]
            residual = torch.maximum((back_x - x_d).abs(), (back_y - y_d).abs())
            limit = MAX_RESIDUAL[x.dtype] * (1 + (x_d * x_d + y_d * y_d).sqrt())
            return x, y, self.is_before_fold(x, y, radius) & (residual <= limit)

    def is_before_fold(self, x: Tensor, y: Tensor, radius: Tensor) -> Tensor:
        """Return (B, N), bool: the lens shows the point (x, y) not folded back, and on the front of a tilted sensor."""
        valid = x * x + y * y <= radius[:, None].square()
        if self.tilt:
            valid = valid & (self._depth(*self._distort_before_tilt(x, y)[0]) > 0)
        return valid & (self.distort(x, y)[1].determinant > 0)

    def radius(self) -> Tensor:
        """Return (B,), float64, the radius up to which the ratio grows and has no pole."""
        numerator, denominator = ([value.double() for value in k] for k in (self.numerator, self.denominator))
        q = first_root(torch.cat(growth(numerator, denominator), dim=1))
        if denominator:
            # Just before the pole the ratio is finite.
            q = torch.minimum(q, (1 - 1e-9) * first_root(torch.cat(denominator, dim=1)))
        return q.sqrt()

    def _distort_before_tilt(self, x: Tensor, y: Tensor) -> tuple[Point, Jacobian]:
        return distort_by_factor(x, y, k=self.numerator, denominator=self.denominator, p=self.p, s=self.s)

    def _depth(self, x: Tensor, y: Tensor) -> Tensor:
        tau_x, tau_y = self.tilt
        return tau_y.sin() * x - tau_y.cos() * tau_x.sin() * y + tau_y.cos() * tau_x.cos()

    def _tilt_matrix(self, x_d: Tensor, y_d: Tensor) -> Jacobian:
        tau_x, tau_y = self.tilt
        right, down = tau_y.sin(), tau_y.cos() * tau_x.sin()
        xx, yy = tau_x.cos() - x_d * right, tau_y.cos() + y_d * down
        return Jacobian(xx, x_d * down, -tau_x.sin() * right - y_d * right, yy)
