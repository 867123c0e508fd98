import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import assert_graph_agrees
from scipy import stats
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, LensDistortion
from torchrefract.cameras.conversion import convert
from torchrefract.cameras.lens_database import read_lenses

CAR = Camera(
    width=640, height=360, fx=560.0, fy=565.0, cx=325.0, cy=178.0, coefficients=(-0.25, 0.09, 1e-3, -8e-4, 0.0)
)
OTHERS = (
    CAR,
    replace(CAR, fx=500.0, fy=500.0, coefficients=(-0.1, 0.02, 0.0, 0.0)),
    replace(CAR, coefficients=(0.08, -0.01, *(0.0,) * 10), model="polynomial12"),
)
FISHEYE = replace(CAR, coefficients=(-0.02, 0.05, -0.04, 0.01), model="fisheye")
POLE = (0.0,) * 5 + (-5.0, 0.0, 0.0)  # at r = 0.447


def lens_of(camera: Camera) -> list[float]:
    """Return the 16 numbers of the lens of a camera: coefficients, fx, fy and center in widths."""
    width = camera.width
    center = [(camera.cx - (width - 1) / 2) / width, (camera.cy - (camera.height - 1) / 2) / width]
    return [*camera.polynomial(), camera.fx / width, camera.fy / width, *center]


def draw_lenses(effect: LensDistortion, count: int, seed: int = 7) -> Tensor:
    """Return the numbers of drawn lenses, (count, 16), float64."""
    params = effect.sample(torch.zeros(count, 1, 1, 1, dtype=torch.float64), seed=seed)
    return torch.cat([params.coefficients, params.focal, params.center], dim=1)


def test_from_camera_moves_each_ray_to_its_pixel_in_the_camera():
    effect = LensDistortion.from_camera(CAR, tolerance_px=None, frame="pad")
    degraded = effect.degrade(torch.zeros(1, 1, 360, 640, dtype=torch.float64), seed=0)
    pixels = torch.tensor([[0.0, 0.0], [639.0, 359.0], [100.0, 250.0]], dtype=torch.float64)
    seen = CAR.project(CAR.unproject(pixels).points).points
    assert_close(seen, pixels, rtol=0, atol=1e-9)
    # The clean frame is that of a pinhole camera with the same numbers.
    rays = CAR.unproject(pixels).points
    clean = rays[:, :2] / rays[:, 2:] * torch.tensor([560.0, 565.0]).double() + torch.tensor([325.0, 178.0]).double()
    columns, rows = pixels.long().T
    assert_close(pixels + degraded.flow[0][:, rows, columns].T, clean, rtol=0, atol=1e-8)


def test_cameras_of_degraded_frames_agree_with_the_restore_flow():
    height, width = 36, 64
    wide = LensDistortion(s1_range=(-0.01, 0.01), s4_range=(-0.01, 0.01), aspect_range=(0.95, 1.05), p=0.6, frame="pad")
    degraded = wide.degrade(torch.zeros(6, 3, height, width, dtype=torch.float64), seed=2)
    cameras = wide.cameras(degraded.params, height=height, width=width)
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).view(-1, 2)
    assert {camera.is_pinhole for camera in cameras} == {True, False}
    for camera, is_applied, flow in zip(cameras, degraded.params.applied.tolist(), degraded.restore_flow, strict=True):
        assert camera.is_pinhole is not is_applied
        # The restore flow points from a clean pixel to where the camera shows the ray of that pixel.
        rays = replace(camera, coefficients=(0.0,) * 12).unproject(pixels).points
        pixels_in_camera, valid, _ = camera.project(rays)
        assert valid.all()
        assert_close(pixels_in_camera - pixels, flow.flatten(1).mT, rtol=0, atol=1e-9)


def test_cameras_of_drawn_params_are_the_resized_camera():
    lens = LensDistortion.from_camera(replace(OTHERS[2], fx=500.25))
    params = lens.sample(torch.zeros(2, 3, 180, 320, dtype=torch.float64), seed=0)
    expected = replace(OTHERS[2], fx=500.25).resized(width=320, height=180)
    for camera in lens.cameras(params, height=180, width=320):
        assert (camera.model, camera.width, camera.height) == ("polynomial12", 320, 180)
        for name in ("fx", "fy", "cx", "cy", "coefficients"):
            assert getattr(camera, name) == pytest.approx(getattr(expected, name), rel=1e-9)


def test_jitter_is_uniform_in_each_number():
    values, expected = draw_lenses(LensDistortion.from_camera(CAR, jitter=0.1, frame="pad"), 2000), lens_of(CAR)
    aspect = values[:, 13] / values[:, 12]
    for i, center in enumerate(expected):
        column = aspect if i == 13 else values[:, i]
        middle = CAR.fy / CAR.fx if i == 13 else center
        if middle == 0:
            assert not column.any()
        else:
            assert stats.kstest(((column / middle - 0.9) / 0.2).numpy(), "uniform").pvalue > 1e-4


