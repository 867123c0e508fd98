"""The command that writes pairs to disk: its options, its output folder, its progress and its last line."""

import errno
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import cv2
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from torchrefract._io import replace_file
from torchrefract._validation import (
    UsageError,
    check_choice,
    check_count,
    check_flag,
    check_number,
    check_positive,
    check_size,
)
from torchrefract.cli.command import check_seed, make, naming, warn_of_assumed_depth
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.frames import first_names
from torchrefract.data.pairs.card import HISTOGRAMS, draw_histograms, format_card, summarize
from torchrefract.data.pairs.files import FORMATS
from torchrefract.data.pairs.generator import (
    PairGenerator,
    PairStorage,
    PairTask,
    SourceReader,
    Sources,
    find_sources,
    generate_pairs,
)
from torchrefract.data.pairs.manifest import Manifest, PairRow, claim, find_manifests, locked_shard, scan_rows
from torchrefract.data.workers import num_cores
from torchrefract.effects.base import Effect

_T = TypeVar("_T")

_SAMPLES = 4  # pairs that the estimate of the size on disk rests on
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_SEED_END = 2**31  # a seed is shifted by 32 bits, and must then fit 64 bits with a sign
_VERSIONS = {"torch": torch.__version__, "numpy": np.__version__, "opencv": cv2.__version__}
_MESSAGE_INTERVAL = 60.0  # seconds


class Shard(NamedTuple):
    """One of several jobs that write a set together."""

    number: int
    total: int

    def units(self, num_pairs: int, size: int) -> Iterator[range]:
        """Yield the numbers of the pairs of each unit of this shard; units hold `size` pairs."""
        for start in range(self.number * size, num_pairs, self.total * size):
            yield range(start, min(start + size, num_pairs))

    def holds(self, number: int, num_pairs: int, size: int) -> bool:
        """Return True if a pair of the set belongs to this shard."""
        return number < num_pairs and number // size % self.total == self.number


class Options(NamedTuple):
    """The parsed configuration."""

    generator: PairGenerator
    sources: Sources
    settings: dict[str, Any]  # everything that determines the content of the files
    num_pairs: int
    license: str
    shard: Shard
    workers: int
    verify: bool

    def task(self, number: int) -> PairTask:
        """Return the task of a pair."""
        repeat, index = divmod(number, len(self.sources.frames))
        return PairTask(number, self.sources.frames[index], repeat)


def generate(cfg: DictConfig) -> None:
    """Write the missing pairs of a shard, and the card when the set is complete."""
    options, out = _parse(cfg), Path(str(cfg.out))
    with _disk_errors(out):
        about = {"license": options.license, "made_with": _VERSIONS}
        previous = claim(out, options.settings, count=options.num_pairs, about=about).get("made_with", _VERSIONS)
        if previous != _VERSIONS:
            print(f"existing pairs were made with {previous}, new ones are made with {_VERSIONS}: bytes may differ")
        with locked_shard(out, *options.shard):
            num_made = _make_missing(options, out)
        _finish(options, out, num_made=num_made)


def _make_missing(options: Options, out: Path) -> int:
    """Write the missing pairs of a shard; return their number."""
    storage = PairStorage(out, options.settings["tar"])
    manifest = Manifest(out, *options.shard)
    complete, damaged = manifest.open(
        lambda number: options.shard.holds(number, options.num_pairs, storage.unit), verify=options.verify
    )
    _report(options, complete, damaged)
    units = [u for u in options.shard.units(options.num_pairs, storage.unit) if not complete.issuperset(u)]
    if units:
        _check_disk(options, [number for unit in units for number in unit], storage)
        tasks = ([options.task(number) for number in unit] for unit in units)
        rows = generate_pairs(tasks, options.generator, storage, workers=min(options.workers, len(units)))
        for unit in _with_progress(rows, total=sum(map(len, units))):
            manifest.add(unit)
    manifest.close()
    return sum(map(len, units))


