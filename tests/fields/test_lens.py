import math

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from torchrefract import warp
from torchrefract.cameras.brown_conrady import ALL_TERMS, POLYNOMIAL12, Terms
from torchrefract.fields.lens import folds_inside, frame_limit, lens_flow, lens_restore_flow, smooth_lens_flow
from torchrefract.warping.grid import inside

BARREL = {"k1": -0.25, "k2": 0.09, "p1": 1e-3, "p2": -2e-3, "s1": 1e-3, "s2": -1e-3, "s3": 2e-3, "s4": 1e-3}
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
Camera = tuple[Tensor, Tensor, Tensor]


def camera(names: dict[str, float], focal: tuple[float, float], center: tuple[float, float]) -> Camera:
    """Coefficients (1, 12), focal (1, 2) and center (1, 2), fp64."""
    coefficients = [names.get(name, 0.0) for name in POLYNOMIAL12]
    a, b, c = (torch.tensor([row], dtype=torch.float64) for row in (coefficients, focal, center))
    return a, b, c


def small_camera(names: dict[str, float], height: int = 36, width: int = 64) -> Camera:
    return camera(names, (0.8 * width, 0.75 * width), (width / 2 - 1.3, height / 2 + 0.4))


def opencv_camera(names: dict[str, float], at: Camera) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = torch.cat(at[1:], dim=1)[0].tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([names.get(name, 0.0) for name in OPENCV_ORDER])


def by_opencv(u: Tensor, v: Tensor, names: dict[str, float], at: Camera) -> Tensor:
    """(2, H, W), px: where cv2.projectPoints puts the undistorted pixels (u, v)."""
    matrix, vector = opencv_camera(names, at)
    space = np.linalg.solve(matrix, np.stack([u.numpy().ravel(), v.numpy().ravel(), np.ones(u.numel())])).T
    projected, _ = cv2.projectPoints(np.ascontiguousarray(space), np.zeros(3), np.zeros(3), matrix, vector)
    return torch.from_numpy(projected[:, 0].T.copy()).view(2, *u.shape)


def test_the_flow_back_is_where_opencv_projects_every_pixel(pixels):
    x, y = pixels(36, 64)
    at = small_camera(BARREL)
    flow, exists = lens_restore_flow(*at, height=36, width=64)
    assert exists.all()
    assert_close(flow[0], by_opencv(x, y, BARREL, at) - torch.stack([x, y]), rtol=0, atol=1e-9)


def test_the_flow_is_where_opencv_projects_every_pixel_from(pixels):
    x, y = pixels(36, 64)
    at = small_camera(BARREL)
    flow, exists = lens_flow(*at, height=36, width=64)
    assert exists.all()
    # So the frame is seen through the lens: what the clean frame holds at p + flow(p) is shown at p.
    reached = by_opencv(x + flow[0, 0], y + flow[0, 1], BARREL, at)
    assert_close(reached, torch.stack([x, y]), rtol=0, atol=1e-9)
    matrix, vector = opencv_camera(BARREL, at)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    observed = torch.stack([x, y], dim=-1).view(-1, 1, 2).numpy()
    found = cv2.undistortPoints(observed, matrix, vector, P=matrix, criteria=criteria)[:, 0].T
    expected = torch.from_numpy(found.copy()).view(2, 36, 64) - torch.stack([x, y])
    assert_close(flow[0], expected, rtol=0, atol=1e-6)


def test_a_barrel_looks_outward_and_is_undone_by_looking_inward(pixels):
    x, y = pixels(36, 64)
    at = camera({"k1": -0.2}, (60, 60), (31.5, 17.5))
    outward = torch.stack([x - 31.5, y - 17.5])[None]
    assert ((lens_flow(*at, height=36, width=64)[0] * outward).sum(dim=1) > 0).all()
    assert ((lens_restore_flow(*at, height=36, width=64)[0] * outward).sum(dim=1) < 0).all()


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-3), (torch.float32, 1e-3)])
def test_the_dense_flow_back_is_opencvs_map_for_rectifying(pixels, dtype, atol, oracle):
    # OpenCV's map tells for each pixel of the undistorted frame where to look in the distorted one.
    height, width = 720, 1280
    at = small_camera(BARREL, height, width)
    matrix, vector = opencv_camera(BARREL, at)
    maps = cv2.initUndistortRectifyMap(matrix, vector, None, matrix, (width, height), cv2.CV_32FC1)
    flow, _ = lens_restore_flow(*(t.to(dtype) for t in at), height=height, width=width)
    looked_up = flow[0].double() + torch.stack(pixels(height, width))
    kind = str(dtype).replace("torch.float", "fp")
    oracle(f"lens dense map, cv2.initUndistortRectifyMap, {kind}", looked_up, torch.from_numpy(np.stack(maps)), atol)


