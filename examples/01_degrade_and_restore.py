"""Each effect on one rendered frame: clean, degraded, the map of what was done, and the frame with it undone."""

import sys

import torch
from matplotlib.figure import Figure

import torchrefract as tr
from torchrefract import visualization
from torchrefract.data.road_scenes import render_road_scenes

out = sys.argv[1] if len(sys.argv) > 1 else "degrade_and_restore.png"
clean, depth = render_road_scenes(torch.tensor([29]), 270, 480)

lens = tr.LensDistortion(k1_range=(-0.3, -0.3), focal_range=(0.75, 0.75)).degrade(clean, seed=7)
unbent, seen = tr.warp(lens.image, lens.restore_flow, interpolation="bicubic")

fog = tr.UniformFog(visibility_range=(90, 90))
misty = fog.degrade(clean, seed=7, depth=depth)
airlight = misty.params.airlight[:, :, None, None]
# What 8 bits cannot hold any more stays fog.
t = misty.transmission.clamp(min=1 / 255)
unveiled = torch.where(misty.valid, (misty.image - airlight * (1 - t)) / t, airlight)

rows = {
    "LensDistortion": (clean, lens.image, visualization.flow_to_rgb(lens.flow * lens.valid), unbent * seen),
    "UniformFog": (clean, misty.image, visualization.transmission_to_rgb(misty.transmission), unveiled),
}
columns = ("clean", "degraded", "flow / transmission", "restored by the map")
figure = Figure(figsize=(13.2, 4.1), layout="constrained")
axes = figure.subplots(len(rows), len(columns))
for row, (name, images) in zip(axes, rows.items(), strict=True):
    row[0].set_ylabel(name, fontsize=12)
    for axis, title, image in zip(row, columns, images, strict=True):
        axis.imshow(image[0].clamp(0, 1).movedim(0, -1))
        axis.set(xticks=[], yticks=[])
        if name == "LensDistortion":
            axis.set_title(title, fontsize=12)
figure.savefig(out, dpi=80)
print(out)
