"""Generation of pairs: read a clean frame, degrade it by the draw of its key, encode and write it, in processes.

A pair or a tar is always complete. Files are written under a hidden name and then renamed. They are not flushed to
disk one by one, which would take longer than everything else. A kill loses nothing. After a power cut, a file may be
short, which the next run detects by its size, or hold zeros, which verify=true detects.
"""

import hashlib
import io
import math
import tarfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._io import make_folder, replace_file, write_file
from torchrefract._validation import UsageError
from torchrefract.cameras.camera import Camera
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.frames import Source
from torchrefract.data.images import (
    ChangedImageError,
    UnreadableImageError,
    check_frame_of_camera,
    decode_image,
    fit,
    is_lost,
    pixels_of,
    read_file,
)
from torchrefract.data.pairs.files import DEPTH, FLOWS, LIGHTS, PairArrays, count_out_of_range, encode_pair
from torchrefract.data.pairs.manifest import LOST, PairRow, StoredFile, tar_path
from torchrefract.data.pairs.ray_engine import map_in_actors
from torchrefract.data.pairs.sources import draw_of
from torchrefract.data.video import read_video
from torchrefract.data.workers import map_in_processes
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.types import Degraded

_PAIRS_PER_FOLDER = 1000
_DISK_BLOCK, _TAR_BLOCK = 4096, 512  # bytes


class SourceReader:
    """Reads clean frames. Frames of a video are read fastest in their order. A new reader can be pickled.

    Args:
        root: folder of the sources.
        size: (height, width), px, to crop and reduce frames to; None keeps their size.
        depth: folder of their depth maps.
        camera: of the frames in the files; all must have its shape.
    """

    def __init__(
        self,
        root: Path,
        size: tuple[int, int] | None,
        depth: DepthFolder | None = None,
        camera: Camera | None = None,
    ):
        self.root, self.size, self.depth, self.camera = root, size, depth, camera
        self._video, self._index = "", -1  # path and frame that were read last
        self._frames: Iterator[tuple[int, Tensor]] = iter(())

    def read(self, source: Source) -> Tensor:
        """Read a frame (3, H, W), float32, in [0, 1].

        Raises:
            UnreadableImageError: the file is damaged, or the video ends before the frame.
        """
        return self.read_with_depth(source)[0]

    def read_with_depth(self, source: Source) -> tuple[Tensor, Tensor | None]:
        """Read a frame as `read` does, and its depth (1, H, W), m, if there is a folder of depth maps.

        Raises:
            UsageError: there is no depth map of the frame, or it has not the shape of the camera's.
        """
        image = self._read_image(source) if source.frame is None else self._read_video(source.path, source.frame)
        check_frame_of_camera(self.camera, source.path, height=image.shape[1], width=image.shape[2])
        depth = None
        if self.depth is not None:
            depth = self.depth.read(
                source.path, source.frame, frame_size=(image.shape[1], image.shape[2]), size=self.size
            )
        return image.contiguous() if self.size is None else fit(image, self.size), depth

    def _read_image(self, source: Source) -> Tensor:
        path = self.root / source.path
        data = read_file(path)
        if source.bytes not in (None, len(data)):
            raise ChangedImageError(f"{path} has changed since it was listed: {len(data)} bytes, not {source.bytes}")
        return decode_image(data, path)

    def _read_video(self, path: str, index: int) -> Tensor:
        if path != self._video or index <= self._index:
            # Each further frame is the one that `_index` names by then.
            self._frames = read_video(self.root / path, iter(lambda: self._index, None))
        self._video, self._index = path, index
        frame = next(self._frames, None)
        if frame is None:
            self._video = ""
            raise UnreadableImageError(f"{self.root / path} ends before its frame {index}")
        return frame[1][0]


class PairTask(NamedTuple):
    """A pair to generate."""

    number: int
    source: Source
    repeat: int  # how many times the source was used before