def _parse(cfg: DictConfig) -> Options:
    effect = make(cfg, "scene")
    if not isinstance(effect, Effect):
        raise UsageError(f"scene must be an effect of torchrefract, got {effect}")
    if check_seed(cfg.seed) >= _SEED_END:
        raise UsageError(f"seed must be below {_SEED_END}, got {cfg.seed}")
    plain: dict[str, Any] = {
        "seed": cfg.seed,
        "maps": _checked(cfg, "maps", check_choice, choices=FORMATS),
        "drive_by": _checked(cfg, "drive_by", check_choice, choices=("auto", "folder", "prefix")),
        "size": None if cfg.size is None else _checked(cfg, "size", check_size),
        "tar": None if cfg.tar is None else _checked(cfg, "tar", check_count),
        "every": _checked(cfg, "every", check_count),
        "val_share": _checked(cfg, "val_share", check_number),
    }
    if not 0 < plain["val_share"] < 1:
        raise UsageError(f"val_share must be between 0 and 1, got {plain['val_share']}")
    verify, shard, workers = _checked(cfg, "verify", check_flag), _shard(cfg), _workers(cfg)
    source = Path(str(cfg.source)).expanduser()
    if Path(str(cfg.out)).resolve().is_relative_to(source.resolve()):
        raise UsageError(f"out must lie outside of source, so that pairs do not become sources, got {cfg.out}")
    with naming("source"):
        options = {name: plain[name] for name in ("size", "every", "drive_by", "val_share", "seed")}
        sources = find_sources(source, **options)
    num_pairs = len(sources.frames) if cfg.count is None else _checked(cfg, "count", check_count)
    sources = sources.limited(num_pairs)
    depth = None
    if cfg.depth is not None:
        depth = DepthFolder(Path(str(cfg.depth)).expanduser(), _checked(cfg, "depth_scale", check_positive))
        plain |= {"depth": sources.depth_digest(depth), "depth_scale": depth.scale}
    if not str(cfg.license or "").strip():
        raise UsageError("license must be that of the source, in words, got nothing")
    scene: dict[str, Any] = {"name": str(HydraConfig.get().runtime.choices["scene"])}
    scene |= cast(dict[str, Any], OmegaConf.to_container(cfg.scene, resolve=True))
    reader = SourceReader(sources.root, plain["size"], depth)
    generator = PairGenerator(effect, scene["name"], reader, cfg.seed, plain["maps"])
    settings = {"scene": scene, **plain, "frames": len(sources.frames), "sources": sources.digest()}
    return Options(generator, sources, settings, num_pairs, str(cfg.license), shard, workers, verify)


def _checked(cfg: DictConfig, name: str, check: Callable[..., _T], **limits: Any) -> _T:
    with naming(name):
        return check(name, cfg[name], **limits)


def _shard(cfg: DictConfig) -> Shard:
    """Return the shard of the options, by default torchrun's rank."""
    if (cfg.shard is None) != (cfg.shards is None):
        raise UsageError(f"shard must be given together with shards, got {cfg.shard} of {cfg.shards}")
    with naming("shard"):
        rank, world = (int(os.environ.get(name, default)) for name, default in (("RANK", "0"), ("WORLD_SIZE", "1")))
        total = check_count("shards", world if cfg.shards is None else cfg.shards)
        number = check_count("shard", rank if cfg.shard is None else cfg.shard, low=0)
    if number >= total:
        raise UsageError(f"shard must be below shards = {total}, got {number}")
    return Shard(number, total)


def _workers(cfg: DictConfig) -> int:
    if cfg.workers is not None:
        return _checked(cfg, "workers", check_count, low=0)
    return num_cores()


