"""Restore pictures and videos: `python -m torchrefract.restore ckpt_path=<run>/best.ckpt input=DIR out=DIR`."""

import hashlib
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_count, check_flag, check_size
from torchrefract.cli.command import as_they_are, command, job, naming, progress
from torchrefract.data.images import UnreadableImageError, pixels_of, read_image
from torchrefract.data.pairs.manifest import claim
from torchrefract.footage import (
    check_apart,
    find_footage,
    is_video,
    is_written,
    write_frames,
    write_picture,
    written_as,
)
from torchrefract.restoration.loading import load_model
from torchrefract.restoration.restorer import Restorer
from torchrefract.restoration.tasks import Undistort
from torchrefract.videos import video_facts

_T = TypeVar("_T")


class _Asked(NamedTuple):
    """What is asked for."""

    restorer: Restorer
    source: Path  # the folder that files are named from
    out: Path
    batch: int
    side_by_side: bool
    device: torch.device

    def target(self, file: Path) -> Path:
        """Where what comes of a file is written."""
        return self.out / written_as(file).relative_to(self.source)

    def is_done(self, file: Path) -> bool:
        """Whether that is there."""
        return is_written(file, self.target(file), beside=1 + self.side_by_side)

    def restored(self, images: Sequence[Tensor]) -> Iterator[np.ndarray]:
        """Images (3, H, W) in [0, 1] as they are written: (H, W, 3), uint8, RGB."""
        there = [image.to(self.device).contiguous() for image in images]
        for before, after in zip(there, self.restorer(there), strict=True):
            shown = torch.cat([before, after], dim=2) if self.side_by_side else after
            yield pixels_of(shown)


@command("restore", prepare=as_they_are)
@hydra.main(config_path=CONFIG_DIR, config_name="restore", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Restore what is not there yet."""
    source, out = Path(str(cfg.input)), Path(str(cfg.out))
    files = find_footage(source, deep=True)
    check_apart(out, source, deep=True)
    asked = _asked(cfg, source if source.is_dir() else source.parent, out)
    with naming("out"):
        claim(out, _settings(cfg, asked), count=0, about={})
    todo = [file for file in files if not asked.is_done(file)]
    start = time.perf_counter()
    failed, frames = dict[Path, str](), 0
    for restore, some in ((_pictures, False), (_videos, True)):
        frames += restore([file for file in todo if is_video(file) is some], asked, failed)
    if len(failed) == len(files):
        raise UsageError(f"input must hold what can be restored, got {next(iter(failed.values()))}")
    rate = frames / (time.perf_counter() - start)
    made, there = len(todo) - len(failed), len(files) - len(todo)
    print(f"{out}: {made} restored, {there} were there already, {len(failed)} skipped")
    print(f"{frames} frames, {rate:.3g} frames a second on {asked.device}")


def _asked(cfg: DictConfig, source: Path, out: Path) -> _Asked:
    with naming("batch"):
        batch = check_count("batch", cfg.batch)
    with naming("side_by_side"):
        side_by_side = check_flag("side_by_side", cfg.side_by_side)
    device = _device(str(cfg.device))
    loaded = load_model(Path(str(cfg.ckpt_path)), changes=cfg.model)
    with naming("size"):
        size = loaded.size if cfg.size is None else check_size("size", cfg.size)
    with naming("tile"):
        tile = None if cfg.tile is None else _tile(cfg.tile)
    if tile is not None and loaded.task == Undistort.name:
        raise UsageError(f"tile must be null for {loaded.task}, whose model must see the whole frame, got {cfg.tile}")
    with naming("interpolation"):
        options = {"tile": tile, "interpolation": cfg.interpolation, "batch": batch}
        restorer = Restorer(loaded.model.to(device), size=size, **options)
    return _Asked(restorer, source, out, batch, side_by_side, device)


def _tile(tile: Any) -> tuple[int, int]:
    return check_size("tile", (tile, tile) if isinstance(tile, int) else tile)


def _device(name: str) -> torch.device:
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # a build without CUDA asserts
        raise UsageError(f"device must be auto, cpu or one that torch finds here, got {name}") from error
    return device


def _settings(cfg: DictConfig, asked: _Asked) -> dict[str, Any]:
    """All that decides what is written; a folder of other settings is not gone on with."""
    with Path(str(cfg.ckpt_path)).open("rb") as stream:
        checkpoint = hashlib.file_digest(stream, "sha256").hexdigest()
    restorer = asked.restorer
    return {
        "checkpoint": checkpoint,
        "input": str(asked.source.resolve()),
        "size": list(restorer.size),
        "tile": restorer.tile and list(restorer.tile),
        "interpolation": restorer.interpolation,
        "side_by_side": asked.side_by_side,
        "model": OmegaConf.to_container(cfg.model),
    }


def _pictures(files: Sequence[Path], asked: _Asked, failed: dict[Path, str]) -> int:
    """Restore pictures; returns how many."""
    made = 0
    for some in _batches(progress(files, "restoring", count=len(files)), asked.batch):
        read = dict(_read(some, failed))
        for file, pixels in zip(read, asked.restored([*read.values()]) if read else (), strict=True):
            target = asked.target(file)
            target.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(target) as path:
                write_picture(pixels, path)
            made += 1
    return made


def _read(files: Sequence[Path], failed: dict[Path, str]) -> Iterator[tuple[Path, Tensor]]:
    for file in files:
        try:
            yield file, read_image(file)
        except UnreadableImageError as error:
            _skip(file, error, failed)


def _videos(files: Sequence[Path], asked: _Asked, failed: dict[Path, str]) -> int:
    """Restore videos; returns how many frames."""
    made = 0
    for file in files:
        target = asked.target(file)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            made += _video(file, target, asked)
        except UnreadableImageError as error:
            _skip(file, error, failed)
    return made


def _video(file: Path, target: Path, asked: _Asked) -> int:
    total = video_facts(file)[0]

    def change(frames: Iterable[Tensor]) -> Iterator[np.ndarray]:
        for some in _batches(progress(frames, f"restoring {file.name}", count=total), asked.batch):
            yield from asked.restored([frame[0] for frame in some])

    with replace_file(target) as path:
        return write_frames(file, path, change=change)


def _skip(file: Path, error: UnreadableImageError, failed: dict[Path, str]) -> None:
    failed[file] = str(error)
    print(f"skipped: {error}", file=sys.stderr)


def _batches(items: Iterable[_T], size: int) -> Iterator[list[_T]]:
    rest = iter(items)
    while some := list(islice(rest, size)):
        yield some


if __name__ == "__main__":
    main()
