"""The density of dust along rays, compared with quadrature."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import integrate
from torch.testing import assert_close

from torchrefract.fields.dust import descent_of_rows, mean_density, mean_wake_density


@pytest.mark.quick
@pytest.mark.parametrize("scale", [0.05, 0.7, 2.0, 50.0])
@pytest.mark.parametrize("distance", [0.5, 12.0, 90.0])
@pytest.mark.parametrize("end", [0.0, 0.4, 1.29999, 1.3, 1.300001, 2.0, 8.0])
def test_the_mean_density_is_that_of_quadrature(scale, distance, end):
    camera = 1.3

    def density(s: float) -> float:
        return math.exp(-(camera + (end - camera) * s / distance) / scale)

    expected = integrate.quad(density, 0, distance, epsabs=0, epsrel=1e-12)[0] / distance
    given = (torch.tensor(value, dtype=torch.float64) for value in (distance, (camera - end) / distance, scale))
    assert mean_density(*given, camera_height=camera).item() == pytest.approx(expected, rel=1e-8)


def test_rays_to_the_sky_leave_the_dust_and_level_rays_do_not():
    far, scale = torch.tensor(math.inf, dtype=torch.float64), torch.tensor(2.0, dtype=torch.float64)
    descent = torch.tensor([-0.1, 0.0], dtype=torch.float64)
    density = mean_density(far, descent, scale, camera_height=1.3)
    # The integral of exp(-(1.3 + 0.1 s) / 2) over all s is 20 exp(-0.65); the transmission clamps distances at 1e12 m.
    assert (1e12 * density[0]).item() == pytest.approx(20 * math.exp(-0.65), rel=1e-9)
    assert density[1].item() == pytest.approx(math.exp(-0.65), rel=1e-12)


def test_a_ray_of_a_row_meets_the_road_where_a_flat_road_is():
    height, horizon, focal = 80, 0.35, 100.0
    descent = descent_of_rows(
        horizon, height=height, focal=focal, center=39.5, dtype=torch.float64, device=torch.device("cpu")
    )
    pitch = math.atan((39.5 - (horizon * height - 0.5)) / focal)
    y = np.arange(height)
    # The rays (0, (y - cy) / f, 1) in a camera that looks down by the pitch.
    expected = (y - 39.5) / focal * math.cos(pitch) + math.sin(pitch)
    assert_close(descent.flatten(), torch.from_numpy(expected), rtol=0, atol=1e-12)


VIEW: dict[str, Any] = {"horizon": 0.4, "focal": 50.0, "center": 21.0, "camera_height": 1.3, "length": 2.0}


def test_the_dust_behind_vehicles_is_that_of_quadrature_along_each_ray():
    height, width = 40, 60
    boxes = torch.tensor([[[20.0, 14.0, 31.0, 22.0], [33.0, 12.0, 52.0, 27.5]]], dtype=torch.float64)
    depth = torch.linspace(0.5, 60.0, height * width, dtype=torch.float64).view(1, 1, height, width)
    descent = descent_of_rows(
        0.4, height=height, focal=50.0, center=21.0, dtype=torch.float64, device=torch.device("cpu")
    ).flatten()
    depth = torch.minimum(depth, 1.3 / descent.clamp(min=1e-9)[:, None])  # no ray leads below the road
    actual = mean_wake_density(depth, boxes, width=width, **VIEW)[0, 0]
    slope = (descent[1] - descent[0]).item()
    for row, column in ((0, 22), (12, 30), (15, 26), (20, 40), (22, 26), (27, 47), (39, 30)):
        far, expected = depth[0, 0, row, column].item(), 0.0
        for x1, y1, x2, y2 in boxes[0].tolist():
            place = 1.3 / (slope * (y2 - 15.5))
            high, across = place * slope * (y2 - y1), math.exp(-(((column - (x1 + x2) / 2) / (x2 - x1)) ** 2) * 2)

            def density(z: float, row: int = row, high: float = high, place: float = place) -> float:
                return math.exp(-(1.3 - descent[row].item() * z) / high - (place - z) / min(2.0, place / 5))

            expected += across * integrate.quad(density, 0, min(far, place), epsabs=0, epsrel=1e-12)[0] / far
        assert actual[row, column].item() == pytest.approx(expected, rel=1e-8)


def test_boxes_without_an_area_and_above_the_road_raise_finite_dust():
    depth = torch.full((1, 1, 40, 60), math.inf)
    boxes = torch.tensor([[[0.0, 0.0, 0.0, 0.0], [30.0, 20.0, 25.0, 30.0], [10.0, 9.0, 20.0, 9.0]]])
    assert not mean_wake_density(depth, boxes, width=60, **VIEW).any()
    above = mean_wake_density(depth.clamp(max=2000.0), boxes.new_tensor([[[20.0, 2.0, 40.0, 8.0]]]), width=60, **VIEW)
    assert above.isfinite().all()
    assert above.max() > 0


def test_gradients_match_finite_differences():
    distance = torch.tensor([3.0, 40.0, 200.0, 5.0], dtype=torch.float64, requires_grad=True)
    descent = torch.tensor([0.4, 1e-8, -0.05, 0.02], dtype=torch.float64, requires_grad=True)
    scale = torch.tensor([0.3, 1.0, 2.0, 1.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda *values: mean_density(*values, camera_height=1.3), [distance, descent, scale], atol=1e-6
    )
    depth = torch.linspace(3.0, 80.0, 60, dtype=torch.float64).view(1, 1, 6, 10).requires_grad_()
    boxes = torch.tensor([[[2.0, 1.5, 4.5, 4.0], [0.0, 0.0, 0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, b: mean_wake_density(d, b, width=10, **VIEW), [depth, boxes], atol=1e-6)
    values = [torch.tensor([v], requires_grad=True) for v in (math.inf, -0.1, 0.05)]
    assert all(g.isfinite().all() for g in torch.autograd.grad(mean_density(*values, camera_height=1.3).sum(), values))