def _report(options: Options, complete: set[int], damaged: int) -> None:
    num_frames = len(options.sources.frames)
    if skipped := options.sources.skipped:
        print(f"{len(skipped)} files of the source are unreadable: {first_names(skipped)}")
    if options.sources.has_one_drive:
        print("the source has a single drive, which cannot be split: all pairs are for training")
    if options.num_pairs > num_frames:
        times = -(-options.num_pairs // num_frames)
        print(
            f"{options.num_pairs} pairs of {num_frames} frames: each frame is used up to {times} times, with new keys"
        )
    if options.generator.reader.depth is None:
        warn_of_assumed_depth(options.generator.effect)
    if damaged:
        print(f"{damaged} pairs were damaged or missing and are made again")
    if complete:
        print(f"{len(complete)} pairs exist already")


def _check_disk(options: Options, missing: Sequence[int], storage: PairStorage) -> None:
    """Print the estimated size of the missing pairs; raise UsageError if the disk has less space."""
    # A reader that has opened a video cannot be sent to workers.
    generator, step = deepcopy(options.generator), max(1, len(missing) // _SAMPLES)
    samples = [generator.generate(options.task(number)) for number in missing[::step][:_SAMPLES]]
    sizes = [storage.disk_bytes(pair) for pair in samples if pair.data]
    mean = sum(sizes) // max(1, len(sizes))
    needed, free = mean * len(missing), shutil.disk_usage(storage.out).free
    estimate = (
        f"{len(missing)} pairs take about {decimal(needed)} on disk, {decimal(mean)} each; {decimal(free)} are free"
    )
    if needed > free:
        raise UsageError(
            f"out must have enough space, got too little: {estimate}; choose another disk or a lower count"
        )
    print(estimate, flush=True)


def _with_progress(units: Iterable[list[PairRow]], *, total: int) -> Iterator[list[PairRow]]:
    """Yield units of pairs; show progress in a terminal, and print a line a minute elsewhere."""
    console = Console(stderr=True)
    start = printed = time.monotonic()
    done = 0
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("pairs, {task.fields[rate]}"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, rate="")
        for unit in units:
            yield unit
            done += len(unit)
            now = time.monotonic()
            rate = done / max(now - start, 1e-9)
            bar.update(task, completed=done, rate=f"{rate:.3g} a second")
            if now - printed > _MESSAGE_INTERVAL and not console.is_terminal:
                printed, minutes = now, (total - done) / rate / 60
                print(
                    f"{done} of {total} pairs, {rate:.3g} a second, {minutes:.0f} min left", file=sys.stderr, flush=True
                )


def _finish(options: Options, out: Path, *, num_made: int) -> None:
    """Write the card if all shards have finished, and print the last line."""
    rows = scan_rows(find_manifests(out), lambda row: row.number < options.num_pairs, skip_invalid=True)
    summary = summarize(row for row, _ in rows)
    num_complete, num_skipped = summary.splits.total(), len(summary.skipped)
    missing = options.num_pairs - num_complete - num_skipped
    if num_complete == 0 and not missing:
        raise UsageError(f"source must hold readable frames, got {summary.skipped[0]}")
    if not missing:
        figure = draw_histograms(summary)
        if figure is not None:
            _write(out / HISTOGRAMS, figure)
        card = format_card(
            summary, settings=options.settings, license_text=options.license, has_histograms=figure is not None
        )
        _write(out / "README.md", card.encode())
    rest = f"{missing} are left to other shards" if missing else "see README.md in this folder"
    skipped = f", {num_skipped} frames are unreadable" if num_skipped else ""
    print(f"{out}: {num_made} pairs made, {num_complete} in total{skipped}; {rest}")


def _write(path: Path, data: bytes) -> None:
    """Write a file that several shards may write at the same time."""
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def _disk_errors(out: Path) -> Iterator[None]:
    """Turn errors of the disk into messages for the user; pairs that are written stay."""
    try:
        yield
    except OSError as error:
        if error.errno in _DISK_FULL:
            raise UsageError(
                f"out must have enough space, got {os.strerror(error.errno).lower()} for {error.filename or out}; "
                "existing pairs are complete, and the same command continues"
            ) from error
        raise UsageError(f"out must be a folder that can be written to, got {out} ({error.strerror})") from error
    except KeyboardInterrupt:
        print("stopped; the same command continues")
        raise SystemExit(130) from None
