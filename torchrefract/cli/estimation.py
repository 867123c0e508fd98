"""The commands that estimate the depth of pictures and videos, and the lens of the camera of a drive."""

import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate, count, groupby
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchrefract._io import is_remote, make_folder, make_writable_folder, matching_files, relative_name
from torchrefract._validation import UsageError, check_count, first_names
from torchrefract.cameras.calibration import estimate_lens as estimate
from torchrefract.cameras.calibration.lens_estimate import focal_of_view
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import OPENCV_SUFFIXES, write_opencv
from torchrefract.cli.options import claim_out, find_device, make, naming, read_option, source_and_out
from torchrefract.cli.progress import Skipped, batches, print_warning, progress
from torchrefract.data import media
from torchrefract.data.depth_maps import DepthFolder, write_depth
from torchrefract.data.frames import drives_of, evenly_spaced
from torchrefract.data.images import UnreadableImageError, read_image
from torchrefract.data.pairs.configuration import CONFIG
from torchrefract.data.pairs.manifest import locked
from torchrefract.data.video import read_video, video_info
from torchrefract.depth import RoadSpreadError, TransformersDepth
from torchrefract.warping.flow import resize_image

Predictor = Callable[[Tensor], Tensor]  # from a frame (1, 3, H, W) to the flow (1, 2, h, w) that undistorts it


# Options of `estimate_depth` by the arguments of from_transformers and GroundPlaneDepth.
_OPTIONS = {"name_or_folder": "network", "scale": "scale_by"}
_OPTIONS |= {name: f"road.{name}" for name in ("camera_height", "focal", "horizon")}


class _Frame(NamedTuple):
    image: Tensor  # (3, H, W)
    target: Path
    name: str


def estimate_depth(cfg: DictConfig) -> None:
    """Write the depth maps of a picture, a video or a folder that are not in the output folder yet."""
    with source_and_out(cfg) as (source, out):
        _estimate_depth(cfg, source, out)


def _estimate_depth(cfg: DictConfig, source: Path, out: Path) -> None:
    size = read_option(cfg, "batch", check_count)
    files = media.find_media(source, out=out, deep=True, name="source")
    folder, root = DepthFolder(out), source if source.is_dir() else source.parent
    pictures = [relative_name(file, root) for file in files if not media.is_video(file)]
    folder.check([(name, None) for name in pictures], exist=False)
    cfg.device = str(find_device(str(cfg.device)))
    network = _make_network(cfg)
    with naming("out"):
        if (out / CONFIG).is_file():
            _claim(cfg, out, root)
        make_folder(out)
    skipped, spreads = Skipped(), list[float]()
    num_written = 0
    with locked("out", out):
        frames = _missing_frames(progress(files, "estimating depth", count=len(files)), root, folder, skipped)
        for batch in _batches(frames, size):
            for frame, result in zip(batch, network.each(torch.stack([frame.image for frame in batch])), strict=True):
                if isinstance(result, RoadSpreadError):
                    skipped.add(f"{frame.name}: {result}")
                    continue
                if num_written == 0:
                    _claim(cfg, out, root)
                make_folder(frame.target.parent)
                write_depth(frame.target, result.depth[0].cpu())
                num_written += 1
                spreads += [] if result.spread is None else [result.spread]
    if num_written == 0 and skipped.errors:
        raise UsageError(f"source must hold a frame whose depth can be estimated, got {skipped.errors[0]}")
    spread = f", median spread of the scale {statistics.median(spreads):.2f}" if spreads else ""
    print(f"{out}: {num_written} depth maps written, {len(skipped.errors)} frames skipped{spread}")
    if skipped.errors:
        raise SystemExit(1)


def _make_network(cfg: DictConfig) -> TransformersDepth:
    """Load the network; errors name the options of the command."""
    try:
        network = make(cfg, "model")
    except (UsageError, ImportError) as error:
        argument, must, rest = str(error).removeprefix("model: ").partition(" must ")
        named = f"{_OPTIONS.get(argument, argument)}{must}{rest}"
        raise UsageError(named if must else f"network: {argument}") from error
    if not isinstance(network, TransformersDepth):
        raise UsageError(f"model must be torchrefract.depth.from_transformers, got {type(network).__name__}")
    return network


