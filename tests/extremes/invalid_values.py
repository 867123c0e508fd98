"""Pass NaN, infinite and huge values to effects and functions: `python invalid_values.py GROUP=EVERY ...`.

`test_invalid_values.py` runs it in a process of its own, which may crash. It runs every EVERY-th case of a GROUP, and
prints each case first, so that the last line names the one that crashed. A failed case prints WRONG and makes the exit
status 1.
"""

import math
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice, product
from typing import Any

import torch
from torch import Tensor

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS

Case = tuple[str, Callable[[], None]]

VALUES = (math.nan, math.inf, -math.inf, 1e38)
DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
HEIGHT, WIDTH = 24, 32
ROW, COLUMN = 11, 13  # of the pixel with the invalid value
REACH = {"nearest": 0.5, "bilinear": 1.0, "bicubic": 2.0}  # px, from a sampled position to pixels with a weight
_ROUNDING = 1e-3  # px
_CAMERA = tr.Camera(width=WIDTH, height=HEIGHT, fx=30, fy=31, cx=15, cy=12, coefficients=(-0.2, 0.05, 0.001, 0.002))
WARPS: dict[str, Callable[..., WarpEffect]] = {
    "lens": tr.LensDistortion,
    "turbulence": partial(tr.Turbulence, amplitude_range=(0.3, 0.5), length_range=(9.0, 14.0)),
    "thin-plate spline": partial(tr.ThinPlateSpline, amplitude_range=(0.5, 1.0)),
    "divergence-free": partial(tr.DivergenceFree, amplitude_range=(0.5, 1.0), length_range=(9.0, 12.0)),
    "rectification": partial(tr.Rectification, _CAMERA),
    "physical turbulence": partial(tr.PhysicalTurbulence, cn2_range=(1e-11, 1e-10)),
    "rolling shutter": tr.RollingShutter,
    "road mirage": partial(tr.RoadMirage, horizon=0.45, focal=40.0),
}
LIGHTS: dict[str, Callable[..., Effect]] = {
    "uniform fog": partial(tr.UniformFog, visibility_range=(20.0, 60.0)),
    "heterogeneous fog": partial(tr.HeterogeneousFog, visibility_range=(20.0, 60.0)),
    "volumetric fog": partial(tr.HeterogeneousFog, mode="ray", visibility_range=(20.0, 60.0)),
    "flare": tr.LensFlare,
    "flare with screen blending": partial(tr.LensFlare, blend="screen"),
    # Without a gain, since every pixel counts for it; in tests of exposure an invalid one counts as black.
    "sun glare": partial(tr.SunGlare, center_x_range=(0.2, 0.8), center_y_range=(0.1, 0.6), gamma_range=(0.0, 0.0)),
    "exposure": partial(tr.Exposure, gamma_range=(0.0, 0.0), shot_range=(1e-4, 1e-3)),
    "plume": partial(tr.HeterogeneousFog, mode="ray", visibility_range=(20.0, 60.0), scale_height_range=(1.0, 3.0)),
    "night glow": tr.NightGlow,  # no pixel is a lamp, whose light spreads; blur has a test of its own
    "vignetting": tr.Vignetting,
    "chromatic aberration": partial(tr.ChromaticAberration, red_range=(0.02, 0.02), blue_range=(-0.02, -0.02)),
}


def random_image(dtype: torch.dtype = torch.float32) -> Tensor:
    """Return noise (2, 3, 24, 32), in [1/4, 3/4]."""
    generator = torch.Generator().manual_seed(0)
    return (0.25 + torch.rand(2, 3, HEIGHT, WIDTH, generator=generator) / 2).to(dtype)


def with_value(clean: Tensor, value: float) -> Tensor:
    """Put a value into one pixel of the first sample."""
    dirty = clean.clone()
    dirty[0, 1, ROW, COLUMN] = value
    return dirty


def effects() -> Iterator[tuple[str, Effect]]:
    """Yield every effect, with every padding and interpolation, exact and with a tolerance."""
    for (name, make), padding, interpolation, tolerance in product(
        WARPS.items(), PADDINGS, INTERPOLATIONS, (None, 0.02)
    ):
        effect = make(padding=padding, interpolation=interpolation, tolerance_px=tolerance)
        yield f"{name}, {padding}, {interpolation}, tolerance {tolerance}", effect
    yield from ((name, make()) for name, make in LIGHTS.items())
    yield "compose", tr.Compose([tr.LensDistortion(), tr.UniformFog(), tr.Turbulence(), tr.LensFlare()])
    yield "one of", tr.OneOf([tr.LensDistortion(), tr.UniformFog()])


