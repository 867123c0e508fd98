"""The rows of the contract that are shown here: each over all types, sizes, paddings and devices that it speaks of."""

import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence

import pytest
import torch
from contract import ROWS
from domain import DTYPES, WARNED
from promises import KINDS, LEARNED, MASKED, NOTHING, REFUSED, TOLD
from torch import Tensor
from torch.testing import assert_close
from torchrefract.effects.refraction import WarpEffect

import torchrefract as tr
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SIZES = [(1, 1), (1, 37), (31, 1), (23, 29), (40, 64)]
LARGE = [(1, 40000), (240, 320)]  # more than 32767 px, where half kernels of the CPU end
FULL = [(1080, 1920), (2160, 3840), (4320, 7680), (1, 40000), (40000, 1)]
THIN = {  # what effects tell of their defaults in frames of one row or column
    ("lens", (40000, 1)): "the lens must not fold back inside the frame",
    ("divergence-free", (1, 40000)): "length must be short enough for a torus",
    ("divergence-free", (40000, 1)): "length must be short enough for a torus",
}
MAPS = ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission", "extinction", "intensity")
EFFECTS = {
    **KINDS,
    "fog in space": lambda **options: tr.HeterogeneousFog(mode="ray", **options),
    "compose": lambda **options: tr.Compose([tr.Turbulence(), tr.LensDistortion(), tr.UniformFog()], **options),
    "one of": lambda **options: tr.OneOf([tr.DivergenceFree(), tr.ThinPlateSpline(), tr.LensFlare()], **options),
}


def cases(test: str) -> list:
    """What a test is parametrized by."""
    return [
        pytest.param(make, name, id=f"{row.effect}: {name}")
        for row in ROWS
        if row.test == test
        for name, make in row.cases.items()
    ]


