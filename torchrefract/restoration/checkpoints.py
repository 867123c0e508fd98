"""Checkpoints: written atomically, verified before use, and sufficient to rebuild their model safely."""

import re
import signal
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytorch_lightning
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.plugins.io import TorchCheckpointIO
from pytorch_lightning.trainer.states import TrainerFn
from pytorch_lightning.utilities.exceptions import MisconfigurationException, SIGTERMException
from torch import Tensor, nn

from torchrefract._io import as_path, local_file, make_folder, replace_file
from torchrefract._validation import UsageError
from torchrefract.restoration.pretrained import WEIGHTS_SUFFIX, find_checkpoint, model_names, read_weights
from torchrefract.restoration.tasks import Task

_PACKAGE = "torchrefract."
_ALLOWED = (nn.Module, Task)  # the classes that a checkpoint may instantiate
_SAME = "the same command starts again"  # of an evaluation
# Parts of the names of weights in older checkpoints, and the parts that replaced them.
_RENAMED = {"whole": "polynomial_head", "place": "coordinate_weight"}
_MOVED = re.compile(r"(?<=\.models\.)(resunet|segformer)(?=\.)")  # modules of older checkpoints, now in coordconv


class CheckpointError(UsageError):
    """A checkpoint is unreadable, does not fit, or cannot be written; the message says what to do."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Replace a checkpoint only by a complete one, so that a full disk keeps the last good file."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write the checkpoint to a temporary file, then move it to `path`; raise CheckpointError if that fails."""
        path = as_path(path)
        try:
            make_folder(path.parent)
            with replace_file(path, alone=True) as temporary:
                torch.save(checkpoint, temporary)
        # If the disk is full, torch raises a RuntimeError of its archive writer.
        except (OSError, RuntimeError) as error:
            if str(error).startswith("DataLoader worker"):  # killed at this time, for which PyTorch interrupts
                raise
            previous = f"; {path} of an earlier epoch is intact" if path.exists() else ""
            reason = error.strerror if isinstance(error, OSError) else "the disk may be full"
            raise CheckpointError(
                f"{path} could not be written ({reason}){previous}: free disk space or choose another hydra.run.dir, "
                "and resume with ckpt_path="
            ) from error

    def load_checkpoint(self, path: str | Path, *args: Any, **options: Any) -> dict[str, Any]:
        """Read a checkpoint, or the weights of a model that comes with torchrefract."""
        with local_file(as_path(path)) as file:
            if file.suffix != WEIGHTS_SUFFIX:
                return super().load_checkpoint(file, *args, **options)
            return {"pytorch-lightning_version": pytorch_lightning.__version__} | read_weights(file)


