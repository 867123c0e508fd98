import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from torchrefract import DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence, warp_points
from torchrefract.cameras.distortion import distort_polynomial

SIZE = (90, 140)


def newton(shift, points: Tensor) -> Tensor:
    """q with q + shift(q) = p by 60 Newton steps in fp64 from p - shift(p)."""
    q, step = points - shift(points), 1e-5
    for _ in range(60):
        error = q + shift(q) - points
        columns = [
            (shift(q + step * way) - shift(q - step * way)) / (2 * step) + way
            for way in torch.eye(2, dtype=torch.float64)
        ]
        q = q - torch.linalg.solve(torch.stack(columns, dim=-1), error)
    return q


def inside(points: Tensor, size: tuple[int, int], margin: float = 0.0) -> Tensor:
    x, y = points.unbind(-1)
    return (x >= margin) & (x <= size[1] - 1 - margin) & (y >= margin) & (y <= size[0] - 1 - margin)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    ("amplitude_px", "length"), [(30.0, 150.0), (12.0, 60.0), (5.0, 30.0), (1.0, 8.0), (0.02, 60.0)]
)
def test_points_land_where_60_newton_steps_on_the_analytic_flow_put_them(
    pixels, waves, amplitude_px, length, dtype, random_points, oracle
):
    size = (180, 320)
    flow = waves(*pixels(*size), amplitude_px, length)[0].to(dtype)
    points = random_points(2000, size=size)
    exact = newton(lambda q: waves(q[:, 0], q[:, 1], amplitude_px, length)[0].T, points)
    assert (exact + waves(exact[:, 0], exact[:, 1], amplitude_px, length)[0].T - points).abs().max() < 1e-9
    landed, visible = warp_points(points.to(dtype), flow)
    error = (landed.double() - exact).norm(dim=1)
    assert landed.dtype == dtype
    what = f"keypoints on waves, 60 Newton steps, {dtype}".replace("torch.float", "fp")
    oracle(what, error[visible], torch.zeros_like(error[visible]), 0.02)
    # What lands off the frame, and that alone, is not seen.
    assert visible[inside(exact, size, 0.01)].all()
    assert not visible[~inside(exact, size, -0.03)].any()
    assert visible.float().mean() > 0.7


@pytest.mark.parametrize("seed", range(4))
def test_points_land_where_the_closed_form_of_the_lens_puts_them(seed, random_points, oracle):
    size = (180, 320)
    degraded = LensDistortion().degrade(torch.zeros(1, 3, *size), seed=seed)
    assert degraded.flow is not None
    points = random_points(2000, size=size, seed=seed)
    params = degraded.params
    middle = torch.tensor([size[1] - 1, size[0] - 1]) / 2 + params.center[0].double() * size[1]
    x, y = ((points - middle) / (params.focal[0].double() * size[1])).T
    distorted = distort_polynomial(x[None], y[None], params.coefficients.double()[..., None])
    exact = torch.cat(distorted).T * params.focal[0].double() * size[1] + middle
    landed, visible = warp_points(points.float()[None], degraded.flow)
    error = (landed[0] - exact).norm(dim=1)
    oracle("keypoints through LensDistortion, closed form", error, torch.zeros_like(error), 0.02)
    assert (exact - points).norm(dim=1).max() > 5
    assert torch.equal(visible[0], inside(exact, size))


@pytest.mark.parametrize("effect", [Turbulence(), ThinPlateSpline(), DivergenceFree()], ids=lambda e: type(e).__name__)
def test_points_land_where_60_newton_steps_on_the_flow_as_scipy_reads_it_put_them(effect, random_points, oracle):
    size = (180, 320)
    flow = effect.degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=1).flow[0]
    points = random_points(500, size=size)

    def shift(q: Tensor) -> Tensor:
        at = q.flip(1).T.numpy()
        planes = [ndimage.map_coordinates(plane.numpy(), at, order=1, mode="nearest") for plane in flow]
        return torch.from_numpy(np.stack(planes, axis=1))

    exact = newton(shift, points)
    # Where a cell's border is the solution, the steps may go to and fro over it.
    found = (exact + shift(exact) - points).norm(dim=1) < 1e-9
    landed, visible = warp_points(points[None], flow[None])
    error = (landed[0] - exact).norm(dim=1)[found & visible[0]]
    assert found.double().mean() > 0.95
    assert visible.double().mean() > 0.8
    assert (exact - points).norm(dim=1).max() > 1
    oracle(f"keypoints through {type(effect).__name__}, 60 Newton steps", error, torch.zeros_like(error), 0.02)


def test_without_a_flow_points_stay_bit_for_bit(random_points):
    points = random_points(3, 50)
    landed, visible = warp_points(points, torch.zeros(3, 2, *SIZE, dtype=torch.float64))
    assert torch.equal(landed, points)
    assert visible.all()


