"""What a crash would end: run in a process of its own, `python tests/extremes/poison.py GROUP EVERY`.

Of the cases of a group the first is run, and each so many-th after it. Each is printed before it runs, so that the last
line names the one that ended the process; what it finds wrong is printed behind it, and makes the exit status 1.
"""

import math
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice, product

import torch
from torch import Tensor
from torchrefract.effects.refraction import WarpEffect

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS

Case = tuple[str, Callable[[], None]]

VALUES = (math.nan, math.inf, -math.inf, 1e38)
DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
HEIGHT, WIDTH = 24, 32
ROW, COLUMN = 11, 13  # of the poisoned pixel
REACH = {"nearest": 0.5, "bilinear": 1.0, "bicubic": 2.0}  # px, from the position to the pixels that it reads
_ROUNDING = 1e-3  # px
_CAMERA = tr.Camera(width=WIDTH, height=HEIGHT, fx=30, fy=31, cx=15, cy=12, coefficients=(-0.2, 0.05, 0.001, 0.002))
WARPS: dict[str, Callable[..., WarpEffect]] = {
    "lens": tr.LensDistortion,
    "turbulence": partial(tr.Turbulence, amplitude_range=(0.3, 0.5), length_range=(9.0, 14.0)),
    "thin plate": partial(tr.ThinPlateSpline, amplitude_range=(0.5, 1.0)),
    "divergence-free": partial(tr.DivergenceFree, amplitude_range=(0.5, 1.0), length_range=(9.0, 12.0)),
    "rectification": partial(tr.Rectification, _CAMERA),
}
LIGHTS: dict[str, Callable[..., Effect]] = {
    "uniform fog": partial(tr.UniformFog, visibility_range=(20.0, 60.0)),
    "drifts": partial(tr.HeterogeneousFog, visibility_range=(20.0, 60.0)),
    "drifts in space": partial(tr.HeterogeneousFog, mode="ray", visibility_range=(20.0, 60.0)),
    "flare": tr.LensFlare,
    "flare on a screen": partial(tr.LensFlare, blend="screen"),
}


def picture(dtype: torch.dtype = torch.float32) -> Tensor:
    """(2, 3, 24, 32), in [1/4, 3/4]."""
    generator = torch.Generator().manual_seed(0)
    return (0.25 + torch.rand(2, 3, HEIGHT, WIDTH, generator=generator) / 2).to(dtype)


def poisoned(clean: Tensor, value: float) -> Tensor:
    """The picture with a value in one pixel of the first sample."""
    dirty = clean.clone()
    dirty[0, 1, ROW, COLUMN] = value
    return dirty


def effects() -> Iterator[tuple[str, Effect]]:
    """Every effect, with every padding and interpolation, exact and by a plan."""
    for (name, make), padding, interpolation, tolerance in product(
        WARPS.items(), PADDINGS, INTERPOLATIONS, (None, 0.02)
    ):
        effect = make(padding=padding, interpolation=interpolation, tolerance_px=tolerance)
        yield f"{name}, {padding}, {interpolation}, tolerance {tolerance}", effect
    yield from ((name, make()) for name, make in LIGHTS.items())
    yield "compose", tr.Compose([tr.LensDistortion(), tr.UniformFog(), tr.Turbulence(), tr.LensFlare()])
    yield "one of", tr.OneOf([tr.LensDistortion(), tr.UniformFog()])


def images() -> Iterator[Case]:
    """Values in a pixel."""
    for (name, effect), value in product(effects(), VALUES):
        for dtype in DTYPES if math.isnan(value) else (torch.float32,):
            yield f"{name}, {value} in a {dtype} image", partial(_image, effect, value, dtype)


