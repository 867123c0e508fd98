import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchrefract.cameras.calibration.plumb_line import (
    NUM_POINTS,
    Chains,
    bends,
    covers_frame,
    find_chains,
    fit_lens,
    line_costs,
    pool_chains,
    published_prior,
)
from torchrefract.cameras.projection import distort, undistort

SIZE = (270, 480)
HALF_DIAGONAL = math.hypot(*SIZE) / 2
CENTER = torch.tensor([239.5, 134.5], dtype=torch.float64)
BARREL = (-0.16, 0.06)


def lens(*numbers: float) -> Tensor:
    return torch.tensor([numbers], dtype=torch.float64)


def through(points: Tensor, numbers: tuple[float, float], *, inverse: bool = False) -> Tensor:
    """Show px of a rectified frame (..., 2) as a lens does; `inverse` rectifies px of the frame."""
    coefficients = torch.tensor([[*numbers, 0.0, 0.0]], dtype=torch.float64)
    function = undistort if inverse else distort
    result = function(((points - CENTER) / HALF_DIAGONAL).reshape(1, -1, 2), coefficients, model="opencv")
    assert result.valid.all()
    return (result.points * HALF_DIAGONAL + CENTER).view(points.shape)


def straight_lines(count: int, seed: int = 0, *, bend_px: float = 0.0) -> Tensor:
    """Return chains (count, 24, 2) in a rectified frame, parabolas of random bends if `bend_px` is above 0."""
    random = torch.Generator().manual_seed(seed)
    ends = (torch.rand(count, 2, 1, 2, generator=random, dtype=torch.float64) - 0.5) * torch.tensor([420.0, 225.0])
    t = torch.linspace(0, 1, NUM_POINTS, dtype=torch.float64)[:, None]
    points = CENTER + ends[:, 0] + t * (ends[:, 1] - ends[:, 0])
    amplitude = bend_px * torch.randn(count, 1, 1, generator=random, dtype=torch.float64)
    return points + amplitude * (t * (1 - t)) * torch.tensor([0.0, 4.0])


def to_gray(frame: Tensor) -> np.ndarray:
    return (255 * frame[0]).round().byte().numpy()


def to_chains(points: Tensor, *, noise_px: float = 0.05, num_frames: int = 10) -> Chains:
    random = torch.Generator().manual_seed(1)
    noisy = points + noise_px * torch.randn(points.shape, generator=random, dtype=points.dtype)
    count = len(points)
    length = (points[:, -1] - points[:, 0]).norm(dim=1)
    return Chains(noisy, torch.full((count,), 0.1).double(), 0.004 * length, torch.arange(count) % num_frames, SIZE)


@pytest.mark.quick
@pytest.mark.parametrize("numbers", [(0.0, 0.0), BARREL, (0.1, -0.05)])
def test_images_of_straight_lines_have_no_bend_through_their_lens_and_have_through_others(numbers):
    points = through(straight_lines(40), numbers)
    assert bends(points, lens(*numbers), SIZE)[0].abs().max() < 1e-6
    assert bends(points, lens(numbers[0] - 0.1, numbers[1]), SIZE)[0].abs().max() > 0.5


@pytest.mark.parametrize("numbers", [(0.0, 0.0), (-0.3, 0.1), (0.2, 0.0)])
def test_a_bend_is_measured_in_px_of_the_distorted_frame_so_that_magnification_does_not_pay(numbers):
    distorted = through(straight_lines(40), numbers)
    along = distorted[:, -1] - distorted[:, 0]
    normal = torch.stack([-along[:, 1], along[:, 0]], dim=1) / along.norm(dim=1, keepdim=True)
    t = torch.linspace(-1, 1, NUM_POINTS, dtype=torch.float64)
    parabola = t * t - (t * t).mean()
    parabola = parabola / parabola.square().mean().sqrt()
    bend = bends(distorted + 0.2 * parabola[:, None] * normal[:, None], lens(*numbers), SIZE)[0][0]
    # Lines are curved, so that their normals turn a little away from those of the chords.
    assert bend.abs().sub(0.2).abs().median() < 0.002
    assert bend.abs().sub(0.2).abs().max() < 0.03


def test_costs_have_the_gradients_of_finite_differences():
    chains, start, step = to_chains(through(straight_lines(20), BARREL)), lens(-0.14, 0.05).requires_grad_(), 1e-5
    (slope,) = torch.autograd.grad(line_costs(chains, start).sum(), start)
    for i, axis in enumerate(step * torch.eye(2, dtype=torch.float64)):
        ahead, before = (line_costs(chains, start.detach() + sign * axis).sum() for sign in (1, -1))
        torch.testing.assert_close(slope[0, i], (ahead - before) / (2 * step), atol=1e-4, rtol=1e-5)


