"""Time warps and weather of this library, kornia, albumentations and OpenCV on the same frame in one process.

python benchmarks/peers.py [--size 1080x1920] [--threads 2] [--repeats 15] [--real PATH]
                           [--out benchmarks/results/peers.json]

Times are multiples of one bare F.grid_sample. A missing package is skipped; the script prints how to install it.
"""

import importlib
import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import torch
from timing import (
    COPY,
    GRID_SAMPLE,
    RESULTS,
    TOLERANCE_PX,
    Candidate,
    Conditions,
    Timing,
    frame_of,
    measure,
    parser,
    references,
    save,
    table,
)
from torch import Tensor

import torchrefract as tr

WHAT = (
    "One frame 1x3xHxW float32 through torchrefract and kornia, and the same frame as uint8 HxWx3, their natural "
    "form, through albumentations and OpenCV; a new draw in every call, no gradients. Lens: k1 -0.25, k2 0.09, p1 = "
    "p2 = 0.0005, focal length 0.9 widths. LensDistortion inverts the lens at each pixel, as a frame seen through it "
    "requires; kornia, OpenCV and albumentations sample along the distorting map, and so does Rectification. "
    "OpticalDistortion has k1 = k2 and no other coefficients. 'bytes' takes and returns OpenCV's uint8 HxWx3. Field: "
    "smooth random displacements of about 1 px rms and 20 px correlation length. Turbulence and DivergenceFree have "
    "an exact covariance; the other packages blur white noise by a Gaussian of 20 px: kornia with 121 taps on each "
    "axis, albumentations with OpenCV's choice, or with 17 taps if approximate. Spline: a thin-plate spline through "
    "16 points displaced by about 5 px; RandomThinPlateSpline has 5 points. Fog: by depth in torchrefract; RandomFog "
    "draws some hundred translucent circles and blurs the frame. Heterogeneous fog: by depth in torchrefract; the "
    "plasma augmentations brighten the frame by a fractal. Flare: a Gaussian disk in torchrefract; RandomSunFlare "
    "draws circles. On the CPU the bare grid_sample keeps one thread busy for each sample."
)
INSTALL = {
    "cv2": "pip install opencv-contrib-python-headless",
    "kornia": "pip install kornia",
    # Its dependencies would install a second OpenCV over the one that calibration needs.
    "albumentations": (
        "pip install --no-deps albumentations==2.0.8 albucore==0.0.24 'stringzilla<4' simsimd pydantic pydantic-core "
        "typing-inspection annotated-types"
    ),
}
TASKS = ("lens", "field", "spline", "fog", "heterogeneous fog", "flare")
OURS = "torchrefract"
K1, K2, P, FOCAL = -0.25, 0.09, 0.0005, 0.9
LENGTH_PX, FIELD_PX, SPLINE_PX = 20.0, 1.0, 5.0
# White noise of variance 1, blurred by a Gaussian of standard deviation s, has standard deviation 1 / (2 sqrt(pi) s).
_BLURRED = 1 / (2 * math.sqrt(math.pi) * LENGTH_PX)
_LARGEST_NORMAL = 5.3  # of as many normal numbers as a 1080p frame has; albumentations divides its noise by it
_TAPS = 17  # of the approximate blur, which is nearly a box of this width


def main() -> None:
    """Measure, print and save."""
    options = parser(__doc__, out=RESULTS / "peers.json", has_real=True)
    args = options.parse_args()
    torch.manual_seed(0)
    try:
        frame = frame_of(args.real, args.size)
    except (ValueError, RuntimeError, OSError) as error:
        options.error(str(error))
    packages, missing = find_packages()
    if "cv2" in packages:
        packages["cv2"].setNumThreads(args.threads)
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    what = f"{WHAT} {', '.join(f'{name} {package.__version__}' for name, package in packages.items())}"
    print(what, "", *missing, sep="\n", flush=True)
    with torch.no_grad():
        timings = measure(
            candidates(frame, packages), references=(GRID_SAMPLE, COPY), repeats=args.repeats, threads=args.threads
        )
    print(table(timings, conditions), "", *standings(timings), sep="\n")
    save(args.out, timings, conditions, what=what)


