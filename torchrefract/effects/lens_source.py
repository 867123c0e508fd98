"""Where lenses are drawn from that are no ranges, one for each number: a list of real ones, or a covariance."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import check_number
from torchrefract.cameras.brown_conrady import POLYNOMIAL12
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.conversion import convert
from torchrefract.cameras.lens_database import read_lenses
from torchrefract.effects.plan import lies_in_one
from torchrefract.fields.lens_bounds import LensRanges, lens_numbers
from torchrefract.types import Range

_NAMES = (*POLYNOMIAL12, "focal", "aspect", "center_x", "center_y")
# An opencv vector has them in this order: k1, k2, p1, p2, k3, then k4 ... k6 of its denominator, then the prism.
_OPENCV_PLACES = {0: 0, 1: 1, 2: 6, 3: 7, 4: 2, 8: 8, 9: 9, 10: 10, 11: 11}


class LensSource(NamedTuple):
    """Lenses of 16 numbers: 12 coefficients, then as `LensDistortion` has them focal length, aspect and center.

    rows: the lenses, one of which is drawn, each as often as another.
    spread: 16 rows of m numbers, by which m numbers uniform in [-1, 1] move a lens; no rows for none.
    """

    rows: tuple[tuple[float, ...], ...]
    spread: tuple[tuple[float, ...], ...] = ()

    @property
    def inputs(self) -> list[Range]:
        """The ranges of what has to be drawn uniformly."""
        return [(0.0, 1.0), *[(-1.0, 1.0)] * (len(self.spread[0]) if self.spread else 0)]

    def lenses(self, inputs: Tensor) -> Tensor:
        """(B, 16), from what was drawn, (B, 1 + m)."""
        # Whole numbers: which lens it is must not depend on how a type rounds.
        place = (inputs[:, 0] * (1 << 24)).long() * len(self.rows) >> 24
        options: Any = {"dtype": inputs.dtype, "device": inputs.device}
        lenses = torch.tensor(self.rows, **options)[place]
        if not self.spread:
            return lenses
        # Sums in one order for every batch size.
        moved = inputs[:, 1:, None] * torch.tensor(self.spread, **options).mT
        return lenses + sum(moved.unbind(1))

    @property
    def boxes(self) -> tuple[LensRanges, ...]:
        """For each row what its numbers lie in."""
        reach = [sum(map(abs, row)) for row in self.spread] or [0.0] * 16
        return tuple(LensRanges.of([(n - r, n + r) for n, r in zip(row, reach, strict=True)]) for row in self.rows)

    @property
    def ranges(self) -> dict[str, Range]:
        """What all lenses lie in, by the arguments of `LensDistortion`."""
        columns = zip(*(box.numbers for box in self.boxes), strict=True)
        limits = [(min(low for low, _ in column), max(high for _, high in column)) for column in columns]
        return {f"{name}_range": limit for name, limit in zip(_NAMES, limits, strict=True)}

    def params_in_range(self, coefficients: Tensor, focal: Tensor, center: Tensor) -> Tensor:
        """(), bool: each of B lenses lies in one of the boxes, but for rounding."""
        return lies_in_one(lens_numbers(coefficients, focal, center), [box.numbers for box in self.boxes])


def listed(table: Sequence[Camera] | None, *, residual_px: float) -> LensSource:
    """The lenses of cameras, each as a polynomial.

    Args:
        table: one or more; None is the table of the package, without the lenses that no polynomial comes near to.
        residual_px: how far a polynomial may be from a camera of another model, px.

    Raises:
        TypeError: something that is no camera.
        ValueError: no camera; one that is too far from a polynomial, or folds back inside its frame.
    """
    residual_px = check_number("residual_px", residual_px, low=0.0)
    if table is None:
        near = [lens.polynomial for lens in read_lenses() if lens.residual_px <= residual_px]
        return LensSource(tuple(_numbers(camera) for camera in near if camera is not None))
    if not table:
        raise ValueError("table must hold a camera at least, got none")
    cameras = [polynomial_of(f"table[{i}]", camera, residual_px) for i, camera in enumerate(table)]
    return LensSource(tuple(map(_numbers, cameras)))


def jittered(camera: Camera, *, jitter: float, residual_px: float) -> LensSource:
    """A camera as a polynomial, each of its numbers up to so large a share of itself off, by itself.

    Args:
        camera: of any model.
        jitter: in [0, 1).
        residual_px: as for `listed`.
    """
    jitter = check_number("jitter", jitter, low=0.0, high=0.99)
    row = _numbers(polynomial_of("camera", camera, check_number("residual_px", residual_px, low=0.0)))
    return LensSource((row,), tuple(tuple(jitter * abs(n) * (i == j) for j in range(16)) for i, n in enumerate(row)))


def correlated(camera: Camera, covariance: Any) -> LensSource:
    """A camera whose numbers are off together, as a calibration that is not sure of them says.

        lens + sqrt(3) S u,  u uniform in [-1, 1], S S^T = covariance: uniform numbers have a variance of 1 / 3

    Args:
        camera: "polynomial12", or "opencv" without denominator and tilt.
        covariance: (4 + n, 4 + n) of fx, fy, cx, cy in px and the n coefficients of the camera, in its order.

    Raises:
        ValueError: something else.
    """
    polynomial = polynomial_of("camera", replace(camera, coefficients=camera.polynomial(), model="polynomial12"), 0.0)
    size = 4 + len(camera.coefficients)
    given = np.array(covariance, dtype=float)
    if given.shape != (size, size):
        raise ValueError(
            f"covariance must have shape ({size}, {size}), of fx, fy, cx, cy and the coefficients, got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise ValueError("covariance must be finite, got NaN or infinity")
    scale = np.sqrt(np.outer(given.diagonal().clip(0), given.diagonal().clip(0)))
    if (np.abs(given - given.T) > 1e-6 * scale).any():
        raise ValueError("covariance must be symmetric, got one that is not")
    slopes = _slopes(camera, size)
    eigenvalues, vectors = np.linalg.eigh(slopes @ ((given + given.T) / 2) @ slopes.T)
    if eigenvalues.min() < -1e-6 * max(eigenvalues.max(), 0.0):
        raise ValueError(f"covariance must have no negative eigenvalue, got {eigenvalues.min():g}")
    spread = math.sqrt(3) * vectors * np.sqrt(eigenvalues.clip(0))
    return LensSource((_numbers(polynomial),), tuple(tuple(row) for row in spread.tolist()))


def cameras_of(
    applied: Tensor, coefficients: Tensor, focal: Tensor, center: Tensor, *, height: int, width: int
) -> list[Camera]:
    """The cameras of lenses (B,), (B, 12), (B, 2) and (B, 2), px; pinholes where the gate is closed."""
    found = []
    for acts, own, (fx, fy), (cx, cy) in zip(
        *(v.tolist() for v in (applied, coefficients, focal, center)), strict=True
    ):
        numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "coefficients": tuple(own) if acts else (0.0,) * len(own)}
        found.append(Camera(width=width, height=height, **numbers, model="polynomial12"))
    return found


def polynomial_of(name: str, camera: Camera, residual_px: float) -> Camera:
    """A camera as one of the model "polynomial12" that covers its frame.

    Raises:
        TypeError: no camera.
        ValueError: none is so near; the lens folds back, or has a pole, inside the frame.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"{name} must be a Camera, got {type(camera).__name__}")
    camera.check_pole(name)
    made = convert(camera, to="polynomial12")
    if made.covered < 1:
        raise ValueError(
            f"{name} must show rays within 80 degrees of its axis in its whole frame, without folding back, got "
            f"{camera.model} that does in {made.covered:.2%} of it"
        )
    # What is only put in another order is off by rounding.
    if made.max_px > max(residual_px, 1e-6):
        raise ValueError(
            f"{name} must be within residual_px = {residual_px:g} px of a polynomial, got {camera.model} that is "
            f"{made.max_px:.3g} px off"
        )
    return made.camera


def _numbers(camera: Camera) -> tuple[float, ...]:
    """The 16 of a camera of the model "polynomial12"."""
    width, middle = camera.width, ((camera.width - 1) / 2, (camera.height - 1) / 2)
    center = (camera.cx - middle[0]) / width, (camera.cy - middle[1]) / width
    return (*camera.coefficients, camera.fx / width, camera.fy / camera.fx, *center)


def _slopes(camera: Camera, size: int) -> np.ndarray:
    """(16, size): the derivatives of the 16 numbers with respect to fx, fy, cx, cy and the camera's coefficients."""
    slopes = np.zeros((16, size))
    slopes[12, 0], slopes[14, 2], slopes[15, 3] = (1 / camera.width,) * 3
    slopes[13, :2] = -camera.fy / camera.fx**2, 1 / camera.fx
    for i in range(size - 4):
        place = i if camera.model == "polynomial12" else _OPENCV_PLACES.get(i)
        if place is not None:
            slopes[place, 4 + i] = 1.0
    return slopes
