"""How far effects computed in float32 are from float64, by the type of the image and the size of the frame.

python benchmarks/precision.py [--sizes 256x256 1080x1920 2160x3840 4320x7680] [--draws 2]
                               [--out benchmarks/results/precision.json]

The table is printed as Markdown. A frame of 8K takes gigabytes in float64; `--sizes` leaves it out.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from arguments import count, size
from subjects import SMOOTH, WEATHER
from timing import Conditions
from torch import Tensor

from torchrefract import Turbulence
from torchrefract._io import replace_file
from torchrefract.effects.base import Effect
from torchrefract.fields.gaussian import gaussian_random_field, spectrum
from torchrefract.fields.spline import fit_spline, spline_flow
from torchrefract.warping.grid import length, pixel_axes, sampler_grid
from torchrefract.warping.resample import sampler_dtype

WHAT = (
    "The largest error over all pixels and draws, against the same parameters and the same image in float64, every "
    "effect exact (no tolerance). 'flow' is that of the flow, 'landing' that of the place where the sampler looks, its "
    "own coordinates included, both in px; 'image' is in 8-bit levels, and for half images contains that the result is "
    "stored in 11 bits (float16) or 8 (bfloat16). Pixels of the image are noise, of 256 levels that all types hold; "
    "of warps they are not compared: at an edge one of 1e-4 px is one of 0.03 levels."
)
SIZES = ((256, 256), (1080, 1920), (2160, 3840), (4320, 7680))
TYPES = {"float32": torch.float32, "float16 image": torch.float16, "bfloat16 image": torch.bfloat16}
AUTOCAST, COMPILED = "float32, autocast", "float32, compiled"
SMALL = (256, 256)  # of what is tried at one size only
SEED = 7
_EXACT: Mapping[str, Callable[[], Effect]] = {
    **{name: partial(make, tolerance_px=None) for name, make in SMOOTH.items()},
    "exponential air": partial(Turbulence, tolerance_px=None),
    **WEATHER,
}


@dataclass(frozen=True)
class Error:
    """Of one effect, computed in one way in frames of one size."""

    effect: str
    way: str
    height: int
    width: int
    flow_px: float | None  # None of an effect that moves nothing
    landing_px: float | None
    levels: float | None  # None of one that moves pixels

    @property
    def largest(self) -> float:
        """What effects are ranked by: px of landing, or levels."""
        return (self.levels if self.landing_px is None else self.landing_px) or 0.0


def main() -> None:
    """Measure, print and save."""
    args = _parser().parse_args()
    torch.manual_seed(0)
    conditions = Conditions.now(_picture(args.sizes[0]), threads=torch.get_num_threads(), repeats=args.draws)
    print(WHAT, end="\n\n", flush=True)
    found: list[Error] = []
    for line in chain(HEAD, map(kept(found), errors(args.sizes, args.draws))):
        print(line, flush=True)
    seconds = second_derivatives()
    print(
        "",
        *worst(found),
        "",
        *(f"second derivatives of {name}: {value:.1e}" for name, value in seconds.items()),
        sep="\n",
    )
    content = {"what": WHAT, "conditions": asdict(conditions), "errors": [asdict(error) for error in found]}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as path:
        path.write_text(json.dumps(content | {"second_derivatives": seconds}, indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


HEAD = (
    "| effect | computed in | frame | flow, px | landing, px | image, levels |",
    "| --- | --- | --- | --- | --- | --- |",
)


def kept(found: list[Error]) -> Callable[[Error], str]:
    """A function that keeps errors, and gives each as a row of the table."""

    def row(error: Error) -> str:
        found.append(error)
        numbers = ("" if value is None else f"{value:.1e}" for value in (error.flow_px, error.landing_px, error.levels))
        return f"| {' | '.join((error.effect, error.way, f'{error.height} x {error.width}', *numbers))} |"

    return row


def errors(sizes: Sequence[tuple[int, int]], draws: int) -> Iterator[Error]:
    """Of every effect in every way, one after the other, since frames are large."""
    for name, make in _EXACT.items():
        for height, width in sizes:
            yield from _of_draws([_compared(name, make(), (height, width), key, TYPES) for key in range(draws)])
        yield from _of_draws([_compared(name, make(), SMALL, key, {AUTOCAST: torch.float32}) for key in range(draws)])
        yield from _of_draws([_compared(name, make(), SMALL, key, {COMPILED: torch.float32}) for key in range(draws)])


def _of_draws(found: Sequence[Sequence[Error]]) -> Iterator[Error]:
    """The largest errors over several draws, way by way."""
    for way in zip(*found, strict=True):
        largest = {
            name: None if getattr(way[0], name) is None else max(getattr(error, name) for error in way)
            for name in ("flow_px", "landing_px", "levels")
        }
        yield Error(way[0].effect, way[0].way, way[0].height, way[0].width, **largest)


def _compared(
    name: str, effect: Effect, frame: tuple[int, int], key: int, ways: Mapping[str, torch.dtype]
) -> list[Error]:
    """One draw in several ways, against float64."""
    image = _picture(frame)
    params = effect.sample(image, seed=SEED, keys=[key])
    true = effect.apply(image.double(), params.to(torch.float64))
    flow, light = true.flow, None if true.flow is not None else true.image
    del true  # its image is half of all memory
    found = []
    for way, dtype in ways.items():
        made = _made(effect, image.to(dtype), params, way)
        px = None if flow is None else (far(made[1], flow), landing(made[0], made[1], flow))
        levels = None if light is None else 255 * (made[0].double() - light).abs().max().item()
        found.append(Error(name, way, *frame, *(px or (None, None)), levels))
    return found


def _made(effect: Effect, image: Tensor, params: Any, way: str) -> tuple[Tensor, Any]:
    """The image and the flow, computed in one way."""

    def run(image: Tensor, params: Any) -> tuple[Tensor, Any]:
        made = effect.apply(image, params)
        return made.image, made.flow

    if way == COMPILED:
        torch.compiler.reset()
        return torch.compile(run, fullgraph=True)(image, params)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=way == AUTOCAST):
        return run(image, params)


def far(flow: Tensor, true: Tensor) -> float:
    """How far a flow is from the true one at most, px."""
    return max(length(a.double() - b).max().item() for a, b in zip(flow.split(256, 2), true.split(256, 2), strict=True))


def landing(image: Tensor, flow: Tensor, true: Tensor) -> float:
    """How far from its place the sampler looks at most, px; where that place is in the frame."""
    height, width = flow.shape[2:]
    grid = sampler_grid(flow.to(sampler_dtype(image, flow.dtype)))
    x, y = pixel_axes(height, width, dtype=torch.float64, device=flow.device)
    largest = 0.0
    for rows, band, line in zip(grid.split(256, 1), true.split(256, 2), y.split(256, 2), strict=True):
        place = torch.cat([x + band[:, :1], line + band[:, 1:]], dim=1)
        size = place.new_tensor((width, height)).view(1, 2, 1, 1)
        seen = ((rows.movedim(-1, 1).double() + 1) * size - 1) / 2
        inside = ((place >= 0) & (place <= size - 1)).all(dim=1, keepdim=True)
        largest = max(largest, torch.where(inside, length(seen - place), 0).max().item())
    return largest


def _picture(frame: tuple[int, int]) -> Tensor:
    """(1, 1, H, W), levels of 1/256, which all types hold."""
    return (256 * torch.rand(1, 1, *frame, generator=torch.Generator().manual_seed(0))).floor() / 256


def worst(found: Sequence[Error]) -> Iterator[str]:
    """The worst case of each effect, in words."""
    for name in dict.fromkeys(error.effect for error in found):
        of = max((error for error in found if error.effect == name), key=lambda error: error.largest)
        unit = "levels" if of.landing_px is None else "px"
        yield f"worst of {name}: {of.largest:.1e} {unit}, {of.way}, {of.height} x {of.width}"


def second_derivatives() -> dict[str, float]:
    """The largest error of a Hessian times a vector in float32, over its largest number, where these are checked."""

    def air(length: Tensor) -> Tensor:
        noise = torch.randn(1, 2, 128, 128, generator=torch.Generator().manual_seed(0)).to(length.dtype)
        shape = spectrum((128, 128), length, kind="gaussian", aperture=length / 4, dtype=length.dtype)
        return gaussian_random_field(noise, shape.amplitude, height=64, width=64)

    def plate(displacement: Tensor) -> Tensor:
        y, x = torch.meshgrid(torch.linspace(0, 63, 4), torch.linspace(0, 63, 4), indexing="ij")
        points = torch.stack([x, y], dim=-1).view(1, -1, 2).to(displacement.dtype)
        spline = fit_spline(points + displacement, displacement, points.new_zeros(1))
        return spline_flow(spline, height=64, width=64, dtype=displacement.dtype)

    inputs = {"a Gaussian field": (air, torch.tensor([8.0])), "a thin plate": (plate, 2 * torch.rand(1, 16, 2))}
    return {name: _hessian_error(function, at) for name, (function, at) in inputs.items()}


def _hessian_error(function: Callable[[Tensor], Tensor], at: Tensor) -> float:
    def product(point: Tensor) -> Tensor:
        point = point.clone().requires_grad_()
        (slope,) = torch.autograd.grad(function(point).square().sum(), point, create_graph=True)
        return torch.autograd.grad(slope.sum(), point)[0].double()

    true = product(at.double())
    return ((product(at) - true).abs().max() / true.abs().max()).item()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=size, nargs="+", default=SIZES, help="height x width of frames, 256x256 to 8K")
    parser.add_argument("--draws", type=count(1), default=2, help="of each effect, 2")
    out = Path(__file__).parent / "results" / "precision.json"
    parser.add_argument("--out", type=Path, default=out, help="the JSON")
    return parser


if __name__ == "__main__":
    main()
