import json
import math

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from torchrefract.cameras.brown_conrady import (
    POLYNOMIAL12,
    RadialLimit,
    Terms,
    distort_polynomial,
    jacobian_polynomial,
    radial_limit,
    undistort_polynomial,
    used_terms,
)

CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
FOCAL = 2000.0
# Within OpenCV's model too: k4 = k5 = k6 = 0.
LENSES = {
    "barrel": {"k1": -0.25, "k2": 0.09},
    "pincushion": {"k1": 0.3, "k2": -0.05, "k3": 0.02},
    "decentred": {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003},
    "prism": {"k1": -0.1, "k2": 0.02, "s1": 0.01, "s2": -0.004, "s3": -0.006, "s4": 0.003},
    "all": {"k1": -0.3, "k2": 0.15, "k3": -0.02}
    | {"p1": 1e-3, "p2": 2e-3, "s1": 3e-3, "s2": 1e-3, "s3": -2e-3, "s4": 4e-3},
}
HIGH_ORDERS = {
    "k4": {"k4": 0.1},
    "k5": {"k5": -0.02},
    "k6": {"k6": 0.01},
    "all six": {"k1": -0.3, "k2": 0.2, "k3": -0.1, "k4": 0.05, "k5": -0.01, "k6": 0.002},
}


def lens(names: dict[str, float], dtype: torch.dtype = torch.float64) -> Tensor:
    """(1, 12, 1)."""
    return torch.tensor([names.get(name, 0.0) for name in POLYNOMIAL12], dtype=dtype).view(1, 12, 1)


def opencv_vector(names: dict[str, float]) -> np.ndarray:
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    assert not {"k4", "k5", "k6"} & set(names)  # of another model there
    return np.array([names.get(name, 0.0) for name in order])


def points(reach: float = 0.9, count: int = 41) -> tuple[Tensor, Tensor]:
    """x and y, each (1, N), on the plane z = 1, in a frame of 16:9."""
    x, y = torch.linspace(-reach, reach, count).double(), torch.linspace(-reach, reach, count).double() * 9 / 16
    x, y = torch.meshgrid(x, y, indexing="ij")
    return x.reshape(1, -1), y.reshape(1, -1)


def by_opencv(x: Tensor, y: Tensor, names: dict[str, float]) -> tuple[Tensor, Tensor]:
    """The points distorted by cv2.projectPoints at identity pose."""
    space = torch.stack([x[0], y[0], torch.ones_like(x[0])], dim=1).numpy()
    projected, _ = cv2.projectPoints(space, np.zeros(3), np.zeros(3), np.eye(3), opencv_vector(names))
    x_d, y_d = torch.from_numpy(projected[:, 0].T.copy())[:, None]
    return x_d, y_d


def limit_of(c: Tensor, reach: float = 4.0, image_reach: float = 2.0) -> RadialLimit:
    one = c.new_ones(c.shape[0])
    return radial_limit(c, reach * one, image_reach * one)


def radial_growth(k: list[float]) -> np.polynomial.Polynomial:
    """d/dr [r (1 + sum k_i r^2i)] as a polynomial in r^2."""
    return np.polynomial.Polynomial([1.0, *((2 * i + 1) * value for i, value in enumerate(k, start=1))])


@pytest.mark.parametrize("name", LENSES)
def test_distorted_points_agree_with_opencv(name, oracle):
    x, y = points()
    expected = torch.stack(by_opencv(x, y, LENSES[name]))
    found = torch.stack(distort_polynomial(x, y, lens(LENSES[name])))
    oracle("lens forward, cv2.projectPoints, fp64", found, expected, 1e-9, scale=FOCAL)
    found = torch.stack(distort_polynomial(x.float(), y.float(), lens(LENSES[name], torch.float32)))
    oracle("lens forward, cv2.projectPoints, fp32", found, expected, 2e-3, scale=FOCAL)


