"""What one resample saves: four warps composed, and a frame rectified for another lens, against one look-up for each.

python benchmarks/one_resample.py PATH [--frames 4] [--threads 1] [--out benchmarks/results/one_resample.json]

PATH is a frame, or a folder of frames such as ../shared/data/fullres.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from composites import closed_forms, composite, positions, spline_read
from roundtrip import psnr
from timing import Bar, Conditions
from torch import Tensor

from torchrefract import (
    Camera,
    Compose,
    ComposeParams,
    DivergenceFree,
    LensDistortion,
    Rectification,
    ThinPlateSpline,
    Turbulence,
    compose_flows,
)
from torchrefract._io import replace_file
from torchrefract.data.images import EXTENSIONS, read_image
from torchrefract.effects.refraction import WarpEffect
from torchrefract.warping.grid import inside, length

WHAT = (
    "LensDistortion, Turbulence, ThinPlateSpline and DivergenceFree at their defaults, one draw a frame. The "
    "reference takes the four flows in float64, reads each where the later ones look by quintic splines, and looks "
    "the frame up along the composite by a quintic spline too, cut to [0, 1]. 'one' is Compose, 'each' the same draws "
    "applied one after the other; both are float32. 'rectified' is a wide car camera's lens taken out of the frame, "
    "and a drawn one put on. PSNR in dB, on pixels that all stages see, 12 px and more from where they do not. A "
    "pixel grid does not hold what lies between its pixels: the reference is what the best reading of a real frame "
    "makes of its noise and its aliasing, and what differs from it is the blur that each look-up adds. Errors of a "
    "flow are lengths in px; what misses most is the bilinear reading of rough turbulence. In closed form, a lens, a "
    "thin plate and a sine of 4 px and a wavelength of 200 px are known everywhere, so the truth is no spline."
)
MODES = ("bilinear", "bicubic")
SEED = 7
MARGIN_PX = 12  # a quintic spline has forgotten the border there, and so have four bicubic look-ups
COMPOSED = "all four, as composed"
CLOSED = "in closed form"
# The wide camera of PJLab-ADG/SensorsCalibration, `pj_wide_cv5` in the table of lenses: focal length in widths.
WIDE_FOCAL = 0.5513
WIDE = (-0.14873913, 0.09693338, -0.00015430, -0.00043046, -0.02374642)

Chain = Callable[[str], list[WarpEffect]]  # by the interpolation, in the order in which they are applied


@dataclass(frozen=True)
class Row:
    """One frame, looked up in one way."""

    frame: str
    interpolation: str
    one_db: float
    each_db: float
    share: float  # of the frame, that was compared

    @property
    def gain_db(self) -> float:
        """What composing saves."""
        return self.one_db - self.each_db

    def __str__(self) -> str:
        return (
            f"{self.frame[:28]:28}  {self.interpolation:8}  {self.one_db:6.2f}  {self.each_db:6.2f}"
            f"  {self.gain_db:6.2f}  {self.share:6.3f}"
        )


class Scene(NamedTuple):
    """One frame's draw, and what the draw should make of it."""

    params: ComposeParams
    flows: tuple[Tensor, ...]  # each (1, 2, H, W), float64, px, in the order in which they are applied
    flow: Tensor  # (1, 2, H, W), float64, px, their composite
    image: Tensor  # (1, C, H, W), float64


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    args, paths = _arguments()
    torch.set_num_threads(args.threads)
    print(WHAT, end="\n\n", flush=True)
    print(f"{'frame':28}  look-up   one     each    gain    share", flush=True)
    rows, relensed, errors = [], [], []
    for key, path in enumerate(paths):
        frame = read_image(path)[None].contiguous()
        made = scene(frame, key)
        chain = partial(rectified, height=frame.shape[2], width=frame.shape[3])
        other = scene(frame, key, chain)
        for mode in MODES:
            rows.append(compare(frame, made, interpolation=mode, name=path.name))
            relensed.append(compare(frame, other, chain, interpolation=mode, name=f"{path.name[:16]}, rectified"))
            print(rows[-1], relensed[-1], sep="\n", flush=True)
        errors.append(drawn_errors(frame, made) | closed_errors(made))
    conditions = Conditions.now(read_image(paths[0])[None], threads=args.threads, repeats=1)
    means = [*_means(rows), *_means(relensed, " rectified")]
    worst = {name: max(found[name] for found in errors) for name in errors[0]}
    held = bars(rows, worst)
    print(*means, "", "composite flow: largest error in px", sep="\n")
    print(*(f"  {name:48} {error:.1e}" for name, error in worst.items()), "", "bars:", *held, sep="\n")
    _save(args.out, rows=[*rows, *relensed], means=means, errors=worst, held=held, conditions=conditions)
    print(f"written to {args.out}")