def test_drawn_lenses_have_the_given_covariance():
    deviations = np.array([4.0, 4.2, 2.0, 1.5, 0.01, 0.012, 2e-4, 1e-4, 0.02])
    correlation = np.eye(9)
    correlation[0, 1] = correlation[1, 0] = 0.98
    correlation[4, 5] = correlation[5, 4] = -0.9
    covariance = correlation * np.outer(deviations, deviations)
    values = draw_lenses(LensDistortion.from_camera(CAR, covariance=covariance, frame="pad"), 40_000)
    width = CAR.width
    # fx, fy, cx, cy, k1, k2, p1, p2, k3.
    numbers = values[:, (12, 13, 14, 15, 0, 1, 6, 7, 2)] * torch.tensor([width] * 4 + [1] * 5)
    middle = torch.tensor([CAR.fx, CAR.fy, CAR.cx - 319.5, CAR.cy - 179.5, *CAR.coefficients], dtype=torch.float64)
    assert (((numbers.mean(dim=0) - middle) / torch.from_numpy(deviations)).abs() < 0.03).all()
    assert_close(numbers.std(dim=0) / torch.from_numpy(deviations), torch.ones(9).double(), rtol=0, atol=0.02)
    sampled = torch.from_numpy(np.corrcoef(numbers.T.numpy()))
    assert_close(sampled, torch.from_numpy(correlation), rtol=0, atol=0.03)
    assert not values[:, (3, 4, 5, 8, 9, 10, 11)].any()


def test_drawn_polynomials_move_rays_as_the_covariance_of_a_fisheye_does():
    deviations = np.array([2.0, 2.0, 1.0, 1.0, 0.01, 0.012, 0.0, 0.0])
    covariance = np.diag(deviations**2)
    covariance[4, 5] = covariance[5, 4] = -0.8 * 0.01 * 0.012
    effect = LensDistortion.from_camera(FISHEYE, covariance=covariance, frame="pad")
    numbers = draw_lenses(effect, 20_000).numpy()
    for angle in (0.2, 0.4, 0.6):
        # theta_d = theta (1 + k1 theta^2 + k2 theta^4 + ...), and the polynomial is in r = tan theta.
        slopes = np.array([angle**3, angle**5])
        expected = np.sqrt(slopes @ covariance[4:6, 4:6] @ slopes)
        r = math.tan(angle)
        drawn = r * (1 + numbers[:, :6] @ r ** np.arange(2.0, 14.0, 2.0))
        assert drawn.std() == pytest.approx(expected, rel=0.05)
    assert numbers[:, 12].std() * FISHEYE.width == pytest.approx(2.0, rel=0.05)


def test_all_lenses_of_a_table_are_drawn_equally_often():
    values = draw_lenses(LensDistortion.from_lenses(OTHERS, frame="pad"), 3000)
    expected = torch.tensor([lens_of(camera) for camera in OTHERS], dtype=torch.float64)
    which = (values[:, None] - expected).abs().amax(dim=2)
    assert (which.amin(dim=1) < 1e-15).all()
    counts = torch.bincount(which.argmin(dim=1), minlength=3)
    assert stats.chisquare(counts.numpy()).pvalue > 1e-4


def test_float32_and_float64_draw_the_same_lens_of_a_table():
    effect = LensDistortion.from_lenses([replace(CAR, fx=500.0 + i) for i in range(23)], frame="pad")
    single = effect.sample(torch.zeros(500, 1, 1, 1), seed=3).focal[:, 0]
    assert_close(single.double(), draw_lenses(effect, 500, seed=3)[:, 12], rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    "make",
    [
        lambda: LensDistortion.from_camera(CAR, jitter=0.05, p=0.7),
        lambda: LensDistortion.from_camera(CAR, covariance=np.diag([4.0] * 4 + [1e-4] * 5), p=0.7),
        lambda: LensDistortion.from_lenses(OTHERS, p=0.7),
    ],
    ids=["jitter", "covariance", "table"],
)
def test_a_sample_depends_on_its_key_alone(make):
    image, effect, keys = torch.rand(5, 3, 36, 64), make(), [3, 1, 4, 15, 9]
    together = effect.degrade(image, seed=5, keys=keys)
    for i, key in enumerate(keys):
        assert torch.equal(effect.degrade(image[i], seed=5, keys=[key]).flow, together.flow[i])
    for copied in (copy.deepcopy(effect), pickle.loads(pickle.dumps(effect))):
        assert torch.equal(copied.degrade(image, seed=5, keys=keys).image, together.image)


def test_one_graph_draws_the_same_lenses():
    assert_graph_agrees(LensDistortion.from_lenses(OTHERS, tolerance_px=0.05), torch.rand(3, 3, 36, 64))


