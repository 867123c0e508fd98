"""The command that degrades pictures and videos, and moves the labels of pictures along."""

import hashlib
import json
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract._io import is_remote, make_folder, relative_name, replace_file, sizes_in_store, write_file
from torchrefract._validation import UsageError, check_choice, check_count, first_names
from torchrefract.cli.options import (
    check_seed,
    claim_out,
    depth_folder,
    file_digests,
    make_effect,
    naming,
    place_scene,
    read_option,
    read_workers,
    source_and_out,
)
from torchrefract.cli.progress import Skipped, check_none_lost, print_warning, progress, warn_of_assumed_depth
from torchrefract.data import media
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.flow_files import FlowFile, FlowFolder, read_flows
from torchrefract.data.frames import drives_of
from torchrefract.data.images import is_lost, local_copy, natural_order, pixels_of, read_image
from torchrefract.data.label_files import (
    Annotation,
    CocoAnnotations,
    CocoLabels,
    LabelFolder,
    MovedLabels,
    PictureLabels,
    category_names,
    labeled_boxes,
    read_labels,
)
from torchrefract.data.pairs.files import FORMATS, count_out_of_range, encode_maps
from torchrefract.data.pairs.generator import maps_of
from torchrefract.data.pairs.manifest import locked
from torchrefract.data.video import convert_video
from torchrefract.data.workers import map_in_processes
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import uses_boxes, with_vehicles
from torchrefract.random import key_of
from torchrefract.types import Degraded

_Labels = CocoLabels | LabelFolder | FlowFolder

_SAMPLES = 16  # files of a store whose headers are read before a run
_JOURNAL = ".labels.jsonl"  # annotations of finished pictures, for the next run


class _Task(NamedTuple):
    file: Path
    name: str  # relative to the source, with forward slashes
    labels: PictureLabels | FlowFile | None


class _Shot(NamedTuple):
    """The place of a picture in the clip of its drive."""

    drive: str
    first: str  # name of its first picture
    frame: int


class _Result(NamedTuple):
    name: str
    num_frames: int = 0
    num_dropped: int = 0  # labels that left the frame
    annotations: list[Annotation] | None = None  # for a COCO JSON
    error: str = ""
    is_lost: bool = False  # the file vanished
    is_beyond: bool = False  # a flow exceeds the range of a PNG