def test_a_chain_where_the_lens_folds_back_costs_as_much_as_a_curved_one():
    chains = to_chains(straight_lines(30))
    folding = line_costs(chains, lens(-0.9, 0.0))[0]
    valid = bends(chains.points, lens(-0.9, 0.0), SIZE)[1][0]
    floor = 0.2 * chains.noise / chains.curved
    assert (~valid).any()
    torch.testing.assert_close(folding[~valid], -torch.log(floor / (1 + floor))[~valid])


@pytest.mark.parametrize("numbers", [(0.0, 0.0), (-0.28, 0.12), (0.08, -0.03)])
def test_the_lens_is_found_although_most_chains_are_really_curved(numbers):
    straight, curved = straight_lines(60), straight_lines(90, seed=5, bend_px=8.0)
    fit = fit_lens(to_chains(through(torch.cat([straight, curved]), numbers)), published_prior())
    radius = torch.linspace(0, 0.85, 50, dtype=torch.float64)  # where the chains lie

    def shift(k: Tensor) -> Tensor:
        return HALF_DIAGONAL * radius**3 * (k[0] + k[1] * radius**2)

    error = (shift(fit.coefficients) - shift(torch.tensor(numbers))).abs().max().item()
    assert error < 1.0  # px
    assert fit.is_straight[:60].float().mean() > 0.9
    assert fit.is_straight[60:].float().mean() < 0.3
    difference = fit.coefficients - torch.tensor(numbers, dtype=torch.float64)
    assert difference @ torch.linalg.solve(fit.covariance, difference) < 9.2  # 99 % of a normal distribution in 2D


def test_without_chains_the_prior_remains():
    fit = fit_lens(to_chains(straight_lines(0)), published_prior())
    torch.testing.assert_close(fit.coefficients, torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    assert 0.1 < fit.covariance[0, 0].sqrt() < 0.25
    assert len(fit.is_straight) == 0


def test_edges_are_found_below_a_tenth_of_a_pixel_and_cut_at_corners(drive):
    strokes = torch.tensor(
        [[[60, 45], [420, 70]], [[75, 250], [405, 225]], [[40, 75], [55, 220]], [[435, 60], [420, 220]]]
    )
    (frame,) = drive(BARREL, 1, strokes.double())
    chains = find_chains(to_gray(frame))
    assert len(chains) >= 8  # two edges of each stroke
    rectified = through(chains, BARREL, inverse=True)
    distance = torch.linalg.svdvals(rectified - rectified.mean(dim=1, keepdim=True))[:, 1] / math.sqrt(NUM_POINTS)
    assert distance.median() < 0.1
    assert bends(chains, lens(*BARREL), SIZE)[0].abs().median() < 0.03
    assert bends(chains, lens(0.0, 0.0), SIZE)[0].abs().median() > 0.3


def test_a_large_picture_is_searched_at_a_smaller_size_and_the_chains_are_in_its_px(drive):
    (frame,) = drive((0.0, 0.0), 1, torch.tensor([[[60.0, 45.0], [420.0, 70.0]]]))
    gray = to_gray(frame)
    large = cv2.resize(gray, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    small_edge, edge = (chains[chains[:, 0, 1].argmin()] for chains in (find_chains(gray), find_chains(large)))
    height, expected = (line[:, 1] - line[:, 0] * 25 / 360 for line in (edge, 4 * small_edge + 1.5))
    assert (height.mean() - expected.mean()).abs() < 1.0


def test_pooling_drops_edges_of_the_car_and_lines_through_the_middle():
    bonnet = torch.stack([torch.linspace(75, 375, NUM_POINTS), 240 + torch.zeros(NUM_POINTS)], dim=1).double()
    through_middle = torch.stack([torch.linspace(250, 460, NUM_POINTS)] * 2, dim=1).double()
    through_middle[:, 1] = 135 + (through_middle[:, 0] - 240) * 0.4
    down = torch.tensor([0.0, 2.5])
    frames = [torch.stack([bonnet, through_middle + i * down, bonnet - (4 + i) * down]) for i in range(12)]
    pooled = pool_chains(frames, SIZE)
    assert pooled.frame.tolist() == list(range(12))
    assert (pooled.points[:, 0, 1] < 231).all()
    alone = pool_chains(frames[:1], SIZE)
    assert len(alone.points) == 2  # a single frame does not tell what stays


def test_a_lens_covers_its_frame_unless_it_folds_back_inside():
    assert covers_frame(torch.zeros(2, dtype=torch.float64))
    # r (1 + k1 r^2) is largest at r^2 = -1 / (3 k1), where it is 2 r / 3: 1 for k1 = -4 / 27.
    assert covers_frame(torch.tensor([-4 / 27 + 1e-3, 0.0], dtype=torch.float64))
    assert not covers_frame(torch.tensor([-4 / 27 - 1e-3, 0.0], dtype=torch.float64))
