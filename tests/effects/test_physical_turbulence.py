"""Turbulence by its physics, against quadrature and the correlations of Kolmogorov's spectrum."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import integrate, special
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, Compose, GroundPlaneDepth, LensDistortion, PhysicalTurbulence, Turbulence
from torchrefract.fields import physical_turbulence
from torchrefract.fields.physical_turbulence import (
    Air,
    Layers,
    fried_parameter,
    height_gain,
    layer_gradients,
    layer_shares,
    layers_of,
    tilt_variance,
)
from torchrefract.planning.plan import TOLERANCE_PX

DASHCAM = Air(0.002, 0.005, 10.0)
SIDE = 2048  # px, of the domain of two rays
# Along and across the separation of two rays, in apertures at the object; Kolmogorov's spectrum, by quadrature.
CORRELATION = {
    **{0.25: (0.966, 0.986), 0.5: (0.920, 0.964), 1: (0.841, 0.921), 2: (0.733, 0.852), 5: (0.574, 0.726)},
    **{10: (0.463, 0.618), 20: (0.368, 0.513), 50: (0.269, 0.390), 100: (0.211, 0.313)},
}


def variance_by_quadrature(distance: float, air: Air) -> float:
    """Integrate the variance for Cn2 = 1 over the path and the wave numbers."""
    k0, km = 2 * math.pi / air.outer_scale, 5.92 / air.inner_scale
    k = np.geomspace(1e-4 * k0, 10 * km, 40001)
    spectrum = 0.033 * (k * k + k0 * k0) ** (-11 / 6) * np.exp(-((k / km) ** 2))

    def per_meter(share: float) -> float:
        u = np.maximum(k * air.aperture * share / 2, 1e-9)
        seen = (2 * special.j1(u) / u) ** 2
        return share**2 * integrate.trapezoid(math.pi * k**3 * spectrum * seen, k)

    shares = np.linspace(0, 1, 201)
    return 2 * math.pi * distance * float(integrate.simpson([per_meter(share) for share in shares], x=shares))


@pytest.mark.quick
def test_the_variance_is_that_of_the_integral_and_of_its_limits():
    for air in (DASHCAM, Air(0.1, 0.003, 20.0), Air(0.01, 0.01, 1.0)):
        assert tilt_variance(300.0, air) == pytest.approx(variance_by_quadrature(300.0, air), rel=2e-3)
    wide, narrow = Air(0.1, 1e-4, 1e10), Air(1e-5, 0.05, 1e10)
    assert tilt_variance(1.0, wide) == pytest.approx(1.062 * 0.1 ** (-1 / 3), rel=5e-3)
    assert tilt_variance(1.0, narrow) == pytest.approx(1.093 * 0.05 ** (-1 / 3), rel=5e-3)


@pytest.fixture
def with_random_phases(monkeypatch):
    """Replace the noise by numbers of one magnitude: means over the periodic domain are then those of all draws."""

    def phases(key: Tensor, count: int, *, start: int = 0) -> Tensor:
        angle = 2 * math.pi * torch.rand(len(key), count, generator=torch.Generator().manual_seed(start))
        angle[:, 0] = math.pi / 4  # a uniform tilt of one standard deviation along both axes
        # Two waves along y make one real wave: a quarter of a turn apart they have its mean power.
        along_y = angle.view(len(key), SIDE, -1)[..., 0]
        along_y[:, SIDE // 2 + 1 :] = math.pi / 2 - along_y[:, 1 : SIDE // 2].flip(1)
        return math.sqrt(2) * torch.stack([angle.cos(), angle.sin()], dim=1)

    monkeypatch.setattr(physical_turbulence, "white_noise", phases)


def drawn_gradients(key: Tensor, layers: Layers, *, focal: float, side: int, shift: Tensor | None = None) -> list:
    """Return the gradients of each layer in a square frame."""
    frame = {"size": (side, side), "rows": range(side), "columns": range(side), "dtype": torch.float64}
    return list(layer_gradients(key, layers, focal=(focal, focal), shift=shift, **frame))


def covariance(air: Air, *, focal: float, distance: float, num_layers: int) -> tuple[Tensor, Tensor]:
    """Return the covariance of two rays along and across their separation in px, relative to the theory's variance."""
    layers = layers_of(distance, num_layers, air)
    shares = layer_shares(torch.tensor([distance], dtype=torch.float64), layers)
    drawn = drawn_gradients(torch.zeros(1, 4, dtype=torch.int64), layers, focal=focal, side=SIDE)
    total = [torch.zeros(SIDE, dtype=torch.float64)] * 2
    for share, gradient in zip(shares, drawn, strict=True):
        power = [torch.fft.fft(part[0, 0], dim=1).abs().square().mean(dim=0) / SIDE**2 for part in gradient]
        # Along and across are two components at points that differ in x.
        total = [t + share.square() * torch.fft.ifft(p).real * SIDE for t, p in zip(total, power, strict=True)]
    return total[0], total[1]