def test_points_follow_a_shift_of_whole_pixels(pixels, random_points):
    flow = torch.tensor([7.0, -4.0]).view(2, 1, 1).expand(2, *SIZE)
    points = random_points(200).round().float()
    landed, visible = warp_points(points, flow)
    expected = points - torch.tensor([7.0, -4.0])
    assert torch.equal(landed, expected)
    assert torch.equal(visible, inside(expected, SIZE))
    assert 0.5 < visible.float().mean() < 1


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_points_follow_flips_and_a_mirror_image_is_no_fold(flip, random_points, axis):
    points = random_points(200)
    points[:4] = torch.tensor([[-3.0, -2.0], [500.0, 10.0], [10.0, 500.0], [-0.5, -0.5]])
    landed, visible = warp_points(points, flip(axis, *SIZE))
    expected = points.clone()
    expected[:, axis] = SIZE[1 - axis] - 1 - points[:, axis]
    assert_close(landed, expected, rtol=0, atol=1e-9)
    assert torch.equal(visible, inside(points, SIZE))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_points_of_the_smallest_frames_follow_flips(size, random_points, flip):
    points = random_points(5, size=size)
    landed, visible = warp_points(points, flip(0, *size))
    assert_close(landed, torch.stack([size[1] - 1 - points[:, 0], points[:, 1]], dim=1), rtol=0, atol=1e-12)
    assert visible.all()


def test_points_land_through_a_rough_flow_on_its_bilinear_reading(random_points):
    flow = torch.randn(2, *SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.2
    points = random_points(500)
    landed, visible = warp_points(points, flow)
    assert visible[inside(points, SIZE, 1.0)].double().mean() > 0.99
    low = landed[visible].floor().clamp(max=torch.tensor([SIZE[1] - 2.0, SIZE[0] - 2.0], dtype=torch.float64))
    tx, ty = (landed[visible] - low).T
    x, y = low.long().T
    above = flow[:, y, x] * (1 - tx) + flow[:, y, x + 1] * tx
    below = flow[:, y + 1, x] * (1 - tx) + flow[:, y + 1, x + 1] * tx
    read = above * (1 - ty) + below * ty
    assert (landed[visible] + read.T - points[visible]).norm(dim=1).max() <= 0.01


def test_points_on_a_sheet_that_is_folded_over_are_not_visible(pixels, random_points):
    x, y = pixels(40, 200)
    flow = torch.stack([-12.0 * torch.sin(x / 8), 0 * y])
    points = random_points(500, size=(40, 200))
    landed, visible = warp_points(points, flow)
    stretch = 1 - 1.5 * torch.cos(landed[:, 0] / 8)
    # Each cell of the flow has one slope, which is that of the analytic flow up to a pixel away.
    assert (stretch[visible] > -1.5 / 8).all()
    assert landed.isfinite().all()
    assert 0.5 < visible.double().mean() <= 1
    # Between x = 80 and 120 this frame shows its middle mirrored, and the points beside it nowhere else.
    mirrored = torch.where((x - 100).abs() < 20, 200 - 2 * x, 0 * x)
    alone = torch.stack([torch.linspace(82, 118, 30), torch.full((30,), 20.0)], dim=1).double()
    landed, visible = warp_points(alone, torch.stack([mirrored, 0 * y]))
    assert_close(landed[:, 0], 200 - alone[:, 0], rtol=0, atol=0.01)
    assert not visible.any()


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf, 3e38])
def test_points_that_a_hole_in_the_flow_would_show_are_not_visible(poison, random_points):
    flow = torch.full((2, *SIZE), 5.0)
    flow[1] = 0
    flow[:, 20:40, 30:60] = poison
    points = random_points(2000).float()
    flow.requires_grad_()
    landed, visible = warp_points(points, flow)
    exact = points - torch.tensor([5.0, 0.0])
    assert landed.isfinite().all()
    x, y = exact.T
    weight = torch.minimum(x - 29, 60 - x).clamp(0, 1) * torch.minimum(y - 19, 40 - y).clamp(0, 1)
    assert 0.02 < (weight > 0.001).float().mean() < 0.1
    assert torch.equal(visible, inside(exact, SIZE) & (weight <= 0.001))
    assert_close(landed[visible], exact[visible], rtol=0, atol=1e-4)
    landed.sum().backward()
    assert flow.grad is not None
    assert flow.grad.isfinite().all()


def test_a_flow_that_is_nowhere_known_shows_nothing(random_points):
    landed, visible = warp_points(random_points(20), torch.full((2, *SIZE), torch.nan))
    assert landed.isfinite().all()
    assert not visible.any()


@pytest.mark.parametrize("far", [1e6, -1e9, 3e38, torch.inf, -torch.inf, torch.nan])
def test_points_far_outside_come_out_finite_and_not_visible(pixels, waves, far):
    flow = waves(*pixels(*SIZE), 3.0, 20.0)[0].float()
    points = torch.tensor([[far, 10.0], [10.0, far], [far, far], [70.0, 40.0]])
    landed, visible = warp_points(points, flow)
    assert landed.isfinite().all()
    assert visible.tolist() == [False, False, False, True]


