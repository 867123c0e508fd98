"""The commands `train` and `eval`, and those that apply a model: `restore` writes pictures, `export` a program."""

import math
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning import Trainer, seed_everything
from pytorch_lightning.utilities.exceptions import MisconfigurationException
from torch import Tensor

from torchrefract._io import (
    as_path,
    file_digest,
    make_folder,
    make_writable_folder,
    matching_files,
    remove_file,
    replace_file,
)
from torchrefract._validation import UsageError, check_choice, check_count, check_flag, check_size
from torchrefract.cameras.camera import Camera
from torchrefract.cli.entry import is_first_process
from torchrefract.cli.estimation import estimate_camera, flow_predictor
from torchrefract.cli.evaluation import changed_values, describe_validation, use_validation_config
from torchrefract.cli.options import (
    check_seed,
    check_task_options,
    claim_out,
    find_device,
    make,
    naming,
    place_scene,
    read_option,
    read_optional,
)
from torchrefract.cli.progress import Skipped, batches, check_none_lost, print_warning, progress, warn_of_assumed_depth
from torchrefract.data.depth_maps import write_map
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import (
    UnreadableImageError,
    check_frame_of_camera,
    image_size,
    is_lost,
    pixels_of,
    read_image,
)
from torchrefract.data.media import (
    describe_losses,
    describe_turned,
    find_media,
    is_complete,
    is_video,
    output_name,
    write_picture,
)
from torchrefract.data.module import PairData, fingerprint, start_method
from torchrefract.data.pairs.manifest import locked
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.data.video import convert_video, video_info
from torchrefract.data.workers import exit_with_parent, num_cores
from torchrefract.restoration.checkpoints import (
    check_fits,
    check_resumed,
    check_run_folder,
    load_model,
    load_weights,
    read_checkpoint,
    stopping,
)
from torchrefract.restoration.export import FORMATS, export_model
from torchrefract.restoration.inference import LensRestorer, Restorer
from torchrefract.restoration.models.coordconv import weights_license
from torchrefract.restoration.models.lens_net import LensEncoder
from torchrefract.restoration.module import Restoration, RestorationModule
from torchrefract.restoration.pretrained import WEIGHTS_SUFFIX, find_checkpoint, write_weights
from torchrefract.restoration.tasks import Restored, Undistort
from torchrefract.warping.warp import INTERPOLATIONS

_FIRST_PROCESS = "TORCHREFRACT_FIRST_PROCESS"
_MANY_PIXELS = 1 << 22  # of road scenes, whose rendering takes longer than the start of processes


def train(cfg: DictConfig) -> None:
    """Train the model of a configuration on its data; with `ckpt_path`, resume a stopped run."""
    data, model, trainer, checkpoint = _make_parts(cfg)
    if checkpoint is None:
        check_run_folder(as_path(cfg.run_dir))
    num_epochs = check_resumed(checkpoint, config=cfg.model, path=cfg.ckpt_path) if checkpoint else 0
    with naming("trainer"):
        limit = None if trainer.max_epochs is None else check_count("max_epochs", trainer.max_epochs, low=-1)
    if num_epochs and limit is not None and -1 < limit <= num_epochs:
        raise UsageError(
            f"trainer.max_epochs must be above the {num_epochs} epochs of ckpt_path, got {limit}; eval scores a "
            "training that is complete"
        )
    changed = changed_values(cfg, checkpoint, ignored=("workers", "pretrained")) if checkpoint else []
    if checkpoint and checkpoint.get("processes", trainer.world_size) != trainer.world_size:
        changed.append("the number of processes")
    if changed and trainer.is_global_zero:
        print_warning(f"the training continues with other values than before of {', '.join(changed)}")
    initial = None if cfg.init_from is None else find_checkpoint(str(cfg.init_from))
    licenses = initial and load_weights(model, initial, task=model.task.name, config=cfg.model)
    model.origin = _origin(cfg, data, initial_licenses=licenses) | {"processes": trainer.world_size}
    _save_config(cfg, trainer)
    run = as_path(cfg.run_dir)
    with locked("run_dir", run) if trainer.is_global_zero else nullcontext():
        if trainer.is_global_zero:
            _remove_incomplete({run} if cfg.ckpt_path is None else {run, as_path(cfg.ckpt_path).parent}, run)
        _render_scenes(data)
        with stopping(trainer, run / "last.ckpt"):
            trainer.fit(model, data, ckpt_path=cfg.ckpt_path, weights_only=True)
    if trainer.global_step == 0 and trainer.max_epochs != 0:  # 0 writes the configuration alone
        raise UsageError("trainer must make a step, got none; raise its max_steps, max_time or limit_train_batches")


