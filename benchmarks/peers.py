"""What warps and weather cost here and at the peers, as multiples of one bare F.grid_sample on the same frame.

python benchmarks/peers.py [--size 1080x1920] [--threads 2] [--repeats 15] [--real PATH]
                           [--out benchmarks/results/peers.json]

A peer that is not installed is left out, and the command says how to install it.
"""

import argparse
import importlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from arguments import count, frame_of, size
from timing import (
    COPY,
    FEWEST_REPEATS,
    GRID_SAMPLE,
    Candidate,
    Conditions,
    Spread,
    Timing,
    measure,
    references,
    save,
    table,
)
from torch import Tensor
from torch.utils import benchmark

from torchrefract import (
    DivergenceFree,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
    warp,
)
from torchrefract.fields.lens import lens_restore_flow

WHAT = (
    "One frame 1x3xHxW float32 through our effects, kornia and torchvision, and the same frame as uint8 HxWx3, which "
    "is their natural form, through albumentations and OpenCV; a new draw in every call, no gradients. "
    "Lens: k1 -0.25, k2 0.09, p1 = p2 = 0.0005 and a focal length of 0.9 widths at kornia, OpenCV and our 'closed "
    "form': all three look the frame up along the distorting map. LensDistortion draws a lens and inverts it for each "
    "pixel, since that is what a frame seen through the lens takes; no peer does. OpticalDistortion has k1 = k2 and no "
    "other term. "
    "Field: smooth random displacements of about 1 px rms. Ours have exactly the covariance asked for, exponential "
    "(Turbulence) or without divergence (DivergenceFree); the peers blur white noise by a Gaussian of 20 px: kornia "
    "with 121 taps on each axis, torchvision with 161 x 161, albumentations with OpenCV's choice, or, if approximate, "
    "with 17 taps, which is a field of another kind. "
    "Spline: a thin plate through 16 points displaced by about 5 px; kornia's RandomThinPlateSpline has 5 points, so "
    "its functions stand beside it with 16. "
    "Fog: ours by depth; RandomFog paints some hundred translucent circles and blurs the frame. "
    "Drifts: ours change the extinction of fog by depth; the peers' plasma brightens the frame by a fractal. "
    "Flare: ours is a Gaussian veil; RandomSunFlare paints circles. "
    "By their own documentation albumentations moves masks, boxes and keypoints with its three warps; torchvision "
    "moves boxes by the negated displacement, which it calls an approximation; kornia's elastic and spline "
    "augmentations have no transform matrix and no inverse. "
    "On the CPU the bare grid_sample threads over the batch alone."
)
INSTALL = {
    "cv2": "pip install opencv-contrib-python-headless",
    "kornia": "pip install kornia",
    "torchvision": "pip install torchvision",
    # Its dependencies would put another OpenCV over the one that calibration needs.
    "albumentations": (
        "pip install --target FOLDER --no-deps albumentations==2.0.8 albucore==0.0.24 'stringzilla<4' simsimd pydantic "
        "pydantic-core typing-inspection annotated-types, with FOLDER on PYTHONPATH"
    ),
}
JOBS = ("lens", "field", "spline", "fog", "drifts", "flare")
# Half a second to several seconds a call: few rounds, or the run takes more than five minutes.
SLOW = (
    "field: torchvision ElasticTransform",
    "spline: kornia warp_image_tps",
    "fog: albumentations RandomFog",
    "drifts: kornia RandomPlasmaBrightness",
    "drifts: albumentations PlasmaBrightnessContrast",
)
LOOKS = 3

LENGTH_PX = 20.0
FIELD_PX = 1.0
SPLINE_PX = 5.0
# White noise of variance 1, blurred by a Gaussian of standard deviation s, has standard deviation 1 / (2 sqrt(pi) s).
_BLURRED = 1 / (2 * math.sqrt(math.pi) * LENGTH_PX)
_LARGEST_NORMAL = 5.3  # of as many normal numbers as a 1080p frame has: what albumentations divides its noise by
_TAPS = 17  # so few of them are nearly a box, which divides the standard deviation by their number
_K1, _K2, _P, _FOCAL = -0.25, 0.09, 0.0005, 0.9


def main() -> None:
    """Measure, print and save; where a peer is faster it is said."""
    parser = _parser()
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(args.threads)
    try:
        frame = frame_of(args.real, args.size).contiguous()
    except (ValueError, RuntimeError) as error:
        parser.error(str(error))
    peers, missing = find_peers()
    if "cv2" in peers:
        peers["cv2"].setNumThreads(args.threads)
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    what = f"{WHAT} {versions(peers)}"
    print(what, "", *missing, sep="\n", flush=True)
    timings = timed(candidates(frame, peers), repeats=args.repeats, threads=args.threads)
    print(table(timings, conditions), *looks(timings), "", *standings(timings), sep="\n")
    save(args.out, timings, conditions, what=what)
    print(f"written to {args.out}")


