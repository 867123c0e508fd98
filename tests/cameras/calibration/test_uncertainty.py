from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefract.cameras.calibration.uncertainty import Crop, certain_part, rectified_deviation
from torchrefract.cameras.camera import Camera

CAMERA = Camera(width=800, height=600, fx=700.0, fy=702.0, cx=405.0, cy=297.0, coefficients=(-0.2, 0.06, 0.002, -0.001))
PINHOLE = replace(CAMERA, coefficients=(0.0,) * 4)
DEVIATIONS = np.array([2.0, 2.0, 3.0, 3.0, 0.01, 0.02, 1e-3, 1e-3])


def covariance(scale: float = 1.0) -> np.ndarray:
    """Return a covariance in which fx and k1, and k1 and k2, are correlated."""
    correlation = np.eye(8)
    correlation[0, 4] = correlation[4, 0] = 0.4
    correlation[4, 5] = correlation[5, 4] = -0.8
    return correlation * np.outer(DEVIATIONS, DEVIATIONS) * scale**2


def test_the_deviation_is_that_of_cameras_drawn_from_the_covariance():
    pixels = np.array([[0.0, 0.0], [799.0, 0.0], [400.0, 599.0], [405.0, 297.0], [650.0, 420.0]])
    values = np.array([700.0, 702.0, 405.0, 297.0, *CAMERA.coefficients])
    draws, generator = [], np.random.default_rng(0)
    for fx, fy, cx, cy, *lens in generator.multivariate_normal(values, covariance(0.1), size=4000):
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
        points = cv2.undistortPoints(pixels[:, None], matrix, np.array(lens), P=matrix, criteria=stop)
        draws.append(points.reshape(-1, 2))
    expected = np.sqrt(np.var(draws, axis=0).sum(axis=1))
    np.testing.assert_allclose(rectified_deviation(CAMERA, covariance(0.1), pixels), expected, rtol=0.05, atol=1e-4)


def test_a_pinhole_without_uncertain_coefficients_is_certain():
    certain = np.diag([4.0, 4.0, 9.0, 9.0, 0, 0, 0, 0])
    assert rectified_deviation(PINHOLE, certain, np.array([[0.0, 0.0]])) == pytest.approx(0, abs=1e-6)


def test_the_certain_part_is_below_two_pixels_and_even():
    deviation, crop = certain_part(CAMERA, covariance(), PINHOLE)
    assert deviation > 2
    assert crop.width % 2 == crop.height % 2 == 0
    assert 0 < crop.width < 800
    assert crop.left == (800 - crop.width) // 2
    largest, part = certain_part(CAMERA, covariance(1e-3), PINHOLE)
    assert (largest < 2, part) == (True, Crop(0, 0, 800, 600))
    assert crop.of(torch.zeros(3, 300, 400), 800).shape[1:] == pytest.approx((crop.height / 2, crop.width / 2), abs=1)


@pytest.mark.parametrize(("height", "width"), [(300, 400), (400, 534), (450, 600), (1200, 1600), (720, 960)])
def test_the_certain_part_of_frames_in_another_resolution_has_the_resized_camera_within_half_a_pixel(height, width):
    _, crop = certain_part(CAMERA, covariance(), PINHOLE)
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    x, y = crop.of(torch.stack([x, y]), CAMERA.width)
    shown, frame = PINHOLE.cropped(**crop._asdict()), PINHOLE.resized(height=height, width=width)
    shown = shown.resized(height=x.shape[0], width=x.shape[1])  # raises for another shape
    for j, i in ((0, 0), (-1, -1)):
        (ray,) = frame.unproject(torch.stack([x[j, i], y[j, i]])[None].double()).points
        pixel = torch.tensor([i % x.shape[1], j % x.shape[0]])
        torch.testing.assert_close(shown.project(ray[None]).points[0], pixel.double(), atol=0.51, rtol=0)
