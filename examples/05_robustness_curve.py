"""How far a model's view of the road goes, over the severities of each scene: a robustness curve without any label.

The model under test finds edges; put yours in its place. What it finds in the clean frame is held against what it finds
in the corrupted one, within 3 px.
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


def model(images: Tensor) -> Tensor:
    """(B, 1, H, W), bool: the edges."""
    return sobel(images).amax(dim=1, keepdim=True) > 0.08


def score(clean: Tensor, degraded: tr.Degraded) -> float:
    """The share of the clean frame's edges that are found again where they ought to be: F1 of both directions."""
    expected, found = model(clean), model(degraded.image)
    if degraded.flow is not None:
        expected = tr.warp_mask(expected.float(), degraded.flow, soft=True) > 0.25
    near = [F.max_pool2d(edges.float(), 7, stride=1, padding=3) > 0 for edges in (expected, found)]
    recall = (expected & near[1]).sum() / expected.sum()
    precision = (found & near[0]).sum() / found.sum().clamp(min=1)
    return (2 * recall * precision / (recall + precision).clamp(min=1e-6)).item()


frames, depth = render_road_scenes(torch.arange(6), *SIZE)
figure = Figure(figsize=(7, 4), dpi=120, layout="constrained")
axes = figure.subplots()
for name, scene in SCENES.items():
    curve = [score(frames, scene(s).degrade(frames, seed=1, depth=depth)) for s in presets.SEVERITIES]
    axes.plot(presets.SEVERITIES, curve, marker="o", label=name)
    print(f"{name:20}", *(f"{value:.2f}" for value in curve))
axes.set(xlabel="severity", ylabel="edges found again (F1)", xticks=presets.SEVERITIES, ylim=(0, 1))
axes.legend(frameon=False)
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "robustness_curve.png")