class Degrader(NamedTuple):
    """Degrades one file at a time, in any order and process; a file that cannot be read becomes an error."""

    scene: str  # configuration of the effect, as JSON
    has_width: bool  # the effect takes the width of each file
    seed: int
    depth: DepthFolder | None
    maps: str | None  # their format
    out: Path
    is_alone: bool  # neither labels nor maps are written
    root: Path  # of the source
    shots: dict[str, _Shot] | None  # of pictures, by name; None draws each one
    names: dict[int, str]  # of the categories of a COCO JSON

    def target(self, name: str) -> Path:
        """Return the path of a degraded file."""
        return self.out / ("" if self.is_alone else "images") / media.output_name(Path(name))

    def __call__(self, task: _Task) -> _Result:
        """Degrade a file; write its labels and maps first, so that a complete file has them."""
        file, target = task.file, self.target(task.name)
        make_folder(target.parent)
        try:
            with torch.no_grad(), local_copy(task.file) as file, replace_file(target, alone=True) as path:
                return (self._video if media.is_video(task.file) else self._picture)(task, file, path)
        except (ValueError, TypeError) as error:
            reason = str(error).replace(str(file), str(task.file))
            reason = reason if str(task.file) in reason else f"{task.file}: {reason}"
            return _Result(task.name, error=reason, is_lost=is_lost(error))

    def _picture(self, task: _Task, file: Path, path: Path) -> _Result:
        degraded = self._degraded(file, task.name, task.labels)
        num_dropped, annotations = 0, None
        if task.labels:
            content, num_dropped = self._moved(task.file, task.labels, degraded)
            if isinstance(task.labels, CocoAnnotations):
                annotations = content
            else:
                _write(self.out / "labels" / PurePosixPath(task.name).with_suffix(task.labels.path.suffix), content)
        is_beyond = self._write_maps(degraded, PurePosixPath(task.name).with_suffix(""))
        media.write_picture(degraded.image[0], path, source=file)
        return _Result(task.name, 1, num_dropped, annotations, is_beyond=is_beyond)

    def _degraded(self, file: Path, name: str, labels: PictureLabels | FlowFile | None) -> Degraded:
        image = read_image(file)[None].contiguous()
        depth = self._depth(name, image)
        with _no_warnings():
            effect = self._effect(image)
            params, frame = self._params(effect, image, name)
            if labels is not None and not isinstance(labels, FlowFile) and uses_boxes(effect):
                boxes = labeled_boxes(labels, (image.shape[2], image.shape[3]), self.names)
                params = with_vehicles(effect, params, [boxes])
            return effect.apply(image, params, frame=frame, depth=depth)

    def _params(self, effect: Effect, image: Tensor, name: str) -> tuple[Any, int]:
        """Return what is drawn for a picture, or for its drive, and its number among the frames of that draw."""
        if self.shots is None:
            return effect.sample(image, seed=self.seed, keys=[key_of(name)]), 0
        drive, first, frame = self.shots[name]
        path = self.root / first
        (height, width), params = _draw_drive(effect, drive, path, self.seed, path.stat().st_mtime_ns)
        if image.shape[2:] != (height, width):
            raise ValueError(
                f"pictures of a drive must have the size of its first one, {first}, {width}x{height}, got "
                f"{image.shape[3]}x{image.shape[2]}"
            )
        return params, frame

    def _moved(self, file: Path, labels: PictureLabels | FlowFile, degraded: Degraded) -> MovedLabels:
        if isinstance(labels, FlowFile):
            following = degraded
            if degraded.has("flow"):
                following = self._degraded(file.with_name(PurePosixPath(labels.following).name), labels.following, None)
            with _no_warnings():
                return MovedLabels(labels.move(degraded, following), 0)
        has_flow = degraded.has("flow") and bool(degraded.flow.any())
        height, width = degraded.image.shape[2:]
        return labels.move(degraded.flow[0] if has_flow else None, (height, width))

    def _video(self, task: _Task, file: Path, path: Path) -> _Result:
        beyond = list[bool]()

        def change(frames: Iterable[Tensor]) -> Iterator[np.ndarray]:
            effect = params = None
            for t, frame in enumerate(frames):
                with _no_warnings():
                    # What the draw reads from the image, such as the color of its sky, must not change in a clip.
                    if effect is None:
                        effect = self._effect(frame)
                        params = effect.sample(frame, seed=self.seed, keys=[key_of(task.name)])
                    degraded = effect.apply(frame, params, frame=t, depth=self._depth(task.name, frame, t))
                beyond.append(self._write_maps(degraded, PurePosixPath(task.name, f"{t:06d}")))
                yield pixels_of(degraded.image[0])

        num_frames = convert_video(file, path, change=change)
        return _Result(task.name, num_frames=num_frames, is_beyond=any(beyond))

    def _effect(self, image: Tensor) -> Effect:
        return _make_effect(self.scene, image.shape[3] if self.has_width else None)

    def _depth(self, name: str, image: Tensor, frame: int | None = None) -> Tensor | None:
        height, width = image.shape[2:]
        return self.depth and self.depth.read(name, frame, frame_size=(height, width), size=None)[None]

    def _write_maps(self, degraded: Degraded, stem: PurePosixPath) -> bool:
        """Write the maps of a frame, if asked for; return True if a flow exceeds the range of a PNG."""
        if self.maps is None:
            return False
        maps = maps_of(degraded, None)
        for suffix, data in encode_maps(maps, self.maps).items():
            _write(self.out / "maps" / f"{stem}.{suffix}", data)
        return self.maps == "png" and bool(count_out_of_range(maps))


@lru_cache(maxsize=16)
def _make_effect(scene: str, width: int | None) -> Effect:
    return instantiate(json.loads(scene) | ({} if width is None else {"width": width}))


@lru_cache(maxsize=16)
def _draw_drive(effect: Effect, drive: str, first: Path, seed: int, time: int) -> tuple[tuple[int, int], Any]:
    """Return the (height, width) of the first picture of a drive, and the parameters of its clip, drawn from it.

    `time` is that of the last change of the file, for which the result is kept.
    """
    image = read_image(first)[None].contiguous()
    return (image.shape[2], image.shape[3]), effect.sample(image, seed=seed, keys=[key_of(drive)])


