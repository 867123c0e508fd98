import math

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from torchrefract.cameras.brown_conrady import ALL_TERMS, POLYNOMIAL12, Terms, distort_polynomial
from torchrefract.fields import lens_error
from torchrefract.fields.lens import frame_limit, lens_flow, lens_restore_flow, misses_in_frame, newton_lens_flow
from torchrefract.warping.grid import Points, inside
from torchrefract.warping.lattice import Lattice, pixel_lattice

BARREL = {"k1": -0.25, "k2": 0.09, "p1": 1e-3, "p2": -2e-3, "s1": 1e-3, "s2": -1e-3, "s3": 2e-3, "s4": 1e-3}
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
Camera = tuple[Tensor, Tensor, Tensor]


def camera(names: dict[str, float], focal: tuple[float, float], center: tuple[float, float]) -> Camera:
    """Return coefficients (1, 12), focal (1, 2) and center (1, 2), float64."""
    coefficients = [names.get(name, 0.0) for name in POLYNOMIAL12]
    a, b, c = (torch.tensor([row], dtype=torch.float64) for row in (coefficients, focal, center))
    return a, b, c


def pixel_points(height: int, width: int, dtype: torch.dtype = torch.float64) -> Points:
    return pixel_lattice(height, width).points(dtype=dtype, device=torch.device("cpu"))