def _render_scenes(data: PairData) -> None:
    """Render road scenes on all cores before the training, whose single worker would take longer."""
    if not data.workers or start_method() != "fork":  # other workers would not have them
        return
    for scenes in (data.train, data.val):
        if isinstance(scenes, RoadScenes) and scenes.num_kept * math.prod(scenes.size) > _MANY_PIXELS:
            numbers = scenes.render(processes=num_cores())
            deque(progress(numbers, "road scenes", count=scenes.num_kept), maxlen=0)  # renders them all


def _remove_incomplete(folders: Iterable[Path], locked_folder: Path) -> None:
    """Remove the checkpoints that killed runs left incomplete in folders, unless another run uses the folder."""
    for folder in folders:
        with suppress(UsageError, OSError), nullcontext() if folder == locked_folder else locked("ckpt_path", folder):
            for path in matching_files(folder, ".*.ckpt"):
                remove_file(path)


def evaluate(cfg: DictConfig) -> None:
    """Score a checkpoint, by default on the data that it was validated on."""
    path = find_checkpoint(str(cfg.ckpt_path))
    checkpoint = read_checkpoint(path, task=str(HydraConfig.get().runtime.choices["task"]))
    changed = use_validation_config(cfg, checkpoint, list(HydraConfig.get().overrides.task), path)
    data, model, trainer, _ = _make_parts(cfg)
    _save_config(cfg, trainer)
    if trainer.is_global_zero:
        print(f"scoring {path} on {describe_validation(data, cfg, changed)}", flush=True)
    with stopping(trainer):
        trainer.validate(model, data, ckpt_path=str(path), verbose=False, weights_only=True)


def restore(cfg: DictConfig) -> None:
    """Restore all pictures and videos of a folder that are not restored yet; print their number and the rate."""
    source, out = Path(str(cfg.input)), Path(str(cfg.out))
    files = find_media(source, out=out, deep=True)
    job = _make_job(cfg, source if source.is_dir() else source.parent, out)
    if job.deviation:
        _check_maps(files, job)
    with naming("out"):
        claim_out(out, _settings(cfg, job))
    with locked("out", out):
        if cfg.pool == "lens":
            job = job.with_one_lens(files, out / "camera.yaml")
        _restore_missing(files, job)


def _restore_missing(files: Sequence[Path], job: "_Job") -> None:
    todo = [file for file in files if not job.is_done(file)]
    for loss in describe_losses(todo, upright=True):
        print_warning(loss)
    start = time.perf_counter()
    skipped = Skipped()
    num_frames = _restore_pictures([file for file in todo if not is_video(file)], job, skipped)
    num_frames += sum(_restore_video(file, job, skipped) for file in todo if is_video(file))
    rate = num_frames / (time.perf_counter() - start)
    counts = skipped.summarize("restored", total=len(files), existing=len(files) - len(todo))
    print(f"{job.out}: {counts}")
    if deviations := job.restorer.deviations:
        print(f"standard deviation of the flow: {median(deviations):.1f} px, root mean square, median of the frames")
    print(f"{num_frames} frames, {rate:.3g} frames a second on {job.device}")
    check_none_lost(skipped.lost)