def _image(effect: Effect, value: float, dtype: torch.dtype) -> None:
    clean = picture(dtype)
    params = effect.sample(clean, seed=7)
    found = []
    for image in (clean, poisoned(clean, value)):
        degraded = effect.apply(image.requires_grad_(), params)
        (slope,) = torch.autograd.grad(degraded.image.sum(), image)
        found.append((degraded, slope))
    (whole, whole_slope), (dirty, slope) = found
    far = ~touched(effect, whole.flow)
    # Bicubic values are held in the range of the image's own, which a large one among them widens.
    finite = math.isfinite(value)
    seen, expected = (held(made.image, clean) if finite else made.image for made in (dirty, whole))
    expect(torch.equal(seen[far], expected[far]), "the value spreads")
    expect(bool(far[1].all()) and float((~far).sum()) <= 50, "the test looks at too little")
    expect(bool(slope.isfinite().all()), "the gradient of the image is not finite")
    expect(torch.equal(slope[1], whole_slope[1]), "the value reaches the gradient of another sample")
    for name in ("flow", "restore_flow", "transmission", "extinction", "intensity"):
        value_map = getattr(dirty, name)
        expect(value_map is None or torch.equal(value_map, getattr(whole, name)), f"the value reaches {name}")


def held(image: Tensor, clean: Tensor) -> Tensor:
    """The image within the range that each channel of a clean one has."""
    low, high = (found(clean.detach(), dim=(2, 3), keepdim=True) for found in (torch.amin, torch.amax))
    return image.clamp(low, high)


def touched(effect: Effect, flow: Tensor | None) -> Tensor:
    """(2, 3, H, W), bool: what looks at the poisoned pixel, by the positions alone."""
    near = torch.zeros(2, 3, HEIGHT, WIDTH, dtype=torch.bool)
    if flow is None:
        near[0, 1, ROW, COLUMN] = True
        return near
    padding, interpolation = getattr(effect, "padding", None), getattr(effect, "interpolation", None)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    across = distance(x + flow[0, 0].detach(), COLUMN, WIDTH, padding or "zeros")
    down = distance(y + flow[0, 1].detach(), ROW, HEIGHT, padding or "zeros")
    # Compositions look up twice, before and behind their fog.
    reach = REACH[interpolation or "bilinear"] * (3 if isinstance(effect, tr.Compose) else 1)
    near[0, 1] = torch.maximum(across, down) <= reach + _ROUNDING
    return near


def distance(position: Tensor, pixel: int, size: int, padding: str) -> Tensor:
    """Px, from where a position is read to a pixel."""
    if padding == "border":
        position = position.clamp(0, size - 1)
    if padding == "reflection":  # at the outer edges of the border pixels
        period = (position + 0.5).remainder(2 * size)
        position = torch.minimum(period, 2 * size - period) - 0.5
    return (position - pixel).abs()


def flows() -> Iterator[Case]:
    """Values in a flow that somebody passes in."""
    for value, padding, interpolation, dtype in product((*VALUES, 3e38, 1e6), PADDINGS, INTERPOLATIONS, DTYPES):
        name = f"warp along {value}, {padding}, {interpolation}, {dtype}"
        yield name, partial(_warp, value, dtype, {"padding": padding, "interpolation": interpolation})
    for value, whole in product((*VALUES, 3e38, 1e6), (False, True)):
        name = f"{value} in {'all' if whole else 'a pixel'} of a flow"
        yield f"inverse, {name}", partial(_inverse, value, whole)
        yield f"composites, {name}", partial(_composites, value, whole)
        yield f"folding, {name}", partial(_folding, value, whole)
        yield f"labels, {name}", partial(_labels, value, whole)


def external(value: float, *, whole: bool = False, dtype: torch.dtype = torch.float32) -> Tensor:
    """(2, 2, H, W), px: a flow of somebody else's."""
    flow = torch.rand(2, 2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) - 0.5
    flow[0, 0, ROW, COLUMN] = value
    return torch.full_like(flow, value).to(dtype) if whole else flow.to(dtype)


