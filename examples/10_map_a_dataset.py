"""Degrade a data set of Hugging Face: once by `map`, which stores the pictures, or anew in the collator of each batch.

python examples/10_map_a_dataset.py [PICTURE]
"""

import sys
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader
from torchvision import tv_tensors
from torchvision.transforms.v2 import functional as F
from torchvision.utils import draw_bounding_boxes, make_grid, save_image

from torchrefract import LensDistortion, UniformFog, warp_labels
from torchrefract.data.road_scenes import render_road_scenes

try:
    from datasets import Dataset  # pyright: ignore[reportMissingImports]  # not in the extras
except ModuleNotFoundError:
    raise SystemExit("this example needs datasets: pip install datasets") from None

SIZE = (180, 320)
LENS = LensDistortion(padding="border")
FOG = UniformFog(visibility_range=(60, 200))


def read(row: dict[str, Any]) -> tuple[Tensor, Any]:
    """Return the image (3, H, W) in [0, 1] and the boxes of a row."""
    image = F.to_dtype(F.pil_to_tensor(row["image"]), torch.float32, scale=True)
    size: dict[str, Any] = {"format": "XYXY", "canvas_size": image.shape[1:]}
    return image, tv_tensors.BoundingBoxes(row["boxes"], **size)


def degrade(row: dict[str, Any], index: int) -> dict[str, Any]:
    """Degrade the image of a row by the draw of its index, and move its boxes."""
    image, boxes = read(row)
    degraded = LENS.degrade(image, seed=0, keys=[index])
    moved = warp_labels({"boxes": boxes}, degraded.flow)["boxes"]
    return {"image": F.to_pil_image(degraded.image), "boxes": moved.tolist()}


def collate(rows: list[dict[str, Any]]) -> tuple[Tensor, list[Any]]:
    """Stack the images and degrade them at once; boxes would move along with a lens."""
    images, boxes = zip(*map(read, rows), strict=True)
    return FOG(torch.stack(images), list(boxes))


frames = render_road_scenes(torch.arange(8), *SIZE)[0]
frames[:, :, 30:90, 40:130] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]  # a sign
rows = {"image": [F.to_pil_image(frame) for frame in frames], "boxes": [[[40.0, 30.0, 130.0, 90.0]]] * 8}
dataset = Dataset.from_dict(rows).map(degrade, with_indices=True)
torch.manual_seed(0)
images, boxes = next(iter(DataLoader(dataset, batch_size=8, collate_fn=collate)))
drawn = [draw_bounding_boxes((255 * i).byte(), b, colors="yellow", width=2) for i, b in zip(images, boxes, strict=True)]
picture = make_grid(torch.stack(drawn).float() / 255, nrow=4)
save_image(picture, sys.argv[1] if len(sys.argv) > 1 else "map_a_dataset.webp")
