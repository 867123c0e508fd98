import cv2
import numpy as np
import pytest

from torchrefract import Camera

NUMBERS = {"width": 64, "height": 36, "fx": 50.0, "fy": 51.0, "cx": 30.0, "cy": 18.0}


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencvs_vector_is_put_in_the_order_of_the_polynomial(count):
    vector = np.zeros(count)
    vector[: min(count, 5)] = (-0.3, 0.1, 0.002, -0.003, 0.04)[:count]
    vector[8:12] = (0.01, -0.02, 0.03, 0.005)[: max(0, min(count, 12) - 8)]
    camera = Camera(**NUMBERS, coefficients=tuple(vector))
    k1, k2, k3, k4, k5, k6, p1, p2, *s = camera.polynomial()
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4 + k5 * r2**5 + k6 * r2**6
    ours = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s[0] * r2 + s[1] * r2**2,
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s[2] * r2 + s[3] * r2**2,
    )
    zero = np.zeros(3)
    theirs, _ = cv2.projectPoints(np.array([[x, y, 1.0]]), zero, zero, np.eye(3), vector)
    assert np.abs(theirs.ravel() - ours).max() < 1e-12


def test_a_calibration_of_opencv_is_taken_as_it_comes():
    matrix = np.array([[50.0, 0, 30], [0, 51, 18], [0, 0, 1]])
    camera = Camera.from_opencv(matrix, np.array([[-0.3, 0.1, 0.002, -0.003, 0.04]]), width=64, height=36)
    assert camera == Camera(**NUMBERS, coefficients=(-0.3, 0.1, 0.002, -0.003, 0.04))
    column = Camera.from_opencv(matrix.tolist(), np.array([[-0.3], [0.1], [0.0], [0.0]]), width=64, height=36)
    assert column.coefficients == (-0.3, 0.1, 0.0, 0.0)


@pytest.mark.parametrize("place", [5, 6, 7, 12, 13])
def test_what_no_polynomial_has_raises(place):
    vector = [0.0] * 14
    vector[place] = 0.01
    with pytest.raises(ValueError, match="coefficients must have k4, k5, k6, tau_x and tau_y of zero"):
        Camera(**NUMBERS, coefficients=tuple(vector)).polynomial()


@pytest.mark.parametrize(
    ("options", "error", "rule"),
    [
        ({"coefficients": (0.0,) * 6}, ValueError, "coefficients must be 4 or 5 or 8 or 12 or 14 numbers .* got 6"),
        ({"coefficients": (0.0,) * 5, "model": "polynomial12"}, ValueError, "coefficients must be 12 numbers"),
        ({"coefficients": (0.0, 0.0, 0.0, np.nan)}, ValueError, "coefficients must not be NaN"),
        ({"fx": 0.0}, ValueError, "fx must be above 0, got 0"),
        ({"fy": -1.0}, ValueError, "fy must be above 0, got -1"),
        ({"cx": np.inf}, ValueError, "cx must be a number"),
        ({"width": 0}, ValueError, "width must be at least 1, got 0"),
        ({"height": 36.0}, TypeError, "height must be a whole number"),
        (
            {"model": "pinhole"},
            ValueError,
            "model must be one of polynomial12, opencv, fisheye, division, got 'pinhole'",
        ),
    ],
)
def test_what_is_no_camera_raises(options, error, rule):
    with pytest.raises(error, match=rule):
        Camera(**{**NUMBERS, "coefficients": (0.0,) * 4, **options})


@pytest.mark.parametrize(
    ("matrix", "rule"),
    [
        ([[50.0, 0.5, 30], [0, 51, 18], [0, 0, 1]], "matrix must have no skew, got 0.5"),
        ([[50.0, 0], [0, 51]], "matrix must be 3 x 3"),
    ],
)
def test_what_is_no_camera_matrix_raises(matrix, rule):
    with pytest.raises(ValueError, match=rule):
        Camera.from_opencv(matrix, [0.0] * 4, width=64, height=36)


@pytest.mark.parametrize("size", [(640, 360), (1920, 1080), (1280, 720), (427, 240)])
def test_a_resized_camera_sees_the_same_rays_through_the_same_places_of_the_frame(size):
    camera = Camera(width=1280, height=720, fx=1161.0, fy=1157.0, cx=676.0, cy=388.3, coefficients=(0.1, 0, 0, 0))
    width, height = size
    other = camera.resized(width=width, height=height)
    assert (other.width, other.height, other.coefficients) == (width, height, camera.coefficients)
    for share in (0.0, 0.3, 1.0):  # of the frame, from its left edge and from its middle down
        u, v = share * 1280 - 0.5, (719 + share * 500) / 2
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        u, v = share * width - 0.5, (height - 1 + share * 500 * width / 1280) / 2
        assert (u - other.cx) / other.fx == pytest.approx(x, abs=1e-12)
        assert (v - other.cy) / other.fy == pytest.approx(y, abs=1e-12)


def test_a_camera_is_not_stretched():
    camera = Camera(width=1280, height=720, fx=1161.0, fy=1157.0, cx=676.0, cy=388.3, coefficients=(0.1, 0, 0, 0))
    with pytest.raises(
        ValueError, match="image must have the shape of the camera's frames, 1280 x 720 px, got 640 x 480"
    ):
        camera.resized(width=640, height=480)