def _warp(value: float, dtype: torch.dtype, options: dict[str, str]) -> None:
    image = picture(dtype).requires_grad_()
    flow, tame = (external(v, dtype=dtype).requires_grad_() for v in (value, 0.25))
    (warped, valid), (expected, _) = tr.warp(image, flow, **options), tr.warp(image, tame, **options)
    slopes = torch.autograd.grad(warped.sum(), [image, flow])
    others = torch.ones(2, 3, HEIGHT, WIDTH, dtype=torch.bool)
    others[0, :, ROW, COLUMN] = False
    expect(torch.equal(warped[others], expected[others]), "other pixels change")
    expect(not valid[0, 0, ROW, COLUMN], "the pixel is called valid")
    expect(bool(warped.isfinite().all()), "the image is not finite")
    expect(all(bool(slope.isfinite().all()) for slope in slopes), "a gradient is not finite")


def _inverse(value: float, whole: bool) -> None:
    flow = external(value, whole=whole).requires_grad_()
    inverse, valid, _ = tr.invert_flow(flow)
    slope = torch.autograd.grad(inverse.sum(), flow)[0]
    expect(bool(inverse[valid.expand_as(inverse)].isfinite().all()), "a valid pixel is not finite")
    expect(bool(inverse[1].isfinite().all()) or whole, "the other sample is not finite")
    expect(bool(slope[1].isfinite().all()) or whole, "the gradient of the other sample is not finite")
    expect(not (whole and valid.any()), "what leads nowhere is called valid")


def _composites(value: float, whole: bool) -> None:
    flow, tame = external(value, whole=whole).requires_grad_(), external(0.25)
    for both in (tr.compose_flows(flow, tame), tr.compose_flows(tame, flow)):
        torch.autograd.grad(both.sum(), flow)
        expect(torch.equal(both[1], tr.compose_flows(tame, tame)[1]) or whole, "the other sample changes")


def _folding(value: float, whole: bool) -> None:
    found = tr.folding(external(value, whole=whole))
    expect(torch.equal(found.fraction[1], tr.folding(external(0.25)).fraction[1]) or whole, "the other sample changes")


def _labels(value: float, whole: bool) -> None:
    flow = external(value, whole=whole)
    mask = (picture()[:, :1] > 0.5).to(torch.uint8)
    depth = picture()[:, :1] * 100
    tr.warp_mask(mask, flow)
    moved = tr.warp_depth(depth, flow)
    tr.warp_points(torch.tensor([[[3.0, 4.0], [13.0, 11.0]]]).expand(2, -1, -1), flow)
    tr.warp_boxes(torch.tensor([[[2.0, 3.0, 20.0, 17.0]]]).expand(2, -1, -1), flow)
    expect(bool(moved[0].isfinite().all()), "a depth is not finite")


def params() -> Iterator[Case]:
    """Values in the parameters of a draw, where they are read, and where nothing may be."""
    for name, make in {**WARPS, **LIGHTS}.items():
        effect = make()
        drawn = effect.sample(picture(), seed=7)
        fields = [field for field, value in drawn._asdict().items() if value.is_floating_point()]
        for field, value, mapped in product(fields, VALUES, (False, True)):
            how = ", nothing read" if mapped else ""
            yield f"{name}, {value} in {field}{how}", partial(_params, effect, field, value, mapped)