class GeneratedPair(NamedTuple):
    """An encoded pair."""

    row: PairRow  # its files have no path yet
    data: dict[str, bytes]  # content of each file by the suffix of its name; empty if the frame was skipped


class PairGenerator(NamedTuple):
    """Generates pairs one at a time, so that a pair has the same bytes in any order and process of a device."""

    effect: Effect
    scene: str  # name of the effect
    reader: SourceReader
    seed: int
    maps: str  # format of the maps: png, npz or safetensors
    device: str = "cpu"  # or "cuda", the first GPU that the process sees

    def generate(self, task: PairTask) -> GeneratedPair:
        """Generate a pair. A frame that is unreadable or lost gives a row with the reason and no files.

        Raises:
            UsageError: the scene, the size or the format of the maps does not suit the frame, or there is no GPU.
        """
        source, device = task.source, device_of(self.device)
        seed, key = draw_of(source, seed=self.seed, repeat=task.repeat)
        origin = (source.path, source.frame, source.drive, source.split)
        row = PairRow(task.number, *origin, self.scene, seed, key, height=0, width=0, effects=[], beyond={}, files={})
        try:
            image, depth = self.reader.read_with_depth(source)
        except UnreadableImageError as error:
            reason = f"{LOST}{error}" if is_lost(error) else str(error).replace(f"{self.reader.root}/", "")
            return GeneratedPair(row._replace(skipped=reason), {})
        except UsageError:
            raise
        except ValueError as error:
            raise UsageError(f"size: {error}") from error
        try:
            with warnings.catch_warnings(), torch.no_grad():
                warnings.simplefilter("ignore", UserWarning)  # of folded pixels, which the masks exclude
                degraded = self.effect.degrade(
                    image[None].to(device),
                    seed=seed,
                    keys=[key],
                    depth=None if depth is None else depth[None].to(device),
                )
        except (ValueError, TypeError, OSError) as error:
            raise UsageError(f"scene: {error}") from error
        pair = PairArrays(pixels_of(image), pixels_of(degraded.image[0]), maps_of(degraded, depth))
        try:
            data = encode_pair(pair, self.maps)
        except ValueError as error:
            raise UsageError(str(error)) from error
        row = row._replace(
            height=image.shape[1],
            width=image.shape[2],
            effects=_applied_effects(self.effect, degraded.params),
            beyond=count_out_of_range(pair.maps) if self.maps == "png" else {},
            files={name: StoredFile("", len(x), hashlib.sha256(x).hexdigest()) for name, x in data.items()},
        )
        return GeneratedPair(row, data)


def device_of(name: str) -> torch.device:
    """Return the device of the name "cpu" or "cuda", which is the first GPU that this process sees.

    Raises:
        UsageError: PyTorch sees no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            f"device must be cpu where PyTorch sees no GPU, got {name}; use a node with one and PyTorch with CUDA"
        )
    return torch.device(name, 0) if name == "cuda" else torch.device(name)


def _applied_effects(effect: Effect, params: Any) -> list[dict[str, Any]]:
    """Return the name and the parameters of each effect that was applied to the first sample, in order."""
    leaves = effect.effects_with_params(params) if isinstance(effect, Compose) else [(effect, params)]
    return [
        {"effect": type(leaf).__name__}
        | {
            name: _plain(value[0].tolist())
            for name, value in values._asdict().items()
            if name != "applied" and value is not None and value.numel() > 0
        }
        for leaf, values in leaves
        if values.applied[0]
    ]


def _plain(value: Any) -> Any:
    """Replace infinite numbers by words, because JSON has no infinity."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def maps_of(degraded: Degraded, depth: Tensor | None) -> dict[str, np.ndarray]:
    """Return the maps of the first sample, and the depth (1, H, W), m, as `PairArrays` holds them."""
    maps = {"valid": degraded.valid[0, 0].cpu().numpy()}
    if depth is not None:
        maps[DEPTH] = depth[0].numpy()
    if degraded.has("flow"):
        maps["restore_valid"] = degraded.restore_valid[0, 0].cpu().numpy()
        maps |= {name: getattr(degraded, name)[0].float().cpu().numpy() for name in FLOWS}
    return maps | {name: getattr(degraded, name)[0, 0].float().cpu().numpy() for name in LIGHTS if degraded.has(name)}