def images() -> Iterator[Case]:
    """Yield cases with a value in a pixel."""
    for (name, effect), value in product(effects(), VALUES):
        for dtype in DTYPES if math.isnan(value) else (torch.float32,):
            yield f"{name}, {value} in a {dtype} image", partial(_image, effect, value, dtype)


def _image(effect: Effect, value: float, dtype: torch.dtype) -> None:
    clean = random_image(dtype)
    params = effect.sample(clean, seed=7)
    results = []
    for image in (clean, with_value(clean, value)):
        degraded = effect.apply(image.requires_grad_(), params)
        (gradient,) = torch.autograd.grad(degraded.image.sum(), image)
        results.append((degraded, gradient))
    (reference, reference_gradient), (degraded, gradient) = results
    far = ~sees_pixel(effect, reference.flow)
    # Bicubic values are clamped to the range of the image, which a large value extends.
    images = [result.image for result in (degraded, reference)]
    actual, expected = [clamp_like(image, clean) for image in images] if math.isfinite(value) else images
    assert torch.equal(actual[far], expected[far]), "the value changes other pixels"
    assert far[1].all(), "the test compares too few pixels"
    assert (~far).sum() <= 50, "the test compares too few pixels"
    assert gradient.isfinite().all(), "the gradient of the image is not finite"
    assert torch.equal(gradient[1], reference_gradient[1]), "the value changes the gradient of another sample"
    for name in ("flow", "restore_flow", "transmission", "extinction", "intensity"):
        value_map = getattr(degraded, name)
        assert value_map is None or torch.equal(value_map, getattr(reference, name)), f"the value changes {name}"


def clamp_like(image: Tensor, clean: Tensor) -> Tensor:
    """Clamp an image to the range of each channel of a clean one."""
    low, high = (limit(clean.detach(), dim=(2, 3), keepdim=True) for limit in (torch.amin, torch.amax))
    return image.clamp(low, high)


def sees_pixel(effect: Effect, flow: Tensor | None) -> Tensor:
    """Return (2, 3, H, W), bool: pixels that are sampled near the pixel with the invalid value."""
    near = torch.zeros(2, 3, HEIGHT, WIDTH, dtype=torch.bool)
    if flow is None:
        near[0, 1, ROW, COLUMN] = True
        return near
    padding, interpolation = getattr(effect, "padding", None), getattr(effect, "interpolation", None)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    across = distance(x + flow[0, 0].detach(), COLUMN, WIDTH, padding or "zeros")
    down = distance(y + flow[0, 1].detach(), ROW, HEIGHT, padding or "zeros")
    # The composition samples twice, before and after its fog.
    reach = REACH[interpolation or "bilinear"] * (3 if isinstance(effect, tr.Compose) else 1)
    near[0, 1] = torch.maximum(across, down) <= reach + _ROUNDING
    return near


def distance(position: Tensor, pixel: int, size: int, padding: str) -> Tensor:
    """Return the distance of sampled positions, after padding, to a pixel, px."""
    if padding == "border":
        position = position.clamp(0, size - 1)
    if padding == "reflection":  # at the outer edges of the border pixels
        period = (position + 0.5).remainder(2 * size)
        position = torch.minimum(period, 2 * size - period) - 0.5
    return (position - pixel).abs()


def flows() -> Iterator[Case]:
    """Yield cases with a value in a flow that the caller passes."""
    for value, padding, interpolation, dtype in product((*VALUES, 3e38, 1e6), PADDINGS, INTERPOLATIONS, DTYPES):
        name = f"warp along {value}, {padding}, {interpolation}, {dtype}"
        yield name, partial(_warp, value, dtype, {"padding": padding, "interpolation": interpolation})
    for value, everywhere in product((*VALUES, 3e38, 1e6), (False, True)):
        name = f"{value} in {'all' if everywhere else 'a pixel'} of a flow"
        yield f"inverse, {name}", partial(_inverse, value, everywhere)
        yield f"composites, {name}", partial(_composites, value, everywhere)
        yield f"folding, {name}", partial(_folding, value, everywhere)
        yield f"labels, {name}", partial(_labels, value, everywhere)


