"""Degrade the batch where the model is, once it is there: in a hook of Lightning, and in a plain loop; boxes follow.

python examples/08_corrupt_on_the_device.py [PICTURE]
"""

import sys
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader
from torchvision import tv_tensors
from torchvision.utils import draw_bounding_boxes, make_grid, save_image

import torchrefract as tr
from torchrefract.data.road_scenes import render_road_scenes

SIZE = (160, 288)
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SCENE = tr.Compose([tr.LensDistortion(padding="border"), tr.UniformFog(visibility_range=(60, 200), p=0.5)])


def collate(rows: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, list[Tensor]]:
    """Stack the frames and list the boxes, whose number differs from frame to frame."""
    size: dict[str, Any] = {"format": "XYXY", "canvas_size": SIZE}
    return torch.stack([frame for frame, _ in rows]), [tv_tensors.BoundingBoxes(boxes, **size) for _, boxes in rows]


class FindSign(pl.LightningModule):
    """Regress the box of the sign."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Conv2d(3, 8, 9, 8), nn.ReLU(), nn.Flatten(), nn.LazyLinear(4))

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        return SCENE(*batch) if self.trainer.training else batch

    def training_step(self, batch: Any) -> Tensor:
        return nn.functional.l1_loss(self.net(batch[0]), torch.cat(batch[1]) / SIZE[1])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.parameters(), lr=1e-3)


torch.manual_seed(0)
frames = render_road_scenes(torch.arange(16), *SIZE)[0]
signs = torch.tensor([[20, 12, 80, 52], [180, 20, 240, 60], [40, 100, 100, 150], [180, 95, 260, 150]] * 4)[:, None]
for frame, (x1, y1, x2, y2) in zip(frames, signs[:, 0], strict=True):
    frame[:, y1:y2, x1:x2] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]
data: Any = list(zip(frames, signs.float(), strict=True))
loader, drawn = DataLoader(data, batch_size=8, collate_fn=collate), []
trainer = pl.Trainer(max_epochs=1, accelerator="auto", devices=1, logger=False, enable_checkpointing=False)
trainer.fit(FindSign(), loader)

for clean, labels in loader:  # the same in a plain loop
    images, boxes = SCENE(clean.to(DEVICE), [box.to(DEVICE) for box in labels])
    drawn = [draw_bounding_boxes(image, box, colors="yellow") for image, box in zip(images, boxes, strict=True)]
save_image(make_grid(torch.stack(drawn), nrow=4), sys.argv[1] if len(sys.argv) > 1 else "corrupt_on_the_device.webp")
