"""Take the lens out of pictures or videos: `python -m torchrefract.rectify input=DIR camera=camera.yaml`."""

import sys
from functools import lru_cache, partial
from pathlib import Path

import hydra
import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_number
from torchrefract.cameras.io.opencv import read_opencv, write_opencv
from torchrefract.cameras.models import Camera
from torchrefract.cli.command import command, job, naming, progress
from torchrefract.data.images import UnreadableImageError, pixels_of, read_image
from torchrefract.data.media import (
    check_output_folder,
    convert_video,
    find_media,
    is_complete,
    is_video,
    output_name,
    write_picture,
)
from torchrefract.fields.rectifying import camera_flow
from torchrefract.warping.resample import warp


@command("rectify")
@hydra.main(config_path=CONFIG_DIR, config_name="rectify", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Rectify what is not there yet, and write the camera of what comes out."""
    source, out = Path(str(cfg.input)), Path(str(cfg.out))
    with naming("zoom"):
        zoom = check_number("zoom", cfg.zoom, low=0.05, high=20.0)
    with naming("camera"):
        lens = _Lens(read_opencv(str(cfg.camera)), zoom)
    files = find_media(source)
    with naming("out"):
        out.mkdir(parents=True, exist_ok=True)
    check_output_folder(out, source)
    _claim(out, lens)
    if lens.black:
        print(
            f"camera: {lens.black:.1%} of the frame has no ray and stays black: the model folds back", file=sys.stderr
        )
    made, failed = 0, dict[Path, str]()
    for file in progress(files, "rectifying", count=len(files)):
        try:
            made += _rectify(file, lens, out)
        except ValueError as error:
            failed[file] = str(error) if isinstance(error, UnreadableImageError) else f"{file}: {error}"
            print(f"skipped: {failed[file]}", file=sys.stderr)
    if len(failed) == len(files):
        raise UsageError(f"input must hold what can be rectified, got {next(iter(failed.values()))}")
    there = len(files) - len(failed) - made
    print(
        f"{out}: {made} rectified, {there} were there already, {len(failed)} skipped; their camera is {out}/camera.yaml"
    )


class _Lens:
    """A camera whose lens is taken out, with the flow for each size of frames."""

    def __init__(self, camera: Camera, zoom: float):
        self.camera, self.zoom = camera, zoom
        _, exists, self.pinhole = camera_flow(camera, zoom=zoom)
        self.black = 1 - exists.double().mean().item()  # share of the frame
        self.flow = lru_cache(maxsize=2)(self._flow)

    def _flow(self, height: int, width: int) -> Tensor:
        return camera_flow(self.camera.resized(width=width, height=height), zoom=self.zoom)[0]

    def __call__(self, frame: Tensor) -> np.ndarray:
        """A frame (1, 3, H, W) in [0, 1] rectified: (H, W, 3), uint8, RGB."""
        image = warp(frame, self.flow(*frame.shape[2:]), interpolation="bicubic")[0]
        return pixels_of(image[0])


def _claim(out: Path, lens: _Lens) -> None:
    """Write the cameras before and after, or raise if the folder is of others, whose pictures would stay."""
    for path, camera in ((out / "lens.yaml", lens.camera), (out / "camera.yaml", lens.pinhole)):
        if path.is_file():
            with naming("out"):
                before = read_opencv(path)
            if before != camera:
                raise UsageError(
                    f"out must be a folder of the same camera and zoom, got {out} with another {path.name}"
                )
        else:
            write_opencv(path, camera)


def _rectify(file: Path, lens: _Lens, out: Path) -> bool:
    """Whether a picture or video had to be rectified."""
    target = out / output_name(file).name
    if is_complete(file, target):
        return False
    with replace_file(target) as path:
        if is_video(file):
            convert_video(file, path, change=partial(map, lens))
        else:
            write_picture(lens(read_image(file)[None].contiguous()), path)
    return True


if __name__ == "__main__":
    main()
