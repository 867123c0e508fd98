import math
import warnings
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from torchrefract import Compose, DivergenceFree, GroundPlaneDepth, ThinPlateSpline, Turbulence, folding
from torchrefract.fields import random_field
from torchrefract.fields.random_field import COVARIANCES

CALM: dict[str, Any] = {"amplitude_range": (0.3, 0.3), "length_range": (12.0, 12.0), "aperture_range": (2.0, 2.0)}


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("aperture", [0.0, 3.0])
def test_the_amplitude_is_the_standard_deviation_of_each_component(covariance, aperture):
    effect = Turbulence(
        amplitude_range=(0.2, 0.2), length_range=(4.0, 8.0), aperture_range=(aperture, aperture), covariance=covariance
    )
    flow = effect.degrade(torch.zeros(40, 1, 64, 96), seed=1).flow
    assert_close(flow.square().mean(dim=(0, 2, 3)).sqrt(), torch.full((2,), 0.2), rtol=0.03, atol=0)
    assert flow.mean(dim=(0, 2, 3)).abs().max() < 0.01


def test_each_field_normalized_by_the_image_has_the_amplitude():
    effect = Turbulence(**CALM, normalize="image")
    flow = effect.degrade(torch.zeros(3, 1, 64, 96), seed=1).flow
    assert_close(flow.std(dim=(2, 3), correction=0), torch.full((3, 2), 0.3), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("covariance", "normalize"), [*zip(COVARIANCES, ("theory", "image") * 2, strict=True)])
def test_a_field_of_ten_frames_stays_finite(covariance, normalize):
    effect = Turbulence(amplitude_range=(1, 1), length_range=(180, 180), covariance=covariance, normalize=normalize)
    image = torch.rand(2, 3, 12, 18)
    params = effect.sample(image, seed=1)
    length = params.length.clone().requires_grad_()
    degraded = effect.apply(image, params._replace(length=length))
    assert degraded.image.isfinite().all()
    assert degraded.flow.isfinite().all()
    # One standard deviation, or at most six if each field is normalized.
    assert degraded.flow.abs().max() < 6
    assert torch.autograd.grad(degraded.image.sum(), length)[0].isfinite().all()
    assert degraded.restore_flow[degraded.restore_valid.expand_as(degraded.restore_flow)].isfinite().all()