def warps(interpolation: str = "bilinear") -> list[WarpEffect]:
    """The four, in the order in which they are applied."""
    return [
        LensDistortion(interpolation=interpolation, tolerance_px=None),
        Turbulence(interpolation=interpolation, tolerance_px=None),
        ThinPlateSpline(interpolation=interpolation, tolerance_px=None),
        DivergenceFree(interpolation=interpolation, tolerance_px=None),
    ]


def rectified(interpolation: str, *, height: int, width: int) -> list[WarpEffect]:
    """The wide camera's lens taken out of a frame, and another one put on."""
    camera = Camera(
        width=width,
        height=height,
        fx=WIDE_FOCAL * width,
        fy=WIDE_FOCAL * width,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        coefficients=WIDE,
        model="opencv",
    )
    return [
        Rectification(camera, interpolation=interpolation, tolerance_px=None),
        LensDistortion(interpolation=interpolation, tolerance_px=None),
    ]


def scene(frame: Tensor, key: int, chain: Chain = warps) -> Scene:
    """The draw of one frame (1, C, H, W), and the reference for it."""
    (height, width), effects = frame.shape[2:], chain("bilinear")
    params = Compose(effects).sample(frame, seed=SEED, keys=[key])
    exact = params.to(torch.float64).children
    flows = tuple(effect.flow(own, height=height, width=width)[0] for effect, own in zip(effects, exact, strict=True))
    flow = composite(flows)
    return Scene(params, flows, flow, spline_read(frame, flow).clamp(0, 1))


def sound(valid: Tensor, flow: Tensor) -> Tensor:
    """(1, 1, H, W), bool: MARGIN_PX and more from what is not valid, and looking as far inside the frame."""
    height, width = valid.shape[2:]
    # The pool pads with nothing, so the border is marked as not valid first.
    wide = F.pad((~valid).float(), (MARGIN_PX,) * 4, value=1.0)
    near = F.max_pool2d(wide, 2 * MARGIN_PX + 1, stride=1) > 0
    at = positions(flow)
    room = torch.minimum(at, torch.tensor([width - 1, height - 1]).view(1, 2, 1, 1) - at)
    return ~near & (room >= MARGIN_PX).all(dim=1, keepdim=True)


def compare(frame: Tensor, made: Scene, chain: Chain = warps, *, interpolation: str, name: str) -> Row:
    """One resample, and one for each warp, of a frame (1, C, H, W), against the reference."""
    effects = chain(interpolation)
    one = Compose(effects, tolerance_px=None).apply(frame, made.params)
    each = frame
    for effect, own in zip(effects, made.params.children, strict=True):
        each = effect.apply(each, own).image
    good = sound(one.valid, made.flow)
    found = (psnr(image, made.image, good).item() for image in (one.image, each))
    return Row(name, interpolation, *found, share=good.double().mean().item())


