"""Options of the commands as values: numbers, paths, devices, scenes, and how the frames were taken."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

import torchrefract
from torchrefract._io import as_path, file_digest, is_remote
from torchrefract._validation import UsageError, check_count, check_number, check_positive
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_camera
from torchrefract.cli.progress import print_warning
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.images import UnreadableImageError, center_crop
from torchrefract.data.pairs.configuration import claim
from torchrefract.data.pairs.files import DamagedPairError
from torchrefract.data.workers import num_cores
from torchrefract.effects.base import Effect

_T = TypeVar("_T")

FILE_ERRORS = (UnreadableImageError, DamagedPairError)  # their messages name the file
_NUM_SEEDS = 2**32  # NumPy's limit
# Options of tasks, and what they set.
_OF_TASKS = {"frame_size": "data.size", "train_scenes": "data.train_count", "epochs": "trainer.max_epochs"}
_BEST = dict.fromkeys(("psnr", "psnr_seen", "ssim"), "max") | dict.fromkeys(("loss", "L", "L_rec", "L_k", "epe"), "min")
_VERSIONS = {"torchrefract": torchrefract.__version__, "torch": torch.__version__}
_VERSIONS |= {"numpy": np.__version__, "opencv": cv2.__version__}
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Turn errors of values inside the block into UsageError, with the name of a part of the configuration.

    Errors of files and missing modules stay as they are, since they name the file, and `command` the extra.
    """
    try:
        yield
    except (*FILE_ERRORS, ModuleNotFoundError):
        raise
    except (ValueError, TypeError, OSError, ImportError) as error:
        if isinstance(error, OSError) and error.filename:
            condition = "exists" if isinstance(error, FileNotFoundError) else "can be read or written"
            raise UsageError(f"{part} must name what {condition}, got {error.filename}: {error.strerror}") from error
        is_named = str(error).startswith(f"{part} must ")
        raise UsageError(str(error) if is_named else f"{part}: {error}") from error


def read_option(cfg: DictConfig, name: str, check: Callable[..., _T], **limits: Any) -> _T:
    """Return the value of an option, as `check(name, value, **limits)` does; its errors become UsageError."""
    with naming(name):
        return check(name, cfg[name], **limits)


def read_optional(cfg: DictConfig, name: str, check: Callable[..., _T], **limits: Any) -> _T | None:
    """Return the value of an option as `read_option` does, or None if it is null."""
    return None if cfg[name] is None else read_option(cfg, name, check, **limits)


def read_workers(cfg: DictConfig) -> int:
    """Return the number of processes; null is one for each core.

    Raises:
        UsageError: processes would share a path in memory://.
    """
    workers = read_optional(cfg, "workers", check_count, low=0)
    workers = num_cores() if workers is None else workers
    for name in ("out", "source", "depth"):
        if workers and str(cfg[name]).startswith("memory://"):
            raise UsageError(
                f"workers must be 0 for {name}={cfg[name]}, because each process has its memory, got {workers}"
            )
    return workers


def read_path(cfg: DictConfig, name: str) -> Path:
    """Return the path or the address that an option gives, see `as_path`."""
    with naming(name):
        return as_path(str(cfg[name]))


def check_seed(seed: Any, *, end: int = _NUM_SEEDS) -> int:
    """Return `seed` if it is a whole number from 0 and below `end`, so that NumPy and PyTorch accept it."""
    if not isinstance(seed, int) or not 0 <= seed < end:
        raise UsageError(f"seed must be a whole number from 0 to {end - 1}, got {seed}")
    return seed


def check_task_options(cfg: DictConfig) -> None:
    """Raise UsageError if an option of a task has no effect, or if `best.mode` would keep the worst epoch."""
    given = {override.partition("=")[0] for override in HydraConfig.get().overrides.task}
    for name, place in _OF_TASKS.items():
        value = OmegaConf.select(cfg, place)
        if name in given and cfg.get(name) != value:
            got = f"{cfg.get(name)} and {'none' if value is None else value}"
            raise UsageError(f"{name} must be that of {place}, which decides, got {got}; leave {name} out")
    score, mode = str(cfg.best.monitor).removeprefix("val/"), cfg.best.mode
    if score in _BEST and mode != _BEST[score]:
        best = "highest" if mode == "min" else "lowest"
        raise UsageError(
            f"best.mode must be {_BEST[score]} for {cfg.best.monitor}, of which the best is the {best}, got {mode}"
        )


def find_device(name: str) -> torch.device:
    """Return a device by its name; "auto" is a GPU if there is one."""
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch asserts in builds without CUDA
        raise UsageError(f"device must be auto, cpu or another device of this machine, got {name}") from error
    return device