def find_packages() -> tuple[dict[str, ModuleType], list[str]]:
    """Return the packages that can be imported, by name, and a line about each that cannot."""
    # Otherwise albumentations asks the network for its latest version.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    packages, missing = {}, []
    for name, command in INSTALL.items():
        try:
            packages[name] = importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} is skipped ({error}); to install it: {command}")
    return packages, missing


def candidates(frame: Tensor, packages: Mapping[str, ModuleType]) -> dict[str, Candidate]:
    """Return what is timed on a frame (1, 3, H, W), named "task: candidate"; the references come first."""
    pixels = (frame[0] * 255).round().byte().movedim(0, -1).contiguous().numpy()
    named = ours(frame, pixels)
    if "kornia" in packages:
        named |= kornia(frame)
    if "cv2" in packages:
        named |= opencv(packages["cv2"], pixels)
    if "albumentations" in packages:
        for name, transform in albumentations(packages["albumentations"], frame.shape[3]).items():
            named[name] = lambda transform=transform: transform(image=pixels)["image"]
    return references(frame) | {name: named[name] for name in sorted(named, key=_task)}


def ours(frame: Tensor, pixels: Any) -> dict[str, Candidate]:
    """Return the effects of this library."""
    height, width = frame.shape[2:]
    lens = partial(tr.LensDistortion, k1_range=(K1, K1), k2_range=(K2, K2), p1_range=(P, P), p2_range=(P, P))
    lens = partial(lens, focal_range=(FOCAL, FOCAL))
    field: dict[str, Any] = {"amplitude_range": (FIELD_PX, FIELD_PX), "length_range": (LENGTH_PX, LENGTH_PX)}
    spline: dict[str, Any] = {"amplitude_range": (SPLINE_PX, SPLINE_PX)}
    within = f"within {TOLERANCE_PX} px"
    effects = {"lens: torchrefract Rectification": tr.Rectification(make_camera(height, width))}
    for words, tolerance_px in (("exact", None), (within, TOLERANCE_PX)):
        effects |= {
            f"lens: torchrefract LensDistortion, {words}": lens(tolerance_px=tolerance_px),
            f"field: torchrefract Turbulence, {words}": tr.Turbulence(**field, tolerance_px=tolerance_px),
            f"field: torchrefract Turbulence, Gaussian, {words}": tr.Turbulence(
                **field, covariance="gaussian", tolerance_px=tolerance_px
            ),
            f"field: torchrefract DivergenceFree, {words}": tr.DivergenceFree(**field, tolerance_px=tolerance_px),
            f"spline: torchrefract ThinPlateSpline, {words}": tr.ThinPlateSpline(**spline, tolerance_px=tolerance_px),
        }
    effects |= {
        "fog: torchrefract UniformFog": tr.UniformFog(),
        "heterogeneous fog: torchrefract HeterogeneousFog": tr.HeterogeneousFog(),
        "heterogeneous fog: torchrefract HeterogeneousFog, volumetric": tr.HeterogeneousFog(mode="ray"),
        "flare: torchrefract LensFlare": tr.LensFlare(),
    }
    on_bytes, channels_first = lens(tolerance_px=TOLERANCE_PX), torch.from_numpy(pixels).permute(2, 0, 1)
    return {name: partial(effect, frame) for name, effect in effects.items()} | {
        f"lens: torchrefract LensDistortion on bytes, {within}": lambda: on_bytes(channels_first).permute(1, 2, 0)
    }


