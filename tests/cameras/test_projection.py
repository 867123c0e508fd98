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


@pytest.mark.parametrize("name", OPENCV)
def test_opencvs_model_agrees_with_opencv_both_ways(name, oracle):
    points, vector = scattered(0.8), np.array(OPENCV[name])
    theirs, _ = cv2.projectPoints(with_depth(points), ZERO, ZERO, np.eye(3), vector)
    expected = torch.from_numpy(theirs[:, 0].copy())[None]
    for kind, dtype, bar in (("fp64", torch.float64, 1e-9), ("fp32", torch.float32, 2e-3)):
        made = distort(points.to(dtype), coefficients(OPENCV[name], dtype), model="opencv")
        assert made.valid.all()
        oracle(f"opencv model, cv2.projectPoints, {kind}", made.points, expected, bar, scale=FOCAL)
    back = undistort(expected, coefficients(OPENCV[name]), model="opencv")
    assert back.valid.all()
    oracle("opencv model, own round trip, fp64", back.points, points, 1e-9, scale=FOCAL)
    theirs = cv2.undistortPoints(expected[0].numpy()[:, None], np.eye(3), vector, criteria=CRITERIA)
    found = torch.from_numpy(theirs[:, 0].copy())[None]
    oracle("opencv model inverse, cv2.undistortPoints, fp64", back.points, found, 1e-6, scale=FOCAL)


@pytest.mark.parametrize("name", FISHEYE)
def test_a_fisheye_agrees_with_opencv_both_ways(name, oracle):
    points, vector = scattered(1.6), np.array(FISHEYE[name])
    made = distort(points, coefficients(FISHEYE[name]), model="fisheye")
    assert made.valid.all()
    expected = torch.from_numpy(cv2.fisheye.distortPoints(points[0].numpy()[:, None], np.eye(3), vector)[:, 0].copy())
    oracle("fisheye, cv2.fisheye.distortPoints, fp64", made.points[0], expected, 1e-9, scale=FOCAL)
    rays = torch.from_numpy(with_depth(points))[None]
    pinhole = {"focal": torch.full((1, 2), FOCAL).double(), "center": torch.zeros(1, 2).double()}
    projected = project(rays, coefficients(FISHEYE[name]), model="fisheye", **pinhole)
    theirs, _ = cv2.fisheye.projectPoints(rays.numpy(), ZERO, ZERO, np.diag([FOCAL, FOCAL, 1]), vector)
    oracle("fisheye, cv2.fisheye.projectPoints, fp64", projected.points, torch.from_numpy(theirs), 1e-9)
    single = distort(points.float(), coefficients(FISHEYE[name], torch.float32), model="fisheye").points[0]
    oracle("fisheye, cv2.fisheye.distortPoints, fp32", single, expected, 2e-3, scale=FOCAL)
    back = undistort(made.points, coefficients(FISHEYE[name]), model="fisheye")
    assert back.valid.all()
    oracle("fisheye, own round trip, fp64", back.points, points, 1e-9, scale=FOCAL)
    seen = made.points[0].numpy()[:, None]
    theirs = cv2.fisheye.undistortPoints(seen, np.eye(3), vector, criteria=CRITERIA)[:, 0]
    oracle(
        "fisheye inverse, cv2.fisheye.undistortPoints, fp64",
        back.points[0],
        torch.from_numpy(theirs),
        1e-6,
        scale=FOCAL,
    )


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, math.pi / 2, 1.9, 2.8])
@pytest.mark.parametrize("name", ["tracking", "plain"])
def test_a_fisheye_sees_past_ninety_degrees(name, angle):
    k, around = FISHEYE[name], 0.7
    ray = (math.sin(angle) * math.cos(around), math.sin(angle) * math.sin(around), math.cos(angle))
    pinhole = {"focal": [[300.0, 310.0]], "center": [[320.0, 240.0]]}
    options = {name: torch.tensor(value, dtype=torch.float64) for name, value in pinhole.items()}
    seen = project(5 * torch.tensor([[ray]], dtype=torch.float64), coefficients(k), model="fisheye", **options)
    radius = angle * (1 + sum(value * angle ** (2 * i) for i, value in enumerate(k, start=1)))
    expected = (320 + 300 * radius * math.cos(around), 240 + 310 * radius * math.sin(around))
    assert seen.valid.all()
    assert_close(seen.points[0, 0].tolist(), list(expected), rtol=0, atol=1e-9)
    back = unproject(seen.points, coefficients(k), model="fisheye", **options)
    assert back.valid.all()
    assert back.residual.max() < 1e-9
    assert_close(back.points[0, 0].tolist(), list(ray), rtol=0, atol=1e-12)
    # On the plane z = 1 only what is in front of it has a place.
    plane = undistort((seen.points - options["center"]) / options["focal"], coefficients(k), model="fisheye")
    assert plane.valid.item() == (angle < math.pi / 2)


