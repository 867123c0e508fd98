import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares as scipy_least_squares

from torchrefract import Camera
from torchrefract.cameras.conversion import convert, least_squares

ZERO = np.zeros(3)
# Ten dashcams, phones, action and car cameras of the shared table.
FISHEYES = ("gf_01", "gf_05", "gf_08", "gf_16", "gf_18", "gf_21", "gf_22", "gf_26", "gf_29", "gf_30")
CAR = Camera(width=640, height=360, fx=500.0, fy=505.0, cx=322.0, cy=181.0, coefficients=(-0.1, 0.0, 0.0, 0.0))


def apart(camera: Camera, other: Camera) -> float:
    """Px, at most, between what OpenCV makes of the rays of a frame by both cameras, those it can undistort itself."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    numbers = np.array(camera.matrix), np.array(camera.coefficients)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    points = undistort(pixels, *numbers, criteria=criteria)[:, 0]
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    matrix, vector = np.array(other.matrix), np.array(other.coefficients)
    if other.model == "polynomial12":
        k, (p1, p2, *s) = vector[:6], vector[6:]
        r2 = (points**2).sum(axis=1)
        radial = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
        x, y = points.T
        seen = np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s[0] * r2 + s[1] * r2**2,
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s[2] * r2 + s[3] * r2**2,
            ],
            axis=1,
        )
        seen = seen * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    else:
        seen = cv2.projectPoints(rays, ZERO, ZERO, matrix, vector)[0][:, 0]
    return float(np.linalg.norm(seen - pixels[:, 0], axis=1).max())


@pytest.mark.parametrize("name", FISHEYES)
def test_a_real_fisheye_becomes_opencvs_ratio_and_says_how_nearly(published, name):
    camera = published[name]
    made = convert(camera, to="opencv")
    assert (made.camera.model, len(made.camera.coefficients)) == ("opencv", 8)
    assert made.camera.matrix == camera.matrix
    assert made.covered == 1
    assert made.rms_px <= made.max_px < 0.15
    assert apart(camera, made.camera) == pytest.approx(made.max_px, rel=0.5, abs=1e-5)


@pytest.mark.parametrize("name", ["pj_rational8", "gf_10", "gf_14", "gf_18", "gf_22", "gf_29"])
def test_a_real_lens_of_moderate_width_becomes_a_polynomial_and_says_how_nearly(published, name):
    camera = published[name]
    made = convert(camera, to="polynomial12")
    assert made.rms_px <= made.max_px < 0.1
    assert apart(camera, made.camera) == pytest.approx(made.max_px, rel=0.5)


def test_ten_real_lenses_without_a_denominator_are_polynomials_as_they_are(published):
    cameras = [c for c in published.values() if c.model == "opencv" and len(c.coefficients) == 5]
    assert len(cameras) >= 10
    for camera in cameras:
        made = convert(camera, to="polynomial12")
        assert made.camera.coefficients == camera.polynomial()
        assert made.max_px < 1e-11 * camera.width
        assert made.covered == 1


def test_a_wide_fisheye_is_no_polynomial_and_that_is_reported(published):
    made = convert(published["gf_20"], to="polynomial12")
    assert made.max_px > 10
    assert apart(published["gf_20"], made.camera) > 10


def test_rays_that_no_plane_shows_are_left_out_and_counted(published):
    camera = published["ov_rs_t265_cam0"]  # sees past 90 degrees
    made = convert(camera, to="opencv", most_angle_deg=70)
    rays = camera.unproject(camera.grid(129)).points
    assert made.covered == pytest.approx((rays[:, 2] > math.cos(math.radians(70))).double().mean().item(), abs=1e-3)
    assert made.max_px < 0.1


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("division", (-0.2,)), ("fisheye", (-0.02, 0.05, -0.04, 0.01)), ("polynomial12", (-0.2, 0.05, *(0.0,) * 10))],
)
def test_a_camera_comes_back_from_the_other_model(model, coefficients):
    camera = replace(CAR, coefficients=coefficients, model=model)
    there = convert(camera, to="opencv", count=14)
    back = convert(there.camera, to=model)
    assert there.max_px < 1e-3
    pixels = camera.grid(17)
    assert (back.camera.project(camera.unproject(pixels).points).points - pixels).abs().max() < 3e-3
    assert convert(camera, to=model).camera is camera


def test_the_least_squares_are_scipys():
    t = torch.linspace(0, 3, 40, dtype=torch.float64)
    goal = 2.5 * torch.exp(-1.3 * t) + 0.4 + 0.05 * torch.sin(9 * t)

    def error(p: torch.Tensor) -> torch.Tensor:
        return (p[:, 0] * torch.exp(-p[:, 1] * t) + p[:, 2] - goal)[:, None]

    def numpys(p: np.ndarray) -> np.ndarray:
        return p[0] * np.exp(-p[1] * t.numpy()) + p[2] - goal.numpy()

    found = least_squares(error, torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64), rows=40)
    theirs = scipy_least_squares(numpys, [1.0, 0.5, 0.0], xtol=1e-14, ftol=1e-14)
    assert found.tolist() == pytest.approx(theirs.x.tolist(), abs=1e-5)


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"to": "pinhole"}, "to must be one of polynomial12, opencv, fisheye, division, got 'pinhole'"),
        ({"to": "opencv", "count": 6}, "count must be 4 or 5 or 8 or 12 or 14 for the model opencv, got 6"),
        ({"to": "fisheye", "count": 5}, "count must be 4 for the model fisheye, got 5"),
        ({"to": "division", "most_angle_deg": 90.0}, r"most_angle_deg must be a number in \[1, 89.9\], got 90"),
    ],
)
def test_what_is_no_conversion_raises(options, rule):
    with pytest.raises(ValueError, match=rule):
        convert(CAR, **options)


def test_a_frame_without_a_ray_raises():
    aside = replace(CAR, cx=-3000.0, coefficients=(0.0, 0.0, 0.0, 0.0), model="fisheye")
    with pytest.raises(ValueError, match="camera must show rays nearer to its axis than most_angle_deg"):
        convert(aside, to="opencv")