def export(cfg: DictConfig) -> None:
    """Export the model of a checkpoint; print how much the file differs from the model."""
    out, loaded = Path(str(cfg.out)), load_model(str(cfg.ckpt_path))
    with naming("out"):
        check_choice("out", out.suffix, (*FORMATS, WEIGHTS_SUFFIX))
        make_writable_folder(out.parent)
    if out.suffix == WEIGHTS_SUFFIX:
        write_weights(read_checkpoint(find_checkpoint(str(cfg.ckpt_path))), out)
        print(f"{out}: weights of {loaded.name} for {loaded.task} in half precision, {out.stat().st_size / 1e6:.2f} MB")
        return
    if not isinstance(loaded.model, Restoration):
        raise UsageError(
            f"ckpt_path must be of a model that restores in a single pass, got {cfg.ckpt_path} of {loaded.name}"
        )
    height, width = loaded.size if cfg.size is None else _parse_size(str(cfg.size))
    interpolation = read_option(cfg, "interpolation", check_choice, choices=INTERPOLATIONS)
    with naming("out"), locked("out", out.parent, out.name):
        errors = export_model(loaded, out, size=(height, width), interpolation=interpolation)
    differences = ", ".join(f"{name} {error:.1e}" for name, error in errors.items())
    print(
        f"{out}: {loaded.name} for {loaded.task}, frames of {height}x{width}, any batch size; "
        f"largest difference from the model: {differences}"
    )


def _make_parts(cfg: DictConfig) -> tuple[PairData, RestorationModule, Trainer, dict[str, Any] | None]:
    """Instantiate data, model and trainer, check that they fit together, and read the checkpoint at `ckpt_path`."""
    OmegaConf.resolve(cfg)
    check_task_options(cfg)
    camera = _place_scene(cfg)
    seed_everything(check_seed(cfg.seed), workers=True, verbose=False)
    path = None if cfg.ckpt_path is None else find_checkpoint(cfg.ckpt_path)
    checkpoint = path and read_checkpoint(path, task=str(HydraConfig.get().runtime.choices["task"]))
    with warnings.catch_warnings():
        if not is_first_process():
            warnings.simplefilter("ignore", UserWarning)  # those of the first process, which reads the same files
        data, model = make(cfg, "data"), make(cfg, "model")
    if camera is not None:
        _check_camera(camera, data)
    try:
        trainer = make(cfg, "trainer")
    except (MisconfigurationException, ModuleNotFoundError) as error:
        name = HydraConfig.get().runtime.choices["logger"]
        if isinstance(error, MisconfigurationException) or name == "csv":
            raise UsageError(f"trainer: {error}") from error
        raise UsageError(f"logger={name} needs its package: pip install 'torchrefract[loggers]'") from error
    if is_first_process():
        os.environ[_FIRST_PROCESS] = str(os.getpid())  # for those that Lightning starts on this machine
    elif first := os.environ.get(_FIRST_PROCESS):
        exit_with_parent(int(first))
    # Lightning starts the processes of other runs itself.
    processes = int(os.environ.get("WORLD_SIZE") or trainer.world_size)
    if processes != trainer.world_size:
        devices = int(os.environ.get("LOCAL_WORLD_SIZE", processes))
        nodes = "" if devices == processes else f" and trainer.num_nodes={processes // devices}"
        raise UsageError(
            f"trainer must be ddp with trainer.devices={devices}{nodes} under torchrun, got one that uses "
            f"{trainer.world_size} of {processes} processes"
        )
    has_no_depth = isinstance(data.train, FrameFolder) and data.train.depth is None
    if has_no_depth and data.effect is not None and trainer.is_global_zero:
        warn_of_assumed_depth(data.effect, option="data.depth")
    with naming("data"):
        data.check_ranks(trainer.world_size)
        data.check_pair()
    if path and checkpoint:
        check_fits(checkpoint, model, path, config=cfg.model)
    return data, model, trainer, checkpoint


def _place_scene(cfg: DictConfig) -> Camera | None:
    """Give the scene the camera and the horizon of the options; return the camera of the frames in the files."""
    if cfg.camera is None and cfg.horizon is None:
        return None
    if not (cfg.data.get("root") and "effect" in cfg.data):
        raise UsageError("camera and horizon must be those of frames in a folder, data=frames, got other data")
    camera = place_scene(cfg, size=cfg.data.get("size"))
    cfg.data.effect = cfg.scene
    return camera


