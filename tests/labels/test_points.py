import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from torchrefract import warp_points

SIZE = (90, 140)


def newton(displacement, points: Tensor) -> Tensor:
    """Solve q + displacement(q) = p by 60 Newton steps in float64."""
    q, step = points - displacement(points), 1e-5
    for _ in range(60):
        error = q + displacement(q) - points
        columns = [
            (displacement(q + step * axis) - displacement(q - step * axis)) / (2 * step) + axis
            for axis in torch.eye(2, dtype=torch.float64)
        ]
        q = q - torch.linalg.solve(torch.stack(columns, dim=-1), error)
    return q


def inside(points: Tensor, size: tuple[int, int], margin: float = 0.0) -> Tensor:
    x, y = points.unbind(-1)
    return (x >= margin) & (x <= size[1] - 1 - margin) & (y >= margin) & (y <= size[0] - 1 - margin)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("amplitude_px", "length"), [(30.0, 150.0), (5.0, 30.0), (1.0, 8.0)])
def test_points_match_a_newton_solution_of_the_analytic_flow(
    pixels, waves, amplitude_px, length, dtype, random_points, oracle
):
    size = (180, 320)
    flow = waves(*pixels(*size), amplitude_px, length)[0].to(dtype)
    points = random_points(2000, size=size)
    exact = newton(lambda q: waves(q[:, 0], q[:, 1], amplitude_px, length)[0].T, points)
    warped, visible = warp_points(points.to(dtype), flow)
    error = (warped.double() - exact).norm(dim=1)
    assert warped.dtype == dtype
    oracle("points on waves, 60 Newton steps", error[visible], torch.zeros_like(error[visible]), 0.02)
    # Exactly the points outside the frame are invisible.
    assert visible[inside(exact, size, 0.01)].all()
    assert not visible[~inside(exact, size, -0.03)].any()
    assert visible.float().mean() > 0.7


@pytest.mark.quick
def test_zero_flow_returns_the_points_bit_for_bit(random_points):
    points = random_points(3, 50)
    warped, visible = warp_points(points, torch.zeros(3, 2, *SIZE, dtype=torch.float64))
    assert torch.equal(warped, points)
    assert visible.all()


@pytest.mark.quick
def test_points_follow_a_shift_by_whole_pixels(random_points):
    flow = torch.tensor([7.0, -4.0]).view(2, 1, 1).expand(2, *SIZE)
    points = random_points(200).round().float()
    warped, visible = warp_points(points, flow)
    expected = points - torch.tensor([7.0, -4.0])
    assert torch.equal(warped, expected)
    assert torch.equal(visible, inside(expected, SIZE))
    assert 0.5 < visible.float().mean() < 1


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_points_follow_flips_of_the_smallest_frames(size, random_points, flip):
    points = random_points(5, size=size)
    warped, visible = warp_points(points, flip(0, *size))
    assert_close(warped, torch.stack([size[1] - 1 - points[:, 0], points[:, 1]], dim=1), rtol=0, atol=1e-12)
    assert visible.all()


