import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera
from torchrefract.cameras.brown_conrady import distort_polynomial

LENSES = {
    "polynomial12": (-0.3, 0.15, -0.02, 0.01, 0.003, -0.001, 1e-3, 2e-3, 3e-3, 1e-3, -2e-3, 4e-3),
    "opencv": (-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05),
    "fisheye": (-0.12, 0.043, -0.0088, -0.0037),
    "division": (-0.3,),
}
RAYS = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.2], [0.0, -0.3, 0.9], [0.5, 0.4, 2.0]], dtype=torch.float64)
MATRIX = np.array([[50.0, 0, 30], [0, 51, 18], [0, 0, 1]])


def camera(coefficients=(0.0,) * 4, model="opencv", **numbers) -> Camera:
    """Return a camera of 64 x 36 px."""
    defaults = {"width": 64, "height": 36, "fx": 50.0, "fy": 51.0, "cx": 30.0, "cy": 18.0}
    return Camera(**{**defaults, **numbers}, coefficients=coefficients, model=model)


@pytest.mark.quick
@pytest.mark.parametrize("count", [4, 5, 12])
def test_opencv_coefficients_are_reordered_for_the_polynomial(count):
    vector = np.zeros(count)
    vector[: min(count, 5)] = (-0.3, 0.1, 0.002, -0.003, 0.04)[:count]
    vector[8:12] = (0.01, -0.02, 0.03, 0.005)[: max(0, count - 8)]
    c = torch.tensor(camera(tuple(vector)).polynomial(), dtype=torch.float64).view(1, 12, 1)
    x, y = torch.tensor([[[0.3]], [[-0.2]]], dtype=torch.float64)
    theirs, _ = cv2.projectPoints(np.array([[0.3, -0.2, 1.0]]), np.zeros(3), np.zeros(3), np.eye(3), vector)
    assert_close(torch.cat(distort_polynomial(x, y, c)).flatten(), torch.from_numpy(theirs.ravel()), rtol=0, atol=1e-12)


def test_from_opencv_accepts_arrays_of_any_shape():
    row = Camera.from_opencv(MATRIX, np.array([[-0.3, 0.1, 0.002, -0.003, 0.04]]), width=64, height=36)
    assert row == camera((-0.3, 0.1, 0.002, -0.003, 0.04))
    column = Camera.from_opencv(MATRIX.tolist(), np.array([[-0.3], [0.1], [0.0], [0.0]]), width=64, height=36)
    assert column.coefficients == (-0.3, 0.1, 0.0, 0.0)


def fold(values: tuple[float, ...], model: str) -> tuple[Callable[[], Camera], str]:
    return lambda: camera(values, model), "coefficients must leave at least one pixel that does not fold back"


@pytest.mark.parametrize(
    ("action", "rule"),
    [
        (lambda: camera((0.0,) * 6), "coefficients must be 4 or 5 or 8 or 12 or 14 numbers .* got 6"),
        (lambda: camera((0.0,) * 5, "polynomial12"), "coefficients must be 12 numbers"),
        (lambda: camera((0.0, 0.0, 0.0, np.nan)), "coefficients must not be NaN"),
        (lambda: camera(fx=0.0), "fx must be above 0, got 0"),
        (lambda: camera(cx=np.inf), "cx must be a number"),
        (lambda: camera(width=0), "width must be at least 1, got 0"),
        (lambda: camera(model="pinhole"), "model must be one of polynomial12, .* got 'pinhole'"),
        fold((-1e30, 0.0, 0.0, 0.0), "opencv"),
        fold((0.0, 0.0, 0.0, 0.0, 0.0, -1e30, 0.0, 0.0), "opencv"),
        fold((0.0, -1e30, *(0.0,) * 10), "polynomial12"),
        fold((-1e30, 0.0, 0.0, 0.0), "fisheye"),
        fold((1e30,), "division"),
        fold((-1e30,), "division"),
        (lambda: Camera.from_opencv(MATRIX + 0.5, [0.0] * 4, width=64, height=36), "matrix must have no skew, got 0.5"),
        (lambda: Camera.from_opencv(MATRIX[:2], [0.0] * 4, width=64, height=36), "matrix must be 3 x 3"),
        (lambda: camera().resized(width=64, height=48), "the camera's frames, 64 x 36 px, got 64 x 48"),
        (
            lambda: camera().cropped(left=10, top=0, width=60, height=36),
            "left must leave 60 of the frame's 64 px, got 10",
        ),
        (lambda: camera().cropped(left=-1, top=0, width=4, height=4), "left must be at least 0, got -1"),
        (lambda: camera().cropped(left=0, top=0, width=4, height=0), "height must be at least 1, got 0"),
        (lambda: camera().flipped("diagonal"), "direction must be one of horizontal, vertical, got 'diagonal'"),
        (lambda: camera((-0.3,), "division").polynomial(), r"polynomial12, or opencv .*convert\(camera.* got division"),
        *(
            (lambda i=i: camera((0.0,) * i + (0.01,) + (0.0,) * (13 - i)).polynomial(), "tau_x and tau_y of zero")
            for i in (5, 6, 7, 12, 13)
        ),
    ],
)
def test_invalid_arguments_raise(action, rule):
    with pytest.raises(ValueError, match=rule):
        action()


