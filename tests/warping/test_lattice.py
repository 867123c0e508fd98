import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.warping.grid import Points
from torchrefract.warping.lattice import Lattice, LatticeFlow, pixel_lattice

CPU = torch.device("cpu")
SIZE = (45, 61)


def cubic_flow(x: Tensor, y: Tensor) -> Tensor:
    """Return a flow (1, 2, h, w) that is cubic in x and in y."""
    x, y = x / 20, y / 20
    return torch.cat([x**3 - 2 * x * y**2 + 1 + 0 * y, y**3 - x**2 * y + 0 * x], dim=1)


def lattice_flow(stride: int, margin: int) -> LatticeFlow:
    lattice = Lattice(*SIZE, stride, margin)
    points = lattice.points(dtype=torch.float64, device=CPU)
    return LatticeFlow(cubic_flow(points.x, points.y), lattice)


def random_points(lattice: Lattice, low: float, high: float) -> Points:
    """Return displaced points at random positions, px."""
    x, y = (low + (high - low) * torch.rand(2, 1, 1, 7, 9, generator=torch.Generator().manual_seed(0))).double()
    return Points(x, y, lattice, is_displaced=True)


@pytest.mark.quick
@pytest.mark.parametrize(("stride", "margin"), [(1, 0), (1, 1), (4, 1), (16, 1), (16, 3)])
def test_nodes_reach_beyond_the_last_pixel(stride, margin):
    lattice = Lattice(*SIZE, stride, margin)
    points = lattice.points(dtype=torch.float64, device=CPU)
    assert (points.y.numel(), points.x.numel()) == lattice.num_nodes
    for axis, size in ((points.y.flatten(), SIZE[0]), (points.x.flatten(), SIZE[1])):
        assert axis[0] == -margin * stride
        assert (axis.diff() == stride).all()
        # A cubic needs two nodes beyond the last pixel, unless a node lies on each pixel.
        assert axis[-1] >= size - 1 + (margin * stride if margin else 0)


@pytest.mark.quick
@pytest.mark.parametrize(("stride", "margin"), [(1, 0), (1, 2), (3, 1), (7, 2), (32, 1)])
def test_cubic_flows_are_exact_at_pixels(pixels, stride, margin):
    x, y = (axis[None, None] for axis in pixels(*SIZE))
    assert_close(lattice_flow(stride, margin).dense(), cubic_flow(x, y), rtol=0, atol=1e-11)


@pytest.mark.parametrize("stride", [1, 8, 16])
def test_cubic_flows_are_exact_at_displaced_points(stride):
    points = random_points(pixel_lattice(*SIZE), 0, SIZE[0] - 1)
    assert_close(lattice_flow(stride, 3).at(points), cubic_flow(points.x, points.y), rtol=0, atol=1e-11)


@pytest.mark.parametrize("other", [Lattice(*SIZE, 5, 2), pixel_lattice(*SIZE)])
def test_points_of_another_lattice_agree_with_displaced_points(other):
    lattice = Lattice(*SIZE, 8, 3)
    nodes = torch.randn(2, 2, *lattice.num_nodes, generator=torch.Generator().manual_seed(1)).double()
    flow, points = LatticeFlow(nodes, lattice), other.points(dtype=torch.float64, device=CPU)
    rows, columns = other.num_nodes
    displaced = points.displaced(torch.zeros(1, 2, rows, columns, dtype=torch.float64))
    assert_close(flow.at(points), flow.at(displaced), rtol=0, atol=1e-12)


@pytest.mark.parametrize("stride", [1, 8])
def test_points_beyond_the_nodes_get_the_outermost_ones(stride):
    lattice = Lattice(*SIZE, stride, 1)
    nodes = torch.randn(1, 2, *lattice.num_nodes, generator=torch.Generator().manual_seed(3)).double()
    for sign, corner in ((-1, nodes[..., :1, :1]), (1, nodes[..., -1:, -1:])):
        far = torch.full((1, 1, 1, 1), sign * 1e6, dtype=torch.float64)
        assert_close(LatticeFlow(nodes, lattice).at(Points(far, far, lattice, is_displaced=True)), corner)


def test_invalid_points_give_finite_values():
    flow = lattice_flow(8, 1)
    invalid = torch.full((1, 1, 1, 1), torch.nan, dtype=torch.float64)
    assert flow.at(Points(invalid, invalid, flow.lattice, is_displaced=True)).isfinite().all()


@pytest.mark.parametrize("stride", [1, 6])
def test_gradients_of_nodes_and_points_are_those_of_finite_differences(stride):
    lattice = Lattice(12, 13, stride, 1)
    nodes = torch.randn(2, 2, *lattice.num_nodes, generator=torch.Generator().manual_seed(4)).double()
    x, y = (1.3 + 8 * torch.rand(2, 2, 1, 3, 2, generator=torch.Generator().manual_seed(5)).double()).round(decimals=1)
    x, y = x + 0.05, y + 0.05  # cubics have kinks at nodes

    def at(nodes: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return LatticeFlow(nodes, lattice).at(Points(x, y, lattice, is_displaced=True))

    assert torch.autograd.gradcheck(
        at, [nodes.requires_grad_(), x.requires_grad_(), y.requires_grad_()], fast_mode=True
    )


def test_one_flow_for_all_frames_of_a_clip_is_interpolated_once():
    lattice = Lattice(*SIZE, 8, 1)
    nodes = torch.randn(1, 2, *lattice.num_nodes, generator=torch.Generator().manual_seed(6))
    dense = LatticeFlow(nodes.expand(5, -1, -1, -1), lattice).dense()
    assert dense.shape == (5, 2, *SIZE)
    assert dense.stride(0) == 0
    assert torch.equal(dense[:1], LatticeFlow(nodes, lattice).dense())
