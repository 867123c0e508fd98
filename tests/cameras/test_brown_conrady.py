import itertools
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
    Terms,
    distort_polynomial,
    distort_with_jacobian,
    newton_undistort,
    undistort_polynomial,
    used_terms,
)
from torchrefract.cameras.radial import RadialLimit, radial_limit

FOCAL = 2000.0
# OpenCV's model is the same polynomial for these, since k4 = k5 = k6 = 0.
LENSES = {
    "barrel": {"k1": -0.25, "k2": 0.09},
    "pincushion": {"k1": 0.3, "k2": -0.05, "k3": 0.02},
    "tangential": {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003},
    "all": {"k1": -0.3, "k2": 0.15, "k3": -0.02}
    | {"p1": 1e-3, "p2": 2e-3, "s1": 3e-3, "s2": 1e-3, "s3": -2e-3, "s4": 4e-3},
}
SIX_TERMS = {"k1": -0.3, "k2": 0.2, "k3": -0.1, "k4": 0.05, "k5": -0.01, "k6": 0.002}


def lens(values: dict[str, float], dtype: torch.dtype = torch.float64) -> Tensor:
    """Return coefficients (1, 12, 1)."""
    return torch.tensor([values.get(name, 0.0) for name in POLYNOMIAL12], dtype=dtype).view(1, 12, 1)


def opencv_vector(values: dict[str, float]) -> np.ndarray:
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    return np.array([values.get(name, 0.0) for name in order])


def points(reach: float = 0.9, count: int = 41) -> tuple[Tensor, Tensor]:
    """Return x and y, each (1, N), on the plane z = 1, in a frame of 16:9."""
    axis = torch.linspace(-reach, reach, count).double()
    x, y = torch.meshgrid(axis, axis * 9 / 16, indexing="ij")
    return x.reshape(1, -1), y.reshape(1, -1)


def opencv_distort(x: Tensor, y: Tensor, values: dict[str, float]) -> Tensor:
    """Distort points by cv2.projectPoints at the identity pose; returns (2, 1, N)."""
    space = torch.stack([x[0], y[0], torch.ones_like(x[0])], dim=1).numpy()
    projected, _ = cv2.projectPoints(space, np.zeros(3), np.zeros(3), np.eye(3), opencv_vector(values))
    return torch.from_numpy(projected[:, 0].T.copy())[:, None]


def limit_of(c: Tensor, reach: float = 4.0, image_reach: float = 2.0) -> RadialLimit:
    ones = c.new_ones(c.shape[0])
    return radial_limit(c, reach * ones, image_reach * ones)


@pytest.mark.quick
@pytest.mark.parametrize("name", LENSES)
def test_distortion_matches_opencv(name, oracle):
    x, y = points()
    expected = opencv_distort(x, y, LENSES[name])
    distorted = torch.stack(distort_polynomial(x, y, lens(LENSES[name])))
    oracle("lens forward, cv2.projectPoints, fp64", distorted, expected, 1e-9, scale=FOCAL)
    distorted = torch.stack(distort_polynomial(x.float(), y.float(), lens(LENSES[name], torch.float32)))
    oracle("lens forward, cv2.projectPoints, fp32", distorted, expected, 2e-3, scale=FOCAL)


@pytest.mark.parametrize("values", [*LENSES.values(), SIX_TERMS], ids=[*LENSES, "six terms"])
@pytest.mark.parametrize(("dtype", "tolerance_px"), [(torch.float64, 1e-9), (torch.float32, 4e-3)])
def test_undistorted_points_distort_back(values, dtype, tolerance_px, oracle):
    x, y = (p.to(dtype) for p in points(0.7))
    c = lens(values, dtype)
    x_u, y_u, exists = undistort_polynomial(x, y, c, limit=limit_of(c))
    assert exists.all()
    back, kind = torch.stack(distort_polynomial(x_u, y_u, c)), str(dtype).replace("torch.float", "fp")
    oracle(f"lens inverse, round trip, {kind}", back, torch.stack([x, y]), tolerance_px, scale=FOCAL)


def test_six_radial_terms_are_inverted_like_by_a_root_finder(oracle):
    def distorted(r: float) -> float:
        return r * (1 + sum(SIX_TERMS[f"k{i}"] * r ** (2 * i) for i in range(1, 7)))

    c = lens(SIX_TERMS)
    limit = limit_of(c)
    edge = limit.radius.item()
    targets = np.linspace(0.0, 0.99, 60) * min(distorted(edge), 1.0)
    roots = [brentq(lambda r, target=target: distorted(r) - target, 0.0, edge, xtol=1e-15) for target in targets]
    r_d, r = torch.from_numpy(targets)[None], torch.tensor(roots, dtype=torch.float64)[None]
    x, y, exists = undistort_polynomial(0.6 * r_d, 0.8 * r_d, c, limit=limit)
    assert exists.all()
    oracle("lens inverse, brentq in r, fp64", torch.stack([x, y]), torch.stack([0.6 * r, 0.8 * r]), 1e-6, scale=FOCAL)