class StopOnSigterm(Callback):
    """Stop a training on SIGTERM between two steps, with a checkpoint that continues at the next one.

    A validation is completed first, and so is a step that accumulates gradients. The processes of a training on several
    devices stop behind the same step, whichever of them receives the signal.

    Args:
        run_dir: the run folder, whose last.ckpt the callback replaces.
    """

    def __init__(self, run_dir: str):
        self.path = as_path(run_dir) / "last.ckpt"
        self._is_pending = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Receive the signal instead of Lightning, whose processes would wait for each other within a step."""

        def receive(number: int, frame: Any) -> None:
            self._is_pending = True

        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, receive)  # Lightning restores the handler of the caller

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Let Lightning stop behind this batch if a process has received the signal."""
        is_last = (batch_idx + 1) % trainer.accumulate_grad_batches == 0 or trainer.is_last_batch
        if is_last and trainer.strategy.reduce_boolean_decision(self._is_pending, all=False):
            self._is_pending, trainer._signal_connector.received_sigterm = False, True

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Complete the validation, within which Lightning would stop."""
        if trainer.received_sigterm:
            self._is_pending, trainer._signal_connector.received_sigterm = True, False

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave a signal of the last validation to `stopping`, as the training is complete."""
        trainer._signal_connector.received_sigterm |= self._is_pending

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Write the checkpoint, and say how to continue."""
        if not isinstance(exception, SIGTERMException):
            return
        message = f"stopped by SIGTERM; {_SAME}"
        if trainer.state.fn == TrainerFn.FITTING:
            epochs: Any = trainer.fit_loop.epoch_progress.current
            # At the end of an epoch, the checkpoint exists already.
            if epochs.processed < epochs.ready:
                trainer.save_checkpoint(str(self.path))
            message = f"stopped by SIGTERM in step {trainer.global_step}; {how_to_continue(self.path)}"
        if trainer.is_global_zero:
            print(message, file=sys.stderr)


@contextmanager
def stopping(trainer: Trainer, last: Path | None = None) -> Iterator[None]:
    """Raise what a command raises if Lightning stops for a signal or an invalid option; `last` continues a training."""
    try:
        yield
        if trainer.received_sigterm:
            raise SIGTERMException
    except SIGTERMException:
        # Lightning kills its first process, which may still write, once another one has ended with an error.
        raise SystemExit(128 + signal.SIGTERM if trainer.is_global_zero else 0) from None
    except MisconfigurationException as error:
        raise UsageError(f"trainer: {error}") from error
    except SystemExit as error:  # Lightning turns Ctrl-C into the status 1
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt(how_to_continue(last) if last else _SAME) from None
        raise


def how_to_continue(path: Path) -> str:
    """Return the words that continue a stopped training from the last checkpoint."""
    return f"ckpt_path={path} continues" if path.is_file() else "no epoch was completed, so nothing is saved"


def check_run_folder(run: Path) -> None:
    """Raise CheckpointError if a new training would replace the checkpoints of another one in its run folder."""
    if (last := run / "last.ckpt").is_file():
        raise CheckpointError(
            f"run_dir must be a folder without the checkpoints of another training, got {run}: {how_to_continue(last)} "
            "that one, and another run_dir keeps it"
        )


def check_resumed(checkpoint: Mapping[str, Any], *, config: Mapping[str, Any], path: str) -> int:
    """Check that a training can resume a checkpoint, and return the number of its complete epochs.

    Args:
        checkpoint: of `read_checkpoint`.
        config: of the model of the training that resumes it, for messages with the `path` of the checkpoint.

    Raises:
        CheckpointError: the checkpoint holds weights alone, or another learning rate, weight decay or schedule than the
            configuration, which the resumed training would ignore.
    """
    if "loops" not in checkpoint:
        raise CheckpointError(
            "ckpt_path must be a checkpoint of a training, such as <run>/last.ckpt, got weights alone"
        )
    stored = checkpoint.get("config", {}).get("model", {})
    for name in ("lr", "weight_decay", "schedule"):
        if name in stored and stored[name] != config.get(name, stored[name]):
            raise CheckpointError(
                f"model.{name} must be {stored[name]}, as of the training that ckpt_path resumes, got {config[name]}: "
                f"init_from={path} starts a new training with its weights"
            )
    return int(checkpoint["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"])


class Loaded(NamedTuple):
    """A model and the facts about it that its checkpoint holds."""

    model: LightningModule  # in evaluation mode; maps images (B, 3, H, W) in [0, 1] to `Restored`
    name: str  # as of `model_name`
    task: str  # the name of its task
    size: tuple[int, int]  # height and width of the frames that it was trained on, px
    licenses: dict[str, Any]  # by source of the model, the license, or None if it is unknown


def load_model(path: str | Path, *, changes: Mapping[str, Any] | None = None, argument: str = "ckpt_path") -> Loaded:
    """Build the model of a checkpoint from the configuration inside the checkpoint.

    Only networks, models and tasks of torchrefract are instantiated. Pretrained weights are not loaded, because the
    checkpoint holds all weights.

    Args:
        path: the checkpoint, or the name of a model that comes with torchrefract, see `pretrained`.
        changes: values that replace those of the model's configuration.
        argument: the option that gave the path, for messages.

    Raises:
        CheckpointError: see `read_checkpoint` and `check_fits`; the configuration is missing or of something else.
    """
    path = find_checkpoint(path)
    checkpoint = read_checkpoint(path, argument=argument)
    config, data = (checkpoint.get(part) for part in ("config", "data"))
    if not (isinstance(config, dict) and isinstance(config.get("model"), dict) and isinstance(data, dict)):
        raise CheckpointError(
            f"{argument} must be a checkpoint with its configuration, as torchrefract.train writes them, got {path}"
        )
    model = _instantiate(config["model"], changes or {}, path)
    check_fits(checkpoint, model, path, config=config["model"], argument=argument)
    model.on_load_checkpoint(checkpoint)
    model.load_state_dict(checkpoint["state_dict"])
    licenses = checkpoint.get("licenses", {})
    name = model_name(config["model"])
    return Loaded(model.eval(), name, str(checkpoint["task"]), _frame_size(data.get("size"), path), licenses)


def load_weights(model: nn.Module, path: Path, *, task: str, config: Mapping[str, Any]) -> Any:
    """Load the weights of a checkpoint into a model of the same network, and return the checkpoint's licenses.

    Args:
        model: of that network.
        path: the checkpoint.
        task: name of the task of the model.
        config: configuration of the model, for messages.

    Raises:
        CheckpointError: see `read_checkpoint` and `check_fits`, whose messages name `init_from`.
    """
    checkpoint = read_checkpoint(path, task=task, argument="init_from")
    check_fits(checkpoint, model, path, config=config, argument="init_from")
    model.load_state_dict(checkpoint["state_dict"])
    return checkpoint.get("licenses")


def read_checkpoint(path: Path, *, task: str | None = None, argument: str = "ckpt_path") -> dict[str, Any]:
    """Read a checkpoint without running code from it; its task must be `task`, if that is given.

    Args:
        path: the file.
        task: the name of the task that is expected; None allows any.
        argument: the option that gave the path, for messages.

    Raises:
        CheckpointError: the file is missing, damaged, no checkpoint of torchrefract, or of another task.
    """
    if not path.is_file():
        names = " or ".join(model_names())
        raise CheckpointError(
            f"{argument} must be a checkpoint file, such as <run>/last.ckpt, or the name {names}, got {path}"
        )
    try:
        with local_file(path) as file:
            checkpoint = read_weights(file) if path.suffix == WEIGHTS_SUFFIX else _read_archive(file)
    except Exception as error:  # zipfile, torch.load and safetensors raise many types for a damaged file
        raise CheckpointError(
            f"{argument} must be an intact checkpoint, got {path}, which is damaged or another kind of file"
        ) from error
    weights, name = (checkpoint.get(key) if isinstance(checkpoint, dict) else None for key in ("state_dict", "task"))
    if not (
        isinstance(name, str)
        and isinstance(weights, dict)
        and all(isinstance(key, str) and isinstance(value, Tensor) for key, value in weights.items())
    ):
        raise CheckpointError(f"{argument} must be a checkpoint of torchrefract, got {path}")
    if task not in (None, name):
        raise CheckpointError(f"{argument} must be a checkpoint of the task {task}, got {path} of {name}")
    return checkpoint | {"state_dict": rename_weights(weights)}


def _read_archive(path: Path) -> Any:
    # torch.load compares no checksums, so a hole in the file would silently change weights.
    with zipfile.ZipFile(path) as archive:
        if (damaged := archive.testzip()) is not None:
            raise zipfile.BadZipFile(damaged)
    return torch.load(path, map_location="cpu", weights_only=True, mmap=True)


def rename_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Give weights of an older version the names of this one."""
    return {".".join(_RENAMED.get(part, part) for part in name.split(".")): weights[name] for name in weights}