def picture(*shape: int, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Tensor:
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    return ((255 * image).round() if dtype is torch.uint8 else image).to(device, dtype)


def maps(degraded: tr.Degraded) -> dict[str, Tensor]:
    return {name: getattr(degraded, name) for name in MAPS if getattr(degraded, name) is not None}


def ways(make) -> list[dict]:
    """The options of warps that there are for such an effect."""
    if not isinstance(make(), WarpEffect):
        return [{}]
    pairs = itertools.product(PADDINGS, INTERPOLATIONS)
    return [{"padding": padding, "interpolation": interpolation} for padding, interpolation in pairs]


@pytest.fixture
def product(pytestconfig) -> Callable[..., Iterable[tuple]]:
    """All combinations; unless all is asked for, so many of them that each value of each list has its turn."""

    def of(*lists: Sequence) -> Iterable[tuple]:
        if pytestconfig.getoption("extremes") == "full":
            return itertools.product(*lists)
        longest = range(max(map(len, lists)))
        # Each list a step ahead of the one before, so that not only equal places meet.
        return [
            tuple(values[(i + i // len(values) * n) % len(values)] for n, values in enumerate(lists)) for i in longest
        ]

    return of


def in_range(image: Tensor) -> bool:
    room = 0 if image.dtype is torch.uint8 else 4 * torch.finfo(torch.promote_types(image.dtype, torch.float32)).eps
    return bool((image >= -room).all() and (image <= (255 if image.dtype is torch.uint8 else 1 + room)).all())


@pytest.mark.parametrize(("call", "name"), cases(REFUSED))
def test_what_is_none_is_refused_by_parameter_rule_and_value(call, name):
    parameter = re.escape(name.split()[0])
    with pytest.raises(ValueError, match=rf"^{parameter}\b.* must .+, got .+"):
        call()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("make", "name"), cases(NOTHING))
def test_nothing_to_do_leaves_every_bit(make, name, device, product):
    for way, dtype, size in product(ways(make), DTYPES, SIZES):
        image = picture(2, 3, *size, dtype=dtype, device=device)
        degraded = make(**way).degrade(image, seed=7)
        assert torch.equal(degraded.image, image), (way, dtype, size)
        assert degraded.valid.all(), (way, dtype, size)
        assert degraded.flow is None or not degraded.flow.any(), (way, dtype, size)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES[1:])
@pytest.mark.parametrize(("make", "name"), cases(MASKED))
@WARNED
def test_what_leaves_its_domain_is_finite_and_masked(make, name, size, device, product):
    for way, dtype in product(ways(make), DTYPES):
        effect, image = make(**way), picture(2, 3, *size, dtype=dtype, device=device)
        degraded = effect.degrade(image, seed=7)
        assert degraded.image.dtype is dtype
        assert in_range(degraded.image), (way, dtype)
        for field, value in maps(degraded).items():
            assert value.isfinite().all(), (way, dtype, field)
        sound = degraded.restore_valid
        assert not degraded.restore_residual[sound].isnan().any(), (way, dtype)
        assert name[:2] == "k1" or (degraded.restore_residual[sound] <= 0.05 + 1e-5 * degraded.flow.abs().max()).all()
        assert not (sound & (degraded.restore_residual > max(size))).any(), (way, dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("make", "name"), cases(LEARNED))
@WARNED
def test_gradients_are_finite_where_nothing_is_known(make, name, dtype, device):
    for size in SIZES[1:]:
        effect, image = make(), picture(2, 3, *size, dtype=dtype, device=device)
        params = effect.sample(image, seed=7)
        learned = {key: v.clone().requires_grad_() for key, v in params._asdict().items() if v.is_floating_point()}
        degraded = effect.apply(image, params._replace(**learned))
        for value in (degraded.image, degraded.flow, degraded.restore_flow):
            for gradient in torch.autograd.grad(value.double().sum(), list(learned.values()), retain_graph=True):
                assert gradient.isfinite().all(), size


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("make", "name"), cases(TOLD))
def test_what_is_masked_is_told_once(make, name, device):
    if device != "cpu":
        pytest.skip("nothing is read from a device to warn of it")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        effect = make()
        for _ in range(3):
            assert not effect.degrade(picture(1, 3, 40, 64), seed=7).restore_valid.all()
    assert [warning.category for warning in caught] == [UserWarning]
    assert "fold" in str(caught[0].message)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("far", [1e6, -1e6, 3e38, math.inf, -math.inf, math.nan])
def test_a_flow_that_is_no_flow_is_masked(far, dtype, device):
    for padding, interpolation, size in itertools.product(PADDINGS, INTERPOLATIONS, SIZES):
        image = picture(2, 3, *size, dtype=dtype, device=device)
        flow = torch.zeros(2, 2, *size, dtype=torch.float64 if dtype is torch.float64 else torch.float32, device=device)
        flow[1, :, size[0] // 2, size[1] // 2] = far
        learned = image.clone().requires_grad_(image.is_floating_point())
        warped, valid = tr.warp(learned, flow.requires_grad_(), padding=padding, interpolation=interpolation)
        assert warped.isfinite().all()
        assert in_range(warped.detach())
        assert valid[0].all()
        assert (~valid[1]).sum() == 1
        if image.is_floating_point():
            for gradient in torch.autograd.grad(warped.double().sum(), [learned, flow]):
                assert gradient.isfinite().all(), (padding, interpolation, size)
        inverse, solved, residual = tr.invert_flow(flow.detach())
        assert inverse.isfinite().all()
        assert residual.isfinite().all()
        assert not solved[1, 0, size[0] // 2, size[1] // 2]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", PADDINGS)
def test_bicubic_stays_in_the_range_of_the_values(padding, dtype, device):
    for size in SIZES:
        two = picture(2, 3, *size) > 0.5
        flow = 3 * torch.rand(2, 2, *size, generator=torch.Generator().manual_seed(1)) - 1.5
        scale, offset = (200, 20) if dtype is torch.uint8 else (0.5, 0.25)
        # Outside zeros is black, which belongs to the values.
        low, high = (0 if padding == "zeros" else offset), offset + scale
        image = (scale * two + offset).to(device, dtype)
        warped, _ = tr.warp(image, flow.to(device), padding=padding, interpolation="bicubic")
        assert (warped >= low).all(), size
        assert (warped <= high).all(), size


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", EFFECTS)
def test_shape_layout_and_channels_change_no_bit(name, dtype, device, product):
    effect = EFFECTS[name]()
    for channels, size in product([1, 3, 4, 12], SIZES):
        image = picture(2, channels, *size, dtype=dtype, device=device)
        expected = effect.degrade(image, seed=7).image
        layouts = {
            "channels_last": image.contiguous(memory_format=torch.channels_last),
            "strided": torch.stack([image, image], dim=-1)[..., 0],
            "transposed": image.mT.contiguous().mT,
        }
        for layout, other in layouts.items():
            found = effect.degrade(other, seed=7).image
            near = dtype is torch.uint8 and layout == "channels_last"  # looked up by OpenCV, where that is installed
            same = (found.int() - expected.int()).abs().max() <= 1 if near else torch.equal(found, expected)
            assert same, (layout, channels, size)
        alone = effect.degrade(image[0], seed=7, keys=[0]).image
        # Its products of matrices are other kernels for one image, which add in another order.
        off = 0.0 if device == "cpu" else None
        assert_close(alone, expected[0], rtol=off, atol=off, msg=f"{channels}, {size}")


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("size", LARGE)
@pytest.mark.parametrize("name", EFFECTS)
def test_half_images_are_computed_in_single_precision(name, size, dtype, device):
    effect, image = EFFECTS[name](), picture(1, 3, *size, dtype=dtype, device=device)
    found = effect.degrade(image, seed=7)
    wide = effect.degrade(image.float(), seed=7)
    assert torch.equal(found.image, wide.image.to(dtype))
    assert found.flow is None or torch.equal(found.flow, wide.flow)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", EFFECTS)
def test_large_frames_are_finite_and_each_sample_is_as_alone(name, device, pytestconfig):
    effect, keys = EFFECTS[name](), torch.tensor([5, 2**40])
    for size in FULL if pytestconfig.getoption("extremes") == "full" else FULL[:1]:
        image = picture(2, 1, *size, device=device)
        if (name, size) == ("fog in drifts", (40000, 1)):
            with pytest.raises(ValueError, match="scales must have periods of at least"):
                effect.degrade(image, seed=7, keys=keys)
            continue
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            together = effect.degrade(image, seed=7, keys=keys)
            assert in_range(together.image)
            alone = effect.degrade(image[1:], seed=7, keys=keys[1:])
            assert torch.equal(alone.image, together.image[1:])
            for field in ("flow", "valid", "transmission"):
                value = getattr(alone, field)
                whole = getattr(together, field)
                assert value is None or (value.isfinite().all() and torch.equal(value, whole[1:])), field
        if device == "cpu":  # elsewhere nothing is read that could be told
            rule = THIN.get((name, size), "")
            assert bool(said) == bool(rule)
            assert all(rule in str(warning.message) for warning in said)


def test_a_visibility_without_end_is_drawn():
    image = picture(4, 3, 8, 9)
    for visibility in (1e31, 1e39, 1e308):
        effect = tr.UniformFog(visibility_range=(visibility, visibility))
        assert torch.equal(effect.degrade(image, seed=7).image, image)
    drawn = tr.UniformFog(visibility_range=(50.0, 1e308)).sample(torch.zeros(1000, 3, 1, 1), seed=7).visibility
    # 1/V is uniform between the ends, as it is up to inf.
    assert (1 / drawn).mean().item() == pytest.approx(0.01, rel=0.1)


def test_an_empty_list_of_keys_goes_with_a_batch_of_none():
    degraded = tr.LensDistortion().degrade(torch.zeros(0, 3, 8, 9), seed=7, keys=[])
    assert degraded.image.shape == (0, 3, 8, 9)
    with pytest.raises(ValueError, match="keys must have one key for each of the 2 images, got shape"):
        tr.LensDistortion().degrade(torch.zeros(2, 3, 8, 9), seed=7, keys=[])


@pytest.mark.parametrize("covariance", ["exponential", "gaussian"])
@pytest.mark.parametrize("size", [(2, 3), (7, 5), (11, 11)])
def test_what_is_normalized_by_the_frame_is_so_in_any_batch(covariance, size):
    effect = tr.Turbulence(normalize="image", covariance=covariance, amplitude_range=(0.1, 0.1))
    image, keys = picture(3, 1, *size), [0, 5, 2**40]
    together = effect.degrade(image, seed=7, keys=keys).flow
    for i, key in enumerate(keys):
        assert torch.equal(effect.degrade(image[i : i + 1], seed=7, keys=[key]).flow[0], together[i])
