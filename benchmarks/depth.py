"""Accuracy of the depth that effects assume, and of fog with it.

The first number is the mean error of log10(depth), up to 250 m, where the true depth is finite. The second is the rms
error of the transmission of a fog of 100 m visibility over the whole frame, in which that of the sky is 0.

    python benchmarks/depth.py                          # rendered roads, whose depth is known
    python benchmarks/depth.py --references REFERENCES  # and real frames with lidar

REFERENCES holds a folder for each frame with image_640x360.jpg, depth_dense_derived_640x360.png (16 bits, 1/256 m,
65535 is the sky) and meta.json (fx of a frame 1920 px wide).
"""

import argparse
import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

import torchrefract as tr
from torchrefract.data.depth_maps import read_depth
from torchrefract.data.images import read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.fields.depth import depth_of

FARTHEST = 250.0  # m
VISIBILITY = 100.0  # m


def log_error(depth: Tensor, truth: Tensor) -> float:
    """Return the mean error of log10(depth) where the true depth is finite."""
    is_known = truth.isfinite()
    ratio = depth.expand_as(truth)[is_known].clamp(1, FARTHEST) / truth[is_known].clamp(1, FARTHEST)
    return ratio.log10().abs().mean().item()


def transmission_error(depth: Tensor, truth: Tensor) -> float:
    """Return the rms error of the transmission 0.05^(d / 100 m)."""
    t, exact = (0.05 ** (value / VISIBILITY) for value in (depth.expand_as(truth), truth))
    return (t - exact).square().mean().sqrt().item()


def frames(references: Path | None) -> Iterator[tuple[str, Tensor, Tensor, float]]:
    """Yield the name, the image, the depth and the focal length in widths of sets of frames."""
    for path in sorted(references.glob("*/depth_dense_derived_640x360.png")) if references else ():
        focal = json.loads((path.parent / "meta.json").read_text())["fx"] / 1920
        yield (
            path.parent.name,
            read_image(path.parent / "image_640x360.jpg")[None],
            read_depth(path)[0][None, None],
            focal,
        )
    image, depth = render_road_scenes(torch.arange(64), 180, 320)
    yield "64 rendered roads", image, depth, 0.9


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--references", type=Path)
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", "depth is that of a road")  # which is what is measured
    print(f"{'':24}{'LinearDepth':>16}{'GroundPlaneDepth':>20}{'CorridorDepth':>16}")
    for name, image, truth, focal in frames(arguments.references):
        sources = (tr.LinearDepth(), tr.GroundPlaneDepth(focal=focal), tr.CorridorDepth(focal=focal))
        depths = [depth_of(source, image, torch.float32) for source in sources]
        texts = [f"{log_error(depth, truth):.3f}, {transmission_error(depth, truth):.3f}" for depth in depths]
        print(f"{name:24}{texts[0]:>16}{texts[1]:>20}{texts[2]:>16}", flush=True)


if __name__ == "__main__":
    main()
