import pytest
import torch
from scipy.interpolate import RBFInterpolator
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.spline import check_points, evaluate_spline, fit_spline, spline_flow

HEIGHT, WIDTH = 1080, 1920


def random_points(count: int, seed: int = 0, *, samples: int = 1) -> Tensor:
    """(B, N, 2), px, fp64, over a frame of full size."""
    unit = torch.rand(samples, count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return unit * torch.tensor([WIDTH - 1.0, HEIGHT - 1.0])


def lattice_points(rows: int, columns: int) -> Tensor:
    y, x = torch.linspace(0, HEIGHT - 1, rows).double(), torch.linspace(0, WIDTH - 1, columns).double()
    return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], dim=-1).view(1, -1, 2)


def random_displacement(points: Tensor, size_px: float = 15.0, seed: int = 1) -> Tensor:
    return size_px * torch.randn(points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def none(points: Tensor) -> Tensor:
    return points.new_zeros(points.shape[0])


def some_pixels() -> Tensor:
    """(1, M, 2): every 60th pixel of the frame both ways, and its last."""
    y, x = torch.arange(0, HEIGHT, 60), torch.arange(0, WIDTH, 60)
    y, x = torch.cat([y, torch.tensor([HEIGHT - 1])]), torch.cat([x, torch.tensor([WIDTH - 1])])
    return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1).view(1, -1, 2).double()


def by_scipy(points: Tensor, displacement: Tensor, at: Tensor, smoothing: float = 0.0) -> Tensor:
    """(M, 2), px: SciPy's spline of the first sample."""
    # Ours smooths in coordinates that the extent divides; SciPy in px, where the kernel is scale^2 times as large, but
    # for a part that the side conditions take away.
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


@pytest.mark.parametrize("smoothing", [0.0, 1e-3, 0.1, 10.0])
@pytest.mark.parametrize("points", POINTS.values(), ids=POINTS.keys())
def test_the_flow_is_scipys_thin_plate_spline(points, smoothing, oracle):
    displacement = random_displacement(points)
    spline = fit_spline(points, displacement, none(points) + smoothing)
    at = torch.cat([some_pixels(), points], dim=1)
    found = evaluate_spline(spline, at)[0]
    oracle("thin plate, RBFInterpolator, fp64", found, by_scipy(points, displacement, at, smoothing), 1e-6)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_the_dense_flow_is_scipys_at_full_size(dtype, atol, oracle):
    points = random_points(25, 2)
    displacement = random_displacement(points)
    spline = fit_spline(points.to(dtype), displacement.to(dtype), none(points).to(dtype))
    flow = spline_flow(spline, height=HEIGHT, width=WIDTH, dtype=dtype)
    assert flow.dtype == dtype
    x, y = some_pixels()[0].long().unbind(1)
    exact = by_scipy(points.to(dtype).double(), displacement.to(dtype).double(), some_pixels())
    bar = min(atol, 1e-6 + exact.abs().max().item() * 1e-7)
    kind = str(dtype).replace("torch.float", "fp")
    oracle(f"thin plate at 1080p, RBFInterpolator, {kind}", flow[0, :, y, x].T, exact, bar)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("points", [random_points(900, 4), lattice_points(30, 30)], ids=["random", "lattice"])
def test_nine_hundred_points_are_met(points, dtype, oracle):
    points, displacement = points.to(dtype), random_displacement(points).to(dtype)
    spline = fit_spline(points, displacement, none(points))
    found = evaluate_spline(spline, points)
    assert_close(found, displacement.double(), rtol=0, atol=1e-3)
    # The interpolant of so many random points swings far between them.
    at = some_pixels()
    exact = by_scipy(points.double(), displacement.double(), at)
    oracle("thin plate of 900 points, RBFInterpolator", evaluate_spline(spline, at)[0], exact, 1e-3)


