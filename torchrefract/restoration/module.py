"""What learns to restore pairs: what all networks share, and those that restore in one step."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from pytorch_lightning import LightningModule
from torch import Tensor, nn
from torch.optim.lr_scheduler import ReduceLROnPlateau

from torchrefract._validation import check_choice, check_count, check_number, check_size
from torchrefract.restoration.finite import check_finite
from torchrefract.restoration.metrics import endpoint_error, psnr, ssim
from torchrefract.restoration.schedules import SCHEDULES, schedule
from torchrefract.restoration.tasks import Restored, Task
from torchrefract.types import Pair
from torchrefract.warping.warp import warp

_NOTHING: tuple[Tensor, ...] = (torch.zeros(0), torch.zeros(0))


class Learner(LightningModule, ABC):
    """A network that learns to restore pairs.

    Logged each epoch: the loss; for val, and for train where a restoration comes with the loss, PSNR in dB and, for a
    task with a flow, the endpoint error in px at `metric_size`; for val also SSIM, and all scores of the degraded image
    as it is (`…_identity`) and of the mean flow of the training set (`…_constant`).

    Args:
        network: of this task.
        task: what is to be restored.
        lr: peak learning rate of AdamW.
        weight_decay: of AdamW.
        warmup_steps: steps of linear warm-up of the schedule "cosine".
        schedule: of the learning rate, "cosine" down to zero, or "plateau", halved where val/loss stays.
        metric_size: (height, width) of the frame whose pixels the endpoint error is given in.
    """

    def __init__(
        self,
        network: nn.Module,
        task: Task,
        *,
        lr: float,
        weight_decay: float,
        warmup_steps: int,
        schedule: str,
        metric_size: Sequence[int],
    ):
        super().__init__()
        self.task, self.network = task, network
        self.lr = check_number("lr", lr, low=0.0)
        self.weight_decay = check_number("weight_decay", weight_decay, low=0.0)
        self.warmup_steps = check_count("warmup_steps", warmup_steps, low=0)
        self.schedule = check_choice("schedule", schedule, SCHEDULES)
        self.metric_size = check_size("metric_size", metric_size)
        # For a rival without eyes: flows summed on valid pixels, and how many; of all ranks, and new ones of this one.
        self.flows, self.new_flows = _NOTHING, _NOTHING

    @abstractmethod
    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """The restoration of images (B, 3, H, W) in [0, 1].

        Args:
            degraded: the images.
            key: (B,), int64, what draws of numbers depend on where a network needs some; None stands for zeros.
        """

    @abstractmethod
    def learn(self, batch: Pair) -> tuple[Tensor, Restored | None]:
        """The loss of a batch of training, and its restoration where that takes no more work."""

    @abstractmethod
    def judge(self, batch: Pair) -> tuple[Tensor, Restored]:
        """The loss of a batch of validation, and its restoration."""

    def training_step(self, batch: Pair, _: int) -> Tensor:
        """The loss of a batch.

        Raises:
            NotFiniteError: a loss that is NaN or infinite.
        """
        loss, restored = self.learn(batch)
        check_finite(loss, batch.key, step=self.global_step, epoch=self.current_epoch)
        self._log("train", {"loss": loss} | ({} if restored is None else self._scores(restored, batch)), batch)
        self._count_flow(batch)
        return loss

    def validation_step(self, batch: Pair, _: int) -> dict[str, Any]:
        """The scores of a batch, beside those of rivals that need no network."""
        loss, restored = self.judge(batch)
        self._log("val", {"loss": loss}, batch)
        rivals = {"": restored, "_identity": Restored(batch.degraded)}
        if restored.flow is not None:
            constant = self.constant_flow(batch.flow)
            rivals["_identity"] = Restored(batch.degraded, torch.zeros_like(constant))
            rivals["_constant"] = Restored(warp(batch.degraded, constant, padding="border")[0], constant)
        for suffix, rival in rivals.items():
            scores = self._scores(rival, batch) | {"ssim": ssim(rival.image, batch.clean, batch.valid)}
            self._log("val", scores, batch, suffix=suffix)
        return restored._asdict()

    def on_validation_start(self) -> None:
        """The flows that the ranks have seen are put together, for the rival that needs them now."""
        self._gather_flows()

    def on_train_epoch_end(self) -> None:
        """The flows that the ranks have seen are put together, for the checkpoint."""
        self._gather_flows()

    def constant_flow(self, like: Tensor) -> Tensor:
        """The mean of the training set's flows on valid pixels, zero where there was none, in the shape of `like`."""
        flow_sum, count = self.flows
        if flow_sum.shape != like.shape[1:]:
            return torch.zeros_like(like)
        return (flow_sum / count.clamp(min=1)).to(like).expand_as(like)

    def configure_optimizers(self) -> Any:
        """AdamW with its schedule."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.lr, weight_decay=self.weight_decay)
        steps = int(self.trainer.estimated_stepping_batches)
        scheduler = schedule(self.schedule, optimizer, warmup_steps=self.warmup_steps, steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": scheduler}

    def on_fit_start(self) -> None:
        """The seed of the run is kept."""
        self.run_seed = torch.initial_seed()

    def on_train_batch_start(self, batch: Pair, batch_idx: int) -> None:
        """What a network drops depends on the seed of the run and on the step: a run that goes on drops the same."""
        torch.manual_seed(self.run_seed + self.global_step)

    def on_validation_epoch_end(self) -> None:
        """A plateau is told the loss before the checkpoint is written: Lightning would do it after."""
        plateau = self.lr_schedulers()
        if isinstance(plateau, ReduceLROnPlateau) and not self.trainer.sanity_checking:
            plateau.step(self.trainer.callback_metrics["val/loss"])

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """A step of what is no plateau."""
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The task, and the flows counted so far, go along."""
        checkpoint["task"] = self.task.name
        checkpoint["flows"] = self.flows

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The flows counted so far come back."""
        self.flows = checkpoint["flows"]

    def _scores(self, restored: Restored, pair: Pair) -> dict[str, Tensor]:
        scores = {"psnr": psnr(restored.image.detach(), pair.clean, pair.valid)}
        if restored.flow is not None:
            scores["epe"] = endpoint_error(restored.flow.detach(), pair.flow, pair.valid, size=self.metric_size)
        return scores

    def _log(self, split: str, scores: dict[str, Tensor], batch: Pair, suffix: str = "") -> None:
        values = {f"{split}/{name}{suffix}": value.mean() for name, value in scores.items()}
        self.log_dict(values, on_step=False, on_epoch=True, batch_size=len(batch.clean), sync_dist=True)

    def _count_flow(self, pair: Pair) -> None:
        weight = pair.valid.double()
        self.new_flows = _add(self.new_flows, ((pair.flow.double() * weight).sum(dim=0), weight.sum(dim=0)))

    def _gather_flows(self) -> None:
        if len(self.new_flows[0]):
            ranks = (self.trainer.strategy.reduce(value.to(self.device), reduce_op="sum") for value in self.new_flows)
            self.flows, self.new_flows = _add(self.flows, tuple(ranks)), _NOTHING


class Restoration(Learner):
    """A network that restores an image in one step.

    Args:
        network: makes the network, given the number of channels to predict and whether they are `smooth`, as of `Task`.
        task: what is to be restored.
        lr, weight_decay, warmup_steps, schedule, metric_size: as for `Learner`.
    """

    def __init__(
        self,
        network: Callable[..., nn.Module],
        task: Task,
        *,
        lr: float = 1e-3,
        weight_decay: float = 1e-2,
        warmup_steps: int = 50,
        schedule: str = "cosine",
        metric_size: Sequence[int] = (1080, 1920),
    ):
        options = {"lr": lr, "weight_decay": weight_decay, "warmup_steps": warmup_steps, "schedule": schedule}
        super().__init__(network(task.channels, smooth=task.smooth), task, metric_size=metric_size, **options)

    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """The restoration of images (B, 3, H, W) in [0, 1]; no draw, so no key counts."""
        return self.task.restore(self.network(degraded), degraded)

    def learn(self, batch: Pair) -> tuple[Tensor, Restored]:
        """The loss of the task, and the restoration."""
        restored = self(batch.degraded)
        return self.task.loss(restored, batch), restored

    def judge(self, batch: Pair) -> tuple[Tensor, Restored]:
        """The same as in training."""
        return self.learn(batch)


def _add(old: tuple[Tensor, ...], new: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    if old[0].shape != new[0].shape:
        return new
    return tuple(a.to(b.device) + b for a, b in zip(old, new, strict=True))
