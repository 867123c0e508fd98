import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields.fog_volume import (
    VARIANCE,
    ExtinctionField,
    Rays,
    deviation_of_mean,
    extinction_on_planes,
    log_field_pace,
    mean_extinction_along_rays,
    noise_on_planes,
)
from torchrefract.fields.random_field import Motion

SCALES, WEIGHTS, REACH = (10.0, 20.0, 40.0, 80.0), (0.4, 0.3, 0.2, 0.1), 400.0
# A frame of 16:9 with a field of view of 88 degrees.
WIDE: dict[str, Any] = {"height": 54, "width": 96, "focal": (50.0, 50.0), "center": (47.5, 26.5)}
SMALL: dict[str, Any] = {"height": 27, "width": 48, "focal": (40.0, 42.0), "center": (23.0, 14.0)}
RAYS, ONE_RAY = Rays(-0.8, 0.37, 5, 0.1, 0.45, 3), Rays(0.0, 0.0, 1, 0.0, 0.0, 1)
DEPTHS = (0.0, 0.7, 2.9, 11.3)


def keys(samples: int, seed: int = 3) -> Tensor:
    return random.noise_key(random.stream(seed, torch.arange(samples)))


def still_fogs(samples: int, contrast: float = 0.6) -> dict[str, Any]:
    """Return parameters of fogs that neither move nor change."""
    one = {"weights": WEIGHTS, "contrast": contrast, "frame": 0.0, "wind": (0.0, 0.0, 0.0), "decorrelation": math.inf}
    return {name: torch.tensor([value] * samples, dtype=torch.float64) for name, value in one.items()}


