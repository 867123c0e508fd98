"""Take the lens out of pictures or videos: `python -m torchrefract.rectify input=DIR camera=camera.yaml`."""

import sys
from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, count
from pathlib import Path

import cv2
import hydra
import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._checks import check_number
from torchrefract._command import UsageError, as_they_are, command, job, naming, progress
from torchrefract._config import CONFIG_DIR
from torchrefract._files import replacing
from torchrefract.cameras.files.opencv import read_opencv, write_opencv
from torchrefract.cameras.models import Camera
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, image_size, read_image
from torchrefract.fields.rectifying import camera_flow
from torchrefract.videos import VIDEOS, read_video, video_facts, write_video
from torchrefract.warping.resample import warp

_FPS = 25.0  # of a video that does not say
_QUALITY = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95]}


@command("rectify", prepare=as_they_are)
@hydra.main(config_path=CONFIG_DIR, config_name="rectify", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Rectify what is not there yet, and write the camera of what comes out."""
    source, out = Path(str(cfg.input)), Path(str(cfg.out))
    with naming("zoom"):
        zoom = check_number("zoom", cfg.zoom, low=0.05, high=20.0)
    with naming("camera"):
        lens = _Lens(read_opencv(str(cfg.camera)), zoom)
    files = _files(source)
    with naming("out"):
        out.mkdir(parents=True, exist_ok=True)
    if out.resolve() == (source if source.is_dir() else source.parent).resolve():
        raise UsageError(f"out must be another folder than that of input, got {out}")
    _claim(out, lens)
    if lens.black:
        print(
            f"camera: {lens.black:.1%} of the frame has no ray and stays black: the model folds back", file=sys.stderr
        )
    made, failed = 0, dict[Path, str]()
    for file in progress(files, "rectifying", count=len(files)):
        try:
            made += _rectify(file, lens, out)
        except (UnreadableImageError, ValueError) as error:
            failed[file] = str(error)
            print(f"skipped: {error}", file=sys.stderr)
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
        return (255 * image[0].clamp(0, 1)).round().byte().permute(1, 2, 0).contiguous().numpy()


def _files(source: Path) -> Sequence[Path]:
    """The pictures and videos to rectify."""
    if not source.exists():
        raise UsageError(f"input must be a folder, a picture or a video, got {source}, which does not exist")
    known = (*EXTENSIONS, *VIDEOS)
    # What is hidden is no picture of the user's, but a file that a stop has left half written.
    files = sorted(source.glob("[!.]*")) if source.is_dir() else [source]
    files = [file for file in files if file.suffix.lower() in known]
    if not files:
        raise UsageError(f"input must be, or hold, {', '.join(known)}, got {source}")
    names = [_target(file) for file in files]
    if double := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"input must not hold two videos of one name, got {', '.join(sorted(double))}")
    return files


def _target(file: Path) -> str:
    return f"{file.stem}.mp4" if file.suffix.lower() in VIDEOS else file.name


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
    target = out / _target(file)
    video = file.suffix.lower() in VIDEOS
    if (_same_length if video else _same_size)(file, target):
        return False
    with replacing(target) as path:
        (_write_video if video else _write_picture)(file, lens, path)
    return True


def _same_size(file: Path, target: Path) -> bool:
    """Whether a target is a whole picture of the size of a file."""
    try:
        return target.is_file() and image_size(target) == image_size(file)
    except UnreadableImageError:
        return False


def _same_length(file: Path, target: Path) -> bool:
    """Whether a target is a video with the frames of a file."""
    return target.is_file() and video_facts(target)[0] == video_facts(file)[0] > 0


def _write_picture(file: Path, lens: _Lens, path: Path) -> None:
    pixels = lens(read_image(file)[None].contiguous())
    done, data = cv2.imencode(path.suffix, pixels[..., ::-1], _QUALITY.get(path.suffix.lower(), []))
    if not done:
        raise UsageError(f"{path} could not be written as {path.suffix}")
    path.write_bytes(data.tobytes())


def _write_video(file: Path, lens: _Lens, path: Path) -> None:
    frames = (frame for _, frame in read_video(file, count()))
    if (first := next(frames, None)) is None:
        raise UnreadableImageError(f"{file} is no video with a frame that can be decoded")
    height, width = first.shape[2:]
    if height % 2 or width % 2:
        raise UnreadableImageError(f"{file} has frames of {width} x {height}, and videos here take even sides only")
    fps = video_facts(file)[1] or _FPS
    write_video(map(lens, chain([first], frames)), path, fps=fps, size=(width, height))


if __name__ == "__main__":
    main()
