"""Plot a robustness curve without labels: a model's output on degraded frames against that on clean ones, by severity.

The model detects edges; replace it by yours. A match may be 3 px away, and pixels outside the lens are ignored.

python examples/05_robustness_curve.py [PICTURE]
"""

import sys

import torch
import torch.nn.functional as F
from kornia.filters import sobel
from matplotlib.figure import Figure
from torch import Tensor

import torchrefract as tr
from torchrefract import presets
from torchrefract.data.road_scenes import render_road_scenes

SIZE = (216, 384)
SCENES = {
    "cape_town_fog": presets.cape_town_fog,
    "limpopo_sun_glare": presets.limpopo_sun_glare,
    "highveld_heat_haze": lambda severity: presets.highveld_heat_haze(severity, width=SIZE[1]),
    "unpaved_road": lambda severity: presets.unpaved_road(severity, width=SIZE[1]),
    "cheap_dashcam": presets.cheap_dashcam,
}


def dilate(mask: Tensor, px: int) -> Tensor:
    """Enlarge a mask (B, 1, H, W), bool, by some px on each side."""
    return F.max_pool2d(mask.float(), 2 * px + 1, stride=1, padding=px) > 0


def model(images: Tensor) -> Tensor:
    """Detect edges, (B, 1, H, W), bool."""
    return sobel(images).amax(dim=1, keepdim=True) > 0.08


def score(clean: Tensor, degraded: tr.Degraded) -> float:
    """Compute the F1 score of edges in degraded frames against edges of the clean ones, moved along the flow."""
    expected, detected = model(clean), model(degraded.image)
    if degraded.flow is not None:
        expected = tr.warp_mask(expected.float(), degraded.flow, soft=True) > 0.25
        outside = dilate(~tr.warp(clean, degraded.flow)[1], 5)  # black padding, whose border is an edge too
        expected, detected = expected & ~outside, detected & ~outside
    recall = (expected & dilate(detected, 3)).sum() / expected.sum()
    precision = (detected & dilate(expected, 3)).sum() / detected.sum().clamp(min=1)
    return (2 * recall * precision / (recall + precision).clamp(min=1e-6)).item()


frames, depth = render_road_scenes(torch.arange(3), *SIZE)
axes = (figure := Figure(figsize=(7, 4), dpi=120, layout="constrained")).subplots()
for name, scene in SCENES.items():
    curve = [score(frames, scene(s).degrade(frames, seed=1, depth=depth)) for s in presets.SEVERITIES]
    axes.plot(presets.SEVERITIES, curve, marker="o", label=name)
    print(f"{name:20}", *(f"{value:.2f}" for value in curve))
axes.set(xlabel="severity", ylabel="F1 score of edges", xticks=presets.SEVERITIES, ylim=(0, 1.02))
axes.legend(frameon=False)
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "robustness_curve.png")
