import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera

NUMBERS = {"width": 64, "height": 36, "fx": 50.0, "fy": 51.0, "cx": 30.0, "cy": 18.0}


@pytest.mark.quick
@pytest.mark.parametrize("count", [4, 5, 12])
def test_opencv_coefficients_are_reordered_for_the_polynomial(count):
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


def test_from_opencv_accepts_arrays_of_any_shape():
    matrix = np.array([[50.0, 0, 30], [0, 51, 18], [0, 0, 1]])
    camera = Camera.from_opencv(matrix, np.array([[-0.3, 0.1, 0.002, -0.003, 0.04]]), width=64, height=36)
    assert camera == Camera(**NUMBERS, coefficients=(-0.3, 0.1, 0.002, -0.003, 0.04))
    column = Camera.from_opencv(matrix.tolist(), np.array([[-0.3], [0.1], [0.0], [0.0]]), width=64, height=36)
    assert column.coefficients == (-0.3, 0.1, 0.0, 0.0)


@pytest.mark.parametrize("index", [5, 6, 7, 12, 13])
def test_a_denominator_or_tilt_has_no_polynomial(index):
    vector = [0.0] * 14
    vector[index] = 0.01
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
def test_invalid_cameras_raise(options, error, rule):
    with pytest.raises(error, match=rule):
        Camera(**{**NUMBERS, "coefficients": (0.0,) * 4, **options})


@pytest.mark.parametrize(
    ("matrix", "rule"),
    [
        ([[50.0, 0.5, 30], [0, 51, 18], [0, 0, 1]], "matrix must have no skew, got 0.5"),
        ([[50.0, 0], [0, 51]], "matrix must be 3 x 3"),
    ],
)
def test_invalid_camera_matrices_raise(matrix, rule):
    with pytest.raises(ValueError, match=rule):
        Camera.from_opencv(matrix, [0.0] * 4, width=64, height=36)


@pytest.mark.parametrize("size", [(1920, 1080), (427, 240)])
def test_a_resized_camera_shows_the_same_rays_at_the_same_share_of_the_frame(size):
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


def test_a_different_aspect_ratio_raises():
    camera = Camera(width=1280, height=720, fx=1161.0, fy=1157.0, cx=676.0, cy=388.3, coefficients=(0.1, 0, 0, 0))
    with pytest.raises(
        ValueError, match="image must have the shape of the camera's frames, 1280 x 720 px, got 640 x 480"
    ):
        camera.resized(width=640, height=480)


LENSES = {
    "polynomial12": (-0.3, 0.15, -0.02, 0.01, 0.003, -0.001, 1e-3, 2e-3, 3e-3, 1e-3, -2e-3, 4e-3),
    "opencv": (-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05),
    "fisheye": (-0.12, 0.043, -0.0088, -0.0037),
    "division": (-0.3,),
}
BIG = {"width": 64, "height": 36, "fx": 40.0, "fy": 41.0, "cx": 30.3, "cy": 18.4}
RAYS = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.2], [0.0, -0.3, 0.9], [0.5, 0.4, 2.0]], dtype=torch.float64)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize(
    ("change", "ray", "pixel"),
    [
        # Pixel (u, v) of the frame is (u - left, v - top) of the crop.
        (lambda c: c.cropped(left=7, top=3, width=50, height=20), (1, 1), lambda p: p - torch.tensor([7.0, 3.0])),
        # Pixel i of W is pixel W - 1 - i of the mirrored frame, which shows the mirrored world.
        (lambda c: c.flipped("horizontal"), (-1, 1), lambda p: torch.stack([63 - p[:, 0], p[:, 1]], dim=1)),
        (lambda c: c.flipped("vertical"), (1, -1), lambda p: torch.stack([p[:, 0], 35 - p[:, 1]], dim=1)),
        # A pixel covers [i - 1/2, i + 1/2], so the edge of the frame is at -1/2 in every size.
        (lambda c: c.resized(width=192, height=108), (1, 1), lambda p: 3 * (p + 0.5) - 0.5),
    ],
    ids=["cropped", "flipped left to right", "flipped top to bottom", "resized"],
)
def test_cropped_flipped_and_resized_cameras_match_the_changed_frame(
    model: str, change: Callable[[Camera], Camera], ray: tuple[int, int], pixel: Callable[[Tensor], Tensor]
):
    camera = Camera(**BIG, coefficients=LENSES[model], model=model)
    original = camera.project(RAYS)
    changed = change(camera).project(RAYS * torch.tensor([*ray, 1.0], dtype=torch.float64))
    assert original.valid.all()
    assert changed.valid.all()
    assert_close(changed.points, pixel(original.points), rtol=0, atol=1e-11)