def find_peers() -> tuple[dict[str, ModuleType], list[str]]:
    """The peers that can be imported, by name, and a line about each that cannot."""
    # Otherwise albumentations asks the network for its latest version.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    found, missing = {}, []
    for name, command in INSTALL.items():
        try:
            found[name] = importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} is left out ({error}); to have it: {command}")
    return found, missing


def versions(peers: Mapping[str, ModuleType]) -> str:
    """The peers by version."""
    return ", ".join(f"{name} {peer.__version__}" for name, peer in peers.items())


def candidates(frame: Tensor, peers: Mapping[str, ModuleType]) -> dict[str, Candidate]:
    """What is compared on a frame (1, 3, H, W), by job and name; the references come first."""
    found = _ours(frame)
    if "kornia" in peers:
        found |= _kornia(frame)
    if "torchvision" in peers:
        found |= _torchvision(frame)
    pixels = (frame[0].movedim(0, -1) * 255).round().byte().contiguous().numpy()
    if "albumentations" in peers:
        found |= _albumentations(peers["albumentations"], pixels)
    if "cv2" in peers:
        found |= _opencv(peers["cv2"], pixels)
    return references(frame) | {name: found[name] for name in sorted(found, key=_job)}


def timed(found: Mapping[str, Candidate], *, repeats: int, threads: int) -> list[Timing]:
    """What each candidate takes, in their order; the slow ones by a few looks."""
    held_against = {name: found[name] for name in (GRID_SAMPLE, COPY)}
    quick = {name: call for name, call in found.items() if name not in SLOW}
    timings = {t.name: t for t in measure(quick, references=tuple(held_against), repeats=repeats, threads=threads)}
    for name in found.keys() - quick.keys():
        timings[name] = glance(name, found[name], held_against)
    return [timings[name] for name in found]


def glance(name: str, slow: Candidate, held_against: Mapping[str, Candidate]) -> Timing:
    """What a slow candidate takes: median, least and most of three rounds, with one call in each."""
    rounds = [
        (_seconds(slow), {key: _seconds(call, before=2) for key, call in held_against.items()}) for _ in range(LOOKS)
    ]
    return Timing(
        name,
        1,
        milliseconds=_spread([1e3 * own for own, _ in rounds]),
        ratios={key: _spread([own / others[key] for own, others in rounds]) for key in held_against},
    )


def looks(timings: Sequence[Timing]) -> list[str]:
    """What the table does not tell: which candidates had few rounds."""
    return [f"{t.name}: median (least-most) of {LOOKS} rounds" for t in timings if t.name in SLOW]


def standings(timings: Sequence[Timing]) -> list[str]:
    """For each of our candidates, which peers at the same job are faster and which slower."""
    ratios = {timing.name: timing.ratios[GRID_SAMPLE].median for timing in timings}
    lines = []
    for name, own in ratios.items():
        if ": ours " not in name:
            continue
        others = {n: r for n, r in ratios.items() if _job(n) == _job(name) and ": ours " not in n}
        faster = _ranked({n: r for n, r in others.items() if r < own})
        slower = _ranked({n: r for n, r in others.items() if r >= own})
        lines.append(f"{name} {own:.3g} x; faster: {faster}; slower: {slower}")
    return lines


def _ours(frame: Tensor) -> dict[str, Candidate]:
    field, length = (FIELD_PX, FIELD_PX), (LENGTH_PX, LENGTH_PX)
    effects = {
        "lens: ours LensDistortion": LensDistortion(),
        "field: ours Turbulence": Turbulence(amplitude_range=field, length_range=length),
        "field: ours DivergenceFree": DivergenceFree(amplitude_range=field, length_range=length),
        "spline: ours ThinPlateSpline": ThinPlateSpline(amplitude_range=(SPLINE_PX, SPLINE_PX)),
        "fog: ours UniformFog": UniformFog(),
        "drifts: ours HeterogeneousFog": HeterogeneousFog(),
        "drifts: ours HeterogeneousFog, in space": HeterogeneousFog(mode="ray"),
        "flare: ours LensFlare": LensFlare(),
    }
    found: dict[str, Candidate] = {name: lambda effect=effect: effect(frame) for name, effect in effects.items()}
    height, width = frame.shape[2:]
    coefficients = torch.tensor([[_K1, _K2, 0, 0, 0, 0, _P, _P, 0, 0, 0, 0]])
    focal = torch.full((1, 2), _FOCAL * width)
    center = torch.tensor([[width - 1, height - 1]]) / 2

    def closed_form() -> Tensor:
        flow, _ = lens_restore_flow(coefficients, focal, center, height=height, width=width)
        return warp(frame, flow)[0]

    return found | {"lens: ours closed form": closed_form}


