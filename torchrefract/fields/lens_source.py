"""Sets of real lenses to draw from: a list of cameras, or those near one camera."""

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
from torchrefract.fields.lens_error import LensRanges
from torchrefract.types import Range

_NAMES = (*POLYNOMIAL12, "focal", "aspect", "center_x", "center_y")
_STEP = 1e-3  # of a coefficient, to differentiate the nearest polynomial


class LensSource(NamedTuple):
    """Lenses of 16 numbers: 12 coefficients, then focal length, aspect and center as in `LensDistortion`.

    lenses: one is drawn, each with the same probability.
    spread: 16 rows of m numbers, which multiply m draws that are uniform in [-1, 1] and are added to the lens; empty
        for none.
    """

    lenses: tuple[tuple[float, ...], ...]
    spread: tuple[tuple[float, ...], ...] = ()

    @property
    def draw_ranges(self) -> list[Range]:
        """Return the ranges of the uniform numbers that `select` needs."""
        return [(0.0, 1.0), *[(-1.0, 1.0)] * (len(self.spread[0]) if self.spread else 0)]

    def select(self, draws: Tensor) -> Tensor:
        """Return (B, 16), the lenses of uniform draws (B, 1 + m) in `draw_ranges`."""
        # Integer arithmetic: the chosen lens must not depend on the rounding of a type.
        place = (draws[:, 0] * (1 << 24)).long() * len(self.lenses) >> 24
        lenses = torch.tensor(self.lenses, dtype=draws.dtype, device=draws.device)[place]
        if not self.spread:
            return lenses
        moved = draws[:, 1:, None] * torch.tensor(self.spread, dtype=draws.dtype, device=draws.device).mT
        # One order of summation for every batch size, so that draws keep their bits.
        return lenses + sum(moved.unbind(1))

    @property
    def boxes(self) -> tuple[LensRanges, ...]:
        """Return for each lens the ranges of its numbers."""
        reach = [sum(map(abs, row)) for row in self.spread] or [0.0] * 16
        spans = [[(n - r, n + r) for n, r in zip(lens, reach, strict=True)] for lens in self.lenses]
        return tuple(LensRanges(tuple(span[:-4]), *span[-4:]) for span in spans)

    @property
    def ranges(self) -> dict[str, Range]:
        """Return ranges that hold all lenses, by the argument names of `LensDistortion`."""
        columns = zip(*(box.numbers for box in self.boxes), strict=True)
        limits = [(min(low for low, _ in column), max(high for _, high in column)) for column in columns]
        return {f"{name}_range": limit for name, limit in zip(_NAMES, limits, strict=True)}


def lenses_from_cameras(table: Sequence[Camera] | None, *, residual_px: float) -> LensSource:
    """Convert cameras to lenses of the polynomial model.

    Args:
        table: at least one camera; None takes the lens database, without lenses that no polynomial comes near.
        residual_px: largest distance in px between a camera of another model and its polynomial.

    Raises:
        ValueError, TypeError: an empty table; as for `as_polynomial`.
    """
    residual_px = check_number("residual_px", residual_px, low=0.0)
    if table is None:
        near = [lens.polynomial for lens in read_lenses() if lens.residual_px <= residual_px]
        return LensSource(tuple(_numbers(camera) for camera in near if camera is not None))
    if not table:
        raise ValueError("table must hold at least one camera, got none")
    cameras = [as_polynomial(f"table[{i}]", camera, residual_px) for i, camera in enumerate(table)]
    return LensSource(tuple(map(_numbers, cameras)))


def ranges_around(camera: Camera, *, jitter: float, residual_px: float) -> dict[str, Range]:
    """Return the range of each number of cameras near one, by the argument names of `LensDistortion`.

    Args:
        camera, residual_px: as for `as_polynomial`.
        jitter: largest relative change of each number, in [0, 0.99].
    """
    jitter = check_number("jitter", jitter, low=0.0, high=0.99)
    lens = _numbers(as_polynomial("camera", camera, check_number("residual_px", residual_px, low=0.0)))
    return {f"{name}_range": (n - jitter * abs(n), n + jitter * abs(n)) for name, n in zip(_NAMES, lens, strict=True)}


