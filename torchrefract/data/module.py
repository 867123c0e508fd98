"""Batches for training: workers load clean frames, and the training device degrades them."""

import hashlib
import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, cast

import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler, default_collate

from torchrefract._io import is_remote, sizes_in_store
from torchrefract._validation import UsageError, check_choice, check_count, check_flag
from torchrefract.data.frames import FrameFolder
from torchrefract.data.pairs.configuration import CONFIG, read_config
from torchrefract.data.pairs.dataset import PairBatches, PairedFolder, check_streamed
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.data.workers import ignore_sigterm
from torchrefract.effects.base import Effect
from torchrefract.effects.lens import LensDistortion
from torchrefract.types import Degraded, Frame, Pair
from torchrefract.warping.warp import warp

BORDERS = {"black": "zeros", "mirrored": "reflection"}  # with the padding of each


class _Sampler(DistributedSampler[Any]):
    """A sampler that can begin inside an epoch."""

    start = 0  # number of samples to skip

    def __iter__(self) -> Iterator[Any]:
        return islice(super().__iter__(), self.start, None)


class _BatchSampler(_Sampler):
    """Gives the epoch and the number of each batch of `PairBatches`."""

    def __iter__(self) -> Iterator[Any]:
        return ((self.epoch, number) for number in super().__iter__())


class _ValidationSampler(DistributedSampler[Any]):
    """Give each frame to one process, in order; Lightning keeps a sampler of this type, and shares out any other's."""

    def __iter__(self) -> Iterator[Any]:
        return iter(range(self.rank, len(self.dataset), self.num_replicas))  # pyright: ignore[reportArgumentType]  # a map-style dataset has a length

    def __len__(self) -> int:
        return len(range(self.rank, len(self.dataset), self.num_replicas))  # pyright: ignore[reportArgumentType]  # as above


class _Position:
    """A point in a training: an epoch, the number of its batches that were handed out, and that of all of them."""

    def __init__(self) -> None:
        self.done = self.resumed = (0, 0, 0)

    def state_dict(self) -> dict[str, int]:
        return dict(zip(("epoch", "batches", "of"), self.done, strict=True))

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.done = self.resumed = (state["epoch"], state["batches"], state.get("of", 0))


class _TrainingLoader(DataLoader[Any]):
    """A loader that a resumed run continues at the next batch."""

    position = _Position()

    def __iter__(self) -> Iterator[Any]:  # pyright: ignore[reportIncompatibleMethodOverride]  # an iterator is enough
        # A generator starts at its first batch, when Lightning has set the epoch. Workers would take the order of the
        # sampler at once, which is still that of epoch 0 in a resumed run.
        sampler, position = self.sampler, self.position
        if not isinstance(sampler, _Sampler):  # Lightning gives one of its own to overfit the first batches
            yield from super().__iter__()
            return
        epoch, total = sampler.epoch, len(self)
        start, expected = position.resumed[1:] if position.resumed[0] == epoch else (0, 0)
        if start and expected not in (0, total):
            raise UsageError(
                f"ckpt_path within an epoch of {expected} batches must be continued with the same data.batch_size, "
                f"workers and processes, got an epoch of {total}; continue with those, or from an earlier best.ckpt"
            )
        position.resumed, sampler.start = (0, 0, 0), start * (self.batch_size or 1)
        for number, batch in enumerate(super().__iter__(), start + 1):
            position.done = epoch, number, total
            yield batch

    def state_dict(self) -> dict[str, int]:  # Lightning warns of a loader without the two functions
        return self.position.state_dict()

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.position.load_state_dict(state)