def _shots(cfg: DictConfig, pictures: Sequence[str]) -> dict[str, _Shot] | None:
    """Number the pictures of each drive by the numbers in their names; None without drives."""
    if cfg.drive_by is None:
        return None
    with naming("drive_by"):
        drive_of = drives_of([*pictures], check_choice("drive_by", cfg.drive_by, ("auto", "folder", "prefix")))
    clips: dict[str, list[str]] = {}
    for name in sorted(pictures, key=natural_order):
        clips.setdefault(drive_of[name], []).append(name)
    return {name: _Shot(drive, clip[0], t) for drive, clip in clips.items() for t, name in enumerate(clip)}


def _write(path: Path, data: bytes) -> None:
    make_folder(path.parent)
    write_file(path, data, alone=True)


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Silence warnings of effects: the command warns of an assumed depth itself, and maps show folded pixels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def degrade(cfg: DictConfig) -> None:
    """Degrade the pictures and videos that are not in the output folder yet; print their number and the rate."""
    with source_and_out(cfg) as (source, out):
        _degrade(cfg, source, out)


def _degrade(cfg: DictConfig, source: Path, out: Path) -> None:
    files = media.find_media(source, out=out, deep=True, name="source")
    root = source if source.is_dir() else source.parent
    names = {relative_name(file, root): file for file in files}
    pictures = [name for name, file in names.items() if not media.is_video(file)]
    labels = _labels(cfg, pictures)
    job = _job(cfg, out, root, pictures, labels)
    workers = read_workers(cfg)
    if is_remote(out) and isinstance(labels, CocoLabels):
        raise UsageError(
            f"out must lie on this machine for labels of COCO, which a run continues line by line, got {out}; write to "
            "a folder and copy it"
        )
    with naming("out"):
        claim_out(out, _settings(cfg, root, job, labels), earlier={"files": None, "drives": None})
    with locked("out", out):
        finished = {name for name, _ in _read_journal(out)}
        tasks = [
            _Task(file, name, labels.of(name) if labels and not media.is_video(file) else None)
            for name, file in names.items()
        ]
        stored = sizes_in_store(out) if is_remote(out) else None
        missing = [
            task
            for task in tasks
            if not _is_complete(task, job, stored)
            or (isinstance(labels, CocoLabels) and task.labels and task.name not in finished)
        ]
        _warn([task.file for task in missing], tasks, labels, has_camera=cfg.scene.get("camera") is not None)
        _degrade_missing(missing, job, workers=min(workers, len(missing)), total=len(names))
        if isinstance(labels, CocoLabels):
            moved = dict(_read_journal(out))
            content = labels.with_moved({name: moved[name] for name in pictures if name in moved})
            _write(out / "labels" / labels.path.name, content)


def _is_complete(task: _Task, job: Degrader, stored: Mapping[str, int] | None) -> bool:
    """Return True if a file is degraded; stores, whose files are listed, hold no part of one."""
    target = job.target(task.name)
    if stored is not None:
        return relative_name(target, job.out) in stored
    return media.is_complete(task.file, target) and not any(
        media.is_older(target, path) for path in _depth_files(task, job.depth)
    )


def _depth_files(task: _Task, depth: DepthFolder | None) -> Iterable[Path]:
    """Return the depth maps of a file; none in a store, whose files have no dates to compare."""
    if depth is None or is_remote(depth.root):
        return ()
    return (depth.root / task.name).glob("*") if media.is_video(task.file) else (depth.path(task.name),)


def _degrade_missing(missing: Sequence[_Task], job: Degrader, *, workers: int, total: int) -> None:
    start, num_frames, num_dropped = time.perf_counter(), 0, 0
    skipped, beyond = Skipped(), list[str]()
    results = map_in_processes(job, missing, workers=workers, preload=__name__) if missing else ()
    for result in progress(results, "degrading", count=len(missing)):
        num_frames, num_dropped = num_frames + result.num_frames, num_dropped + result.num_dropped
        beyond += [result.name] if result.is_beyond else []
        if result.error:
            skipped.add(result.error, is_lost=result.is_lost)
        elif result.annotations is not None:
            with (job.out / _JOURNAL).open("a", encoding="utf-8") as journal:
                # The line before may be incomplete, if its run was killed.
                journal.write("\n" + json.dumps([result.name, result.annotations]))
    rate = num_frames / (time.perf_counter() - start)
    dropped = f"; {num_dropped} labels left the frame" if any(task.labels for task in missing) else ""
    counts = skipped.summarize("degraded", total=total, existing=total - len(missing), name="source")
    print(f"{job.out}: {counts}{dropped}")
    print(f"{num_frames} frames, {rate:.3g} frames a second")
    if beyond:
        print_warning(
            f"the flows of {first_names(sorted(beyond))} exceed 512 px, the range of a PNG, where they are clipped and "
            "marked as not valid; maps=npz or safetensors holds them"
        )
    check_none_lost(skipped.lost, name="source")