def camera_with_covariance(camera: Camera, covariance: Any, *, residual_px: float) -> LensSource:
    """Vary the numbers of a camera together, by the covariance of its calibration.

        lens + sqrt(3) S u,  u uniform in [-1, 1], S S^T = J covariance J^T,  J = d lens / d camera

    Uniform numbers have a variance of 1 / 3.

    Args:
        camera, residual_px: as for `as_polynomial`.
        covariance: (4 + n, 4 + n) of fx, fy, cx, cy in px and the n coefficients of the camera, in its order.

    Raises:
        ValueError: another camera; a covariance of another shape, not finite, not symmetric, or not positive.
    """
    residual_px = check_number("residual_px", residual_px, low=0.0)
    lens = _numbers(as_polynomial("camera", camera, residual_px))
    size = 4 + len(camera.coefficients)
    matrix = np.array(covariance, dtype=float)
    if matrix.shape != (size, size):
        raise ValueError(
            f"covariance must have shape ({size}, {size}), of fx, fy, cx, cy and the coefficients, got {matrix.shape}"
        )
    if not np.isfinite(matrix).all():
        raise ValueError("covariance must be finite, got NaN or infinity")
    scale = np.sqrt(np.outer(matrix.diagonal().clip(0), matrix.diagonal().clip(0)))
    if (np.abs(matrix - matrix.T) > 1e-6 * scale).any():
        raise ValueError("covariance must be symmetric, got one that is not")
    jacobian = _jacobian(camera, is_fixed=matrix.diagonal() == 0)
    eigenvalues, vectors = np.linalg.eigh(jacobian @ ((matrix + matrix.T) / 2) @ jacobian.T)
    if eigenvalues.min() < -1e-6 * max(eigenvalues.max(), 0.0):
        raise ValueError(f"covariance must have no negative eigenvalue, got {eigenvalues.min():g}")
    spread = math.sqrt(3) * vectors * np.sqrt(eigenvalues.clip(0))
    return LensSource((lens,), tuple(tuple(row) for row in spread.tolist()))


def as_polynomial(name: str, camera: Camera, residual_px: float) -> Camera:
    """Convert a camera to the model "polynomial12".

    Raises:
        TypeError: not a camera.
        ValueError: no polynomial is within `residual_px`; the lens folds back, or has a pole, inside the frame.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"{name} must be a Camera, got {type(camera).__name__}")
    camera.check_pole(name)
    converted = convert(camera, to="polynomial12")
    if converted.covered < 1:
        raise ValueError(
            f"{name} must show rays within 80 degrees of its axis in its whole frame, without folding back, got "
            f"{camera.model} that does so in {converted.covered:.2%} of it"
        )
    # A mere change of order is off by rounding.
    if converted.max_px > max(residual_px, 1e-6):
        raise ValueError(
            f"{name} must be within residual_px = {residual_px:g} px of a polynomial, got {camera.model} that is "
            f"{converted.max_px:.3g} px off"
        )
    return converted.camera


def _numbers(camera: Camera) -> tuple[float, ...]:
    """Return the 16 numbers of a camera of the model "polynomial12"."""
    width, middle = camera.width, ((camera.width - 1) / 2, (camera.height - 1) / 2)
    center = (camera.cx - middle[0]) / width, (camera.cy - middle[1]) / width
    return (*camera.coefficients, camera.fx / width, camera.fy / camera.fx, *center)


def _jacobian(camera: Camera, *, is_fixed: np.ndarray) -> np.ndarray:
    """Return (16, 4 + n): derivatives of the 16 numbers with respect to fx, fy, cx, cy and the n coefficients.

    Those of coefficients are central differences of the nearest polynomial; columns of a mask (4 + n,) are zero.
    """
    jacobian = np.zeros((len(_NAMES), len(is_fixed)))
    jacobian[-4, 0], jacobian[-2, 2], jacobian[-1, 3] = (1 / camera.width,) * 3
    jacobian[-3, :2] = -camera.fy / camera.fx**2, 1 / camera.fx
    for i in np.flatnonzero(~is_fixed[4:]):
        ahead, before = (
            replace(camera, coefficients=tuple(c + step * (k == i) for k, c in enumerate(camera.coefficients)))
            for step in (_STEP, -_STEP)
        )
        ahead, before = (np.array(convert(one, to="polynomial12").camera.coefficients) for one in (ahead, before))
        jacobian[:-4, 4 + i] = (ahead - before) / (2 * _STEP)
    return jacobian