class PairData(LightningDataModule):
    """Pairs of clean and degraded frames for Lightning.

    In training, the draw of a frame depends on (seed, epoch, key of the frame); in validation, on the seed and the key.
    A resumed run therefore sees the same pairs in the same order as an uninterrupted one, also from within an epoch.

    Args:
        train, val: clean frames, or pairs from disk; `val` should be of other drives than `train`.
        effect: degrades the frames; None for pairs.
        batch_size: frames in a batch on each device.
        workers: processes that load frames; 0 loads them in the training process.
        seed: of the draws and the order, at least 0.
        transmission: True to add the transmission to pairs of frames.
        flow: True to require a flow in pairs of frames.
        border: "black" or "mirrored" adds a border to degraded frames, see `add_border`; None keeps them filled.
        buffer: a number of pairs reads the pairs of tars one after another and shuffles them in a buffer of that many
            for each worker, see `PairBatches`; None reads frames and pairs in any order.

    Raises:
        ValueError: an argument is out of range, `batch_size` exceeds the number of training frames, the effect is no
            lens that a border could be added for, or `buffer` is given for other data than tars.
    """

    def __init__(
        self,
        train: Dataset[Frame] | Dataset[Pair],
        val: Dataset[Frame] | Dataset[Pair],
        *,
        effect: Effect | None,
        batch_size: int = 16,
        workers: int = 2,
        seed: int = 0,
        transmission: bool = False,
        flow: bool = False,
        border: str | None = None,
        buffer: int | None = None,
    ):
        super().__init__()
        if border is not None and not (isinstance(effect, LensDistortion) and effect.frame == "fill"):
            raise ValueError(f"border must be null unless the scene is a lens that fills its frames, got {border}")
        self.border = border and check_choice("border", border, tuple(BORDERS))
        self.train, self.val, self.effect = train, val, effect
        self.batch_size = check_count("batch_size", batch_size)
        self.workers = check_count("workers", workers, low=0)
        self.seed = check_count("seed", seed, low=0)
        self._maps = {"transmission": check_flag("transmission", transmission), "flow": check_flag("flow", flow)}
        self.buffer = buffer if buffer is None else check_count("buffer", buffer)
        for pairs in (train, val) if buffer else ():
            check_streamed(pairs if isinstance(pairs, PairedFolder) else None)
        self._position = _Position()
        self.check_ranks(1)

    def check_ranks(self, ranks: int) -> None:
        """Raise ValueError unless each of `ranks` processes has training frames for a batch and a validation frame."""
        count = len(self.train) // ranks  # pyright: ignore[reportArgumentType]  # a map-style dataset has a length
        if count < self.batch_size:
            share = "" if ranks == 1 else f" that each of {ranks} processes has"
            raise ValueError(f"batch_size must be at most the {count} training frames{share}, got {self.batch_size}")
        if (count := len(self.val)) < ranks:  # pyright: ignore[reportArgumentType]  # as above
            raise ValueError(f"the validation must have a frame for each of {ranks} processes, got {count} frames")

    def check_pair(self) -> None:
        """Raise ValueError if the first pair is unreadable or lacks a required map."""
        first = self.train[0]
        if isinstance(first, Frame) and self.effect is not None:
            make_pair(default_collate([first]), self.effect, seed=0, border=None, **self._maps)

    def state_dict(self) -> dict[str, int]:
        """Return the position in the training, which checkpoints hold."""
        return self._position.state_dict()

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue at a position; Lightning may have made the loader before."""
        self._position.load_state_dict(state_dict)

    def train_dataloader(self) -> DataLoader[Any]:
        """Return batches of training frames or pairs, shuffled in each epoch."""
        loader = self._loader(self.train, training=True)
        cast(_TrainingLoader, loader).position = self._position
        return loader

    def val_dataloader(self) -> DataLoader[Any]:
        """Return batches of validation frames or pairs, in order."""
        return self._loader(self.val, training=False)

    def transfer_batch_to_device(self, batch: Frame | Pair, device: torch.device, dataloader_idx: int) -> Frame | Pair:
        """Move a batch to a device, except for its keys: draws on the CPU would have to wait for them."""
        return super().transfer_batch_to_device(batch, device, dataloader_idx)._replace(key=batch.key)

    def on_after_batch_transfer(self, batch: Frame | Pair, dataloader_idx: int) -> Pair:
        """Degrade a batch of frames on its device; return pairs unchanged."""
        if isinstance(batch, Pair) or self.effect is None:
            return cast(Pair, batch)
        training = self.trainer is not None and self.trainer.training
        # Validation has the seed of epoch 0, so training begins at 1.
        epoch = 1 + self.trainer.current_epoch if training and self.trainer else 0
        # A validation compares the model with what the true transmission allows, where there is one.
        maps: dict[str, Any] = dict(self._maps)
        if not training and not maps["transmission"]:
            maps["transmission"] = None
        return make_pair(batch, self.effect, seed=(self.seed << 32) + epoch, border=self.border, **maps)

    def _loader(self, frames: Any, *, training: bool) -> DataLoader[Any]:
        ranks, rank = (self.trainer.world_size, self.trainer.global_rank) if self.trainer else (1, 0)
        self.check_ranks(ranks)
        workers, batch_size, sampler = self.workers, self.batch_size, None
        # Each rank has its own frames, once; Lightning sets the epoch of a sampler.
        if self.buffer is not None:
            workers = min(workers, len(frames) // ranks)  # each reads a frame at least
            options = {"buffer": self.buffer if training else 1, "seed": self.seed, "rank": rank, "ranks": ranks}
            frames = PairBatches(frames, batch_size=batch_size, workers=workers, **options)
            sampler, batch_size = _BatchSampler(frames, 1, 0, shuffle=False), None
        elif training:
            sampler = _Sampler(frames, ranks, rank, seed=self.seed, drop_last=True)
        else:
            sampler = _ValidationSampler(frames, ranks, rank)
        return (_TrainingLoader if training else DataLoader)(
            frames,
            batch_size=batch_size,
            sampler=sampler,
            drop_last=training and batch_size is not None,
            num_workers=workers,
            worker_init_fn=ignore_sigterm,
            multiprocessing_context=start_method() if workers else None,
            persistent_workers=workers > 0,
            pin_memory=torch.cuda.is_available(),
        )


def start_method() -> str:
    """Return how workers start: as the program chose, or as Python does by default."""
    chosen, methods = multiprocessing.get_start_method(), multiprocessing.get_all_start_methods()
    # Launchers of jobs, as joblib, choose a method of their own, with which no DataLoader starts workers.
    return chosen if chosen in methods else methods[0]


@torch.no_grad()
def make_pair(
    frames: Frame,
    effect: Effect,
    *,
    seed: int,
    transmission: bool | None = False,
    flow: bool = False,
    border: str | None = None,
) -> Pair:
    """Degrade a batch of frames on its device.

    Args:
        frames: image (B, 3, H, W), key (B,), and depth (B, 1, H, W) or an empty tensor.
        effect: degrades the frames.
        seed: of the draws.
        transmission: True to add the transmission; None to add it if the effect has one.
        flow: True to require a flow; otherwise, an effect without one gives a flow of zeros.
        border: for a lens, see `add_border`.

    Returns:
        degraded and clean images, restore_flow (B, 2, H, W), its validity mask (B, 1, H, W), keys (B,), transmission
        (B, 1, H, W) or (B, 0).

    Raises:
        ValueError: the effect lacks a required map.
    """
    depth = frames.depth if frames.depth.ndim == 4 else None
    degraded = effect.degrade(frames.image, seed=seed, keys=frames.key, depth=depth)
    for is_required, name, example in ((transmission, "transmission", "fog"), (flow, "flow", "a lens")):
        if is_required and not degraded.has(name):
            raise ValueError(f"effect must have a {name}, as {example} has, got {type(effect).__name__}")
    like = frames.image[:, :1]
    restore = torch.zeros_like(like).expand(-1, 2, -1, -1) if degraded.restore_flow is None else degraded.restore_flow
    valid = torch.ones_like(like, dtype=torch.bool) if degraded.restore_valid is None else degraded.restore_valid
    has_transmission = degraded.has("transmission") if transmission is None else transmission
    transmitted = degraded.transmission if has_transmission else frames.image.new_empty(len(frames.image), 0)
    image = degraded.image if border is None else add_border(degraded, cast(LensDistortion, effect), border)
    return Pair(image, frames.image, restore, valid, frames.key, transmitted)


def add_border(degraded: Degraded, lens: LensDistortion, border: str) -> Tensor:
    """Make frames (B, C, H, W) that a lens filled black or mirrored where padded ones would have a border.

    The clean frames, the flows and all other pixels stay, so a model that sees the lens restores them alike.

    Args:
        degraded: of the lens, with a zoom.
        lens: fills its frames.
        border: "black" or "mirrored".
    """
    image = degraded.image
    padded = lens.apply(image, degraded.params._replace(zoom=None, shift=None))
    # The frame that the padded one would be made of, which the filled one shows in its middle.
    clean, _ = warp(image, cast(Tensor, padded.restore_flow))
    bordered, _ = warp(clean, cast(Tensor, padded.flow), padding=BORDERS[border])
    return torch.where(padded.valid, image, bordered)


def fingerprint(frames: Dataset[Frame] | Dataset[Pair]) -> dict[str, Any]:
    """Describe a dataset in plain values, so that a checkpoint can state what it was trained on.

    Returns:
        source: name of the dataset's class.
        root: its folder; None for rendered scenes.
        depth: the folder of its depth maps, if there is one.
        drives: number of drives; None if unknown.
        license: of the frames; None if unknown.
        frames: number of frames.
        size: [height, width] of the first frame, px.
        sha256: of the names and sizes of the files, of the checksums of pairs, or of the arguments of rendered scenes.
    """
    result: dict[str, Any] = {"source": type(frames).__name__, "root": None, "drives": None, "license": None}
    lines: Iterable[str] = ()
    if isinstance(frames, FrameFolder):
        result |= {"root": str(frames.root), "drives": len(frames.drives)}
        result |= {} if frames.depth is None else {"depth": str(frames.depth.root)}
        sizes = sizes_in_store(frames.root) if is_remote(frames.root) else {}
        lines = (f"{name} {sizes.get(name) or (frames.root / name).stat().st_size}" for name in frames.names)
    elif isinstance(frames, PairedFolder):
        rows = list(frames.rows())
        result |= {"root": str(frames.root), "drives": len({row.drive for row in rows}), "license": _license(frames)}
        lines = (f"{row.name}.{suffix} {file.sha256}" for row in rows for suffix, file in sorted(row.files.items()))
    elif isinstance(frames, RoadScenes):
        lines = [f"{frames.seed} {frames.first} {frames.count} {frames.size[0]}x{frames.size[1]}"]
    digest = hashlib.sha256()
    for line in lines:
        digest.update(line.encode(errors="surrogateescape") + b"\n")
    result |= {"frames": len(frames), "size": list(frames[0][0].shape[-2:])}  # pyright: ignore[reportArgumentType]  # a map-style dataset has a length
    return result | {"sha256": digest.hexdigest()}


def _license(pairs: PairedFolder) -> str | None:
    """Read the license of the frames from config.json."""
    try:
        text = read_config(pairs.root / CONFIG).get("license")
    except (OSError, UsageError):
        return None
    return text if isinstance(text, str) else None


def road_scenes(
    *,
    effect: Effect,
    size: Sequence[int] = (64, 112),
    train_count: int = 512,
    val_count: int = 128,
    batch_size: int = 16,
    workers: int = 2,
    seed: int = 0,
    transmission: bool = False,
    flow: bool = False,
    border: str | None = None,
) -> PairData:
    """Make the data of rendered road scenes; see `RoadScenes` and `PairData` for the arguments."""
    train = RoadScenes(train_count, size=size, seed=seed)
    val = RoadScenes(val_count, size=size, seed=seed, first=train_count)
    options = {"batch_size": batch_size, "workers": workers, "seed": seed, "transmission": transmission, "flow": flow}
    return PairData(train, val, effect=effect, border=border, **options)


def frames(
    *,
    root: str | Path,
    effect: Effect,
    size: Sequence[int] = (64, 112),
    drive_by: str = "auto",
    val_share: float = 0.2,
    batch_size: int = 16,
    workers: int = 2,
    seed: int = 0,
    transmission: bool = False,
    flow: bool = False,
    border: str | None = None,
    depth: str | Path | None = None,
) -> PairData:
    """Make the data of a folder of frames, split by drive; see `FrameFolder` and `PairData` for the arguments."""
    train, val = (
        FrameFolder(root, size=size, split=split, drive_by=drive_by, val_share=val_share, seed=seed, depth=depth)
        for split in ("train", "val")
    )
    options = {"batch_size": batch_size, "workers": workers, "seed": seed, "transmission": transmission, "flow": flow}
    return PairData(train, val, effect=effect, border=border, **options)


def pairs(
    *,
    root: str | Path,
    size: Sequence[int] | None = None,
    batch_size: int = 16,
    workers: int = 2,
    seed: int = 0,
    transmission: bool = False,
    flow: bool = False,
    buffer: int | None = None,
) -> PairData:
    """Make the data of pairs from disk, with their splits; see `PairedFolder` and `PairData` for the arguments."""
    options: dict[str, Any] = {"size": size, "transmission": transmission, "flow": flow}
    train, val = (PairedFolder(root, split=split, **options) for split in ("train", "val"))
    return PairData(train, val, effect=None, batch_size=batch_size, workers=workers, seed=seed, buffer=buffer)
