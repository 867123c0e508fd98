import math
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields import fog_volume
from torchrefract.fields.fog_volume import path_mean
from torchrefract.fields.perlin3d import VARIANCE, Rays

SCALES, WEIGHTS, REACH = (10.0, 20.0, 40.0, 80.0), (0.4, 0.3, 0.2, 0.1), 400.0
# A frame of 16:9 and 88 degrees.
WIDE: dict[str, Any] = {"height": 54, "width": 96, "focal": (50.0, 50.0), "center": (47.5, 26.5)}
SMALL: dict[str, Any] = {"height": 27, "width": 48, "focal": (40.0, 42.0), "center": (23.0, 14.0)}


def keys(samples: int, seed: int = 3) -> Tensor:
    return random.noise_key(random.stream(seed, torch.arange(samples)))


def still(samples: int, contrast: float = 0.6) -> dict[str, Any]:
    """Fogs that neither move nor change."""
    one = {"weights": WEIGHTS, "contrast": contrast, "frame": 0.0, "wind": (0.0, 0.0, 0.0), "decorrelation": math.inf}
    return {name: torch.tensor([value] * samples, dtype=torch.float64) for name, value in one.items()}


def drawn(samples: int, dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """Fogs that move and change, each in its own way."""
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


def field(key: Tensor, distance: Tensor, **options: Any) -> Tensor:
    options = {"scales": SCALES, "reach": REACH, "dtype": distance.dtype} | SMALL | options
    return path_mean(key, distance, **options)


def mean_at(distance: float, key: Tensor | None = None, **options: Any) -> Tensor:
    """m of one sample, (H, W), for one distance."""
    options = WIDE | still(1) | options
    key, rows = keys(1) if key is None else key, torch.full((1, 1, options["height"], 1), distance).double()
    return field(key, rows, **options)[0, 0]


def at_camera(parameters: dict[str, Any]) -> Tensor:
    """q where the camera is, (N,)."""
    many, ahead = fog_volume._Fog(keys(len(parameters["frame"])), **parameters), Rays(0.0, 0.0, 1, 0.0, 0.0, 1)
    return 1 + fog_volume._excess(ahead, many, scales=SCALES, reach=1e-3, dtype=torch.float64)[:, 0, 0, 0]


def alike(first: Tensor, second: Tensor) -> float:
    return torch.corrcoef(torch.stack([first.flatten(), second.flatten()]))[0, 1].item()


def noise_along(key: Tensor, points: np.ndarray, octave: int, turns: float) -> np.ndarray:
    """Perlin noise at points (P, 3), in periods, by the eight nodes around each."""
    root = np.roots([1, 0, 0, -1, -1]).real.max()
    points = points + np.mod([int(key[0, i]) / 2**32 + (octave + 1) / root ** (i + 1) for i in range(3)], 1)
    first, noise = np.floor(points), np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        node, away = (first + corner).astype(np.int64), points - first - corner
        number = torch.from_numpy(node @ [1, 2048, 2048**2] + 2048**2 * 633 * octave)
        (high, high2), (low, low2) = np.divmod(
            2048 * random.lattice_noise(key, [number[None]], 2)[0].double().numpy(), 1
        )
        cosine, longitude = (high + 0.5) / 1024 - 1, 2 * math.pi * low
        angle = 2 * math.pi * high2 / 2048 + math.sqrt(2) * torch.special.ndtri(torch.from_numpy(low2)).numpy() * turns
        east = np.stack([-np.sin(longitude), np.cos(longitude), 0 * longitude], axis=1)
        south = np.stack([cosine * np.cos(longitude), cosine * np.sin(longitude), -np.sqrt(1 - cosine**2)], axis=1)
        gradient = south * np.cos(angle)[:, None] + east * np.sin(angle)[:, None]
        t = 1 - np.abs(away)
        noise += np.prod(t**3 * (t * (6 * t - 15) + 10), axis=1) * (gradient * away).sum(axis=1)
    return noise


def summed(key: Tensor, ray: np.ndarray, ends: list[float], parameters: dict[str, Any]) -> np.ndarray:
    """m along a ray by a sum over steps of 1/4 m."""
    weights, contrast, frame, wind, decorrelation = (value[0].numpy() for value in parameters.values())
    s = (np.arange(4 * math.ceil(max(ends))) + 0.5) / 4
    points = s[:, None] * ray / np.linalg.norm(ray) - wind * frame
    octaves = (noise_along(key, points / scale, i, float(frame / decorrelation)) for i, scale in enumerate(SCALES))
    g = weights @ np.stack(list(octaves)) / math.sqrt(VARIANCE * (weights**2).sum())
    q = np.exp(contrast * g - contrast**2 / 2)
    return np.array([q[s < end].mean() for end in ends])


def test_the_extinction_has_its_mean_and_its_contrast():
    samples, contrast = 10_000, 0.6
    q = at_camera(still(samples, contrast))
    assert q.mean().item() == pytest.approx(1, abs=0.02)
    assert q.log().std().item() == pytest.approx(contrast, rel=0.05)
    assert q.log().mean().item() == pytest.approx(-(contrast**2) / 2, abs=4 * contrast / math.sqrt(samples))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_contrast_the_mean_is_one_for_every_distance(dtype):
    distance = distances(2, 27, 48, dtype)
    distance[0, 0, 0, :4] = torch.tensor([0.0, 1e-12, math.inf, 400.0])
    distance[1, 0, :3, 0] = torch.tensor([math.inf, 1e30, 0.0])
    for d in (distance, distance[..., :1], distance[:1], distance[:1, :, :, :1]):
        assert torch.equal(field(keys(2), d, **still(2, contrast=0.0)), torch.ones(2, 1, 27, 48, dtype=dtype))


def test_the_mean_is_that_of_the_extinction_summed_along_rays():
    ends = [2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0]
    errors, deviations = [], []
    for seed in range(4):
        key, parameters = keys(1, seed), drawn(1) | {name: still(1)[name] for name in ("weights", "contrast")}
        found = [mean_at(end, key, **parameters) for end in ends]
        for y, x in np.random.default_rng(seed).integers((54, 96), size=(8, 2)):
            expected = summed(key, np.array([(x - 47.5) / 50, (y - 26.5) / 50, 1]), ends, parameters)
            errors.append([m[y, x].item() - e for m, e in zip(found, expected, strict=True)])
            deviations.append(expected - 1)
    error, deviation = (np.sqrt(np.mean(np.square(values), axis=0)) for values in (errors, deviations))
    assert np.sqrt(np.mean(error**2)) < 0.03
    # Up to 100 m, where the rays still resolve the finest noise, a tenth of what m varies by at most.
    assert error[:6].max() < 0.025
    assert (error / deviation)[:6].max() < 0.1


def test_the_mean_over_fogs_and_pixels_is_one():
    parameters = {name: value.float() for name, value in still(300).items()} | {"weights": torch.ones(300, 2)}
    distance = torch.tensor([50.0, 100.0, 200.0]).repeat(9)[None, None, :, None]
    found = field(keys(300), distance, **parameters, scales=(10.0, 20.0), reach=200.0)[:, 0].unflatten(1, (9, 3))
    assert_close(found.mean(dim=(0, 1, 3)), torch.ones(3), rtol=0, atol=0.02)


def test_however_high_the_contrast_no_mean_is_negative():
    for columns in (1, 48):
        assert field(keys(8), distances(8, 27, columns), **still(8, contrast=4.0)).min() == 0


def test_noise_finer_than_the_rays_can_see_is_left_out():
    for scale in (1e-3, 1e-2):
        found = mean_at(300.0, scales=(scale,), weights=torch.ones(1, 1).double())
        assert_close(found, torch.ones_like(found), rtol=0, atol=2e-3)


def layer(near: float, far: float, *args: Any, **options: Any) -> Tensor:
    """What lies between two distances."""
    return far * mean_at(far, *args, **options) - near * mean_at(near, *args, **options)


@pytest.mark.parametrize(("near", "far", "tried"), [(8.0, 12.0, range(60)), (95.0, 105.0, range(20))])
def test_near_fog_passes_faster_than_far_fog(near, far, tried):
    wind, focal = 2.0, 200.0
    options: dict[str, Any] = {"height": 90, "width": 320, "focal": (focal, focal), "center": (159.5, 44.5)}
    options |= {"scales": (4.0, 16.0), "weights": torch.ones(1, 2).double()}
    moved = {"frame": torch.ones(1), "wind": torch.tensor([[wind, 0.0, 0.0]])}
    found = []
    for seed in range(6):
        before, after = (layer(near, far, keys(1, seed), **options, **motion) for motion in ({}, moved))
        fits = np.array([alike(before[:, 100:200], after[:, 100 + shift : 200 + shift]) for shift in tried])
        best = int(fits[1:-1].argmax()) + 1
        left, here, right = fits[best - 1 : best + 2]
        assert here > 0.8
        found.append(best + (left - right) / (2 * (left - 2 * here + right)))
    assert np.mean(found) == pytest.approx(focal * wind / ((near + far) / 2), rel=0.1)


def test_fog_that_comes_nearer_grows_from_the_center():
    come, tried = (
        {"frame": torch.full((1,), 2.0), "wind": torch.tensor([[0.0, 0.0, -2.5]])},
        (0.8, 0.85, 0.9, 0.95, 1.0),
    )
    for seed in range(3):
        before, after = layer(45, 55, keys(1, seed)), layer(40, 50, keys(1, seed), **come)
        fits = []
        for scale in tried:
            # What is at p now was at 45/50 p then.
            theta = torch.tensor([[[scale, 0.0, 0.0], [0.0, scale, 0.0]]]).double()
            grid = F.affine_grid(theta, [1, 1, 54, 96], align_corners=False)
            looked_up = F.grid_sample(before[None, None], grid, align_corners=False)[0, 0]
            fits.append(alike(looked_up[12:42, 20:76], after[12:42, 20:76]))
        assert tried[int(np.argmax(fits))] == 45 / 50
        assert max(fits) > 0.95


@pytest.mark.parametrize("contrast", [0.6, 1.5])
def test_the_logarithm_of_fog_in_place_changes_as_a_gaussian_of_time(contrast):
    tau, samples, times = 30.0, 4_000, (0.0, 15.0, 30.0, 45.0, 60.0)
    parameters = still(samples, contrast) | {"decorrelation": torch.full((samples,), tau)}
    before, *after = (at_camera(parameters | {"frame": torch.full((samples,), t)}).log() for t in times)
    pace = -math.log(math.log1p(math.expm1(contrast**2) / math.e) / contrast**2)
    for t, later in zip(times[1:], after, strict=True):
        expected = math.exp(-pace * (t / tau) ** 2)
        assert alike(before, later) == pytest.approx(expected, abs=3 / math.sqrt(samples))


def test_the_exponential_of_a_gaussian_field_is_correlated_by_1_over_e_after_its_time():
    variance = torch.tensor([1e-12, 1e-6, 9.99e-5, 1.01e-4, 1e-2, 0.36, 4.0, 100.0], dtype=torch.float64)
    left = torch.exp(-fog_volume._pace(variance).square())
    found = torch.expm1(variance * left) / torch.expm1(variance)
    assert_close(found, torch.full_like(variance, math.exp(-1)), rtol=1e-8, atol=0)
    ends = torch.tensor([0.0, 900.0], dtype=torch.float64, requires_grad=True)
    pace = fog_volume._pace(ends)
    assert_close(pace, torch.tensor([1.0, math.sqrt(math.log(900 / 899))], dtype=torch.float64))
    assert torch.autograd.grad(pace.sum(), ends)[0].isfinite().all()


@pytest.mark.parametrize("contrast", [0.5, 0.8])
def test_over_60_frames_fog_in_place_forgets_itself_in_its_decorrelation_time(contrast, oracle):
    samples = 2_000
    parameters = still(samples, contrast) | {"decorrelation": torch.full((samples,), 12.0)}
    q = torch.stack([at_camera(parameters | {"frame": torch.full((samples,), 3.0 * i)}) for i in range(20)])
    q -= q.mean()
    for lag in range(1, 6):
        correlation = (q[:-lag] * q[lag:]).mean().item() / q.square().mean().item()
        time = torch.tensor(3 * lag / math.sqrt(-math.log(correlation)))
        oracle(
            f"decorrelation time of fog in space, contrast {contrast}, frames", time, torch.tensor(12.0), 1.2, unit=""
        )


@pytest.mark.parametrize("columns", [1, 12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_distance_is_too_short_or_too_long(columns, dtype):
    distance = torch.tensor([0.0, 1e-30, 1e-6, 399.9, 400.0, 400.1, 800.0, 1e12, 1e30, math.inf], dtype=dtype)
    distance = distance[None, None, :, None].expand(2, -1, -1, columns).clone().requires_grad_()
    parameters = {name: value.requires_grad_() for name, value in drawn(2, dtype).items()}
    found = field(keys(2), distance, height=10, width=12, focal=(10.0, 10.0), center=(5.5, 4.5), **parameters)
    assert found.isfinite().all()
    # At the camera all rays meet; beyond the reach there is nothing but the mean.
    assert_close(found[:, :, 0], found[:, :, 0, :1].expand(-1, -1, 12), rtol=0, atol=1e-6)
    assert torch.equal(found[:, :, 9], torch.ones_like(found[:, :, 9]))
    for gradient in torch.autograd.grad(found.square().sum(), [distance, *parameters.values()]):
        assert gradient.isfinite().all()


def test_beyond_the_reach_the_fog_is_its_mean():
    at_reach = mean_at(400.0)
    assert_close(mean_at(1000.0), (400 * at_reach + 600) / 1000, rtol=0, atol=1e-12)
    assert (at_reach - 1).abs().max() > 0.1


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 5e-5), (torch.float64, 1e-11)])
def test_distances_by_row_give_what_the_same_distances_by_pixel_give(dtype, atol):
    distance, parameters = distances(2, 54, 1, dtype), drawn(2, dtype)
    rows, pixels = (field(keys(2), d, **WIDE, **parameters) for d in (distance, distance.expand(-1, -1, -1, 96)))
    assert_close(rows, pixels, rtol=0, atol=atol)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 40), (40, 1), (7, 5)])