@pytest.mark.parametrize("size", [(37, 53), (1, 40), (40, 1), (1, 1), (0, 5)])
def test_the_dense_flow_is_the_spline_at_each_pixel(size):
    points = random_points(9, samples=2)
    spline = fit_spline(points, random_displacement(points), none(points))
    height, width = size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    at = torch.stack([x, y], dim=-1).view(1, -1, 2).expand(2, -1, -1)
    flow = spline_flow(spline, height=height, width=width, dtype=torch.float64)
    assert_close(flow, evaluate_spline(spline, at).mT.reshape(2, 2, height, width), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(33, 40), (120, 200)])
def test_a_kernel_gives_the_flow_of_pytorchs_operations(size, dtype, monkeypatch, oracle):
    source = torch.Generator().manual_seed(5)
    at = 200 * torch.rand(3, 20, 2, generator=source, dtype=torch.float64)
    at[:, 0] = at[:, 0].round()  # on a pixel, where the kernel is 0
    spline = fit_spline(at, 10 * torch.randn(3, 20, 2, generator=source), torch.tensor([0.0, 0.1, 10.0]))
    options = {"height": size[0], "width": size[1], "dtype": dtype}
    found = spline_flow(spline, **options)
    monkeypatch.setattr("torchrefract.fields.spline.kernels", lambda _: None)
    oracle(
        f"plates by a kernel, {dtype}", found, spline_flow(spline, **options), 1e-5 if dtype is torch.float32 else 1e-11
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_points_that_stay_move_nothing(dtype):
    points = random_points(16, samples=2).to(dtype)
    spline = fit_spline(points, torch.zeros_like(points), none(points))
    assert not spline_flow(spline, height=50, width=60, dtype=dtype).any()


@pytest.mark.parametrize("smoothing", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("count", [3, 4, 25, 100])
def test_affine_displacements_are_reproduced_however_smooth(count, smoothing):
    points = random_points(count)
    matrix = torch.tensor([[0.02, -0.05], [0.04, -0.01]], dtype=torch.float64)
    shift = torch.tensor([7.0, -3.0], dtype=torch.float64)
    spline = fit_spline(points, points @ matrix.T + shift, none(points) + smoothing)
    at = some_pixels()
    assert_close(evaluate_spline(spline, at), at @ matrix.T + shift, rtol=0, atol=1e-9)


def test_smoothing_without_end_leaves_the_affine_fit_of_least_squares():
    points = random_points(25)
    displacement = random_displacement(points)
    plane = torch.cat([torch.ones_like(points[..., :1]), points], dim=2)
    fit = torch.linalg.lstsq(plane[0], displacement[0]).solution
    at = some_pixels()
    found = evaluate_spline(fit_spline(points, displacement, none(points) + 1e10), at)
    assert_close(found[0], fit[0] + at[0] @ fit[1:], rtol=0, atol=1e-6)


def test_the_spline_does_not_depend_on_where_or_how_large_the_frame_is():
    points = random_points(16)
    displacement = random_displacement(points)
    at = some_pixels()
    for smoothing in (0.0, 0.1):
        expected = evaluate_spline(fit_spline(points, displacement, none(points) + smoothing), at)
        for scale, shift in ((1e-3, 0.0), (1.0, 1e5), (7.0, -300.0)):
            moved = fit_spline(scale * points + shift, displacement, none(points) + smoothing)
            assert_close(evaluate_spline(moved, scale * at + shift), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_spline_of_a_batch_is_taken_by_itself_bit_for_bit(dtype):
    for count in (9, 30):
        points = random_points(count, samples=5).to(dtype)
        displacement = random_displacement(points).to(dtype)
        smoothing = torch.tensor([0.0, 1.0, 0.0, 1e-3, 0.0], dtype=dtype)
        at = random_points(33, 9, samples=5)
        together = fit_spline(points, displacement, smoothing)
        flow = spline_flow(together, height=91, width=157, dtype=dtype)
        moved = evaluate_spline(together, at)
        for i in range(5):
            one = slice(i, i + 1)
            alone = fit_spline(points[one], displacement[one], smoothing[one])
            assert torch.equal(spline_flow(alone, height=91, width=157, dtype=dtype)[0], flow[i])
            assert torch.equal(evaluate_spline(alone, at[one])[0], moved[i])


@pytest.mark.parametrize("count", [16, 100])
def test_threads_do_not_change_a_bit(count, on_threads):
    points = random_points(count, samples=2)
    found = []
    for threads in (1, 2, 3):
        on_threads(threads)
        spline = fit_spline(points, random_displacement(points), none(points))
        found.append((spline_flow(spline, height=91, width=401, dtype=torch.float32), evaluate_spline(spline, points)))
    for flow, moved in found[1:]:
        assert torch.equal(flow, found[0][0])
        assert torch.equal(moved, found[0][1])


def small_points() -> tuple[Tensor, Tensor]:
    """Five points off the pixels of a frame of 5 x 7, two samples, and their displacements."""
    unit = torch.rand(2, 5, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    points = unit * torch.tensor([6.0, 4.0])
    return points, random_displacement(points, 1.0)


@pytest.mark.parametrize("smoothing", [[0.0, 0.0], [0.3, 0.02]])
def test_gradients_of_the_flow_are_those_of_finite_differences(smoothing):
    points, displacement = small_points()

    def flow(points: Tensor, displacement: Tensor, smoothing: Tensor) -> Tensor:
        return spline_flow(fit_spline(points, displacement, smoothing), height=5, width=7, dtype=torch.float64)

    inputs = [points, displacement, torch.tensor(smoothing, dtype=torch.float64)]
    assert torch.autograd.gradcheck(flow, [t.requires_grad_() for t in inputs])
    assert torch.autograd.gradgradcheck(lambda p, d: flow(p, d, inputs[2].detach())[..., ::2, ::3], inputs[:2])


def test_gradients_at_points_are_those_of_finite_differences():
    points, displacement = small_points()
    at = (points.flip(1) * 0.8 + 0.3).detach()

    def moved(points: Tensor, displacement: Tensor, smoothing: Tensor, at: Tensor) -> Tensor:
        return evaluate_spline(fit_spline(points, displacement, smoothing), at)

    smoothing = torch.tensor([0.3, 0.02], dtype=torch.float64)
    assert torch.autograd.gradcheck(moved, [t.requires_grad_() for t in (points, displacement, smoothing, at)])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_with_points_exactly_on_pixels_are_finite_and_right(dtype):
    points = torch.tensor([[[0, 0], [6, 0], [0, 4], [6, 4], [3, 2], [2, 1]]], dtype=dtype)
    displacement = random_displacement(points, 1.0).to(dtype).requires_grad_()
    smoothing = none(points).requires_grad_()
    points = points.requires_grad_()

    def flow(points: Tensor, displacement: Tensor, smoothing: Tensor) -> Tensor:
        return spline_flow(fit_spline(points, displacement, smoothing), height=5, width=7, dtype=dtype)

    found = torch.autograd.grad(flow(points, displacement, smoothing).sin().sum(), (points, displacement, smoothing))
    assert all(gradient.isfinite().all() for gradient in found)
    # There r^2 ln r has a slope, 0, but no second one, so differences are off by their step times its logarithm.
    if dtype == torch.float64:
        assert torch.autograd.gradcheck(flow, (points, displacement, smoothing), atol=1e-4)
    # At its own place each point moves as it is told.
    y, x = points[0, :, 1].long(), points[0, :, 0].long()
    told = flow(points, displacement, smoothing)[0, :, y, x]
    own = torch.autograd.grad(told.sum(), displacement)[0]
    assert_close(own, torch.ones_like(own), rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-10)


def test_the_flow_keeps_little_for_its_gradient():
    points = random_points(25).requires_grad_()
    kept = 0

    def count(tensor: Tensor) -> Tensor:
        nonlocal kept
        kept += tensor.numel()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        spline = fit_spline(points, random_displacement(points), none(points))
        spline_flow(spline, height=200, width=300, dtype=torch.float32)
    assert kept < 200 * 300


def test_a_map_over_samples_gives_the_same_flow_and_gradient():
    points, displacement = small_points()

    def flow(points: Tensor, displacement: Tensor) -> Tensor:
        spline = fit_spline(points[None], displacement[None], none(points[None]))
        return spline_flow(spline, height=5, width=7, dtype=torch.float64)[0]

    expected = torch.stack([flow(*pair) for pair in zip(points, displacement, strict=True)])
    assert_close(torch.func.vmap(flow)(points, displacement), expected, rtol=0, atol=1e-12)
    slope = torch.func.grad(lambda p, d: flow(p, d).square().sum(), argnums=(0, 1))
    found = torch.func.vmap(slope)(points, displacement)
    for i in range(2):
        for mapped, alone in zip(found, slope(points[i], displacement[i]), strict=True):
            assert_close(mapped[i], alone, rtol=1e-9, atol=1e-9)


def test_compiled_code_gives_the_same_flow_and_gradient():
    points, displacement = (t.float().requires_grad_() for t in small_points())

    def flow(points: Tensor, displacement: Tensor) -> Tensor:
        return spline_flow(fit_spline(points, displacement, none(points)), height=5, width=7, dtype=torch.float32)

    found, expected = torch.compile(flow, fullgraph=True)(points, displacement), flow(points, displacement)
    assert_close(found, expected, rtol=0, atol=1e-5)
    gradients = [torch.autograd.grad(f.sin().sum(), (points, displacement)) for f in (found, expected)]
    for compiled, eager in zip(*gradients, strict=True):
        assert_close(compiled, eager, rtol=1e-5, atol=1e-5)


def test_too_few_points_raise():
    for count in (0, 1, 2):
        with pytest.raises(ValueError, match=rf"points must be at least 3 to a sample, got {count}"):
            fit_spline(torch.rand(2, count, 2), torch.zeros(2, count, 2), torch.zeros(2))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("count", [3, 30])  # few and many distances are computed in different ways
def test_two_points_that_are_the_same_raise(count, dtype):
    points = random_points(count, samples=2).to(dtype)
    check_points(points)
    points[1, 1] = points[1, 0]
    with pytest.raises(ValueError, match="points must differ from one another, got two that are the same"):
        fit_spline(points, random_displacement(points), none(points))
    with pytest.raises(ValueError, match="points must differ from one another, got two that are the same"):
        check_points(torch.full((1, count, 2), 5.0, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.35)])
@pytest.mark.parametrize("count", [3, 20])
def test_points_on_a_line_raise(count, direction, dtype):
    at = torch.linspace(-400, 900, count).to(dtype)[:, None] + torch.tensor([0.0]).to(dtype)
    line = (at * torch.tensor(direction, dtype=dtype) + torch.tensor([500.0, 300.0], dtype=dtype))[None]
    points = torch.cat([random_points(count).to(dtype), line])
    with pytest.raises(ValueError, match="points must not lie on a line, got a sample whose points do"):
        fit_spline(points, torch.zeros_like(points), none(points))
    # One pixel off the line is a spline, if a wild one.
    points[1, 0] += torch.tensor([-direction[1], direction[0]], dtype=dtype)
    check_points(points)


def test_close_points_are_no_duplicates():
    points = random_points(9)
    points[0, 1] = points[0, 0] + 0.01
    displacement = random_displacement(points)
    spline = fit_spline(points, displacement, none(points))
    assert_close(evaluate_spline(spline, points), displacement, rtol=0, atol=1e-6)


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
def test_points_that_are_nowhere_raise(poison):
    points = random_points(9)
    points[0, 3, 1] = poison
    with pytest.raises(ValueError, match="points must be finite, got"):
        fit_spline(points, random_displacement(points), none(points))
