"""Use effects inside a detector: in training it degrades the batch on its device, and the boxes move along.

Each frame has a magenta sign, so that the moved boxes can be compared with the degraded image.
python examples/04_detector_with_boxes.py [PICTURE]
"""

import sys

import torch
from torch import Tensor, nn
from torchvision import tv_tensors
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_320_fpn
from torchvision.ops import box_iou, masks_to_boxes
from torchvision.utils import draw_bounding_boxes, make_grid, save_image

import torchrefract as tr
from torchrefract.data.road_scenes import render_road_scenes

SIZE = (160, 288)
SIGNS = torch.tensor([[20, 12, 80, 52], [215, 20, 275, 60], [15, 100, 75, 150], [200, 95, 280, 150]])
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


class RobustDetector(nn.Module):
    """A detector that degrades its input in training only."""

    def __init__(self):
        super().__init__()
        self.effect = tr.Compose([tr.Turbulence(), tr.LensDistortion(padding="border")])
        self.detector = fasterrcnn_mobilenet_v3_large_320_fpn(
            weights=None, weights_backbone=None, num_classes=2, min_size=SIZE[0], rpn_post_nms_top_n_train=30
        )

    def forward(self, images: Tensor, targets: list[dict] | None = None) -> dict[str, Tensor] | list[dict]:
        if self.training:
            images, targets = self.effect(images, targets)
        return self.detector(list(images), targets)


torch.manual_seed(0)
frames, targets = render_road_scenes(torch.arange(4), *SIZE)[0], []
for frame, sign in zip(frames, SIGNS, strict=True):
    frame[:, sign[1] : sign[3], sign[0] : sign[2]] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    box = tv_tensors.BoundingBoxes(sign[None].float(), format="XYXY", canvas_size=SIZE, device=DEVICE)  # pyright: ignore[reportCallIssue]  # torchvision's overloads
    targets.append({"boxes": box, "labels": torch.ones(1, dtype=torch.int64, device=DEVICE)})
frames, model = frames.to(DEVICE), RobustDetector().to(DEVICE).train()
optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
for step in range(4):
    optimizer.zero_grad()
    loss = torch.stack(list(model(frames, targets).values())).sum()
    loss.backward()
    optimizer.step()
    print(f"step {step}: loss {loss.item():.2f}")
images, moved = model.effect(frames, targets)
signs = masks_to_boxes(images[:, ::2].amin(dim=1) - images[:, 1] > 0.5) + torch.tensor([0, 0, 1, 1], device=DEVICE)
for name, boxes in (("moved", moved), ("original", targets)):
    iou = [box_iou(target["boxes"], sign[None]).item() for target, sign in zip(boxes, signs, strict=True)]
    print(f"IoU of the {name} boxes with the degraded signs:", *(f"{value:.3f}" for value in iou))
drawn = [draw_bounding_boxes(image, t["boxes"], colors="yellow") for image, t in zip(images, moved, strict=True)]
save_image(make_grid(torch.stack(drawn), nrow=2), sys.argv[1] if len(sys.argv) > 1 else "detector_with_boxes.webp")