def flow_with_value(value: float, *, everywhere: bool = False, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a small flow (2, 2, H, W), px, with a value in one pixel or everywhere."""
    flow = torch.rand(2, 2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) - 0.5
    flow[0, 0, ROW, COLUMN] = value
    return torch.full_like(flow, value).to(dtype) if everywhere else flow.to(dtype)


def _warp(value: float, dtype: torch.dtype, options: dict[str, str]) -> None:
    image = random_image(dtype).requires_grad_()
    flow, small = (flow_with_value(v, dtype=dtype).requires_grad_() for v in (value, 0.25))
    (warped, valid), (expected, _) = tr.warp(image, flow, **options), tr.warp(image, small, **options)
    gradients = torch.autograd.grad(warped.sum(), [image, flow])
    others = torch.ones(2, 3, HEIGHT, WIDTH, dtype=torch.bool)
    others[0, :, ROW, COLUMN] = False
    assert torch.equal(warped[others], expected[others]), "other pixels change"
    assert not valid[0, 0, ROW, COLUMN], "the pixel is valid"
    assert warped.isfinite().all(), "the image is not finite"
    assert all(bool(gradient.isfinite().all()) for gradient in gradients), "a gradient is not finite"


def _inverse(value: float, everywhere: bool) -> None:
    flow = flow_with_value(value, everywhere=everywhere).requires_grad_()
    inverse, valid, _ = tr.invert_flow(flow)
    gradient = torch.autograd.grad(inverse.sum(), flow)[0]
    assert inverse[valid.expand_as(inverse)].isfinite().all(), "a valid pixel is not finite"
    assert bool(inverse[1].isfinite().all()) or everywhere, "the other sample is not finite"
    assert bool(gradient[1].isfinite().all()) or everywhere, "the gradient of the other sample is not finite"
    assert not (everywhere and valid.any()), "a pixel without inverse is valid"


def _composites(value: float, everywhere: bool) -> None:
    flow, small = flow_with_value(value, everywhere=everywhere).requires_grad_(), flow_with_value(0.25)
    for both in (tr.compose_flows(flow, small), tr.compose_flows(small, flow)):
        torch.autograd.grad(both.sum(), flow)
        assert torch.equal(both[1], tr.compose_flows(small, small)[1]) or everywhere, "the other sample changes"


def _folding(value: float, everywhere: bool) -> None:
    result, expected = (tr.folding(flow_with_value(v, everywhere=a)) for v, a in ((value, everywhere), (0.25, False)))
    assert torch.equal(result.fraction[1], expected.fraction[1]) or everywhere, "the other sample changes"


def _labels(value: float, everywhere: bool) -> None:
    flow = flow_with_value(value, everywhere=everywhere)
    mask = (random_image()[:, :1] > 0.5).to(torch.uint8)
    depth = random_image()[:, :1] * 100
    tr.warp_mask(mask, flow)
    moved = tr.warp_depth(depth, flow)
    tr.warp_points(torch.tensor([[[3.0, 4.0], [13.0, 11.0]]]).expand(2, -1, -1), flow)
    tr.warp_boxes(torch.tensor([[[2.0, 3.0, 20.0, 17.0]]]).expand(2, -1, -1), flow)
    assert moved[0].isfinite().all(), "a depth is not finite"


def params() -> Iterator[Case]:
    """Yield cases with a value in drawn parameters, checked in eager mode and unchecked inside vmap."""
    for name, make in {**WARPS, **LIGHTS}.items():
        effect = make()
        drawn = _drawn(effect, random_image())
        fields = [field for field, value in drawn._asdict().items() if value is not None and value.is_floating_point()]
        for field, value, is_mapped in product(fields, VALUES, (False, True)):
            mode = " inside vmap" if is_mapped else ""
            yield f"{name}, {value} in {field}{mode}", partial(_params, effect, field, value, is_mapped)


def _drawn(effect: Effect, image: Tensor) -> Any:
    """Return drawn parameters, with a vehicle where the effect takes some."""
    drawn = effect.sample(image, seed=7)
    has_vehicles = "vehicles" in drawn._fields
    return drawn._replace(vehicles=torch.tensor([[[2.0, 3.0, 20.0, 17.0]]] * len(image))) if has_vehicles else drawn


def _params(effect: Effect, field: str, value: float, is_mapped: bool) -> None:
    image = random_image().requires_grad_()
    drawn = _drawn(effect, image)
    changed = getattr(drawn, field).clone()
    changed[0].view(-1)[-1] = value
    changed.requires_grad_()

    def one_sample(image: Tensor, changed: Tensor, rest: tuple[Tensor, ...]) -> Tensor:
        rows = type(drawn)(*(row[None] for row in rest))._replace(**{field: changed[None]})
        return effect.apply(image[None], rows).image[0]

    try:
        result = (
            torch.vmap(one_sample)(image, changed, tuple(drawn))
            if is_mapped
            else effect.apply(image, drawn._replace(**{field: changed})).image
        )
    except ValueError as error:
        message = str(error)
        assert not is_mapped, f"values are read inside vmap: {message}"
        assert field in message, f"the error does not name the field: {message}"
        assert " must " in message, f"the error has no rule: {message}"
        return
    assert (
        is_mapped or math.isfinite(value) or (field in ("visibility", "decorrelation", "scale_height") and value > 0)
    ), "no error"
    assert result.isfinite().all(), "the image is not finite"
    gradients = torch.autograd.grad(result.sum(), [image, changed], allow_unused=True)
    for gradient in gradients:
        assert gradient is None or bool(gradient[1].isfinite().all()), "the gradient of the other sample is not finite"
    assert gradients[0].isfinite().all(), "the gradient of the image is not finite"


def depths() -> Iterator[Case]:
    """Yield cases with a value in a depth that the caller passes."""
    fogs = {name: make for name, make in LIGHTS.items() if "fog" in name}
    for (name, make), value in product(fogs.items(), (*VALUES, -1.0, -1e38, 0.0, 1e-38)):
        yield f"{name}, {value} in a depth", partial(_depth, make(), value)
    for value in (*VALUES, -1.0):
        yield f"converters, {value}", partial(_converters, value)


def _depth(effect: Effect, value: float) -> None:
    image = random_image().requires_grad_()
    depth = 5 + 100 * random_image()[:, :1].detach()
    reference = effect.degrade(image, seed=7, depth=depth)
    changed = depth.clone()
    changed[0, 0, ROW, COLUMN] = value
    changed.requires_grad_()
    try:
        degraded = effect.degrade(image, seed=7, depth=changed)
    except ValueError as error:
        message = str(error)
        assert message.startswith("depth must"), f"the error does not name the depth: {message}"
        assert not value >= 0, f"a depth of {value} raises"
        return
    assert value >= 0, "no error"
    gradients = torch.autograd.grad(degraded.image.sum(), [image, changed])
    assert degraded.image.isfinite().all(), "the image is not finite"
    assert all(bool(gradient.isfinite().all()) for gradient in gradients), "a gradient is not finite"
    assert torch.equal(degraded.image[1], reference.image[1]), "the other sample changes"
    if value >= 1e38:
        t = degraded.transmission[0, 0, ROW, COLUMN]
        assert t == 0, f"the transmission at infinity is {t}"


def _converters(value: float) -> None:
    values = random_image()[:, :1].clone()
    values[0, 0, ROW, COLUMN] = value
    for convert in (
        lambda: tr.depth_from_disparity(values, focal_px=500.0, baseline=0.1),
        lambda: tr.depth_from_inverse(values, near=1.0, far=100.0),
        lambda: tr.depth_from_normalized(values, near=1.0, far=100.0),
    ):
        try:
            depth = convert()
        except ValueError as error:
            message = str(error)
            assert " must " in message, f"the error has no rule: {message}"
            continue
        assert not bool(depth.isnan().any()), "a depth is NaN"


GROUPS: dict[str, Callable[[], Iterator[Case]]] = {cases.__name__: cases for cases in (images, flows, params, depths)}


def main(*words: str) -> int:
    """Run every EVERY-th case of each GROUP=EVERY, and return 1 if one fails."""
    # Strong flows warn that they fold.
    warnings.simplefilter("ignore")
    wrong = 0
    for group, every in (word.split("=") for word in words):
        count = 0
        for name, case in islice(GROUPS[group](), 0, None, int(every)):
            print(f"case: {name}", flush=True)
            count += 1
            try:
                case()
            except Exception as error:  # the next case still has to run
                wrong += 1
                print(f"WRONG: {name}: {error!r}", flush=True)
        print(f"cases of {group}: {count}", flush=True)
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