def test_straight_behind_a_fisheye_there_is_no_direction():
    options = {"focal": torch.ones(1, 2).double(), "center": torch.zeros(1, 2).double()}
    ray = torch.tensor([[[0.0, 0.0, -1.0]]]).double()
    seen = project(ray, coefficients(FISHEYE["plain"]), model="fisheye", **options)
    assert not seen.valid.any()
    assert torch.equal(seen.points, torch.zeros(1, 1, 2).double())


@pytest.mark.parametrize("k", [-0.4, -0.05, 0.0, 0.1, 0.2])
def test_the_division_model_is_the_root_of_its_equation(k):
    points = scattered(0.9, 200)
    made = distort(points, coefficients((k,)), model="division")
    assert made.valid.all()
    for (x, y), found in zip(points[0].tolist(), made.points[0].tolist(), strict=True):
        r = math.hypot(x, y)
        # x = x_d / (1 + k r_d^2), read along the radius.
        r_d = brentq(lambda s, r=r: s - r * (1 + k * s * s), 0.0, 1.58 if k > 0 else 4.0, xtol=1e-15)
        assert math.hypot(*found) == pytest.approx(r_d, abs=1e-12)
        assert math.atan2(found[1], found[0]) == pytest.approx(math.atan2(y, x), abs=1e-12)
    back = undistort(made.points, coefficients((k,)), model="division")
    assert back.valid.all()
    assert_close(back.points, points, rtol=0, atol=1e-13)


def test_the_valid_radius_is_the_first_root_by_numpy():
    generator = torch.Generator().manual_seed(3)
    size = torch.tensor([0.6, 0.4, 1e-3, 1e-3, 0.2, 0.6, 0.4, 0.2]).double()
    vectors = (2 * torch.rand(200, 8, generator=generator).double() - 1) * size
    found = valid_radius(vectors, model="opencv").tolist()
    poly = np.polynomial.Polynomial
    for c, radius in zip(vectors.tolist(), found, strict=True):
        above, below, q = poly([1, c[0], c[1], c[4]]), poly([1, *c[5:8]]), poly([0, 1])
        growth = above * below + 2 * q * (above.deriv() * below - above * below.deriv())
        roots = np.concatenate([growth.roots(), below.roots()])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        assert radius == pytest.approx(math.sqrt(min(real, default=math.inf)), rel=1e-6)


