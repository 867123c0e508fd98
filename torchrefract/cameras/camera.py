"""A camera: a pinhole behind a lens."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_choice, check_count, check_number, check_positive, check_tensor
from torchrefract.cameras.growth import falls_before, first_root, growth_of_powers, growth_of_ratio
from torchrefract.cameras.projection import PointResult, distort, project, undistort, unproject, valid_radius
from torchrefract.cameras.sheet import MODELS

# Along each side of the frame, where it is asked how much of it a model covers.
_PLACES = 129
DIRECTIONS = ("horizontal", "vertical")


@dataclass(frozen=True, kw_only=True)
class Camera:
    """What a calibration finds: a pinhole, and the distortion of its lens.

        x = (u - cx) / fx,  y = (v - cy) / fy on the plane z = 1,  pixel centers being whole numbers

    width, height: px, of the frames it was calibrated with.
    fx, fy: focal lengths, px.
    cx, cy: principal point, px.
    coefficients: of the model: "polynomial12" is k1 ... k6, p1, p2, s1 ... s4 of the extended Brown-Conrady polynomial;
        "opencv" is OpenCV's vector k1, k2, p1, p2, k3, k4, k5, k6, s1 ... s4, tau_x, tau_y, of 4, 5, 8, 12 or 14;
        "fisheye" is k1 ... k4 of OpenCV's fisheye, a polynomial in the angle to the axis (Kannala and Brandt);
        "division" is the one k of Fitzgibbon's division model.
    model: which of the four; the same numbers mean another lens in another one.

    Points go through it by `distort`, `undistort`, `project` and `unproject`, each (N, n) or (B, N, n); the functions
    of the same names in `torchrefract.cameras.projection` take a batch of cameras, with gradients.

    Raises:
        ValueError: numbers that are no camera; coefficients by which the lens shows less than one pixel. Real fits fold
            back before the corners of their frames: that is no error here, see `coverage` and `check_covers`.
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
        lengths = MODELS[self.model]
        if len(numbers) not in lengths:
            raise ValueError(
                f"coefficients must be {' or '.join(map(str, lengths))} numbers for the model {self.model}, "
                f"got {len(numbers)}"
            )
        if any(numbers):
            self._check_growth()

    @staticmethod
    def from_opencv(matrix: Any, coefficients: Any, *, width: int, height: int) -> "Camera":
        """The camera of `cv2.calibrateCamera`: its matrix, (3, 3), and its coefficients, in any nesting."""
        rows = [[float(value) for value in row] for row in matrix]
        if [len(row) for row in rows] != [3, 3, 3]:
            raise ValueError(f"matrix must be 3 x 3, got {len(rows)} rows of {[len(row) for row in rows]}")
        (fx, skew, cx), (_, fy, cy), _ = rows
        if skew != 0:
            raise ValueError(f"matrix must have no skew, got {skew:g}")
        return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(_flat(coefficients)))

    def resized(self, *, width: int, height: int) -> "Camera":
        """The camera of the same frames, reduced or enlarged to another size.

            fx' = s fx,  cx' = (W' - 1) / 2 + s (cx - (W - 1) / 2),  s = W' / W,  likewise fy and cy with the same s

        Raises:
            ValueError: a size of another ratio of the sides.
        """
        ratio = self.height / self.width
        # A frame of one pixel, and one row more or less, have no ratio to speak of.
        if abs(height - width * ratio) > max(1.0, ratio):
            raise ValueError(
                f"image must have the shape of the camera's frames, {self.width} x {self.height} px, got "
                f"{width} x {height}"
            )
        scale = width / self.width
        focal = {"fx": self.fx * scale, "fy": self.fy * scale}
        # The middle of the frame stays the middle, also where a row more or less was rounded away.
        middle = {"cx": (self.width - 1) / 2, "cy": (self.height - 1) / 2}
        center = {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
        moved = {name: center[name] + (getattr(self, name) - middle[name]) * scale for name in center}
        return replace(self, width=width, height=height, **focal, **moved)

    def cropped(self, *, left: int, top: int, width: int, height: int) -> "Camera":
        """The camera of the same frames, cut to the part of a size whose first pixel is (left, top).

            cx' = cx - left,  cy' = cy - top

        Raises:
            ValueError: a part that is not inside the frame.
        """
        for name, start, size, most in (("left", left, width, self.width), ("top", top, height, self.height)):
            check_count(name, start, low=0)
            check_count("width" if name == "left" else "height", size)
            if start + size > most:
                raise ValueError(f"{name} must leave {size} of the frame's {most} px, got {start}")
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def flipped(self, direction: str) -> "Camera":
        """The camera of the same frames mirrored, left to right ("horizontal") or top to bottom ("vertical").

        cx' = W - 1 - cx, and what a lens has that is not even in x changes its sign: p2, s1, s2, tau_y; likewise cy,
        p1, s3, s4 and tau_x
        """
        across = check_choice("direction", direction, DIRECTIONS) == "horizontal"
        odd: dict[str, tuple[int, ...]] = {"polynomial12": (7, 8, 9), "opencv": (3, 8, 9, 13)}
        if not across:
            odd = {"polynomial12": (6, 10, 11), "opencv": (2, 10, 11, 12)}
        signs = odd.get(self.model, ())
        coefficients = tuple(-value if i in signs else value for i, value in enumerate(self.coefficients))
        moved = {"cx": self.width - 1 - self.cx} if across else {"cy": self.height - 1 - self.cy}
        return replace(self, coefficients=coefficients, **moved)

    @property
    def matrix(self) -> tuple[tuple[float, float, float], ...]:
        """The matrix of the pinhole, 3 x 3, as OpenCV has it."""
        return (self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)

    @property
    def valid_radius(self) -> float:
        """The radius of `points.valid_radius`, on the plane z = 1 before distortion; of a fisheye its angle, rad."""
        return valid_radius(torch.tensor([self.coefficients], dtype=torch.float64), model=self.model).item()

    def places(self, count: int) -> Tensor:
        """(count^2, 2), px, float64: a lattice over the frame, from border to border."""
        u, v = (torch.linspace(0, size - 1, count, dtype=torch.float64) for size in (self.width, self.height))
        return torch.cartesian_prod(u, v)

    def coverage(self) -> float:
        """The share of the frame that has rays, counted at 129 x 129 places from border to border."""
        return self.unproject(self.places(_PLACES)).valid.double().mean().item()

    def check_pole(self, name: str = "camera") -> None:
        """Raise, under a name, where OpenCV's denominator is zero or below at a ray of the pinhole's frame.

        No lens does that; a fit to few corners does.
        """
        if self.model != "opencv" or not any(self.coefficients[5:8]):
            return
        sides = ((self.cx, self.width, self.fx), (self.cy, self.height, self.fy))
        corner = math.hypot(*(max(abs(center), abs(size - 1 - center)) / focal for center, size, focal in sides))
        pole = first_root(torch.tensor([self.coefficients[5:8]], dtype=torch.float64)).sqrt().item()
        if pole <= corner:
            raise ValueError(
                f"{name} must keep its denominator 1 + k4 r^2 + k5 r^4 + k6 r^6 above zero inside the frame, up to "
                f"r = {corner:.4g} focal lengths, got zero at r = {pole:.4g}"
            )

    def check_covers(self) -> None:
        """Raise unless every place of the frame that `coverage` looks at has a ray, and for `check_pole`."""
        self.check_pole()
        share = self.coverage()
        if share < 1:
            raise ValueError(
                f"camera must not fold back inside its frame, got {self.model} with rays for {share:.2%} of it "
                f"(one-to-one up to {self.valid_radius:.4g})"
            )

    def tensors(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients (1, n), focal lengths (1, 2) and principal point (1, 2), px, of a tensor's type and device."""
        numbers = (self.coefficients, (self.fx, self.fy), (self.cx, self.cy))
        coefficients, focal, center = (as_device_tensor([row], dtype=like.dtype, device=like.device) for row in numbers)
        return coefficients, focal, center

    def distort(self, points: Tensor) -> PointResult:
        """Points (N, 2) or (B, N, 2) of the plane z = 1 by `points.distort`."""
        return self._through("points", points, lambda p, c, **_: distort(p, c, model=self.model))

    def undistort(self, points: Tensor) -> PointResult:
        """Points (N, 2) or (B, N, 2), in focal lengths, by `points.undistort`."""
        return self._through("points", points, lambda p, c, **_: undistort(p, c, model=self.model))

    def project(self, points: Tensor) -> PointResult:
        """Points in space (N, 3) or (B, N, 3) by `points.project`: the pixels that show them, in the frame or not."""
        return self._through("points", points, lambda p, c, **pinhole: project(p, c, model=self.model, **pinhole))

    def unproject(self, pixels: Tensor) -> PointResult:
        """Pixels (N, 2) or (B, N, 2) by `points.unproject`: the rays of unit length that they show."""
        return self._through("pixels", pixels, lambda p, c, **pinhole: unproject(p, c, model=self.model, **pinhole))

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens moves nothing; that of a fisheye always does."""
        return self.model != "fisheye" and not any(self.coefficients)

    @property
    def is_polynomial(self) -> bool:
        """Whether `polynomial` has an answer: "polynomial12", or "opencv" without denominator and tilt."""
        if self.model == "opencv":
            return not any(self.coefficients[5:8]) and not any(self.coefficients[12:])
        return self.model == "polynomial12"

    def polynomial(self) -> tuple[float, ...]:
        """The coefficients as those of "polynomial12".

        Raises:
            ValueError: OpenCV's denominator (k4, k5, k6) or tilt (tau_x, tau_y), which no polynomial has; a fisheye, a
                division model.
        """
        if self.model == "polynomial12":
            return self.coefficients
        if self.model != "opencv":
            raise ValueError(
                f"model must be polynomial12, or opencv without denominator and tilt (convert(camera, "
                f'to="polynomial12") finds the nearest polynomial), got {self.model}'
            )
        if not self.is_polynomial:
            raise ValueError(
                "coefficients must have k4, k5, k6, tau_x and tau_y of zero: OpenCV's denominator and tilt are no "
                f'polynomial (convert(camera, to="polynomial12") finds the nearest), got {self.coefficients}'
            )
        k1, k2, p1, p2, k3, *others = (*self.coefficients, *(0.0,) * (14 - len(self.coefficients)))
        return (k1, k2, k3, 0.0, 0.0, 0.0, p1, p2, *others[3:7])

    def _through(self, name: str, points: Tensor, function: Callable[..., PointResult]) -> PointResult:
        if check_tensor(name, points).ndim not in (2, 3):
            raise ValueError(f"{name} must have shape (N, n) or (B, N, n), got {tuple(points.shape)}")
        batch = points if points.ndim == 3 else points[None]
        coefficients, focal, center = (value.expand(len(batch), -1) for value in self.tensors(points))
        found = function(batch, coefficients, focal=focal, center=center)
        return found if points.ndim == 3 else PointResult(*(value[0] for value in found))

    def _check_growth(self) -> None:
        """Raise for a lens that shows less than a pixel; by plain numbers, so that compilers can follow."""
        c = self.coefficients
        if self.model == "opencv":
            growths = [growth_of_ratio((*c[:2], *c[4:5]), c[5:8]), c[5:8]]
        elif self.model == "division":
            growths = [c, [-value for value in c]]
        else:
            growths = [growth_of_powers(c[:6] if self.model == "polynomial12" else c)]
        if any(falls_before(growth, 1 / min(self.fx, self.fy) ** 2) for growth in growths):
            raise ValueError(f"coefficients must leave at least one pixel that does not fold back, got {c}")


def _flat(values: Any) -> Sequence[float]:
    """The numbers of an array or of nested lists, in order."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, int | float):
        return [float(values)]
    return [number for value in values for number in _flat(value)]