def check_fits(
    checkpoint: Mapping[str, Any],
    model: nn.Module,
    path: Path,
    *,
    config: Mapping[str, Any] | None = None,
    argument: str = "ckpt_path",
) -> None:
    """Raise CheckpointError unless the weights of a checkpoint have the names and shapes of a model's.

    The message names the option `argument`, the path and, if the configuration of the model is given, both models.
    """
    shapes, saved = (
        {name: value.shape for name, value in weights.items()}
        for weights in (model.state_dict(), checkpoint["state_dict"])
    )
    differing = sorted(name for name in shapes.keys() | saved.keys() if shapes.get(name) != saved.get(name))
    if not differing:
        return
    expected, reason = "the model that model= names", f", where {differing[0]} differs"
    if config and "config" in checkpoint:
        name, other = model_name(config), model_name(checkpoint["config"]["model"])
        if name != other:
            expected, reason = f"{name}, which model= names", f" of {other}"
    raise CheckpointError(f"{argument} must be a checkpoint of {expected}, got {path}{reason}")


def model_name(model: Mapping[str, Any]) -> str:
    """Return the network of a model's configuration and its encoder, such as "ResUNet (tu-resnet34)"."""
    network = model.get("network", model)
    name = str(network.get("_target_", "a network")).rsplit(".", 1)[-1]
    return f"{name} ({network['encoder']})" if "encoder" in network else name