@pytest.mark.parametrize(
    ("model", "values", "radius"),
    [
        ("polynomial12", (-0.3, *(0.0,) * 11), 1 / math.sqrt(0.9)),
        ("opencv", (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2 * (1 - 5e-10)),  # the pole
        ("opencv", (0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0), 2.0),  # r / (1 + r^2 / 4) turns at 2
        ("fisheye", (-1 / 3, 0.0, 0.0, 0.0), 1.0),
        ("fisheye", (0.1, 0.0, 0.0, 0.0), math.pi),
        ("division", (0.25,), 1.0),
        ("division", (-0.25,), math.inf),
    ],
)
def test_one_coefficient_turns_at_its_closed_form(model, values, radius):
    assert valid_radius(coefficients(values), model=model).item() == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize(
    ("model", "values", "edge"),
    [
        ("polynomial12", (-0.3, *(0.0,) * 11), 2 / 3 / math.sqrt(0.9)),
        ("opencv", (0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0), 1.0),
        ("fisheye", (-1 / 3, 0.0, 0.0, 0.0), 2 / 3),
        ("division", (0.25,), 2.0),
    ],
)
def test_beyond_the_fold_there_is_no_point_and_before_it_every_one(model, values, edge):
    r_d = torch.linspace(0, 2 * edge, 401).double()
    made = undistort(torch.stack([0.6 * r_d, 0.8 * r_d], dim=1)[None], coefficients(values), model=model)
    clear = (r_d / edge - 1).abs() > 1e-4
    assert torch.equal(made.valid[0, clear], (r_d < edge)[clear])
    assert made.residual[made.valid].max() < 1e-10
    assert made.points.isfinite().all()
    assert not made.points[~made.valid].any()


@pytest.mark.parametrize("model", ALL)
def test_gradients_are_those_of_finite_differences(model):
    points = scattered(0.7, 9).requires_grad_()
    c = coefficients(ALL[model]).requires_grad_()
    focal = torch.tensor([[3.0, 3.1]]).double().requires_grad_()
    center = torch.tensor([[0.2, -0.1]]).double().requires_grad_()
    rays = torch.cat([points.detach(), torch.full((1, 9, 1), 1.3).double()], dim=2).requires_grad_()
    pixels = torch.cat([2 * points.detach(), center.detach()[None]], dim=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, c: distort(p, c, model=model).points, (points, c))
    assert torch.autograd.gradcheck(lambda p, c: undistort(p, c, model=model).points, (points, c))
    for function, inputs in ((project, rays), (unproject, pixels)):
        assert torch.autograd.gradcheck(
            lambda p, c, f, e, function=function: function(p, c, focal=f, center=e, model=model).points,
            (inputs, c, focal, center),
        )


@pytest.mark.parametrize("model", ALL)
def test_gradients_are_finite_where_there_is_no_point(model):
    points = torch.tensor([[[0.1, 0.2], [1e3, 0.0], [1e20, 1e20], [math.nan, 0.0], [math.inf, 1.0]]]).double()
    folding = {"polynomial12": (-1.0, *(0.0,) * 11), "opencv": (-1.0, 0.0, 0.0, 0.0), "division": (0.3,)}
    c = coefficients(folding.get(model, (-0.3, 0.0, 0.0, 0.0))).requires_grad_()
    points.requires_grad_()
    for function in (distort, undistort):
        made = function(points, c, model=model)
        assert made.points.isfinite().all()
        assert made.valid[0, 0]
        assert not made.valid[0, 3:].any()
        for gradient in torch.autograd.grad(made.points.sum(), (points, c)):
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
def test_no_points_and_no_cameras_are_no_special_case(model):
    c = coefficients(ALL[model])
    for function in (distort, undistort):
        assert function(torch.zeros(1, 0, 2).double(), c, model=model).points.shape == (1, 0, 2)
        assert function(torch.zeros(0, 5, 2).double(), c[:0], model=model).valid.shape == (0, 5)


@pytest.mark.parametrize("model", ALL)
def test_a_focal_length_and_two_coefficients_are_found_from_correspondences(model):
    truth = {"polynomial12": 12, "opencv": 8, "fisheye": 4, "division": 1}[model] * [0.0]
    truth[: min(2, len(truth))] = (-0.27, 0.09)[: len(truth)]
    generator = torch.Generator().manual_seed(5)
    rays = torch.cat([scattered(0.7, 300), torch.ones(1, 300, 1).double()], dim=2)
    rays = rays * (1 + torch.rand(1, 300, 1, generator=generator).double())
    center = torch.tensor([[318.0, 243.0]]).double()

    def seen(focal: Tensor, k: Tensor) -> Tensor:
        c = torch.cat([k, k.new_zeros(len(truth) - len(k))])[None]
        return project(rays, c, focal=focal.expand(1, 2), center=center, model=model).points

    k_true = torch.tensor(truth[:2]).double()
    pixels = seen(torch.tensor(512.0).double(), k_true)
    focal, k = torch.tensor(5.5).double().requires_grad_(), torch.zeros_like(k_true).requires_grad_()
    optimizer = torch.optim.LBFGS([focal, k], max_iter=200, line_search_fn="strong_wolfe", tolerance_change=1e-15)

    def loss() -> float:
        optimizer.zero_grad()
        value = (seen(100 * focal, k) - pixels).square().mean()
        value.backward()
        return value.item()

    optimizer.step(loss)
    assert 100 * focal.item() == pytest.approx(512.0, abs=0.01)
    assert_close(k.detach(), k_true, rtol=0, atol=1e-4)


def test_the_inverse_of_every_published_lens_is_right_or_marked(published, oracle):
    assert len(published) > 50
    for name, camera in published.items():
        pixels = camera.grid(61)
        rays, valid, residual = camera.unproject(pixels)
        assert valid.double().mean() > 0.97, name
        assert residual[valid].max() <= 1e-6, name
        matrix, vector = np.array(camera.matrix), np.array(camera.coefficients)
        seen = rays[valid]
        if camera.model == "fisheye":
            assert torch.atan2(seen[:, :2].norm(dim=1), seen[:, 2]).max() <= camera.valid_radius
            if (seen[:, 2] > 0.05).all():
                theirs = cv2.fisheye.projectPoints(seen[None].numpy(), ZERO, ZERO, matrix, vector)[0][0]
                oracle("published fisheyes, put into cv2.fisheye", torch.from_numpy(theirs), pixels[valid], 1e-6)
        else:
            theirs = cv2.projectPoints(seen.numpy(), ZERO, ZERO, matrix, vector)[0][:, 0]
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
def test_what_does_not_fit_raises(points, values, model, error, rule):
    with pytest.raises(error, match=rule):
        distort(points, coefficients(values, torch.float32), model=model)


@pytest.mark.parametrize(
    ("focal", "center", "rule"),
    [
        (torch.tensor([[1.0, 0.0]]), torch.zeros(1, 2), "focal must be positive and finite, got 0"),
        (torch.ones(1, 1), torch.zeros(1, 2), r"focal must have shape \(1, 2\)"),
        (torch.ones(1, 2), torch.full((1, 2), math.inf), "center must be finite, got inf"),
    ],
)
def test_what_is_no_pinhole_raises(focal, center, rule):
    with pytest.raises(ValueError, match=rule):
        unproject(torch.zeros(1, 1, 2), torch.zeros(1, 1), focal=focal, center=center, model="division")


def test_a_camera_takes_points_with_and_without_a_batch():
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
