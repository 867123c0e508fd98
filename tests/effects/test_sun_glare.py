"""Sun glare against a renderer in NumPy, its place in real frames, and real photographs of a low sun."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import decode, encode
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, SunGlare
from torchrefract.data.images import read_image
from torchrefract.fields.sky import sky_mask

SIZE = (36, 64)
IN_FRAME: dict[str, Any] = {"center_x_range": (0.5, 0.9), "center_y_range": (0.1, 0.4)}


def picture(*shape: int, seed: int = 0) -> Tensor:
    return 0.7 * torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def reference(image: np.ndarray, params, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render one frame (C, H, W) pixel by pixel -> the image and the light of the sun."""
    height, width = image.shape[1:]
    degree = camera.fx * math.pi / 180
    center = params.center * torch.tensor([width, height]) - 0.5
    added = np.zeros_like(image)
    p4 = params.shape.item()
    p3 = params.scale.item() ** -p4
    p2 = params.scatter.item() * p4 * p3 ** (2 / p4) / (2 * math.pi * math.gamma(2 / p4))
    flux = params.luminance.item() * math.pi * 0.265**2
    for y in range(height):
        for x in range(width):
            r = math.hypot(x - center[0], y - center[1]) / degree
            value = flux * p2 * math.exp(-p3 * (r * r + 1e-6 * params.scale.item() ** 2) ** (p4 / 2))
            coverage = min(max((0.265**2 - r * r) * degree / 0.53 + 0.5, 0), 1)
            value += (1 - params.scatter.item()) * params.luminance.item() * coverage
            added[:, y, x] = value * params.color.numpy()
            for (place, radius, share), tint in zip(params.ghosts.numpy(), params.tints.numpy(), strict=True):
                gx = camera.cx + place * (center[0] - camera.cx)
                gy = camera.cy + place * (center[1] - camera.cy)
                d = math.hypot(x - gx, y - gy) / degree / radius
                profile = min(max((1 - d * d) / 0.3, 0), 1)
                added[:, y, x] += flux * share / (math.pi * radius**2 * 0.85) * profile * tint
    light = decode(image)
    mean, with_sun = light.mean(), np.minimum(light + added, 16).mean()
    gain = max(((mean + 1e-3) / (with_sun + 1e-3)) ** params.gamma.item(), 1 / 16)
    return encode(np.clip(gain * (light + added), 0, 1)), added


@pytest.mark.quick
@pytest.mark.parametrize("key", [3, 4])
def test_the_image_is_that_of_a_renderer_pixel_by_pixel(key):
    image = picture(1, 3, *SIZE)
    camera = Camera(width=64, height=36, fx=70, fy=70, cx=30.0, cy=20.0, coefficients=(0.0,) * 5)
    effect = SunGlare(**IN_FRAME, camera=camera, ghost_share_range=(1e-5, 1e-3), color=(1.0, 0.8, 0.6))
    degraded = effect.degrade(image, seed=1, keys=[key])
    row = type(degraded.params)(*(value[0] for value in degraded.params))
    expected, added = reference(image[0].numpy(), row, camera)
    assert np.abs(degraded.image[0].numpy() - expected).max() < 1e-6
    assert_close(degraded.intensity[0, 0], torch.from_numpy(added.mean(axis=0)), rtol=1e-6, atol=1e-9)
    assert torch.equal(degraded.valid[0, 0], torch.from_numpy(expected.max(axis=0) < 1 - 1e-9))
    assert 0.005 < (~degraded.valid).double().mean() < 0.9


def test_the_foreground_gets_darker_under_a_sun_in_the_sky_and_colors_lose_contrast():
    frame = torch.full((1, 3, *SIZE), 0.4, dtype=torch.float64)
    frame[:, :, :15] = torch.tensor([0.5, 0.6, 0.8])[:, None, None]
    frame[:, :, 30:, ::2] = 0.2
    degraded = SunGlare(outside=0.0).degrade(frame, seed=5).image
    assert degraded[:, :, 30:].mean() < 0.8 * frame[:, :, 30:].mean()
    assert (degraded[:, :, :15] == 1).all(dim=1).any()
    kept = SunGlare(outside=0.0, gamma_range=(0, 0)).degrade(frame, seed=5).image
    assert (kept >= frame - 1e-9).all()  # glare alone only adds light


@pytest.mark.parametrize("seed", [1, 2])
def test_the_sun_stands_in_the_sky_of_real_frames(shared_data: Path, seed):
    folder = shared_data / "fullres"
    for name in ("cn_pjlab_clear", "ca280_test3", "us_losaltos_levinj_challenge3", "us_resid_dsc00001"):
        image = read_image(folder / f"{name}.jpg")[None]
        sky, params = sky_mask(image)[0, 0], SunGlare(outside=0.0).sample(image, seed=seed)
        x, y = (params.center[0] * torch.tensor([image.shape[3], image.shape[2]])).long().tolist()
        assert sky[y, x], name
        assert params.luminance > 0
        ys, xs = torch.meshgrid(torch.arange(y - 8, y + 9), torch.arange(x - 8, x + 9), indexing="ij")
        inside = (ys >= 0) & (xs >= 0) & (ys < sky.shape[0]) & (xs < sky.shape[1])
        assert sky[ys[inside], xs[inside]].all(), name