def test_gradients_of_points_are_those_of_finite_differences(pixels, waves):
    size = (6, 7)
    flow = (waves(*pixels(*size), 0.3, 2.0) + torch.tensor([0.4, -0.2]).view(1, 2, 1, 1)).requires_grad_()
    points = torch.tensor([[[2.3, 2.6], [3.45, 1.7], [4.2, 3.15]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, f: warp_points(p, f, steps=40)[0], [points, flow])


def test_the_gradient_is_not_paid_for_where_nobody_asks(random_points):
    points, flow = random_points(1, 3), torch.zeros(1, 2, *SIZE, dtype=torch.float64)
    assert not warp_points(points, flow)[0].requires_grad
    with torch.no_grad():
        assert not warp_points(points, flow.requires_grad_())[0].requires_grad


def test_a_batch_is_each_sample_alone_bit_for_bit(pixels, waves, random_points):
    x, y = pixels(*SIZE)
    flow = torch.cat([waves(x, y, 8.0, 40.0 + i) for i in range(3)] + [torch.full((1, 2, *SIZE), 3.0)]).float()
    points = random_points(4, 37).float()
    whole = warp_points(points, flow)
    for i in range(4):
        alone = warp_points(points[i], flow[i])
        assert all(torch.equal(one, many[i]) for one, many in zip(alone, whole, strict=True))
    one = warp_points(points, flow[:1])[0]
    assert torch.equal(one, warp_points(points, flow[:1].expand(4, -1, -1, -1))[0])


def test_a_compiled_graph_gives_the_points_of_the_eager_one(pixels, waves, random_points):
    flow = waves(*pixels(*SIZE), 8.0, 40.0).float()
    points = random_points(1, 64).float()
    landed, visible = warp_points(points, flow, steps=6)
    compiled, seen = torch.compile(warp_points, fullgraph=True)(points, flow, steps=6)
    # Fused multiply-adds round once where eager rounds twice.
    assert_close(compiled, landed, rtol=0, atol=1e-4)
    assert torch.equal(seen, visible)


def test_no_value_is_read_where_that_would_wait_for_a_device():
    # Tensors of this device have no values, so that reading one raises.
    points, flow = torch.zeros(2, 3, 2, device="meta"), torch.zeros(2, 2, *SIZE, device="meta")
    landed, visible = warp_points(points, flow)
    assert (landed.shape, visible.shape) == (points.shape, (2, 3))


def test_half_points_are_placed_in_single_precision():
    flow = torch.full((1, 2, 8, 2000), 0.25, dtype=torch.float16)
    landed, visible = warp_points(torch.tensor([[[1500.0, 3.0]]], dtype=torch.float16), flow)
    assert landed.tolist() == [[[1499.75, 2.75]]]
    assert visible.all()


def test_whole_numbers_are_points_too():
    landed, _ = warp_points(torch.tensor([[30, 40]]), torch.full((2, *SIZE), 0.5))
    assert landed.tolist() == [[29.5, 39.5]]


def test_none_of_points_or_samples_stay_none():
    assert warp_points(torch.zeros(0, 4, 2), torch.zeros(0, 2, *SIZE))[0].shape == (0, 4, 2)
    landed, visible = warp_points(torch.zeros(2, 0, 2), torch.zeros(2, 2, *SIZE))
    assert (landed.shape, visible.shape) == ((2, 0, 2), (2, 0))


FLOW = torch.zeros(2, 2, 5, 6)
ONE = torch.zeros(2, 5, 6)


@pytest.mark.parametrize(
    ("call", "kind", "rule"),
    [
        (lambda: warp_points([1.0, 2.0], FLOW), TypeError, "points_xy must be a tensor, got list"),  # pyright: ignore[reportArgumentType]  # the point
        (lambda: warp_points(torch.zeros(2, 3, 3), FLOW), ValueError, r"points_xy must have shape \(B, N, 2\)"),
        (lambda: warp_points(torch.zeros(3, 2), FLOW), ValueError, r"points_xy must have shape \(B, N, 2\)"),
        (lambda: warp_points(torch.zeros(1, 3, 2), FLOW[None]), ValueError, r"flow must have shape \(B, 2, H, W\)"),
        (lambda: warp_points(torch.zeros(3, 3, 2), FLOW), ValueError, "flow must have the batch of points_xy, 3"),
        (lambda: warp_points(torch.zeros(3, 2, dtype=torch.bool), ONE), TypeError, "points_xy must be of real"),
        (lambda: warp_points(torch.zeros(3, 2), ONE.long()), TypeError, "flow must be of a floating type"),
        (lambda: warp_points(torch.zeros(3, 2), ONE[:, :0]), ValueError, "flow must have a pixel"),
        (lambda: warp_points(torch.zeros(3, 2), ONE, steps=0), ValueError, "steps must be at least 1, got 0"),
        (lambda: warp_points(torch.zeros(3, 2), ONE, tolerance_px=0.0), ValueError, "tolerance_px must be above 0"),
    ],
)
def test_what_does_not_fit_raises(call, kind, rule):
    with pytest.raises(kind, match=rule):
        call()