@pytest.mark.usefixtures("with_random_phases")
@pytest.mark.parametrize("num_layers", [3, 4])
def test_two_rays_are_correlated_as_in_kolmogorovs_air(num_layers):
    distance, aperture = 1000.0, 0.1
    focal = 4 * distance / aperture  # four pixels for each aperture
    along, across = covariance(Air(aperture, 1e-3, 1e6), focal=focal, distance=distance, num_layers=num_layers)
    assert along[0].item() == pytest.approx(1, abs=1e-3)
    assert across[0].item() == pytest.approx(1, abs=1e-3)
    for separation, expected in CORRELATION.items():
        px = round(4 * separation)
        actual = (along[px] / along[0]).item(), (across[px] / across[0]).item()
        assert actual == pytest.approx(expected, abs=0.01), separation


@pytest.mark.parametrize(("focal", "size"), [(300.0, (60, 96)), (1400.0, (96, 60)), (20000.0, (60, 96))])
def test_pixels_have_the_variance_of_the_integral_whatever_they_resolve(focal, size):
    camera = Camera(width=size[1], height=size[0], fx=focal, fy=focal, cx=0, cy=0, coefficients=(0.0,) * 5)
    effect = PhysicalTurbulence(cn2_range=(1e-12, 1e-12), camera=camera, height=None, tolerance_px=None)
    depth = torch.full((400, 1, *size), 300.0)
    flow = effect.degrade(torch.zeros(400, 1, *size), seed=1, depth=depth).flow
    sigma = focal * math.sqrt(1e-12 * variance_by_quadrature(300.0, DASHCAM))
    # Long waves differ from draw to draw.
    margin = 0.02 if focal < 2000 else 0.04
    assert flow.square().mean(dim=(0, 2, 3)).sqrt().tolist() == pytest.approx([sigma, sigma], rel=margin)


def test_the_field_has_no_curl():
    effect = PhysicalTurbulence(cn2_range=(1e-9, 1e-9), height=None, tolerance_px=None)
    size = (60, 96)  # the domain is as large as the frame
    image = torch.zeros(1, 1, *size, dtype=torch.float64)
    flow = effect.degrade(image, seed=1, depth=torch.full_like(image, 200.0)).flow[0]
    qy, qx = torch.fft.fftfreq(size[0], dtype=torch.float64)[:, None], torch.fft.fftfreq(size[1], dtype=torch.float64)
    u, v = torch.fft.fft2(flow)
    curl, slopes = qx * v - qy * u, torch.stack([qx * u, qy * u, qx * v, qy * v])
    assert curl.norm() <= 1e-6 * slopes.norm()
    assert slopes.norm() > 0


def test_the_displacement_grows_with_the_root_of_distance_and_not_with_the_number_of_layers():
    depths = np.geomspace(30.0, 1000.0, 7)
    for num_layers in (3, 4, 8):
        air: dict[str, Any] = {"cn2_range": (1e-11, 1e-11), "height": None, "reach": 1000.0}
        effect = PhysicalTurbulence(**air, num_layers=num_layers, tolerance_px=None)
        image = torch.zeros(24, 1, 60, 96)
        spread = [
            effect.degrade(image, seed=2, depth=torch.full_like(image, d)).flow.square().mean().sqrt().item()
            for d in depths.tolist()
        ]
        slope, offset = np.polyfit(np.log(depths), np.log(spread), 1)
        assert slope == pytest.approx(0.5, abs=0.02)
        expected = effect.equivalent_amplitude(96, distance=200.0)[0]
        assert math.exp(offset) * 200**0.5 == pytest.approx(expected, rel=0.03)