def kornia(frame: Tensor) -> dict[str, Candidate]:
    """Return the functions and augmentations of kornia."""
    augmentation = importlib.import_module("kornia.augmentation")
    calibration = importlib.import_module("kornia.geometry.calibration")
    transform = importlib.import_module("kornia.geometry.transform")
    height, width = frame.shape[2:]
    camera = make_camera(height, width)
    matrix, lens = torch.tensor([camera.matrix]), torch.tensor([camera.coefficients])
    per_px = torch.tensor([2 / width, 2 / height])  # kornia's coordinates span 2
    strength = (FIELD_PX / _BLURRED * 2 / width, FIELD_PX / _BLURRED * 2 / height)
    side = torch.linspace(-1, 1, 4)
    points = torch.cartesian_prod(side, side)[None]
    five_points = augmentation.RandomThinPlateSpline(scale=math.sqrt(3) * SPLINE_PX * 2 / width, p=1.0)
    plasma = augmentation.RandomPlasmaBrightness(p=1.0)

    def elastic() -> Tensor:
        noise = torch.randn(1, 2, height, width)
        return transform.elastic_transform2d(frame, noise, (121, 121), (LENGTH_PX, LENGTH_PX), strength)

    def sixteen_points() -> Tensor:
        moved = points + SPLINE_PX * per_px * torch.randn_like(points)
        kernel, affine = transform.get_tps_transform(moved, points)
        return transform.warp_image_tps(frame, points, kernel, affine)

    return {
        "lens: kornia undistort_image": lambda: calibration.undistort_image(frame, matrix, lens),
        "field: kornia elastic_transform2d": elastic,
        "spline: kornia warp_image_tps": sixteen_points,
        "spline: kornia RandomThinPlateSpline, 5 points": lambda: five_points(frame),
        "heterogeneous fog: kornia RandomPlasmaBrightness": lambda: plasma(frame),
    }


def opencv(package: Any, pixels: Any) -> dict[str, Candidate]:
    """Return the functions of OpenCV."""
    height, width = pixels.shape[:2]
    camera = make_camera(height, width)
    matrix, lens = np.array(camera.matrix), np.array(camera.coefficients)

    def undistort() -> Any:
        maps = package.initUndistortRectifyMap(matrix, lens, None, matrix, (width, height), package.CV_32FC1)
        return package.remap(pixels, *maps, package.INTER_LINEAR)

    return {"lens: OpenCV initUndistortRectifyMap + remap": undistort}


def albumentations(package: Any, width: int) -> dict[str, Any]:
    """Return the transforms of albumentations for frames of a width in px."""
    elastic = partial(package.ElasticTransform, sigma=LENGTH_PX, p=1.0)
    share = 10 * SPLINE_PX / width
    return {
        "lens: albumentations OpticalDistortion": package.OpticalDistortion(distort_limit=(K1, K1), p=1.0),
        "field: albumentations ElasticTransform": elastic(alpha=_LARGEST_NORMAL * FIELD_PX / _BLURRED),
        "field: albumentations ElasticTransform, approximate": elastic(
            alpha=_LARGEST_NORMAL * FIELD_PX * _TAPS, approximate=True
        ),
        "spline: albumentations ThinPlateSpline": package.ThinPlateSpline(
            scale_range=(share, share), num_control_points=4, p=1.0
        ),
        "fog: albumentations RandomFog": package.RandomFog(p=1.0),
        "heterogeneous fog: albumentations PlasmaBrightnessContrast": package.PlasmaBrightnessContrast(p=1.0),
        "flare: albumentations RandomSunFlare": package.RandomSunFlare(p=1.0),
    }


def standings(timings: Sequence[Timing]) -> list[str]:
    """For each candidate of this library, list the faster and the slower candidates of the other packages."""
    ratios = {timing.name: timing.ratios[GRID_SAMPLE].median for timing in timings}
    lines = []
    for name, ratio in ratios.items():
        if OURS not in name:
            continue
        others = {n: r for n, r in ratios.items() if _task(n) == _task(name) and OURS not in n}
        faster = _ranked({n: r for n, r in others.items() if r < ratio})
        slower = _ranked({n: r for n, r in others.items() if r >= ratio})
        lines.append(f"{name} {ratio:.3g} x; faster: {faster}; slower: {slower}")
    return lines


def _task(name: str) -> int:
    task = name.partition(":")[0]
    return TASKS.index(task) if task in TASKS else -1


def _ranked(ratios: Mapping[str, float]) -> str:
    ranked = sorted(ratios, key=lambda name: ratios[name])
    return ", ".join(f"{name.partition(': ')[2]} {ratios[name]:.3g} x" for name in ranked) or "none"


def make_camera(height: int, width: int) -> tr.Camera:
    """Return the camera of the task "lens"."""
    pinhole: dict[str, Any] = {"fx": FOCAL * width, "fy": FOCAL * width, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    return tr.Camera(width=width, height=height, **pinhole, coefficients=(K1, K2, P, P, 0.0))


if __name__ == "__main__":
    main()
