"""Uncertainty of rectified pictures, from the covariance of a calibration."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract.cameras.calibration.fit import camera_values, with_values
from torchrefract.cameras.camera import Camera

MAX_DEVIATION_PX = 2.0  # above which `rectify` warns
_STEP = 1e-3  # standard deviations
_GRID = 65  # points along each side of the frame
_SIDES = np.linspace(1.0, 0.1, 91)  # of a crop, in sides of the frame


def rectified_deviation(camera: Camera, covariance: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Compute the standard deviation of where `rectify` shows pixels.

        u(p) = f undistort((p - c) / f) + c,  sqrt(trace(J covariance J^T)),  J = du / d(fx, fy, cx, cy, coefficients)

    J is a central difference along the axes of the covariance.

    Args:
        camera: of the frames.
        covariance: (4 + n, 4 + n), of fx, fy, cx, cy and the n coefficients.
        pixels: (N, 2), px, in frames of the camera.

    Returns:
        (N,), px; NaN where the rectified picture shows nothing.
    """
    values, axes = np.linalg.eigh(covariance)
    start, variance = camera_values(camera), np.zeros(len(pixels))
    is_shown = undistort_pixels(camera, pixels)[1]
    for axis in (axes * np.sqrt(values.clip(min=0))).T:
        if not axis.any():
            continue
        cameras = (with_values(camera, start + sign * _STEP * axis) for sign in (1, -1))
        (ahead, _), (before, _) = (undistort_pixels(one, pixels) for one in cameras)
        variance += (((ahead - before) / (2 * _STEP)) ** 2).sum(axis=1)
    return np.where(is_shown, np.sqrt(variance), np.nan)


def undistort_pixels(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) as the camera's pinhole shows them, and (N,), bool: it shows them."""
    rays, has_ray, _ = camera.unproject(torch.from_numpy(pixels))
    rectified, is_shown, _ = camera.without_lens().project(rays)
    return rectified.numpy(), (has_ray & is_shown).numpy()


class Crop(NamedTuple):
    """The middle part of a rectified frame, px."""

    left: int
    top: int
    width: int
    height: int

    def size(self, width: int, frame_width: int) -> tuple[int, int]:
        """Return the height and width of this part of a frame of a width; both are even, which videos need."""
        columns = 2 * round(self.width * width / frame_width / 2)
        return 2 * round(columns * self.height / self.width / 2), columns

    def of(self, image: Tensor, frame_width: int) -> Tensor:
        """Return this part of a frame (C, H, W) in any resolution, around its middle as `Camera.resized` has it."""
        height, width = self.size(image.shape[2], frame_width)
        top, left = (image.shape[1] - height) // 2, (image.shape[2] - width) // 2
        return image[:, top : top + height, left : left + width]


def certain_part(camera: Camera, covariance: np.ndarray, pinhole: Camera) -> tuple[float, Crop]:
    """Return the largest deviation over a rectified frame, px, and the largest part of its middle below 2 px.

    Args:
        camera, covariance: as for `rectified_deviation`.
        pinhole: of the rectified frame.
    """
    grid = pinhole.grid(_GRID)
    pixels, shown = (value.numpy() for value in camera.project(pinhole.unproject(grid).points)[:2])
    deviation = np.full(len(grid), np.nan)
    deviation[shown] = pinhole.fx / camera.fx * rectified_deviation(camera, covariance, pixels[shown])
    middle = (np.array([pinhole.width, pinhole.height]) - 1) / 2
    distance = (np.abs(grid.numpy() - middle) / middle).max(axis=1)
    is_vague = deviation > MAX_DEVIATION_PX
    side = next((side for side in _SIDES if not is_vague[distance <= side].any()), _SIDES[-1])
    # Video codecs need even sizes.
    width, height = (int(size * side) // 2 * 2 for size in (pinhole.width, pinhole.height))
    crop = Crop((pinhole.width - width) // 2, (pinhole.height - height) // 2, width, height)
    return float(np.nanmax(deviation, initial=0.0)), crop