@pytest.mark.parametrize(("table", "tolerance"), [(OTHERS, 0.3), ([CAR], 0.03)], ids=["three", "one"])
def test_lenses_of_a_table_stay_within_the_tolerance(table, tolerance):
    effect = LensDistortion.from_lenses(table, tolerance_px=tolerance)
    plan = effect.plan(180, 320)
    assert plan.stride > 1
    assert plan.error_px <= tolerance
    image = torch.zeros(12, 1, 180, 320)
    params = effect.sample(image, seed=2)
    degraded, exact = effect.apply(image, params), effect.exact().apply(image, params)
    assert len(params.coefficients.unique(dim=0)) == len(table)
    assert (degraded.flow - exact.flow).norm(dim=1).max() <= tolerance


def test_lenses_outside_the_table_are_computed_exactly():
    effect = LensDistortion.from_lenses(OTHERS, tolerance_px=0.05)
    image = torch.zeros(2, 1, 36, 64)
    params = effect.sample(image, seed=0)
    assert effect.for_params(params, 36, 64) is effect
    other = params._replace(coefficients=0.5 * params.coefficients)
    assert effect.for_params(other, 36, 64) is not effect
    assert torch.equal(effect.apply(image, other).flow, LensDistortion().apply(image, other).flow)


def test_the_plan_of_a_table_with_a_lens_that_may_fold_is_exact():
    # Far out on the frame this one hardly grows any more.
    flat = replace(CAR, fx=570.0, fy=570.0, coefficients=(-0.33, 0.0, 0.0, 0.0))
    plan = LensDistortion.from_lenses([CAR, flat], tolerance_px=0.1).plan(90, 160)
    assert plan.stride == 1
    assert "no error bound is known" in plan.reason


def test_from_lenses_draws_from_the_table_of_the_package():
    effect = LensDistortion.from_lenses(frame="pad")
    near = [lens for lens in read_lenses() if lens.residual_px <= 0.5]
    assert len(near) > 30
    values = draw_lenses(effect, 2000)
    assert len(values.unique(dim=0)) == len({tuple(lens_of(lens.polynomial)) for lens in near if lens.polynomial})
    assert LensDistortion.from_lenses(residual_px=0.0).sample(torch.zeros(1, 1, 4, 4), seed=0).applied.all()


def test_a_fisheye_is_replaced_by_the_nearest_polynomial():
    effect = LensDistortion.from_camera(FISHEYE, jitter=0.0)
    expected = torch.tensor([lens_of(convert(FISHEYE, to="polynomial12").camera)], dtype=torch.float64)
    assert_close(draw_lenses(effect, 2), expected.expand(2, -1), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("camera", "options", "error", "rule"),
    [
        ({}, {}, TypeError, "camera must be a Camera, got dict"),
        (CAR, {"jitter": 1.0}, ValueError, r"jitter must be a number in \[0, 0.99\], got 1"),
        (CAR, {"jitter": math.nan}, ValueError, "jitter must not be NaN"),
        (CAR, {"residual_px": -1.0}, ValueError, "residual_px must be a number of at least 0"),
        (CAR, {"jitter": 0.1, "covariance": np.eye(9)}, ValueError, "jitter must be 0 if a covariance is given"),
        (CAR, {"covariance": np.eye(8)}, ValueError, r"covariance must have shape \(9, 9\), .* got \(8, 8\)"),
        (CAR, {"covariance": np.full((9, 9), np.nan)}, ValueError, "covariance must be finite"),
        (CAR, {"covariance": -np.eye(9)}, ValueError, "covariance must have no negative eigenvalue"),
        (CAR, {"covariance": np.triu(np.ones((9, 9)))}, ValueError, "covariance must be symmetric"),
        (FISHEYE, {"covariance": np.eye(9)}, ValueError, r"covariance must have shape \(8, 8\), .* got \(9, 9\)"),
        (FISHEYE, {"residual_px": 1e-4}, ValueError, "within residual_px = 0.0001 px of a polynomial, got fisheye"),
        (replace(CAR, coefficients=(-0.6, 0.0, 0.0, 0.0)), {}, ValueError, "camera must show rays .* without folding"),
        (replace(CAR, coefficients=POLE), {}, ValueError, "camera must keep its denominator .* inside the frame"),
        (replace(FISHEYE, fx=150.0, fy=150.0), {}, ValueError, "camera must show rays within 80 degrees"),
    ],
)  # one line for each
def test_invalid_cameras_and_arguments_raise(camera, options, error, rule):
    with pytest.raises(error, match=rule):
        LensDistortion.from_camera(camera, **options)


def test_an_invalid_lens_of_a_table_is_named():
    with pytest.raises(
        ValueError, match=r"table\[1\] must show rays .* without folding back, got opencv that does so in"
    ):
        LensDistortion.from_lenses([CAR, replace(CAR, coefficients=(-0.6, 0.0, 0.0, 0.0))])
    with pytest.raises(ValueError, match=r"table\[1\] must keep its denominator .* above zero inside the frame"):
        LensDistortion.from_lenses([CAR, replace(CAR, coefficients=POLE)])
    with pytest.raises(ValueError, match="table must hold at least one camera, got none"):
        LensDistortion.from_lenses([])