def _labels(cfg: DictConfig, pictures: Sequence[str]) -> _Labels | None:
    """Read the labels and check that each is of a picture."""
    if cfg.labels is None:
        return None
    fill = read_option(cfg, "mask_fill", check_count, low=0)
    with naming("labels"):
        path = Path(str(cfg.labels)).expanduser()
        labels = read_flows(path) or read_labels(path, fill=fill)
    labels.check(pictures)
    return labels


def _job(cfg: DictConfig, out: Path, root: Path, pictures: Sequence[str], labels: _Labels | None) -> Degrader:
    if cfg.severity is not None:
        cfg.scene.severity = cfg.severity
    place_scene(cfg)
    effect = make_effect(cfg, "scene")
    with naming("maps"):
        maps = {True: "png", False: None}.get(cfg.maps, cfg.maps)
        maps = maps if maps is None else check_choice("maps", maps, FORMATS)
    if (depth := depth_folder(cfg)) is None:
        warn_of_assumed_depth(effect)
    else:
        depth.check((name, None) for name in pictures)
    if maps or labels:
        stems = Counter(str(PurePosixPath(name).with_suffix("")) for name in pictures)
        if repeated := sorted(stem for stem, count in stems.items() if count > 1):
            raise UsageError(
                "source must hold pictures whose names differ in more than their extension, for the names of their "
                f"labels and maps, got two of {first_names(repeated)}"
            )
    is_given = any(word.lstrip("+").startswith("scene.width=") for word in HydraConfig.get().overrides.task)
    scene = json.dumps(OmegaConf.to_container(cfg.scene, resolve=True))
    has_width = "width" in cfg.scene and not is_given
    names = category_names(labels) if isinstance(labels, CocoLabels) else {}
    shots = _shots(cfg, pictures)
    is_alone = not (maps or labels)
    return Degrader(scene, has_width, check_seed(cfg.seed), depth, maps, out, is_alone, root, shots, names)


def _settings(cfg: DictConfig, root: Path, job: Degrader, labels: _Labels | None) -> dict[str, Any]:
    """Return everything that decides the output, so that a folder is only continued with the same settings."""
    scene = json.loads(job.scene)
    return {
        "source": str(root.resolve()),
        "scene": scene,
        "files": file_digests(pytree.tree_leaves(scene)),  # as that of a camera
        "width": "of each file" if job.has_width else None,
        "seed": job.seed,
        "drives": job.shots and hashlib.sha256(repr(sorted(job.shots.items())).encode()).hexdigest(),
        "maps": job.maps,
        "depth": job.depth and [str(job.depth.root.resolve()), job.depth.scale],
        "labels": labels and labels.digest(),
        "mask_fill": labels and cfg.mask_fill,
    }


def _warn(missing: Sequence[Path], tasks: Sequence[_Task], labels: _Labels | None, *, has_camera: bool) -> None:
    if missing and is_remote(missing[0]):  # the header of each file would cost a request for all of it
        missing = missing[:: len(missing) // _SAMPLES or 1]
    messages = media.describe_losses(missing, upright=True)
    if labels or has_camera:
        messages.append(media.describe_turned(missing, upright=True))
    if labels:
        without = [t.name for t in tasks if not t.labels and (media.is_video(t.file) or isinstance(labels, CocoLabels))]
        messages.append(f"labels do not list {len(without)} of the files: {first_names(without)}" if without else "")
    for message in filter(None, messages):
        print_warning(message)


def _read_journal(out: Path) -> Iterator[tuple[str, list[Annotation]]]:
    """Yield the name and the moved annotations of each finished picture; ignore a line that a kill cut off."""
    path = out / _JOURNAL
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        try:
            name, annotations = json.loads(line)
        except ValueError:
            continue
        yield name, annotations
