"""Train a detector of Ultralytics, from its architecture, on frames that a transform of Albumentations degrades.

Ultralytics moves the boxes of its YOLO labels by the same transform and draws them, which makes the picture.
python examples/07_train_yolo.py [PICTURE]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import yaml
from PIL import Image
from ultralytics import YOLO  # pyright: ignore[reportMissingImports]  # not in the extras

import torchrefract as tr
from torchrefract.adapters.albumentations import AlbumentationsEffect
from torchrefract.data.road_scenes import render_road_scenes

SIZE = 64


def write_data(root: Path) -> Path:
    """Write 16 rendered roads, each with a magenta sign, and their labels."""
    for name in ("images", "labels"):
        (root / name).mkdir()
    corners = np.random.default_rng(0).integers(6, 36, (16, 2))
    for i, (frame, (x, y)) in enumerate(zip(render_road_scenes(torch.arange(16), SIZE, SIZE)[0], corners, strict=True)):
        frame[:, y : y + 14, x : x + 18] = torch.tensor([1.0, 0.0, 1.0])[:, None, None]
        Image.fromarray((255 * frame.movedim(0, -1)).byte().numpy()).save(root / f"images/{i}.png")
        (root / f"labels/{i}.txt").write_text(f"0 {(x + 9) / SIZE} {(y + 7) / SIZE} {18 / SIZE} {14 / SIZE}\n")
    data = root / "data.yaml"
    data.write_text(yaml.safe_dump({"path": str(root), "train": "images", "val": "images", "names": ["sign"]}))
    return data


def main() -> None:
    """Train one epoch."""
    scene = tr.Compose([tr.LensDistortion(padding="border"), tr.UniformFog(visibility_range=(60, 200), p=0.5)])
    transform = AlbumentationsEffect(scene, p=0.8, channels="bgr")  # Ultralytics reads pictures as OpenCV does
    options = {"epochs": 1, "batch": 16, "imgsz": SIZE, "workers": 2, "device": "cpu", "mosaic": 0.0, "amp": False}
    with TemporaryDirectory() as folder:
        root = Path(folder)
        model = YOLO("yolo11n.yaml")
        model.train(data=write_data(root), augmentations=[transform], project=root, name="run", **options)
        picture = Image.open(root / "run/train_batch0.jpg").resize((768, 768))
        picture.save(sys.argv[1] if len(sys.argv) > 1 else "train_yolo.webp")


if __name__ == "__main__":
    main()