def test_real_frames_without_sky_have_the_sun_above_them_and_those_at_night_none(shared_data: Path):
    above = sorted((shared_data / "frames/val").glob("br_es*.jpg"))[::6]
    for path in above:
        params = SunGlare(outside=0.0).sample(read_image(path)[None], seed=1)
        assert params.center[0, 1] < -0.3
        assert params.luminance > 0
    night = sorted((shared_data / "frames/train").glob("us_atx*.jpg"))[::4]
    images = torch.stack([read_image(path) for path in night])
    degraded = SunGlare().degrade(images, seed=1)
    dark = degraded.params.luminance == 0
    assert dark.float().mean() > 0.8
    assert torch.equal(degraded.image[dark], images[dark])


def test_only_a_sun_in_the_frame_has_ghosts():
    image = picture(1, 3, *SIZE)
    for y, has_ghosts in ((0.2, True), (-0.2, False)):
        options: dict[str, Any] = {
            "center_x_range": (0.6, 0.6),
            "center_y_range": (y, y),
            "ghost_share_range": (1e-3, 1e-3),
        }
        with_ghosts, without = (
            SunGlare(**options, num_ghosts=count).degrade(image, seed=1).intensity for count in (4, 0)
        )
        assert torch.equal(with_ghosts, without) != has_ghosts


@pytest.mark.parametrize("step", [(1 / 640, 0.0), (0.0, -1 / 360)])
def test_ghosts_fade_while_the_sun_drifts_out_of_the_frame(step):
    still: dict[str, Any] = {"ghost_share_range": (1e-3, 1e-3), "gamma_range": (0, 0)}
    x, y = (1.0, 0.3) if step[0] else (0.6, 0.0)
    still |= {"center_x_range": (x - 8 * step[0],) * 2, "center_y_range": (y - 8 * step[1],) * 2}
    still |= {"drift_x_range": step[:1] * 2, "drift_y_range": step[1:] * 2}
    clip = torch.zeros(1, 17, 3, 360, 640)
    with_ghosts, without = (SunGlare(**still, num_ghosts=count).degrade(clip, seed=1).intensity for count in (1, 0))
    peak = (with_ghosts - without).amax(dim=(0, 2, 3, 4))
    assert (peak[1:] <= 1.001 * peak[:-1]).all()
    assert (peak[:-1] - peak[1:]).max() < 0.25 * peak[0]
    assert peak[-1] == 0 < peak[0]


def histogram_distance(first: Tensor, second: Tensor) -> float:
    """Return the mean shift of luminance, in levels, that turns one histogram into the other."""
    quantiles = torch.linspace(0, 1, 256)
    return 255 * (first.flatten().quantile(quantiles) - second.flatten().quantile(quantiles)).abs().mean().item()


def test_luminance_comes_closer_to_that_of_real_photographs_of_a_low_sun(shared_data: Path):
    def gray(image: Tensor) -> Tensor:
        return torch.nn.functional.interpolate(image.float()[None] / 255, (180, 320), mode="area")[0].mean(dim=0)

    real = gray(read_image(shared_data / "references/sun_glare_boreas/camera_1733249255732230_crop.jpg"))
    before, after, foreground = [], [], []
    for name in ("cn_pjlab_clear", "ca280_test3", "us_losaltos_levinj_challenge3", "ca280_pv_21"):
        image = read_image(shared_data / "fullres" / f"{name}.jpg")
        before.append(histogram_distance(gray(image), real))
        for seed in range(4):
            degraded = gray(SunGlare(outside=0.0).degrade(image, seed=seed).image)
            after.append(histogram_distance(degraded, real))
            foreground.append((degraded[120:].mean() / gray(image)[120:].mean()).item())
    assert np.mean(after) < 0.9 * np.mean(before)
    assert np.mean(foreground) < 0.8  # the lowest third of the frame


def test_the_sun_drifts_over_a_clip():
    clip = picture(1, 3, 3, *SIZE)
    effect = SunGlare(**IN_FRAME, drift_x_range=(2 / 64, 2 / 64), drift_y_range=(1 / 36, 1 / 36), num_ghosts=0)
    intensity = effect.degrade(clip, seed=3).intensity[0, :, 0]
    assert_close(intensity[1, 1:, 2:], intensity[0, :-1, :-2], rtol=1e-6, atol=1e-9)
    assert_close(intensity[2, 1:, 2:], intensity[1, :-1, :-2], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("index", "name", "value"), [(1, "radius", -1.0), (2, "share", 2.0), (0, "place", 1e6)])
def test_invalid_ghosts_raise(index, name, value):
    image, effect = picture(2, 3, *SIZE), SunGlare()
    params = effect.sample(image, seed=1)
    ghosts = params.ghosts.clone()
    ghosts[1, 2, index] = value
    with pytest.raises(ValueError, match=rf"params\.ghosts must have a {name} in \["):
        effect.apply(image, params._replace(ghosts=ghosts))