def test_small_frames_are_parts_of_the_same_fog(height, width):
    size = {"focal": (50.0, 50.0), "center": (3.0, 2.0), "height": height, "width": width}
    ray = np.array([(width - 1 - 3) / 50, (height - 1 - 2) / 50, 1])
    expected = summed(keys(1), ray, [30.0], still(1))[0]
    for columns in (1, width):
        found = field(keys(1), torch.full((1, 1, height, columns), 30.0).double(), **size, **still(1))
        assert found[0, 0, -1, -1].item() == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(("samples", "height", "width"), [(0, 27, 48), (2, 0, 48), (2, 27, 0)])
def test_nothing_to_see_is_no_error(samples, height, width):
    size = SMALL | {"height": height, "width": width}
    found = field(keys(samples), torch.zeros(samples, 1, height, width), **size, **still(samples))
    assert torch.equal(found, torch.zeros(samples, 1, height, width))


def test_float32_is_as_exact_after_long_as_at_first():
    distance, parameters = distances(1, 27, 48), drawn(1) | {"wind": torch.tensor([[0.3, -0.1, -20.0]]).double()}
    for frame in (0.0, 1e5):
        parameters["frame"] = torch.full((1,), frame).double()
        fine, coarse = (field(keys(1), distance, **parameters, dtype=t) for t in (torch.float64, torch.float32))
        assert_close(coarse.double(), fine, rtol=0, atol=1e-4)


