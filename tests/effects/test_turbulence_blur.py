"""The blur of short exposures, against its transfer function and convolutions pixel by pixel."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import BlurredTurbulence, GroundPlaneDepth, PhysicalTurbulence, TurbulenceBlur
from torchrefract.fields.physical_turbulence import fried_parameter
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear
from torchrefract.fields.turbulence_blur import View, blur_by_distance, distances_for, halo_px, largest_change

WAVELENGTH, APERTURE, REACH = 600e-9, 0.004, 900.0
CN2 = 1e-11
ERROR = 0.02  # of the contrast, by the interpolation between distances


def blur_of(image: Tensor, depth: Tensor | float, *, cn2: float = CN2, **options: Any) -> Tensor:
    """Return the linear light of frames with a focal length of 400 widths behind air of one Cn2 everywhere."""
    given: dict[str, Any] = {"height": None, "focal": 400.0, "aperture": APERTURE, "wavelength": WAVELENGTH}
    effect = TurbulenceBlur(cn2_range=(cn2, cn2), reach=REACH, tolerance=None, **given | options)
    depth = torch.as_tensor(depth, dtype=image.dtype).expand(1, 1, *image.shape[2:])
    return srgb_to_linear(effect.degrade(image, seed=1, depth=depth).image)


def transfer(rho: np.ndarray, distance: float, *, cn2: float = CN2) -> np.ndarray:
    """Return the transfer function of Fried at cycles per radian, constant from the cut-off on."""
    rho = np.minimum(rho, APERTURE / WAVELENGTH)
    r0 = fried_parameter(cn2, min(distance, REACH), wavelength=WAVELENGTH)
    ratio = WAVELENGTH * rho
    return np.exp(-3.44 * (ratio / r0) ** (5 / 3) * (1 - 0.5 * (ratio / APERTURE) ** (1 / 3)))


def cosine(height: int, width: int, down: int, across: int) -> Tensor:
    """Return a wave with half as many periods, which reflection at the borders continues."""
    y, x = ((torch.arange(size, dtype=torch.float64) + 0.5) / size for size in (height, width))
    return torch.cos(math.pi * down * y)[:, None] * torch.cos(math.pi * across * x)


@pytest.mark.quick
@pytest.mark.parametrize(("down", "across"), [(0, 3), (5, 0), (14, 21), (29, 0), (0, 39), (29, 39)])
@pytest.mark.parametrize("distance", [30.0, 400.0, 5000.0])
def test_the_amplitude_of_a_wave_scales_by_the_transfer_function(down, across, distance):
    wave = cosine(30, 40, down, across)
    light = blur_of(linear_to_srgb(0.5 + 0.4 * wave)[None, None], distance)
    # Cycles per radian; the shortest waves lie beyond the cut-off of 6667.
    rho = 16000 * np.hypot(down / 60, across / 80)
    amplitude = ((light - 0.5) * wave).sum() / (0.4 * wave.square().sum())
    assert amplitude.item() == pytest.approx(float(transfer(np.array(rho), distance)), abs=1e-3)
    assert_close(light[0, 0], 0.5 + 0.4 * amplitude * wave, rtol=0, atol=1e-6)


def by_convolution(light: Tensor, thickness: Tensor, view: View) -> Tensor:
    """Convolve light (H, W) with the kernel of each pixel, (D / r0)^(5/3) (H, W), in the reflected frame."""
    mirrored = torch.cat([light, light.flip(0)])
    spectrum = torch.fft.fft2(torch.cat([mirrored, mirrored.flip(1)], dim=1)).numpy()
    height, width = light.shape
    fy, fx = np.fft.fftfreq(2 * height)[:, None] * view.focal[1], np.fft.fftfreq(2 * width) * view.focal[0]
    q = np.minimum(np.hypot(fy, fx) * view.wavelength / view.aperture, 1)
    result = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            otf = np.exp(-3.44 * thickness[y, x].item() * (q ** (5 / 3) - q**2 / 2))
            result[y, x] = np.fft.ifft2(spectrum * otf)[y, x].real
    return torch.from_numpy(result)


@pytest.mark.parametrize("with_height", [False, True])
def test_each_pixel_is_blurred_by_the_air_in_front_of_it(with_height):
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(1, 2, 14, 18, generator=generator, dtype=torch.float64)
    depth = 1200 * torch.rand(1, 1, 14, 18, generator=generator, dtype=torch.float64)
    options: dict[str, Any] = {"height": 2.0, "horizon": 0.4} if with_height else {"height": None}
    actual = blur_of(linear_to_srgb(light), depth, **options)
    strength = (APERTURE / fried_parameter(CN2, REACH, wavelength=WAVELENGTH)) ** (5 / 3)
    thickness = strength * depth[0, 0].clamp(max=REACH) / REACH
    if with_height:
        # The integral of Cn2 along the ray, from its end on, by the middle of 20,000 stretches.
        share = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
        row = torch.arange(14, dtype=torch.float64)[:, None, None]
        end = (1 - depth[0, 0, ..., None].clamp(max=REACH) * (row - (0.4 * 14 - 0.5)) / (400 * 18) / 2.0).clamp(min=0)
        air = (share ** (5 / 3) * (end + (1 - end) * share).clamp(min=1e-12) ** (-4 / 3)).mean(dim=-1) * 8 / 3
        thickness = thickness * air
        assert air.min() < 0.9
        assert air.max() > 1.1
    view = View((400.0 * 18, 400.0 * 18), APERTURE, WAVELENGTH)
    expected = torch.stack([by_convolution(channel, thickness, view) for channel in light[0]])
    sharp = (expected - light[0]).abs().max()
    assert sharp > 0.3
    assert_close(actual[0], expected, rtol=0, atol=ERROR / 2)


@pytest.mark.parametrize("strength", [0.03, 1.0, 16.0, 3000.0])
def test_the_contrast_is_right_to_two_percent_at_every_distance_and_frequency(strength):
    view = View((9000.0, 9000.0), APERTURE, WAVELENGTH)
    highest = 9000 / math.sqrt(2) * WAVELENGTH / APERTURE  # of the frame, in cut-offs
    distances, width = distances_for(strength, view), 400
    strengths = strength * torch.linspace(0, 1, width, dtype=torch.float64).square().view(1, 1, 1, width)
    worst = 0.0
    for down in range(1, 32):  # each column has a distance of its own
        wave = cosine(32, width, down, 0)
        blurred = blur_by_distance(wave[None, None], strengths, view, distances=distances, halo=width)
        q = min(9000 * down / 64 * WAVELENGTH / APERTURE, 1)
        expected = torch.exp(-3.44 * strengths[0, 0, 0] * (q ** (5 / 3) - q**2 / 2))
        worst = max(worst, (blurred[0, 0, 0] / wave[0] - expected).abs().max().item())
    assert worst < ERROR
    # No more distances than it takes: without the last one the interpolation between the others is off by more.
    places, rates = (np.array(values[:-1]) for values in distances[:2])
    share = np.linspace(0, 1, 500)[:, None] ** 2
    largest = strength * 3.44 * (highest ** (5 / 3) - highest**2 / 2)
    basis = np.exp(-rates * share) @ np.linalg.inv(np.exp(-np.outer(places, rates)))
    missed = basis @ np.exp(-largest * np.outer(places, share)) - np.exp(-largest * share * share.T)
    assert np.abs(missed).max() > ERROR


@pytest.mark.quick
def test_the_light_of_the_frame_stays():
    generator = torch.Generator().manual_seed(1)
    for size in ((25, 31), (260, 311)):
        light = torch.rand(1, 3, *size, generator=generator, dtype=torch.float64) * 0.8 + 0.1
        light[..., -5:, -9:] = 1.0  # at the border
        blurred = blur_of(linear_to_srgb(light), 700.0, focal=16000 / size[1])
        assert (blurred - light).abs().mean() > 0.05
        assert_close(blurred.mean(dim=(2, 3)), light.mean(dim=(2, 3)), rtol=1e-3, atol=0)


def test_no_light_wraps_around_the_frame():
    view, strength = View((8000.0, 8000.0), APERTURE, WAVELENGTH), 5.2 ** (5 / 3)
    light = torch.zeros(1, 1, 64, 600, dtype=torch.float64)
    light[..., :100] = 1.0
    everywhere = torch.full((1, 1, 1, 1), strength, dtype=torch.float64)
    halo = halo_px(strength, view)
    assert halo < 200  # the middle of the reflected frame is left out
    blurred, exact = (
        blur_by_distance(light, everywhere, view, distances=distances_for(strength, view), halo=px)
        for px in (halo, 600)
    )
    assert_close(blurred, exact, rtol=0, atol=1e-3)
    assert exact[..., -1].max() < 1e-3
    # The rest of the light beyond the halo, by a frame that holds nearly all of it.
    point = torch.zeros(1, 1, 1601, 1601, dtype=torch.float64)
    point[..., 800, 800] = 1.0
    spread = blur_by_distance(point, everywhere, view, distances=distances_for(strength, view), halo=0)[0, 0]
    y, x = torch.meshgrid(*(torch.arange(1601) - 800.0,) * 2, indexing="ij")
    beyond = spread[torch.hypot(y, x) > halo].sum().item()
    assert 0.0005 < beyond < 0.0012


@pytest.mark.quick
def test_the_blur_vanishes_with_cn2():
    image = torch.rand(1, 3, 20, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    light = srgb_to_linear(image)
    changes = [(blur_of(image, 500.0, cn2=cn2) - light).abs().max().item() for cn2 in (1e-14, 1e-16, 1e-18)]
    assert changes[0] == pytest.approx(100 * changes[1], rel=0.05)
    assert changes[1] == pytest.approx(100 * changes[2], rel=0.05)
    assert torch.equal(TurbulenceBlur(cn2_range=(0.0, 0.0), tolerance=None).degrade(image, seed=1).image, image)


@pytest.mark.quick
def test_no_frame_changes_more_than_the_plan_says():
    generator = torch.Generator().manual_seed(0)
    for ratio in (0.01, 0.3, 2.0):
        strength, view = ratio ** (5 / 3), View((3000.0, 3000.0), APERTURE, WAVELENGTH)
        bound = largest_change(strength, view)
        everywhere = torch.full((1, 1, 1, 1), strength, dtype=torch.float64)
        # Light where the kernel of the middle pixel is above 0, and noise.
        point = torch.zeros(1, 1, 64, 64, dtype=torch.float64)
        point[..., 32, 32] = 1.0
        kernel = blur_by_distance(point, everywhere, view, distances=distances_for(strength, view), halo=64) - point
        frames = [(kernel > 0).double(), torch.rand(1, 1, 64, 64, generator=generator, dtype=torch.float64).round()]
        changes = [
            (blur_by_distance(frame, everywhere, view, distances=distances_for(strength, view), halo=64) - frame)
            .abs()
            .max()
            .item()
            for frame in frames
        ]
        assert max(changes) <= bound * (1 + 1e-6)
        assert changes[0] > 0.9 * bound


@pytest.mark.quick
def test_the_plan_leaves_out_a_blur_that_cannot_be_seen():
    hidden = TurbulenceBlur(cn2_range=(1e-13, 1e-12))  # D / r0 of 0.78
    plan = hidden.plan(1080, 1920)
    assert plan.is_identity
    assert "D / r0 is up to 0.78 at the reach: below 1 the diffraction of the aperture hides the blur" in str(plan)
    image = torch.rand(1, 3, 36, 64, generator=torch.Generator().manual_seed(0))
    assert torch.equal(hidden.degrade(image, seed=1).image, image)
    stronger: dict[str, Any] = {"cn2_range": (1e-12, 2e-12), "aperture": 0.003, "wavelength": 400e-9, "reach": 2000.0}
    for name, value in stronger.items():
        seen = TurbulenceBlur(**{"cn2_range": (1e-13, 1e-12), name: value})
        assert not seen.plan(1080, 1920).is_identity
        assert f"D / r0 is up to {seen.blur_ratio:.2g} at the reach" in str(seen.plan(1080, 1920))
    # No level moves where pixels are far coarser than the blur, whatever D / r0 is.
    coarse: dict[str, Any] = {"cn2_range": (1e-12, 1e-12), "aperture": 0.01, "focal": 0.002}
    assert TurbulenceBlur(**coarse).blur_ratio > 1
    plan = TurbulenceBlur(**coarse).plan(108, 192)
    assert plan.is_identity
    assert 0 < plan.error <= 0.5
    assert "no tolerance" in str(TurbulenceBlur(tolerance=None).plan(1080, 1920))
    blurred = TurbulenceBlur(tolerance=None).degrade(image, seed=1).image
    assert not torch.equal(blurred, image)


@pytest.mark.quick
def test_air_that_is_stronger_than_the_range_is_blurred_as_that_air():
    image = torch.rand(1, 3, 36, 64, generator=torch.Generator().manual_seed(0))
    weak, strong = (TurbulenceBlur(cn2_range=(cn2, cn2), focal=400.0) for cn2 in (1e-14, 3e-11))
    params = strong.sample(image, seed=1)
    assert_close(weak.apply(image, params).image, strong.apply(image, params).image, rtol=0, atol=ERROR)
    assert not torch.equal(weak.apply(image, params).image, image)


@pytest.mark.quick
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_invalid_pixel_counts_as_black(value):
    image = torch.rand(1, 3, 36, 64, generator=torch.Generator().manual_seed(0))
    effect = TurbulenceBlur(cn2_range=(1e-11, 1e-11), focal=100.0)
    image[0, 1, 7, 9] = 0.0
    expected = effect.degrade(image, seed=1)
    assert expected.valid.all()
    image[0, 1, 7, 9] = value
    actual = effect.degrade(image, seed=1)
    assert torch.equal(actual.image, expected.image)
    assert (~actual.valid).nonzero().tolist() == [[0, 0, 7, 9]]


@pytest.mark.quick
def test_one_air_moves_and_blurs():
    place: dict[str, Any] = {
        "aperture": 0.01,
        "focal": 6.0,
        "reach": 600.0,
        "height": None,
        "depth": GroundPlaneDepth(),
    }
    turbulence = PhysicalTurbulence(cn2_range=(1e-12, 1e-11), p=0.7, **place)
    both = BlurredTurbulence(turbulence, wavelength=WAVELENGTH)
    image = torch.rand(8, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    degraded = both.degrade(image, seed=2)
    tilt, blur = degraded.params.children
    assert torch.equal(tilt.tilt, turbulence.sample(image, seed=2).tilt)  # as if it were alone
    assert 0 < blur.applied.sum() < 8
    assert torch.equal(blur.applied, tilt.applied)
    amplitude = turbulence.equivalent_amplitude(64)[1] / (6 * 64)  # of Cn2 = 1e-11
    for row in range(8):
        cn2 = 1e-11 * (1e-6 * tilt.tilt[row].item() / amplitude) ** 2
        assert 1e-12 < cn2 < 1e-11
        ratio = 0.01 / fried_parameter(cn2, 600.0, wavelength=WAVELENGTH)
        assert blur.ratio[row].item() == pytest.approx(ratio, rel=1e-4)
    moved = turbulence.apply(image, tilt)
    assert torch.equal(degraded.flow, moved.flow)
    assert_close(degraded.image, both.blur.apply(moved.image, blur).image, rtol=0, atol=1e-6)
    assert not torch.equal(degraded.image, moved.image)
    with pytest.raises(TypeError, match="turbulence must be a PhysicalTurbulence, got TurbulenceBlur"):
        BlurredTurbulence(both.blur)  # pyright: ignore[reportArgumentType]  # the test is of this
