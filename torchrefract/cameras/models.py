"""A camera that has been calibrated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torchrefract._checks import check_choice, check_count, check_number, check_positive

MODELS = ("polynomial12", "opencv")
_OPENCV_LENGTHS = (4, 5, 8, 12, 14)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """What a calibration finds: a pinhole, and the distortion of its lens.

        x = (u - cx) / fx,  y = (v - cy) / fy on the plane z = 1,  pixel centers being whole numbers

    width, height: px, of the frames it was calibrated with.
    fx, fy: focal lengths, px.
    cx, cy: principal point, px.
    coefficients: of the model: "polynomial12" is k1 ... k6, p1, p2, s1 ... s4 of the extended Brown-Conrady polynomial;
        "opencv" is OpenCV's vector k1, k2, p1, p2, k3, k4, k5, k6, s1 ... s4, tau_x, tau_y, of 4, 5, 8, 12 or 14.
    model: which of the two; the same numbers mean another lens in the other one.
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
        check_choice("model", self.model, MODELS)
        numbers = tuple(check_number("coefficients", float(value)) for value in self.coefficients)
        object.__setattr__(self, "coefficients", numbers)
        lengths = (12,) if self.model == "polynomial12" else _OPENCV_LENGTHS
        if len(numbers) not in lengths:
            raise ValueError(
                f"coefficients must be {' or '.join(map(str, lengths))} numbers for the model {self.model}, "
                f"got {len(numbers)}"
            )

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

    def polynomial(self) -> tuple[float, ...]:
        """The coefficients as those of "polynomial12".

        Raises:
            ValueError: OpenCV's denominator (k4, k5, k6) or tilt (tau_x, tau_y), which no polynomial has.
        """
        if self.model == "polynomial12":
            return self.coefficients
        k1, k2, p1, p2, k3, *others = (*self.coefficients, *(0.0,) * (14 - len(self.coefficients)))
        denominator, prism, tilt = others[:3], others[3:7], others[7:]
        if any(denominator) or any(tilt):
            raise ValueError(
                "coefficients must have k4, k5, k6, tau_x and tau_y of zero: OpenCV's denominator and tilt are no "
                f"polynomial, got {self.coefficients}"
            )
        return (k1, k2, k3, 0.0, 0.0, 0.0, p1, p2, *prism)


def _flat(values: Any) -> Sequence[float]:
    """The numbers of an array or of nested lists, in order."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, int | float):
        return [float(values)]
    return [number for value in values for number in _flat(value)]
