import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers import assert_graph_agrees, decode, encode, random_image
from scipy import stats
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, FogParams, HeterogeneousFog, LinearDepth, UniformFog, remove_fog
from torchrefract.fields.airlight import airlight_of_frame

picture = partial(random_image, dtype=torch.float64)
PAPER_AIRLIGHT = (220 / 255, 220 / 255, 235 / 255)


def fog_params(image: Tensor, visibility: float, deviation: float = 0.0) -> FogParams:
    batch, dtype = image.shape[0], image.dtype
    return FogParams(
        applied=torch.ones(batch, dtype=torch.bool),
        visibility=torch.full((batch,), visibility, dtype=dtype),
        deviation=torch.full((batch,), deviation, dtype=dtype),
        airlight=torch.tensor([PAPER_AIRLIGHT[: image.shape[1]]] * batch, dtype=dtype),
    )


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("linear_light", [False, True])
@pytest.mark.parametrize("has_depth", [False, True])
def test_the_image_is_the_closed_form(dtype, linear_light, has_depth):
    image = picture(2, 3, 20, 30, dtype=dtype)
    depth = 200 * picture(2, 1, 20, 30, dtype=dtype) if has_depth else None
    threshold = 0.02 if has_depth else 0.05
    effect = UniformFog(visibility_range=(50.0, 150.0), linear_light=linear_light, threshold=threshold)
    degraded = effect.degrade(image, seed=7, depth=depth)
    visibility, deviation = (getattr(degraded.params, name).double().numpy() for name in ("visibility", "deviation"))
    rows = (1 - (np.arange(20) + 0.5) / 20) * 160
    d = rows[None, None, :, None] if depth is None else depth.double().numpy()
    k = (-math.log(threshold) / visibility * (1 + deviation))[:, None, None, None]
    t = np.broadcast_to(np.exp(-k * d), (2, 1, 20, 30))
    clean, airlight = image.double().numpy(), np.array(PAPER_AIRLIGHT)[None, :, None, None]
    expected = (
        encode(decode(clean) * t + decode(airlight) * (1 - t)) if linear_light else clean * t + airlight * (1 - t)
    )
    assert_close(degraded.image.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)
    assert_close(degraded.transmission.double(), torch.from_numpy(t.copy()), rtol=0, atol=1e-6)
    assert torch.equal(degraded.valid, degraded.transmission >= 1 / 255)
    assert degraded.valid.any()
    assert degraded.flow is None
    assert degraded.restore_flow is None


def test_the_draw_is_uniform_in_its_ranges():
    image = torch.zeros(4000, 3, 1, 1)
    params = UniformFog(visibility_range=(30.0, 300.0), deviation_range=(-0.2, 0.1)).sample(image, seed=7)
    for values, low, high in ((params.visibility, 30, 300), (params.deviation, -0.2, 0.1)):
        assert stats.kstest(((values.double() - low) / (high - low)).numpy(), "uniform").pvalue > 1e-4
    assert torch.equal(params.airlight, torch.tensor(PAPER_AIRLIGHT).expand(4000, 3))


def test_the_extinction_is_uniform_if_the_visibility_has_no_upper_end():
    params = UniformFog(visibility_range=(50.0, math.inf)).sample(torch.zeros(4000, 3, 1, 1), seed=7)
    assert stats.kstest((50 / params.visibility.double()).numpy(), "uniform").pvalue > 1e-4
    assert params.visibility.min() >= 50


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fog_as_thick_as_a_wall_is_its_airlight_with_finite_gradients(dtype):
    image = picture(1, 3, 20, 30, dtype=dtype).requires_grad_()
    params = fog_params(image.detach(), 1e-3)
    values = [params.visibility.requires_grad_(), params.deviation.requires_grad_(), params.airlight.requires_grad_()]
    degraded = UniformFog().apply(image, params)
    assert torch.equal(degraded.image, params.airlight[:, :, None, None].expand_as(image))
    assert not degraded.valid.any()
    gradients = torch.autograd.grad(degraded.image.sum(), [image, *values])
    expected = [torch.zeros_like(image), torch.zeros(1), torch.zeros(1), torch.full((1, 3), 600.0)]
    assert_close(list(gradients), [value.to(dtype) for value in expected], rtol=1e-5, atol=0)