def drawn_errors(frame: Tensor, made: Scene) -> dict[str, float]:
    """The error of the composite of the drawn flows, all of them and by pairs; the truth is by quintic splines."""
    single = [flow.float() for flow in made.flows]
    names = [type(effect).__name__ for effect in warps()]
    found = {
        COMPOSED: error_px(Compose(warps(), tolerance_px=None).apply(frame, made.params).flow, made.flow),
    }
    for first, then in combinations(range(len(single)), 2):
        truth = composite([made.flows[first], made.flows[then]])
        found[f"{names[first]}, then {names[then]}"] = error_px(compose_flows(single[first], single[then]), truth)
    return found


def closed_errors(made: Scene) -> dict[str, float]:
    """The error of `compose_flows` on pairs that are known in closed form."""
    height, width = made.flow.shape[2:]
    known = closed_forms(made.params, height=height, width=width)
    still = positions(torch.zeros_like(made.flow))
    at_pixels = {name: flow(still) for name, flow in known.items()}
    found = {}
    for first, then in permutations(known, 2):
        after = at_pixels[then]
        truth = after + known[first](still + after)
        flow = compose_flows(at_pixels[first].float(), after.float())
        found[f"{CLOSED}, {first}, then {then}"] = error_px(flow, truth)
    return found


def error_px(flow: Tensor, truth: Tensor) -> float:
    """The longest error of a flow (1, 2, H, W) in px, where the truth looks MARGIN_PX inside the frame and deeper."""
    good = sound(inside(truth), truth)
    return length(flow - truth)[good].max().item()


def bars(rows: Sequence[Row], errors: Mapping[str, float]) -> list[Bar]:
    """What the issue asks for, beside what was measured."""
    gains = [_mean([row.gain_db for row in rows if row.interpolation == mode]) for mode in MODES]
    held = [Bar(f"one over four, {mode}", gain, ">=", 6.0, "dB") for mode, gain in zip(MODES, gains, strict=True)]
    closed = max(error for name, error in errors.items() if name.startswith(CLOSED))
    held.append(Bar(f"composite, {COMPOSED}", errors[COMPOSED], "<=", 2e-3, "px"))
    held.append(Bar(f"composite of two, {CLOSED}", closed, "<=", 2e-3, "px"))
    return held


def _means(rows: Sequence[Row], what: str = "") -> list[Row]:
    means = []
    for mode in MODES:
        values = [(row.one_db, row.each_db, row.share) for row in rows if row.interpolation == mode]
        one, each, share = (_mean(column) for column in zip(*values, strict=True))
        means.append(Row(f"mean of {len(values)}{what}", mode, one, each, share))
    return means


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _save(
    path: Path,
    *,
    rows: Sequence[Row],
    means: Sequence[Row],
    errors: Mapping[str, float],
    held: Sequence[Bar],
    conditions: Conditions,
) -> None:
    content: dict[str, Any] = {
        "what": WHAT,
        "conditions": asdict(conditions),
        "rows": [asdict(row) | {"gain_db": row.gain_db} for row in (*rows, *means)],
        "errors_px": errors,
        "bars": [asdict(bar) | {"holds": bar.holds} for bar in held],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _arguments() -> tuple[argparse.Namespace, list[Path]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("path", type=Path, help="a frame, or a folder of frames, of any size")
    parser.add_argument("--frames", type=int, default=4, help="so many of a folder, spread over it, 4")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch on the CPU, 1")
    out = Path(__file__).parent / "results" / "one_resample.json"
    parser.add_argument("--out", type=Path, default=out, help="the JSON")
    args = parser.parse_args()
    if args.frames < 1 or args.threads < 1:
        parser.error(f"frames and threads must be at least 1, got {args.frames} and {args.threads}")
    found = [args.path] if args.path.is_file() else sorted(args.path.rglob("*"))
    paths = [path for path in found if path.suffix.lower() in EXTENSIONS]
    if not paths:
        parser.error(f"path must be a frame or hold frames, got {args.path}")
    return args, paths[:: max(1, len(paths) // args.frames)][: args.frames]


if __name__ == "__main__":
    main()