def _kornia(frame: Tensor) -> dict[str, Candidate]:
    augmentation = importlib.import_module("kornia.augmentation")
    calibration = importlib.import_module("kornia.geometry.calibration")
    transform = importlib.import_module("kornia.geometry.transform")
    height, width = frame.shape[2:]
    camera = torch.tensor([_camera(height, width)])
    lens = torch.tensor([[_K1, _K2, _P, _P, 0.0]])
    to_sampler = torch.tensor([2 / width, 2 / height])  # of px
    strength = tuple((FIELD_PX / _BLURRED * to_sampler).tolist())
    side = torch.linspace(-1, 1, 4)
    points = torch.cartesian_prod(side, side)[None]
    plasma = augmentation.RandomPlasmaBrightness(p=1.0)
    five = augmentation.RandomThinPlateSpline(scale=math.sqrt(3) * SPLINE_PX * 2 / width, p=1.0)

    def elastic() -> Tensor:
        noise = torch.randn(1, 2, height, width)
        return transform.elastic_transform2d(frame, noise, (121, 121), (LENGTH_PX, LENGTH_PX), strength)

    def sixteen() -> Tensor:
        moved = points + SPLINE_PX * to_sampler * torch.randn_like(points)
        kernel, affine = transform.get_tps_transform(moved, points)
        return transform.warp_image_tps(frame, points, kernel, affine)

    return {
        "lens: kornia undistort_image": lambda: calibration.undistort_image(frame, camera, lens),
        "field: kornia elastic_transform2d": elastic,
        "spline: kornia RandomThinPlateSpline, 5 points": lambda: five(frame),
        "spline: kornia warp_image_tps": sixteen,
        "drifts: kornia RandomPlasmaBrightness": lambda: plasma(frame),
    }


def _torchvision(frame: Tensor) -> dict[str, Candidate]:
    transforms = importlib.import_module("torchvision.transforms.v2")
    # Uniform noise in [-1, 1], in half widths.
    elastic = transforms.ElasticTransform(alpha=2 * math.sqrt(3) * FIELD_PX / _BLURRED, sigma=LENGTH_PX)
    return {"field: torchvision ElasticTransform": lambda: elastic(frame)}


def _albumentations(package: Any, pixels: Any) -> dict[str, Candidate]:
    strength = _LARGEST_NORMAL * FIELD_PX / _BLURRED
    share = 10 * SPLINE_PX / pixels.shape[1]
    transforms = {
        "lens: albumentations OpticalDistortion": package.OpticalDistortion(distort_limit=(_K1, _K1), p=1.0),
        "field: albumentations ElasticTransform": package.ElasticTransform(alpha=strength, sigma=LENGTH_PX, p=1.0),
        "field: albumentations ElasticTransform, approximate": package.ElasticTransform(
            alpha=_LARGEST_NORMAL * FIELD_PX * _TAPS, sigma=LENGTH_PX, approximate=True, p=1.0
        ),
        "spline: albumentations ThinPlateSpline": package.ThinPlateSpline(
            scale_range=(share, share), num_control_points=4, p=1.0
        ),
        "fog: albumentations RandomFog": package.RandomFog(p=1.0),
        "drifts: albumentations PlasmaBrightnessContrast": package.PlasmaBrightnessContrast(p=1.0),
        "flare: albumentations RandomSunFlare": package.RandomSunFlare(p=1.0),
    }
    return {name: lambda chosen=chosen: chosen(image=pixels)["image"] for name, chosen in transforms.items()}


def _opencv(package: Any, pixels: Any) -> dict[str, Candidate]:
    height, width = pixels.shape[:2]
    camera = torch.tensor(_camera(height, width), dtype=torch.float64).numpy()
    lens = torch.tensor([_K1, _K2, _P, _P, 0.0], dtype=torch.float64).numpy()

    def undistort() -> Any:
        maps = package.initUndistortRectifyMap(camera, lens, None, camera, (width, height), package.CV_32FC1)
        return package.remap(pixels, *maps, package.INTER_LINEAR)

    return {"lens: OpenCV initUndistortRectifyMap + remap": undistort}


def _camera(height: int, width: int) -> list[list[float]]:
    focal = _FOCAL * width
    return [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]


def _job(name: str) -> int:
    job = name.partition(":")[0]
    return JOBS.index(job) if job in JOBS else -1


def _seconds(call: Candidate, *, before: int = 0) -> float:
    for _ in range(before):
        call()
    start = benchmark.timer()
    call()
    return benchmark.timer() - start


def _spread(values: Sequence[float]) -> Spread:
    least, median, most = sorted(values)
    return Spread(median, least, most)


def _ranked(ratios: Mapping[str, float]) -> str:
    told = [f"{name.partition(': ')[2]} {ratios[name]:.3g} x" for name in sorted(ratios, key=lambda n: ratios[n])]
    return ", ".join(told) or "none"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=size, default=(1080, 1920), help="height x width of the frame, 1080x1920")
    parser.add_argument("--threads", type=count(1), default=2, help="threads of torch and OpenCV, 2")
    parser.add_argument("--repeats", type=count(FEWEST_REPEATS), default=FEWEST_REPEATS, help="rounds, 15 or more")
    parser.add_argument("--real", type=Path, help="a picture to use as the frame, instead of noise")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "peers.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
