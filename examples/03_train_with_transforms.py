"""Use effects in the torchvision transforms of a training script: DataLoader workers degrade frames and move boxes.

python examples/03_train_with_transforms.py [PICTURE]
"""

import sys

import torch
from torch.utils.data import DataLoader, Dataset
from torchvision import tv_tensors
from torchvision.transforms import v2
from torchvision.utils import draw_bounding_boxes, make_grid, save_image

import torchrefract as tr
from torchrefract.data.road_scenes import RoadScenes

SIZE = (180, 320)


class Scenes(Dataset):
    """Rendered roads with a magenta sign and its box."""

    def __init__(self, transform: v2.Transform):
        self.frames, self.transform = RoadScenes(8, size=SIZE), transform

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int) -> tuple[torch.Tensor, dict]:
        image = self.frames[i].image
        image[:, 50:80, 210:260] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]
        box = torch.tensor([[210.0, 50.0, 260.0, 80.0]])
        boxes = tv_tensors.BoundingBoxes(box, format="XYXY", canvas_size=SIZE)  # pyright: ignore[reportCallIssue]  # torchvision's overloads
        target = {"boxes": boxes, "labels": torch.tensor([1])}
        return self.transform(tv_tensors.Image(image), target)


def main() -> None:
    """Draw one batch."""
    out = sys.argv[1] if len(sys.argv) > 1 else "train_with_transforms.webp"
    weather = tr.OneOf([tr.UniformFog(visibility_range=(60, 200)), tr.Turbulence(amplitude_range=(0.5, 1.0))], p=0.8)
    transform = v2.Compose([v2.RandomHorizontalFlip(), weather, tr.LensDistortion(padding="border", p=0.8)])
    torch.manual_seed(0)  # seeds the workers, which seed the effects
    loader = DataLoader(
        Scenes(transform), batch_size=8, num_workers=2, collate_fn=lambda batch: list(zip(*batch, strict=True))
    )
    images, targets = next(iter(loader))
    drawn = [
        draw_bounding_boxes((255 * image).byte(), target["boxes"], colors="yellow", width=2)
        for image, target in zip(images, targets, strict=True)
    ]
    save_image(make_grid(torch.stack(drawn).float() / 255, nrow=4), out)


if __name__ == "__main__":
    main()
