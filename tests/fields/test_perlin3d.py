import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields.perlin3d import VARIANCE, Rays, deviation_of_mean, noise_on_planes

RAYS = Rays(-0.8, 0.37, 5, 0.1, 0.45, 3)
DEPTHS = (0.0, 0.7, 2.9, 11.3)
ONE = Rays(0.0, 0.0, 1, 0.0, 0.0, 1)


def keys(samples: int, seed: int = 5) -> Tensor:
    return random.noise_key(random.stream(seed, torch.arange(samples)))


def at_rest(samples: int) -> dict[str, Any]:
    return {"moved": torch.zeros(samples, 3).double(), "turns": torch.zeros(samples).double()}


def ones(samples: int, octaves: int, planes: int) -> Tensor:
    return torch.ones(samples, octaves, planes, dtype=torch.float64)


def phase_of(key: list[int], octave: int) -> np.ndarray:
    """By powers of the root of r^4 = r + 1."""
    root = np.roots([1, 0, 0, -1, -1]).real.max()
    return np.array([key[i] / 2**32 + (octave + 1) / root ** (i + 1) for i in range(3)]) % 1


def gradient_of(key: Tensor, node: np.ndarray, octave: int, turns: float) -> np.ndarray:
    """Of one node: an axis at random, and a turn about it."""
    number = int(node[0]) + 2048 * int(node[1]) + 2048**2 * (int(node[2]) + 633 * octave)
    numbers = random.lattice_noise(key[None], [torch.tensor([[number]])], 2).flatten().double().numpy()
    high, low = np.divmod(numbers * 2048, 1)
    cosine, longitude = (high[0] + 0.5) / 1024 - 1, 2 * math.pi * low[0]
    rate = math.sqrt(2) * torch.special.ndtri(torch.tensor(low[1])).item()
    angle = 2 * math.pi * high[1] / 2048 + rate * turns
    sine = math.sqrt(1 - cosine**2)
    axis = np.array([sine * math.cos(longitude), sine * math.sin(longitude), cosine])
    start = np.array([cosine * math.cos(longitude), cosine * math.sin(longitude), -sine])
    return start * math.cos(angle) + np.cross(axis, start) * math.sin(angle)


def noise_at(key: Tensor, point: np.ndarray, octave: int = 0, turns: float = 0.0) -> float:
    """At one point, in periods: the sum over the nodes around it, one after the other."""
    first, total = np.floor(point), 0.0
    for corner in np.ndindex(2, 2, 2):
        away = point - first - corner
        t = 1 - np.abs(away)
        total += np.prod(t**3 * (t * (6 * t - 15) + 10)) * gradient_of(key, first + corner, octave, turns) @ away
    return float(total)