def test_a_field_without_length_is_white_noise_of_the_amplitude():
    effect = Turbulence(amplitude_range=(0.1, 0.1), length_range=(0.1, 0.1), aperture_range=(0.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        flow = effect.degrade(torch.zeros(4, 1, 128, 128), seed=1).flow
    assert flow.std().item() == pytest.approx(0.1, rel=0.01)
    assert torch.corrcoef(torch.stack([flow[..., 1:].flatten(), flow[..., :-1].flatten()]))[0, 1].abs() < 0.02


def test_an_amplitude_that_folds_warns_and_folded_pixels_are_not_valid():
    length = 20.0
    limit = 0.14 * math.sqrt(length)  # of the exponential covariance without an aperture
    image = torch.rand(1, 3, 96, 128)

    def at(amplitude: float) -> Turbulence:
        return Turbulence(
            amplitude_range=(amplitude, amplitude), length_range=(length, length), aperture_range=(0.0, 0.0)
        )

    calm = at(0.9 * limit).degrade(image, seed=1)
    assert folding(calm.flow).fraction < 1e-3
    with pytest.warns(UserWarning, match="Turbulence this strong folds the image"):
        wild = at(8 * limit).degrade(image, seed=1)
    assert folding(wild.flow).fraction > 0.05
    assert wild.image.isfinite().all()
    assert wild.restore_flow.isfinite().all()
    assert wild.restore_valid.double().mean() < 0.9 < calm.restore_valid.double().mean()
    assert torch.where(wild.restore_valid, wild.restore_residual, 0).max() < 0.05


@pytest.mark.parametrize("effect", [Turbulence, DivergenceFree])
def test_a_length_beyond_the_largest_domain_warns(effect, monkeypatch):
    monkeypatch.setattr(random_field, "_MAX_POINTS", 1 << 12)
    long = effect(length_range=(60.0, 60.0), covariance="gaussian")
    with pytest.warns(UserWarning, match=r"length must fit into .* domain .* got 60 px: .*% of the spectrum"):
        degraded = long.degrade(torch.rand(2, 1, 27, 48), seed=0)
    assert degraded.flow.isfinite().all()
    assert degraded.flow.std() > 0.1
    # Samples that are not degraded do not warn, and shorter lengths fit.
    effect(length_range=(60.0, 60.0), covariance="gaussian", p=0.0).degrade(torch.rand(2, 1, 27, 48), seed=0)
    effect(length_range=(4.0, 4.0), amplitude_range=(0.1, 0.1)).degrade(torch.rand(2, 1, 27, 48), seed=0)


FIELD: dict[str, Any] = {"amplitude_range": (0.8, 0.8), "length_range": (12.0, 12.0), "aperture_range": (2.0, 2.0)}


@pytest.mark.parametrize(
    "options",
    [{}, {"covariance": "gaussian"}, {"tolerance_px": None}, {"normalize": "image", "covariance": "gaussian"}],
)
def test_the_displacement_grows_with_the_root_of_depth_up_to_the_reference(options):
    image, columns = torch.rand(2, 3, 48, 64), torch.arange(64)
    depth = (2.0 * (1 + columns)).expand(2, 1, 48, -1)  # m
    depth = torch.where(columns < 60, depth, torch.inf)
    effect = Turbulence(**FIELD, **options, depth=GroundPlaneDepth(), reference_distance=80.0)
    flow = effect.degrade(image, seed=1, depth=depth).flow
    whole = Turbulence(**FIELD, **options).degrade(image, seed=1).flow
    assert_close(flow, whole * (depth / 80).clamp(max=1).sqrt(), rtol=0, atol=0.03 if effect.tolerance_px else 1e-6)


def test_a_field_at_depth_is_within_its_tolerance_alone_and_in_a_composition():
    image, depth = torch.rand(1, 3, 90, 120), 300 * torch.rand(1, 1, 90, 120)
    smooth: dict[str, Any] = {"covariance": "gaussian", "length_range": (30.0, 40.0), "depth": GroundPlaneDepth()}
    options: dict[str, Any] = FIELD | smooth
    for tolerance_px in (0.02, 0.1):
        effect = Turbulence(**options, tolerance_px=tolerance_px)
        stride, _ = effect.plan(90, 120).details
        assert stride > 2  # the field, not its share, is interpolated
        exact = Turbulence(**options, tolerance_px=None)
        params = effect.sample(image, seed=1)
        flows = [one.apply(image, params, depth=depth).flow for one in (effect, exact)]
        assert 0 < (flows[0] - flows[1]).norm(dim=1).max() <= tolerance_px
        composed = Compose([effect, ThinPlateSpline()], tolerance_px=tolerance_px)
        composed_exact = Compose([exact, ThinPlateSpline(tolerance_px=None)], tolerance_px=None)
        params = composed.sample(image, seed=1)
        wall = torch.full((1, 1, 90, 120), 300.0)
        flows = [one.apply(image, params, depth=wall).flow for one in (composed, composed_exact)]
        assert (flows[0] - flows[1]).norm(dim=1).max() <= tolerance_px


def test_the_flow_has_the_gradient_of_its_depth():
    effect = Turbulence(**FIELD, depth=GroundPlaneDepth(), reference_distance=100.0, tolerance_px=None)
    image, depth = torch.rand(1, 1, 3, 4, dtype=torch.float64), 90 * torch.rand(1, 1, 3, 4, dtype=torch.float64)
    params = effect.sample(image, seed=1)
    assert torch.autograd.gradcheck(lambda d: effect.apply(image, params, depth=d).flow, depth.requires_grad_())


def test_without_a_depth_of_its_own_a_field_ignores_depth():
    image, effect = torch.rand(1, 3, 36, 48), Turbulence(**FIELD)
    assert torch.equal(
        effect.degrade(image, seed=1, depth=torch.full((1, 1, 36, 48), 5.0)).flow, effect.degrade(image, seed=1).flow
    )
