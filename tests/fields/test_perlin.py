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
from torchrefract.fields.perlin_lattice import Octave, octave

from torchrefract import random
from torchrefract.fields.perlin import perlin_noise

PERIODS = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
WEIGHTS = (0.30, 0.22, 0.15, 0.11, 0.08, 0.07)
GOLDEN = (math.sqrt(5) - 1) / 2
BOUND = math.sqrt(0.5)


def keys(*samples: int) -> Tensor:
    return random.noise_key(random.stream(5, torch.tensor(samples, dtype=torch.int64)))


def frame_of(
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
    """The octaves of a frame; numbers stand for all samples."""
    motion: Any = {
        "frame": torch.as_tensor(frame, dtype=torch.float64).expand(len(key)),
        "wind": torch.as_tensor(wind, dtype=torch.float64).expand(len(key), 2),
        "decorrelation": torch.as_tensor(decorrelation, dtype=torch.float64).expand(len(key)),
    }
    return [
        octave(key, i, period=period, height=height, width=width, **motion, dtype=dtype)
        for i, period in enumerate(periods)
    ]


def weights_of(count: int, periods: tuple[float, ...], dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(WEIGHTS[: len(periods)], dtype=dtype).repeat(count, 1)


def noise_of(key: Tensor, periods: tuple[float, ...], height: int, width: int, **motion) -> Tensor:
    octaves = frame_of(key, periods, height, width, **motion)
    return perlin_noise(octaves, weights_of(len(key), periods))


def quintic(s: float) -> float:
    return 6 * s**5 - 15 * s**4 + 10 * s**3


def corners(gradient: Callable[[int, int], np.ndarray], x: float, y: float, fade=quintic) -> float:
    """Perlin's noise at one point, as he wrote it: the four corners of the cell, weighted."""
    column, row = math.floor(x), math.floor(y)
    f, g = x - column, y - row
    total = 0.0
    for a, b in itertools.product((0, 1), (0, 1)):
        weight = (fade(f) if a else 1 - fade(f)) * (fade(g) if b else 1 - fade(g))
        along = gradient(column + a, row + b)
        total += weight * (along[0] * (f - a) + along[1] * (g - b))
    return total


def by_hand(
    key: Tensor, index: int, period: float, height: int, width: int, *, t: float, wind: tuple[float, float], tau: float
) -> np.ndarray:
    """(H, W): an octave pixel by pixel."""
    numbers = [int(word) for word in key[0]]
    phase = [(numbers[i] / 2**32 + (index + 1) * GOLDEN) % 1 for i in range(2)]
    x = [(j + 0.5 - wind[0] * t) / period + phase[0] for j in range(width)]
    y = [(i + 0.5 - wind[1] * t) / period + phase[1] for i in range(height)]
    axes = [torch.arange(math.floor(min(axis)), math.floor(max(axis)) + 2) for axis in (x, y)]
    u = (
        random.lattice_noise(key, [torch.tensor([[index]]), *(axis[None] for axis in axes)], 2)[0, :, 0]
        .double()
        .numpy()
    )
    angle = 2 * np.pi * u[0] + math.sqrt(2) * stats.norm.ppf(u[1]) * t / tau
    drawn = np.stack([np.cos(angle), np.sin(angle)], axis=2)

    def gradient(column: int, row: int) -> np.ndarray:
        return drawn[column - int(axes[0][0]), row - int(axes[1][0])]

    return np.array([[corners(gradient, a, b) for a in x] for b in y])


def directions(*shape: int, seed: int = 0) -> Tensor:
    """(N, 2, m, n), fp64: unit vectors."""
    angle = 2 * math.pi * torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def at(gradient: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(N, H, W), the noise of one lattice at x and y, in cells."""
    count = len(gradient)
    places = (axis.expand(count, -1) for axis in (x, y))
    return perlin_noise([Octave(gradient, *places)], gradient.new_ones(count, 1))[:, 0]


@pytest.mark.parametrize("motion", [(0.0, (0.0, 0.0), math.inf), (37.5, (1.3, -0.7), 21.0)])
@pytest.mark.parametrize(
    ("periods", "size"),
    [
        ((4.0, 8.0), (75, 131)),
        ((7.3, 2.5, 1.1), (41, 29)),
        ((1.0,), (17, 23)),
        ((0.5, 0.013), (31, 27)),
        ((300.0, 1e9), (19, 140)),
    ],
)
def test_the_noise_is_that_of_a_loop_over_pixels_and_corners(periods, size, motion, oracle):
    frame, wind, decorrelation = motion
    key = keys(3)
    found = noise_of(key, periods, *size, frame=frame, wind=wind, decorrelation=decorrelation)
    expected = sum(
        WEIGHTS[i] * by_hand(key, i, period, *size, t=frame, wind=wind, tau=decorrelation)
        for i, period in enumerate(periods)
    )
    oracle("Perlin noise, loop over pixels", found[0, 0], torch.from_numpy(expected), 1e-10, unit="")


def test_on_a_node_the_noise_is_zero_and_its_slope_the_drawn_one(oracle):
    gradient = directions(1, 7, 9)
    nodes, step = torch.arange(1, 6, dtype=torch.float64), 1e-5
    rows, columns = nodes[None], torch.arange(1, 8, dtype=torch.float64)[None]
    oracle("Perlin noise on nodes", at(gradient, columns, rows), torch.zeros(1, 5, 7), 1e-6, unit="")
    slope_x = (at(gradient, columns + step, rows) - at(gradient, columns - step, rows)) / (2 * step)
    slope_y = (at(gradient, columns, rows + step) - at(gradient, columns, rows - step)) / (2 * step)
    found = torch.stack([slope_x, slope_y], dim=1)
    oracle("slope of Perlin noise on nodes", found, gradient[:, :, 1:6, 1:8], 1e-6, unit="")


def test_the_bound_is_kept_and_reached(oracle):
    noise = noise_of(keys(*range(8)), (3.7,), 300, 300) / WEIGHTS[0]
    assert 0.9 * BOUND < noise.abs().max() < BOUND
    # All four gradients point at the center of the cell.
    inward = torch.tensor([[[1.0, -1.0], [1.0, -1.0]], [[1.0, 1.0], [-1.0, -1.0]]], dtype=torch.float64) * BOUND
    middle = torch.full((1, 1), 0.5, dtype=torch.float64)
    fine = torch.linspace(0, 1, 101, dtype=torch.float64)[None]
    for places in (middle, fine):
        largest = at(inward[None], places, places).amax()
        oracle("largest Perlin noise, sqrt(1/2)", largest, torch.tensor(BOUND, dtype=largest.dtype), 1e-12, unit="")


def bend_jump(noise: Callable[[Tensor], Tensor], step: float) -> float:
    """How far the second differences on both sides of the node x = 2 are apart."""
    right, left = (noise(2 + sign * step * torch.arange(3, dtype=torch.float64)) for sign in (1, -1))
    return ((right[2] - 2 * right[1]) - (left[2] - 2 * left[1])).abs().item() / step**2


def test_curvature_does_not_jump_between_cells_as_it_would_with_a_cubic_fade(oracle):
    gradient = directions(1, 4, 5)
    y = torch.tensor([1.3], dtype=torch.float64)

    def ours(x: Tensor) -> Tensor:
        return at(gradient, x[None], y[None])[0, 0]

    def of_corners(fade: Callable[[float], float]) -> Callable[[Tensor], Tensor]:
        drawn = gradient[0].numpy()
        return lambda x: torch.tensor([corners(lambda c, r: drawn[:, r, c], a, y.item(), fade) for a in x.tolist()])

    steps = (1e-2, 1e-3, 1e-4)
    jumps = [bend_jump(ours, step) for step in steps]
    assert jumps[0] < 2
    assert jumps[1] < 0.2 * jumps[0]
    assert jumps[2] < 0.2 * jumps[1]
    oracle("jump of Perlin noise's curvature, step 1e-4", torch.tensor(jumps[2]), torch.tensor(0.0), 0.08, unit="")
    for step in steps:
        assert bend_jump(of_corners(quintic), step) == pytest.approx(bend_jump(ours, step), abs=1e-6)
        assert bend_jump(of_corners(lambda s: 3 * s**2 - 2 * s**3), step) > 0.5


@pytest.mark.parametrize("elapsed", [6.0, 30.0, 60.0, 90.0])
def test_what_is_left_of_the_noise_after_a_while_is_the_gaussian_of_it(elapsed):
    decorrelation, start = 60.0, 1e4
    size = {"height": 900, "width": 900, "periods": (2.0, 3.0)}
    noise = [noise_of(keys(1), **size, frame=t, decorrelation=decorrelation) for t in (start, start + elapsed)]
    before, after = noise[0].square().mean(), noise[1].square().mean()
    expected = math.exp(-((elapsed / decorrelation) ** 2))
    assert ((noise[0] * noise[1]).mean() / (before * after).sqrt()).item() == pytest.approx(expected, abs=0.02)
    assert after.item() == pytest.approx(before.item(), rel=0.02)
    gradients = [
        frame_of(keys(1), (2.0,), 900, 900, frame=t, decorrelation=decorrelation)[0].gradient
        for t in (start, start + elapsed)
    ]
    assert_close(gradients[1].norm(dim=1), torch.ones(1, 452, 452, dtype=torch.float64), rtol=0, atol=1e-12)
    # The variance of cos(omega t) is at most 1, and 1/2 for a long t.
    assert (gradients[0] * gradients[1]).sum(dim=1).mean().item() == pytest.approx(expected, abs=5 / 452)


@pytest.mark.parametrize("start", [0.0, 1e5])
def test_the_wind_carries_the_pattern_along(start):
    periods, wind = (3.3, 16.0, 200.0), (3.0, -2.0)
    first, then = (
        noise_of(keys(4), periods, 60, 150, frame=start + t, wind=wind, dtype=torch.float32) for t in (0.0, 2.0)
    )
    assert first.std() > 0.05
    # Four rows up, six columns to the right.
    assert_close(then[:, :, :-4, 6:], first[:, :, 4:, :-6], rtol=0, atol=1e-5)
    assert (then - first).abs().max() > 0.1


def test_the_pattern_comes_back_at_no_time():
    first, *others = (
        noise_of(keys(4), (4.0, 8.0), 200, 200, frame=t, wind=(0.32, 0.0)).flatten() for t in (0.0, 1e3, 1e5, 1e7)
    )
    for other in others:
        assert torch.corrcoef(torch.stack([first, other]))[0, 1].abs() < 0.05
        assert other.std().item() == pytest.approx(first.std().item(), rel=0.1)


@pytest.mark.parametrize("size", [(36, 128), (37, 129), (110, 300)])
def test_part_of_a_frame_shows_what_the_frame_shows_there(size):
    octaves = frame_of(keys(2), PERIODS, 200, 400, frame=9.0, wind=(0.7, 0.1), decorrelation=30.0)
    whole = perlin_noise(octaves, weights_of(1, PERIODS))
    top, left = 61, 97
    parts = []
    for gradient, *places in octaves:
        x, y = places[0][:, left : left + size[1]], places[1][:, top : top + size[0]]
        column, row = int(x[0, 0]), int(y[0, 0])
        # With the nodes that the part needs, and no others.
        nodes = gradient[:, :, row : int(y[0, -1]) + 2, column : int(x[0, -1]) + 2]
        parts.append(Octave(nodes, x - column, y - row))
    found = perlin_noise(parts, weights_of(1, PERIODS))
    assert_close(found, whole[:, :, top : top + size[0], left : left + size[1]], rtol=0, atol=1e-12)


def test_octaves_and_keys_differ():
    fields = torch.cat(
        [
            torch.cat([noise_of(keys(sample), (5.0,), 300, 300) for sample in (1, 2)]),
            perlin_noise(frame_of(keys(1), (9.0, 5.0), 300, 300)[1:], torch.ones(1, 1)),
        ]
    ).flatten(1)
    off = torch.corrcoef(fields) - torch.eye(3, dtype=fields.dtype)
    assert off.abs().max() < 5 / 60  # as many as 60^2 cells


@pytest.mark.parametrize("frame", [0.0, 3.0, 1e4])
def test_float32_is_as_good_as_float64(frame):
    motion = {"frame": frame, "wind": (1.7, 0.3), "decorrelation": 25.0}
    found, exact = (noise_of(keys(6), PERIODS, 211, 1397, **motion, dtype=d) for d in (torch.float32, torch.float64))
    assert found.dtype == torch.float32
    assert_close(found.double(), exact, rtol=0, atol=1e-5)


def motions(count: int) -> dict[str, Tensor]:
    """Of samples that differ in all, the first at rest."""
    each = torch.arange(count).double()
    return {"frame": 3.5 * each, "wind": torch.stack([1.3 - each, 0.2 * each], dim=1), "decorrelation": 40 + each}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("size", "periods"), [((97, 391), PERIODS), ((50, 333), (2.7, 1.0)), ((1, 7), (3.0,))])
def test_every_sample_of_a_batch_is_made_by_itself_bit_for_bit(size, periods, dtype):
    key, motion = keys(0, 1, 2, 3), motions(4)

    def made(chosen: list[int]) -> list[Tensor]:
        moved = (motion[name][chosen] for name in ("frame", "wind", "decorrelation"))
        octaves = frame_of(key[chosen], periods, *size, *moved, dtype=dtype)
        weights = torch.rand(4, len(periods), generator=torch.Generator().manual_seed(1))[chosen]
        return [perlin_noise(octaves, weights), *itertools.chain(*octaves)]

    together = made([0, 1, 2, 3])
    for chosen in ([0], [1], [2], [3], [3, 1, 0], [2, 2]):
        for found, expected in zip(made(chosen), together, strict=True):
            assert torch.equal(found, expected[chosen])


@pytest.mark.parametrize("size", [(1080, 1920), (719, 1281)])
def test_threads_do_not_change_a_bit(size, on_threads):
    found = []
    for threads in (1, 2, 3):
        on_threads(threads)
        octaves = frame_of(keys(1), PERIODS, *size, frame=2.5, wind=(1.1, 0.4), decorrelation=50.0, dtype=torch.float32)
        weights = weights_of(1, PERIODS)
        found.append([perlin_noise(octaves, weights), *itertools.chain(*octaves)])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, found[0], strict=True))


def test_gradients_need_no_other_noise():
    octaves = frame_of(keys(1, 2), PERIODS, 75, 200, dtype=torch.float32)
    weights = weights_of(2, PERIODS, torch.float32)
    assert torch.equal(perlin_noise(octaves, weights.clone().requires_grad_()), perlin_noise(octaves, weights))


def test_gradients_of_the_noise_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(2)
    weights = torch.rand(2, 2, generator=generator, dtype=torch.float64)
    # Off the nodes and on them, where the noise is smooth as well.
    x = torch.tensor([[0.0, 0.4, 1.0, 1.7], [0.2, 0.9, 1.1, 2.0]], dtype=torch.float64)
    y = torch.tensor([[0.1, 0.8, 1.3], [1.0, 1.5, 1.9]], dtype=torch.float64)
    parts = [directions(2, 3, 3, seed=3), x, y, directions(2, 3, 4, seed=4), 1.3 * x, 0.7 * y]

    def made(weights: Tensor, *parts: Tensor) -> Tensor:
        return perlin_noise([Octave(*parts[:3]), Octave(*parts[3:])], weights)

    inputs = [tensor.requires_grad_() for tensor in (weights, *parts)]
    assert torch.autograd.gradcheck(made, inputs)


def test_gradients_over_many_bands_and_stripes_are_those_of_finite_differences():
    octaves = frame_of(keys(1), (30.0, 200.0), 75, 259)
    generator = torch.Generator().manual_seed(5)
    seen = torch.randn(75, 259, generator=generator, dtype=torch.float64) / 75

    def made(weights: Tensor, shift: Tensor, factor: Tensor) -> Tensor:
        moved = [Octave(o.gradient * factor[i], o.x + shift[0], o.y + shift[1]) for i, o in enumerate(octaves)]
        return (perlin_noise(moved, weights) * seen).sum()

    shift, factor = torch.tensor([1e-3, 2e-3]).double(), torch.tensor([0.9, 1.1]).double()
    inputs = [tensor.requires_grad_() for tensor in (weights_of(1, (1.0, 2.0)), shift, factor)]
    assert torch.autograd.gradcheck(made, inputs)


def test_gradients_of_the_motion_are_those_of_finite_differences():
    key = keys(1, 2)

    def made(frame: Tensor, wind: Tensor, decorrelation: Tensor) -> Tensor:
        octaves = frame_of(key, (3.0, 9.0), 4, 5, frame, wind, decorrelation)
        return perlin_noise(octaves, weights_of(2, (3.0, 9.0)))

    inputs = [torch.tensor([0.0, 7.0]), torch.tensor([[0.3, -0.2], [0.0, 0.1]]), torch.tensor([20.0, 35.0])]
    assert torch.autograd.gradcheck(made, [value.double().requires_grad_() for value in inputs])


def moving_noise(key: Tensor, frame: Tensor, wind: Tensor, decorrelation: Tensor, weights: Tensor) -> Tensor:
    motion: Any = {"frame": frame, "wind": wind, "decorrelation": decorrelation}
    octaves = [
        octave(key, i, period=p, height=80, width=140, **motion, dtype=torch.float32) for i, p in enumerate((2.5, 30.0))
    ]
    return perlin_noise(octaves, weights)


def arguments() -> tuple[Tensor, ...]:
    motion = {name: value.float() for name, value in motions(3).items()}
    return keys(1, 2, 3), motion["frame"], motion["wind"], motion["decorrelation"], weights_of(3, (1.0, 2.0)).float()


def test_one_graph_gives_the_same_noise():
    compiled = torch.compile(moving_noise, fullgraph=True)
    assert_close(compiled(*arguments()), moving_noise(*arguments()), rtol=0, atol=1e-5)


def test_one_graph_gives_the_same_gradient():
    inputs = [value.requires_grad_() if value.is_floating_point() else value for value in arguments()]
    compiled = torch.compile(moving_noise, fullgraph=True, backend="aot_eager")
    found, expected = compiled(*inputs), moving_noise(*inputs)
    assert_close(found, expected, rtol=0, atol=1e-5)
    slopes = (torch.autograd.grad(noise.square().mean(), inputs[1:]) for noise in (found, expected))
    for one_graph, eager in zip(*slopes, strict=True):
        assert_close(one_graph, eager, rtol=1e-3, atol=1e-6)


def test_a_map_over_samples_gives_the_same_noise():
    def mapped(*sample: Tensor) -> Tensor:
        return moving_noise(*(value[None] for value in sample))[0]

    assert_close(torch.func.vmap(mapped)(*arguments()), moving_noise(*arguments()), rtol=0, atol=1e-5)


def test_autocast_changes_nothing():
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = moving_noise(*arguments())
    assert torch.equal(found, moving_noise(*arguments()))


@pytest.mark.parametrize("size", [(1, 1), (1, 263), (131, 1), (37, 131), (0, 5), (5, 0)])
@pytest.mark.parametrize("periods", [(1.0, 0.7), PERIODS, (1e12,)])
def test_frames_of_any_size_are_finite(size, periods):
    for count in (0, 2):
        octaves = frame_of(keys(*range(count)), periods, *size, *motions(count).values(), dtype=torch.float32)
        found = perlin_noise(octaves, weights_of(count, periods))
        assert found.shape == (count, 1, *size)
        assert found.dtype == torch.float32
        assert found.isfinite().all()
        if 0 not in size:
            assert not count or found.abs().max() > 0