class PairStorage(NamedTuple):
    """Writes units of pairs, each completely or not at all.

    Without `tar`, a unit is a pair of files, as pairs/00012/00012345.clean.png. Otherwise it is a tar of that many
    pairs in WebDataset's layout, as tars/00000012.tar, in which each pair has its row of the manifest as a further file
    with the suffix json.
    """

    out: Path  # the folder of the set
    tar: int | None

    @property
    def unit(self) -> int:
        """The number of pairs in a unit."""
        return self.tar or 1

    def write(self, tasks: Sequence[PairTask], generator: PairGenerator) -> list[PairRow]:
        """Generate and write the pairs of a unit; return their rows."""
        if self.tar is None:
            return [self._write_files(generator.generate(task)) for task in tasks]
        path = tar_path(tasks[0].number // self.tar)
        target = self.out / path
        make_folder(target.parent)
        with (
            replace_file(target, alone=True) as temporary,
            tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            return [_add_pair(tar, generator.generate(task), path) for task in tasks]

    def disk_bytes(self, pair: GeneratedPair) -> int:
        """Return the size of a pair on disk, with its row: files fill blocks, and those of a tar have a header."""
        sizes, block, header = [len(data) for data in pair.data.values()], _DISK_BLOCK, 0
        if self.tar is not None:
            sizes.append(len(pair.row.without_files()))
            block = header = _TAR_BLOCK
        return sum(header + math.ceil(size / block) * block for size in sizes) + len(pair.row.as_line())

    def _write_files(self, pair: GeneratedPair) -> PairRow:
        folder, files = f"pairs/{pair.row.number // _PAIRS_PER_FOLDER:05d}", {}
        for suffix, data in pair.data.items():
            files[suffix] = file = pair.row.files[suffix]._replace(path=f"{folder}/{pair.row.name}.{suffix}")
            make_folder(self.out / folder)
            write_file(self.out / file.path, data, alone=True)
        return pair.row._replace(files=files)


def _add_pair(tar: tarfile.TarFile, pair: GeneratedPair, path: str) -> PairRow:
    row, files = pair.row, {}
    for suffix, data in pair.data.items():
        files[suffix] = row.files[suffix]._replace(path=path, offset=_add_file(tar, f"{row.name}.{suffix}", data))
    if files:
        _add_file(tar, f"{row.name}.json", row.without_files())
    return row._replace(files=files)


def _add_file(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Add a file without time and owner, so that its bytes are reproducible; return the offset of its content."""
    start, info = tar.offset, tarfile.TarInfo(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))
    return start + _TAR_BLOCK


def generate_pairs(
    units: Iterable[Sequence[PairTask]],
    generator: PairGenerator,
    storage: PairStorage,
    *,
    workers: int,
    engine: Mapping[str, Any],
) -> Iterator[list[PairRow]]:
    """Generate and write units of pairs in processes, or in this one with `workers` 0.

    Args:
        units: the pairs of each file that is written as a whole.
        generator, storage: make and write a pair.
        workers: number of processes, or of actors.
        engine: name "ray", address of a cluster and GPUs of an actor, see `map_in_actors`; another name takes processes
            of this machine.

    Yields:
        the rows of each unit when it is written, in any order.

    Raises:
        UsageError: a worker was killed.
        Exception: any error of a worker, after the others have finished their units.
    """
    work = partial(storage.write, generator=generator)
    if engine["name"] == "ray":
        block = 8 if storage.tar is None else 1  # a tar takes long enough by itself
        options: Any = {"address": engine["address"], "num_gpus": engine["num_gpus"], "block": block}
        return map_in_actors(work, units, workers=workers, **options)
    return map_in_processes(work, units, workers=workers, preload=__name__)
