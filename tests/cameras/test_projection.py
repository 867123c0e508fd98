import math

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera
from torchrefract.cameras.projection import distort, project, undistort, unproject, valid_radius

CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
FOCAL = 2000.0
COUNT = 10_000
ZERO = np.zeros(3)
OPENCV = {
    "4": (-0.25, 0.09, 1e-3, -2e-3),
    "5": (0.3, -0.05, 1e-3, 2e-3, 0.02),
    "8": (0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03),
    "12": (-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3),
    "14": (-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05),
}
FISHEYE = {
    "dashcam": (-0.12, 0.043, -0.0088, -0.0037),
    "tracking": (-0.0033, 0.054, -0.0516, 0.0108),
    "plain": (0.0, 0.0, 0.0, 0.0),
}
ALL = {
    "polynomial12": (-0.3, 0.15, -0.02, 0.01, 0.003, -0.001, 1e-3, 2e-3, 3e-3, 1e-3, -2e-3, 4e-3),
    "opencv": OPENCV["14"],
    "fisheye": FISHEYE["dashcam"],
    "division": (-0.3,),
}


def coefficients(values: tuple[float, ...], dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor([values], dtype=dtype)


def scattered(reach: float, count: int = COUNT) -> Tensor:
    """(1, count, 2), in a frame of 16:9."""
    generator = torch.Generator().manual_seed(1)
    points = 2 * torch.rand(1, count, 2, generator=generator, dtype=torch.float64) - 1
    return points * torch.tensor([reach, reach * 9 / 16], dtype=torch.float64)


def with_depth(points: Tensor) -> np.ndarray:
    return torch.cat([points[0], torch.ones_like(points[0, :, :1])], dim=1).numpy()


@pytest.mark.quick
@pytest.mark.parametrize("name", OPENCV)
def test_the_opencv_model_matches_opencv(name, oracle):
    points, vector = scattered(0.8), np.array(OPENCV[name])
    theirs, _ = cv2.projectPoints(with_depth(points), ZERO, ZERO, np.eye(3), vector)
    expected = torch.from_numpy(theirs[:, 0].copy())[None]
    for kind, dtype, bar in (("fp64", torch.float64, 1e-9), ("fp32", torch.float32, 2e-3)):
        result = distort(points.to(dtype), coefficients(OPENCV[name], dtype), model="opencv")
        assert result.valid.all()
        oracle(f"opencv model, cv2.projectPoints, {kind}", result.points, expected, bar, scale=FOCAL)
    back = undistort(expected, coefficients(OPENCV[name]), model="opencv")
    assert back.valid.all()
    oracle("opencv model, round trip, fp64", back.points, points, 1e-9, scale=FOCAL)
    theirs = cv2.undistortPoints(expected[0].numpy()[:, None], np.eye(3), vector, criteria=CRITERIA)
    theirs = torch.from_numpy(theirs[:, 0].copy())[None]
    oracle("opencv model inverse, cv2.undistortPoints, fp64", back.points, theirs, 1e-6, scale=FOCAL)


@pytest.mark.quick
@pytest.mark.parametrize("name", FISHEYE)
def test_the_fisheye_matches_opencv(name, oracle):
    points, vector = scattered(1.6), np.array(FISHEYE[name])
    result = distort(points, coefficients(FISHEYE[name]), model="fisheye")
    assert result.valid.all()
    expected = torch.from_numpy(cv2.fisheye.distortPoints(points[0].numpy()[:, None], np.eye(3), vector)[:, 0].copy())
    oracle("fisheye, cv2.fisheye.distortPoints, fp64", result.points[0], expected, 1e-9, scale=FOCAL)
    rays = torch.from_numpy(with_depth(points))[None]
    pinhole = {"focal": torch.full((1, 2), FOCAL).double(), "center": torch.zeros(1, 2).double()}
    projected = project(rays, coefficients(FISHEYE[name]), model="fisheye", **pinhole)
    theirs, _ = cv2.fisheye.projectPoints(rays.numpy(), ZERO, ZERO, np.diag([FOCAL, FOCAL, 1]), vector)
    oracle("fisheye, cv2.fisheye.projectPoints, fp64", projected.points, torch.from_numpy(theirs), 1e-9)
    single = distort(points.float(), coefficients(FISHEYE[name], torch.float32), model="fisheye").points[0]
    oracle("fisheye, cv2.fisheye.distortPoints, fp32", single, expected, 2e-3, scale=FOCAL)
    back = undistort(result.points, coefficients(FISHEYE[name]), model="fisheye")
    assert back.valid.all()
    oracle("fisheye, round trip, fp64", back.points, points, 1e-9, scale=FOCAL)
    pixels = result.points[0].numpy()[:, None]
    theirs = torch.from_numpy(cv2.fisheye.undistortPoints(pixels, np.eye(3), vector, criteria=CRITERIA)[:, 0])
    oracle("fisheye inverse, cv2.fisheye.undistortPoints, fp64", back.points[0], theirs, 1e-6, scale=FOCAL)


@pytest.mark.parametrize("angle", [0.0, 1.2, math.pi / 2, 2.8])
@pytest.mark.parametrize("name", ["tracking", "plain"])
def test_a_fisheye_sees_past_ninety_degrees_but_not_straight_behind(name, angle):
    k, azimuth = FISHEYE[name], 0.7
    ray = (math.sin(angle) * math.cos(azimuth), math.sin(angle) * math.sin(azimuth), math.cos(angle))
    pinhole = {"focal": [[300.0, 310.0]], "center": [[320.0, 240.0]]}
    options = {name: torch.tensor(value, dtype=torch.float64) for name, value in pinhole.items()}
    pixel = project(5 * torch.tensor([[ray]], dtype=torch.float64), coefficients(k), model="fisheye", **options)
    radius = angle * (1 + sum(value * angle ** (2 * i) for i, value in enumerate(k, start=1)))
    expected = (320 + 300 * radius * math.cos(azimuth), 240 + 310 * radius * math.sin(azimuth))
    assert pixel.valid.all()
    assert_close(pixel.points[0, 0].tolist(), list(expected), rtol=0, atol=1e-9)
    back = unproject(pixel.points, coefficients(k), model="fisheye", **options)
    assert back.valid.all()
    assert back.residual.max() < 1e-9
    assert_close(back.points[0, 0].tolist(), list(ray), rtol=0, atol=1e-12)
    behind = project(torch.tensor([[[0.0, 0.0, -1.0]]]).double(), coefficients(k), model="fisheye", **options)
    assert not behind.valid.any()
    assert behind.points.tolist() == [[[320, 240]]]
    # Only rays in front of the plane z = 1 meet it.
    plane = undistort((pixel.points - options["center"]) / options["focal"], coefficients(k), model="fisheye")
    assert plane.valid.item() == (angle < math.pi / 2)


@pytest.mark.parametrize("k", [-0.4, 0.0, 0.2])
def test_the_division_model_is_the_root_of_its_equation(k):
    points = scattered(0.9, 200)
    result = distort(points, coefficients((k,)), model="division")
    assert result.valid.all()
    for (x, y), distorted in zip(points[0].tolist(), result.points[0].tolist(), strict=True):
        r = math.hypot(x, y)
        # x = x_d / (1 + k r_d^2), along the radius.
        r_d = brentq(lambda s, r=r: s - r * (1 + k * s * s), 0.0, 1.58 if k > 0 else 4.0, xtol=1e-15)
        assert math.hypot(*distorted) == pytest.approx(r_d, abs=1e-12)
        assert math.atan2(distorted[1], distorted[0]) == pytest.approx(math.atan2(y, x), abs=1e-12)
    back = undistort(result.points, coefficients((k,)), model="division")
    assert back.valid.all()
    assert_close(back.points, points, rtol=0, atol=1e-13)


def test_the_valid_radius_is_the_first_root_by_numpy():
    generator = torch.Generator().manual_seed(3)
    size = torch.tensor([0.6, 0.4, 1e-3, 1e-3, 0.2, 0.6, 0.4, 0.2]).double()
    vectors = (2 * torch.rand(200, 8, generator=generator).double() - 1) * size
    radii = valid_radius(vectors, model="opencv").tolist()
    poly = np.polynomial.Polynomial
    for c, radius in zip(vectors.tolist(), radii, strict=True):
        numerator, denominator, q = poly([1, c[0], c[1], c[4]]), poly([1, *c[5:8]]), poly([0, 1])
        growth = numerator * denominator + 2 * q * (numerator.deriv() * denominator - numerator * denominator.deriv())
        roots = np.concatenate([growth.roots(), denominator.roots()])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        assert radius == pytest.approx(math.sqrt(min(real, default=math.inf)), rel=1e-6)


FOLDS = [
    ("polynomial12", (-0.3, *(0.0,) * 11), 1 / math.sqrt(0.9), 2 / 3 / math.sqrt(0.9)),
    ("opencv", (0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0), 2.0, 1.0),  # r / (1 + r^2 / 4) turns at 2
    ("fisheye", (-1 / 3, 0.0, 0.0, 0.0), 1.0, 2 / 3),
    ("division", (0.25,), 1.0, 2.0),
]


@pytest.mark.parametrize(("model", "values", "radius", "edge"), FOLDS)
def test_one_coefficient_folds_at_its_closed_form(model, values, radius, edge):
    assert valid_radius(coefficients(values), model=model).item() == pytest.approx(radius, rel=1e-9)
    r_d = torch.linspace(0, 2 * edge, 401).double()
    result = undistort(torch.stack([0.6 * r_d, 0.8 * r_d], dim=1)[None], coefficients(values), model=model)
    clear = (r_d / edge - 1).abs() > 1e-4
    assert torch.equal(result.valid[0, clear], (r_d < edge)[clear])
    assert result.residual[result.valid].max() < 1e-10
    assert result.points.isfinite().all()
    assert not result.points[~result.valid].any()


def test_lenses_without_a_fold_end_at_a_pole_or_never():
    pole = coefficients((0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0))
    assert valid_radius(pole, model="opencv").item() == pytest.approx(2 * (1 - 5e-10), rel=1e-9)
    assert valid_radius(coefficients((0.1, 0.0, 0.0, 0.0)), model="fisheye").item() == pytest.approx(math.pi)
    assert valid_radius(coefficients((-0.25,)), model="division").item() == math.inf


@pytest.mark.parametrize("model", ALL)
def test_gradients_match_finite_differences(model):
    points = scattered(0.7, 3).requires_grad_()
    c = coefficients(ALL[model]).requires_grad_()
    focal = torch.tensor([[3.0, 3.1]]).double().requires_grad_()
    center = torch.tensor([[0.2, -0.1]]).double().requires_grad_()
    rays = torch.cat([points.detach(), torch.full((1, 3, 1), 1.3).double()], dim=2).requires_grad_()
    pixels = torch.cat([2 * points.detach(), center.detach()[None]], dim=1).requires_grad_()
    for function, inputs in ((project, rays), (unproject, pixels)):
        assert torch.autograd.gradcheck(
            lambda p, c, f, e, function=function: function(p, c, focal=f, center=e, model=model).points,
            (inputs, c, focal, center),
            fast_mode=True,
        )


@pytest.mark.parametrize("model", ALL)
def test_gradients_are_finite_where_no_point_exists(model):
    points = torch.tensor([[[0.1, 0.2], [1e3, 0.0], [1e20, 1e20], [math.nan, 0.0], [math.inf, 1.0]]]).double()
    folding = {"polynomial12": (-1.0, *(0.0,) * 11), "opencv": (-1.0, 0.0, 0.0, 0.0), "division": (0.3,)}
    c = coefficients(folding.get(model, (-0.3, 0.0, 0.0, 0.0))).requires_grad_()
    points.requires_grad_()
    for function in (distort, undistort):
        result = function(points, c, model=model)
        assert result.points.isfinite().all()
        assert result.valid[0, 0]
        assert not result.valid[0, 3:].any()
        for gradient in torch.autograd.grad(result.points.sum(), (points, c)):
            assert gradient.isfinite().all()


@pytest.mark.parametrize("model", ALL)
def test_a_camera_does_not_depend_on_the_batch_around_it(model):
    cameras = torch.cat([share * coefficients(ALL[model]) for share in (1.0, 0.5, 0.0)])
    points = torch.cat([scattered(reach, 101) for reach in (0.8, 0.3, 0.6)])
    batch = undistort(points, cameras, model=model)
    for i in range(3):
        single = undistort(points[i : i + 1], cameras[i : i + 1], model=model)
        assert_close(tuple(single), tuple(value[i : i + 1] for value in batch), rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", ALL)
def test_empty_batches_give_empty_results(model):
    c = coefficients(ALL[model])
    for function in (distort, undistort):
        assert function(torch.zeros(1, 0, 2).double(), c, model=model).points.shape == (1, 0, 2)
        assert function(torch.zeros(0, 5, 2).double(), c[:0], model=model).valid.shape == (0, 5)


def test_the_inverse_of_every_published_lens_is_right_or_marked(published, oracle):
    assert len(published) > 50
    for name, camera in published.items():
        pixels = camera.grid(61)
        rays, valid, residual = camera.unproject(pixels)
        assert valid.double().mean() > 0.97, name
        assert residual[valid].max() <= 1e-6, name
        matrix, vector = np.array(camera.matrix), np.array(camera.coefficients)
        rays = rays[valid]
        if camera.model == "fisheye":
            assert torch.atan2(rays[:, :2].norm(dim=1), rays[:, 2]).max() <= camera.valid_radius
            if (rays[:, 2] > 0.05).all():
                theirs = cv2.fisheye.projectPoints(rays[None].numpy(), ZERO, ZERO, matrix, vector)[0][0]
                oracle("published fisheyes, put into cv2.fisheye", torch.from_numpy(theirs), pixels[valid], 1e-6)
        else:
            theirs = cv2.projectPoints(rays.numpy(), ZERO, ZERO, matrix, vector)[0][:, 0]
            oracle("published lenses, put into cv2", torch.from_numpy(theirs), pixels[valid], 1e-6)


@pytest.mark.parametrize(
    ("points", "values", "model", "error", "rule"),
    [
        (torch.zeros(1, 3, 2), (0.0,) * 14, "polynomial12", ValueError, r"\(B, 12\) for the model polynomial12"),
        (torch.zeros(1, 3, 2), (0.0,) * 12, "fisheye", ValueError, r"\(B, 4\) for the model fisheye, got \(1, 12\)"),
        (torch.zeros(1, 3, 2), (0.0,) * 6, "opencv", ValueError, r"\(B, 4 or 5 or 8 or 12 or 14\)"),
        (torch.zeros(1, 3, 2), (0.0,), "brown", ValueError, "model must be one of polynomial12, opencv"),
        (torch.zeros(1, 3, 3), (0.0,), "division", ValueError, r"points must have shape \(1, N, 2\)"),
        (torch.zeros(2, 3, 2), (0.0,), "division", ValueError, r"points must have shape \(1, N, 2\)"),
        (torch.zeros(1, 3, 2).half(), (0.0,), "division", TypeError, "points must be float32 or float64"),
        (torch.zeros(1, 3, 2), (math.nan,), "division", ValueError, "coefficients must be finite, got nan"),
    ],
)
def test_invalid_points_and_coefficients_raise(points, values, model, error, rule):
    with pytest.raises(error, match=rule):
        distort(points, coefficients(values, torch.float32), model=model)


@pytest.mark.parametrize(
    ("focal", "center", "rule"),
    [
        ([1.0, 0.0], [0.0, 0.0], "focal must be positive and finite, got 0"),
        ([1.0], [0.0, 0.0], r"focal must have shape \(1, 2\)"),
        ([1.0, 1.0], [math.inf, 0.0], "center must be finite, got inf"),
    ],
)
def test_invalid_pinholes_raise(focal, center, rule):
    pinhole = {"focal": torch.tensor([focal]), "center": torch.tensor([center])}
    with pytest.raises(ValueError, match=rule):
        unproject(torch.zeros(1, 1, 2), torch.zeros(1, 1), **pinhole, model="division")


def test_methods_of_a_camera_accept_points_with_and_without_a_batch():
    camera = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=23.0, coefficients=(-0.2, 0.05, 0.0, 0.0))
    rays = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(0)).double()
    rays[..., 2] = rays[..., 2].abs() + 2
    both = camera.project(rays)
    theirs = cv2.projectPoints(rays[1].numpy(), ZERO, ZERO, np.array(camera.matrix), np.array(camera.coefficients))[0]
    assert_close(both.points[1], torch.from_numpy(theirs[:, 0]), rtol=0, atol=1e-10)
    assert torch.equal(camera.project(rays[1]).points, both.points[1])
    back = camera.unproject(both.points[0])
    assert_close(back.points, rays[0] / rays[0].norm(dim=1, keepdim=True), rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"points must have shape \(N, n\) or \(B, N, n\)"):
        camera.project(torch.zeros(3))