def test_points_solve_a_rough_flow_as_interpolated_bilinearly(random_points):
    flow = torch.randn(2, *SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.2
    points = random_points(500)
    warped, visible = warp_points(points, flow)
    assert visible[inside(points, SIZE, 1.0)].double().mean() > 0.99
    at = warped[visible].flip(1).T.numpy()
    sampled = torch.from_numpy(np.stack([ndimage.map_coordinates(plane.numpy(), at, order=1) for plane in flow]))
    assert (warped[visible] + sampled.T - points[visible]).norm(dim=1).max() <= 0.01


def test_points_on_a_folded_part_of_the_image_are_invisible(pixels, random_points):
    x, y = pixels(40, 200)
    flow = torch.stack([-12.0 * torch.sin(x / 8), 0 * y])
    points = random_points(500, size=(40, 200))
    warped, visible = warp_points(points, flow)
    stretch = 1 - 1.5 * torch.cos(warped[:, 0] / 8)
    # A cell of the flow has one slope, which the analytic flow has up to a pixel away.
    assert (stretch[visible] > -1.5 / 8).all()
    assert warped.isfinite().all()
    assert 0.5 < visible.double().mean() <= 1
    # Between x = 80 and 120 this frame shows its content mirrored and nowhere else.
    mirrored = torch.where((x - 100).abs() < 20, 200 - 2 * x, 0 * x)
    points = torch.stack([torch.linspace(82, 118, 30), torch.full((30,), 20.0)], dim=1).double()
    warped, visible = warp_points(points, torch.stack([mirrored, 0 * y]))
    assert_close(warped[:, 0], 200 - points[:, 0], rtol=0, atol=0.01)
    assert not visible.any()


@pytest.mark.parametrize("invalid", [torch.nan, torch.inf, -torch.inf, 3e38])
def test_points_whose_solution_touches_an_invalid_flow_are_invisible(invalid, random_points):
    flow = torch.full((2, *SIZE), 5.0)
    flow[1] = 0
    flow[:, 20:40, 30:60] = invalid
    points = random_points(2000).float()
    flow.requires_grad_()
    warped, visible = warp_points(points, flow)
    exact = points - torch.tensor([5.0, 0.0])
    assert warped.isfinite().all()
    x, y = exact.T
    weight = torch.minimum(x - 29, 60 - x).clamp(0, 1) * torch.minimum(y - 19, 40 - y).clamp(0, 1)
    assert 0.02 < (weight > 0.001).float().mean() < 0.1
    assert torch.equal(visible, inside(exact, SIZE) & (weight <= 0.001))
    assert_close(warped[visible], exact[visible], rtol=0, atol=1e-4)
    warped.sum().backward()
    assert flow.grad is not None
    assert flow.grad.isfinite().all()


def test_a_flow_without_valid_pixels_shows_no_point(random_points):
    warped, visible = warp_points(random_points(20), torch.full((2, *SIZE), torch.nan))
    assert warped.isfinite().all()
    assert not visible.any()


@pytest.mark.parametrize("far", [1e6, 3e38, -torch.inf, torch.nan])
def test_points_far_outside_the_frame_are_finite_and_invisible(pixels, waves, far):
    flow = waves(*pixels(*SIZE), 3.0, 20.0)[0].float()
    warped, visible = warp_points(torch.tensor([[far, 10.0], [10.0, far], [far, far], [70.0, 40.0]]), flow)
    assert warped.isfinite().all()
    assert visible.tolist() == [False, False, False, True]


def test_a_batch_of_points_equals_its_samples(pixels, waves, random_points):
    flow = torch.cat([waves(*pixels(*SIZE), 8.0, 40.0), torch.full((1, 2, *SIZE), 3.0)]).float()
    points = random_points(2, 37).float()
    batch = warp_points(points, flow)
    for i in range(2):
        assert all(map(torch.equal, warp_points(points[i], flow[i]), (value[i] for value in batch)))
    shared = warp_points(points, flow[:1])[0]
    assert torch.equal(shared, warp_points(points, flow[:1].expand(2, -1, -1, -1))[0])


def test_one_graph_gives_the_points_of_eager_mode(pixels, waves, random_points):
    flow, points = waves(*pixels(*SIZE), 8.0, 40.0).float(), random_points(1, 64).float()
    compiled = torch.compile(warp_points, fullgraph=True, backend="eager")(points, flow, steps=2)
    assert_close(compiled, warp_points(points, flow, steps=2), rtol=0, atol=1e-4)


def test_half_and_integer_points_are_computed_in_single_precision():
    flow = torch.full((1, 2, 8, 2000), 0.25, dtype=torch.float16)
    warped, visible = warp_points(torch.tensor([[[1500.0, 3.0]]], dtype=torch.float16), flow)
    assert warped.tolist() == [[[1499.75, 2.75]]]
    assert visible.all()
    assert warp_points(torch.tensor([[30, 40]]), torch.full((2, *SIZE), 0.5))[0].tolist() == [[29.5, 39.5]]


def test_empty_points_and_batches_stay_empty():
    assert warp_points(torch.zeros(0, 4, 2), torch.zeros(0, 2, *SIZE))[0].shape == (0, 4, 2)
    warped, visible = warp_points(torch.zeros(2, 0, 2), torch.zeros(2, 2, *SIZE))
    assert (warped.shape, visible.shape) == ((2, 0, 2), (2, 0))


FLOW, ONE_FLOW, POINTS = torch.zeros(2, 2, 5, 6), torch.zeros(2, 5, 6), torch.zeros(3, 2)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        (([1.0, 2.0], FLOW), {}, TypeError, "points_xy must be a tensor, got list"),
        ((torch.zeros(2, 3, 3), FLOW), {}, ValueError, r"points_xy must have shape \(B, N, 2\)"),
        ((POINTS, FLOW), {}, ValueError, r"points_xy must have shape \(B, N, 2\)"),
        ((torch.zeros(1, 3, 2), FLOW[None]), {}, ValueError, r"flow must have shape \(B, 2, H, W\)"),
        ((torch.zeros(3, 3, 2), FLOW), {}, ValueError, "flow must have a batch of 1 or 3, as points_xy"),
        ((POINTS.bool(), ONE_FLOW), {}, TypeError, "points_xy must contain real numbers"),
        ((POINTS, ONE_FLOW.long()), {}, TypeError, "flow must be of a floating type"),
        ((POINTS, ONE_FLOW[:, :0]), {}, ValueError, "flow must have at least one pixel"),
        ((POINTS, ONE_FLOW), {"steps": 0}, ValueError, "steps must be at least 1, got 0"),
        ((POINTS, ONE_FLOW), {"tolerance_px": 0.0}, ValueError, "tolerance_px must be above 0"),
    ],
)
def test_invalid_points_and_flows_raise(arguments, options, error, message):
    with pytest.raises(error, match=message):
        warp_points(*arguments, **options)
