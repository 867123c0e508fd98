"""The training loop that all networks share, and the module of networks that restore in a single pass."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from pytorch_lightning import LightningModule
from pytorch_lightning.trainer.states import TrainerFn
from torch import Tensor, nn
from torch.optim.lr_scheduler import ReduceLROnPlateau

from torchrefract._validation import UsageError, check_choice, check_count, check_number, check_rgb, check_size
from torchrefract.effects.batch import check_image_values
from torchrefract.restoration.checkpoints import rename_weights
from torchrefract.restoration.metrics import coverage, endpoint_error, psnr, restore_by_transmission, ssim, through_fog
from torchrefract.restoration.tasks import Restored, Task
from torchrefract.types import Pair
from torchrefract.warping.flow import resize_flow
from torchrefract.warping.warp import warp

PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
SCHEDULES = ("cosine", "plateau")


class NotFiniteError(UsageError):
    """A loss is NaN or infinite; the message names its batch."""


class RestorationModule(LightningModule, ABC):
    """Train and validate a network that restores pairs.

    Logs for each epoch: the loss; PSNR in dB and, for a task with a flow, the endpoint error in px of `metric_size`,
    for val, and for train if the loss needs a restoration anyway; for val all of `restoration_scores`, SSIM in the
    last epoch only, also of two baselines: the degraded image (`…_identity`) and the mean flow of the training set
    (`…_constant`); for pairs with a transmission also of the image that it restores, see `restore_by_transmission`
    (`…_fog`).

    Args:
        network: predicts the maps of the task.
        task: the kind of restoration.
        lr: peak learning rate of AdamW.
        weight_decay: weight decay of AdamW.
        warmup_steps: steps of linear warm-up of the schedule "cosine"; see `num_warmup_steps`.
        schedule: "cosine" decays the learning rate to zero; "plateau" halves it after more than 5 epochs without a
            lower val/loss.
        metric_size: (height, width) of the frame whose pixels are the unit of the endpoint error.
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
        # For the constant baseline: the sum of the valid flows and their number, (3, H, W), over all ranks, and those
        # of this rank that are not yet added.
        self.flows, self.new_flows = torch.zeros(0), torch.zeros(0)
        self.resumed = (0, 0)  # the complete epochs of the checkpoint that a training resumes, and their steps
        self.origin: dict[str, Any] = {}  # config, data and licenses in plain values, which checkpoints hold

    @abstractmethod
    def forward(self, degraded: Tensor, key: Tensor | None = None) -> Restored:
        """Restore images.

        Args:
            degraded: (B, 3, H, W), in [0, 1].
            key: (B,), int64, the keys of the random numbers that a network draws; None stands for zeros.
        """

    @property
    def has_deviation(self) -> bool:
        """Return True if restorations have the standard deviation of their flow."""
        return False

    @abstractmethod
    def training_loss(self, batch: Pair) -> tuple[Tensor, Restored | None]:
        """Compute the loss () of a training batch; also return the restoration if the loss needs it."""

    @abstractmethod
    def validation_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        """Compute the loss () of a validation batch and its restoration."""

    def training_step(self, batch: Pair, _: int) -> Tensor:
        """Compute and log the loss of a batch.

        Raises:
            NotFiniteError: the loss is NaN or infinite.
            TypeError: the batch is no Pair.
        """
        _check_pair(batch)
        loss, restored = self.training_loss(batch)
        if not loss.isfinite():
            # The corruption of a frame is drawn from (seed, epoch, key), so the message is enough to repeat the batch.
            keys = ", ".join(str(key) for key in batch.key.tolist())
            raise NotFiniteError(
                f"loss must be finite, got {loss:g} in step {self.global_step} of epoch {self.current_epoch} "
                f"for the keys {keys}"
            )
        scores = {} if restored is None else _main_scores(restored, batch, self.metric_size)
        self._log("train", {"loss": loss.expand(len(batch.clean))} | scores, batch)
        flows = torch.cat([batch.flow * batch.valid, batch.valid], dim=1).sum(dim=0, dtype=torch.float64)
        self.new_flows = _add(self.new_flows, flows)
        return loss

    def validation_step(self, batch: Pair, _: int) -> dict[str, Any]:
        """Log the scores of the model and of the baselines; return the restoration as a dict."""
        _check_pair(batch)
        loss, restored = self.validation_loss(batch)
        self._log("val", {"loss": loss.expand(len(batch.clean))}, batch)
        clear = None if restored.transmission is None else torch.ones_like(restored.transmission)
        methods = {"": restored, "_identity": Restored(batch.degraded, transmission=clear)}
        if restored.flow is not None:
            constant = self.constant_flow(batch.flow)
            methods["_identity"] = Restored(batch.degraded, torch.zeros_like(constant))
            methods["_constant"] = Restored(warp(batch.degraded, constant, padding="border")[0], constant)
        elif batch.transmission.ndim == 4:
            true_map = None if clear is None else batch.transmission
            methods["_fog"] = Restored(restore_by_transmission(batch), transmission=true_map)
        # SSIM takes longer than all other scores together, so a training computes it in its last epoch alone.
        trainer = self.trainer
        next_epoch = trainer.current_epoch + (trainer.check_val_every_n_epoch or 1)
        is_last = 0 < (trainer.max_epochs or -1) <= next_epoch or trainer.global_step == trainer.max_steps
        with_ssim = is_last or trainer.should_stop or trainer.state.fn != TrainerFn.FITTING
        for suffix, result in methods.items():
            scores = restoration_scores(self.task, result, batch, metric_size=self.metric_size, with_ssim=with_ssim)
            self._log("val", scores, batch, suffix=suffix)
        return restored._asdict()

    def predict_step(self, batch: Tensor | Pair, _: int) -> Restored:
        """Restore a batch of images (B, 3, H, W), or the degraded images of pairs."""
        if isinstance(batch, Tensor):
            check_image_values(check_rgb("batch", batch))
            return self(batch)
        _check_pair(batch)
        return self(batch.degraded, batch.key)

    def on_validation_start(self) -> None:
        """Add up the flows of all ranks for the constant baseline."""
        if len(self.new_flows):
            of_all_ranks = self.trainer.strategy.reduce(self.new_flows.to(self.device), reduce_op="sum")
            self.flows, self.new_flows = _add(self.flows, of_all_ranks), torch.zeros(0)

    def on_train_epoch_end(self) -> None:
        """Add up the flows of an epoch without a validation for the checkpoint."""
        self.on_validation_start()

    def constant_flow(self, like: Tensor) -> Tensor:
        """Return the mean valid flow of the training set at the size of `like`; 0 without a valid flow."""
        if not len(self.flows):
            return torch.zeros_like(like)
        mean = (self.flows[:2] / self.flows[2:].clamp(min=1))[None]
        return resize_flow(mean, like.shape[2:]).to(like).expand_as(like)

    @property
    def steps_per_epoch(self) -> int:
        """Return the steps of the optimizer in an epoch."""
        return math.ceil(self.trainer.num_training_batches / self.trainer.accumulate_grad_batches)

    @property
    def num_steps(self) -> float:
        """Return the steps of the training, of which those before a resume may be of other batches."""
        steps = self.trainer.estimated_stepping_batches
        if math.isinf(self.trainer.num_training_batches) or self.trainer.max_steps != -1:  # it may load no data
            return steps
        epochs, made = self.resumed
        return steps + made - epochs * self.steps_per_epoch

    def num_warmup_steps(self, num_steps: int) -> int:
        """Return the steps of the warm-up in a training of `num_steps`: `warmup_steps`, but at most a tenth of all."""
        return min(self.warmup_steps, num_steps // 10)

    def configure_optimizers(self) -> Any:
        """Create AdamW and its learning rate schedule; raise UsageError if a cosine has no last step."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.lr, weight_decay=self.weight_decay)
        if self.schedule == "plateau":
            plateau = ReduceLROnPlateau(optimizer, factor=0.5, patience=5)
            # Not strict, since an epoch may have no validation.
            scheduler = {"scheduler": plateau, "monitor": "val/loss", "strict": False}
        else:
            steps = self.num_steps
            if math.isinf(steps):
                raise UsageError(
                    f"schedule must be plateau for a training without a last step, got {self.schedule}; or give the "
                    "trainer max_epochs or max_steps"
                )
            cosine = get_cosine_schedule_with_warmup(optimizer, self.num_warmup_steps(int(steps)), int(steps))
            scheduler = {"scheduler": cosine, "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": scheduler}

    def setup(self, stage: str) -> None:
        """Keep the seed of the run; raise UsageError for a precision that would convert frames, flows and scores."""
        if self.trainer.precision not in PRECISIONS and stage != "predict":
            raise UsageError(
                f"trainer.precision must be one of {', '.join(PRECISIONS)}, since frames, flows and scores need single "
                f"precision, got {self.trainer.precision}"
            )
        self.run_seed = torch.initial_seed()

    def on_train_batch_start(self, batch: Pair, batch_idx: int) -> None:
        """Seed dropout by the run and the step, so that a resumed run drops the same units."""
        torch.manual_seed(self.run_seed + self.global_step)

    def on_validation_epoch_end(self) -> None:
        """Step a plateau schedule before the checkpoint is written; Lightning would step it afterwards."""
        plateau = self.lr_schedulers()
        if isinstance(plateau, ReduceLROnPlateau) and not self.trainer.sanity_checking:
            plateau.step(self.trainer.callback_metrics["val/loss"])

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Step every schedule except a plateau."""
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the task, the sums of the flows and the origin to a checkpoint."""
        self.on_validation_start()  # within an epoch, flows are left to be added
        checkpoint.update(self.origin, task=self.task.name, flows=(self.flows[:2], self.flows[2:]))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the sums of the flows; rename weights of an older version; note the steps of complete epochs."""
        checkpoint["state_dict"] = rename_weights(checkpoint["state_dict"])
        self.flows = torch.cat(checkpoint["flows"])
        if "loops" in checkpoint:  # weights alone have none
            loop = checkpoint["loops"]["fit_loop"]
            epochs = loop["epoch_progress"]["current"]
            steps = loop["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]["step"]
            of_this = steps["current"]["completed"] if epochs["processed"] < epochs["ready"] else 0
            self.resumed = epochs["processed"], steps["total"]["completed"] - of_this

    def _log(self, split: str, scores: dict[str, Tensor], batch: Pair, suffix: str = "") -> None:
        for name, value in scores.items():
            pixels = through_fog(batch) if name == "psnr_seen" else batch.valid
            kept = value[~value.isnan() | pixels.flatten(1).any(dim=1)]  # NaN of an image without pixels to score
            mean = kept.mean() if len(kept) else torch.zeros((), device=value.device)  # of weight 0
            # Lightning averages the number over processes in its type, and would round an integer down.
            options: dict[str, Any] = {"batch_size": float(len(kept)), "on_step": False, "on_epoch": True}
            self.log(f"{split}/{name}{suffix}", mean, sync_dist=True, **options)


class Restoration(RestorationModule):
    """Train a network that restores an image in a single pass.

    Args:
        network: builds the network, called as `network(channels, smooth=...)` with the values of the task.
        task: the kind of restoration.
        lr, weight_decay, warmup_steps, schedule, metric_size: see `RestorationModule`.
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
        """Restore images (B, 3, H, W) in [0, 1]. The key has no effect, because nothing is random."""
        return self.task.restore(self.network(degraded), degraded)

    def training_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        restored = self(batch.degraded)
        return self.task.loss(restored, batch), restored

    def validation_loss(self, batch: Pair) -> tuple[Tensor, Restored]:
        return self.training_loss(batch)


def restoration_scores(
    task: Task, restored: Restored, pair: Pair, *, metric_size: tuple[int, int], with_ssim: bool = True
) -> dict[str, Tensor]:
    """Score each restoration of a batch; a score (B,) without meaning for the task is missing.

    Returns:
        L, L_rec, L_k: the loss of the task and its terms, see `Task.loss_terms`.
        psnr: dB.
        psnr_seen: dB, over the pixels of `through_fog`, for a pair with a transmission.
        ssim: at most 1; missing unless `with_ssim`.
        epe: endpoint error, px of `metric_size` = (height, width).
        coverage: share of the values of the flow within two standard deviations, for a restoration that has them.
    """
    reconstruction, of_map = task.loss_terms(restored, pair)
    losses = {"L": reconstruction, "L_rec": reconstruction}
    if of_map is not None:
        losses |= {"L": reconstruction + of_map, "L_k": of_map}
    scores = losses | _main_scores(restored, pair, metric_size)
    return scores | {"ssim": ssim(restored.image, pair.clean, pair.valid)} if with_ssim else scores


def _main_scores(restored: Restored, pair: Pair, metric_size: tuple[int, int]) -> dict[str, Tensor]:
    scores = {"psnr": psnr(restored.image.detach(), pair.clean, pair.valid)}
    if restored.flow is not None:
        scores["epe"] = endpoint_error(restored.flow.detach(), pair.flow, pair.valid, size=metric_size)
        if restored.deviation is not None:
            scores["coverage"] = coverage(restored.flow, restored.deviation, pair.flow, pair.valid)
    elif pair.transmission.ndim == 4:
        scores["psnr_seen"] = psnr(restored.image.detach(), pair.clean, through_fog(pair))
    return scores


def _check_pair(batch: object) -> None:
    if not isinstance(batch, Pair):
        raise TypeError(
            f"batch must be a Pair of torchrefract, got {type(batch).__name__}; give the trainer "
            "datamodule=PairData(...), which degrades frames on the device, a loader of pairs or, to predict, one of "
            "images (B, 3, H, W)"
        )


def _add(old: Tensor, new: Tensor) -> Tensor:
    return old.to(new.device) + new if old.shape == new.shape else new