def test_the_noise_is_perlins_summed_node_by_node():
    key, planes, periods = keys(2), (4, 3), (1.3, 0.6)
    amplitude = torch.rand(2, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved, turns = torch.tensor([[0.0, 0, 0], [31.7, -4.1, 1e6]]).double(), torch.tensor([0.0, 0.8]).double()
    motion = {"moved": moved, "turns": turns}
    found = noise_on_planes(key, RAYS, DEPTHS, periods=periods, planes=planes, amplitude=amplitude, **motion)
    for n, k, i, j in np.ndindex(found.shape):
        ray = np.array([RAYS.left + j * RAYS.step_x, RAYS.top + i * RAYS.step_y, 1])
        expected = 0.0
        for octave in range(2):
            if k < planes[octave]:
                point = (DEPTHS[k] * ray - moved[n].numpy()) / periods[octave] + phase_of(key[n].tolist(), octave)
                noise = noise_at(key[n], point, octave, turns[n].item())
                expected += amplitude[n, octave, k].item() * noise
        assert found[n, k, i, j].item() == pytest.approx(expected, abs=1e-8)


def test_at_the_nodes_there_is_nothing_and_the_slope_is_the_gradient():
    key, period, step = keys(1), 2.0, 1e-4
    # The wind takes the phase away, so that the camera and all that is whole periods ahead are nodes.
    moved = torch.from_numpy(period * phase_of(key[0].tolist(), 0))[None]
    spread = Rays(-step, step, 3, -step, step, 3)
    depths = [0.0, *(period * node + d for node in (1, 2, 3) for d in (-step, 0, step))]
    found = noise_on_planes(
        key, spread, depths, periods=[period], planes=[10], amplitude=ones(1, 1, 10), **at_rest(1) | {"moved": moved}
    )[0]
    for node in (1, 2, 3):
        before, here, after = found[3 * node - 2 : 3 * node + 1]
        assert abs(here[1, 1]) < 1e-12
        across = 2 * step * period * node
        slope = [here[1, 2] - here[1, 0], here[2, 1] - here[0, 1], (after - before)[1, 1] * across / (2 * step)]
        expected = gradient_of(key[0], np.array([0, 0, node]), 0, 0.0)
        assert_close(period / across * torch.stack(slope), torch.from_numpy(expected), rtol=0, atol=1e-6)


def test_the_variance_is_that_over_all_gradients_and_places():
    p = (np.arange(2000) + 0.5) / 2000
    hat = 1 - p**3 * (p * (6 * p - 15) + 10)
    # A gradient of random direction has a third of the squared distance; eight nodes are alike over the cell.
    assert pytest.approx(8 * np.mean((hat * p) ** 2) * np.mean(hat**2) ** 2, rel=1e-6) == VARIANCE
    amplitude = ones(20_000, 1, 1)
    found = noise_on_planes(keys(20_000), ONE, [0.0], periods=[1.0], planes=[1], amplitude=amplitude, **at_rest(20_000))
    # The variance of so many has a deviation of about 1 %.
    assert found.square().mean().item() == pytest.approx(VARIANCE, rel=0.03)
    assert abs(found.mean()) < 4 * math.sqrt(VARIANCE / 20_000)


def test_the_mean_over_a_length_varies_as_the_correlation_says():
    # The correlation of the noise along an axis, averaged over its places in the cell.
    step = 1e-3
    t = np.arange(-1, 1, step) + step / 2
    s = 1 - np.abs(t)
    hat = s**3 * (s * (6 * s - 15) + 10)
    even, odd = (np.correlate(np.pad(h, (0, 2 * len(h))), h, "valid")[: len(h) + 1] for h in (hat, hat * t))
    correlation = odd * (hat**2).sum() ** 2 + 2 * even * (hat**2).sum() * ((hat * t) ** 2).sum()
    lag = np.arange(len(correlation)) * step
    for length in (0.1, 0.3, 1.0, 2.0, 3.0, 10.0):
        terms = np.clip(1 - lag / length, 0, None) * correlation / correlation[0]
        expected = math.sqrt(step / length * (2 * terms[1:].sum() + 1))
        assert deviation_of_mean(torch.tensor(length)).item() == pytest.approx(expected, rel=0.025)


def test_octaves_samples_and_far_places_do_not_correlate():
    amplitude = ones(20_000, 2, 2)
    first, second = amplitude.clone(), amplitude.clone()
    first[:, 1], second[:, 0] = 0, 0
    far = {"periods": [1.0, 1.0], "planes": [2, 2], **at_rest(20_000)}
    one, other = (noise_on_planes(keys(20_000), ONE, [0.0, 5.2], amplitude=a, **far) for a in (first, second))
    columns = torch.cat([one.flatten(1), other.flatten(1), one.flatten(1).roll(1, 0)], dim=1).T
    off = torch.corrcoef(columns) - torch.eye(6)
    assert off.abs().max() < 4 / math.sqrt(20_000)


@pytest.mark.parametrize("turns", [0.0, 0.3, 1.0, 2.0])
def test_in_place_the_noise_forgets_as_a_gaussian_of_time(turns):
    key, still = keys(20_000), at_rest(20_000)
    options: dict[str, Any] = {"periods": [1.0], "planes": [1], "amplitude": ones(20_000, 1, 1)}
    before = noise_on_planes(key, ONE, [0.0], **options, **still)
    after = noise_on_planes(key, ONE, [0.0], **options, **still | {"turns": still["turns"] + turns})
    correlation = torch.corrcoef(torch.stack([before.flatten(), after.flatten()]))[0, 1].item()
    assert correlation == pytest.approx(math.exp(-(turns**2)), abs=4 / math.sqrt(20_000))
    assert after.square().mean().item() == pytest.approx(VARIANCE, rel=0.03)


def test_float32_is_as_exact_after_long_as_at_first():
    key, turns = keys(3), torch.tensor([1e5 / 30]).expand(3)
    for late in (0.0, 1e5):
        motion = {"moved": late * torch.tensor([[0.31, -0.17, 20.0]]).double().expand(3, -1), "turns": turns}
        fine, coarse = (
            noise_on_planes(key, RAYS, DEPTHS, periods=[1.3], planes=[4], amplitude=ones(3, 1, 4).to(dtype), **motion)
            for dtype in (torch.float64, torch.float32)
        )
        assert_close(coarse.double(), fine, rtol=0, atol=5e-6)


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    amplitude = torch.rand(2, 2, 4, generator=generator, dtype=torch.float64)
    moved, turns = torch.rand(2, 3, generator=generator).double(), torch.rand(2, generator=generator).double()

    def noise(amplitude: Tensor, moved: Tensor, turns: Tensor) -> Tensor:
        motion = {"amplitude": amplitude, "moved": moved, "turns": turns}
        return noise_on_planes(keys(2), RAYS, DEPTHS, periods=(1.3, 0.6), planes=(4, 3), **motion)

    assert torch.autograd.gradcheck(noise, [value.requires_grad_() for value in (amplitude, moved, turns)])