def test_flipping_twice_restores_the_camera():
    camera = Camera(**BIG, coefficients=LENSES["opencv"])
    for direction in ("horizontal", "vertical"):
        twice = camera.flipped(direction).flipped(direction)
        assert twice.coefficients == camera.coefficients
        assert (twice.cx, twice.cy) == pytest.approx((camera.cx, camera.cy), abs=1e-12)


@pytest.mark.parametrize(
    ("part", "rule"),
    [
        ({"left": 10, "top": 0, "width": 60, "height": 36}, "left must leave 60 of the frame's 64 px, got 10"),
        ({"left": 0, "top": 30, "width": 64, "height": 7}, "top must leave 7 of the frame's 36 px, got 30"),
        ({"left": -1, "top": 0, "width": 4, "height": 4}, "left must be at least 0, got -1"),
        ({"left": 0, "top": 0, "width": 4, "height": 0}, "height must be at least 1, got 0"),
    ],
)
def test_a_crop_outside_the_frame_raises(part, rule):
    with pytest.raises(ValueError, match=rule):
        Camera(**BIG, coefficients=LENSES["division"], model="division").cropped(**part)


def test_an_invalid_flip_direction_raises():
    with pytest.raises(ValueError, match="direction must be one of horizontal, vertical, got 'diagonal'"):
        Camera(**BIG, coefficients=(0.0,) * 4).flipped("diagonal")


def test_coverage_is_the_area_of_the_circle_before_the_fold():
    # A barrel of one coefficient shows r_d up to 2 / (3 sqrt(-3 k1)).
    camera = Camera(width=201, height=201, fx=100.0, fy=100.0, cx=100.0, cy=100.0, coefficients=(-0.4, 0.0, 0.0, 0.0))
    assert camera.valid_radius == pytest.approx(1 / math.sqrt(1.2))
    edge = 2 / 3 / math.sqrt(1.2)
    assert camera.coverage() == pytest.approx(math.pi * edge**2 / 4, abs=0.005)
    with pytest.raises(
        ValueError, match=r"camera must not fold back inside its frame, got opencv with rays for 28.6.%"
    ):
        camera.check_covers()
    Camera(**BIG, coefficients=LENSES["division"], model="division").check_covers()


def test_check_pole_raises_for_a_pole_inside_the_frame():
    # 1 - 2 r^2 is zero at r = 0.707; the corner of 201 x 201 px is at sqrt(2) 100 / f.
    sizes = {"width": 201, "height": 201, "cx": 100.0, "cy": 100.0, "coefficients": (0.0,) * 5 + (-2.0, 0.0, 0.0)}
    near = Camera(**sizes, fx=199.0, fy=199.0)
    with pytest.raises(ValueError, match=r"camera must keep its denominator .* up to r = 0.7107 .* zero at r = 0.7071"):
        near.check_pole()
    with pytest.raises(ValueError, match="camera must keep its denominator"):
        near.check_covers()
    Camera(**sizes, fx=201.0, fy=201.0).check_pole()


def test_zero_coefficients_are_a_pinhole_except_for_a_fisheye():
    assert Camera(**BIG, coefficients=(0.0,) * 8).is_pinhole
    assert not Camera(**BIG, coefficients=(0.0,) * 4, model="fisheye").is_pinhole
    assert not Camera(**BIG, coefficients=(0.0, 0.0, 1e-9, 0.0)).is_pinhole


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("opencv", (-1e30, 0.0, 0.0, 0.0)),
        ("opencv", (0.0, 0.0, 0.0, 0.0, 0.0, -1e30, 0.0, 0.0)),
        ("polynomial12", (0.0, -1e30, *(0.0,) * 10)),
        ("fisheye", (-1e30, 0.0, 0.0, 0.0)),
        ("division", (1e30,)),
        ("division", (-1e30,)),
    ],
)
def test_a_lens_that_folds_within_a_pixel_raises(model, coefficients):
    with pytest.raises(ValueError, match="coefficients must leave at least one pixel that does not fold back"):
        Camera(**BIG, coefficients=coefficients, model=model)


@pytest.mark.parametrize("model", ["fisheye", "division"])
def test_polynomial_raises_for_other_models_and_names_convert(model):
    with pytest.raises(ValueError, match=r"model must be polynomial12, or opencv .*convert\(camera.* got " + model):
        Camera(**BIG, coefficients=LENSES[model], model=model).polynomial()