def moving_fogs(samples: int, dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """Return parameters of fogs that move and change, each in another way."""
    numbers = torch.rand(samples, 10, generator=torch.Generator().manual_seed(1), dtype=dtype)
    return {
        "weights": 0.1 + numbers[:, :4],
        "contrast": 0.5 + 0.3 * numbers[:, 4],
        "frame": 10 * numbers[:, 5],
        "wind": numbers[:, 6:9] - 0.5,
        "decorrelation": 20 + 10 * numbers[:, 9],
    }


def distances(samples: int, height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return 500 * torch.rand(samples, 1, height, width, generator=generator, dtype=dtype) ** 2


def field_of(key: Tensor, parameters: dict[str, Any]) -> ExtinctionField:
    motion = Motion(*(parameters[name] for name in Motion._fields))
    return ExtinctionField(key, parameters["weights"], parameters["contrast"], motion)


def mean_extinction(key: Tensor, distance: Tensor, **options: Any) -> Tensor:
    options = {"scales": SCALES, "reach": REACH} | SMALL | options
    field = field_of(key, options)
    names = ("height", "width", "focal", "center", "scales", "reach")
    return mean_extinction_along_rays(field, distance, **{name: options[name] for name in names})


def mean_up_to(distance: float, key: Tensor | None = None, **options: Any) -> Tensor:
    """Return m of one sample, (H, W), for one distance."""
    options = WIDE | still_fogs(1) | options
    key, rows = keys(1) if key is None else key, torch.full((1, 1, options["height"], 1), distance).double()
    return mean_extinction(key, rows, **options)[0, 0]


def extinction_at_camera(parameters: dict[str, Any]) -> Tensor:
    """Return q at the camera, (N,)."""
    key = keys(len(parameters["frame"]))
    options: dict[str, Any] = {"scales": SCALES, "reach": 1e-3, "dtype": torch.float64}
    return 1 + extinction_on_planes(field_of(key, parameters), ONE_RAY, **options)[:, 0, 0, 0]


def correlation_of(first: Tensor, second: Tensor) -> float:
    return torch.corrcoef(torch.stack([first.flatten(), second.flatten()]))[0, 1].item()


def noise_at_points(key: Tensor, points: np.ndarray, octave: int, turns: float) -> np.ndarray:
    """Compute Perlin noise at points (P, 3), in periods, from the eight nodes around each."""
    root = np.roots([1, 0, 0, -1, -1]).real.max()
    points = points + np.mod([int(key[0, i]) / 2**32 + (octave + 1) / root ** (i + 1) for i in range(3)], 1)
    first, noise = np.floor(points), np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        node, away = (first + corner).astype(np.int64), points - first - corner
        number = torch.from_numpy(node @ [1, 2048, 2048**2] + 2048**2 * 633 * octave)
        uniform = random.lattice_noise(key, [number[None]], 2)[0].double().numpy()
        (high, high2), (low, low2) = np.divmod(2048 * uniform, 1)
        cosine, longitude = (high + 0.5) / 1024 - 1, 2 * math.pi * low
        angle = 2 * math.pi * high2 / 2048 + math.sqrt(2) * torch.special.ndtri(torch.from_numpy(low2)).numpy() * turns
        east = np.stack([-np.sin(longitude), np.cos(longitude), 0 * longitude], axis=1)
        south = np.stack([cosine * np.cos(longitude), cosine * np.sin(longitude), -np.sqrt(1 - cosine**2)], axis=1)
        gradient = south * np.cos(angle)[:, None] + east * np.sin(angle)[:, None]
        t = 1 - np.abs(away)
        noise += np.prod(t**3 * (t * (6 * t - 15) + 10), axis=1) * (gradient * away).sum(axis=1)
    return noise


def mean_by_summation(key: Tensor, ray: np.ndarray, ends: list[float], parameters: dict[str, Any]) -> np.ndarray:
    """Compute m along a ray by a sum over steps of 1/4 m."""
    weights, contrast, frame, wind, decorrelation = (value[0].numpy() for value in parameters.values())
    s = (np.arange(4 * math.ceil(max(ends))) + 0.5) / 4
    points = s[:, None] * ray / np.linalg.norm(ray) - wind * frame
    octaves = (noise_at_points(key, points / scale, i, float(frame / decorrelation)) for i, scale in enumerate(SCALES))
    g = weights @ np.stack(list(octaves)) / math.sqrt(VARIANCE * (weights**2).sum())
    q = np.exp(contrast * g - contrast**2 / 2)
    return np.array([q[s < end].mean() for end in ends])


@pytest.mark.quick
def test_noise_on_planes_equals_a_sum_over_nodes():
    key, planes, periods = keys(2), (4, 3), (1.3, 0.6)
    amplitude = torch.rand(2, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved, turns = torch.tensor([[0.0, 0, 0], [31.7, -4.1, 1e6]]).double(), torch.tensor([0.0, 0.8]).double()
    motion = {"moved": moved, "turns": turns}
    noise = noise_on_planes(key, RAYS, DEPTHS, periods=periods, planes=planes, amplitude=amplitude, **motion)
    y, x = np.mgrid[:3, :5]
    slopes = np.stack([RAYS.left + x * RAYS.step_x, RAYS.top + y * RAYS.step_y, np.ones((3, 5))], axis=-1)
    for n, k in np.ndindex(2, 4):
        expected = np.zeros(15)
        for octave in range(2):
            if k < planes[octave]:
                points = (DEPTHS[k] * slopes.reshape(-1, 3) - moved[n].numpy()) / periods[octave]
                octave_noise = noise_at_points(key[n : n + 1], points, octave, turns[n].item())
                expected += amplitude[n, octave, k].item() * octave_noise
        assert_close(noise[n, k].flatten(), torch.from_numpy(expected), rtol=0, atol=1e-8)


def test_the_variance_of_the_noise_is_that_over_all_gradients_and_places():
    p = (np.arange(2000) + 0.5) / 2000
    hat = 1 - p**3 * (p * (6 * p - 15) + 10)
    # A gradient of random direction has a third of the squared distance; eight nodes are alike over the cell.
    assert pytest.approx(8 * np.mean((hat * p) ** 2) * np.mean(hat**2) ** 2, rel=1e-6) == VARIANCE
    still: dict[str, Any] = {"moved": torch.zeros(20_000, 3), "turns": torch.zeros(20_000)}
    amplitude = torch.ones(20_000, 1, 1, dtype=torch.float64)
    noise = noise_on_planes(keys(20_000), ONE_RAY, [0.0], periods=[1.0], planes=[1], amplitude=amplitude, **still)
    assert noise.square().mean().item() == pytest.approx(VARIANCE, rel=0.03)  # three standard deviations
    assert abs(noise.mean()) < 4 * math.sqrt(VARIANCE / 20_000)


def test_the_deviation_of_a_mean_over_a_length_follows_from_the_correlation():
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


def test_the_extinction_has_its_mean_and_its_contrast():
    samples, contrast = 10_000, 0.6
    q = extinction_at_camera(still_fogs(samples, contrast))
    assert q.mean().item() == pytest.approx(1, abs=0.02)
    assert q.log().std().item() == pytest.approx(contrast, rel=0.05)
    assert q.log().mean().item() == pytest.approx(-(contrast**2) / 2, abs=4 * contrast / math.sqrt(samples))


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_contrast_the_mean_is_one_for_every_distance(dtype):
    distance = distances(2, 27, 48, dtype)
    distance[0, 0, 0, :4] = torch.tensor([0.0, 1e-12, math.inf, 400.0])
    for d in (distance, distance[..., :1], distance[:1], distance[:1, :, :, :1]):
        m = mean_extinction(keys(2), d, **still_fogs(2, contrast=0.0))
        assert torch.equal(m, torch.ones(2, 1, 27, 48, dtype=dtype))


def test_the_mean_equals_the_extinction_summed_along_rays():
    ends = [2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0]
    errors, deviations = [], []
    for seed in range(3):
        parameters = moving_fogs(1) | {name: still_fogs(1)[name] for name in ("weights", "contrast")}
        means = [mean_up_to(end, keys(1, seed), **parameters) for end in ends]
        for y, x in np.random.default_rng(seed).integers((54, 96), size=(8, 2)):
            ray = np.array([(x - 47.5) / 50, (y - 26.5) / 50, 1])
            expected = mean_by_summation(keys(1, seed), ray, ends, parameters)
            errors.append([m[y, x].item() - e for m, e in zip(means, expected, strict=True)])
            deviations.append(expected - 1)
    error, deviation = (np.sqrt(np.mean(np.square(values), axis=0)) for values in (errors, deviations))
    assert np.sqrt(np.mean(error**2)) < 0.03
    # Up to 100 m the rays resolve the finest noise.
    assert error[:6].max() < 0.025
    assert (error / deviation)[:6].max() < 0.1


@pytest.mark.parametrize("columns", [1, 48])
def test_no_mean_is_negative_at_high_contrast(columns):
    assert mean_extinction(keys(8), distances(8, 27, columns), **still_fogs(8, contrast=4.0)).min() == 0


def test_noise_too_fine_for_the_rays_is_left_out():
    m = mean_up_to(300.0, scales=(1e-3,), weights=torch.ones(1, 1).double())
    assert_close(m, torch.ones_like(m), rtol=0, atol=2e-3)


def test_the_wind_moves_near_fog_by_focal_length_over_distance():
    wind, focal, near, far = 2.0, 200.0, 8.0, 12.0
    options: dict[str, Any] = {"height": 90, "width": 320, "focal": (focal, focal), "center": (159.5, 44.5)}
    options |= {"scales": (4.0, 16.0), "weights": torch.ones(1, 2).double()}
    moved = {"frame": torch.ones(1), "wind": torch.tensor([[wind, 0.0, 0.0]])}

    def layer(key: Tensor, motion: dict[str, Any]) -> Tensor:
        """Return the optical depth between two distances."""
        return far * mean_up_to(far, key, **options, **motion) - near * mean_up_to(near, key, **options, **motion)

    shifts = []
    for seed in range(4):
        before, after = (layer(keys(1, seed), motion) for motion in ({}, moved))
        matches = [correlation_of(before[:, 100:200], after[:, 100 + shift : 200 + shift]) for shift in range(60)]
        assert max(matches) > 0.8
        shifts.append(int(np.argmax(matches)))
    assert np.mean(shifts) == pytest.approx(focal * wind / ((near + far) / 2), rel=0.1)


@pytest.mark.parametrize("contrast", [0.6, 1.5])
def test_the_logarithm_of_the_extinction_decorrelates_as_a_gaussian_of_time(contrast):
    tau, samples, times = 30.0, 4_000, (0.0, 15.0, 30.0, 60.0)
    parameters = still_fogs(samples, contrast) | {"decorrelation": torch.full((samples,), tau)}
    before, *after = (extinction_at_camera(parameters | {"frame": torch.full((samples,), t)}).log() for t in times)
    pace = -math.log(math.log1p(math.expm1(contrast**2) / math.e) / contrast**2)
    for t, later in zip(times[1:], after, strict=True):
        expected = math.exp(-pace * (t / tau) ** 2)
        assert correlation_of(before, later) == pytest.approx(expected, abs=3 / math.sqrt(samples))


def test_the_exponential_of_a_gaussian_field_has_the_correlation_1_over_e_after_its_time():
    variance = torch.tensor([1e-12, 1e-6, 9.99e-5, 1.01e-4, 1e-2, 0.36, 4.0, 100.0], dtype=torch.float64)
    correlation = torch.exp(-log_field_pace(variance).square())
    ratio = torch.expm1(variance * correlation) / torch.expm1(variance)
    assert_close(ratio, torch.full_like(variance, math.exp(-1)), rtol=1e-8, atol=0)
    ends = torch.tensor([0.0, 900.0], dtype=torch.float64, requires_grad=True)
    pace = log_field_pace(ends)
    assert_close(pace, torch.tensor([1.0, math.sqrt(math.log(900 / 899))], dtype=torch.float64))
    assert torch.autograd.grad(pace.sum(), ends)[0].isfinite().all()


@pytest.mark.parametrize("columns", [1, 12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_and_gradients_are_finite_at_every_distance(columns, dtype):
    distance = torch.tensor([0.0, 1e-30, 1e-6, 399.9, 400.0, 400.1, 800.0, 1e12, 1e30, math.inf], dtype=dtype)
    distance = distance[None, None, :, None].expand(2, -1, -1, columns).clone().requires_grad_()
    parameters = {name: value.requires_grad_() for name, value in moving_fogs(2, dtype).items()}
    m = mean_extinction(keys(2), distance, height=10, width=12, focal=(10.0, 10.0), center=(5.5, 4.5), **parameters)
    assert m.isfinite().all()
    # At the camera all rays meet; infinitely far away m is the mean of the field.
    assert_close(m[:, :, 0], m[:, :, 0, :1].expand(-1, -1, 12), rtol=0, atol=1e-6)
    assert torch.equal(m[:, :, 9], torch.ones_like(m[:, :, 9]))
    for gradient in torch.autograd.grad(m.square().sum(), [distance, *parameters.values()]):
        assert gradient.isfinite().all()


def test_beyond_the_reach_the_fog_is_uniform():
    at_reach = mean_up_to(400.0)
    assert_close(mean_up_to(1000.0), (400 * at_reach + 600) / 1000, rtol=0, atol=1e-12)
    assert (at_reach - 1).abs().max() > 0.1


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 5e-5), (torch.float64, 1e-11)])
def test_distances_by_row_and_by_pixel_give_the_same_mean(dtype, atol):
    distance, parameters = distances(2, 54, 1, dtype), moving_fogs(2, dtype)
    rows, pixels = (
        mean_extinction(keys(2), d, **WIDE, **parameters) for d in (distance, distance.expand(-1, -1, -1, 96))
    )
    assert_close(rows, pixels, rtol=0, atol=atol)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 40), (40, 1), (7, 5)])