@pytest.mark.parametrize("linear_light", [False, True])
def test_the_sky_is_infinitely_far(linear_light):
    image = picture(1, 3, 4, 5).requires_grad_()
    depth = torch.full((1, 1, 4, 5), 10.0, dtype=torch.float64)
    depth[..., :2, :] = math.inf
    degraded = UniformFog(linear_light=linear_light).apply(image, fog_params(image.detach(), 100.0), depth=depth)
    assert not degraded.transmission[..., :2, :].any()
    sky = torch.tensor(PAPER_AIRLIGHT, dtype=torch.float64).view(1, 3, 1, 1).expand(-1, -1, 2, 5)
    assert_close(degraded.image[..., :2, :], sky, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(degraded.image.sum(), image)
    assert gradient.isfinite().all()
    assert not gradient[..., :2, :].any()
    clear = UniformFog(linear_light=linear_light).apply(image, fog_params(image.detach(), math.inf), depth=depth)
    assert torch.equal(clear.image, image)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_half_precision_depth_is_converted_to_float32(dtype):
    image, depth = picture(1, 3, 4, 5, dtype=torch.float32), (100 * picture(1, 1, 4, 5)).to(dtype)
    expected = UniformFog().degrade(image, seed=7, depth=depth.float()).image
    assert torch.equal(UniformFog().degrade(image, seed=7, depth=depth).image, expected)


def color_of_opaque_fog(channels: int, airlight: float | tuple[float, ...] | None) -> list[float]:
    """The color of a fog too thick to see through."""
    effect = UniformFog(visibility_range=(1e-3, 1e-3), airlight=airlight)
    return effect.degrade(picture(1, channels, 2, 2), seed=7).image[0, :, 0, 0].tolist()


def test_the_airlight_fits_the_channels():
    assert color_of_opaque_fog(3, None) == pytest.approx(PAPER_AIRLIGHT)
    luminance = float(np.dot((0.2126, 0.7152, 0.0722), PAPER_AIRLIGHT))
    assert color_of_opaque_fog(1, None) == pytest.approx([luminance])
    assert color_of_opaque_fog(4, None) == pytest.approx([luminance] * 4)
    assert color_of_opaque_fog(4, 0.5) == [0.5] * 4
    assert color_of_opaque_fog(2, (0.25, 0.75)) == [0.25, 0.75]
    assert color_of_opaque_fog(3, (0.5,)) == [0.5] * 3


def test_the_airlight_of_the_frame_is_that_of_its_sky_and_dark_at_night():
    image = 0.05 + 0.3 * picture(2, 3, 90, 160)
    image[0, :, :40] = 0.8
    image[1] *= 0.3
    effect = UniformFog(visibility_range=(1e-3, 1e-3), airlight="frame")
    degraded = effect.degrade(image, seed=7)
    assert_close(degraded.params.airlight, airlight_of_frame(image), rtol=0, atol=0)
    assert_close(degraded.image[0, :, 3, 3], torch.full((3,), 0.8, dtype=torch.float64), rtol=0, atol=1e-4)
    assert degraded.image[1, :, 3, 3].max() < 0.15
    other = effect.apply(picture(2, 3, 90, 160), degraded.params)  # the color is a parameter
    assert torch.equal(other.image[:, :, 3, 3], degraded.image[:, :, 3, 3])
    stored = (255 * image).round().to(torch.uint8)
    assert torch.equal(effect.sample(stored, seed=7).airlight, effect.sample(stored.float() / 255, seed=7).airlight)


def test_a_clip_has_the_airlight_of_its_first_frame():
    clip = torch.stack([0.3 * picture(3, 90, 160), 0.6 * picture(3, 90, 160)])[None]
    effect = UniformFog(airlight="frame")
    degraded = effect.degrade(clip, seed=7)
    assert torch.equal(degraded.params.airlight, airlight_of_frame(clip[:, 0]))
    alone = effect.apply(clip[:, 1], degraded.params, frame=1)
    assert_close(alone.image, degraded.image[:, 1], rtol=0, atol=1e-12)


def test_the_plan_of_fog_holds_for_the_airlight_of_any_frame():
    def error(airlight: Any) -> float:
        thin: dict[str, Any] = {"visibility_range": (1e5, 1e5), "depth": LinearDepth(max_depth=10.0), "tolerance": 2.0}
        return UniformFog(airlight=airlight, linear_light=True, **thin).plan(90, 160).error

    assert error("frame") == error((0.0, 1.0, 0.0)) > error(None) > 0


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
def test_fog_of_the_color_of_the_frame_is_the_same_in_any_batch_and_graph(dtype):
    image = picture(3, 3, 24, 32, dtype=torch.float32) * torch.tensor([1.0, 0.5, 0.1]).view(3, 1, 1, 1)
    image = (255 * image).round().to(dtype) if dtype is torch.uint8 else image.to(dtype)
    effect = HeterogeneousFog(airlight="frame")
    expected = effect.degrade(image, seed=7, keys=[3, 4, 5])
    part = effect.degrade(image[[2, 0]], seed=7, keys=[5, 3])
    assert torch.equal(part.params.airlight, expected.params.airlight[[2, 0]])
    assert_close(part.image, expected.image[[2, 0]], rtol=0, atol=1 if dtype is torch.uint8 else 1e-3)
    if dtype is torch.float32:
        assert_graph_agrees(UniformFog(airlight="frame"), image)  # a smaller graph with the same airlight


def test_an_airlight_for_other_channels_raises():
    with pytest.raises(ValueError, match="airlight must have 1 number or 4, one for each channel"):
        UniformFog(airlight=(0.1, 0.2, 0.3)).degrade(picture(1, 4, 2, 2), seed=7)
    image = picture(1, 4, 2, 2)
    with pytest.raises(ValueError, match=r"params\.airlight must have shape \(B, 4\), got \(1, 3\)"):
        UniformFog().apply(image, fog_params(image, 10.0))


@pytest.mark.parametrize("linear_light", [False, True])
def test_gradients_match_finite_differences(linear_light):
    image, depth = picture(2, 3, 3, 4), 100 * picture(2, 1, 3, 4)
    params = fog_params(image, 60.0, deviation=0.03)
    effect = UniformFog(linear_light=linear_light)

    def foggy(image, depth, visibility, deviation, airlight):
        return effect.apply(image, FogParams(params.applied, visibility, deviation, airlight), depth=depth).image

    inputs = [image, depth, params.visibility, params.deviation, params.airlight]
    assert torch.autograd.gradcheck(foggy, [value.clone().requires_grad_() for value in inputs])


@pytest.mark.parametrize("size", [(36, 64), (72, 128)])
def test_a_camera_converts_depth_to_the_distance_along_each_ray(size):
    camera = Camera(width=128, height=72, fx=90.0, fy=110.0, cx=50.0, cy=40.0, coefficients=(0.0,) * 4)
    image, depth = picture(2, 3, *size), 5 + 80 * picture(2, 1, *size)
    d = UniformFog(camera=camera).degrade(image, seed=7, depth=depth)
    scale = size[1] / 128
    y, x = np.mgrid[: size[0], : size[1]]
    x = (x - ((50 + 0.5) * scale - 0.5)) / (90 * scale)
    y = (y - ((40 + 0.5) * scale - 0.5)) / (110 * scale)
    distance = depth * torch.from_numpy(np.sqrt(1 + x * x + y * y))
    k = -math.log(0.05) / 100 * (1 + d.params.deviation)[:, None, None, None]
    assert_close(d.transmission, torch.exp(-k * distance), rtol=0, atol=1e-12)
    assert_close(d.extinction, k.expand_as(depth), rtol=0, atol=1e-15)
    rows = UniformFog(camera=camera, depth=LinearDepth(max_depth=90.0)).degrade(image, seed=7).transmission
    ramp = torch.tensor([(1 - (i + 0.5) / size[0]) * 90 for i in range(size[0])], dtype=torch.float64)[:, None]
    assert_close(rows, torch.exp(-k * ramp * torch.from_numpy(np.sqrt(1 + x * x + y * y))), rtol=0, atol=1e-12)


# --- remove_fog

AIRLIGHT = (0.9, 0.7, 0.8)


def random_in(low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * picture(*shape)


def degraded_by_fog(clean: Tensor, *, linear_light: bool = False) -> Any:
    """Return the image in fog with transmissions from 1 down to below 1/255."""
    depth = 200 * picture(*clean.shape[:-3], 1, *clean.shape[-2:])
    effect = UniformFog(visibility_range=(50.0, 150.0), airlight=AIRLIGHT, linear_light=linear_light)
    return effect.degrade(clean, seed=7, depth=depth)


@pytest.mark.quick
@pytest.mark.parametrize("linear_light", [False, True])
def test_fog_of_known_transmission_is_removed(linear_light):
    clean = picture(3, 3, 40, 60)
    d = degraded_by_fog(clean, linear_light=linear_light)
    result, valid = remove_fog(d.image, d.transmission, d.params.airlight, linear_light=linear_light)
    assert torch.equal(valid, d.valid)
    assert 0.5 < valid.double().mean() < 1
    error = (result - clean).abs() * d.transmission
    # The curves of the standard and their inverses differ by 1e-7 where their pieces meet.
    assert error[valid.expand_as(error)].amax() <= (1e-6 if linear_light else 1e-15)
    assert torch.equal(result[~valid.expand_as(result)], d.image[~valid.expand_as(result)])


def test_removing_fog_from_8_bits_errs_by_half_a_level_over_the_transmission():
    clean = (255 * picture(2, 3, 40, 60)).round().to(torch.uint8)
    d = degraded_by_fog(clean)
    t = d.transmission.double()
    exact, valid = remove_fog(d.image.double() / 255, t, AIRLIGHT)
    selected = valid.expand_as(exact)
    assert (((255 * exact - clean).abs() * t)[selected] <= 0.5 + 1e-4).all()
    result, valid = remove_fog(d.image, d.transmission, AIRLIGHT)
    assert result.dtype == torch.uint8
    assert torch.equal(valid, d.valid)
    assert_close(result.double()[selected], (255 * exact).round().clamp(0, 255)[selected], rtol=0, atol=1)
    assert torch.equal(result[~selected], d.image[~selected])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
@pytest.mark.parametrize("linear_light", [False, True])
def test_removing_fog_keeps_clear_and_opaque_pixels_bit_for_bit(dtype, linear_light):
    image = (255 * picture(2, 3, 9, 14)).round().to(dtype) if dtype is torch.uint8 else picture(2, 3, 9, 14).to(dtype)
    for t, is_valid in ((1.0, True), (0.0, False), (0.0039, False)):
        result, valid = remove_fog(image, torch.full((2, 1, 9, 1), t), 0.8, linear_light=linear_light)
        assert torch.equal(result, image)
        assert result.dtype == dtype
        assert valid.shape == (2, 1, 9, 14)
        assert bool(valid.all()) == bool(valid.any()) == is_valid


@pytest.mark.parametrize(
    "airlight",
    [0.6, (0.6,), AIRLIGHT, picture(3), picture(2, 3)],
    ids=["number", "one", "tuple", "channels", "samples"],
)
def test_airlight_and_transmission_broadcast(airlight):
    image, t = picture(2, 3, 9, 14), random_in(0.1, 1.0, 2, 1, 9, 14)
    a = np.broadcast_to(np.asarray(airlight), (2, 3))[:, :, None, None]
    for part in (t, t[:1], t[..., :1], t[:1, :, :1, :1]):
        expected = a + (image.numpy() - a) / part.numpy()
        assert_close(remove_fog(image, part, airlight)[0], torch.from_numpy(expected), rtol=1e-12, atol=1e-14)


def test_removing_fog_accepts_unbatched_empty_and_channels_last_images():
    image, t = picture(2, 3, 9, 14), picture(2, 1, 9, 14)
    result, valid = remove_fog(image, t, AIRLIGHT)
    alone, valid_alone = remove_fog(image[1], t[1], torch.tensor(AIRLIGHT, dtype=torch.float64))
    assert torch.equal(alone, result[1])
    assert torch.equal(valid_alone, valid[1])
    last = remove_fog(image.contiguous(memory_format=torch.channels_last), t, AIRLIGHT)[0]
    assert torch.equal(last, result)
    assert last.is_contiguous(memory_format=torch.channels_last)
    assert remove_fog(image[:0], t[:0], torch.ones(0, 3))[0].shape == (0, 3, 9, 14)


@pytest.mark.parametrize("linear_light", [False, True])
def test_gradients_of_removed_fog_match_finite_differences_and_are_finite_at_zero(linear_light):
    image, t, airlight = random_in(0.2, 1, 2, 3, 3, 4), random_in(0.2, 0.9, 2, 1, 3, 4), random_in(0.3, 1, 2, 3)
    t[0, 0, 0] = 0.001

    def clear(image, t, airlight):
        return remove_fog(image, t, airlight, linear_light=linear_light)[0]

    assert torch.autograd.gradcheck(clear, [value.requires_grad_() for value in (image, t, airlight)])
    values = [picture(1, 3, 4, 5).requires_grad_(), torch.zeros(1, 1, 4, 5).requires_grad_(), airlight[:1]]
    for gradient in torch.autograd.grad(clear(*values).sum(), values):
        assert gradient.isfinite().all()


def test_one_graph_and_vmap_remove_fog_as_eager_mode_does():
    image, t, airlight = picture(2, 3, 9, 14).float(), random_in(0.1, 1, 2, 1, 9, 14).float(), picture(2, 3).float()
    result, valid = remove_fog(image, t, airlight)
    for other in (torch.compile(remove_fog, fullgraph=True, backend="aot_eager"), torch.vmap(remove_fog)):
        assert_close(other(image, t, airlight)[0], result, rtol=0, atol=2e-4)
        assert torch.equal(other(image, t, airlight)[1], valid)


def test_invalid_pixels_do_not_spread_where_fog_is_removed():
    image, t = picture(1, 3, 4, 5), torch.zeros(1, 1, 4, 5, dtype=torch.float64)
    t[..., 2:] = 0.5
    image[0, 0, 0, 0], image[0, 1, 0, 1], image[0, 2, 3, 4] = math.inf, math.nan, math.nan
    assert torch.equal(remove_fog(image, t, AIRLIGHT)[0].isfinite(), image.isfinite())


@pytest.mark.parametrize(
    ("changed", "error", "rule"),
    [
        ({"image": torch.zeros(4, 5)}, ValueError, r"image must have shape \(B, C, H, W\)"),
        ({"image": torch.zeros(1, 3, 4, 5).int()}, TypeError, "image must be floating in .* or uint8"),
        ({"image": [0.0]}, TypeError, "image must be a tensor"),
        ({"transmission": torch.ones(1, 1, 4, 4)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 3, 4, 5)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 4, 5)}, ValueError, "transmission must broadcast"),
        ({"transmission": torch.ones(1, 1, 4, 5).int()}, TypeError, "transmission must be of a floating type"),
        ({"transmission": torch.full((1, 1, 4, 5), 1.01)}, ValueError, r"transmission must be in \[0, 1\], got 1\.01"),
        ({"transmission": torch.full((1, 1, 4, 5), math.nan)}, ValueError, r"transmission must be in \[0, 1\]"),
        ({"airlight": 1.5}, ValueError, "airlight must be a number in"),
        ({"airlight": (0.1, 0.2)}, ValueError, "airlight must have 1 number or 3"),
        ({"airlight": torch.ones(2, 3)}, ValueError, r"airlight must have shape \(3,\), \(1, 3\) or that of"),
        ({"airlight": torch.tensor([0.1, math.nan, 0.2])}, ValueError, "airlight must be finite"),
        ({"linear_light": 1}, TypeError, "linear_light must be True or False"),
    ],
)
def test_invalid_arguments_of_remove_fog_raise(changed: dict[str, Any], error, rule):
    valid = {"image": torch.zeros(1, 3, 4, 5), "transmission": torch.ones(1, 1, 4, 5), "airlight": 0.8}
    with pytest.raises(error, match=rule):
        remove_fog(**(valid | changed))
