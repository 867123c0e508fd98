"""Glow around lamps, compared with simulated paths of light."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, NightGlow
from torchrefract.fields.night_glow import scattering_transfer
from torchrefract.types import Degraded

FOCAL = 90.0  # px


def glow_of(image: Tensor, thickness: float, asymmetry: float = 0.9, **options: Any) -> Degraded:
    """Return the glow of lamps of a luminance of 10, for a camera of 90 px."""
    height, width = image.shape[-2:]
    cx, cy = (width - 1) / 2, (height - 1) / 2
    camera = Camera(width=width, height=height, fx=FOCAL, fy=FOCAL, cx=cx, cy=cy, coefficients=(0.0,) * 4)
    ranges = {"optical_depth_range": (thickness,) * 2, "asymmetry_range": (asymmetry,) * 2}
    return NightGlow(camera=camera, luminance_range=(10.0, 10.0), **ranges, **options).degrade(image, seed=7)


def lamp(height: int, width: int, row: int, column: int) -> Tensor:
    image = torch.zeros(1, 1, height, width, dtype=torch.float64)
    image[..., row, column] = 1.0
    return image


def simulated_energy(thickness: float, asymmetry: float, radii: tuple[float, ...]) -> list[float]:
    """Simulate paths of light and return the shares of it that arrive scattered, within radii in px."""
    dice, count = np.random.default_rng(0), 400_000
    number = dice.poisson(thickness, count)
    path = np.repeat(np.arange(count), number)
    scale = (1 - asymmetry) / math.sqrt(asymmetry)
    # An angle r with the density proportional to r / (scale^2 + r^2)^(3/2), the small angles of Henyey and Greenstein.
    radius = scale * np.sqrt(dice.random(len(path)) ** -2 - 1) * dice.random(len(path))  # times the share of the way
    turn = 2 * math.pi * dice.random(len(path))
    x, y = (np.bincount(path, radius * f(turn), count) for f in (np.cos, np.sin))
    distance = np.where(number > 0, FOCAL * np.hypot(x, y), np.inf)
    return [float((distance < r).mean()) for r in radii]


@pytest.mark.parametrize(("thickness", "asymmetry"), [(0.3, 0.9), (1.5, 0.85), (4.0, 0.95)])
def test_the_energy_within_circles_is_that_of_simulated_paths(thickness, asymmetry):
    size, radii = 319, (6.5, 12.5, 25.5, 50.5)
    glow = glow_of(lamp(size, size, 159, 159), thickness, asymmetry).intensity[0, 0] / 10
    y, x = torch.meshgrid(*(torch.arange(size) - 159.0,) * 2, indexing="ij")
    energy = [glow[torch.hypot(x, y) < r].sum().item() for r in radii]
    # The border reflects less than 0.5 % of the light into these circles.
    assert energy == pytest.approx(simulated_energy(thickness, asymmetry, radii), abs=0.006)


def test_the_transfer_of_single_scattering_is_the_mean_of_its_angles_along_the_way():
    q, a = torch.tensor([0.0, 1e-5, 0.3, 5.0, 80.0], dtype=torch.float64), 0.1 / math.sqrt(0.9)
    share = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    single = torch.exp(-a * q[:, None] * share).mean(dim=1)
    actual = scattering_transfer(q, torch.tensor(0.9, dtype=torch.float64))
    assert_close(actual, single, rtol=1e-8, atol=0)


@pytest.mark.parametrize("size", [(60, 90), (300, 501), (341, 643), (642, 1282)])
@pytest.mark.parametrize("thickness", [0.05, 1.0, 6.0])
def test_the_glow_has_the_light_that_lamps_lose(size, thickness):
    image = 0.3 * torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    image[0, :, 11:24, 20:40] = image[1, 0, -22:-2, -22:-2] = 1.0  # also at the border
    glow = glow_of(image, thickness).intensity.sum(dim=(1, 2, 3))
    lost = -math.expm1(-thickness) * 10 * torch.tensor([13 * 20.0, 20 * 20 / 3])
    assert_close(glow, lost, rtol=1e-3, atol=0)


def test_the_image_is_the_light_of_both():
    image = 0.4 * torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image[..., 20:22, 30:32] = 1.0
    degraded = glow_of(image.mean(dim=1, keepdim=True), 1.0)  # one channel, so that `intensity` is its glow
    clean = image.mean(dim=1, keepdim=True)
    linear = np.where(clean <= 0.04045, clean / 12.92, ((clean.numpy() + 0.055) / 1.055) ** 2.4)
    light = linear + degraded.intensity.numpy()
    stored = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert_close(degraded.image, torch.from_numpy(stored).clamp(0, 1), rtol=0, atol=1e-6)
    assert torch.equal(degraded.valid, torch.from_numpy(light <= 1 + 1e-5))


def test_the_glow_vanishes_with_the_optical_depth():
    image = lamp(40, 60, 20, 30)
    changes = [(glow_of(image, thickness).image - image).abs().max().item() for thickness in (1e-2, 1e-4, 1e-6)]
    assert changes[0] > 10 * changes[1] > 100 * changes[2]
    assert changes[2] < 1e-5
    assert torch.equal(glow_of(image, 0.0).image, image)


def test_a_frame_with_a_sky_of_the_day_has_no_glow():
    image = 0.4 * torch.rand(2, 3, 90, 160, generator=torch.Generator().manual_seed(0))
    image[0, :, :40] = 0.95
    image[1, :, 20:25, 30:35] = 1.0
    degraded = glow_of(image, 1.0)
    assert (degraded.params.luminance == torch.tensor([0.0, 10.0])).all()
    assert torch.equal(degraded.image[0], image[0])
    assert (degraded.image[1] > image[1]).any()