def _claim(cfg: DictConfig, out: Path, root: Path) -> None:
    """Note the settings in the output folder; raise UsageError if its maps are of another network, road or source."""
    names = [path.name for path in matching_files(out, "*") if not path.name.startswith(".")]
    if names and CONFIG not in names:
        return  # a folder of maps of another program, of which the frames without one are estimated
    model = cast(dict[str, Any], OmegaConf.to_container(cfg.model, resolve=True))
    content = {name: value for name, value in model.items() if name not in ("device", "max_spread")}
    claim_out(out, {"source": str(root.resolve()), "model": content})


def _missing_frames(files: Iterable[Path], root: Path, folder: DepthFolder, skipped: Skipped) -> Iterator[_Frame]:
    """Yield the frames that have no map yet, or changed since; name those that cannot be read."""
    # Maps of another program may be older than copies of its frames.
    is_claimed = not is_remote(folder.root) and (folder.root / CONFIG).is_file()

    def has_map(file: Path, name: str, index: int | None = None) -> bool:
        return folder.has(name, index) and not (is_claimed and media.is_older(folder.path(name, index), file))

    for file in files:
        name = relative_name(file, root)
        try:
            if media.is_video(file):
                for index, image in read_video(file, count()):
                    if not has_map(file, name, index):
                        yield _Frame(image[0], folder.path(name, index), f"{name}#{index}")
            elif not has_map(file, name):
                yield _Frame(read_image(file), folder.path(name), name)
        except UnreadableImageError as error:
            skipped.add(str(error))


def _batches(frames: Iterator[_Frame], size: int) -> Iterator[list[_Frame]]:
    """Yield up to `size` frames in a row of one shape."""
    for _, group in groupby(frames, lambda frame: frame.image.shape):
        yield from batches(group, size)


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
        make_writable_folder(out.parent)
    chosen = _select_frames(files, max_frames)
    total = sum(len(times) for _, times in chosen)
    frames = progress(_read_frames(chosen, upright=upright), "estimating the lens", count=total)
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
    counts = [max(1, video_info(file)[0]) if media.is_video(file) else 1 for file in files]
    numbers, chosen = evenly_spaced(sum(counts), max_frames), list[tuple[Path, list[int]]]()
    for file, start, end in zip(files, accumulate([0, *counts]), accumulate(counts), strict=False):
        chosen.append((file, [number - start for number in numbers if start <= number < end]))
    return chosen


def _read_frames(chosen: Sequence[tuple[Path, list[int]]], *, upright: bool) -> Iterator[Tensor]:
    """Yield frames (1, 3, H, W) as stored, or as a viewer shows them; name and skip unreadable files."""
    num_read, skipped, size = 0, Skipped(), None
    for file, times in chosen:
        num_before = num_read
        try:
            if media.is_video(file):
                frames = (frame for _, frame in read_video(file, times, upright=upright))
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
            if len(chosen) == 1 and num_read == 0:
                raise  # `restore` names each video that it skips
            skipped.add(str(error))
    if num_read == 0:
        raise UnreadableImageError(f"input must hold a readable picture or video, got {skipped.errors[-1]}")


def _load_network(cfg: DictConfig) -> Predictor:
    """Return a function that predicts the flow of a frame by the model of a checkpoint, at the size of its training."""
    from torchrefract.restoration.checkpoints import load_model  # noqa: PLC0415 - lines alone need no training stack
    from torchrefract.restoration.tasks import Undistort  # noqa: PLC0415 - as above

    loaded, device = load_model(str(cfg.checkpoint), argument="checkpoint"), find_device(str(cfg.device))
    if loaded.task != Undistort.name:
        raise UsageError(f"checkpoint must be of the task {Undistort.name}, got {cfg.checkpoint} of {loaded.task}")
    return flow_predictor(loaded.model.to(device), loaded.size, device)
