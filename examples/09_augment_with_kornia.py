"""Use an effect in a container of kornia, which moves each kind of label that it has: all data keys in one call.

python examples/09_augment_with_kornia.py [PICTURE]
"""

import sys

import kornia.augmentation as K
import torch
from torchvision.utils import draw_bounding_boxes, draw_keypoints, draw_segmentation_masks, make_grid, save_image

import torchrefract as tr
from torchrefract.adapters.kornia import KorniaEffect
from torchrefract.data.road_scenes import render_road_scenes

SIZE = (180, 320)
KEYS = ["input", "mask", "bbox", "bbox_xyxy", "bbox_xywh", "keypoints", "class"]

frames = render_road_scenes(torch.arange(4), *SIZE)[0]
x1, y1, x2, y2 = 40, 30, 130, 110
frames[:, :, y1 : y2 + 1, x1 : x2 + 1] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]  # a sign
mask = torch.zeros(4, 1, *SIZE)
mask[:, :, y1 : y2 + 1, x1 : x2 + 1] = 1
corners = torch.tensor([[x1, y1], [x2, y1], [x2, y2], [x1, y2]]).float()
labels = {
    "mask": mask,
    "bbox": corners.expand(4, 1, 4, 2),
    "bbox_xyxy": torch.tensor([x1, y1, x2, y2]).float().expand(4, 1, 4),
    "bbox_xywh": torch.tensor([x1, y1, x2 - x1 + 1, y2 - y1 + 1]).float().expand(4, 1, 4),
    "keypoints": corners.expand(4, 4, 2),
    "class": torch.full((4,), 7),
}
weather = tr.Compose([tr.LensDistortion(padding="border"), tr.UniformFog(visibility_range=(60, 200))])
container = K.AugmentationSequential(K.RandomHorizontalFlip(), KorniaEffect(weather), data_keys=KEYS)
torch.manual_seed(0)
frames, *moved = container(frames, *labels.values())
moved = dict(zip(labels, moved, strict=True))
print("the box by its corners", moved["bbox"][0, 0].round().int().tolist(), "and the class", moved["class"][0].item())
drawn = []
for i, frame in enumerate((255 * frames).byte()):
    picture = draw_segmentation_masks(frame, moved["mask"][i, 0] > 0.5, alpha=0.4, colors="cyan")
    picture = draw_bounding_boxes(picture, moved["bbox_xyxy"][i], colors="yellow", width=2)
    drawn.append(draw_keypoints(picture, moved["keypoints"][i][None], colors="red", radius=4))
picture = make_grid(torch.stack(drawn).float() / 255, nrow=2)
save_image(picture, sys.argv[1] if len(sys.argv) > 1 else "augment_with_kornia.webp")
