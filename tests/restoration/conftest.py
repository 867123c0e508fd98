from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from pytorch_lightning import Callback, Trainer
from torch.utils.data import DataLoader

from torchrefract import Pair
from torchrefract.data.module import make_pair
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.effects.base import Effect
from torchrefract.restoration.checkpoints import AtomicCheckpointIO
from torchrefract.types import Frame


@pytest.fixture
def trainer(tmp_path) -> Callable[..., Trainer]:
    return partial(
        Trainer,
        accelerator="cpu",
        default_root_dir=tmp_path,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        plugins=[AtomicCheckpointIO()],
    )


@pytest.fixture(scope="session")
def make_frames() -> Callable[..., Frame]:
    """Return a function that renders a batch of road scenes with consecutive keys."""

    def make(count: int, *, first: int = 0, size: tuple[int, int]) -> Frame:
        scenes = RoadScenes(count, size=size, first=first)
        return Frame(*(torch.stack(part) for part in zip(*(scenes[i] for i in range(count)), strict=True)))

    return make


@pytest.fixture(scope="session")
def make_batches(make_frames) -> Callable[..., list[Pair]]:
    """Return a function that renders road scenes and corrupts them: batches with consecutive keys."""

    def make(effect: Effect, count: int, *, first: int = 0, size: tuple[int, int], batch: int = 4) -> list[Pair]:
        starts = range(first, first + count * batch, batch)
        return [make_pair(make_frames(batch, first=start, size=size), effect, seed=start) for start in starts]

    return make


@pytest.fixture(scope="session")
def loader() -> Callable[[list[Pair]], DataLoader[Pair]]:
    """Return a function that wraps batches in a DataLoader."""
    return lambda batches: DataLoader(batches, batch_size=None)  # pyright: ignore[reportArgumentType]  # a list is a map-style dataset


class Losses(Callback):
    """Keep the loss of each training step."""

    def __init__(self):
        self.values: list[float] = []

    def on_train_batch_end(self, trainer, pl_module, outputs: Any, batch, batch_idx) -> None:
        self.values.append(float(outputs["loss"]))


@pytest.fixture
def losses() -> type[Losses]:
    return Losses