def test_newton_steps_without_a_table_converge_quadratically():
    x, y = points(0.5, 9)
    c = lens(LENSES["all"])
    x_d, y_d = distort_polynomial(x, y, c)
    errors = []
    for steps in range(4):
        x_u, y_u = newton_undistort(x_d, y_d, c, steps=steps)
        errors.append(torch.maximum((x_u - x).abs(), (y_u - y).abs()).max().item())
    assert all(after < 10 * before**2 for before, after in itertools.pairwise(errors) if after > 1e-14)
    assert errors[3] < 1e-9


def test_the_limit_is_the_first_root_of_the_growth():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([0.5, 0.3, 0.2, 0.1, 0.05, 0.02]).double()
    k = (2 * torch.rand(200, 6, generator=generator).double() - 1) * size
    limit = limit_of(torch.cat([k, torch.zeros(200, 6)], dim=1)[..., None], reach=2.0)
    for row, radius in zip(k.tolist(), limit.radius.flatten().tolist(), strict=True):
        # d/dr [r (1 + sum k_i r^2i)] as a polynomial in r^2.
        growth = np.polynomial.Polynomial([1.0, *((2 * i + 1) * value for i, value in enumerate(row, start=1))])
        real = [math.sqrt(z.real) for z in growth.roots() if abs(z.imag) < 1e-9 and z.real > 0]
        first = min((r for r in real if r < 2.0), default=2.0)
        assert radius == pytest.approx(first, abs=1e-5), row


def test_a_fold_by_a_tangential_term_is_marked():
    # Without radial terms the map is a parabola in x: x_d = x + 3 p2 x^2 on y = 0, which turns at x = -1 / (6 p2).
    c = lens({"p2": 0.2})
    x_d = torch.linspace(-1, 1, 401).double()[None]
    x, _, exists = undistort_polynomial(x_d, torch.zeros_like(x_d), c, limit=limit_of(c))
    turn = -1 / (12 * 0.2)  # the smallest x_d
    assert not exists[x_d < turn].any()
    assert exists[x_d > 0.85 * turn].all()  # points closer to the fold may be given up
    expected = (-1 + (1 + 12 * 0.2 * x_d).clamp(min=0).sqrt()) / (6 * 0.2)
    assert_close(x[exists], expected[exists], rtol=0, atol=1e-9)


@pytest.mark.parametrize("values", [LENSES["all"], SIX_TERMS], ids=["all", "six terms"])
def test_the_jacobian_matches_automatic_differentiation(values):
    x, y = (p.requires_grad_() for p in points(0.8, 9))
    c = lens(values)
    x_d, y_d = distort_polynomial(x, y, c)
    expected = [d for value in (x_d, y_d) for d in torch.autograd.grad(value.sum(), (x, y), retain_graph=True)]
    jacobian = distort_with_jacobian(x, y, c)[1]
    assert_close([jacobian.xx, jacobian.xy, jacobian.yx, jacobian.yy], expected, rtol=0, atol=1e-12)


def test_used_terms_are_those_with_coefficients_other_than_zero():
    assert used_terms(lens({"k1": -0.2, "k3": 0.05})[..., 0]) == Terms(radial=3, tangential=False, prism=False)
    assert used_terms(lens({"p2": 0.1})[..., 0]) == Terms(radial=0, tangential=True, prism=False)
    assert used_terms(lens({"s3": 0.1})[..., 0]) == Terms(radial=0, tangential=False, prism=True)
    assert used_terms(lens({})[..., 0].requires_grad_()) == Terms()


def test_skipped_terms_count_as_zero():
    x, y = points(0.7, 9)
    kept = {name: LENSES["all"][name] for name in ("k1", "k2")}
    few = Terms(2, tangential=False, prism=False)
    assert_close(distort_polynomial(x, y, lens(LENSES["all"]), few), distort_polynomial(x, y, lens(kept)))
    c = lens(kept)
    for_few, for_all = (undistort_polynomial(x, y, c, limit=limit_of(c), terms=terms) for terms in (few, Terms()))
    assert_close(for_few, for_all, rtol=0, atol=1e-12)