def _check_camera(camera: Camera, data: PairData) -> None:
    """Raise UsageError if the first frame of a drive has another shape than the camera; warn if a tag turns it."""
    for frames in (data.train, data.val):
        assert isinstance(frames, FrameFolder)  # as `_place_scene` checked
        first = [*dict(zip(reversed(frames.drive_names), reversed(frames.paths), strict=True)).values()]
        for frame in first:
            height, width = image_size(frame)
            check_frame_of_camera(camera, str(frame), height=height, width=width)
        if (turned := describe_turned(first, upright=True)) and is_first_process():
            print_warning(turned)


def _save_config(cfg: DictConfig, trainer: Trainer) -> None:
    if trainer.is_global_zero:
        with naming("run_dir"):
            run = as_path(cfg.run_dir)
            make_folder(run)
            with replace_file(run / "config.yaml") as temporary:
                OmegaConf.save(cfg, temporary)


def _origin(cfg: DictConfig, data: PairData, *, initial_licenses: Any) -> dict[str, Any]:
    """Return what a checkpoint holds of its origin: configuration, training data, and licenses by source."""
    source, network = fingerprint(data.train), cfg.model.network
    weights = weights_license(network.encoder) if "encoder" in network and network.get("pretrained") else None
    licenses = {"data": source["license"], "pretrained weights": weights}
    if cfg.init_from is not None:
        licenses[f"initial weights, {cfg.init_from}"] = initial_licenses
    return {"config": OmegaConf.to_container(cfg, enum_to_str=True), "data": source, "licenses": licenses}


