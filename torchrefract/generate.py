"""Write pairs to disk: `python -m torchrefract.generate scene=paper_weather source=DIR out=DIR license="CC BY 4.0"`."""

import errno
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import cv2
import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_choice, check_count, check_flag, check_number, check_size
from torchrefract.cli.command import check_seed, command, job, leave, make, naming, quote_option
from torchrefract.data.frame_folder import some
from torchrefract.data.pair_files import FORMATS
from torchrefract.data.pair_manifest import manifests, scan
from torchrefract.data.pairs.card import HISTOGRAMS, contents, write_card
from torchrefract.data.pairs.ledger import Ledger, claim
from torchrefract.data.pairs.making import Job, Maker, Recipe
from torchrefract.data.pairs.running import make_ready, run
from torchrefract.data.pairs.sources import Sources, find_sources
from torchrefract.data.pairs.watching import watched
from torchrefract.data.pairs.writing import Folders, Store, Tars
from torchrefract.effects.base import Effect

_TRIED = 4  # pairs that tell how much room the others will take
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LARGEST_SEED = 2**31  # so that seeds of the draws fit 64 bits with a sign
_DRAWING = "torchrefract.data.pairs.histograms"  # which workers, who import this file too, do without
_MADE_WITH = {"torch": torch.__version__, "numpy": np.__version__, "opencv": cv2.__version__}


class _Shard(NamedTuple):
    """Which part of a set is made here."""

    number: int
    of: int

    def units(self, count: int, size: int) -> Iterator[range]:
        """The numbers of the pairs of its units, of which each has so many."""
        for start in range(self.number * size, count, self.of * size):
            yield range(start, min(start + size, count))

    def has(self, index: int, count: int, size: int) -> bool:
        """Whether a pair of a set of so many is its own."""
        return index < count and index // size % self.of == self.number


class _Asked(NamedTuple):
    """What is asked for."""

    recipe: Recipe
    sources: Sources
    settings: dict[str, Any]  # all that decides what is in which file
    number: int  # of the pairs of the set
    license: str
    shard: _Shard
    workers: int
    verify: bool

    def job(self, number: int) -> Job:
        """How a pair is made."""
        lap, place = divmod(number, len(self.sources.frames))
        return Job(number, self.sources.frames[place], lap)


