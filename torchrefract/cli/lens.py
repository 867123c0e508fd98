"""The command that estimates the lens of a camera from the frames of a drive."""

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._validation import UsageError, check_count, first_names
from torchrefract.cameras.calibration import estimate_lens as estimate
from torchrefract.cameras.calibration.lens_estimate import focal_of_view
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import OPENCV_SUFFIXES, write_opencv
from torchrefract.cli.command import print_warning, progress
from torchrefract.cli.options import find_device, naming, read_option
from torchrefract.data import media
from torchrefract.data.frames import drives_of, evenly_spaced
from torchrefract.data.images import UnreadableImageError, read_image
from torchrefract.warping.flow import resize_image

Predictor = Callable[[Tensor], Tensor]  # from a frame (1, 3, H, W) to the flow (1, 2, h, w) that undistorts it


def estimate_lens(cfg: DictConfig) -> None:
    """Estimate the lens of the camera of pictures and videos, write the camera, and print how certain it is."""
    max_frames = read_option(cfg, "frames", check_count)
    with naming("fov_deg"):
        focal_of_view(cfg.fov_deg)
    out = Path(str(cfg.out))
    if out.suffix.lower() not in OPENCV_SUFFIXES:
        raise UsageError(f"out must end in .xml, .yml or .yaml, got {out}")
    files = media.find_media(Path(str(cfg.input)))
    if turned := media.describe_turned(files):
        print_warning(turned)
    predict = None if cfg.checkpoint is None else _load_network(cfg)
    estimate_camera(files, out, max_frames=max_frames, fov_deg=cfg.fov_deg, predict=predict)


def estimate_camera(
    files: Sequence[Path],
    out: Path,
    *,
    max_frames: int = 100,
    fov_deg: float | None = None,
    predict: Predictor | None = None,
    upright: bool = False,
) -> Camera:
    """Estimate the camera of at most so many frames of files, write it to `out`, and print how certain it is."""
    drives = sorted(set(drives_of([file.as_posix() for file in files], "prefix").values()))
    if len(drives) > 1:
        print_warning(
            f"frames of {len(drives)} drives by their names, {first_names(drives)}, are taken for those of one camera: "
            "estimate each camera by itself"
        )
    with naming("out"):
        out.parent.mkdir(parents=True, exist_ok=True)
    chosen = _select_frames(files, max_frames)
    count = sum(len(times) for _, times in chosen)
    frames = progress(_read_frames(chosen, upright=upright), "estimating the lens", count=count)
    with naming("input"):
        result = estimate(frames, fov_deg=fov_deg, predict=predict)
    with naming("out"):
        write_opencv(out, result.camera, covariance=result.covariance)
    for message in result.warnings:
        print_warning(message)
    k1, k2, *_ = result.camera.coefficients
    deviations = result.covariance.diagonal()[4:6] ** 0.5
    print(
        f"{out}: k1 {k1:.3f} +- {deviations[0]:.3f}, k2 {k2:.3f} +- {deviations[1]:.3f} for a focal length of "
        f"{result.camera.fx:.0f} px, from {result.num_frames} frames with {result.num_straight} straight edges of "
        f"{result.num_chains}; standard deviation of the rectified position: {result.edge_px:.1f} px at the left and "
        f"right edge, {result.corner_px:.1f} px in the corners"
    )
    return result.camera


def flow_predictor(model: Callable[[Tensor], Any], size: tuple[int, int], device: torch.device) -> Predictor:
    """Return a function that predicts the flow of a frame (1, 3, H, W) by a model of frames of a size."""

    @torch.inference_mode()
    def predict(frame: Tensor) -> Tensor:
        flow = model(resize_image(frame.to(device), size)).flow
        assert flow is not None  # the task predicts it
        return flow.cpu().clone()

    return predict


def _select_frames(files: Sequence[Path], max_frames: int) -> list[tuple[Path, list[int]]]:
    """Choose at most so many frames, evenly spaced over all files; return their numbers in each file."""
    # A video that states no frames is read too, which says why it has none.
    counts = [max(1, media.video_info(file)[0]) if media.is_video(file) else 1 for file in files]
    numbers, chosen = evenly_spaced(sum(counts), max_frames), list[tuple[Path, list[int]]]()
    for file, start, end in zip(files, accumulate([0, *counts]), accumulate(counts), strict=False):
        chosen.append((file, [number - start for number in numbers if start <= number < end]))
    return chosen


def _read_frames(chosen: Sequence[tuple[Path, list[int]]], *, upright: bool) -> Iterator[Tensor]:
    """Yield frames (1, 3, H, W) as stored, or as a viewer shows them; name and skip unreadable files."""
    num_read, reason, size = 0, "", None
    for file, times in chosen:
        num_before = num_read
        try:
            if media.is_video(file):
                frames = (frame for _, frame in media.read_video(file, times, upright=upright))
            else:
                frames = (read_image(file, upright=upright)[None] for _ in times)
            for frame in frames:
                height, width = frame.shape[2:]
                if size not in (None, (width, height)):
                    raise ValueError(
                        f"frames must be of one size, since they are of one camera, got {size[0]} x {size[1]} px and, "
                        f"in {file}, {width} x {height} px"
                    )
                size = width, height
                yield frame
                num_read += 1
            if times and num_read == num_before:
                raise UnreadableImageError(f"{file} is not a video with a frame that can be decoded")
        except UnreadableImageError as error:
            reason = str(error)
            print(f"skipped: {reason}", file=sys.stderr)
    if num_read == 0:
        raise UnreadableImageError(f"input must hold a readable picture or video, got {reason}")


def _load_network(cfg: DictConfig) -> Predictor:
    """Return a function that predicts the flow of a frame by the model of a checkpoint, at the size of its training."""
    from torchrefract.restoration.checkpoints import load_model  # noqa: PLC0415 - lines alone need no training stack
    from torchrefract.restoration.tasks import Undistort  # noqa: PLC0415 - as above

    loaded, device = load_model(str(cfg.checkpoint), argument="checkpoint"), find_device(str(cfg.device))
    if loaded.task != Undistort.name:
        raise UsageError(f"checkpoint must be of the task {Undistort.name}, got {cfg.checkpoint} of {loaded.task}")
    return flow_predictor(loaded.model.to(device), loaded.size, device)
