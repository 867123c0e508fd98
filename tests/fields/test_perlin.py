import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields.perlin import Octave, draw_octave, perlin_noise
from torchrefract.fields.random_field import Motion

PERIODS = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
WEIGHTS = (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
BOUND = math.sqrt(0.5)


def keys(*samples: int) -> Tensor:
    return random.noise_key(random.stream(5, torch.tensor(samples, dtype=torch.int64)))


def octaves_of(
    key: Tensor,
    periods: tuple[float, ...],
    height: int,
    width: int,
    frame: Tensor | float = 0.0,
    wind: Tensor | tuple[float, float] = (0.0, 0.0),
    decorrelation: Tensor | float = math.inf,
    *,
    dtype: torch.dtype = torch.float64,
) -> list[Octave]:
    """Draw the octaves of a frame; numbers hold for all samples."""
    frame, wind, decorrelation = (torch.as_tensor(v, dtype=torch.float64) for v in (frame, wind, decorrelation))
    motion = Motion(frame.expand(len(key)), wind.expand(len(key), 2), decorrelation.expand(len(key)))
    options: Any = {"height": height, "width": width, "motion": motion, "dtype": dtype}
    return [draw_octave(key, i, period=period, **options) for i, period in enumerate(periods)]


def weights_of(count: int, periods: tuple[float, ...], dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(WEIGHTS[: len(periods)], dtype=dtype).repeat(count, 1)


def noise_of(
    key: Tensor, periods: tuple[float, ...], height: int, width: int, *, dtype: torch.dtype = torch.float64, **motion
) -> Tensor:
    octaves = octaves_of(key, periods, height, width, **motion, dtype=dtype)
    return perlin_noise(octaves, weights_of(len(key), periods, dtype))


def quintic(s: float) -> float:
    return 6 * s**5 - 15 * s**4 + 10 * s**3


def noise_at_point(gradient: Callable[[int, int], np.ndarray], x: float, y: float) -> float:
    """Compute Perlin noise at one point from the four corners of its cell, as in Perlin's paper."""
    column, row = math.floor(x), math.floor(y)
    f, g = x - column, y - row
    total = 0.0
    for a, b in itertools.product((0, 1), (0, 1)):
        weight = (quintic(f) if a else 1 - quintic(f)) * (quintic(g) if b else 1 - quintic(g))
        slope = gradient(column + a, row + b)
        total += weight * (slope[0] * (f - a) + slope[1] * (g - b))
    return total


def octave_by_loop(
    key: Tensor, index: int, period: float, height: int, width: int, *, t: float, wind: tuple[float, float], tau: float
) -> np.ndarray:
    """Compute an octave, (H, W), pixel by pixel from the definition of its draw."""
    numbers = [int(word) for word in key[0]]
    phase = [(numbers[i] / 2**32 + (index + 1) * GOLDEN_RATIO) % 1 for i in range(2)]
    x = [(j + 0.5 - wind[0] * t) / period + phase[0] for j in range(width)]
    y = [(i + 0.5 - wind[1] * t) / period + phase[1] for i in range(height)]
    axes = [torch.arange(math.floor(min(axis)), math.floor(max(axis)) + 2) for axis in (x, y)]
    nodes = [torch.tensor([[index]]), *(axis[None] for axis in axes)]
    u = random.lattice_noise(key, nodes, 2)[0, :, 0].double().numpy()
    angle = 2 * np.pi * u[0] + math.sqrt(2) * stats.norm.ppf(u[1]) * t / tau
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=2)

    def gradient(column: int, row: int) -> np.ndarray:
        return directions[column - int(axes[0][0]), row - int(axes[1][0])]

    return np.array([[noise_at_point(gradient, a, b) for a in x] for b in y])


def noise_between(gradient: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the noise of one lattice at x and y in cells, (N, H, W)."""
    count, step = len(gradient), float(x[..., 1] - x[..., 0]) if x.shape[-1] > 1 else 1.0
    octave = Octave(gradient, x.expand(count, -1), y.expand(count, -1), max(step, 1.0))
    return perlin_noise([octave], gradient.new_ones(count, 1))[:, 0]


@pytest.mark.quick
@pytest.mark.parametrize("motion", [(0.0, (0.0, 0.0), math.inf), (37.5, (1.3, -0.7), 21.0)])
@pytest.mark.parametrize(
    ("periods", "size"),
    [((4.0, 8.0), (45, 71)), ((7.3, 2.5, 1.1), (21, 39)), ((0.5, 0.013), (31, 27)), ((1e9,), (9, 40))],
)
def test_noise_equals_a_loop_over_pixels_and_corners(periods, size, motion):
    frame, wind, decorrelation = motion
    key = keys(3)
    noise = noise_of(key, periods, *size, frame=frame, wind=wind, decorrelation=decorrelation)
    expected = sum(
        WEIGHTS[i] * octave_by_loop(key, i, period, *size, t=frame, wind=wind, tau=decorrelation)
        for i, period in enumerate(periods)
    )
    assert_close(noise[0, 0], torch.from_numpy(expected), rtol=0, atol=1e-10)


def test_noise_reaches_its_bound_and_stays_within():
    noise = noise_of(keys(*range(8)), (3.7,), 300, 300) / WEIGHTS[0]
    assert 0.9 * BOUND < noise.abs().max() < BOUND
    # All four gradients point at the center of the cell.
    inward = torch.tensor([[[1.0, -1.0], [1.0, -1.0]], [[1.0, 1.0], [-1.0, -1.0]]], dtype=torch.float64) * BOUND
    middle = torch.full((1, 1), 0.5, dtype=torch.float64)
    assert noise_between(inward[None], middle, middle).item() == pytest.approx(BOUND, abs=1e-12)


@pytest.mark.parametrize("elapsed", [30.0, 60.0, 90.0])
def test_noise_decorrelates_as_a_gaussian_of_time_and_keeps_its_variance(elapsed):
    decorrelation, start = 60.0, 1e4
    before, after = (
        noise_of(keys(1), (2.0, 3.0), 500, 500, frame=t, decorrelation=decorrelation) for t in (start, start + elapsed)
    )
    variances = before.square().mean(), after.square().mean()
    correlation = ((before * after).mean() / (variances[0] * variances[1]).sqrt()).item()
    assert correlation == pytest.approx(math.exp(-((elapsed / decorrelation) ** 2)), abs=0.03)
    assert variances[1].item() == pytest.approx(variances[0].item(), rel=0.03)


@pytest.mark.parametrize("start", [0.0, 1e5])
def test_the_wind_moves_the_noise(start):
    periods, wind = (3.3, 16.0, 200.0), (3.0, -2.0)
    first, then = (
        noise_of(keys(4), periods, 60, 150, frame=start + t, wind=wind, dtype=torch.float32) for t in (0.0, 2.0)
    )
    assert first.std() > 0.05
    # Four rows up, six columns to the right.
    assert_close(then[:, :, :-4, 6:], first[:, :, 4:, :-6], rtol=0, atol=1e-5)
    assert (then - first).abs().max() > 0.1


def test_octaves_keys_and_late_frames_do_not_correlate():
    fields = [noise_of(keys(sample), (5.0,), 300, 300) for sample in (1, 2)]
    fields.append(perlin_noise(octaves_of(keys(1), (9.0, 5.0), 300, 300)[1:], torch.ones(1, 1).double()))
    fields += [noise_of(keys(1), (5.0,), 300, 300, frame=t, wind=(0.32, 0.0)) for t in (1e3, 1e7)]
    off_diagonal = torch.corrcoef(torch.cat(fields).flatten(1)) - torch.eye(5, dtype=torch.float64)
    assert off_diagonal.abs().max() < 5 / 60  # of 60^2 cells


@pytest.mark.parametrize("frame", [0.0, 1e4])
def test_float32_is_exact_to_1e_5(frame):
    motion = {"frame": frame, "wind": (1.7, 0.3), "decorrelation": 25.0}
    single, double = (noise_of(keys(6), PERIODS, 211, 397, **motion, dtype=d) for d in (torch.float32, torch.float64))
    assert single.dtype == torch.float32
    assert_close(single.double(), double, rtol=0, atol=1e-5)


def test_gradients_of_the_motion_match_finite_differences():
    key = keys(1, 2)

    def noise(frame: Tensor, wind: Tensor, decorrelation: Tensor) -> Tensor:
        octaves = octaves_of(key, (3.0, 9.0), 4, 40, frame, wind, decorrelation)
        return perlin_noise(octaves, weights_of(2, (3.0, 9.0)))

    inputs = [torch.tensor([0.0, 7.0]), torch.tensor([[0.3, -0.2], [0.0, 0.1]]), torch.tensor([20.0, 35.0])]
    assert torch.autograd.gradcheck(noise, [value.double().requires_grad_() for value in inputs], fast_mode=True)
