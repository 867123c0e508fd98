"""What warps and weather cost here and at the peers, as multiples of one bare F.grid_sample on the same frame.

python benchmarks/peers.py [--size 1080x1920] [--threads 2] [--repeats 15] [--real PATH]
                           [--out benchmarks/results/peers.json]

A peer that is not installed is left out, and the command says how to install it.
"""

import argparse
import importlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import peer_fields
import peer_warps
import peer_weather
import torch
from arguments import count, frame_of, size
from slow_timing import timed
from timing import FEWEST_REPEATS, GRID_SAMPLE, Candidate, Conditions, Timing, references, save, table
from torch import Tensor

from torchrefract._tensor import to_uint8

WHAT = (
    "One frame 1x3xHxW float32 through our effects, kornia and torchvision, and the same frame as uint8 HxWx3, which "
    "is their natural form, through albumentations and OpenCV; a new draw in every call, no gradients. "
    "Lens: k1 -0.25, k2 0.09, p1 = p2 = 0.0005 and a focal length of 0.9 widths at kornia, OpenCV and our 'closed "
    "form': all three look the frame up along the distorting map. LensDistortion draws a lens and inverts it for each "
    "pixel, since that is what a frame seen through the lens takes; no peer does. On bytes it takes OpenCV's "
    "frame, uint8 HxWx3, and hands one over. OpticalDistortion has k1 = k2 and no other term. 'Within 0.05 px' is the "
    "same of ours with that tolerance. "
    "Field: smooth random displacements of about 1 px rms. Ours have exactly the covariance asked for, exponential or "
    "Gaussian (Turbulence) or without divergence (DivergenceFree). GSTools is the stack of the paper: two fields of "
    "exponential covariance, each of 1000 random modes, and one remap; its fields have that covariance in the mean "
    "over many. The other peers blur white noise by a Gaussian of 20 px: kornia with 121 taps on each axis, "
    "torchvision with 161 x 161, albumentations with OpenCV's choice, or, if approximate, with 17 taps, which is a "
    "field of another kind. "
    "Spline: a thin plate through 16 points displaced by about 5 px; kornia's RandomThinPlateSpline has 5 points, so "
    "its functions stand beside it with 16. torch-tps is a spline alone and looks up by grid_sample. "
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
    "torch_tps": "pip install torch-tps",
    "gstools": "pip install gstools",
    # Its dependencies would put another OpenCV over the one that calibration needs.
    "albumentations": (
        "pip install --target FOLDER --no-deps albumentations==2.0.8 albucore==0.0.24 'stringzilla<4' simsimd pydantic "
        "pydantic-core typing-inspection annotated-types, with FOLDER on PYTHONPATH"
    ),
}
JOBS = ("lens", "field", "spline", "fog", "drifts", "flare")


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
    if "gstools" in peers:
        peers["gstools"].config.NUM_THREADS = args.threads
    conditions = Conditions.now(frame, threads=args.threads, repeats=args.repeats)
    what = f"{WHAT} {versions(peers)}"
    print(what, "", *missing, sep="\n", flush=True)
    timings, notes = timed(candidates(frame, peers), repeats=args.repeats, threads=args.threads)
    print(table(timings, conditions), *notes, "", *standings(timings), sep="\n")
    save(args.out, timings, conditions, what=" ".join([what, *notes]))
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
    pixels = to_uint8(frame)[0].movedim(0, -1).contiguous().numpy()
    found = peer_warps.candidates(frame, pixels, peers) | peer_fields.candidates(frame, pixels, peers)
    found |= peer_weather.candidates(frame, peers)
    for name, chosen in albumentations(peers, frame.shape[3]).items():
        found[name] = lambda chosen=chosen: chosen(image=pixels)["image"]
    return references(frame) | {name: found[name] for name in sorted(found, key=_job)}


def albumentations(peers: Mapping[str, ModuleType], width: int) -> dict[str, Any]:
    """Its transforms for frames of a width in px, by job and name; none where it is not installed."""
    if "albumentations" not in peers:
        return {}
    package = peers["albumentations"]
    found = peer_warps.albumentations(package, width) | peer_fields.albumentations(package)
    return found | peer_weather.albumentations(package)


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


def _job(name: str) -> int:
    job = name.partition(":")[0]
    return JOBS.index(job) if job in JOBS else -1


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