def test_small_frames_show_the_same_fog(height, width):
    size = {"focal": (50.0, 50.0), "center": (3.0, 2.0), "height": height, "width": width}
    ray = np.array([(width - 1 - 3) / 50, (height - 1 - 2) / 50, 1])
    expected = mean_by_summation(keys(1), ray, [30.0], still_fogs(1))[0]
    for columns in (1, width):
        distance = torch.full((1, 1, height, columns), 30.0).double()
        m = mean_extinction(keys(1), distance, **size, **still_fogs(1))
        assert m[0, 0, -1, -1].item() == pytest.approx(expected, abs=0.03)


def test_float32_is_as_exact_at_late_frames_as_at_first():
    distance, parameters = distances(1, 27, 48), moving_fogs(1) | {"wind": torch.tensor([[0.3, -0.1, -20.0]]).double()}
    for frame in (0.0, 1e5):
        parameters["frame"] = torch.full((1,), frame).double()
        double, single = (
            mean_extinction(keys(1), distance.to(t), **parameters) for t in (torch.float64, torch.float32)
        )
        assert_close(single.double(), double, rtol=0, atol=1e-4)


@pytest.mark.parametrize("columns", [1, 4])
def test_gradients_match_finite_differences(columns):
    size, parameters = {"height": 3, "width": 4, "focal": (4.0, 4.0), "center": (1.5, 1.0)}, moving_fogs(1)

    def m(distance: Tensor, *values: Tensor) -> Tensor:
        return mean_extinction(keys(1), distance, **size, **dict(zip(parameters, values, strict=True)))

    # Between the slices, at which the mean has a kink.
    inputs = [value.requires_grad_() for value in (1 + distances(1, 3, columns), *parameters.values())]
    assert torch.autograd.gradcheck(m, inputs, fast_mode=True)
