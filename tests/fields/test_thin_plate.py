import pytest
import torch
from scipy.interpolate import RBFInterpolator
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.thin_plate import Spline, check_points, fit_spline, spline_flow
from torchrefract.warping.grid import pixel_axes

HEIGHT, WIDTH = 1080, 1920


def random_points(count: int, seed: int = 0, *, samples: int = 1) -> Tensor:
    """Return (B, N, 2), px, float64, over a frame of full size."""
    unit = torch.rand(samples, count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return unit * torch.tensor([WIDTH - 1.0, HEIGHT - 1.0])


def lattice_points(rows: int, columns: int) -> Tensor:
    y, x = torch.linspace(0, HEIGHT - 1, rows).double(), torch.linspace(0, WIDTH - 1, columns).double()
    return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], dim=-1).view(1, -1, 2)


def random_displacement(points: Tensor, size_px: float = 15.0, seed: int = 1) -> Tensor:
    return size_px * torch.randn(points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def no_smoothing(points: Tensor) -> Tensor:
    return points.new_zeros(points.shape[0])


def flow_at(spline: Spline, points: Tensor) -> Tensor:
    """Return (B, M, 2), px, float64, at points (B, M, 2)."""
    x, y = points.double().mT[..., None].unbind(1)  # each (B, M, 1)
    return spline_flow(spline, x[:, None], y[:, None], dtype=torch.float64)[..., 0].mT


def dense_flow(spline: Spline, height: int, width: int, dtype: torch.dtype) -> Tensor:
    axes = pixel_axes(height, width, dtype=torch.float64, device=spline.points.device)
    return spline_flow(spline, *axes, dtype=dtype)


def sampled_pixels() -> Tensor:
    """Return (1, M, 2): every 60th pixel of the frame along both axes, and the last one."""
    y, x = torch.arange(0, HEIGHT, 60), torch.arange(0, WIDTH, 60)
    y, x = torch.cat([y, torch.tensor([HEIGHT - 1])]), torch.cat([x, torch.tensor([WIDTH - 1])])
    return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1).view(1, -1, 2).double()


def by_scipy(points: Tensor, displacement: Tensor, at: Tensor, smoothing: float = 0.0) -> Tensor:
    """Return (M, 2), px: SciPy's spline of the first sample."""
    # Our smoothing is in units of the extent; SciPy's is in px, where the kernel is scale^2 times as large, apart from
    # a quadratic part that the side conditions cancel.
    scale = (points[0] - points[0].mean(dim=0)).square().sum(dim=1).mean().sqrt().item()
    oracle = RBFInterpolator(
        points[0].numpy(), displacement[0].numpy(), smoothing=smoothing * scale**2, kernel="thin_plate_spline"
    )
    return torch.from_numpy(oracle(at[0].numpy()))


POINTS = {
    "3 random": random_points(3),
    "9 random": random_points(9, 1),
    "3x3": lattice_points(3, 3),
    "25 random": random_points(25, 2),
    "5x5": lattice_points(5, 5),
    "100 random": random_points(100, 3),
    "10x10": lattice_points(10, 10),
}


@pytest.mark.parametrize(("name", "smoothing"), [*zip(POINTS, (0.0, 1e-3, 0.1, 10.0, 0.0, 1e-3, 0.1), strict=True)])
def test_the_flow_is_scipys_thin_plate_spline(name, smoothing, oracle):
    points = POINTS[name]
    displacement = random_displacement(points)
    spline = fit_spline(points, displacement, no_smoothing(points) + smoothing)
    at = torch.cat([sampled_pixels(), points], dim=1)
    found = flow_at(spline, at)[0]
    oracle("thin plate, RBFInterpolator, fp64", found, by_scipy(points, displacement, at, smoothing), 1e-6)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_the_dense_flow_is_scipys_at_full_size(dtype, atol, oracle):
    points = random_points(25, 2)
    displacement = random_displacement(points)
    spline = fit_spline(points.to(dtype), displacement.to(dtype), no_smoothing(points).to(dtype))
    flow = dense_flow(spline, HEIGHT, WIDTH, dtype)
    assert flow.dtype == dtype
    x, y = sampled_pixels()[0].long().unbind(1)
    exact = by_scipy(points.to(dtype).double(), displacement.to(dtype).double(), sampled_pixels())
    bar = min(atol, 1e-6 + exact.abs().max().item() * 1e-7)
    kind = str(dtype).replace("torch.float", "fp")
    oracle(f"thin plate at 1080p, RBFInterpolator, {kind}", flow[0, :, y, x].T, exact, bar)


@pytest.mark.parametrize("size", [(37, 53), (1, 40), (40, 1), (1, 1), (0, 5)])
def test_the_dense_flow_is_the_spline_at_each_pixel(size):
    points = random_points(9, samples=2)
    spline = fit_spline(points, random_displacement(points), no_smoothing(points))
    height, width = size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    at = torch.stack([x, y], dim=-1).view(1, -1, 2).expand(2, -1, -1)
    flow = dense_flow(spline, height, width, torch.float64)
    assert_close(flow, flow_at(spline, at).mT.reshape(2, 2, height, width), rtol=0, atol=1e-12)