def pixels_of(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return x and y of the pixels, (H, W)."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return x, y


def small_camera(names: dict[str, float], height: int = 36, width: int = 64) -> Camera:
    return camera(names, (0.8 * width, 0.75 * width), (width / 2 - 1.3, height / 2 + 0.4))


def opencv_camera(names: dict[str, float], at: Camera) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = torch.cat(at[1:], dim=1)[0].tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([names.get(name, 0.0) for name in OPENCV_ORDER])


def by_opencv(u: Tensor, v: Tensor, names: dict[str, float], at: Camera) -> Tensor:
    """Distort the pixels (u, v) by cv2.projectPoints -> (2, H, W), px."""
    matrix, vector = opencv_camera(names, at)
    space = np.linalg.solve(matrix, np.stack([u.numpy().ravel(), v.numpy().ravel(), np.ones(u.numel())])).T
    projected, _ = cv2.projectPoints(np.ascontiguousarray(space), np.zeros(3), np.zeros(3), matrix, vector)
    return torch.from_numpy(projected[:, 0].T.copy()).view(2, *u.shape)


def test_the_restore_flow_leads_to_the_projection_of_opencv(pixels):
    x, y = pixels(36, 64)
    at = small_camera(BARREL)
    flow, exists = lens_restore_flow(*at, points=pixel_points(36, 64))
    assert exists.all()
    assert_close(flow[0], by_opencv(x, y, BARREL, at) - torch.stack([x, y]), rtol=0, atol=1e-9)


OUTSIDE = {"k1": 0.05, "p1": 1e-3}, camera({"k1": 0.05, "p1": 1e-3}, (200.0, 150.0), (-150.0, 90.0))


@pytest.mark.parametrize(("names", "at"), [(BARREL, small_camera(BARREL)), OUTSIDE], ids=["barrel", "center outside"])
def test_the_flow_inverts_the_projection_of_opencv(pixels, names, at):
    x, y = pixels(36, 64)
    flow, exists = lens_flow(*at, points=pixel_points(36, 64))
    assert exists.all()
    # The lens shows the clean pixel p + flow(p) at p.
    reached = by_opencv(x + flow[0, 0], y + flow[0, 1], names, at)
    assert_close(reached, torch.stack([x, y]), rtol=0, atol=1e-9)
    matrix, vector = opencv_camera(names, at)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    observed = torch.stack([x, y], dim=-1).view(-1, 1, 2).numpy()
    undistorted = cv2.undistortPoints(observed, matrix, vector, P=matrix, criteria=criteria)[:, 0].T
    expected = torch.from_numpy(undistorted.copy()).view(2, 36, 64) - torch.stack([x, y])
    assert_close(flow[0], expected, rtol=0, atol=1e-6)


def test_single_precision_is_off_by_less_than_2_thousandths_of_a_pixel_at_4k(oracle):
    # Strips with the corners and the center represent the frame.
    height, width = 2160, 3840
    at = camera({"k1": -0.25, "k2": 0.09, "k3": -0.01}, (3000.0, 3000.0), (1925.0, 1070.0))
    for field in (lens_flow, lens_restore_flow):
        for top in (0.0, 1069.0, 2158.0):
            shifted = (at[0], at[1], at[2] - torch.tensor([[0.0, top]]))
            exact, _ = field(*shifted, points=pixel_points(2, width))
            single, exists = field(*(t.float() for t in shifted), points=pixel_points(2, width, torch.float32))
            assert single.dtype == torch.float32
            assert exists.all()
            oracle(f"{field.__name__} at 4K, fp32 against fp64", single, exact, 2e-3)
    # Preimages are searched up to four times the farthest corner.
    reach = frame_limit(torch.zeros_like(at[0]), *at[1:], height=height, width=width).radius.item()
    assert reach == pytest.approx(4 * math.hypot(1925, 1089) / 3000)


@pytest.mark.quick
@pytest.mark.parametrize("seed", range(6))
def test_strong_prisms_are_solved_in_single_precision_as_in_double(seed):
    dice = torch.Generator().manual_seed(seed)
    size = {"k1": 0.05, "p1": 0.02, "p2": 0.005, "s2": 0.02, "s4": 0.03}
    numbers = 2 * torch.rand(len(size), generator=dice) - 1
    names = {name: most * number for (name, most), number in zip(size.items(), numbers.tolist(), strict=True)}
    at = camera(names, (50.0, 55.0), (33.0, 109.0))  # the corners lie at 2.2 focal lengths
    double, exists = lens_flow(*at, points=pixel_points(223, 68))
    single, single_exists = lens_flow(*(t.float() for t in at), points=pixel_points(223, 68, torch.float32))
    assert not (single_exists & ~exists).any()
    assert (exists & ~single_exists).double().mean() < 0.01  # those near a fold
    rounding_px = 40 * 2.0**-24 * 223
    assert (single - double).abs()[single_exists.expand(-1, 2, -1, -1)].max() < rounding_px
    flow = double.where(exists, torch.nan)
    x, y = (torch.stack(pixels_of(223, 68)) + flow[0]).unbind(0)
    back = by_opencv(x.nan_to_num(33.0), y.nan_to_num(109.0), names, at)
    assert (back - torch.stack(pixels_of(223, 68))).abs()[exists[0].expand(2, -1, -1)].max() < 1e-6


@pytest.mark.quick
@pytest.mark.parametrize("k1", [1.0, 3.0, 10.0])
def test_strong_pincushions_are_solved_at_every_pixel(pixels, k1):
    at = camera({"k1": k1}, (50.0, 50.0), (31.5, 17.5))
    flow, exists = lens_flow(*at, points=pixel_points(36, 64))
    assert exists.all()
    x, y = pixels(36, 64)
    r_d = torch.hypot((x - 31.5) / 50, (y - 17.5) / 50)
    radii = [brentq(lambda r, goal=goal: r + k1 * r**3 - goal, 0, 2, xtol=1e-15) for goal in r_d.flatten().tolist()]
    scale = torch.tensor(radii, dtype=torch.float64).view_as(r_d) / r_d - 1
    assert_close(flow[0], torch.stack([(x - 31.5) * scale, (y - 17.5) * scale]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_beyond_the_fold_positions_are_outside_and_masked(pixels, dtype):
    at = tuple(t.to(dtype) for t in camera({"k1": -0.5}, (64.0, 64.0), (31.5, 17.5)))
    x, y = pixels(36, 64)
    r = torch.hypot((x - 31.5) / 64, (y - 17.5) / 64)
    r_max = 1 / math.sqrt(1.5)
    flow, exists = lens_flow(*at, points=pixel_points(36, 64, dtype))
    # The determinant (1 - q / 2) (1 - 3 q / 2), q = r^2, is zero at the fold and 1/32 where single precision ends.
    smallest = 1 / 32 if dtype is torch.float32 else 0
    q = (2 - math.sqrt(1 + 3 * smallest)) / 1.5
    r_last = math.sqrt(q) * (1 - q / 2)
    clear = (r - r_last).abs() > 1e-3
    assert torch.equal(exists[0, 0][clear], (r < r_last)[clear])
    assert 0 < exists.double().mean() < 1
    assert flow.isfinite().all()
    assert not inside(flow)[~exists].any()
    wide = (at[0], at[1] * 0.5, at[2])
    back, restore_exists = lens_restore_flow(*wide, points=pixel_points(36, 64, dtype))
    clear = (2 * r - r_max).abs() > 1e-3
    assert torch.equal(restore_exists[0, 0][clear], (2 * r < r_max)[clear])
    assert back.isfinite().all()
    assert not inside(back)[~restore_exists].any()
    assert frame_limit(*wide, height=36, width=64).radius.item() == pytest.approx(r_max, rel=1e-5)


@pytest.mark.parametrize(
    ("names", "misses"),
    [
        ({"k1": -0.3}, True),
        ({"p2": 0.3}, True),
        ({"k1": -0.1, "p2": 0.01}, False),
        ({"k1": -0.6, "k2": 0.17}, True),  # a ring that is magnified by 32 or more
    ],
)
def test_a_point_without_a_preimage_counts_inside_the_frame_alone(names, misses):
    coefficients, focal, center = (value.float() for value in camera(names, (40.0, 40.0), (31.5, 17.5)))
    points = pixel_points(36, 64, torch.float32)
    exists = lens_flow(coefficients, focal, center, points)[1]
    assert exists.all().item() != misses
    assert misses_in_frame(exists, points).item() == misses
    outside = points.displaced(torch.full((1, 2, 36, 64), 64.0))
    assert not misses_in_frame(exists, outside).item()


some_terms = pytest.mark.parametrize(
    "terms",
    [ALL_TERMS, Terms(6, False, False), Terms(2, False, False), Terms(3, True, False), Terms(0, False, True)],
    ids=str,
)


def random_lenses(terms: Terms, scale: float) -> tuple[Tensor, Tensor, Tensor]:
    """Draw the coefficients, focal lengths and centers of five lenses that have only `terms`."""
    random = torch.Generator().manual_seed(0)
    sizes = scale * torch.tensor([0.4, 0.1, 0.03, 0.01, 0.003, 0.001, 0.03, 0.03, 0.03, 0.01, 0.03, 0.01])
    sizes[terms.radial : 6] = 0
    sizes[6:8] *= terms.tangential
    sizes[8:] *= terms.prism
    return (
        sizes * torch.randn(5, 12, generator=random),
        700 + 500 * torch.rand(5, 2, generator=random),
        300 + 100 * torch.rand(5, 2, generator=random),
    )


@some_terms
def test_newton_steps_at_nodes_converge_to_the_flow(terms, oracle):
    lens = random_lenses(terms, scale=0.02)
    points = Lattice(720, 1280, 64, 1).points(dtype=torch.float32, device=torch.device("cpu"))
    exact, exists = lens_flow(lens[0].double(), lens[1].double(), lens[2].double(), points)
    assert exists.all()
    flow = newton_lens_flow(*lens, points, num_steps=6, terms=terms)
    oracle("lens flow at nodes by 6 Newton steps", flow, exact, 1e-3)
    single = newton_lens_flow(lens[0][2:3], lens[1][2:3], lens[2][2:3], points, num_steps=6, terms=terms)
    assert_close(single[0], flow[2], rtol=0, atol=1e-4)
    # The first guess alone is worse, and each step improves it.
    errors = [
        (newton_lens_flow(*lens, points, num_steps=steps, terms=terms) - exact).abs().amax().item()
        for steps in (0, 1, 3)
    ]
    assert errors[0] >= errors[1] >= errors[2] - 1e-4


@some_terms
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_newton_steps_at_nodes_of_strong_lenses_round_little(terms, steps, oracle):
    # Some of these lenses fold, so there is no inverse to compare with: the same steps in float64 are the oracle.
    lens = random_lenses(terms, scale=0.1)
    lattice, cpu = Lattice(720, 1280, 64, 1), torch.device("cpu")
    points = lattice.points(dtype=torch.float64, device=cpu)
    coefficients, focal, center = lens
    exact = newton_lens_flow(
        coefficients.double(), focal.double(), center.double(), points, num_steps=steps, terms=terms
    )
    assert exact.dtype == torch.float64
    flow = newton_lens_flow(*lens, lattice.points(dtype=torch.float32, device=cpu), num_steps=steps, terms=terms)
    oracle("lens flow at nodes of strong lenses", flow, exact, 1e-3)


def test_newton_steps_that_measure_the_errors_end_in_the_inverse_at_every_point(oracle):
    barrel = torch.tensor([BARREL.get(name, 0.0) for name in POLYNOMIAL12], dtype=torch.float64).view(1, 12, 1)
    coefficients = torch.cat([barrel, 0 * barrel, -1.2 * barrel])  # each needs another number of steps
    side = torch.linspace(-0.9, 0.9, 9, dtype=torch.float64)
    x, y = (axis.flatten().expand(3, -1) for axis in torch.meshgrid(side, side, indexing="ij"))
    iterates = lens_error._solve(x, y, coefficients)
    assert iterates is not None
    back = distort_polynomial(*iterates[-1], coefficients)
    oracle("measured inverse", torch.stack(back), torch.stack([x, y]), 1e-12, unit="focal lengths")