class _Job(NamedTuple):
    """The options of a restoration."""

    restorer: Restorer
    restore_images: Callable[[Sequence[Tensor]], list[Restored]]  # by the restorer, or by the lens of all frames
    pools_videos: bool  # each video has one lens
    source: Path  # outputs are named by the path of a file relative to this folder
    out: Path
    batch: int
    side_by_side: bool
    deviation: bool
    device: torch.device

    def target(self, file: Path) -> Path:
        return self.out / output_name(file).relative_to(self.source)

    def map_target(self, file: Path) -> Path:
        return self.target(file).with_suffix(".deviation.png")

    def is_done(self, file: Path) -> bool:
        has_map = not self.deviation or is_complete(file, self.map_target(file))
        return has_map and is_complete(file, self.target(file), num_columns=1 + self.side_by_side)

    def with_one_lens(self, files: Sequence[Path], camera: Path) -> "_Job":
        """Estimate one lens for files of one camera, write the camera, and return a job that restores by it."""
        predict = flow_predictor(self.restorer.model, self.restorer.size, self.device)
        lens = estimate_camera(files, camera, predict=predict, upright=True)
        return self._replace(restore_images=LensRestorer(lens, interpolation=self.restorer.interpolation).restore)

    def restore(self, images: Sequence[Tensor]) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Restore images (3, H, W) in [0, 1]; also yield the deviation of the flow, (H, W), px, or None.

        `side_by_side` puts the image to the left of its restoration.
        """
        moved = [image.to(self.device).contiguous() for image in images]
        for before, restored in zip(moved, self.restore_images(moved), strict=True):
            after, deviations = restored.image[0], restored.deviation
            deviation = None if deviations is None else deviations[0].norm(dim=0)
            yield torch.cat([before, after], dim=2) if self.side_by_side else after, deviation


def _make_job(cfg: DictConfig, source: Path, out: Path) -> _Job:
    batch = read_option(cfg, "batch", check_count)
    side_by_side, deviation = (read_option(cfg, name, check_flag) for name in ("side_by_side", "deviation"))
    device = find_device(str(cfg.device))
    loaded = load_model(str(cfg.ckpt_path), changes=cfg.model)
    if deviation and (cfg.pool == "lens" or not loaded.model.has_deviation):
        raise UsageError(
            "deviation must be false for pool=lens, whose deviation is printed, and for any model but ddpm with at "
            f"least two samples, got true for {loaded.name}"
        )
    size = read_optional(cfg, "size", check_size) or loaded.size
    with naming("tile"):
        sides = (cfg.tile, cfg.tile) if isinstance(cfg.tile, int) else cfg.tile
        tile = None if sides is None else check_size("tile", sides)
    if tile is not None and loaded.task == Undistort.name:
        raise UsageError(f"tile must be null for {loaded.task}, whose model needs the complete frame, got {cfg.tile}")
    if tile is not None and cfg.size is not None:
        raise UsageError(f"size must be null beside tile, which has the resolution of the frame, got {cfg.size}")
    if cfg.pool not in (None, "auto", "lens") or (cfg.pool == "lens" and loaded.task != Undistort.name):
        raise UsageError(
            f"pool must be auto, null, or lens for the task {Undistort.name}, got {cfg.pool} for {loaded.task}"
        )
    with naming("interpolation"):
        restorer = Restorer(loaded.model.to(device), size=size, tile=tile, interpolation=cfg.interpolation, batch=batch)
    # Other networks of this task find warps that change from frame to frame, too.
    pools_videos = cfg.pool == "auto" and any(isinstance(part, LensEncoder) for part in loaded.model.modules())
    return _Job(restorer, restorer.restore, pools_videos, source, out, batch, side_by_side, deviation, device)


def _check_maps(files: Sequence[Path], job: _Job) -> None:
    """Raise UsageError if a file is a video, or if the map of a picture would replace another file."""
    owners = {job.target(file): file for file in files}
    for file in files:
        if is_video(file):
            raise UsageError(f"deviation must be false for videos, got true with {file}: save its frames as files")
        path = job.map_target(file)
        if path in owners:
            raise UsageError(
                f"deviation must have a name for each map, got {owners[path]} and {file}, which both need {path}: give "
                "the pictures names that differ in more than their extension"
            )
        owners[path] = file


def _settings(cfg: DictConfig, job: _Job) -> dict[str, Any]:
    """Return everything that decides the output, so that a folder is only continued with the same settings."""
    return {
        "checkpoint": file_digest(find_checkpoint(str(cfg.ckpt_path))),
        "input": str(job.source.resolve()),
        "size": list(job.restorer.size),
        "tile": job.restorer.tile and list(job.restorer.tile),
        "interpolation": job.restorer.interpolation,
        "side_by_side": job.side_by_side,
        "pool": cfg.pool,
        "model": OmegaConf.to_container(cfg.model),
    }


def _restore_pictures(files: Sequence[Path], job: _Job, skipped: Skipped) -> int:
    """Restore pictures and return their number, without the unreadable ones."""
    count = 0
    for chunk in batches(progress(files, "restoring", count=len(files)), job.batch):
        images = dict[Path, Tensor]()
        for file in chunk:
            try:
                images[file] = read_image(file)
            except UnreadableImageError as error:
                skipped.add(str(error), is_lost=is_lost(error))
        restored = job.restore([*images.values()]) if images else ()
        for file, (image, deviation) in zip(images, restored, strict=True):
            target = job.target(file)
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with replace_file(target, alone=True) as path:
                    write_picture(image, path, source=file)
                if job.deviation and deviation is not None:
                    write_map(job.map_target(file), deviation)
                count += 1
            except UnreadableImageError as error:  # the file vanished after it was read
                skipped.add(str(error), is_lost=is_lost(error))
    return count


def _restore_video(file: Path, job: _Job, skipped: Skipped) -> int:
    """Restore a video and return the number of its frames; 0 for an unreadable one."""

    def change(frames: Iterable[Tensor]) -> Iterator[np.ndarray]:
        num_frames = video_info(file)[0]
        for chunk in batches(progress(frames, f"restoring {file.name}", count=num_frames), job.batch):
            yield from (pixels_of(image) for image, _ in job.restore([frame[0] for frame in chunk]))

    target = job.target(file)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        if job.pools_videos:
            job = job.with_one_lens([file], target.with_suffix(".camera.yaml"))
        with replace_file(target, alone=True) as path:
            return convert_video(file, path, change=change)
    except UnreadableImageError as error:
        skipped.add(str(error), is_lost=is_lost(error))
        return 0


def _parse_size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and int(side) > 0 for side in sides):
        raise UsageError(f"size must be HEIGHTxWIDTH, such as 720x1280, got {text}")
    return int(sides[0]), int(sides[1])
