"""What holds for every image, and every argument in the domain of an effect."""

import pytest
import torch
from domain import DOMAINS, WARNED, cases
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.fields import torus
from torchrefract.fields.random_field import COVARIANCES

MAPS = ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission", "extinction", "intensity")
FLOATS = (torch.float32, torch.float64)
small = pytest.mark.usefixtures("small_tori")
pytestmark = WARNED


@pytest.fixture(params=DOMAINS)
def name(request) -> str:
    return request.param


def test_every_public_effect_has_a_domain():
    kinds = {kind for kind in vars(tr).values() if isinstance(kind, type) and issubclass(kind, Effect)}
    # Compositions and what draws nothing have no ranges.
    assert kinds - {tr.Compose, tr.OneOf, tr.Rectification} == {domain.kind for domain in DOMAINS.values()}


def maps(degraded: tr.Degraded) -> dict[str, Tensor]:
    return {name: getattr(degraded, name) for name in MAPS if getattr(degraded, name) is not None}


def each_alone(effect: Effect, image: Tensor, keys: list[int]) -> dict[str, Tensor]:
    """The maps of a batch, which are those of each sample alone, bit for bit."""
    together = maps(effect.degrade(image, seed=7, keys=keys))
    for i, key in enumerate(keys):
        for field, value in maps(effect.degrade(image[i : i + 1], seed=7, keys=[key])).items():
            assert torch.equal(value, together[field][i : i + 1]), field
    return together


def unbounded(effect: Effect) -> bool:
    return isinstance(effect, tr.LensFlare) and not effect.clip and effect.blend == "add"


@small
@given(data=st.data())
def test_what_comes_out_is_finite_in_range_and_of_the_same_kind(name, data):
    effect, image = data.draw(cases(name))
    degraded = effect.degrade(image, seed=7)
    for key, value in maps(degraded).items():
        assert value.isfinite().all(), key
        assert value.shape[2:] == image.shape[2:], key
        assert len(value) == len(image), key
    result = degraded.image
    assert (result.shape, result.dtype, result.stride()) == (image.shape, image.dtype, image.stride())
    if image.dtype is not torch.uint8:
        # The weights of a bilinear look-up add up to 1 but for their rounding.
        room = 4 * torch.finfo(torch.promote_types(image.dtype, torch.float32)).eps
        assert (result >= -room).all()
        assert unbounded(effect) or (result <= 1 + room).all()
    if degraded.transmission is not None:
        assert ((degraded.transmission >= 0) & (degraded.transmission <= 1)).all()


@small
@given(data=st.data())
def test_gradients_are_finite(name, data):
    effect, image = data.draw(cases(name, dtypes=FLOATS))
    params = effect.sample(image, seed=7)
    learned = {key: v.clone().requires_grad_() for key, v in params._asdict().items() if v.is_floating_point()}
    image = image.clone().requires_grad_()
    result = effect.apply(image, params._replace(**learned)).image
    weights = torch.rand(result.shape, generator=torch.Generator().manual_seed(1), dtype=result.dtype)
    found = torch.autograd.grad((result * weights).sum(), [image, *learned.values()], allow_unused=True)
    for key, gradient in zip(["image", *learned], found, strict=True):
        assert gradient is None or gradient.isfinite().all(), key


@small
@given(data=st.data())
def test_what_is_off_is_the_image_bit_for_bit(name, data):
    never = data.draw(st.booleans())
    effect, image = data.draw(cases(name, fixed={"p": 0.0} if never else {}))
    params = effect.sample(image, seed=7)
    degraded = effect.apply(image, params._replace(applied=torch.zeros_like(params.applied)))
    off = effect.degrade(image, seed=7) if never else degraded
    for found in (degraded, off):
        assert torch.equal(found.image, image)
        assert found.flow is None or not found.flow.any()


@small
@given(data=st.data())
def test_a_batch_is_each_sample_alone(name, data):
    effect, image = data.draw(cases(name, batch=3))
    keys = data.draw(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=len(image), max_size=len(image)))
    each_alone(effect, image, keys)


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("kind", [tr.Turbulence, tr.DivergenceFree])
def test_the_longest_correlations_take_the_largest_torus(kind, covariance, full_extremes, monkeypatch):
    if not full_extremes:
        monkeypatch.setattr(torus, "_MOST_POINTS", 1 << 16)
    rows, columns = torus.torus(24, 31, length=1e6, kind=covariance)
    assert torus._MOST_POINTS / 2 < rows * columns <= torus._MOST_POINTS
    effect = kind(length_range=(1e6, 1e6), covariance=covariance, tolerance_px=None)
    image = torch.rand(2, 3, 24, 31, generator=torch.Generator().manual_seed(0))
    together = each_alone(effect, image, [1, 2])
    assert all(value.isfinite().all() for value in together.values())
    assert together["flow"].any()
    assert (together["image"] >= 0).all()
    assert (together["image"] <= 1 + 1e-6).all()