@command("generate", prepare=quote_option("license"))
@hydra.main(config_path=CONFIG_DIR, config_name="generate", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Make the pairs that are not there yet, and the card when all are."""
    if _workers(cfg):  # what they import takes longer than to see what there is to do
        make_ready()
    asked, out = _asked(cfg), Path(str(cfg.out))
    with _room_on(out):
        about = {"license": asked.license, "made_with": _MADE_WITH}
        before = claim(out, asked.settings, count=asked.number, about=about).get("made_with", _MADE_WITH)
        if before != _MADE_WITH:
            print(f"the pairs there were made with {before}, and new ones are with {_MADE_WITH}: bytes may differ")
        store = Folders(out) if asked.settings["tar"] is None else Tars(out, asked.settings["tar"])
        ledger = Ledger(out, *asked.shard)
        there, damaged = ledger.open(lambda i: asked.shard.has(i, asked.number, store.unit), verify=asked.verify)
        _tell(asked, there, damaged)
        units = [unit for unit in asked.shard.units(asked.number, store.unit) if not there.issuperset(unit)]
        if units:
            if asked.workers:
                # Beside the pairs, not when all else is done.
                Thread(target=import_module, args=(_DRAWING,), daemon=True).start()
            _check_room(asked, [number for unit in units for number in unit], store)
            jobs = ([asked.job(number) for number in unit] for unit in units)
            made = run(jobs, asked.recipe, store, workers=min(asked.workers, len(units)))
            for rows in watched(made, total=sum(map(len, units))):
                ledger.add(rows)
        ledger.close()
        _finish(asked, out, made=sum(map(len, units)))


def _asked(cfg: DictConfig) -> _Asked:
    recipe, options, shard, workers = _recipe(cfg), _options(cfg), _shard(cfg), _workers(cfg)
    sources = _sources(cfg, recipe)
    with naming("count"):
        number = len(sources.frames) if cfg.count is None else check_count("count", cfg.count)
    sources = sources.thinned(number)
    if not str(cfg.license or "").strip():
        raise UsageError("license must be that of the source, in words, got nothing")
    settings = {"scene": _scene(cfg), **options, "frames": len(sources.frames), "sources": sources.digest()}
    return _Asked(recipe, sources, settings, number, str(cfg.license), shard, workers, cfg.verify)


def _recipe(cfg: DictConfig) -> Recipe:
    effect = make(cfg, "scene")
    if not isinstance(effect, Effect):
        raise UsageError(f"scene must be an effect of torchrefract, got {effect}")
    with naming("size"):
        size = None if cfg.size is None else check_size("size", cfg.size)
    if check_seed(cfg.seed) >= _LARGEST_SEED:
        raise UsageError(f"seed must be below {_LARGEST_SEED}, got {cfg.seed}")
    with naming("maps"):
        maps = check_choice("maps", str(cfg.maps), FORMATS)
    source = Path(str(cfg.source)).expanduser()
    root = source.parent if source.is_file() else source
    return Recipe(effect, _scene(cfg)["name"], root, size, cfg.seed, maps)


def _options(cfg: DictConfig) -> dict[str, Any]:
    """What else decides what is in which file."""
    with naming("tar"):
        tar = None if cfg.tar is None else check_count("tar", cfg.tar)
    with naming("every"):
        every = check_count("every", cfg.every)
    with naming("drive_by"):
        drive_by = check_choice("drive_by", str(cfg.drive_by), ("auto", "folder", "prefix"))
    with naming("val_share"):
        if not 0 < (share := check_number("val_share", cfg.val_share)) < 1:
            raise UsageError(f"val_share must be between 0 and 1, got {share}")
    with naming("verify"):
        check_flag("verify", cfg.verify)
    size = None if cfg.size is None else list(cfg.size)
    plain = {"seed": cfg.seed, "maps": str(cfg.maps), "drive_by": drive_by, "size": size}
    return plain | {"tar": tar, "every": every, "val_share": share}


def _scene(cfg: DictConfig) -> dict[str, Any]:
    name = str(HydraConfig.get().runtime.choices["scene"])
    scene = OmegaConf.to_container(cfg.scene, resolve=True)
    return {"name": name, **({str(key): value for key, value in scene.items()} if isinstance(scene, dict) else {})}


def _sources(cfg: DictConfig, recipe: Recipe) -> Sources:
    source, out = Path(str(cfg.source)).expanduser(), Path(str(cfg.out)).resolve()
    if out.is_relative_to(source.resolve()):
        raise UsageError(f"out must lie outside of source, whose pictures it would join, got {cfg.out}")
    options = {"every": cfg.every, "drive_by": str(cfg.drive_by), "val_share": cfg.val_share, "seed": cfg.seed}
    with naming("source"):
        return find_sources(source, size=recipe.size, **options)


def _shard(cfg: DictConfig) -> _Shard:
    """The one that is asked for, or torchrun's rank."""
    if (cfg.shard is None) != (cfg.shards is None):
        raise UsageError(f"shard must be given together with shards, got {cfg.shard} of {cfg.shards}")
    with naming("shard"):
        rank, world = (int(os.environ.get(name, default)) for name, default in (("RANK", "0"), ("WORLD_SIZE", "1")))
        shards = check_count("shards", world if cfg.shards is None else cfg.shards)
        shard = check_count("shard", rank if cfg.shard is None else cfg.shard, low=0)
    if shard >= shards:
        raise UsageError(f"shard must be below shards = {shards}, got {shard}")
    return _Shard(shard, shards)


def _workers(cfg: DictConfig) -> int:
    if cfg.workers is not None:
        with naming("workers"):
            return check_count("workers", cfg.workers, low=0)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def _tell(asked: _Asked, there: set[int], damaged: int) -> None:
    frames = len(asked.sources.frames)
    if skipped := asked.sources.skipped:
        print(f"{len(skipped)} files of the source cannot be read: {some(skipped)}")
    if asked.sources.alone:
        print("the source has a single drive, which cannot be split: all of it is for training")
    if asked.number > frames:
        times = -(-asked.number // frames)
        print(f"{asked.number} pairs of {frames} frames: each frame is used up to {times} times, with new keys")
    if damaged:
        print(f"{damaged} pairs were damaged or missing and are made again")
    if there:
        print(f"{len(there)} pairs are there already")


def _check_room(asked: _Asked, missing: Sequence[int], store: Store) -> None:
    """Say how much room the missing pairs take, by some that are made on trial, and raise if there is less."""
    maker, step = Maker(asked.recipe), max(1, len(missing) // _TRIED)
    tried = [maker.make(asked.job(number)) for number in missing[::step][:_TRIED]]
    sizes = [store.bytes_of(made) + len(made.row.as_line()) for made in tried if made.data]
    each = sum(sizes) / max(1, len(sizes))
    needed, free = each * len(missing), shutil.disk_usage(store.out).free
    room = f"{len(missing)} pairs take about {_size(needed)} on disk, {_size(each)} each; {_size(free)} are free"
    if needed > free:
        raise UsageError(f"out must have room, got too little: {room}; choose another disk or a smaller count")
    print(room, flush=True)


def _finish(asked: _Asked, out: Path, *, made: int) -> None:
    """The card, if all shards have made their pairs; and the last line."""
    found = contents(row for row, _ in scan(manifests(out), lambda row: row.number < asked.number, torn=True))
    there, unreadable = found.splits.total(), len(found.skipped)
    missing = asked.number - there - unreadable
    if there == 0 and not missing:
        raise UsageError(f"source must hold frames that can be read, got {found.skipped[0]}")
    if not missing:
        picture: bytes | None = import_module(_DRAWING).histograms(found)
        if picture is not None:
            _write(out / HISTOGRAMS, picture)
        pictured = picture is not None
        card = write_card(found, settings=asked.settings, license_of=asked.license, pictured=pictured)
        _write(out / "README.md", card.encode())
    rest = f"{missing} are left to other shards" if missing else "README.md tells of them"
    skipped = f", {unreadable} frames could not be read" if unreadable else ""
    print(f"{out}: {made} pairs made, {there} there{skipped}; {rest}")


def _write(path: Path, data: bytes) -> None:
    """Write a file that several shards may be writing at once."""
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def _room_on(out: Path) -> Iterator[None]:
    """A disk that is full, or cannot be written to, is the user's to mend; what is there stays."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise UsageError(
                f"out must have room, got {os.strerror(error.errno).lower()} for {error.filename or out}; the pairs "
                "that are there are whole, and the same command goes on"
            ) from error
        raise UsageError(f"out must be a folder that can be written to, got {out} ({error.strerror})") from error
    except KeyboardInterrupt:
        print("stopped; the same command goes on")
        raise SystemExit(130) from None


def _size(count: float) -> str:
    for unit in ("kB", "MB", "GB"):
        count /= 1000
        if count < 1000 or unit == "GB":
            break
    return f"{count:.3g} {unit}"


if __name__ == "__main__":
    main()
    leave()