def _params(effect: Effect, field: str, value: float, mapped: bool) -> None:
    image = picture().requires_grad_()
    drawn = effect.sample(image, seed=7)
    given = getattr(drawn, field).clone()
    given[0].view(-1)[-1] = value
    given.requires_grad_()

    def alone(image: Tensor, given: Tensor, rest: tuple[Tensor, ...]) -> Tensor:
        rows = type(drawn)(*(row[None] for row in rest))._replace(**{field: given[None]})
        return effect.apply(image[None], rows).image[0]

    try:
        made = (
            torch.vmap(alone)(image, given, tuple(drawn))
            if mapped
            else effect.apply(image, drawn._replace(**{field: given})).image
        )
    except ValueError as error:
        expect(not mapped, f"what may not be read is: {error}")
        expect(f"params.{field} must" in str(error) or "must" in str(error), f"an error without a name: {error}")
        return
    expect(mapped or math.isfinite(value) or (field in ("visibility", "decorrelation") and value > 0), "no error")
    expect(bool(made.isfinite().all()), "the image is not finite")
    slopes = torch.autograd.grad(made.sum(), [image, given], allow_unused=True)
    for slope in slopes:
        expect(slope is None or bool(slope[1].isfinite().all()), "the gradient of the other sample is not finite")
    expect(bool(slopes[0].isfinite().all()), "the gradient of the image is not finite")


def depths() -> Iterator[Case]:
    """Values in a depth that somebody passes in."""
    fogs = {name: make for name, make in LIGHTS.items() if "flare" not in name}
    for (name, make), value in product(fogs.items(), (*VALUES, -1.0, -1e38, 0.0, 1e-38)):
        yield f"{name}, {value} in a depth", partial(_depth, make(), value)
    for value in (*VALUES, -1.0):
        yield f"converters, {value}", partial(_converters, value)


def _depth(effect: Effect, value: float) -> None:
    image = picture().requires_grad_()
    depth = 5 + 100 * picture()[:, :1].detach()
    tame = effect.degrade(image, seed=7, depth=depth)
    dirty = depth.clone()
    dirty[0, 0, ROW, COLUMN] = value
    dirty.requires_grad_()
    try:
        degraded = effect.degrade(image, seed=7, depth=dirty)
    except ValueError as error:
        expect(str(error).startswith("depth must"), f"an error without a name: {error}")
        expect(not value >= 0, f"a depth of {value} is refused")
        return
    expect(value >= 0, "no error")
    slopes = torch.autograd.grad(degraded.image.sum(), [image, dirty])
    expect(bool(degraded.image.isfinite().all()), "the image is not finite")
    expect(all(bool(slope.isfinite().all()) for slope in slopes), "a gradient is not finite")
    expect(torch.equal(degraded.image[1], tame.image[1]), "the other sample changes")
    if value >= 1e38:
        t = degraded.transmission[0, 0, ROW, COLUMN]
        expect(bool(t == 0), f"the transmission at infinity is {t}")


def _converters(value: float) -> None:
    values = picture()[:, :1].clone()
    values[0, 0, ROW, COLUMN] = value
    for convert in (
        lambda: tr.depth_from_disparity(values, focal_px=500.0, baseline=0.1),
        lambda: tr.depth_from_inverse(values, near=1.0, far=100.0),
        lambda: tr.depth_from_normalized(values, near=1.0, far=100.0),
    ):
        try:
            made = convert()
        except ValueError as error:
            expect(" must " in str(error), f"an error without a rule: {error}")
            continue
        expect(not bool(made.isnan().any()), "a depth is NaN")


class WrongError(Exception):
    """A promise that does not hold."""


def expect(holds: bool, otherwise: str) -> None:
    """Raise unless a promise holds."""
    if not holds:
        raise WrongError(otherwise)


GROUPS: dict[str, Callable[[], Iterator[Case]]] = {
    "images": images,
    "flows": flows,
    "params": params,
    "depths": depths,
}


def main(group: str, every: int) -> int:
    """Run the first case of a group and each so many-th after it: 1 if one went wrong."""
    # Strong draws say that they fold, and that is what they are for.
    warnings.simplefilter("ignore")
    wrong = count = 0
    for name, case in islice(GROUPS[group](), 0, None, every):
        print(f"case: {name}", flush=True)
        count += 1
        try:
            case()
        except Exception as error:  # whatever a case raises is its result, and the next one is still to run
            wrong += 1
            print(f"WRONG: {name}: {error!r}", flush=True)
    print(f"cases: {count}", flush=True)
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
