"""Polygons move along a flow like their points, and end at the border of the frame."""

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchrefract import LensDistortion, warp_points
from torchrefract.labels.boxes import polygon_area, warp_polygons

HEIGHT, WIDTH = 90, 120


def shift(x: float, y: float) -> Tensor:
    """Return a flow that moves the content by (x, y)."""
    return -torch.tensor([x, y]).view(2, 1, 1).expand(2, HEIGHT, WIDTH)


def star(x: float, y: float, radius: float) -> Tensor:
    angle = torch.arange(10) * math.pi / 5
    length = torch.where(torch.arange(10) % 2 == 0, radius, 0.5 * radius)
    return torch.stack([x + length * angle.cos(), y + length * angle.sin()], dim=1)


def depth_in(polygon: Tensor, x: float, y: float) -> float:
    """Return how far inside a polygon a point lies, px; negative outside."""
    return cv2.pointPolygonTest(polygon.float().numpy(), (x, y), measureDist=True)


@pytest.mark.quick
def test_a_polygon_is_shifted_and_cut_at_the_border():
    square = torch.tensor([[10.0, 10.0], [30.0, 10.0], [30.0, 40.0], [10.0, 40.0]])
    whole, cut, gone = (warp_polygons([square], shift(x, 5.0))[0] for x in (7.0, 100.0, 120.0))
    assert polygon_area(whole) == pytest.approx(600)
    assert torch.equal(whole.amin(dim=0), torch.tensor([17.0, 15.0]))
    # The frame ends at 119.5: 9.5 of 20 px remain.
    assert polygon_area(cut) == pytest.approx(9.5 * 30)
    assert torch.equal(cut.amax(dim=0), torch.tensor([119.5, 45.0]))
    assert gone.shape == (0, 2)
    assert warp_polygons([], shift(0.0, 0.0)) == []


@pytest.mark.quick
def test_a_pixel_lies_in_a_warped_polygon_if_it_shows_the_inside_of_the_polygon():
    lens = LensDistortion(k1_range=(-0.5, -0.5), k2_range=(0.15, 0.15), tolerance_px=None)
    flow = lens.degrade(torch.rand(1, 3, HEIGHT, WIDTH), seed=0).flow[0]
    stars = [star(60, 45, 30), star(5, 5, 25), star(115, 80, 20)]
    for polygon, warped in zip(stars, warp_polygons(stars, flow), strict=True):
        num_inside = 0
        for y, x in np.ndindex(HEIGHT, WIDTH):
            u, v = flow[:, y, x].tolist()
            if abs(depth := depth_in(polygon, x + u, y + v)) > 0.05:
                assert (depth > 0) == (depth_in(warped, x, y) > 0), (x, y)
                num_inside += depth > 0
        assert num_inside > 100
        points, visible = warp_points(polygon, flow)
        assert torch.cdist(points[visible].double(), warped.double()).amin(dim=1).max() < 1e-4
        assert visible.any()


def test_points_without_a_position_are_left_out():
    flow = shift(0.0, 0.0).clone()
    flow[:, 40:50, 40:50] = torch.nan
    square = torch.tensor([[30.0, 30.0], [45.0, 30.0], [45.0, 60.0], [30.0, 60.0]])
    warped = warp_polygons([square], flow)[0]
    assert warped.isfinite().all()
    assert polygon_area(warped) == pytest.approx(450)  # the outline goes straight on over the gap
