import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import FogParams, LinearDepth, UniformFog, remove_fog

AIRLIGHT = (0.9, 0.7, 0.8)


def number(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def foggy(clean: Tensor, *, linear_light: bool = False, far: float = 200.0) -> Any:
    """The image in a fog that lets light through between 1 and less than 1/255 of it."""
    depth = number(*clean.shape[:-3], 1, *clean.shape[-2:], high=far)
    effect = UniformFog(visibility_range=(50.0, 150.0), airlight=AIRLIGHT, linear_light=linear_light)
    return effect.degrade(clean, seed=7, depth=depth)


@pytest.mark.parametrize("linear_light", [False, True])
def test_fog_of_known_transmission_is_taken_away(linear_light):
    clean = number(3, 3, 40, 60)
    degraded = foggy(clean, linear_light=linear_light)
    found, valid = remove_fog(
        degraded.image, degraded.transmission, degraded.params.airlight, linear_light=linear_light
    )
    assert torch.equal(valid, degraded.valid)
    assert 0.5 < valid.double().mean() < 1
    error = (found - clean).abs() * degraded.transmission
    # The standard's sRGB curve and its inverse differ by 1e-7 at their joint.
    assert error[valid.expand_as(error)].amax() <= (1e-6 if linear_light else 1e-15)
    assert torch.equal(found[~valid.expand_as(found)], degraded.image[~valid.expand_as(found)])


def test_single_precision_costs_its_rounding_over_the_transmission():
    clean = number(2, 3, 40, 60).float()
    degraded = foggy(clean)
    found, valid = remove_fog(degraded.image, degraded.transmission, AIRLIGHT)
    error = (found - clean).abs() * degraded.transmission
    assert error[valid.expand_as(error)].amax() <= 4 * torch.finfo(torch.float32).eps


def test_eight_bits_cost_half_a_level_over_the_transmission():
    clean = (255 * number(2, 3, 40, 60)).round().to(torch.uint8)
    degraded = foggy(clean)
    assert degraded.image.dtype == torch.uint8
    t, levels = degraded.transmission.double(), degraded.image.double()
    exact, valid = remove_fog(levels / 255, t, AIRLIGHT)
    known = valid.expand_as(exact)
    # The fog itself was blended in single precision.
    assert (((255 * exact - clean).abs() * t)[known] <= 0.5 + 1e-4).all()
    found, valid = remove_fog(degraded.image, degraded.transmission, AIRLIGHT)
    assert found.dtype == torch.uint8
    assert torch.equal(valid, degraded.valid)
    assert (((found.double() - clean).abs() - 0.5) * t <= 0.5 + 1e-4)[known].all()
    assert_close(found.double()[known], (255 * exact).round().clamp(0, 255)[known], rtol=0, atol=1)
    assert torch.equal(found[~known], degraded.image[~known])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("linear_light", [False, True])
def test_clear_air_and_an_opaque_wall_leave_every_bit(dtype, linear_light):
    image = (255 * number(2, 3, 9, 14)).round().to(dtype) if dtype is torch.uint8 else number(2, 3, 9, 14).to(dtype)
    for t, seen in ((1.0, True), (0.0, False), (0.0039, False)):
        found, valid = remove_fog(image, torch.full((2, 1, 9, 1), t), 0.8, linear_light=linear_light)
        assert torch.equal(found, image)
        assert found.dtype == dtype
        assert valid.shape == (2, 1, 9, 14)
        assert bool(valid.all()) == bool(valid.any()) == seen


@pytest.mark.parametrize("airlight", [0.6, (0.6,), AIRLIGHT, "channels", "samples"])
def test_every_form_of_the_airlight_and_the_transmission_is_the_formula(airlight):
    image, t = number(2, 3, 9, 14), number(2, 1, 9, 14, low=0.1)
    colors = {"channels": number(3), "samples": number(2, 3)}
    given: Any = colors.get(airlight, airlight) if isinstance(airlight, str) else airlight
    a = np.broadcast_to(np.asarray(given), (2, 3))[:, :, None, None]
    for shape in (t, t[:1], t[..., :1], t[:1, :, :1, :1]):
        expected = a + (image.numpy() - a) / shape.numpy()
        assert_close(remove_fog(image, shape, given)[0], torch.from_numpy(expected), rtol=1e-12, atol=1e-14)


def test_an_unbatched_or_strided_image_is_the_batched_one():
    image, t = number(2, 3, 9, 14), number(2, 1, 9, 14)
    found, valid = remove_fog(image, t, AIRLIGHT)
    alone, valid_alone = remove_fog(image[1], t[1], torch.tensor(AIRLIGHT, dtype=torch.float64))
    assert torch.equal(alone, found[1])
    assert torch.equal(valid_alone, valid[1])
    last = image.contiguous(memory_format=torch.channels_last)
    assert torch.equal(remove_fog(last, t, AIRLIGHT)[0], found)
    assert remove_fog(last, t, AIRLIGHT)[0].is_contiguous(memory_format=torch.channels_last)
    across = remove_fog(image.mT.contiguous().mT, t, AIRLIGHT)[0]
    assert torch.equal(across, found)
    assert across.is_contiguous()
    assert remove_fog(image[:0], t[:0], torch.ones(0, 3))[0].shape == (0, 3, 9, 14)


@pytest.mark.parametrize("linear_light", [False, True])
def test_gradients_are_those_of_finite_differences(linear_light):
    image, t, airlight = number(2, 3, 3, 4, low=0.2), number(2, 1, 3, 4, low=0.2, high=0.9), number(2, 3, low=0.3)
    t[0, 0, 0] = 0.001

    def clear(image, t, airlight):
        return remove_fog(image, t, airlight, linear_light=linear_light)[0]

    assert torch.autograd.gradcheck(clear, [value.requires_grad_() for value in (image, t, airlight)])


@pytest.mark.parametrize("linear_light", [False, True])
def test_where_nothing_is_left_of_the_light_gradients_are_finite_and_bad_pixels_stay_local(linear_light):
    image, t = number(1, 3, 4, 5), torch.zeros(1, 1, 4, 5, dtype=torch.float64)
    t[..., 2:] = 0.5
    image[0, 0, 0, 0], image[0, 1, 0, 1], image[0, 2, 3, 4] = math.inf, math.nan, math.nan
    found, _ = remove_fog(image, t, AIRLIGHT, linear_light=linear_light)
    assert torch.equal(found.nan_to_num(), torch.where(t > 0, found, image).nan_to_num())
    assert torch.equal(found.isfinite(), image.isfinite())
    values = [number(1, 3, 4, 5).requires_grad_(), t.requires_grad_(), torch.tensor(AIRLIGHT).requires_grad_()]
    clean, _ = remove_fog(*values, linear_light=linear_light)
    for gradient in torch.autograd.grad(clean.sum(), values):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("linear_light", [False, True])
def test_one_graph_and_vmap_give_the_same(linear_light):
    image, t, airlight = number(2, 3, 9, 14).float(), number(2, 1, 9, 14, low=0.1).float(), number(2, 3).float()
    found, valid = remove_fog(image, t, airlight, linear_light=linear_light)

    def clear(image, t, airlight):
        return remove_fog(image, t, airlight, linear_light=linear_light)

    for other in (torch.compile(clear, fullgraph=True), torch.vmap(clear)):
        assert_close(other(image, t, airlight)[0], found, rtol=0, atol=2e-4)
        assert torch.equal(other(image, t, airlight)[1], valid)


@pytest.mark.parametrize("linear_light", [False, True])
def test_a_sample_does_not_depend_on_the_batch_or_the_threads(linear_light, on_threads):
    image, t, airlight = number(5, 3, 131, 119).float(), number(5, 1, 131, 119).float(), number(5, 3).float()
    on_threads(1)
    samples = zip(*(value.split(1) for value in (image, t, airlight)), strict=True)
    alone = torch.cat([remove_fog(*sample, linear_light=linear_light)[0] for sample in samples])
    for threads in (1, 2, 3):
        on_threads(threads)
        assert torch.equal(remove_fog(image, t, airlight, linear_light=linear_light)[0], alone)


@pytest.mark.parametrize(
    ("changed", "error", "rule"),
    [
        ({"image": torch.zeros(4, 5)}, ValueError, r"image must have shape \(B, C, H, W\)"),
        ({"image": torch.zeros(1, 3, 4, 5).int()}, TypeError, "image must be floating in .* or uint8"),
        ({"image": [0.0]}, TypeError, "image must be a tensor"),
        ({"transmission": torch.ones(1, 1, 4, 4)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 3, 4, 5)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(2, 1, 4, 5)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 4, 5)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 1, 4, 5).int()}, TypeError, "transmission must be of a floating type"),
        ({"transmission": torch.full((1, 1, 4, 5), 1.01)}, ValueError, r"transmission must be in \[0, 1\], got 1\.01"),
        ({"transmission": torch.full((1, 1, 4, 5), -0.01)}, ValueError, r"transmission must be in \[0, 1\]"),
        ({"transmission": torch.full((1, 1, 4, 5), math.nan)}, ValueError, r"transmission must be in \[0, 1\]"),
        ({"airlight": 1.5}, ValueError, "airlight must be a number in"),
        ({"airlight": (0.1, 0.2)}, ValueError, "airlight must have 1 number or 3"),
        ({"airlight": torch.ones(2, 3)}, ValueError, r"airlight must have shape \(3,\) or \(1, 3\)"),
        ({"airlight": torch.tensor([0.1, math.nan, 0.2])}, ValueError, "airlight must be finite"),
        ({"linear_light": 1}, TypeError, "linear_light must be True or False"),
    ],
)
def test_arguments_that_do_not_fit_raise(changed: dict[str, Any], error, rule):
    fine = {"image": torch.zeros(1, 3, 4, 5), "transmission": torch.ones(1, 1, 4, 5), "airlight": 0.8}
    with pytest.raises(error, match=rule):
        remove_fog(**(fine | changed))


def test_the_fog_of_given_params_is_taken_away_by_them():
    clean = number(2, 3, 20, 30)
    params = FogParams(
        torch.ones(2, dtype=torch.bool), torch.tensor([40.0, 300.0]).double(), torch.zeros(2).double(), number(2, 3)
    )
    degraded = UniformFog(depth=LinearDepth(max_depth=60.0)).apply(clean, params)
    found, valid = remove_fog(degraded.image, degraded.transmission, params.airlight)
    assert valid.all()
    assert_close(found, clean, rtol=0, atol=1e-12)