@pytest.mark.quick
def test_layers_add_up_to_one_and_those_behind_a_pixel_do_not_count():
    depth = torch.tensor([0.5, 7.0, 40.0, 333.0, 1000.0, math.inf], dtype=torch.float64)
    for count in range(3, 9):
        layers = layers_of(1000.0, count, DASHCAM)
        shares = torch.stack(layer_shares(depth, layers))
        assert_close(shares.square().sum(dim=0), depth.clamp(1.0, 1000.0) / 1000)
        behind = torch.tensor(layers.edges[:-1])[:, None] >= depth.clamp(1.0, 1000.0)
        assert (shares[behind] == 0).all()
        assert (shares[~behind] > 0).all()


@pytest.mark.quick
def test_air_that_thins_with_height_gives_rays_to_the_road_twice_the_variance():
    for air, road in ((Air(0.1, 1e-4, 1e6), 2.0), (Air(1e-4, 0.05, 1e6), 1.8)):
        layers = layers_of(500.0, 4, air)
        ends = [0.0, 0.01, 0.3, 1.0, 5.0, 100.0, 1e4]
        gains = height_gain(torch.tensor(ends, dtype=torch.float64), layers.gains).square().tolist()
        m = layers.exponent
        for end, gain in zip(ends, gains, strict=True):
            exact, _ = integrate.quad(
                lambda y, end=end, m=m: m * 3 * y ** (3 * m - 1) * (end + (1 - end) * y**3) ** (-4 / 3), 0, 1
            )
            assert gain == pytest.approx(exact, rel=0.01)
        assert gains[0] == pytest.approx(road, rel=5e-3)
        assert gains[3] == pytest.approx(1)


def test_the_bonnet_is_still_and_the_horizon_shimmers():
    effect = PhysicalTurbulence(cn2_range=(1e-10, 1e-10), tolerance_px=None)
    flow = effect.degrade(torch.zeros(40, 1, 90, 160), seed=1).flow
    rows = flow.square().mean(dim=(0, 1, 3)).sqrt()
    assert rows[45] > 5 * rows[-1]
    assert rows[45] > 3 * rows[0]


def test_the_wind_carries_each_layer():
    layers, side, focal = layers_of(100.0, 3, Air(0.05, 0.01, 5.0)), 32, 900.0
    key = torch.tensor([[1, 2, 3, 4]])

    still = drawn_gradients(key, layers, focal=focal, side=side)
    for k, distance in enumerate(layers.distances):
        shift = torch.tensor([[5.0, -3.0]], dtype=torch.float64) * distance / focal  # px in this layer
        moved = drawn_gradients(key, layers, focal=focal, side=side, shift=shift)
        for component in (0, 1):
            assert_close(moved[k][component], still[k][component].roll((-3, 5), (2, 3)), rtol=0, atol=1e-5)


def test_each_pixel_looks_through_the_air_in_front_of_it():
    effect = PhysicalTurbulence(cn2_range=(1e-10, 1e-10), tolerance_px=None)
    image = torch.zeros(1, 1, 36, 64)
    near, far = torch.full_like(image, 20.0), torch.full_like(image, 600.0)
    mixed = torch.where(torch.arange(64) < 30, near, far)
    flows = [effect.degrade(image, seed=3, depth=depth).flow for depth in (near, far, mixed)]
    assert_close(flows[2], torch.where(torch.arange(64) < 30, flows[0], flows[1]))
    # In a composition the depth is that of the scene, as the warps before have moved it.
    composed = Compose([LensDistortion(k1_range=(0, 0), k2_range=(0, 0), p1_range=(0, 0), p2_range=(0, 0)), effect])
    params = composed.sample(image, seed=3)
    alone = effect.apply(image, params.children[1], depth=mixed).flow
    assert_close(composed.apply(image, params, depth=mixed).flow, alone, rtol=0, atol=1e-4)


def test_the_flow_has_the_gradient_of_its_depth():
    effect = PhysicalTurbulence(cn2_range=(1e-7, 1e-7), tolerance_px=None)
    image = torch.rand(1, 1, 3, 4, dtype=torch.float64)
    params = effect.sample(image, seed=1)
    depth = 20 + 300 * torch.rand(1, 1, 3, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: effect.apply(image, params, depth=d).flow, depth.requires_grad_())


