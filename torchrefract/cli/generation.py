"""The commands `generate`, which writes pairs to disk, and `merge`, which joins the manifests of its shards."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.filesize import decimal
from torch.utils import _pytree as pytree

from torchrefract._io import as_path, is_remote, make_folder, remove_file
from torchrefract._validation import (
    UsageError,
    check_choice,
    check_count,
    check_flag,
    check_number,
    check_size,
    first_names,
)
from torchrefract.cli.options import (
    check_seed,
    claim_out,
    depth_folder,
    disk_errors,
    file_digests,
    make_effect,
    naming,
    place_scene,
    read_option,
    read_optional,
    read_path,
    read_workers,
)
from torchrefract.cli.progress import check_none_lost, print_warning, progress, warn_of_assumed_depth
from torchrefract.data.frames import Source
from torchrefract.data.images import UnreadableImageError, opened
from torchrefract.data.media import describe_turned
from torchrefract.data.pairs.card import summarize, write_card
from torchrefract.data.pairs.configuration import CONFIG, check_shards, read_config, shard_configs, shard_suffix
from torchrefract.data.pairs.files import FORMATS
from torchrefract.data.pairs.generator import (
    PairGenerator,
    PairStorage,
    PairTask,
    SourceReader,
    device_of,
    generate_pairs,
)
from torchrefract.data.pairs.manifest import (
    LOST,
    Manifest,
    PairRow,
    find_manifests,
    locked,
    locked_shard,
    scan_rows,
)
from torchrefract.data.pairs.ray_engine import check_cluster
from torchrefract.data.pairs.sources import LIST, Sources, find_sources, read_sources
from torchrefract.data.workers import map_in_processes

_SHOWN = 20  # unreadable frames that are listed at the end; README.md and the manifest state all
_SAMPLES = 4  # pairs that the estimate of the size on disk rests on
_TAGS = 16  # frames whose orientation is read beside a camera
_SEED_END = 2**31  # a seed is shifted by 32 bits, and must then fit 64 bits with a sign


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
    write_list: Callable[[], None]  # of the frames, if there is none
    settings: dict[str, Any]  # everything that determines the content of the files
    num_pairs: int
    license: str
    shard: Shard
    workers: int
    engine: dict[str, Any]
    verify: bool
    repaired: set[int]  # pairs whose frames were unreadable in an earlier run

    def task(self, number: int) -> PairTask:
        """Return the task of a pair; the file of a frame that was repaired has another size than in the list."""
        repeat, index = divmod(number, self.sources.num_frames)
        source = self.sources.frame(index)
        return PairTask(number, source._replace(bytes=None) if number in self.repaired else source, repeat)


def generate(cfg: DictConfig) -> None:
    """Write the missing pairs of a shard, and the card when the set is complete."""
    out = read_path(cfg, "out")
    with disk_errors(out):
        make_folder(out)
        with locked("out", out, "sources", wait=True):  # other shards wait for the list instead of scanning again
            options = _parse(cfg, out)
            about, suffix = {"license": options.license}, shard_suffix(*options.shard)
            earlier = {"device": "cpu", "depth_content": options.settings.get("depth_content")}
            claim_out(out, options.settings, count=options.num_pairs, about=about, earlier=earlier, suffix=suffix)
            options.write_list()
        with locked_shard(out, *options.shard):
            num_made, lost = _make_missing(options, out)
        _finish(options, out, num_made=num_made)
    check_none_lost(lost, name="source")


def _make_missing(options: Options, out: Path) -> tuple[int, list[str]]:
    """Write the missing pairs of a shard; return their number, and the errors of frames that could not be opened."""
    storage = PairStorage(out, options.settings["tar"])
    manifest = Manifest(out, *options.shard)
    complete, damaged = manifest.open(
        lambda number: options.shard.holds(number, options.num_pairs, storage.unit),
        verify=options.verify,
        is_repaired=lambda row: _is_repaired(row, options),
    )
    _report(options, complete, damaged)
    units = [u for u in options.shard.units(options.num_pairs, storage.unit) if not complete.issuperset(u)]
    num_made, lost = 0, list[str]()
    if units:
        _check_disk(options, [number for unit in units for number in unit], storage)
        tasks = ([options.task(number) for number in unit] for unit in units)
        workers = min(options.workers, len(units))
        made = generate_pairs(tasks, options.generator, storage, workers=workers, engine=options.engine)
        try:
            for row in progress(chain.from_iterable(made), "making pairs", count=sum(map(len, units))):
                if row.skipped.startswith(LOST):
                    lost.append(row.skipped.removeprefix(LOST))
                else:
                    manifest.add(row)
                    num_made += not row.skipped
        finally:
            manifest.flush()
    manifest.close()
    return num_made, lost


def _is_repaired(row: PairRow, options: Options) -> bool:
    """Return True if the frame of a row without a pair is readable by now, and note it."""
    try:
        SourceReader(options.sources.root, None).read(Source(row.source, row.drive, row.split, row.frame))
    except UnreadableImageError:
        return False
    options.repaired.add(row.number)
    return True


def _parse(cfg: DictConfig, out: Path) -> Options:
    size = read_optional(cfg, "size", check_size)
    camera = place_scene(cfg, size=size)
    effect = make_effect(cfg, "scene")
    plain: dict[str, Any] = {
        "seed": check_seed(cfg.seed, end=_SEED_END),
        "maps": read_option(cfg, "maps", check_choice, choices=FORMATS),
        "drive_by": read_option(cfg, "drive_by", check_choice, choices=("auto", "folder", "prefix")),
        "size": size,
        "tar": read_optional(cfg, "tar", check_count),
        "every": read_option(cfg, "every", check_count),
        "val_share": read_option(cfg, "val_share", check_number),
    }
    engine = cast(dict[str, Any], OmegaConf.to_container(cfg.engine))
    with naming("device"):
        plain["device"] = choose_device(cfg.device, engine)
    if not 0 < plain["val_share"] < 1:
        raise UsageError(f"val_share must be between 0 and 1, got {plain['val_share']}")
    verify, shard, workers = read_option(cfg, "verify", check_flag), _shard(cfg), read_workers(cfg)
    if engine["name"] == "ray" and workers == 0:
        raise UsageError("workers must be at least 1 for engine=ray, which counts its actors, got 0")
    if engine["name"] == "ray" and engine["address"]:
        check_cluster(str(engine["address"]))
    source = read_path(cfg, "source")
    if is_remote(out) == is_remote(source) and out.resolve().is_relative_to(source.resolve()):
        raise UsageError(f"out must lie outside of source, so that pairs do not become sources, got {cfg.out}")
    if not str(cfg.license or "").strip():
        raise UsageError("license must be that of the source, in words, got nothing")
    count = read_optional(cfg, "count", check_count)
    listed, write_list = _list_frames(cfg, source, out, plain)
    num_pairs = listed.num_frames if count is None else count
    sources = listed.limited(num_pairs)
    if cfg.scene.get("camera") is not None:
        # The header of each frame would cost a large set minutes.
        paths = {source.path: sources.root / source.path for source in sources.limited(_TAGS).frames()}
        if turned := describe_turned([*paths.values()], upright=True):
            print_warning(turned)
    if (depth := depth_folder(cfg)) is not None:
        plain |= sources.depth_digests(depth) | {"depth_scale": depth.scale}
    scene: dict[str, Any] = {"name": str(HydraConfig.get().runtime.choices["scene"])}
    scene |= cast(dict[str, Any], OmegaConf.to_container(cfg.scene, resolve=True))
    reader = SourceReader(sources.root, plain["size"], depth, camera)
    generator = PairGenerator(effect, scene["name"], reader, cfg.seed, plain["maps"], plain["device"])
    files = file_digests(pytree.tree_leaves(scene))  # as that of a camera
    settings = {"scene": scene, "files": files, **plain, "frames": sources.num_frames, "sources": sources.digest()}
    return Options(
        generator, sources, write_list, settings, num_pairs, str(cfg.license), shard, workers, engine, verify, set()
    )


def choose_device(name: str, engine: Mapping[str, Any]) -> str:
    """Return the device that computes pairs, "cpu" or "cuda": `name`, or a GPU if actors of Ray get one.

    Raises:
        UsageError: PyTorch sees no GPU for engine=local.
        ValueError, TypeError: the name or the number of GPUs is invalid, or the actors get no GPU for "cuda".
    """
    check_choice("device", name, ("cpu", "cuda"))
    if engine["name"] != "ray":
        device_of(name)  # Ray's actors run on other machines
        return name
    num_gpus = check_number("engine.num_gpus", engine["num_gpus"], low=0)
    if name == "cuda" and num_gpus == 0:
        raise ValueError(
            "engine.num_gpus must be above 0 for device=cuda, because Ray hides GPUs from other actors, got 0"
        )
    return "cuda" if num_gpus else "cpu"


def _list_frames(
    cfg: DictConfig, source: Path, out: Path, settings: dict[str, Any]
) -> tuple[Sources, Callable[[], None]]:
    """Read the list of frames, or scan the source; return the frames and a function that writes a new list."""
    path = out / LIST if cfg.files is None else as_path(str(cfg.files))
    options = {name: settings[name] for name in ("every", "drive_by", "val_share", "seed")}
    if path.is_file():
        # `claim` compares the options of a list in the folder of the set.
        sources = read_sources(path, source.parent if source.is_file() else source, options if cfg.files else {})
        print(f"{sources.num_frames} frames, as listed in {path}; files that were added since then are not used")
        return sources, lambda: None
    with naming("source"):
        sources = find_sources(source, size=settings["size"], **options)
    return sources, lambda: sources.write(path, options)


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


def _report(options: Options, complete: set[int], damaged: int) -> None:
    num_frames = options.sources.num_frames
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
    tasks = [options.task(number) for number in missing[:: max(1, len(missing) // _SAMPLES)][:_SAMPLES]]
    # A process takes the memory of the compiled effects with it when it ends; with Ray, it would serve nothing else.
    # Sizes on the CPU are those on a GPU, which the machine that starts Ray's actors may lack.
    work = options.generator._replace(device="cpu").generate
    workers = 0 if options.engine["name"] == "ray" else min(1, options.workers)
    samples = [*map_in_processes(work, tasks, workers=workers, preload="torchrefract.data.pairs.generator")]
    sizes = [storage.disk_bytes(pair) for pair in samples if pair.data]
    lost = [pair.row.skipped.removeprefix(LOST) for pair in samples if pair.row.skipped.startswith(LOST)]
    if len(lost) == len(samples):
        check_none_lost(lost, name="source")
    mean = sum(sizes) // max(1, len(sizes))
    needed, free = mean * len(missing), None if is_remote(storage.out) else shutil.disk_usage(storage.out).free
    estimate = f"{len(missing)} pairs take about {decimal(needed)} on disk, {decimal(mean)} each"
    estimate += "" if free is None else f"; {decimal(free)} are free"
    if free is not None and needed > free:
        raise UsageError(
            f"out must have enough space, got too little: {estimate}; choose another disk or a lower count"
        )
    print(estimate, flush=True)


def _finish(options: Options, out: Path, *, num_made: int) -> None:
    """Write the card if all shards have finished, and print the last line."""
    rows = scan_rows(find_manifests(out), lambda row: row.number < options.num_pairs, skip_invalid=True)
    summary = summarize((row for row, _ in rows), settings=options.settings)
    num_complete, num_skipped = summary.splits.total(), len(summary.skipped)
    missing = options.num_pairs - num_complete - num_skipped
    if num_complete == 0 and not missing:
        raise UsageError(f"source must hold readable frames, got {summary.skipped[0]}")
    if not missing:
        write_card(out, summary, settings=options.settings, license_text=options.license)
    rest = f"{missing} are missing or left to other shards" if missing else "see README.md in this folder"
    skipped = f", {num_skipped} frames are unreadable" if num_skipped else ""
    _list_unreadable(summary.skipped)
    print(f"{out}: {num_made} pairs made, {num_complete} in total{skipped}; {rest}")


def _list_unreadable(reasons: Sequence[str]) -> None:
    """Print the reasons of frames without a pair."""
    for reason in reasons[:_SHOWN]:
        print(f"unreadable, tried again by the same command: {reason}")
    if len(reasons) > _SHOWN:
        print(f"and {len(reasons) - _SHOWN} more, which the manifest names")


def merge(cfg: DictConfig) -> None:
    """Join the manifests of a set; raise UsageError if it lacks a pair, or has one twice or of other options."""
    out = read_path(cfg, "out")
    verify = read_option(cfg, "verify", check_flag)
    settings, count, license_text = _configuration(out)
    with disk_errors(out), locked_shard(out, 0, 1):
        count = check_shards(out, settings, count)
        num_rows = _count_lines(out)
        _check_configuration(out, settings, count)
        manifest = Manifest(out, 0, 1)
        complete, _ = manifest.open(lambda number: number < count, verify=verify, is_repaired=lambda _: False)
        draws = Counter((row.seed, row.key) for row, _ in scan_rows([manifest.path], lambda row: not row.skipped))
        rows = (row for row, _ in scan_rows([manifest.path], lambda _: True))
        summary = summarize(rows, settings=settings)
        _list_unreadable(summary.skipped)
        print(
            f"{out}: {summary.splits.total()} of {count} pairs, {len(summary.skipped)} frames are unreadable, "
            f"{num_rows - len(complete)} rows dropped that repeat others or lack their files"
        )
        if missing := [str(number) for number in range(count) if number not in complete]:
            raise UsageError(
                f"out must hold {count} pairs, got {len(missing)} missing: {first_names(missing)}; the same commands "
                "of generate make them"
            )
        if repeated := [str(key) for (_, key), times in draws.items() if times > 1]:
            raise UsageError(f"out must hold each draw once, got pairs that share the keys {first_names(repeated)}")
        write_card(out, summary, settings=settings, license_text=license_text)
        for path in shard_configs(out):
            remove_file(path)


def _configuration(out: Path) -> tuple[dict[str, Any], int, str]:
    """Return the settings, the number of pairs and the license in config.json."""
    try:
        config = read_config(out / CONFIG)
        settings = config["settings"]
        _ = settings["scene"]["name"], settings["seed"]  # an error if there is none
        return settings, int(config["count"]), str(config["license"])
    except (OSError, UsageError, KeyError, TypeError) as error:
        raise UsageError(f"out must be a folder of generate with a valid config.json, got {out}") from error


def _check_configuration(out: Path, settings: Mapping[str, Any], count: int) -> None:
    """Raise UsageError if rows are of another seed or scene, as of shards that were copied without their options."""
    rows = (row for row, _ in scan_rows(find_manifests(out), lambda row: row.number < count, skip_invalid=True))
    expected = settings["scene"]["name"], settings["seed"]
    # The seed of a draw holds that of the set in its upper bits, see `draw_of`.
    if other := [str(row.number) for row in rows if (row.scene, row.seed >> 32) != expected]:
        raise UsageError(
            f"out must hold pairs of one configuration, got {len(other)} of another seed or scene: "
            f"{first_names(sorted(other, key=int))}; make each set in a folder of its own"
        )


def _count_lines(out: Path) -> int:
    count = 0
    for path in find_manifests(out):
        with opened(path) as stream:
            count += sum(1 for _ in stream)
    return count