def _instantiate(config: dict[str, Any], changes: Mapping[str, Any], path: Path) -> LightningModule:
    """Instantiate the configuration of a model after checking that it can do nothing else."""
    try:
        merged = OmegaConf.to_container(OmegaConf.merge(config, dict(changes)), resolve=False)
        model = instantiate(safe_config(merged, path))
    except (InstantiationException, OmegaConfBaseException, ValueError, TypeError) as error:
        reason = error.__cause__ or error
        if isinstance(reason, ModuleNotFoundError):
            raise reason from None  # a missing library is not a fault of the checkpoint
        raise CheckpointError(f"ckpt_path must be of a model that can be built, got {path}: {reason}") from error
    if not isinstance(model, LightningModule):
        raise CheckpointError(f"ckpt_path must be of a model, got {path} of {type(model).__name__}")
    return model


def safe_config(value: Any, path: Path, *, is_allowed: Callable[[Any], bool] | None = None) -> Any:
    """Drop pretrained weights from a configuration; raise CheckpointError if it could run code or read files.

    Args:
        value: the configuration, or a part of it.
        path: of the checkpoint, for messages.
        is_allowed: returns True for other classes and functions of torchrefract that may be instantiated.
    """
    if isinstance(value, str) and "${" in value:
        raise CheckpointError(f"ckpt_path must hold a resolved configuration, got {path} with ${{…}} in it")
    if isinstance(value, list):
        return [safe_config(child, path, is_allowed=is_allowed) for child in value]
    if not isinstance(value, dict):
        return value
    safe = {
        key: None if key == "pretrained" else safe_config(child, path, is_allowed=is_allowed)
        for key, child in value.items()
    }
    if isinstance(target := safe.get("_target_"), str):
        safe["_target_"] = target = _MOVED.sub("coordconv", target)
    if "_target_" in safe:
        named = _resolve(target)
        is_model = isinstance(named, type) and issubclass(named, _ALLOWED)
        if named is None or not (is_model or (is_allowed and is_allowed(named))):
            raise CheckpointError(
                f"ckpt_path must name models and tasks of torchrefract only, got {path} with {target!r}"
            )
    return safe


def _resolve(target: Any) -> Any:
    """Import what a target names; return None if torchrefract does not define it."""
    if not isinstance(target, str) or not target.startswith(_PACKAGE):
        return None
    module, _, name = target.rpartition(".")
    try:
        value = getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or f"{error.name}.".startswith(_PACKAGE):
            return None
        raise  # a missing library is not a fault of the checkpoint
    except (ImportError, ValueError, AttributeError):
        return None
    # Our modules have attributes of other packages, so the module that defines the value decides.
    return value if str(getattr(value, "__module__", "")).startswith(_PACKAGE) else None


def _frame_size(size: Any, path: Path) -> tuple[int, int]:
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)):
        raise CheckpointError(f"ckpt_path must hold the size of its frames, got {path} with {size!r}")
    return size[0], size[1]