@pytest.mark.parametrize("size", [(1920, 1080), (427, 240)])
def test_a_resized_camera_shows_the_same_rays_at_the_same_share_of_the_frame(size):
    original = Camera(width=1280, height=720, fx=1161.0, fy=1157.0, cx=676.0, cy=388.3, coefficients=(0.1, 0, 0, 0))
    width, height = size
    resized = original.resized(width=width, height=height)
    assert (resized.width, resized.height, resized.coefficients) == (width, height, original.coefficients)
    for share in (0.0, 0.3, 1.0):  # of the frame, from its left edge and from its middle down
        u, v = share * 1280 - 0.5, (719 + share * 500) / 2
        x, y = (u - original.cx) / original.fx, (v - original.cy) / original.fy
        u, v = share * width - 0.5, (height - 1 + share * 500 * width / 1280) / 2
        assert (u - resized.cx) / resized.fx == pytest.approx(x, abs=1e-12)
        assert (v - resized.cy) / resized.fy == pytest.approx(y, abs=1e-12)


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
    original = camera(LENSES[model], model, fx=40.0, fy=41.0)
    before = original.project(RAYS)
    after = change(original).project(RAYS * torch.tensor([*ray, 1.0], dtype=torch.float64))
    assert before.valid.all()
    assert after.valid.all()
    assert_close(after.points, pixel(before.points), rtol=0, atol=1e-11)


@pytest.mark.quick
@pytest.mark.parametrize("model", LENSES)
def test_a_camera_without_its_lens_shows_undistorted_points_with_its_pinhole(model):
    original = camera(LENSES[model], model)
    pinhole = original.without_lens(zoom=2.0)
    assert pinhole.is_pinhole
    (fx, _, cx), (_, fy, cy), _ = original.matrix
    expected = RAYS[:, :2] / RAYS[:, 2:] * torch.tensor([2 * fx, 2 * fy]) + torch.tensor([cx, cy])
    rays = original.unproject(original.project(RAYS).points).points
    assert_close(pinhole.project(rays).points, expected, rtol=0, atol=1e-9)


def test_coverage_is_the_area_of_the_circle_before_the_fold():
    # A barrel of one coefficient shows r_d up to 2 / (3 sqrt(-3 k1)).
    square = {"width": 201, "height": 201, "fx": 100.0, "fy": 100.0, "cx": 100.0, "cy": 100.0}
    barrel = camera((-0.4, 0.0, 0.0, 0.0), **square)
    assert barrel.valid_radius == pytest.approx(1 / math.sqrt(1.2))
    edge = 2 / 3 / math.sqrt(1.2)
    assert barrel.coverage() == pytest.approx(math.pi * edge**2 / 4, abs=0.005)
    with pytest.raises(ValueError, match=r"camera must not fold back inside its frame, .* rays for 28.6.%"):
        barrel.check_covers()
    camera(LENSES["division"], "division").check_covers()
    # 1 - 2 r^2 is zero at r = 0.707; the corner of 201 x 201 px is at sqrt(2) 100 / f.
    pole = (0.0,) * 5 + (-2.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"camera must keep its denominator .* up to r = 0.7107 .* zero at r = 0.7071"):
        camera(pole, **{**square, "fx": 199.0, "fy": 199.0}).check_covers()
    camera(pole, **{**square, "fx": 201.0, "fy": 201.0}).check_pole()


def test_zero_coefficients_are_a_pinhole_except_for_a_fisheye():
    assert camera((0.0,) * 8).is_pinhole
    assert not camera(model="fisheye").is_pinhole
    assert not camera((0.0, 0.0, 1e-9, 0.0)).is_pinhole
