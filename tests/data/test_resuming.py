"""A resumed training gets the pairs of an uninterrupted one, in the same order."""

import os
import signal
from pathlib import Path

import pytest
import torch
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch import Tensor
from torch.utils.data import Dataset

from torchrefract import Frame, Pair, UniformFog
from torchrefract.data.module import PairData, pairs
from torchrefract.restoration.checkpoints import StopOnSigterm

EPOCHS, BATCHES = 3, 3
# Warnings of Lightning about its own code, small trainings and a folder that is continued, and of Python about fork.
_IGNORED = ("LeafSpec", "does not have many workers", "multi-threaded", "exists and is not empty")
pytestmark = [pytest.mark.filterwarnings(f"ignore:.*{text}") for text in _IGNORED]


class Images(Dataset[Frame]):
    def __init__(self, count: int):
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        return Frame(torch.full((3, 8, 12), index / 20), torch.tensor(index), torch.empty(0))


class Recorder(LightningModule):
    """Note the keys and the draws of each batch; receive SIGTERM at a batch of the training or the validation."""

    def __init__(self, stop_at: tuple[str, int, int] | None = None):
        super().__init__()
        self.stop_at, self.batches = stop_at, dict[tuple[int, int], tuple[list[int], float]]()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch: Pair, index: int) -> Tensor:
        self.batches[self.current_epoch, index] = batch.key.tolist(), batch.degraded.sum().item()
        self._stop("train", index)
        return self.weight * batch.degraded.mean()

    def validation_step(self, batch: Pair, index: int) -> None:
        self._stop("val", index)

    def configure_optimizers(self):
        # As a cosine schedule does; it makes Lightning create the loader before it restores the state of the loops.
        steps = EPOCHS * -(-BATCHES // self.trainer.accumulate_grad_batches)
        assert self.trainer.estimated_stepping_batches == steps or self.trainer.max_epochs != EPOCHS
        return torch.optim.SGD(self.parameters(), lr=0.1)

    def _stop(self, stage: str, index: int) -> None:
        if self.stop_at == (stage, self.current_epoch, index):
            os.kill(os.getpid(), signal.SIGTERM)


def fit(
    folder: Path,
    *,
    workers: int,
    epochs: int = EPOCHS,
    stop_at=None,
    resume: bool = False,
    tars: Path | None = None,
    accumulated: int = 1,
) -> Recorder:
    model = Recorder(stop_at)
    if tars is None:
        data = PairData(Images(13), Images(8), effect=UniformFog(), batch_size=4, workers=workers)
    else:
        data = pairs(root=tars, buffer=4, batch_size=6, workers=workers)
    trainer = Trainer(
        max_epochs=epochs,
        accumulate_grad_batches=accumulated,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
        callbacks=[StopOnSigterm(str(folder)), ModelCheckpoint(folder, save_last=True)],
    )
    path = folder / "last.ckpt" if resume else None
    try:
        trainer.fit(model, data, ckpt_path=path, weights_only=True)
    except SystemExit:
        assert stop_at is not None
    return model


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict[tuple[int, int], tuple[list[int], float]]:
    batches = fit(tmp_path_factory.mktemp("run"), workers=0).batches
    assert sorted(batches) == [(epoch, index) for epoch in range(EPOCHS) for index in range(BATCHES)]
    assert len({tuple(keys) for keys, _ in batches.values()}) > BATCHES
    return batches


@pytest.mark.parametrize(
    ("workers", "stop_at"),
    [(1, None), (1, ("train", 1, 1)), (0, ("train", 0, 0)), (0, ("train", 1, 2)), (0, ("val", 1, 0))],
)
def test_a_resumed_training_gets_the_batches_of_an_uninterrupted_one(tmp_path, expected, capsys, workers, stop_at):
    first = fit(tmp_path, workers=workers, epochs=2 if stop_at is None else EPOCHS, stop_at=stop_at)
    assert ("stopped by SIGTERM" in capsys.readouterr().err) == (stop_at is not None)
    rest = fit(tmp_path, workers=workers, resume=True)
    assert not first.batches.keys() & rest.batches.keys()
    assert first.batches | rest.batches == expected


@pytest.mark.parametrize("stop_at", [("train", 0, 2), ("train", 1, 0), ("train", 1, 1), ("val", 1, 0)])
def test_a_training_that_accumulates_gradients_is_stopped_at_the_end_of_a_step(tmp_path, capsys, stop_at):
    expected = fit(tmp_path / "whole", workers=0, accumulated=2)
    fit(tmp_path, workers=0, stop_at=stop_at, accumulated=2)
    assert "stopped by SIGTERM" in capsys.readouterr().err
    assert torch.equal(fit(tmp_path, workers=0, resume=True, accumulated=2).weight, expected.weight)


@pytest.mark.parametrize(("workers", "stop_at"), [(1, ("train", 1, 1)), (0, ("train", 0, 0)), (0, None)])
def test_a_resumed_training_on_tars_gets_the_batches_of_an_uninterrupted_one(tmp_path, tars, workers, stop_at):
    pytest.importorskip("webdataset")  # in its own extra
    expected = fit(tmp_path / "whole", workers=0, tars=tars).batches
    assert len(expected) == EPOCHS * BATCHES
    first = fit(tmp_path, workers=workers, epochs=2 if stop_at is None else EPOCHS, stop_at=stop_at, tars=tars)
    rest = fit(tmp_path, workers=workers, resume=True, tars=tars)
    assert not first.batches.keys() & rest.batches.keys()
    assert first.batches | rest.batches == expected
