import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares as scipy_least_squares

from torchrefract import Camera
from torchrefract.cameras.brown_conrady import distort_polynomial
from torchrefract.cameras.conversion import convert, least_squares

ZERO = np.zeros(3)
# Dashcams, phones, action and car cameras of the shared table, the model to convert to, and the largest error, px.
REAL = [(name, "opencv", 0.15) for name in ("gf_01", "gf_08", "gf_18", "gf_26", "gf_30")]
REAL += [(name, "polynomial12", 0.1) for name in ("pj_rational8", "gf_10", "gf_22")]  # of moderate width
CAR = Camera(width=640, height=360, fx=500.0, fy=505.0, cx=322.0, cy=181.0, coefficients=(-0.1, 0.0, 0.0, 0.0))


def opencv_distance(camera: Camera, other: Camera) -> float:
    """Return the largest distance, px, between rays of a frame by both cameras, with OpenCV's undistortion."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    parameters = np.array(camera.matrix), np.array(camera.coefficients)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    points = undistort(pixels, *parameters, criteria=criteria)[:, 0]
    matrix, vector = np.array(other.matrix), np.array(other.coefficients)
    if other.model == "polynomial12":
        x, y = torch.from_numpy(points.T.copy())[:, None]
        distorted = torch.stack(distort_polynomial(x, y, torch.from_numpy(vector).view(1, 12, 1)))[:, 0].T.numpy()
        projected = distorted * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    else:
        rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        projected = cv2.projectPoints(rays, ZERO, ZERO, matrix, vector)[0][:, 0]
    return float(np.linalg.norm(projected - pixels[:, 0], axis=1).max())


@pytest.mark.parametrize(("name", "model", "limit_px"), REAL)
def test_real_lenses_are_converted_with_the_reported_error(published, name, model, limit_px):
    camera = published[name]
    result = convert(camera, to=model)
    assert (result.camera.model, len(result.camera.coefficients)) == (model, 8 if model == "opencv" else 12)
    assert result.camera.matrix == camera.matrix
    assert result.covered == 1
    assert result.rms_px <= result.max_px < limit_px
    assert opencv_distance(camera, result.camera) == pytest.approx(result.max_px, rel=0.5, abs=1e-5)


def test_lenses_without_a_denominator_are_converted_exactly(published):
    cameras = [c for c in published.values() if c.model == "opencv" and len(c.coefficients) == 5]
    assert len(cameras) >= 10
    for camera in cameras:
        result = convert(camera, to="polynomial12")
        assert result.camera.coefficients == camera.polynomial()
        assert result.max_px < 1e-11 * camera.width
        assert result.covered == 1


def test_rays_beyond_the_largest_angle_are_ignored_and_counted(published):
    camera = published["ov_rs_t265_cam0"]  # sees past 90 degrees
    result = convert(camera, to="opencv", most_angle_deg=70)
    rays = camera.unproject(camera.grid(129)).points
    assert result.covered == pytest.approx((rays[:, 2] > math.cos(math.radians(70))).double().mean().item(), abs=1e-3)
    assert result.max_px < 0.1


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("division", (-0.2,)), ("fisheye", (-0.02, 0.05, -0.04, 0.01)), ("polynomial12", (-0.2, 0.05, *(0.0,) * 10))],
)
def test_converting_forth_and_back_restores_the_camera(model, coefficients):
    camera = replace(CAR, coefficients=coefficients, model=model)
    forth = convert(camera, to="opencv", count=14)
    back = convert(forth.camera, to=model)
    assert forth.max_px < 1e-3
    pixels = camera.grid(17)
    assert (back.camera.project(camera.unproject(pixels).points).points - pixels).abs().max() < 3e-3
    assert convert(camera, to=model).camera is camera


def test_least_squares_match_scipy():
    t = torch.linspace(0, 3, 40, dtype=torch.float64)
    target = 2.5 * torch.exp(-1.3 * t) + 0.4 + 0.05 * torch.sin(9 * t)

    def function(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        decay = torch.exp(-p[1] * t)
        return p[0] * decay + p[2] - target, torch.stack([decay, -p[0] * t * decay, torch.ones_like(t)], dim=1)

    def numpy_error(p: np.ndarray) -> np.ndarray:
        return p[0] * np.exp(-p[1] * t.numpy()) + p[2] - target.numpy()

    parameters = least_squares(function, torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))
    theirs = scipy_least_squares(numpy_error, [1.0, 0.5, 0.0], xtol=1e-14, ftol=1e-14)
    assert parameters.tolist() == pytest.approx(theirs.x.tolist(), abs=1e-5)


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"to": "pinhole"}, "to must be one of polynomial12, opencv, fisheye, division, got 'pinhole'"),
        ({"to": "opencv", "count": 6}, "count must be 4 or 5 or 8 or 12 or 14 for the model opencv, got 6"),
        ({"to": "fisheye", "count": 5}, "count must be 4 for the model fisheye, got 5"),
        ({"to": "division", "most_angle_deg": 90.0}, r"most_angle_deg must be a number in \[1, 89.9\], got 90"),
    ],
)
def test_invalid_conversions_raise(options, rule):
    with pytest.raises(ValueError, match=rule):
        convert(CAR, **options)


def test_a_frame_without_rays_near_the_axis_raises():
    outside = replace(CAR, cx=-3000.0, coefficients=(0.0, 0.0, 0.0, 0.0), model="fisheye")
    with pytest.raises(ValueError, match="camera must show rays nearer to its axis than most_angle_deg"):
        convert(outside, to="opencv")