def file_digests(values: Iterable[Any]) -> dict[str, str] | None:
    """Return the SHA-256 digests of the files that are among the values of options, by path; None without any."""
    paths = [value for value in values if isinstance(value, str) and os.path.isfile(value)]
    return {path: file_digest(Path(path)) for path in paths} or None


def make(cfg: DictConfig, part: str) -> Any:
    """Instantiate a part of a configuration."""
    with naming(part):
        try:
            return instantiate(cfg[part])
        except InstantiationException as error:
            raise error.__cause__ or error from None


def make_effect(cfg: DictConfig, part: str) -> Effect:
    """Instantiate a part of a configuration that must be an effect."""
    effect = make(cfg, part)
    if not isinstance(effect, Effect):
        raise UsageError(f"{part} must be an effect of torchrefract, got {effect}")
    return effect


def depth_folder(cfg: DictConfig) -> DepthFolder | None:
    """Return the folder of depth maps that the options `depth` and `depth_scale` give; None without one."""
    if cfg.depth is None:
        return None
    return DepthFolder(read_path(cfg, "depth"), read_option(cfg, "depth_scale", check_positive))


def read_place(cfg: DictConfig) -> dict[str, Any]:
    """Return the arguments of scenes that the options `camera=` and `horizon=` give: a `Camera` and a number."""
    place: dict[str, Any] = {}
    if cfg.camera is not None:
        with naming("camera"):
            place["camera"] = read_camera(Path(str(cfg.camera)).expanduser())
    if cfg.horizon is not None:
        place["horizon"] = read_option(cfg, "horizon", check_number, low=-10, high=10)  # as the effects
    return place


def place_scene(cfg: DictConfig, *, size: Sequence[int] | None = None) -> Camera | None:
    """Write the camera, by its numbers, and the horizon that options give into the configuration of the scene.

    Args:
        cfg: has `scene`, `camera` and `horizon`; the scene changes.
        size: (height, width) to which the command crops and reduces frames, as `fit` does; the camera that the scene
            gets is that of the cropped frames.

    Returns:
        The camera of the frames as they are stored; None if none is given.

    Raises:
        UsageError: there is no scene, or it takes no such argument.
    """
    place = read_place(cfg)
    name = HydraConfig.get().runtime.choices.get("scene")
    for option in place:
        if cfg.scene is None or option not in cfg.scene:
            raise UsageError(
                f"{option} must be given with a scene that takes it, got scene={name}; leave {option} out, or choose "
                "another scene"
            )
    camera: Camera | None = place.get("camera")
    if camera is not None:
        if size is not None:
            top, left, height, width = center_crop((camera.height, camera.width), size)
            place["camera"] = camera.cropped(left=left, top=top, width=width, height=height)
        place["camera"] = {"_target_": "torchrefract.Camera"} | asdict(place["camera"])
    for option, value in place.items():
        cfg.scene[option] = value
    return camera


def claim_out(
    out: Path, settings: Mapping[str, Any], *, about: Mapping[str, Any] | None = None, **options: Any
) -> None:
    """Claim an output folder as `claim` does, and note the versions of the libraries; warn if others made its files."""
    previous = claim(out, settings, about={**(about or {}), "made_with": _VERSIONS}, **options)
    if (versions := previous.get("made_with", _VERSIONS)) != _VERSIONS:
        print_warning(
            f"the files in {out} were made with {_names(versions)}, further ones are made with {_names(_VERSIONS)}: "
            "they may differ"
        )


def _names(versions: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())


@contextmanager
def source_and_out(cfg: DictConfig) -> Iterator[tuple[Path, Path]]:
    """Yield the paths or addresses of the options `source` and `out`; errors of a store for `out` become one line."""
    source, out = read_path(cfg, "source"), read_path(cfg, "out")
    with disk_errors(out) if is_remote(out) else nullcontext():
        yield source, out


@contextmanager
def disk_errors(out: Path) -> Iterator[None]:
    """Turn errors of the disk into messages for the user; files that are written stay."""
    try:
        yield
    except BrokenPipeError:  # of the standard output
        raise
    except OSError as error:
        if error.errno in _DISK_FULL:
            raise UsageError(
                f"out must have enough space, got {os.strerror(error.errno).lower()} for {error.filename or out}; "
                "existing files are complete, and the same command continues"
            ) from error
        raise UsageError(
            f"out must be a folder that can be written to, got {out} ({error.strerror or error})"
        ) from error