@pytest.mark.parametrize("name", HIGH_ORDERS)
def test_high_orders_are_a_polynomial_up_to_r12(name):
    x, y = points()
    r = (x.square() + y.square()).sqrt()
    radial = 1 + sum(HIGH_ORDERS[name].get(f"k{i}", 0.0) * r ** (2 * i) for i in range(1, 7))
    assert_close(distort_polynomial(x, y, lens(HIGH_ORDERS[name])), (x * radial, y * radial), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_points_agree_with_opencv(name, oracle):
    x, y = points(0.7)
    observed = torch.stack([x[0], y[0]], dim=1).numpy()[:, None]
    expected = cv2.undistortPoints(observed, np.eye(3), opencv_vector(LENSES[name]), criteria=CRITERIA)[:, 0].T
    c = lens(LENSES[name])
    x_u, y_u, exists = undistort_polynomial(x, y, c, limit=limit_of(c))
    assert exists.all()
    expected = torch.from_numpy(expected.copy())
    oracle("lens inverse, cv2.undistortPoints, fp64", torch.cat([x_u, y_u]), expected, 1e-6, scale=FOCAL)


@pytest.mark.parametrize("name", [*LENSES, *HIGH_ORDERS])
@pytest.mark.parametrize(("dtype", "tolerance_px"), [(torch.float64, 1e-9), (torch.float32, 4e-3)])
def test_what_is_undistorted_distorts_back(name, dtype, tolerance_px, oracle):
    x, y = (p.to(dtype) for p in points(0.7))
    c = lens((LENSES | HIGH_ORDERS)[name], dtype)
    x_u, y_u, exists = undistort_polynomial(x, y, c, limit=limit_of(c))
    assert exists.all()
    back, kind = torch.stack(distort_polynomial(x_u, y_u, c)), str(dtype).replace("torch.float", "fp")
    oracle(f"lens inverse, own round trip, {kind}", back, torch.stack([x, y]), tolerance_px, scale=FOCAL)


@pytest.mark.parametrize("name", HIGH_ORDERS)
def test_high_orders_are_inverted_as_by_a_root_finder(name, oracle):
    k = [HIGH_ORDERS[name].get(f"k{i}", 0.0) for i in range(1, 7)]

    def distorted(r: float) -> float:
        return r * (1 + sum(value * r ** (2 * i) for i, value in enumerate(k, start=1)))

    c = lens(HIGH_ORDERS[name])
    limit = limit_of(c)
    edge = limit.radius.item()
    targets = np.linspace(0.0, 0.99, 60) * min(distorted(edge), 1.0)
    expected = [brentq(lambda r, goal=goal: distorted(r) - goal, 0.0, edge, xtol=1e-15) for goal in targets]
    x_d = torch.from_numpy(targets)[None] * 0.6
    x, y, exists = undistort_polynomial(x_d, x_d / 0.6 * 0.8, c, limit=limit)
    assert exists.all()
    expected = torch.tensor(expected, dtype=torch.float64)[None]
    found = torch.stack([x, y])
    expected = torch.stack([0.6 * expected, 0.8 * expected])
    oracle("lens inverse, brentq in r, fp64", found, expected, 1e-6, scale=FOCAL)


@pytest.mark.parametrize("k1", [1.0, 2.0, 5.0, 10.0])
def test_strong_pincushions_are_inverted_as_by_cardano(k1):
    # k1 r^3 + r = r_d has one real root, 2 a sinh(asinh(r_d / (2 k1 a^3)) / 3) with a = 1 / sqrt(3 k1).
    r_d = torch.linspace(0, 2, 500).double()[None]
    a = 1 / math.sqrt(3 * k1)
    expected = 2 * a * (r_d / (2 * k1 * a**3)).asinh().div(3).sinh()
    c = lens({"k1": k1})
    x, y, exists = undistort_polynomial(0.6 * r_d, -0.8 * r_d, c, limit=limit_of(c))
    assert exists.all()
    assert_close((x, y), (0.6 * expected, -0.8 * expected), rtol=0, atol=1e-9 / FOCAL)


@pytest.mark.parametrize("k1", [-0.05, -0.2, -0.3, -1.0, -100.0])
def test_one_coefficient_folds_at_its_closed_form(k1):
    limit = limit_of(lens({"k1": k1}))
    r_max = 1 / math.sqrt(-3 * k1)
    assert limit.folds.item()
    assert limit.radius.item() == pytest.approx(r_max, rel=1e-6)
    assert limit.image_radius.item() == pytest.approx(2 / 3 * r_max, rel=1e-6)


@pytest.mark.parametrize("k1", [0.0, 0.3, 10.0])
def test_a_lens_that_grows_all_the_way_does_not_fold(k1):
    limit = limit_of(lens({"k1": k1}), reach=3.0)
    assert not limit.folds.item()
    assert limit.radius.item() == 3.0


def test_the_limit_is_the_first_root_of_the_growth():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([0.5, 0.3, 0.2, 0.1, 0.05, 0.02]).double()
    k = (2 * torch.rand(200, 6, generator=generator).double() - 1) * size
    c = torch.cat([k, torch.zeros(200, 6)], dim=1)[..., None]
    limit = limit_of(c, reach=2.0)
    for row, radius, folds in zip(k.tolist(), limit.radius.flatten().tolist(), limit.folds.tolist(), strict=True):
        roots = radial_growth(row).roots()
        real = [math.sqrt(z.real) for z in roots if abs(z.imag) < 1e-9 and z.real > 0]
        first = min((r for r in real if r < 2.0), default=2.0)
        assert folds == (first < 2.0), row
        assert radius == pytest.approx(first, abs=1e-5), row


def test_beyond_the_fold_nothing_exists_and_before_it_everything():
    c = lens({"k1": -0.3})
    r_d = torch.linspace(0, 1.2, 400).double()[None]
    edge = 2 / 3 / math.sqrt(0.9)
    x, y, exists = undistort_polynomial(0.6 * r_d, 0.8 * r_d, c, limit=limit_of(c))
    assert x.isfinite().all()
    assert y.isfinite().all()
    clear = (r_d - edge).abs() > 1e-5
    assert torch.equal(exists[clear], (r_d < edge)[clear])


def test_a_fold_that_decentring_makes_is_not_taken_for_an_inverse():
    # Without radial terms the map is a parabola in x: x_d = x + 3 p2 x^2 on y = 0, which turns at x = -1 / (6 p2).
    c = lens({"p2": 0.2})
    x_d = torch.linspace(-1, 1, 401).double()[None]
    x, _, exists = undistort_polynomial(x_d, torch.zeros_like(x_d), c, limit=limit_of(c))
    turn = -1 / (12 * 0.2)  # the least x_d
    assert not exists[x_d < turn].any()
    assert exists[x_d > 0.85 * turn].all()  # so near to its fold a point may be given up
    expected = (-1 + (1 + 12 * 0.2 * x_d).clamp(min=0).sqrt()) / (6 * 0.2)
    assert_close(x[exists], expected[exists], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", [*LENSES, *HIGH_ORDERS])
def test_the_jacobian_is_that_of_finite_differences(name):
    x, y = points(0.8, 9)
    c, h = lens((LENSES | HIGH_ORDERS)[name]), 1e-6
    jacobian = jacobian_polynomial(x, y, c)
    along_x = [
        (plus - minus) / (2 * h)
        for plus, minus in zip(distort_polynomial(x + h, y, c), distort_polynomial(x - h, y, c), strict=True)
    ]
    along_y = [
        (plus - minus) / (2 * h)
        for plus, minus in zip(distort_polynomial(x, y + h, c), distort_polynomial(x, y - h, c), strict=True)
    ]
    assert_close([jacobian.xx, jacobian.yx, jacobian.xy, jacobian.yy], [*along_x, *along_y], rtol=0, atol=1e-8)
    a, b = jacobian.solve(jacobian.xx * 2 + jacobian.xy * 3, jacobian.yx * 2 + jacobian.yy * 3)
    assert_close((a, b), (torch.full_like(a, 2), torch.full_like(b, 3)), rtol=0, atol=1e-9)


def test_terms_that_are_left_out_are_those_of_zeros():
    x, y = points(0.7, 9)
    names = {"k1": -0.2, "k3": 0.05}
    assert used_terms(lens(names)[..., 0]) == Terms(radial=3, tangential=False, prism=False)
    assert used_terms(lens({"p2": 0.1})[..., 0]) == Terms(radial=0, tangential=True, prism=False)
    assert used_terms(lens({"s3": 0.1})[..., 0]) == Terms(radial=0, tangential=False, prism=True)
    # A coefficient whose gradient is asked for counts, at zero too.
    assert used_terms(lens({})[..., 0].requires_grad_()) == Terms()
    c, few = lens(names), Terms(3, False, False)
    assert torch.equal(torch.stack(distort_polynomial(x, y, c, few)), torch.stack(distort_polynomial(x, y, c)))
    some, all_of_them = (undistort_polynomial(x, y, c, limit=limit_of(c), terms=t) for t in (few, Terms()))
    assert_close(some, all_of_them, rtol=0, atol=1e-12)


def test_every_lens_of_a_batch_is_taken_by_itself():
    x, y = points(0.9, 11)
    c = torch.cat([lens(names) for names in LENSES.values()])
    together = undistort_polynomial(x, y, c, limit=limit_of(c))
    for i in range(len(LENSES)):
        alone = undistort_polynomial(x, y, c[i : i + 1], limit=limit_of(c[i : i + 1]))
        assert_close([t[i : i + 1] for t in together], list(alone), rtol=0, atol=0)


def test_no_published_lens_is_silently_wrong(shared_data):
    published = [row for row in json.loads((shared_data / "lenses.json").read_text()) if row["model"] == "opencv5"]
    assert len(published) >= 10
    for row in published:
        names: dict[str, float] = dict(zip(("k1", "k2", "p1", "p2", "k3"), row["coeffs"], strict=True))
        u, v = torch.meshgrid(
            torch.linspace(0, row["width"] - 1, 97).double(),
            torch.linspace(0, row["height"] - 1, 61).double(),
            indexing="ij",
        )
        x_d = ((u - row["cx"]) / row["fx"]).reshape(1, -1)
        y_d = ((v - row["cy"]) / row["fy"]).reshape(1, -1)
        corner = (x_d.square() + y_d.square()).sqrt().max().item()
        c = lens(names)
        x, y, exists = undistort_polynomial(x_d, y_d, c, limit=limit_of(c, 4 * corner, 1.1 * corner))
        reached_x, reached_y = by_opencv(x, y, names)
        error = torch.maximum((reached_x - x_d).abs() * row["fx"], (reached_y - y_d).abs() * row["fy"])
        assert error[exists].max() <= 1e-6, row["id"]
        # On the first sheet, where the radial part still grows from the center outward.
        r2 = (x.square() + y.square())[exists].numpy()
        growth = radial_growth([names["k1"], names["k2"], names["k3"]])
        for share in np.linspace(0.05, 0.999, 20):
            assert (growth(share * r2) > 0).all(), row["id"]
        # And not refused out of caution: where OpenCV finds a point of that sheet, well off the fold, so do we.
        found = cv2.undistortPoints(
            torch.stack([x_d[0], y_d[0]], dim=1).numpy()[:, None], np.eye(3), opencv_vector(names), criteria=CRITERIA
        )[:, 0]
        theirs_x, theirs_y = torch.from_numpy(found.T.copy())[:, None]
        again_x, again_y = by_opencv(theirs_x, theirs_y, names)
        theirs_r2 = (theirs_x.square() + theirs_y.square()).numpy()
        upright = np.all([growth(share * theirs_r2) > 0.05 for share in np.linspace(0.05, 1, 20)], axis=0)
        solved = torch.from_numpy(upright) & ((again_x - x_d).abs() + (again_y - y_d).abs() < 1e-9)
        assert exists[solved].all(), row["id"]
        assert_close(torch.cat([x, y])[:, solved[0]], torch.cat([theirs_x, theirs_y])[:, solved[0]], rtol=0, atol=1e-8)
