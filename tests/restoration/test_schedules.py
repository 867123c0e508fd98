import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import Callback, ModelCheckpoint
from torch import Tensor, nn

from torchrefract import LensDistortion
from torchrefract.data.module import road_scenes
from torchrefract.restoration.checkpoints import AtomicCheckpointIO
from torchrefract.restoration.models.resunet import ResUNet
from torchrefract.restoration.models.segformer import SegFormer
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.schedules import schedule
from torchrefract.restoration.tasks import Undistort

EPOCHS = 3
NETWORKS: dict[str, Callable[[int], nn.Module]] = {
    "resunet": partial(ResUNet, encoder="tu-resnet10t"),
    "segformer": partial(SegFormer, encoder="mit_b0"),  # which drops paths at random
}

# Advice of Lightning on how to train, which small trainings do not follow; LeafSpec is of its own code.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:.*dirpath has changed"
)


def rates(name: str, losses: list[float]) -> list[float]:
    """The learning rates, from 1 on, before steps after which the validation has these losses."""
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = schedule(name, optimizer, warmup_steps=5, steps=len(losses))["scheduler"]
    seen = []
    for loss in losses:
        seen.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step(*([loss] if name == "plateau" else []))
    return seen


def test_a_cosine_warms_up_for_a_tenth_at_most_and_ends_at_zero():
    fall = [0.5 * (1 + math.cos(math.pi * i / 18)) for i in range(18)]
    assert rates("cosine", [1.0] * 20) == pytest.approx([0.0, 0.5, *fall])


def test_a_plateau_halves_the_rate_after_more_than_five_epochs_without_a_better_loss():
    losses = [1.0] * 7 + [0.5] * 8
    # The best of the ones is the first, so the seventh is the sixth that is no better; likewise of the halves.
    assert rates("plateau", losses) == [1.0] * 7 + [0.5] * 7 + [0.25]


class Rates(Callback):
    """Keeps the learning rate of each epoch."""

    def __init__(self):
        self.seen: dict[int, float] = {}

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.seen[trainer.current_epoch] = trainer.optimizers[0].param_groups[0]["lr"]


class StoppedError(Exception):
    """A run ends in the middle of an epoch."""


class Stop(Callback):
    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if (trainer.current_epoch, batch_idx) == (1, 1):
            raise StoppedError


class Impatient(Restoration):
    """Its plateau halves the rate with each epoch: no loss is good enough."""

    def configure_optimizers(self) -> Any:
        made = super().configure_optimizers()
        if self.schedule == "plateau":
            made["lr_scheduler"]["scheduler"].patience = 0
            made["lr_scheduler"]["scheduler"].threshold = 1.0
        return made


def trained(
    folder: Path, network: str, name: str, *callbacks: Callback, ckpt_path: Path | None = None
) -> tuple[dict[str, Tensor], dict[int, float]]:
    """The weights of a run, and its learning rates."""
    torch.manual_seed(3)
    data = road_scenes(effect=LensDistortion(), size=(32, 64), train_count=4, val_count=2, batch_size=2, workers=0)
    model, kept = Impatient(NETWORKS[network], Undistort(), lr=1e-2, schedule=name), Rates()
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=EPOCHS,
        callbacks=[kept, *callbacks, ModelCheckpoint(folder, monitor="val/loss", save_last=True)],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        plugins=[AtomicCheckpointIO()],
        use_distributed_sampler=False,
    )
    trainer.fit(model, data, ckpt_path=ckpt_path, weights_only=True)
    return model.state_dict(), kept.seen


@pytest.mark.parametrize(("network", "name"), [("resunet", "plateau"), ("segformer", "cosine")])
def test_a_run_that_was_stopped_ends_with_the_weights_of_one_that_was_not_bit_for_bit(
    tmp_path, on_threads, network, name
):
    on_threads(1)
    whole, rates = trained(tmp_path / "whole", network, name)
    again, _ = trained(tmp_path / "again", network, name)
    with pytest.raises(StoppedError):
        trained(tmp_path / "first", network, name, Stop())
    rest, late = trained(tmp_path / "rest", network, name, ckpt_path=tmp_path / "first" / "last.ckpt")
    assert late == {epoch: rate for epoch, rate in rates.items() if epoch >= 1}
    if name == "plateau":
        assert list(rates.values()) == [1e-2, 5e-3, 2.5e-3]
    for weight, value in whole.items():
        assert torch.equal(value, again[weight]), weight
        assert torch.equal(value, rest[weight]), weight
