"""A camera: a pinhole behind a lens."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_choice, check_count, check_number, check_positive, check_tensor
from torchrefract.cameras import projection
from torchrefract.cameras.brown_conrady import POLYNOMIAL12
from torchrefract.cameras.projection import COEFFICIENTS, MODELS, PointResult
from torchrefract.cameras.radial import falls_before, first_root, growth
from torchrefract.cameras.rational import RationalLens

_GRID = 129  # points along each side of the frame at which `coverage` looks for a ray
UNKNOWN_FOCAL = 0.9  # widths of the frame, of the pinhole that stands in for an unknown camera
DIRECTIONS = ("horizontal", "vertical")
# Coefficients whose term is odd in x, or in y: they change their sign in a mirrored frame.
_ODD = {"horizontal": ("p2", "s1", "s2", "tau_y"), "vertical": ("p1", "s3", "s4", "tau_x")}


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A calibrated camera: a pinhole and the distortion of its lens.

        x = (u - cx) / fx,  y = (v - cy) / fy on the plane z = 1; pixel centers are whole numbers

    `distort`, `undistort`, `project` and `unproject` take points (N, n) or (B, N, n). The functions of the same names
    in `torchrefract.cameras` take a batch of cameras, with gradients.

    Args:
        width, height: px, of the frames that the camera was calibrated with.
        fx, fy: focal lengths, px.
        cx, cy: principal point, px.
        coefficients: of the model, in its order:
            "polynomial12": k1 ... k6, p1, p2, s1 ... s4 of the extended Brown-Conrady polynomial;
            "opencv": k1, k2, p1, p2, k3, k4, k5, k6, s1 ... s4, tau_x, tau_y of OpenCV, of which 4, 5, 8, 12 or 14;
            "fisheye": k1 ... k4 of OpenCV's fisheye, a polynomial in the angle to the axis (Kannala and Brandt);
            "division": k of Fitzgibbon's division model.
        model: one of the four. The same numbers describe different lenses in different models.

    Raises:
        ValueError: an argument is out of range, or the lens folds back within the first pixel. Many calibrations fold
            back before the corners of the frame; those are accepted, see `coverage` and `check_covers`.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...]
    model: str = "opencv"

    def __post_init__(self) -> None:
        check_count("width", self.width)
        check_count("height", self.height)
        for name in ("fx", "fy"):
            object.__setattr__(self, name, check_positive(name, getattr(self, name)))
        for name in ("cx", "cy"):
            object.__setattr__(self, name, check_number(name, getattr(self, name)))
        check_choice("model", self.model, tuple(MODELS))
        numbers = tuple(check_number("coefficients", float(value)) for value in self.coefficients)
        object.__setattr__(self, "coefficients", numbers)
        counts = MODELS[self.model]
        if len(numbers) not in counts:
            raise ValueError(
                f"coefficients must be {' or '.join(map(str, counts))} numbers for the model {self.model}, "
                f"got {len(numbers)}"
            )
        if any(numbers):
            self._check_growth()

    @staticmethod
    def from_opencv(matrix: Any, coefficients: Any, *, width: int, height: int) -> "Camera":
        """Create a camera of frames of width x height px from the results of `cv2.calibrateCamera`.

        Args:
            matrix: (3, 3), an array or nested lists.
            coefficients: 4, 5, 8, 12 or 14 numbers, an array of any shape or nested lists; 4 are k1, k2, p1, p2. The 4
                of `cv2.fisheye.calibrate` describe another lens: use `Camera(..., model="fisheye")`.

        Raises:
            ValueError: the matrix is not 3 x 3 or has skew; see also `Camera`.
        """
        rows, numbers = np.asarray(matrix, dtype=float), np.asarray(coefficients, dtype=float).ravel()
        if rows.shape != (3, 3):
            raise ValueError(f"matrix must be 3 x 3, got {rows.shape}")
        (fx, skew, cx), (_, fy, cy), _ = rows.tolist()
        if skew != 0:
            raise ValueError(f"matrix must have no skew, got {skew:g}")
        return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(numbers.tolist()))

    @property
    def matrix(self) -> tuple[tuple[float, float, float], ...]:
        """Return the matrix of the pinhole, 3 x 3, as OpenCV has it."""
        return (self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)

    @property
    def valid_radius(self) -> float:
        """Return the radius on the plane z = 1 up to which the lens is one-to-one; the angle in rad for a fisheye."""
        return projection.valid_radius(
            torch.tensor([self.coefficients], dtype=torch.float64, device="cpu"), model=self.model
        ).item()

    @property
    def is_pinhole(self) -> bool:
        """Return True if the lens does not distort; a fisheye always does."""
        return self.model != "fisheye" and not any(self.coefficients)

    @property
    def is_polynomial(self) -> bool:
        """Return True for "polynomial12", and for "opencv" without denominator and tilt."""
        if self.model == "opencv":
            return not any(self.coefficients[5:8]) and not any(self.coefficients[12:])
        return self.model == "polynomial12"

    def polynomial(self) -> tuple[float, ...]:
        """Return the coefficients in the order of "polynomial12".

        Raises:
            ValueError: `is_polynomial` is False.
        """
        if not self.is_polynomial:
            raise ValueError(
                "model must be polynomial12, or opencv without denominator and tilt: k4, k5, k6, tau_x and tau_y of "
                'zero (convert(camera, to="polynomial12") finds the nearest polynomial), got '
                f"{self.model} with {self.coefficients}"
            )
        if self.model == "polynomial12":
            return self.coefficients
        values = dict(zip(COEFFICIENTS["opencv"], self.coefficients, strict=False))
        return tuple(0.0 if name in ("k4", "k5", "k6") else values.get(name, 0.0) for name in POLYNOMIAL12)

    def distort(self, points: Tensor) -> PointResult:
        """Distort points (N, 2) or (B, N, 2) of the plane z = 1, see `projection.distort`."""
        return self._apply(projection.distort, points)

    def undistort(self, points: Tensor) -> PointResult:
        """Undistort points (N, 2) or (B, N, 2) in focal lengths, see `projection.undistort`."""
        return self._apply(projection.undistort, points)

    def project(self, points: Tensor) -> PointResult:
        """Project points in space (N, 3) or (B, N, 3) to pixels, see `projection.project`."""
        return self._apply(projection.project, points, has_pinhole=True)

    def unproject(self, pixels: Tensor) -> PointResult:
        """Return the rays of unit length of pixels (N, 2) or (B, N, 2), see `projection.unproject`."""
        return self._apply(projection.unproject, pixels, name="pixels", has_pinhole=True)

    def tensors(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return coefficients (1, n), focal lengths (1, 2) and center (1, 2), px, with dtype and device of `like`."""
        numbers = (self.coefficients, (self.fx, self.fy), (self.cx, self.cy))
        coefficients, focal, center = (as_device_tensor([row], dtype=like.dtype, device=like.device) for row in numbers)
        return coefficients, focal, center

    def grid(self, count: int) -> Tensor:
        """Return pixels (count^2, 2), float64, on a regular grid over the frame, from border to border."""
        u, v = (
            torch.linspace(0, size - 1, count, dtype=torch.float64, device="cpu") for size in (self.width, self.height)
        )
        return torch.cartesian_prod(u, v)

    def resized(self, *, width: int, height: int) -> "Camera":
        """Return the camera of the same frames in another resolution.

            fx' = s fx,  cx' = (W' - 1) / 2 + s (cx - (W - 1) / 2),  s = W' / W,  likewise fy and cy with the same s

        Raises:
            ValueError: the aspect ratio differs by more than rounding.
        """
        aspect = self.height / self.width
        # Rounding to whole pixels may add or remove one row.
        if abs(height - width * aspect) > max(1.0, aspect):
            raise ValueError(
                f"image must have the shape of the camera's frames, {self.width} x {self.height} px, got "
                f"{width} x {height}"
            )
        scale = width / self.width
        # The middle of the frame stays the middle, so that a rounded row does not shift the principal point.
        cx = (width - 1) / 2 + (self.cx - (self.width - 1) / 2) * scale
        cy = (height - 1) / 2 + (self.cy - (self.height - 1) / 2) * scale
        return replace(self, width=width, height=height, fx=self.fx * scale, fy=self.fy * scale, cx=cx, cy=cy)

    def cropped(self, *, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of a part of the same frames whose first pixel is (left, top).

            cx' = cx - left,  cy' = cy - top

        Raises:
            ValueError: the part is not inside the frame.
        """
        for name, start, size, limit in (("left", left, width, self.width), ("top", top, height, self.height)):
            check_count(name, start, low=0)
            check_count("width" if name == "left" else "height", size)
            if start + size > limit:
                raise ValueError(f"{name} must leave {size} of the frame's {limit} px, got {start}")
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def without_lens(self, *, zoom: float = 1.0) -> "Camera":
        """Return the pinhole of rectified frames of the same size, with both focal lengths times `zoom`."""
        return replace(self, model="opencv", coefficients=(0.0,) * 4, fx=zoom * self.fx, fy=zoom * self.fy)

    def flipped(self, direction: str) -> "Camera":
        """Return the camera of the same frames mirrored left to right ("horizontal") or top to bottom ("vertical").

        cx' = W - 1 - cx, and the coefficients of terms that are odd in x change their sign; likewise cy.

        Raises:
            ValueError: another direction.
        """
        odd = _ODD[check_choice("direction", direction, DIRECTIONS)]
        pairs = zip(COEFFICIENTS[self.model], self.coefficients, strict=False)
        coefficients = tuple(-value if name in odd else value for name, value in pairs)
        center = {"cx": self.width - 1 - self.cx} if direction == "horizontal" else {"cy": self.height - 1 - self.cy}
        return replace(self, coefficients=coefficients, **center)

    def coverage(self) -> float:
        """Return the share of the frame that has rays, counted at 129 x 129 points from border to border."""
        return self.unproject(self.grid(_GRID)).valid.double().mean().item()

    def check_covers(self) -> None:
        """Raise ValueError if a part of the frame has no ray (see `coverage`), or for `check_pole`."""
        self.check_pole()
        share = self.coverage()
        if share < 1:
            raise ValueError(
                f"camera must not fold back inside its frame, got {self.model} with rays for {share:.2%} of it "
                f"(one-to-one up to {self.valid_radius:.4g})"
            )

    def check_pole(self, name: str = "camera") -> None:
        """Raise ValueError if OpenCV's denominator reaches zero inside the frame; `name` is the argument to blame.

        No real lens does that, but a calibration with corners in the middle of the frame only may.
        """
        if self.model != "opencv" or not any(self.coefficients[5:8]):
            return
        sides = ((self.cx, self.width, self.fx), (self.cy, self.height, self.fy))
        corner = math.hypot(*(max(abs(center), abs(size - 1 - center)) / focal for center, size, focal in sides))
        pole = first_root(torch.tensor([self.coefficients[5:8]], dtype=torch.float64, device="cpu")).sqrt().item()
        if pole <= corner:
            raise ValueError(
                f"{name} must keep its denominator 1 + k4 r^2 + k5 r^4 + k6 r^6 above zero inside the frame, up to "
                f"r = {corner:.4g} focal lengths, got zero at r = {pole:.4g}"
            )

    def _apply(
        self, function: Callable[..., PointResult], points: Tensor, *, name: str = "points", has_pinhole: bool = False
    ) -> PointResult:
        if check_tensor(name, points).ndim not in (2, 3):
            raise ValueError(f"{name} must have shape (N, n) or (B, N, n), got {tuple(points.shape)}")
        batch = points if points.ndim == 3 else points[None]
        coefficients, focal, center = (value.expand(len(batch), -1) for value in self.tensors(points))
        pinhole = {"focal": focal, "center": center} if has_pinhole else {}
        result = function(batch, coefficients, model=self.model, **pinhole)
        return result if points.ndim == 3 else PointResult(*(value[0] for value in result))

    def _check_growth(self) -> None:
        """Raise ValueError if the lens folds back within a pixel; with Python numbers, so that compilers can trace."""
        c = self.coefficients
        if self.model == "division":
            growths = [c, [-value for value in c]]
        elif self.model == "fisheye":
            growths = [growth(c)]
        else:
            lens = RationalLens.of((*c, *(0.0,) * 4) if self.model == "opencv" else c, self.model)
            growths = [growth(lens.numerator, lens.denominator), lens.denominator]
        focal = min(self.fx, self.fy)
        if any(falls_before(a, 1 / focal / focal) for a in growths):  # a square could overflow
            raise ValueError(f"coefficients must leave at least one pixel that does not fold back, got {c}")


class Pinhole(NamedTuple):
    """A pinhole for frames of one size."""

    focal: tuple[float, float]  # px, fx and fy
    center: tuple[float, float]  # px, principal point


def pinhole_of(camera: Camera | None, *, height: int, width: int, focal: float = UNKNOWN_FOCAL) -> Pinhole:
    """Return the pinhole of a camera for frames of a size; None is a centered one with a focal length in widths."""
    if camera is None:
        return Pinhole((focal * width, focal * width), ((width - 1) / 2, (height - 1) / 2))
    camera = camera.resized(width=width, height=height)
    return Pinhole((camera.fx, camera.fy), (camera.cx, camera.cy))


def check_camera(camera: Camera | None) -> Camera | None:
    """Return `camera` if it is a camera or None.

    Raises:
        TypeError: otherwise.
    """
    if camera is not None and not isinstance(camera, Camera):
        raise TypeError(f"camera must be a Camera, got {type(camera).__name__}")
    return camera