def test_cn2_and_displacements_convert_into_each_other():
    camera = Camera(width=1920, height=1080, fx=1400, fy=1400, cx=960, cy=540, coefficients=(0.0,) * 5)
    # Sizes that were computed by quadrature: wide dashcams, and a lens of 25 mm at 2 km.
    for cn2, distance, px in ((1e-12, 200.0, 0.0465), (1e-11, 300.0, 0.1802)):
        effect = Turbulence.from_physics(cn2, camera=camera)
        assert effect.equivalent_amplitude(1920, distance=distance)[0] == pytest.approx(px, rel=1e-3)
    air: dict[str, Any] = {"aperture": 0.025, "inner_scale": 1e-3, "outer_scale": 1e4, "reach": 2000.0}
    long = PhysicalTurbulence(cn2_range=(1e-12, 1e-12), camera=replace(camera, fx=8570, fy=8570), **air)
    assert long.equivalent_amplitude(1920)[0] == pytest.approx(0.73, abs=0.01)
    haze = Turbulence(amplitude_range=(0.4, 1.2), reference_distance=150.0)
    cn2_range = haze.equivalent_cn2(camera)
    physical = PhysicalTurbulence(cn2_range=cn2_range, camera=camera, reach=400.0)
    assert physical.equivalent_amplitude(1920, distance=150.0) == pytest.approx((0.4, 1.2))
    assert haze.equivalent_cn2(width=1920)[0] == pytest.approx(cn2_range[0] * (1400 / 1728) ** 2)


def test_from_physics_is_the_effect_with_these_numbers():
    image = torch.rand(1, 3, 36, 64)
    physical = Turbulence.from_physics((1e-11, 1e-10), height=2.0, wind=1.0, aperture=0.01)
    same = PhysicalTurbulence(cn2_range=(1e-11, 1e-10), height=2.0, wind_x_range=(-1.0, 1.0), aperture=0.01)
    assert torch.equal(physical.degrade(image, seed=1).flow, same.degrade(image, seed=1).flow)


@pytest.mark.quick
@pytest.mark.parametrize("cn2", [1e-14, 3e-12])
@pytest.mark.parametrize("distance", [50.0, 1000.0])
def test_fried_s_parameter_is_that_of_quadrature(cn2, distance):
    k = 2 * math.pi / 500e-9
    path = integrate.quad(lambda s: cn2 * (1 - s / distance) ** (5 / 3), 0, distance, epsabs=0)[0]
    expected = (0.423 * k**2 * path) ** -0.6
    assert fried_parameter(cn2, distance, wavelength=500e-9) == pytest.approx(expected, rel=1e-9)
    assert fried_parameter(0.0, distance) == math.inf


@pytest.mark.quick
def test_the_plan_says_where_a_short_exposure_would_be_blurred():
    for aperture, cn2, ratio in ((0.002, 1e-12, None), (0.002, 1e-11, "3.1"), (0.05, 1e-12, "19.4")):
        effect = PhysicalTurbulence(cn2_range=(0.0, cn2), aperture=aperture)
        left_out = f"BlurredTurbulence blurs short exposures too, D / r0 is up to {ratio}"
        assert (left_out in str(effect.plan(1080, 1920))) == (ratio is not None)
        assert (effect.blur_ratio > 1) == (ratio is not None)


def test_a_displacement_below_the_tolerance_is_not_computed():
    weak = PhysicalTurbulence(cn2_range=(1e-18, 1e-17))
    assert weak.plan(1080, 1920).is_identity
    image = torch.rand(1, 3, 36, 64)
    for depth in (None, 300 * torch.rand(1, 1, 36, 64)):
        assert torch.equal(weak.degrade(image, seed=1, depth=depth).image, image)
    assert "each pixel has a ray of its own" in str(PhysicalTurbulence().plan(1080, 1920))
    # Some pixel of a frame moves by up to seven deviations, and towards the road air moves pixels farther.
    deviation = PhysicalTurbulence(cn2_range=(1e-15, 1e-15)).equivalent_amplitude(1920)[1]
    for share, height, is_identity in ((0.15, None, False), (0.12, None, True), (0.12, 1.3, False)):
        cn2 = 1e-15 * (share * TOLERANCE_PX / deviation) ** 2
        effect = PhysicalTurbulence(cn2_range=(cn2, cn2), height=height)
        assert effect.plan(1080, 1920).is_identity == is_identity


def test_a_missing_width_raises():
    with pytest.raises(ValueError, match="width must be that of the frames"):
        Turbulence().equivalent_cn2()
    assert isinstance(PhysicalTurbulence().depth, GroundPlaneDepth)
