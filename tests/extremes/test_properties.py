"""Properties that hold for every image and all valid arguments of an effect."""

import pytest
import torch
from domain import DOMAINS, IGNORE_STRENGTH, cases
from helpers import assert_close_maps, floating_leaves, is_in_range, maps_of, random_image
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.fields import random_field
from torchrefract.fields.random_field import COVARIANCES

FLOATS = (torch.float32, torch.float64)
small = pytest.mark.usefixtures("small_domains")
pytestmark = IGNORE_STRENGTH


@pytest.fixture(params=DOMAINS)
def name(request) -> str:
    return request.param


def assert_independent_of_batch(effect: Effect, image: Tensor, keys: list[int]) -> tr.Degraded:
    """Return the result of a batch, after comparing its maps with those of each sample alone."""
    together = effect.degrade(image, seed=7, keys=keys)
    for i, key in enumerate(keys):
        alone = effect.degrade(image[i : i + 1], seed=7, keys=[key])
        for field, value in alone.params._asdict().items():
            if value is not None:
                assert torch.equal(value[0], getattr(together.params, field)[i]), field
        expected = {field: value[i : i + 1] for field, value in maps_of(together).items()}
        actual = maps_of(alone)
        if getattr(effect, "interpolation", None) == "nearest" and not torch.equal(actual["flow"], expected["flow"]):
            del actual["image"], expected["image"]  # a position within rounding of two pixels may show either
        assert_close_maps(actual, expected)
    return together


def test_every_public_effect_has_a_domain():
    kinds = {kind for kind in vars(tr).values() if isinstance(kind, type) and issubclass(kind, Effect)}
    # Compositions and rectifications have no ranges.
    assert kinds - {tr.BlurredTurbulence, tr.Compose, tr.OneOf, tr.Rectification} == {
        domain.kind for domain in DOMAINS.values()
    }


@small
@given(data=st.data())
def test_results_are_finite_in_range_of_the_kind_of_the_image_and_independent_of_the_batch(name, data):
    effect, image = data.draw(cases(name, batch=3))
    keys = data.draw(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=len(image), max_size=len(image)))
    degraded = assert_independent_of_batch(effect, image, keys)
    for key, value in maps_of(degraded).items():
        assert value.isfinite().all(), key
        assert value.shape[2:] == image.shape[2:], key
        assert len(value) == len(image), key
    result = degraded.image
    assert (result.shape, result.dtype, result.stride()) == (image.shape, image.dtype, image.stride())
    # A flare that adds without clipping has no upper bound.
    is_unbounded = isinstance(effect, tr.LensFlare) and not effect.clip and effect.blend == "add"
    assert is_in_range(result.clamp(max=1) if is_unbounded else result)
    if degraded.transmission is not None:
        assert ((degraded.transmission >= 0) & (degraded.transmission <= 1)).all()


@small
@given(data=st.data())
def test_gradients_are_finite(name, data):
    effect, image = data.draw(cases(name, dtypes=FLOATS))
    params = effect.sample(image, seed=7)
    leaves = floating_leaves(params)
    image = image.clone().requires_grad_()
    result = effect.apply(image, params._replace(**leaves)).image
    weights = random_image(*result.shape, dtype=result.dtype, seed=1)
    gradients = torch.autograd.grad((result * weights).sum(), [image, *leaves.values()], allow_unused=True)
    for key, gradient in zip(["image", *leaves], gradients, strict=True):
        assert gradient is None or gradient.isfinite().all(), key


@small
@given(data=st.data())
def test_an_effect_that_is_not_applied_keeps_every_bit(name, data):
    never = data.draw(st.booleans())
    effect, image = data.draw(cases(name, fixed={"p": 0.0} if never else {}))
    params = effect.sample(image, seed=7)
    results = [effect.apply(image, params._replace(applied=torch.zeros_like(params.applied)))]
    results += [effect.degrade(image, seed=7)] if never else []
    for degraded in results:
        assert torch.equal(degraded.image, image)
        assert degraded.flow is None or not degraded.flow.any()


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("kind", [tr.Turbulence, tr.DivergenceFree])
def test_the_longest_correlations_take_the_largest_domain(kind, covariance, full_extremes, monkeypatch):
    if not full_extremes:
        monkeypatch.setattr(random_field, "_MAX_POINTS", 1 << 16)
    largest = random_field._MAX_POINTS
    rows, columns = random_field.embedding_size(24, 31, length=1e6, kind=covariance)
    assert largest / 2 < rows * columns <= largest
    effect = kind(length_range=(1e6, 1e6), covariance=covariance, tolerance_px=None)
    maps = maps_of(assert_independent_of_batch(effect, random_image(2, 3, 24, 31), [1, 2]))
    assert all(value.isfinite().all() for value in maps.values())
    assert maps["flow"].any()
    assert (maps["image"] >= 0).all()
    assert (maps["image"] <= 1 + 1e-6).all()
