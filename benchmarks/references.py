"""Distance of the scenes to real fog, haze, dust and sun, beside that of the clear frames that they degrade.

    python benchmarks/references.py                   # DATA is ../shared/data beside the checkout
    python benchmarks/references.py --pictures FOLDER # and saves them side by side
    python benchmarks/references.py --clear PATTERN   # from other clear frames, where the depth is not measured
    python benchmarks/references.py --restore best.ckpt  # contrast before and after a model of the task deweather

Real and clear frames show different roads and exposures, so that only statistics are compared: the mean distance, over
twelve bands of rows, of the histograms of luma, and of those of local contrast, the standard deviation of luma in a
window of 9 px, both divided by the mean luma of the frame. The distance of two histograms is that of the earth mover
(Wasserstein-1). A scene is good where its distances are below those of the clear frames, of which at most eight count.

--restore prints the contrast of real pictures in haze, in fog and in clear air: the mean of that standard deviation of
luma, divided by the mean luma of the picture. With --pictures it saves them beside their restorations.
"""

import argparse
import warnings
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from severity import gray_levels, scene_for_width
from torch import Tensor

from torchrefract import presets
from torchrefract.data.depth_maps import read_depth
from torchrefract.data.images import fit, pixels_of, read_image
from torchrefract.restoration.checkpoints import load_model
from torchrefract.restoration.inference import Restorer

DATA = Path(__file__).parents[2] / "shared" / "data"
SIZE = (360, 640)
BANDS, WINDOW, QUANTILES, FRAMES = 12, 9, 101, 8


class Reference(NamedTuple):
    """A real picture of what a scene is to show, and clear frames of the same kind: paths and patterns in the data."""

    real: str
    scene: str
    clear: str
    depth: str | None = None


HAZE = "references/haze_road_lidar/image_640x360.jpg"
CLEAR = "references/clear_road_lidar"
FOG = "references/real_fog_comma/preview_640x360.jpg"
TO_RESTORE = {"haze": HAZE, "fog": FOG, "clear": f"{CLEAR}/image_640x360.jpg"}
REFERENCES = {
    "haze, depth by lidar": Reference(
        HAZE, "cape_town_fog", f"{CLEAR}/image_640x360.jpg", f"{CLEAR}/depth_dense_derived_640x360.png"
    ),
    "haze": Reference(HAZE, "cape_town_fog", "fullres/cn_pjlab_road.jpg"),
    "fog": Reference(FOG, "cape_town_fog", "frames/val/in_rdd_g*"),
    "dust and sun": Reference(
        "references/sun_dust_india/India_001877_720x720.jpg", "unpaved_road", "frames/train/in_rdd_f*"
    ),
    "sun, open road": Reference(
        "references/sun_glare_boreas/camera_1733249255732230_crop.jpg", "limpopo_sun_glare", "frames/val/us_losaltos*"
    ),
    "sun, forest": Reference(
        "references/sun_glare_forest/glare_strong.jpg", "limpopo_sun_glare", "frames/train/us_forest*"
    ),
}


def statistics(image: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return quantiles of the relative luma and local contrast of an image (3, H, W), each (bands, quantiles)."""
    share = np.linspace(0, 1, QUANTILES)
    luma, local = (
        np.stack([np.quantile(band, share) for band in np.array_split(value, BANDS)])
        for value in luma_and_contrast(image)
    )
    return luma, local


def luma_and_contrast(image: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the luma of an image (3, H, W) and its local contrast, relative to the mean luma, each (H, W)."""
    y = gray_levels(image).astype(np.float32)
    y /= y.mean()
    mean, square = (cv2.blur(value, (WINDOW, WINDOW)) for value in (y, y * y))
    return y, np.sqrt(np.maximum(square - mean * mean, 0))


def contrast(image: Tensor) -> float:
    """Return the mean local contrast of an image (3, H, W), relative to its mean luma."""
    return float(luma_and_contrast(image)[1].mean())


def distances(first: Tensor, second: Tensor) -> np.ndarray:
    """Return the distances of the histograms of luma and of local contrast of images (3, H, W), (2,)."""
    pairs = zip(statistics(first), statistics(second), strict=True)
    return np.array([np.abs(a - b).mean() for a, b in pairs])


def restore(checkpoint: str, data: Path, pictures: Path | None) -> None:
    """Print the contrast of real pictures before and after the model of a checkpoint."""
    loaded = load_model(checkpoint)
    restorer = Restorer(loaded.model, size=loaded.size)
    print("| picture | contrast | restored |\n| --- | --- | --- |")
    for name, path in TO_RESTORE.items():
        image = read_image(data / path)
        (restored,) = restorer([image])
        print(f"| {name} | {contrast(image):.3f} | {contrast(restored):.3f} |", flush=True)
        save_picture(pictures, f"restored_{name}", [image, restored])


def save_picture(folder: Path | None, name: str, images: list[Tensor]) -> None:
    """Save images (3, H, W) side by side, if there is a folder."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{name}.png"), pixels_of(torch.cat(images, dim=2))[..., ::-1])


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each reference beside its scene")
    parser.add_argument(
        "--clear", help="clear frames of all references without a measured depth, a pattern in the data"
    )
    parser.add_argument("--restore", help="checkpoint of the task deweather, whose contrast is measured instead")
    arguments = parser.parse_args()
    if not arguments.data.is_dir():
        print(f"skipped: needs real pictures, and {arguments.data} does not exist")
        return
    if arguments.restore:
        return restore(arguments.restore, arguments.data, arguments.pictures)
    warnings.filterwarnings("ignore", "depth is that of a road")  # real pictures have no depth map
    print("| reference | scene | clear | " + " | ".join(map(str, presets.SEVERITIES)) + " |")
    print("| --- | --- | --- |" + " --- |" * len(presets.SEVERITIES))
    for name, reference in REFERENCES.items():
        if arguments.clear and reference.depth is not None:
            continue
        real = fit(read_image(arguments.data / reference.real), SIZE)
        paths = sorted(arguments.data.glob(arguments.clear or reference.clear))[:FRAMES]
        if not paths:
            parser.error(f"--clear must name pictures in {arguments.data}, got none for {arguments.clear}")
        clear = torch.stack([fit(read_image(path), SIZE) for path in paths])
        depth = None if reference.depth is None else read_depth(arguments.data / reference.depth)[0][None, None]
        versions = [clear]
        for severity in presets.SEVERITIES:
            effect = scene_for_width(reference.scene, severity, SIZE[1])
            versions.append(effect.degrade(clear, seed=0, depth=depth).image)
        results = [np.mean([distances(real, image) for image in images], axis=0) for images in versions]
        print(f"| {name} | `{reference.scene}` |", " | ".join(f"{a:.3f}, {b:.3f}" for a, b in results), "|", flush=True)
        file = name.replace(",", "").replace(" ", "_")
        save_picture(arguments.pictures, file, [real, *(images[0] for images in versions)])


if __name__ == "__main__":
    main()
