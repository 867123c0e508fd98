"""Degrade a frame by a lens and by fog, and restore it with the maps of the effects.

python examples/01_degrade_and_restore.py [PICTURE]
"""

import sys

import torch
from matplotlib.figure import Figure

import torchrefract as tr
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.visualization import flow_to_rgb, hatch_invalid, transmission_to_rgb

out = sys.argv[1] if len(sys.argv) > 1 else "degrade_and_restore.webp"
clean, depth = render_road_scenes(torch.tensor([29]), 270, 480)

lens = tr.LensDistortion(k1_range=(-0.3, -0.3), focal_range=(0.75, 0.75)).degrade(clean, seed=7)
undistorted, _ = tr.warp(lens.image, lens.restore_flow, interpolation="bicubic")

fog = tr.UniformFog(visibility_range=(90, 90)).degrade(clean, seed=7, depth=depth)
defogged, fog_valid = tr.remove_fog(fog.image, fog.transmission, fog.params.airlight)

rows = {
    "LensDistortion": (
        clean,
        lens.image,
        hatch_invalid(flow_to_rgb(lens.flow * lens.valid), lens.valid),
        hatch_invalid(undistorted, lens.restore_valid),
    ),
    "UniformFog": (clean, fog.image, transmission_to_rgb(fog.transmission), hatch_invalid(defogged, fog_valid)),
}
columns = ("clean", "degraded", "flow / transmission", "restored (invalid: hatched)")
figure = Figure(figsize=(13.2, 4.1), layout="constrained")
axes = figure.subplots(len(rows), len(columns))
for row, (name, images) in zip(axes, rows.items(), strict=True):
    row[0].set_ylabel(name, fontsize=12)
    for axis, image in zip(row, images, strict=True):
        axis.imshow(image[0].clamp(0, 1).movedim(0, -1))
        axis.set(xticks=[], yticks=[])
for axis, title in zip(axes[0], columns, strict=True):
    axis.set_title(title, fontsize=12)
figure.savefig(out, dpi=80)
print(out)
