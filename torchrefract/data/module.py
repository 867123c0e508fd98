"""Batches to learn from: clean frames come out of workers, and are corrupted on the device that trains."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from pytorch_lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset, DistributedSampler, default_collate

from torchrefract._validation import check_count, check_flag
from torchrefract.data.frames import FrameFolder
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.effects.base import Effect
from torchrefract.types import Frame, Pair

# Seeds of the epochs of training lie above the one of validation.
_FIRST_EPOCH = 1


class PairData(LightningDataModule):
    """Pairs of clean and degraded frames.

    In training a frame is degraded anew each epoch, by the draw of (seed, epoch, key of the frame); in validation it is
    degraded alike each time. So a run that goes on after a stop sees what it would have seen.

    Args:
        train, val: clean frames, or pairs from disk; val of drives that train has none of.
        effect: what degrades them; None for pairs.
        batch_size: frames in a batch, of each device.
        workers: processes that read or render frames; 0 does it in the training process.
        seed: of the draws and of the order.
        transmission: whether pairs made on the fly have theirs.
        flow: whether they must have one.
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
    ):
        super().__init__()
        self.train, self.val, self.effect = train, val, effect
        self.batch_size = check_count("batch_size", batch_size)
        self.workers = check_count("workers", workers, low=0)
        self.seed = check_count("seed", seed, low=0)
        self.asked = {"transmission": check_flag("transmission", transmission), "flow": check_flag("flow", flow)}
        self.check_ranks(1)

    def check_ranks(self, ranks: int) -> None:
        """Raise ValueError unless each of so many processes has frames for a batch."""
        count = len(self.train) // ranks  # pyright: ignore[reportArgumentType]  # a map-style dataset has a length
        if count < self.batch_size:
            share = "" if ranks == 1 else f" that each of {ranks} processes has"
            raise ValueError(f"batch_size must be at most the {count} training frames{share}, got {self.batch_size}")

    def check_pair(self) -> None:
        """Raise ValueError where the first pair cannot be had, or lacks what is asked for."""
        first = self.train[0]
        if isinstance(first, Frame) and self.effect is not None:
            make_pair(default_collate([first]), self.effect, seed=0, **self.asked)

    def train_dataloader(self) -> DataLoader[Any]:
        """Batches of frames, or pairs, in an order of the epoch."""
        return self._loader(self.train, training=True)

    def val_dataloader(self) -> DataLoader[Any]:
        """Batches of frames, or pairs, in their order."""
        return self._loader(self.val, training=False)

    def transfer_batch_to_device(self, batch: Frame | Pair, device: torch.device, dataloader_idx: int) -> Frame | Pair:
        """The batch on the device, but for its keys: draws are computed on the CPU, which would wait to have them."""
        return super().transfer_batch_to_device(batch, device, dataloader_idx)._replace(key=batch.key)

    def on_after_batch_transfer(self, batch: Frame | Pair, dataloader_idx: int) -> Pair:
        """The batch and its degraded copy, made on the device that it has come to; pairs as they are."""
        if isinstance(batch, Pair) or self.effect is None:
            return cast(Pair, batch)
        training = self.trainer is not None and self.trainer.training
        epoch = _FIRST_EPOCH + self.trainer.current_epoch if training and self.trainer else 0
        return make_pair(batch, self.effect, seed=(self.seed << 32) + epoch, **self.asked)

    def _loader(self, frames: Dataset[Any], *, training: bool) -> DataLoader[Any]:
        ranks, rank = (self.trainer.world_size, self.trainer.global_rank) if self.trainer else (1, 0)
        self.check_ranks(ranks)
        # Every rank its own frames, none twice in training; Lightning sets the epoch.
        sampler = DistributedSampler(frames, ranks, rank, shuffle=training, seed=self.seed, drop_last=training)
        return DataLoader(
            frames,
            batch_size=self.batch_size,
            sampler=sampler,
            drop_last=training,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
            pin_memory=torch.cuda.is_available(),
        )


@torch.no_grad()
def make_pair(frames: Frame, effect: Effect, *, seed: int, transmission: bool = False, flow: bool = False) -> Pair:
    """A batch of frames and what an effect makes of it, on the device of the frames; its transmission, if asked for.

    Raises:
        ValueError: a transmission or a flow is asked for, and the effect has none.
    """
    depth = frames.depth if frames.depth.ndim == 4 else None
    degraded = effect.degrade(frames.image, seed=seed, keys=frames.key, depth=depth)
    for wanted, name, example in ((transmission, "transmission", "fog"), (flow, "flow", "a lens")):
        if wanted and not degraded.has(name):
            raise ValueError(f"effect must have a {name}, as {example} has, got {type(effect).__name__}")
    like = frames.image[:, :1]
    moved = torch.zeros_like(like).expand(-1, 2, -1, -1) if degraded.restore_flow is None else degraded.restore_flow
    valid = torch.ones_like(like, dtype=torch.bool) if degraded.restore_valid is None else degraded.restore_valid
    passed = degraded.transmission if transmission else frames.image.new_empty(len(frames.image), 0)
    return Pair(degraded.image, frames.image, moved, valid, frames.key, passed)


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
) -> PairData:
    """Pairs of rendered road scenes; arguments as for `RoadScenes` and `PairData`."""
    train = RoadScenes(train_count, size=size, seed=seed)
    val = RoadScenes(val_count, size=size, seed=seed, first=train_count)
    options = {"batch_size": batch_size, "workers": workers, "seed": seed, "transmission": transmission, "flow": flow}
    return PairData(train, val, effect=effect, **options)


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
) -> PairData:
    """Pairs of a folder's frames, split by drive; arguments as for `FrameFolder` and `PairData`."""
    train, val = (
        FrameFolder(root, size=size, split=split, drive_by=drive_by, val_share=val_share, seed=seed)
        for split in ("train", "val")
    )
    options = {"batch_size": batch_size, "workers": workers, "seed": seed, "transmission": transmission, "flow": flow}
    return PairData(train, val, effect=effect, **options)


def pairs(
    *,
    root: str | Path,
    batch_size: int = 16,
    workers: int = 2,
    seed: int = 0,
    transmission: bool = False,
    flow: bool = False,
) -> PairData:
    """Pairs from disk, split by drive when they were made; arguments as for `PairedFolder` and `PairData`."""
    train, val = (PairedFolder(root, split=split, transmission=transmission, flow=flow) for split in ("train", "val"))
    return PairData(train, val, effect=None, batch_size=batch_size, workers=workers, seed=seed)