@pytest.mark.parametrize("columns", [1, 48])
def test_a_sample_does_not_depend_on_the_batch_around_it(columns):
    key, distance, parameters = keys(4), distances(4, 27, columns, torch.float32), drawn(4, torch.float32)
    together = field(key, distance, **parameters)
    for order in ([0], [2], [3, 1], [3, 2, 1, 0]):
        some = {name: value[order] for name, value in parameters.items()}
        assert torch.equal(field(key[order], distance[order], **some), together[order])


@pytest.mark.parametrize("columns", [1, 480])
def test_threads_do_not_change_a_bit(columns, on_threads):
    distance, parameters = distances(1, 271, columns, torch.float32), drawn(1, torch.float32)
    size = {"height": 271, "width": 480, "focal": (400.0, 400.0), "center": (240.0, 130.0)}
    found = []
    for threads in (1, 2, 3):
        on_threads(threads)
        found.append(field(keys(1), distance, **size, **parameters))
    assert all(torch.equal(one, found[0]) for one in found[1:])


@pytest.mark.parametrize("columns", [1, 48])
def test_one_graph_a_map_over_samples_and_autocast_give_the_same(columns):
    key, distance, parameters = keys(2), distances(2, 27, columns, torch.float32), drawn(2, torch.float32)

    def one(key: Tensor, distance: Tensor, parameters: dict[str, Tensor]) -> Tensor:
        return field(key[None], distance[None], **{name: value[None] for name, value in parameters.items()})[0]

    expected = field(key, distance, **parameters)
    assert torch.equal(torch.func.vmap(one)(key, distance, parameters), expected)
    with torch.autocast("cpu"):
        assert torch.equal(field(key, distance, **parameters), expected)
    compiled = torch.compile(field, fullgraph=True, backend="aot_eager")
    assert_close(compiled(key, distance, **parameters), expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("columns", [1, 4])
def test_gradients_are_those_of_finite_differences(columns):
    size, parameters = {"height": 3, "width": 4, "focal": (4.0, 4.0), "center": (1.5, 1.0)}, drawn(1)

    def of(distance: Tensor, *values: Tensor) -> Tensor:
        return field(keys(1), distance, **size, **dict(zip(parameters, values, strict=True)))

    # Off the slices, between which the mean is linear.
    inputs = [value.requires_grad_() for value in (1 + distances(1, 3, columns), *parameters.values())]
    assert torch.autograd.gradcheck(of, inputs)