def test_single_precision_is_right_to_a_fraction_of_a_pixel_at_4k(oracle):
    # Strips that hold the corners and the center stand for the frame.
    height, width = 2160, 3840
    at = camera({"k1": -0.25, "k2": 0.09, "k3": -0.01}, (3000.0, 3000.0), (1925.0, 1070.0))
    for field in (lens_flow, lens_restore_flow):
        for top in (0.0, 1069.0, 2158.0):
            shifted = (at[0], at[1], at[2] - torch.tensor([[0.0, top]]))
            exact, _ = field(*shifted, height=2, width=width)
            single, exists = field(*(t.float() for t in shifted), height=2, width=width)
            assert single.dtype == torch.float32
            assert exists.all()
            oracle(f"{field.__name__} at 4K, fp32 against fp64", single, exact, 2e-3)
    # Four times the farthest corner is as far as preimages are looked for.
    reach = frame_limit(torch.zeros_like(at[0]), *at[1:], height=height, width=width).radius.item()
    assert reach == pytest.approx(4 * math.hypot(1925, 1089) / 3000)


@pytest.mark.parametrize("k1", [1.0, 3.0, 10.0])
def test_strong_pincushions_are_solved_at_every_pixel(pixels, k1):
    at = camera({"k1": k1}, (50.0, 50.0), (31.5, 17.5))
    flow, exists = lens_flow(*at, height=36, width=64)
    assert exists.all()
    x, y = pixels(36, 64)
    r_d = torch.hypot((x - 31.5) / 50, (y - 17.5) / 50)
    radii = [brentq(lambda r, goal=goal: r + k1 * r**3 - goal, 0, 2, xtol=1e-15) for goal in r_d.flatten().tolist()]
    scale = torch.tensor(radii, dtype=torch.float64).view_as(r_d) / r_d - 1
    assert_close(flow[0], torch.stack([(x - 31.5) * scale, (y - 17.5) * scale]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_beyond_the_fold_every_look_up_is_outside_and_marked(pixels, dtype):
    at = tuple(t.to(dtype) for t in camera({"k1": -0.5}, (64.0, 64.0), (31.5, 17.5)))
    x, y = pixels(36, 64)
    r = torch.hypot((x - 31.5) / 64, (y - 17.5) / 64)
    r_max = 1 / math.sqrt(1.5)
    flow, exists = lens_flow(*at, height=36, width=64)
    clear = (r - 2 / 3 * r_max).abs() > 1e-3
    assert torch.equal(exists[0, 0][clear], (r < 2 / 3 * r_max)[clear])
    assert 0 < exists.double().mean() < 1
    assert flow.isfinite().all()
    assert not inside(flow)[~exists].any()
    wide = (at[0], at[1] * 0.5, at[2])
    back, known = lens_restore_flow(*wide, height=36, width=64)
    clear = (2 * r - r_max).abs() > 1e-3
    assert torch.equal(known[0, 0][clear], (2 * r < r_max)[clear])
    assert back.isfinite().all()
    assert not inside(back)[~known].any()
    assert frame_limit(*wide, height=36, width=64).radius.item() == pytest.approx(r_max, rel=1e-5)


@pytest.mark.parametrize(
    ("names", "folds"), [({"k1": -0.3}, True), ({"p2": 0.3}, True), ({"k1": -0.1, "p2": 0.01}, False)]
)
def test_a_fold_inside_the_frame_is_told_from_its_border(names, folds):
    at = camera(names, (40.0, 40.0), (31.5, 17.5))
    assert folds_inside(*at, height=36, width=64).item() == folds
    assert lens_flow(*at, height=36, width=64)[1].all().item() != folds


def test_a_principal_point_far_outside_is_as_good_as_any(pixels):
    x, y = pixels(36, 64)
    at = camera({"k1": 0.05, "p1": 1e-3}, (200.0, 150.0), (-150.0, 90.0))
    flow, exists = lens_flow(*at, height=36, width=64)
    assert exists.all()
    reached = by_opencv(x + flow[0, 0], y + flow[0, 1], {"k1": 0.05, "p1": 1e-3}, at)
    assert_close(reached, torch.stack([x, y]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (0, 9)])
def test_frames_of_one_row_or_less_are_no_special_case(size):
    at = camera({"k1": -0.1, "p1": 1e-3}, (9.0, 9.0), (0.5, -0.5))
    whole, _ = lens_flow(*at, height=9, width=9)
    flow, exists = lens_flow(*at, height=size[0], width=size[1])
    assert flow.shape == (1, 2, *size)
    assert exists.all()
    assert_close(flow, whole[:, :, : size[0], : size[1]], rtol=0, atol=1e-9)


def test_every_lens_of_a_batch_is_taken_by_itself():
    cameras = [small_camera(BARREL), camera({"k6": 0.1}, (50, 60), (30, 20)), camera({}, (40, 40), (31, 17))]
    together = tuple(torch.cat(parts) for parts in zip(*cameras, strict=True))
    for field in (lens_flow, lens_restore_flow):
        flow, exists = field(*together, height=36, width=64)  # pyright: ignore[reportArgumentType]  # of a list
        for i, at in enumerate(cameras):
            alone, known = field(*at, height=36, width=64)
            # To rounding: terms that no lens of a batch has are not computed at all.
            assert_close(flow[i], alone[0], rtol=0, atol=1e-11)
            assert torch.equal(exists[i], known[0])
        assert not flow[2].any()


@pytest.mark.parametrize("field", [lens_flow, lens_restore_flow])
@pytest.mark.parametrize("size", [1e-2, 0.0])
def test_flow_gradients_are_those_of_finite_differences(field, size):
    # At zero too, where descent starts.
    names = {name: size * (-1) ** i * (1 + i / 7) for i, name in enumerate(POLYNOMIAL12)}
    inputs = [t.requires_grad_() for t in camera(names, (7.3, 6.9), (2.6, 1.7))]
    assert torch.autograd.gradcheck(lambda c, f, p: field(c, f, p, height=4, width=6)[0], inputs)


@pytest.mark.parametrize("field", [lens_flow, lens_restore_flow])
def test_image_gradients_are_those_of_finite_differences(field):
    names = {name: 1e-2 * (1 + i / 7) for i, name in enumerate(POLYNOMIAL12)}
    inputs = [t.requires_grad_() for t in camera(names, (5.3, 5.9), (2.63, 1.71))]
    image = torch.rand(1, 2, 4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()

    def warped(image: Tensor, c: Tensor, f: Tensor, p: Tensor) -> Tensor:
        return warp(image, field(c, f, p, height=4, width=6)[0], padding="border")[0]

    assert torch.autograd.gradcheck(warped, [image, *inputs])


@pytest.mark.parametrize(
    "terms",
    [ALL_TERMS, Terms(6, False, False), Terms(2, False, False), Terms(3, True, False), Terms(0, False, True)],
    ids=str,
)
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_nodes_by_a_kernel_are_those_of_newtons_steps(terms, steps, oracle):
    random = torch.Generator().manual_seed(0)
    sizes = 0.1 * torch.tensor([0.4, 0.1, 0.03, 0.01, 0.003, 0.001, 0.03, 0.03, 0.03, 0.01, 0.03, 0.01])
    if not terms.tangential:
        sizes[6:8] = 0  # such a plan has none
    coefficients = sizes * torch.randn(5, 12, generator=random)
    focal, center = 700 + 500 * torch.rand(5, 2, generator=random), 300 + 100 * torch.rand(5, 2, generator=random)
    x, y = torch.arange(-64.0, 1216, 64).view(1, 1, 1, -1), torch.arange(-64.0, 832, 64).view(1, 1, -1, 1)
    numbers = coefficients, focal, center, x, y
    found = smooth_lens_flow(*numbers, steps=steps, terms=terms, large=True)
    exact = smooth_lens_flow(*(own.double() for own in numbers), steps=steps, terms=terms, large=False)
    oracle("nodes of lenses by a kernel", found, exact, 1e-3)
    alone = smooth_lens_flow(coefficients[2:3], focal[2:3], center[2:3], x, y, steps=steps, terms=terms, large=True)
    assert torch.equal(alone[0], found[2])
    learning = coefficients.clone().requires_grad_()
    by_steps = smooth_lens_flow(learning, *numbers[1:], steps=steps, terms=terms, large=True)
    oracle("nodes of lenses by a kernel, Newton's steps", found, by_steps.detach(), 5e-4)
