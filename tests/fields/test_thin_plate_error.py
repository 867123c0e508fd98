import numpy as np
import pytest
import torch

from torchrefract.fields.thin_plate import Spline, fit_spline, spline_flow
from torchrefract.fields.thin_plate_error import ThinPlateErrorModel
from torchrefract.warping.lattice import Lattice, LatticeFlow, pixel_lattice

HEIGHT, WIDTH = 90, 130


def unit_splines(smoothing: float) -> Spline:
    """Fit splines through a lattice of 3 x 4 points, each of which displaces one point by 1."""
    y, x = torch.linspace(0, HEIGHT - 1, 3).double(), torch.linspace(0, WIDTH - 1, 4).double()
    points = torch.stack([x.expand(3, -1), y[:, None].expand(-1, 4)], dim=-1).view(1, -1, 2).expand(12, -1, -1)
    displacement = torch.eye(12).double()[..., None].expand(-1, -1, 2)
    return fit_spline(points, displacement, torch.full((12,), smoothing))


def flow_on(lattice: Lattice, smoothing: float) -> torch.Tensor:
    at = lattice.points(dtype=torch.float64, device=torch.device("cpu"))
    return spline_flow(unit_splines(smoothing), at.x, at.y, dtype=torch.float64)[:, :1]


@pytest.mark.quick
@pytest.mark.parametrize("smoothing", [0.0, 0.2])
def test_errors_of_cubics_and_gradients_are_bounded(smoothing):
    bounds = ThinPlateErrorModel(1.0, (3, 4), (smoothing, smoothing)).bounds(HEIGHT, WIDTH)
    assert bounds is not None
    dense = flow_on(pixel_lattice(HEIGHT, WIDTH), smoothing)
    for stride in (3, 8, 20):
        lattice = Lattice(HEIGHT, WIDTH, stride)
        error = (LatticeFlow(flow_on(lattice, smoothing), lattice).dense() - dense).square().sum(dim=0).sqrt().max()
        bound = bounds.interpolation_error(np.array([float(stride)]))[0]
        assert 7 * error <= bound < 70 * error
    gradient = (dense[..., 2:] - dense[..., :-2]).square().sum(dim=0).sqrt().max() / 2
    assert 4 * gradient <= bounds.max_gradient < 8 * gradient
    assert bounds.max_displacement == 14


@pytest.mark.quick
def test_a_flow_longer_than_the_frame_has_no_lattice():
    assert not ThinPlateErrorModel(50.0, (3, 4), (0.0, 0.0)).simplify(HEIGHT, WIDTH, 0.02).can_interpolate
    assert ThinPlateErrorModel(1.0, (3, 4), (0.0, 0.0)).simplify(HEIGHT, WIDTH, 0.02).can_interpolate