@pytest.mark.parametrize("smoothing", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("count", [3, 4, 25, 100])
def test_affine_displacements_are_reproduced_with_any_smoothing(count, smoothing):
    points = random_points(count)
    matrix = torch.tensor([[0.02, -0.05], [0.04, -0.01]], dtype=torch.float64)
    shift = torch.tensor([7.0, -3.0], dtype=torch.float64)
    spline = fit_spline(points, points @ matrix.T + shift, no_smoothing(points) + smoothing)
    at = sampled_pixels()
    assert_close(flow_at(spline, at), at @ matrix.T + shift, rtol=0, atol=1e-9)


def test_the_spline_is_invariant_to_shift_and_scale():
    points = random_points(16)
    displacement = random_displacement(points)
    at = sampled_pixels()
    for smoothing in (0.0, 0.1):
        expected = flow_at(fit_spline(points, displacement, no_smoothing(points) + smoothing), at)
        for scale, shift in ((1e-3, 0.0), (1.0, 1e5), (7.0, -300.0)):
            moved = fit_spline(scale * points + shift, displacement, no_smoothing(points) + smoothing)
            assert_close(flow_at(moved, scale * at + shift), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_of_points_on_pixels_are_finite_and_correct(dtype):
    points = torch.tensor([[[0, 0], [6, 0], [0, 4], [6, 4], [3, 2], [2, 1]]], dtype=dtype)
    displacement = random_displacement(points, 1.0).to(dtype).requires_grad_()
    smoothing = no_smoothing(points).requires_grad_()
    points = points.requires_grad_()

    def flow(points: Tensor, displacement: Tensor, smoothing: Tensor) -> Tensor:
        return dense_flow(fit_spline(points, displacement, smoothing), 5, 7, dtype)

    found = torch.autograd.grad(flow(points, displacement, smoothing).sin().sum(), (points, displacement, smoothing))
    assert all(gradient.isfinite().all() for gradient in found)
    # r^2 ln r has no second derivative there, so differences are off by their step times its logarithm.
    if dtype == torch.float64:
        assert torch.autograd.gradcheck(flow, (points, displacement, smoothing), atol=1e-4)
    # At a control point the flow is its displacement.
    y, x = points[0, :, 1].long(), points[0, :, 0].long()
    at_points = flow(points, displacement, smoothing)[0, :, y, x]
    gradient = torch.autograd.grad(at_points.sum(), displacement)[0]
    assert_close(gradient, torch.ones_like(gradient), rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-10)


def test_the_flow_stores_little_for_its_gradient():
    points = random_points(25).requires_grad_()
    stored = 0

    def count(tensor: Tensor) -> Tensor:
        nonlocal stored
        stored += tensor.numel()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        spline = fit_spline(points, random_displacement(points), no_smoothing(points))
        dense_flow(spline, 200, 300, torch.float32)
    assert stored < 200 * 300


def test_too_few_points_raise():
    for count in (0, 1, 2):
        with pytest.raises(ValueError, match=rf"points must be at least 3 to a sample, got {count}"):
            check_points(torch.rand(2, count, 2))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("count", [3, 30])  # few and many distances are computed in different ways
def test_equal_points_raise(count, dtype):
    points = random_points(count, samples=2).to(dtype)
    check_points(points)
    points[1, 1] = points[1, 0]
    with pytest.raises(ValueError, match="points must differ from one another, got two equal ones"):
        check_points(points)
    with pytest.raises(ValueError, match="points must differ from one another, got two equal ones"):
        check_points(torch.full((1, count, 2), 5.0, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.35)])
@pytest.mark.parametrize("count", [3, 20])
def test_collinear_points_raise(count, direction, dtype):
    at = torch.linspace(-400, 900, count).to(dtype)[:, None] + torch.tensor([0.0]).to(dtype)
    line = (at * torch.tensor(direction, dtype=dtype) + torch.tensor([500.0, 300.0], dtype=dtype))[None]
    points = torch.cat([random_points(count).to(dtype), line])
    with pytest.raises(ValueError, match="points must not lie on one line, got a sample with collinear points"):
        check_points(points)
    # One pixel off the line suffices.
    points[1, 0] += torch.tensor([-direction[1], direction[0]], dtype=dtype)
    check_points(points)


def test_close_points_are_accepted():
    points = random_points(9)
    points[0, 1] = points[0, 0] + 0.01
    displacement = random_displacement(points)
    spline = fit_spline(points, displacement, no_smoothing(points))
    assert_close(flow_at(spline, points), displacement, rtol=0, atol=1e-6)


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
def test_points_that_are_not_finite_raise(poison):
    points = random_points(9)
    points[0, 3, 1] = poison
    with pytest.raises(ValueError, match="points must be finite, got"):
        check_points(points)
